"""Few images chosen of many, against all of them and as many at random.

``python -m benchmarks.choice FOLDER`` makes scenes of 24 images there and solves them, each run in
a process of its own. It prints a row per run: error of heights and slopes, processor seconds, and
largest memory.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.one import accuracy, peak_memory
from benchmarks.scenes import Scene, make_scene

POSTS, IMAGES = 384, 24
PASSES = (12, 6, 4, 2)  # images under nearly one Sun
SCENES = (("passes", 1), ("passes", 2), ("spread", 1))
DRAWS = 3  # of images at random


def lights(kind, seed):
    """Azimuth and elevation of Suns, azimuth and off-nadir angle of cameras, degrees."""
    random = np.random.default_rng(1000 + seed)
    if kind == "spread":
        suns = [(random.uniform(0, 360), random.uniform(12, 65)) for _ in range(IMAGES)]
    else:
        centres = [(random.uniform(0, 360), random.uniform(15, 60)) for _ in PASSES]
        suns = [
            (azimuth + random.normal(0, 2), elevation + random.normal(0, 1))
            for (azimuth, elevation), count in zip(centres, PASSES, strict=True)
            for _ in range(count)
        ]
    cameras = [(random.uniform(0, 360), random.uniform(0, 15)) for _ in range(IMAGES)]
    return tuple(suns), tuple(cameras)


def run(folder, output, names, all_images):
    """Solve with some of a scene's images; accuracy and cost, printed as JSON."""
    from lommel.run.inputs import SceneFiles
    from lommel.run.shape_from_shading import SfsSettings, run_shape_from_shading

    images = tuple(folder / name for name in names)
    files = SceneFiles(images, (folder / "init_dem.tif",), folder / "sun_positions.txt")
    start = time.process_time()
    results = run_shape_from_shading(
        files, output, SfsSettings(all_images=all_images), overwrite=True
    )
    found = accuracy(folder, output) | {"seconds": time.process_time() - start}
    found |= {"images": results["images"], "peak_mb": peak_memory() / 1e6}
    print(json.dumps(found))


def make_many(kind, seed, folder):
    """Write a scene of many images; its folder."""
    place = folder / f"{kind}{seed}"
    suns, cameras = lights(kind, seed)
    light = {"suns_deg": suns, "cameras_deg": cameras}
    make_scene(Scene(POSTS, IMAGES, seed, albedo_contrast=0.1, noise=0.0075, **light), place)
    return place


def main(folder):
    print("| scene | images | height, m | slope, deg | processor s | peak MB |")
    print("|---|---|---|---|---|---|")
    for kind, seed in SCENES:
        place = make_many(kind, seed, folder)
        names = sorted(path.name for path in place.glob("img*.tif"))
        chosen = report(place, f"{kind} {seed}, chosen", names, False)
        report(place, f"{kind} {seed}, all", names, True)
        random = np.random.default_rng(seed)
        for _ in range(DRAWS):
            drawn = sorted(random.choice(names, chosen, replace=False).tolist())
            report(place, f"{kind} {seed}, random", drawn, True)


def report(place, title, names, all_images):
    command = [sys.executable, "-m", "benchmarks.choice", str(place), str(all_images), *names]
    answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    found = json.loads(answer.splitlines()[-1])
    print(
        f"| {title} | {found['images']} | {found['height_rmse_m']:.3f} | "
        f"{found['slope_rmse_deg']:.3f} | {found['seconds']:.1f} | {found['peak_mb']:.0f} |",
        flush=True,
    )
    return found["images"]


if __name__ == "__main__":
    if len(sys.argv) == 2:
        main(Path(sys.argv[1]))
    else:
        place = Path(sys.argv[1])
        run(place, place / "solved", sys.argv[3:], sys.argv[2] == "True")
