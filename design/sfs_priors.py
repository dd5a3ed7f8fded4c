"""How far the estimated priors of `lommel sfs` are from the best that a scan can find.

For each scene folder (img*.tif with .tsai cameras, sun_positions.txt, init_dem.tif, truth_dem.tif):
height and slope RMSE of the untouched default, and of the best combination of
--terrain-roughness, --initial-dem-error and --initial-dem-resolution, found with the truth at hand.

    python design/sfs_priors.py SCENE_FOLDER...
"""

import itertools
import sys
from pathlib import Path

import numpy as np

from lommel.core.reflectance import reflectance_model
from lommel.estimate.priors import PriorSettings
from lommel.estimate.shape_from_shading import solve_surface
from lommel.estimate.surface import Surface
from lommel.evaluate import compare_heights
from lommel.io.raster import read_pixels
from lommel.run.inputs import SceneFiles
from lommel.run.views import read_views

ROUGHNESS_DEG = (2.0, 4.0, 8.0, 16.0)
ERROR_M = (0.1, 0.3, 1.0, 3.0, 10.0)
RESOLUTION_POSTS = (4, 8, 16, 32)
BORDER = 10  # posts


def main(folders):
    """Print one line per scene."""
    print("scene            default m / deg     best m / deg   at roughness, error, resolution")
    for folder in map(Path, folders):
        files = SceneFiles(
            tuple(sorted(folder.glob("img*.tif"))),
            (folder / "init_dem.tif",),
            folder / "sun_positions.txt",
        )
        terrain = read_views(files)
        truth = read_pixels(folder / "truth_dem.tif")
        default = score(terrain, truth, PriorSettings())
        spacing = terrain.grid.spacing[0]
        scan = {}
        for roughness, error, posts in itertools.product(ROUGHNESS_DEG, ERROR_M, RESOLUTION_POSTS):
            settings = PriorSettings(np.radians(roughness), error, posts * spacing)
            scan[roughness, error, posts * spacing] = score(terrain, truth, settings)
        best = min(scan, key=lambda key: scan[key][0])
        print(
            f"{folder.name:16} {default[0]:7.3f} / {default[1]:.3f}  {scan[best][0]:9.3f} / "
            f"{scan[best][1]:.3f}   {best[0]:g} deg, {best[1]:g} m, {best[2]:.0f} m",
            flush=True,
        )


def score(terrain, truth, settings):
    """Height and slope RMSE of one solve, m and degrees."""
    surface = Surface(terrain.grid, float(terrain.heights.mean()))
    start = surface.posts_from_heights(terrain.heights)
    solution = solve_surface(surface, start, terrain.views, reflectance_model(), settings)
    heights = surface.heights_from_posts(solution.value.u)
    errors = compare_heights(heights, truth, terrain.grid, BORDER)
    return errors["height_rmse_m"], errors["slope_rmse_deg"]


if __name__ == "__main__":
    main(sys.argv[1:])
