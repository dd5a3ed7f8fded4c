"""Solve one scene in a process of its own: ``python -m benchmarks.one FOLDER OUTPUT``.

Prints a line of JSON: seconds per stage, peak memory, steps, and accuracy against the truth.
"""

import json
import re
import sys
import time
from pathlib import Path

import numpy as np

BORDER = 10  # posts left out of the comparison


def main(folder, output):
    start = time.perf_counter()
    from benchmarks.stopwatch import Stopwatch
    from lommel.estimate import problem, shape_from_shading
    from lommel.run import shape_from_shading as stage
    from lommel.run.inputs import SceneFiles

    watch = Stopwatch()
    watch.watch(stage, "read_views", "read")
    watch.watch(stage, "solve_surface", "other")
    for name in ("prepare_geometry", "sample_images", "find_shadows"):
        watch.watch(problem.Problem, name, "geometry, sampling")
    watch.watch(shape_from_shading, "_estimate_priors", "priors")
    watch.watch(shape_from_shading, "_coarse_to_fine", "coarse levels")
    watch.watch(
        shape_from_shading,
        "_descend",
        lambda level, *_: "finest steps" if level.stride == 1 else "coarse levels",
    )
    watch.watch(shape_from_shading, "_fit_albedo", "albedo")
    watch.seconds["import"] = time.perf_counter() - start
    loaded = peak_memory()
    folder = Path(folder)
    files = SceneFiles(
        images=tuple(sorted(folder.glob("img*.tif"))),
        dems=(folder / "init_dem.tif",),
        sun_positions=folder / "sun_positions.txt",
    )
    begun = time.perf_counter()
    stage.run_shape_from_shading(files, output)
    run = time.perf_counter() - begun
    known = sum(seconds for name, seconds in watch.seconds.items() if name != "import")
    watch.seconds["write, report"] = run - known
    record = json.loads((Path(output) / "run.json").read_text())
    fine = [step for step in record["history"] if step["stride"] == 1]
    print(
        json.dumps(
            {
                "stages": watch.seconds,
                "peak_bytes": peak_memory(),
                "import_bytes": loaded,
                "outcome": record["outcome"]["name"],
                "cycles": [step["cycles"] for step in fine],
                **accuracy(folder, output),
            }
        )
    )


def peak_memory():
    """Largest resident memory of this process so far, bytes; `getrusage` knows its parent's."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(re.search(r"VmHWM:\s+(\d+) kB", status)[1])


def accuracy(folder, output):
    """Errors of height (m), slope (degrees) and albedo against the truth."""
    from lommel.io.raster import read_grid, read_pixels

    truth = read_pixels(folder / "truth_dem.tif")
    spacing = read_grid(folder / "truth_dem.tif").spacing
    refined = read_pixels(Path(output) / "dem.tif")
    inside = (slice(BORDER, -BORDER),) * 2
    error = (refined - truth)[inside].astype(float)
    slope = (slope_deg(refined, spacing) - slope_deg(truth, spacing))[inside]
    result = {
        "height_rmse_m": float(np.sqrt(np.nanmean(error**2))),
        "slope_rmse_deg": float(np.sqrt(np.nanmean(slope.astype(float) ** 2))),
    }
    if (folder / "truth_albedo.tif").exists():
        albedo = read_pixels(Path(output) / "albedo.tif")
        true = read_pixels(folder / "truth_albedo.tif")
        both = np.isfinite(albedo[inside]) & np.isfinite(true[inside])
        pairs = albedo[inside][both], true[inside][both]
        result["albedo_correlation"] = float(np.corrcoef(*pairs)[0, 1])
    return result


def slope_deg(heights, spacing):
    """Slope angle by central differences, degrees."""
    down, along = np.gradient(heights, *(np.float32(s) for s in spacing))
    return np.degrees(np.arctan(np.hypot(down, along)))


if __name__ == "__main__":
    main(*sys.argv[1:])
