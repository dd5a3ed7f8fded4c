"""The benchmark's scenes are what they claim to be, and the package reads them."""

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
SHADING = 0.007  # of the brightness: 0.5 % noise, and what the ground is rougher than its posts
PLACE = 0.05  # posts: an image displaced by more would be seen as shading


@pytest.fixture(scope="module")
def scenes():
    sys.path.insert(0, str(ROOT))
    from benchmarks import scenes

    return scenes


@pytest.fixture(scope="module")
def folder(scenes, tmp_path_factory):
    path = tmp_path_factory.mktemp("scene")
    scenes.make_scene(scenes.Scene(posts=96, images=2, seed=5, albedo_contrast=0.1), path)
    return path


@pytest.fixture(scope="module")
def seen(folder):
    from lommel.run.inputs import SceneFiles
    from lommel.run.views import read_views

    images = tuple(sorted(folder.glob("img*.tif")))
    files = SceneFiles(images, (folder / "truth_dem.tif",), folder / "sun_positions.txt")
    return read_views(files)


def test_the_same_seed_makes_the_same_scene(scenes, folder, tmp_path):
    scenes.make_scene(scenes.Scene(posts=96, images=2, seed=5, albedo_contrast=0.1), tmp_path)
    for name in ("truth_dem.tif", "init_dem.tif", "img2.tif", "img2.tsai", "sun_positions.txt"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


def test_the_true_dem_explains_the_images_to_their_noise_where_they_are(seen, folder):
    from lommel.core.reflectance import reflectance_model
    from lommel.estimate.problem import fresh_problem
    from lommel.estimate.surface import Surface
    from lommel.io.raster import read_pixels

    surface = Surface(seen.grid, float(seen.heights.mean()))
    u = surface.posts_from_heights(seen.heights)
    albedo = read_pixels(folder / "truth_albedo.tif")
    level = fresh_problem(surface, u, seen.views, reflectance_model("lunar-lambert"), albedo)
    level.prepare_geometry(u)
    level.sample_images(u)
    level.exposures[:] = 100.0
    for k, cells in enumerate(level.cells):
        model = level.predict(u, k)
        error = (cells - model)[2:-2, 2:-2]
        assert np.nanstd(error) < SHADING * np.nanmean(cells)
        for axis in (0, 1):
            rise = np.gradient(model, axis=axis)[2:-2, 2:-2]
            assert abs(np.nansum(rise * error) / np.nansum(rise**2)) < PLACE


def test_the_initial_dem_is_the_true_one_without_its_short_waves(folder):
    from lommel.io.raster import read_pixels

    error = read_pixels(folder / "init_dem.tif") - read_pixels(folder / "truth_dem.tif")
    assert 1.0 < error.std() < 5.0  # m, of which 1 m is noise
    assert abs(error.mean()) < 0.3  # m: a blur keeps the mean but for what crosses the border
