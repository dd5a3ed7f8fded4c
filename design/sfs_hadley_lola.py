"""How well one Apollo image fills the gaps between laser tracks, on tracks that were left out.

The image is registered once, to the DEM of all dates. Then, fold by fold, the shots of a few dates
are left out of a linear interpolation of the others, `lommel sfs` refines that DEM from the image
without any option, and both are compared with the shots left out, also by their distance to shots
that were used: gaps get wider than those of the whole set.

    python design/sfs_hadley_lola.py FOLDER [DATES_PER_FOLD]

FOLDER holds AS15-M-1134-hadley.cub, lola-shots.csv and initial-dem.tif, whose grid is used.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from lommel.io.raster import read_grid, read_pixels, write_raster
from lommel.run.inputs import SceneFiles
from lommel.run.register import run_register
from lommel.run.shape_from_shading import run_shape_from_shading

IMAGE = "AS15-M-1134-hadley"
REACHES = (10, 20, 30, 40)  # posts
SEED = 5  # of the order in which dates are left out


def main(folder, dates_per_fold=3):
    """Print one line per fold, and one for all shots that the image sees or does not see."""
    folder = Path(folder)
    shots = np.genfromtxt(
        folder / "lola-shots.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    grid = read_grid(folder / "initial-dem.tif")
    places = np.stack(
        grid.index_at(np.radians(shots["longitude_deg"]), np.radians(shots["latitude_deg"]))
    )
    inside = ((places >= 0) & (places.T <= np.array(grid.shape) - 1).T).all(axis=0)
    dates = np.random.default_rng(SEED).permutation(np.unique(shots["date"]))
    results = []
    with tempfile.TemporaryDirectory() as work:
        work = Path(work)
        image = folder / f"{IMAGE}.cub"
        run_register(SceneFiles((image,), (folder / "initial-dem.tif",)), work / "cameras")
        camera = work / "cameras" / f"{IMAGE}.json"
        for first in range(0, dates.size - dates_per_fold + 1, dates_per_fold):
            out = np.isin(shots["date"], dates[first : first + dates_per_fold])
            write_raster(work / "dem.tif", _interpolated(grid, places, shots, ~out), grid, "height")
            run_shape_from_shading(
                SceneFiles((image,), (work / "dem.tif",), cameras=(camera,)),
                work / "sfs",
                overwrite=True,
            )
            left = out & inside
            distance = cKDTree(places[:, ~out].T).query(places[:, left].T)[0]
            results.append(_errors(work, places[:, left], shots["height_m"][left], distance))
            print(", ".join(dates[first : first + dates_per_fold]), _words(results[-1]), flush=True)
    before, after, seen, distance = np.concatenate(results, axis=1)
    print("all:", _words((before, after)))
    for reach in REACHES:
        part = distance <= reach
        print(f"within {reach} posts of a shot that was used:", _words((before[part], after[part])))
    for name, part in (("seen by the image:", seen > 0), ("not seen:", seen == 0)):
        print(name, _words((before[part], after[part])))


def _interpolated(grid, places, shots, kept):
    surface = LinearNDInterpolator(places[:, kept].T, shots["height_m"][kept])
    return surface(*np.indices(grid.shape)).astype(np.float32)


def _errors(work, places, heights, distance):
    """Errors before and after, m, whether the image sees the place, and how far it is, posts."""
    before, after = (
        map_coordinates(read_pixels(work / name), places, order=1) - heights
        for name in ("dem.tif", "sfs/dem.tif")
    )
    seen = np.isfinite(read_pixels(work / "sfs/measured.tif")).astype(float)
    seen = map_coordinates(seen, places - 0.5, order=0, mode="nearest")
    known = np.isfinite(before) & np.isfinite(after)
    return np.stack([before, after, seen, distance])[:, known]


def _words(errors):
    sentences = []
    for name, e in zip(("before", "after"), errors, strict=False):
        rmse, mae = np.sqrt(np.mean(e**2)), np.mean(np.abs(e))
        nmad = 1.4826 * np.median(np.abs(e - np.median(e)))
        sentences.append(f"{name} RMSE {rmse:.1f} MAE {mae:.1f} NMAD {nmad:.1f} m")
    return f"({len(errors[0])} shots) " + ", ".join(sentences)


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
