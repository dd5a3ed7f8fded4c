"""Windows at full resolution that tell what the tiles of a large scene share."""

import numpy as np
import pytest

from lommel.core.reflectance import reflectance_model
from lommel.estimate.problem import coarse_posts, fresh_problem
from lommel.estimate.surface import Surface
from lommel.io.raster import read_pixels
from lommel.run.footprints import find_footprints
from lommel.run.shape_from_shading import SfsSettings
from lommel.run.tiles_plan import coarse_grid
from lommel.run.tiles_samples import photometry, solve_samples
from lommel.run.views import read_views

from .tiled_scene import files_of

STRIDE = 4


@pytest.fixture(scope="module")
def coarse(tile_scene):
    """Images on coarse posts, and what windows tell of them."""
    footprints = find_footprints(files_of(tile_scene))
    scene = read_views(footprints.used, coarse_grid(footprints.grid, STRIDE))
    return scene, solve_samples(footprints, STRIDE, SfsSettings(), scene.thresholds)


def test_windows_tell_what_the_truth_leaves_of_images_on_coarse_posts(tile_scene, coarse):
    """They know the refined surface only, which lacks finest relief: hence the tenth."""
    scene, samples = coarse
    found = photometry([view.name for view in scene.views], samples)
    u = read_pixels(tile_scene / "truth_dem.tif")
    for _ in range(STRIDE.bit_length() - 1):
        u = coarse_posts(u)
    surface = Surface(scene.grid, float(u.mean()))
    model, truth = reflectance_model("lunar-lambert"), surface.posts_from_heights(u)
    level = fresh_problem(surface, truth, scene.views, model, None)
    level.see(truth)
    level.exposures = found.exposures
    for k, misfit in enumerate(found.coarse_misfits):
        left = np.sqrt(np.nanmean((level.cells[k] - level.predict(truth, k)) ** 2))
        assert misfit == pytest.approx(left, rel=0.1)
        assert misfit > 3 * found.noise[k] / STRIDE


def test_an_image_that_no_window_sees_has_no_photometry_of_its_own(coarse):
    scene, samples = coarse
    found = photometry(["not there.tif", scene.views[0].name], samples)
    for values in vars(found).values():
        assert np.isnan(values[0]) and np.isfinite(values[1])
