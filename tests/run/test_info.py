"""What `lommel info` says about rasters."""

import json

import numpy as np
import pytest
from affine import Affine

from lommel.errors import InputError
from lommel.io.isd import write_isd
from lommel.io.raster import write_raster
from lommel.run.info import describe
from lommel.scene.body import MOON, to_xyz
from lommel.scene.camera import FrameCamera, nadir_rotation
from lommel.scene.grid import Grid, grid_from_bounds, read_crs

DEGREE = 2e-6  # degrees, the facts are rounded to 1e-6
GEOGRAPHIC = read_crs("IAU_2015:30100")
SOUTH_POLE = read_crs("+proj=stere +lat_0=-90 +R=1737400 +units=m +type=crs")


@pytest.fixture
def image(tmp_path):
    """An 8-bit image with a mask, centred on 30 E 10 N."""
    grid = Grid((40, 60), Affine(0.01, 0, 29.7, 0, -0.01, 10.2), GEOGRAPHIC)
    values = np.full(grid.shape, 100, np.uint8)
    path = tmp_path / "AS16-M-0001.tif"
    write_raster(path, values, grid, "brightness", valid=values > 0)
    return path


def table(path, longitude_deg, latitude_deg, height):
    xyz = to_xyz(MOON, np.radians(longitude_deg), np.radians(latitude_deg), height)
    path.write_text("AS16-M-0001 " + " ".join(repr(float(value)) for value in xyz))
    return path


@pytest.fixture
def sun(tmp_path):
    return table(tmp_path / "sun.txt", 70.0, 10.0, 1.5e11)


@pytest.fixture
def craft(tmp_path):
    return table(tmp_path / "craft.txt", 30.0, 10.0, 110e3)


def test_raster_is_described_by_its_header_and_place(image):
    facts = describe(image)
    assert facts == {
        "file": str(image),
        "rows": 40,
        "cols": 60,
        "bands": 2,
        "dtype": "uint8",
        "nodata": None,
        "mask": "second band",
        "crs": GEOGRAPHIC.name,
        "gsd_m": pytest.approx(np.radians(0.01) * MOON.radius, rel=1e-4),
        "longitude_deg": pytest.approx(30.0, abs=DEGREE),
        "latitude_deg": pytest.approx(10.0, abs=DEGREE),
        "longitude_west_deg": pytest.approx(29.7, abs=DEGREE),
        "longitude_east_deg": pytest.approx(30.3, abs=DEGREE),
        "latitude_south_deg": pytest.approx(9.8, abs=DEGREE),
        "latitude_north_deg": pytest.approx(10.2, abs=DEGREE),
    }


def test_points_below_sun_and_spacecraft_are_where_they_stand(image, sun, craft):
    facts = describe(image, sun, craft)
    assert facts["subsolar_longitude_deg"] == pytest.approx(70.0, abs=DEGREE)
    assert facts["subsolar_latitude_deg"] == pytest.approx(10.0, abs=DEGREE)
    assert facts["subspacecraft_longitude_deg"] == pytest.approx(30.0, abs=DEGREE)
    assert facts["subspacecraft_latitude_deg"] == pytest.approx(10.0, abs=DEGREE)
    assert facts["spacecraft_altitude_m"] == pytest.approx(110e3, abs=0.01)


def test_camera_overhead_sees_the_incidence_as_phase(image, sun, craft):
    """Spherical law of cosines for the Sun 40 degrees east on the same parallel, at infinity."""
    latitude = np.radians(10.0)
    cosine = np.sin(latitude) ** 2 + np.cos(latitude) ** 2 * np.cos(np.radians(40.0))
    far = 1e-3  # degrees, the Moon's radius seen from the Sun
    facts = describe(image, sun, craft)
    assert facts["emission_deg"] == pytest.approx(0.0, abs=DEGREE)
    assert facts["incidence_deg"] == pytest.approx(np.degrees(np.arccos(cosine)), abs=far)
    assert facts["phase_deg"] == pytest.approx(facts["incidence_deg"], abs=DEGREE)
    assert facts["sun_elevation_deg"] == pytest.approx(90 - facts["incidence_deg"], abs=DEGREE)


@pytest.mark.parametrize(
    ("longitude_deg", "latitude_deg", "azimuth_deg"),
    [(30, 50, 0), (30, -50, 180), (119.999, 0, 90), (-60.001, 0, 270)],
)
def test_sun_azimuth_counts_clockwise_from_north(
    tmp_path, image, longitude_deg, latitude_deg, azimuth_deg
):
    sun = table(tmp_path / "s.txt", longitude_deg, latitude_deg, 1.5e11)
    azimuth = describe(image, sun)["sun_azimuth_deg"]
    assert np.cos(np.radians(azimuth - azimuth_deg)) == pytest.approx(1.0, abs=1e-6)


def test_one_table_gives_its_own_facts_only(image, sun, craft):
    assert "sun_elevation_deg" in describe(image, sun)
    assert not {"emission_deg", "phase_deg"} & set(describe(image, sun))
    assert "emission_deg" in describe(image, None, craft)
    assert not {"incidence_deg", "phase_deg"} & set(describe(image, None, craft))


def test_footprint_across_the_date_line_runs_from_west_to_east(tmp_path):
    grid = grid_from_bounds((178.0, -1.0, 183.0, 1.0), 5e3, GEOGRAPHIC)
    write_raster(tmp_path / "a.tif", np.zeros(grid.shape), grid, "height", "m")
    facts = describe(tmp_path / "a.tif")
    assert 4.9 < facts["longitude_east_deg"] - facts["longitude_west_deg"] < 5.3


def test_footprint_over_the_pole_reaches_it(tmp_path):
    grid = grid_from_bounds((-3e4, -2e4, 1e4, 4e4), 1e3, SOUTH_POLE)
    write_raster(tmp_path / "a.tif", np.zeros(grid.shape), grid, "height", "m")
    facts = describe(tmp_path / "a.tif")
    assert facts["latitude_south_deg"] == pytest.approx(-90.0, abs=DEGREE)
    width = facts["longitude_east_deg"] - facts["longitude_west_deg"]
    assert width == pytest.approx(360.0, abs=360 / 32)  # the step of the lattice of points


def test_facts_are_json(image, sun, craft, tmp_path):
    grid = grid_from_bounds((0.0, 0.0, 1.0, 1.0), 5e3, GEOGRAPHIC)
    write_raster(tmp_path / "dem.tif", np.zeros(grid.shape), grid, "height", "m")
    for facts in (describe(image, sun, craft), describe(tmp_path / "dem.tif")):
        assert json.loads(json.dumps(facts, allow_nan=False)) == facts


def test_image_that_the_table_does_not_know_is_an_error(tmp_path, image, sun):
    image.rename(tmp_path / "AS17.tif")
    with pytest.raises(InputError, match=r"sun\.txt has no entry for AS17\.tif"):
        describe(tmp_path / "AS17.tif", sun)


@pytest.mark.real_data
def test_apollo_frame_at_hadley_has_a_morning_sun(real_data):
    folder = real_data("apollo15-hadley-stereo")
    facts = describe(
        folder / "AS15-M-1134.ortho.tif", folder / "sunpos.txt", folder / "spacecraftpos.txt"
    )
    assert facts["spacecraft_altitude_m"] == pytest.approx(106e3, abs=2e3)
    assert 60 < facts["incidence_deg"] < 63
    assert 90 < facts["sun_azimuth_deg"] < 115


def test_a_camera_file_alone_is_described(tmp_path):
    """Straight down from 100 km: the spacing is distance over focal length."""
    position = np.array([MOON.radius + 100e3, 0.0, 0.0])
    camera = FrameCamera(
        position,
        nadir_rotation(position, np.array([0.0, 1.0, 0.0])),
        focal_length=1000.0,
        principal_point=(50.0, 60.0),
        shape=(100, 120),
        sun_position=1.5e11 * np.array([0.8, 0.6, 0.0]),
    )
    write_isd(tmp_path / "frame.json", camera)
    facts = describe(tmp_path / "frame.json")
    assert (facts["rows"], facts["cols"]) == (100, 120)
    assert facts["gsd_m"] == pytest.approx(100.0, rel=1e-3)
    assert facts["longitude_deg"] == pytest.approx(0.0, abs=1e-6)
