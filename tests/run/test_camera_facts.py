"""What `lommel info` says of images with cameras, and of single pixels of them."""

import json

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.errors import NotGeoreferencedWarning

from lommel.errors import GeometryError, InputError
from lommel.io.isd import write_isd
from lommel.io.isis import read_isis
from lommel.io.raster import raster_info, write_raster
from lommel.run.camera_facts import camera_facts, image_azimuth
from lommel.run.ground_point import describe_pixel
from lommel.run.info import describe
from lommel.scene.body import MOON, local_frame, to_xyz
from lommel.scene.camera import FrameCamera, nadir_rotation
from lommel.scene.grid import Grid, read_crs

DEGREE = 2e-6  # degrees; facts are rounded to 1e-6
GROUND_DEG = 1e-9  # degrees, 30 micrometres
LONGITUDE, LATITUDE = np.radians(10.0), np.radians(20.0)
SHAPE = (200, 300)
GEOGRAPHIC = read_crs("IAU_2015:30100")


def camera(**changes):
    """100 km over 10 E 20 N, straight down, 10 m pixels, north up; the Sun over 60 E 0 N."""
    position = to_xyz(MOON, LONGITUDE, LATITUDE, 100e3)
    east, _, _ = local_frame(LONGITUDE, LATITUDE)
    settings = {
        "position": position,
        "rotation": nadir_rotation(position, east),
        "focal_length": 10_000.0,
        "principal_point": (100.0, 150.0),
        "shape": SHAPE,
        "sun_position": to_xyz(MOON, np.radians(60.0), 0.0, 1.5e11),
    }
    return FrameCamera(**(settings | changes))


@pytest.fixture
def image(tmp_path):
    """An image without a CRS; the returned function writes its camera beside it."""
    path = tmp_path / "frame.tif"
    profile = {"driver": "GTiff", "count": 1, "dtype": "float32"}
    with (
        pytest.warns(NotGeoreferencedWarning),
        rasterio.open(path, "w", height=SHAPE[0], width=SHAPE[1], **profile) as file,
    ):
        file.write(np.ones(SHAPE, np.float32), 1)

    def with_camera(**changes):
        write_isd(path.with_suffix(".json"), camera(**changes))
        return path

    return with_camera


def dem_of(path, height, posts=401, spacing=0.01, middle=(10.0, 20.0)):
    """A DEM in longitude and latitude whose heights are height(longitude, latitude), degrees."""
    half = posts / 2 * spacing
    affine = Affine(spacing, 0, middle[0] - half, 0, -spacing, middle[1] + half)
    grid = Grid((posts, posts), affine, GEOGRAPHIC)
    write_raster(path, height(*np.degrees(grid.lonlat())), grid, "height", "m")
    return path


# --- whole images ---------------------------------------------------------------------------------


def test_camera_overhead_is_described(image):
    facts = describe(image())
    assert facts["camera"] == "frame, distortion radial"  # CSM's way to have none
    assert facts["seen_percent"] == 100.0
    assert facts["gsd_m"] == pytest.approx(10.0, abs=1e-3)
    assert facts["longitude_deg"] == pytest.approx(10.0, abs=DEGREE)
    assert facts["latitude_deg"] == pytest.approx(20.0, abs=DEGREE)
    metres = np.radians(1.0) * MOON.radius
    height = facts["latitude_north_deg"] - facts["latitude_south_deg"]
    width = facts["longitude_east_deg"] - facts["longitude_west_deg"]
    assert height * metres == pytest.approx(2000.0, rel=2e-3)  # the corners bulge
    assert width * metres * np.cos(LATITUDE) == pytest.approx(3000.0, rel=2e-3)
    assert facts["subspacecraft_longitude_deg"] == pytest.approx(10.0, abs=DEGREE)
    assert facts["spacecraft_altitude_m"] == pytest.approx(100e3, abs=1e-3)
    assert facts["slant_distance_m"] == pytest.approx(100e3, abs=1e-3)
    assert facts["subsolar_longitude_deg"] == pytest.approx(60.0, abs=DEGREE)


def test_angles_are_those_of_the_central_pixel_and_have_a_range(image):
    facts = describe(image())
    cosine = np.cos(LATITUDE) * np.cos(np.radians(50.0))
    far = 1e-3  # degrees, the Moon's radius seen from the Sun
    assert facts["emission_deg"] == pytest.approx(0.0, abs=DEGREE)
    assert facts["incidence_deg"] == pytest.approx(np.degrees(np.arccos(cosine)), abs=far)
    assert facts["phase_deg"] == pytest.approx(facts["incidence_deg"], abs=DEGREE)
    assert facts["sun_elevation_deg"] == pytest.approx(90 - facts["incidence_deg"], abs=DEGREE)
    for name in ("incidence", "emission", "phase"):
        least, most = facts[f"{name}_min_deg"], facts[f"{name}_max_deg"]
        assert least <= facts[f"{name}_deg"] <= most
        assert most > least
    corner = np.hypot(1000.0, 1500.0)
    expected = np.arctan(corner / 100e3) + corner / MOON.radius
    assert facts["emission_max_deg"] == pytest.approx(np.degrees(expected), abs=1e-4)


@pytest.mark.parametrize("turn_deg", [0.0, 30.0, 200.0])
def test_azimuths_in_the_image_count_clockwise_from_up(turn_deg):
    """The camera turns clockwise by an angle: everything in the image turns against the clock."""
    turn = np.radians(turn_deg)
    cosine, sine = np.cos(turn), np.sin(turn)
    spin = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    facts = camera_facts("a", camera(rotation=spin @ camera().rotation))
    north = facts["image_north_azimuth_deg"]
    assert (north + turn_deg + 180) % 360 == pytest.approx(180.0, abs=1e-5)
    sun = (facts["image_sun_azimuth_deg"] - facts["sun_azimuth_deg"] + turn_deg + 180) % 360
    assert sun == pytest.approx(180.0, abs=1e-3)  # up to perspective


def test_image_partly_beside_the_moon_tells_of_the_part_that_is_on_it():
    """Tilted by 70 degrees to the east, where the limb is 71 degrees away from the nadir."""
    tilt = np.radians(70.0)
    turn = np.array([[np.cos(tilt), 0, -np.sin(tilt)], [0, 1, 0], [np.sin(tilt), 0, np.cos(tilt)]])
    facts = camera_facts("a", camera(rotation=turn @ camera().rotation, focal_length=1000.0))
    assert 0 < facts["seen_percent"] < 100
    assert facts["emission_max_deg"] < 90
    assert facts["image_spacecraft_azimuth_deg"] == pytest.approx(270.0, abs=1.0)


def test_image_beside_the_moon_is_an_error(image):
    away = np.diag([1.0, -1.0, -1.0])
    path = image(rotation=away @ camera().rotation)
    with pytest.raises(GeometryError, match="its camera does not see the Moon"):
        describe(path)
    with pytest.raises(GeometryError, match=r"sample 1, line 2 looks past the Moon\."):
        describe_pixel(path, 1.0, 2.0)


def test_footprint_over_the_pole_holds_all_longitudes():
    position = to_xyz(MOON, 0.0, np.radians(89.99), 100e3)
    facts = camera_facts(
        "a", camera(position=position, rotation=nadir_rotation(position, np.array([0.0, 1.0, 0])))
    )
    assert facts["latitude_north_deg"] == 90.0
    assert facts["longitude_east_deg"] - facts["longitude_west_deg"] == pytest.approx(360.0)


def test_camera_without_a_sun_takes_it_from_the_table(image, tmp_path):
    path = image(sun_position=None)
    facts = describe(path)
    assert "incidence_deg" not in facts and "image_sun_azimuth_deg" not in facts
    sun = to_xyz(MOON, np.radians(60.0), 0.0, 1.5e11)
    (tmp_path / "sun.txt").write_text("frame " + " ".join(map(repr, sun.tolist())))
    assert describe(path, tmp_path / "sun.txt")["subsolar_longitude_deg"] == pytest.approx(60.0)
    found = describe_pixel(path, 150.0, 100.0, sun_positions=tmp_path / "sun.txt")
    assert found["phase_deg"] == pytest.approx(found["incidence_deg"], abs=1e-6)


@pytest.mark.real_data
def test_azimuths_are_those_of_isis(real_data):
    """Of campt at (375, 375) on LOLA's terrain, clockwise from the right; ours from up.

    ISIS steps on the ground too, by another length: 2.5e-5 degrees.
    """
    path = real_data("apollo15-hadley-lola") / "AS15-M-1134-hadley.cub"
    model = read_isis(path, raster_info(path).shape)
    ground = to_xyz(
        MOON,
        np.radians(3.0122642527153),
        np.radians(25.429658072044),
        1735684.7557107 - MOON.radius,
    )
    targets = [np.array([0.0, 0.0, 1.0]), model.sun_position, model.position]
    found = [np.degrees(image_azimuth(model, ground, target)) - 90 for target in targets]
    assert found == pytest.approx([262.75530319617, 7.2938915825096, 18.341089964805], abs=1e-4)
    facts = describe(path)
    for name, value in {
        "subspacecraft_longitude_deg": 4.372019573016,
        "subspacecraft_latitude_deg": 24.831756095817,
        "subsolar_longitude_deg": 61.301043176222,
        "subsolar_latitude_deg": 0.20960170441931,
    }.items():
        assert facts[name] == pytest.approx(value, abs=DEGREE)


# --- single pixels --------------------------------------------------------------------------------


def test_principal_pixel_lies_below_the_spacecraft(image):
    facts = describe_pixel(image(), 150.0, 100.0)
    assert facts["longitude_deg"] == pytest.approx(10.0, abs=GROUND_DEG)
    assert facts["latitude_deg"] == pytest.approx(20.0, abs=GROUND_DEG)
    assert facts["height_m"] == pytest.approx(0.0, abs=1e-3)
    assert facts["emission_deg"] == pytest.approx(0.0, abs=1e-7)
    assert facts["incidence_deg"] == pytest.approx(facts["phase_deg"], abs=1e-7)


def test_pixel_on_a_level_dem_has_its_height(image, tmp_path):
    dem = dem_of(tmp_path / "dem.tif", lambda longitude, latitude: 0 * longitude + 500.0)
    facts = describe_pixel(image(), 250.0, 100.0, dem)
    assert facts["height_m"] == pytest.approx(500.0, abs=1e-3)
    sphere = describe_pixel(image(), 250.0, 100.0)
    metres = np.radians(1.0) * MOON.radius * np.cos(LATITUDE)
    nearer = (sphere["longitude_deg"] - facts["longitude_deg"]) * metres
    expected = 500.0 * np.tan(np.radians(facts["ellipsoid_emission_deg"]))
    assert nearer == pytest.approx(expected, rel=1e-3)
    assert facts["incidence_deg"] == pytest.approx(facts["ellipsoid_incidence_deg"], abs=1e-4)


def test_incidence_and_emission_are_those_of_the_slope(image, tmp_path):
    """A slope of 0.1 that rises to the east: the nadir is seen at atan(0.1)."""
    metres = np.radians(1.0) * MOON.radius * np.cos(LATITUDE)
    dem = dem_of(
        tmp_path / "dem.tif", lambda longitude, latitude: 0.1 * metres * (longitude - 10.0)
    )
    facts = describe_pixel(image(), 150.0, 100.0, dem)
    assert facts["emission_deg"] == pytest.approx(np.degrees(np.arctan(0.1)), abs=1e-3)
    assert facts["ellipsoid_emission_deg"] == pytest.approx(0.0, abs=1e-5)
    assert facts["incidence_deg"] > facts["ellipsoid_incidence_deg"]  # turned from an eastern Sun


def test_pixel_beyond_the_dem_or_over_a_hole_is_an_error(image, tmp_path):
    path = image()
    far = dem_of(tmp_path / "far.tif", lambda longitude, _: 0 * longitude, middle=(40.0, 20.0))
    hole = dem_of(tmp_path / "hole.tif", lambda longitude, _: np.nan * longitude)
    for dem in (far, hole):
        with pytest.raises(GeometryError, match="looks past the Moon, or beyond .*, or at a hole"):
            describe_pixel(path, 150.0, 100.0, dem)


@pytest.mark.parametrize("pixel", [(-0.1, 5.0), (5.0, 200.1), (np.nan, 5.0), (np.inf, 5.0)])
def test_pixel_outside_the_image_is_an_error(image, pixel):
    with pytest.raises(InputError, match="lies outside the image of 300 samples and 200 lines"):
        describe_pixel(image(), *pixel)


def test_image_without_a_camera_has_no_ground_points(tmp_path, image):
    path = image()
    path.with_suffix(".json").unlink()
    with pytest.raises(InputError, match=r"no camera found\. Looked for an ISD"):
        describe_pixel(path, 5.0, 5.0)


def test_facts_of_a_camera_are_json(image):
    path = image()
    for facts in (describe(path), describe_pixel(path, 5.0, 5.0)):
        assert json.loads(json.dumps(facts, allow_nan=False)) == facts
