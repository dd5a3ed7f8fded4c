"""`lommel albedo` takes raw images: where they lie, what they show, which are left out."""

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.errors import NotGeoreferencedWarning

from lommel.errors import InputError
from lommel.io.isd import write_isd
from lommel.io.raster import write_raster
from lommel.run.inputs import SceneFiles
from lommel.run.mixed_scene import read_mixed_scene
from lommel.scene.body import MOON, local_frame, to_xyz
from lommel.scene.camera import FrameCamera, nadir_rotation
from lommel.scene.grid import Grid, read_crs

LONGITUDE, LATITUDE = np.radians(10.0), np.radians(20.0)
GRID = Grid(
    (80, 80),
    Affine(100.0, 0, -4000.0, 0, -100.0, 4000.0),
    read_crs("+proj=stere +lat_0=20 +lon_0=10 +R=1737400 +units=m +type=crs"),
)
SUN = to_xyz(MOON, LONGITUDE + 0.7, LATITUDE, 1.5e11)
SPOT = (700.0, -500.0)  # m east and north of the middle, 300 m wide


@pytest.fixture
def scene(tmp_path):
    """A level DEM; the returned function adds a raw image taken some metres east of the middle."""
    write_raster(tmp_path / "dem.tif", np.zeros(GRID.shape), GRID, "height", "m")

    def add(name, shift, sun=SUN):
        position = to_xyz(MOON, LONGITUDE, LATITUDE, 100e3)
        east, north, _ = local_frame(LONGITUDE, LATITUDE)
        camera = FrameCamera(
            position=position + shift * east,
            rotation=nadir_rotation(position, east),
            focal_length=1000.0,
            principal_point=(30.0, 30.0),
            shape=(60, 60),
            sun_position=sun,
        )
        write_isd(tmp_path / f"{name}.json", camera)
        spot = MOON.radius * position / np.linalg.norm(position) + SPOT[0] * east + SPOT[1] * north
        line, sample = camera.project(spot)
        rows, cols = np.indices((60, 60)) + 0.5
        values = np.where(np.hypot(rows - line, cols - sample) < 1.5, 200.0, 100.0)
        path = tmp_path / f"{name}.tif"
        profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "height": 60, "width": 60}
        with pytest.warns(NotGeoreferencedWarning), rasterio.open(path, "w", **profile) as file:
            file.write(values.astype("f4"), 1)
        return path

    return add


def files(tmp_path, *images, **others):
    return SceneFiles(tuple(images), (tmp_path / "dem.tif",), **others)


def test_raw_images_show_the_ground_where_it_lies(tmp_path, scene):
    found = read_mixed_scene(files(tmp_path, scene("a", -800.0), scene("b", 900.0)))
    assert [observation.name for observation in found.observations] == ["a.tif", "b.tif"]
    row, col = found.grid.index_at(
        LONGITUDE + SPOT[0] / MOON.radius / np.cos(LATITUDE), LATITUDE + SPOT[1] / MOON.radius
    )
    for observation in found.observations:
        part = observation.window
        bright = np.argwhere(observation.measured > 150.0) + [part.row, part.col]
        assert np.abs(bright.mean(axis=0) - [row, col]).max() < 0.5  # posts
        np.testing.assert_allclose(observation.sun_position, SUN)
        assert np.linalg.norm(observation.spacecraft_position) > MOON.radius + 99e3
    first, second = (observation.window.col for observation in found.observations)
    assert (second - first) * max(found.grid.spacing) == pytest.approx(1700.0, abs=150.0)


def test_orthoimages_and_raw_images_go_together(tmp_path, scene):
    raw = scene("raw", 0.0)
    write_raster(tmp_path / "flat.tif", np.full(GRID.shape, 90.0), GRID, "brightness")
    for kind, xyz in {"sun": SUN, "craft": to_xyz(MOON, LONGITUDE, LATITUDE, 1e5)}.items():
        (tmp_path / f"{kind}.txt").write_text("flat " + " ".join(map(repr, xyz.tolist())))
    flat = tmp_path / "flat.tif"
    tables = {"sun_positions": tmp_path / "sun.txt", "spacecraft_positions": tmp_path / "craft.txt"}
    found = read_mixed_scene(files(tmp_path, flat, raw, **tables))
    assert [observation.name for observation in found.observations] == ["flat.tif", "raw.tif"]
    assert np.nanmean(found.observations[0].measured) == pytest.approx(90.0)
    with pytest.raises(InputError, match="No sun positions given"):
        read_mixed_scene(files(tmp_path, flat, raw))


def test_image_beside_the_dem_or_without_a_sun_is_left_out(tmp_path, scene):
    images = scene("good", 0.0), scene("far", 50e3), scene("dark", 0.0, sun=None)
    found = read_mixed_scene(files(tmp_path, *images))
    assert [observation.name for observation in found.observations] == ["good.tif"]
    reasons = {skip.name: skip.reason for skip in found.skipped}
    assert "its camera does not see the DEM" in reasons["far.tif"]
    assert "does not tell where the Sun stood" in reasons["dark.tif"]
    with pytest.raises(InputError, match=r"No image can be used\.\n.*far\.tif"):
        read_mixed_scene(files(tmp_path, images[1]))
    with pytest.raises(InputError, match="--cameras names 1 files for 3 images"):
        read_mixed_scene(files(tmp_path, *images, cameras=(tmp_path / "good.json",)))
