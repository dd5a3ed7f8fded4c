"""What a true surface leaves of images on coarse posts, and what that grows with.

    python design/sfs_coarse_misfit.py      # with benchmarks/ on the path

A coarse level of shape from shading averages images over its cells and heights over its posts.
The residual of the true surface there is no noise of pixels; over terrain of any roughness, Suns
and views, in units of roughness times the change of brightness with slope, it is nearly one number.
`lommel.estimate.problem.HIDDEN_SLOPE` is that number.
"""

import tempfile
from pathlib import Path

import numpy as np
from benchmarks.scenes import Scene, make_scene

from lommel.core.reflectance import reflectance_model
from lommel.estimate.problem import fresh_problem
from lommel.estimate.shape_from_shading import solve_surface
from lommel.estimate.surface import Surface
from lommel.io.raster import read_pixels
from lommel.run.inputs import SceneFiles
from lommel.run.views import read_views

SCENES = {
    "as benchmarks": Scene(1000, 4, seed=2),
    "other seed": Scene(1000, 4, seed=3),
    "slopes of 4": Scene(1000, 4, seed=2, slope_deg=4.0),
    "slopes of 14": Scene(1000, 4, seed=2, slope_deg=14.0),
    "small phase": Scene(1000, 1, seed=2, cameras_deg=((62.0, 42.0),)),
    "large phase": Scene(1000, 1, seed=2, cameras_deg=((242.0, 42.0),)),
    "rougher detail": Scene(1000, 4, seed=5, hurst=0.6),
    "smoother detail": Scene(1000, 4, seed=6, finest_detail=2.0),
}
COARSEST = 40  # posts along a side


def main():
    """One line per scene and stride."""
    model = reflectance_model("lunar-lambert")
    for name, scene in SCENES.items():
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            make_scene(scene, folder)
            images = tuple(sorted(folder.glob("img*.tif")))
            dem, suns = folder / "init_dem.tif", folder / "sun_positions.txt"
            seen = read_views(SceneFiles(images, (dem,), suns))
            truth = read_pixels(folder / "truth_dem.tif")
        surface = Surface(seen.grid, float(seen.heights.mean()))
        initial = surface.posts_from_heights(seen.heights)
        roughness = solve_surface(surface, initial, seen.views, model).value.priors.roughness
        level = fresh_problem(surface, surface.posts_from_heights(truth), seen.views, model, None)
        level.see(level.initial)
        level.exposures[:] = scene.exposure
        count = range(scene.images)
        gains = [np.hypot(*level.mean_gain(level.initial, k)) for k in count]
        brightness = level.typical_brightness()
        while min(level.initial.shape) > COARSEST:
            left = [(level.cells[k] - level.predict(level.initial, k))[2:-2, 2:-2] for k in count]
            bias = np.mean([np.nanmean(left[k]) / brightness[k] for k in count])
            share = np.mean([np.nanstd(left[k]) / gains[k] / roughness for k in count])
            print(
                f"{name:16} every {level.stride:2}th post: mean {100 * bias:6.2f} % of the "
                f"brightness, std {share:.3f} of roughness times gain",
                flush=True,
            )
            level = level.coarser()


if __name__ == "__main__":
    main()
