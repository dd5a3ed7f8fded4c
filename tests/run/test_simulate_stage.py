import csv
import json

import numpy as np
import pytest

from lommel.errors import InputError
from lommel.io.positions import find_position, read_positions
from lommel.io.raster import raster_info, read_grid, read_pixels
from lommel.run.simulate import run_simulate, scene_settings
from lommel.scene.body import MOON
from lommel.simulate import SceneSettings, preset, simulate_scene

SMALL = """
seed = 7
[grid]
rows = 24
cols = 64
spacing = 8000.0
[film]
haze = 4.0
"""


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "small.toml"
    path.write_text(SMALL, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def folder(scene_file):
    return run_simulate(scene_file, scene_file.parent / "out")


@pytest.fixture(scope="module")
def scene(scene_file):
    return simulate_scene(scene_settings(scene_file))


def test_what_the_scene_file_leaves_out_has_the_default(scene_file):
    settings = scene_settings(scene_file)
    assert settings.seed == 7
    assert settings.film.haze == 4.0
    assert settings.film.noise == SceneSettings().film.noise
    assert settings.orbit == SceneSettings().orbit
    assert scene_settings("sfs-patch") is preset("sfs-patch")


def test_rasters_return_as_simulated(folder, scene):
    assert read_grid(folder.truth_dem).is_same(scene.grid)
    np.testing.assert_array_equal(read_pixels(folder.truth_dem), scene.heights.astype("f4"))
    np.testing.assert_array_equal(
        read_pixels(folder.initial_dem), scene.initial_heights.astype("f4")
    )
    np.testing.assert_array_equal(read_pixels(folder.truth_albedo), scene.albedo.astype("f4"))


def test_images_return_with_mask_saturation_and_place(folder, scene):
    assert len(folder.images) == len(scene.images) == 9
    for path, image in zip(folder.images, scene.images, strict=True):
        observation = image.observation
        assert path.name == observation.name
        np.testing.assert_array_equal(read_pixels(path), observation.measured)
        assert read_grid(path).is_same(scene.grid.cut(observation.window))
        assert raster_info(path).saturation == observation.saturation == 255.0


def test_positions_return_within_a_millimetre(folder, scene):
    sun = read_positions(folder.sun_positions, "sun", MOON)
    spacecraft = read_positions(folder.spacecraft_positions, "spacecraft", MOON)
    for image in scene.images:
        observation = image.observation
        there = find_position(spacecraft, observation.name, folder.spacecraft_positions)
        np.testing.assert_allclose(there, observation.spacecraft_position, atol=1e-3)
        there = find_position(sun, observation.name, folder.sun_positions)
        np.testing.assert_allclose(there, observation.sun_position, rtol=1e-14)


def test_true_exposures_are_listed(folder, scene):
    with open(folder.truth_exposures, encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["exposure"]) for row in rows] == [image.exposure for image in scene.images]
    assert any(float(row["haze"]) > 0 for row in rows)


def test_run_record_repeats_the_settings(folder, scene_file):
    record = json.loads((folder.folder / "run.json").read_text())
    assert record["command"] == "simulate"
    assert record["settings"]["seed"] == 7
    assert record["inputs"][0]["path"] == str(scene_file)
    assert record["results"]["images"] == 9


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sede = 3\n", "sede is not a setting"),
        ("[film]\ngrain = 0.1\n", "film.grain is not a setting"),
        ("[grid]\nrows = 'many'\n", "grid.rows = 'many'"),
        ("[grid]\nrows = 2\n", "grid.rows = 2 cannot be simulated. Give 8 or more"),
        ("seed = \n", "cannot be read as TOML"),
    ],
)
def test_scene_file_with_a_mistake_is_an_error(tmp_path, text, message):
    path = tmp_path / "scene.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        scene_settings(path)


def test_missing_scene_file_is_an_error(tmp_path):
    with pytest.raises(InputError, match="cannot be read as TOML"):
        scene_settings(tmp_path / "nowhere.toml")


def test_existing_folder_is_kept_without_overwrite(folder, scene_file):
    with pytest.raises(InputError, match="--overwrite"):
        run_simulate(scene_file, folder.folder)
    assert folder.truth_dem.exists()
