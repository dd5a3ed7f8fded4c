import json

import numpy as np
import pytest

from lommel.errors import InputError
from lommel.io.isd import write_isd
from lommel.io.raster import raster_info, read_grid, read_on_grid, read_pixels
from lommel.run import orthoproject, raw_images
from lommel.run.inputs import GridSettings, SceneFiles
from lommel.run.orthoproject import run_orthoproject
from lommel.scene.geometry import surface_normals, viewing_geometry

from .pointing_scene import make_scene, mispointed

PLACE = 0.05  # of the image's contrast; pixel noise is 0.01, a tenth of a pixel makes about 0.03
ANGLE = 0.05  # deg; heights are stored to 1e-4 m, normals span two posts of 80 m


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene with its image, and the camera written beside it."""
    folder = tmp_path_factory.mktemp("scene")
    scene = make_scene(folder, seed=3, sun_elevation=25.0, tilt=25.0)
    image = scene.write_image(folder / "frame.tif")
    write_isd(folder / "frame.json", scene.camera)
    return scene, image, folder


@pytest.fixture(scope="module")
def products(scene, tmp_path_factory):
    _, image, _ = scene
    output = tmp_path_factory.mktemp("products") / "out"
    run_orthoproject(SceneFiles((image.path,), (scene[0].dem,)), output)
    return output


def test_the_orthoimage_shows_each_place_as_the_ground_reflects_it(scene, products):
    truth, _, _ = scene
    grid = read_grid(products / "frame.tif")
    window = grid.footprint(truth.surface.grid)
    expected = truth.surface.mean(truth.brightness)[window.slices]
    values = read_pixels(products / "frame.tif")
    assert values.shape == expected.shape
    known = np.isfinite(values)
    assert known.mean() > 0.6
    difference = (values - expected)[known]
    assert np.sqrt(np.mean(difference**2)) < 0.3 * expected.std()  # pixels are smaller than posts
    assert abs(np.corrcoef(values[known], expected[known])[0, 1]) > 1 - PLACE


def test_backplanes_are_the_angles_of_the_dem(scene, products):
    truth, _, _ = scene
    grid = read_grid(products / "frame.tif")
    window = grid.footprint(truth.surface.grid)
    xyz = truth.surface.grid.xyz(truth.surface.heights)
    geometry = viewing_geometry(xyz, surface_normals(xyz), truth.sun, truth.camera.position)
    for name, expected in (
        ("incidence", np.arccos(geometry.cos_incidence)),
        ("emission", np.arccos(geometry.cos_emission)),
        ("phase", geometry.phase),
    ):
        plane = read_pixels(products / f"frame-{name}.tif")
        known = np.isfinite(plane)
        assert known.mean() > 0.6
        np.testing.assert_allclose(
            plane[known], np.degrees(expected[window.slices])[known], atol=ANGLE
        )


def test_shadow_is_a_byte_plane_with_its_own_nodata(products):
    info = raster_info(products / "frame-shadow.tif")
    assert (info.dtype, info.nodata) == ("uint8", 255)
    plane = read_pixels(products / "frame-shadow.tif")
    incidence = read_pixels(products / "frame-incidence.tif")
    assert set(np.unique(plane[np.isfinite(plane)])) <= {0.0, 1.0}
    assert (plane[incidence > 90.0] == 1).all()
    assert (np.isfinite(plane) == np.isfinite(incidence)).all()


def test_small_blocks_give_what_one_block_gives(scene, products, tmp_path, monkeypatch):
    """Also when the image is read in small parts."""
    truth, image, _ = scene
    monkeypatch.setattr(orthoproject, "BLOCK", 48)
    monkeypatch.setattr(raw_images, "PIXELS_AT_ONCE", 400)
    run_orthoproject(SceneFiles((image.path,), (truth.dem,)), tmp_path / "out")
    for name in ("", "-incidence", "-emission", "-phase", "-shadow"):
        whole, parts = (
            read_pixels(folder / f"frame{name}.tif") for folder in (products, tmp_path / "out")
        )
        np.testing.assert_allclose(parts, whole, rtol=1e-5, atol=1e-4)


def test_grid_options_hold_for_orthoimages(scene, products, tmp_path):
    truth, image, _ = scene
    xmin, ymin, xmax, ymax = truth.surface.grid.bounds
    middle = (xmin + xmax) / 2, (ymin + ymax) / 2
    bounds = middle[0] - 4e3, middle[1] - 3e3, middle[0] + 4e3, middle[1] + 3e3
    settings = GridSettings(spacing=200.0, bounds=bounds)
    run_orthoproject(SceneFiles((image.path,), (truth.dem,)), tmp_path / "out", settings)
    grid = read_grid(tmp_path / "out" / "frame.tif")
    assert grid.shape == pytest.approx((30, 40), abs=1)
    expected = read_on_grid(products / "frame.tif", grid)  # area means of the fine orthoimage
    values = read_pixels(tmp_path / "out" / "frame.tif")
    known = np.isfinite(values) & np.isfinite(expected)
    assert known.mean() > 0.9
    assert np.corrcoef(values[known], expected[known])[0, 1] > 1 - PLACE


def test_an_image_without_camera_is_left_out_with_its_reason(scene, tmp_path):
    truth, image, _ = scene
    other = tmp_path / "alone.tif"
    other.write_bytes(image.path.read_bytes())
    run_orthoproject(SceneFiles((image.path, other), (truth.dem,)), tmp_path / "out")
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["results"]["images"] == 1
    assert "no camera found" in record["skipped"][0]["reason"]
    with pytest.raises(InputError, match="no camera found"):
        run_orthoproject(SceneFiles((other,), (truth.dem,)), tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_a_camera_elsewhere_is_said_to_be(scene, tmp_path):
    truth, image, _ = scene
    write_isd(tmp_path / "off.json", mispointed(truth.camera, 80e3, 0.0))
    files = SceneFiles((image.path,), (truth.dem,), cameras=(tmp_path / "off.json",))
    with pytest.raises(InputError, match="does not see the DEM"):
        run_orthoproject(files, tmp_path / "out")
