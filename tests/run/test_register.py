import csv
import json

import numpy as np
import pytest

from lommel.errors import GeometryError, InputError
from lommel.io.cameras import read_camera
from lommel.io.isd import write_isd
from lommel.run.albedo import run_albedo
from lommel.run.inputs import SceneFiles
from lommel.run.register import run_register, settle_cameras
from lommel.run.register_to_terrain import RegistrationSettings, register_to_terrain

from .pointing_scene import (
    PIXELS,
    make_scene,
    mispointed,
    placement_errors,
    write_pixels,
)

FINE = 0.3  # px, where the DEM is as fine as the image; found: up to 0.2
ERRORS = 4.0  # standard errors told, of the error made


@pytest.mark.parametrize(
    ("seed", "elevation", "azimuth", "offset", "direction", "twist"),
    [(1, 12.0, 80.0, 2000.0, 0.5, 2e-3), (2, 35.0, 250.0, 1500.0, 4.0, -2e-3)],
)
def test_a_pointing_error_of_kilometres_is_found(
    tmp_path, seed, elevation, azimuth, offset, direction, twist
):
    scene = make_scene(tmp_path, seed, elevation, azimuth, tilt=10.0)
    image = scene.write_image(tmp_path / "frame.tif")
    believed = mispointed(scene.camera, offset, direction, twist)
    assert np.median(placement_errors(believed, scene.camera, scene.surface)) > 20
    state = register_to_terrain(image.with_camera(believed), scene.terrain, RegistrationSettings())
    assert placement_errors(state.corrected.camera, scene.camera, scene.surface).max() < FINE
    assert state.agreeing > 0.8 * state.patches > 8


def test_a_dem_five_times_coarser_than_the_image_still_tells(tmp_path):
    scene = make_scene(tmp_path, 3, 30.0, 100.0, dem_spacing=320.0)
    image = scene.write_image(tmp_path / "frame.tif")
    believed = mispointed(scene.camera, 1800.0, 2.0)
    state = register_to_terrain(image.with_camera(believed), scene.terrain, RegistrationSettings())
    errors = placement_errors(state.corrected.camera, scene.camera, scene.surface)
    assert errors.max() * state.site.gsd < ERRORS * state.error
    assert state.error < 40.0  # m, an eighth of the DEM's spacing


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("scene"), 4, 30.0, 100.0)


def frame(scene, folder, name, offset, direction, noise=0.01):
    """An image and the camera that a user has of it, beside it."""
    image = scene.write_image(folder / f"{name}.tif", noise=noise, seed=len(name))
    write_isd(folder / f"{name}.json", mispointed(scene.camera, offset, direction))
    return image.path


def test_corrected_cameras_are_written_and_what_cannot_be_placed_is_left_out(scene, tmp_path):
    good = frame(scene, tmp_path, "good", 1200.0, 1.0)
    second = frame(scene, tmp_path, "second", 700.0, 4.0)
    noise = np.random.default_rng(0).standard_normal((PIXELS, PIXELS)).astype(np.float32)
    write_pixels(tmp_path / "noise.tif", noise)
    write_isd(tmp_path / "noise.json", scene.camera)
    lone = tmp_path / "lone.tif"
    write_pixels(lone, noise)
    files = SceneFiles((good, second, tmp_path / "noise.tif", lone), (scene.dem,))
    results = run_register(files, tmp_path / "out")
    assert results["images"] == 2
    assert results["tie_residual_px"] < 0.2
    with open(tmp_path / "out" / "register.csv", encoding="utf-8") as table:
        rows = {row["image"]: row for row in csv.DictReader(table)}
    assert [rows[name]["used"] for name in ("good.tif", "second.tif")] == ["1", "1"]
    assert rows["good.tif"]["quality"] == "patches"
    assert float(rows["good.tif"]["shift_m"]) == pytest.approx(1200.0, abs=60.0)
    for name in ("good", "second"):
        camera = read_camera(tmp_path / "out" / f"{name}.json", (PIXELS, PIXELS))
        assert placement_errors(camera, scene.camera, scene.surface).max() < FINE
    assert rows["noise.tif"]["used"] == "0"
    assert "no place on the terrain stands out" in rows["noise.tif"]["reason"]
    assert "no camera found" in rows["lone.tif"]["reason"]
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert {skip["image"] for skip in record["skipped"]} == {"noise.tif", "lone.tif"}


def test_an_image_beyond_the_search_radius_is_not_placed_wrongly(scene, tmp_path):
    path = frame(scene, tmp_path, "far", 2500.0, 1.0)
    with pytest.raises(GeometryError, match="no place on the terrain stands out"):
        run_register(
            SceneFiles((path,), (scene.dem,)),
            tmp_path / "out",
            RegistrationSettings(search_radius=1000.0),
        )
    assert not (tmp_path / "out").exists()


def test_an_image_that_is_off_is_warned_of_and_registered_on_demand(scene, tmp_path):
    path = frame(scene, tmp_path, "off", 1500.0, 1.0)
    files = SceneFiles((path,), (scene.dem,))
    same, lost, remark = settle_cameras(files, tmp_path)
    assert (same, lost) == (files, [])
    assert "off.tif by 1" in remark
    settled, lost, remark = settle_cameras(files, tmp_path, registers=True)
    camera = read_camera(settled.cameras[0], (PIXELS, PIXELS))
    assert placement_errors(camera, scene.camera, scene.surface).max() < FINE
    again = settle_cameras(settled, tmp_path)
    assert again[2] == ""


@pytest.mark.parametrize(
    ("options", "message"),
    [({"adjust": "roll"}, "adjust = 'roll'"), ({"search_radius": -1.0}, "search_radius = -1")],
)
def test_settings_out_of_range_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        RegistrationSettings(**options)


def test_albedo_takes_registered_cameras(scene, tmp_path):
    """Two frames, each off in its own direction, disagree less once they are registered."""
    paths = tuple(
        frame(scene, tmp_path, name, offset, direction)
        for name, offset, direction in (("a", 900.0, 1.0), ("b", 900.0, 4.0))
    )
    cameras = tuple(path.with_suffix(".json") for path in paths)
    files = SceneFiles(paths, (scene.dem,), cameras=cameras)
    off = run_albedo(files, tmp_path / "off")
    on = run_albedo(files, tmp_path / "on", registers=True)
    assert on["disagreement_after_percent"] < 0.5 * off["disagreement_after_percent"]
    record = json.loads((tmp_path / "off" / "run.json").read_text())
    assert "images do not lie on the DEM" in record["outcome"]["sentence"]
