"""Cameras of ISIS cubes: synthetic cubes whose camera is known, and cubes that lie."""

import json
import struct

import numpy as np
import pytest
import rasterio
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rasterio.errors import NotGeoreferencedWarning
from scipy.spatial.transform import Rotation

from lommel.errors import InputError, LommelError
from lommel.io.cameras import find_camera, read_camera
from lommel.io.isis import read_isis
from lommel.io.raster import read_isis_label, read_pixels
from lommel.scene.body import MOON, to_lonlat, to_xyz
from lommel.scene.intersection import meet_sphere

from .cubes import (
    CONSTANT,
    LABEL_BYTES,
    METRIC,
    NAC,
    NAIF_METRIC,
    NAIF_NAC,
    QUATERNIONS,
    STATES,
    TIME,
    alpha_cube,
    body_turns,
    metric_tables,
    scalar_first,
    to_j2000,
    write_cube,
)

PIXEL = 1e-6  # px; float64 on 1e6 m leaves 1e-9
GROUND = 1e-6  # m
TURN = 1e-10  # rad; times of 1e8 s are known to 1.5e-8 s, in which the orbit turns by 1.4e-11
PLAIN = NAIF_METRIC.replace("-0.006, -0.002", "0, 0").replace("-5.4958195e-07", "0.0")


def metric(path, shape=(20, 30)):
    return read_isis(path, shape)


def nac_tables(times):
    """Tables of a polar flight at 1.6 km/s and 50 km, looking straight down, lines eastward."""
    angles = (np.asarray(times) - TIME) * 1600.0 / (MOON.radius + 50e3)
    place = to_xyz(MOON, np.zeros(angles.shape), angles, 50e3)
    speed = 1600.0 * to_xyz(MOON, np.zeros(angles.shape), angles + np.pi / 2, -MOON.radius + 1.0)
    down = -place / np.linalg.norm(place, axis=1, keepdims=True)
    east = np.broadcast_to([0.0, 1.0, 0.0], down.shape)
    axes = np.stack([np.cross(east, down), east, down], axis=1)  # x along the flight, y a line
    bodies = body_turns(times)
    pointing = Rotation.from_matrix(axes @ (CONSTANT @ bodies.as_matrix()))
    inertial = bodies.inv().apply(speed @ CONSTANT) - np.cross(
        [1e-7, -2e-7, 2.6e-6], to_j2000(place, times)
    )  # the body turns around an axis that it shares with J2000
    rows = np.column_stack([to_j2000(place, times), inertial]) / 1e3
    sun = to_j2000(np.tile(to_xyz(MOON, 1.0, 0.0, 1.5e11), (len(times), 1)), times)
    sun = np.column_stack([sun, -np.cross([1e-7, -2e-7, 2.6e-6], sun)]) / 1e3
    return {
        "InstrumentPointing": (QUATERNIONS, np.column_stack([scalar_first(pointing), times])),
        "InstrumentPosition": (STATES, np.column_stack([rows, times])),
        "BodyRotation": (QUATERNIONS, np.column_stack([scalar_first(bodies), times])),
        "SunPosition": (STATES, np.column_stack([sun, times])),
    }


def nac_cube(path, **parts):
    """A NAC image whose first line began at TIME."""
    period = 0.5e-3 * 1.0045
    clock = struct.pack("<d", TIME - 1024 * period).hex()
    times = TIME + np.linspace(-0.1, 0.6, 8)
    settings = {
        "tables": nac_tables(times),
        "instrument": NAC,
        "naif": NAIF_NAC.format(clock=clock),
        "code": -85600,
    }
    return write_cube(path, (1000, 64), **(settings | parts))


def test_metric_camera_looks_down_on_the_centre_of_its_film(tmp_path):
    """Without distortion the axis meets the ground under the spacecraft, ISIS's sample 15."""
    camera = metric(write_cube(tmp_path / "a.cub", naif=PLAIN))
    below = meet_sphere(camera.origin(9.5, 14.5), camera.ray(9.5, 14.5), MOON.radius)
    np.testing.assert_allclose(
        to_lonlat(MOON, below)[:2], np.radians([10.0, 20.0]), rtol=0, atol=1e-12
    )
    assert to_lonlat(MOON, camera.position)[2] == pytest.approx(110e3, abs=GROUND)
    longitude, latitude, height = to_lonlat(MOON, camera.sun_position)
    assert (longitude, latitude) == pytest.approx((np.radians(60.0), 0.0), abs=1e-12)
    assert height == pytest.approx(1.5e11, rel=1e-12)


def test_film_is_seen_from_its_other_side(tmp_path):
    """Samples grow against x, which points north, and lines along y, which points west."""
    camera = metric(write_cube(tmp_path / "a.cub", naif=PLAIN))
    right = to_lonlat(MOON, meet_sphere(camera.position, camera.ray(9.5, 24.5), MOON.radius))
    below = to_lonlat(MOON, meet_sphere(camera.position, camera.ray(14.5, 14.5), MOON.radius))
    assert right[1] < np.radians(20.0)
    assert right[0] == pytest.approx(np.radians(10.0), abs=1e-9)
    assert below[0] < np.radians(10.0)


def test_crop_and_reduction_show_the_same_ground_as_the_whole_image(tmp_path):
    whole = metric(write_cube(tmp_path / "whole.cub"))
    alpha = alpha_cube((20, 30), (4.5, 10.5), (16.5, 26.5), (6, 8))  # each pixel two by two
    part = metric(write_cube(tmp_path / "part.cub", (6, 8), alpha=alpha), (6, 8))
    line, sample = np.meshgrid([0.0, 3.0, 5.5], [0.5, 7.7], indexing="ij")
    np.testing.assert_allclose(
        part.ray(line, sample), whole.ray(4 + 2 * line, 10 + 2 * sample), rtol=0, atol=1e-15
    )
    ground = meet_sphere(part.position, part.ray(line, sample), MOON.radius)
    np.testing.assert_allclose(part.project(ground), (line, sample), rtol=0, atol=PIXEL)


def test_byte_order_is_of_no_account(tmp_path):
    values = np.arange(600.0).reshape(20, 30)
    cubes = [
        write_cube(tmp_path / f"{order}.cub", values=values, order=order)
        for order in ("Lsb", "Msb")
    ]
    np.testing.assert_array_equal(*(read_pixels(path) for path in cubes))
    np.testing.assert_array_equal(*(metric(path).rotation for path in cubes))


def test_special_pixels_are_missing(tmp_path):
    values = np.ones((20, 30), np.float32)
    specials = np.array([0xFF7FFFFB, 0xFF7FFFFC, 0xFF7FFFFD, 0xFF7FFFFE, 0xFF7FFFFF], np.uint32)
    values[3, :5] = specials.view(np.float32)  # Null, low and high saturation
    read = read_pixels(write_cube(tmp_path / "a.cub", values=values))
    assert np.isnan(read[3, :5]).all()
    assert np.isfinite(read).sum() == 595


def test_pointing_as_polynomials_is_the_same_rotation(tmp_path):
    """Euler angles about z, x and z, each a polynomial of (t - base) / scale."""
    tables = metric_tables()
    quaternion = tables["InstrumentPointing"][1][0][:4]
    matrix = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    angles = -Rotation.from_matrix(matrix).as_euler("ZXZ")[::-1]  # angle1, angle2, angle3
    slopes = np.array([0.1, 0.2, 0.3])
    moment = (TIME - 5.0 - TIME) / 10.0
    rows = [[*(angles - slopes * moment)], [*slopes], [TIME + 5.0, 10.0, 1.0]]
    tables["InstrumentPointing"] = ("J2000Ang1", "J2000Ang2", "J2000Ang3"), rows
    times = f" CkTableStartTime = {TIME}\n CkTableEndTime = {TIME}\n"
    path = write_cube(tmp_path / "p.cub", tables=tables, keywords={"InstrumentPointing": times})
    expected = metric(write_cube(tmp_path / "q.cub")).rotation
    np.testing.assert_allclose(metric(path).rotation, expected, rtol=0, atol=1e-12)


def test_positions_as_polynomials_are_the_same_place(tmp_path):
    tables = metric_tables()
    place = np.array(tables["InstrumentPosition"][1][0][:3])
    rows = [[*(place + 1.0)], [1.0, 1.0, 1.0], [TIME + 2.0, 2.0, 1.0]]
    tables["InstrumentPosition"] = ("J2000SVX", "J2000SVY", "J2000SVZ"), rows
    times = f" SpkTableStartTime = {TIME}\n SpkTableEndTime = {TIME}\n"
    keywords = {"InstrumentPosition": times + " CacheType = PolyFunction\n"}
    path = write_cube(tmp_path / "p.cub", tables=tables, keywords=keywords)
    expected = metric(write_cube(tmp_path / "q.cub")).position
    np.testing.assert_allclose(metric(path).position, expected, rtol=0, atol=GROUND)


def test_line_scan_camera_is_over_its_lines(tmp_path):
    """The spacecraft flies north 1.6 km/s; line n is taken n - 1/2 lines after the start."""
    camera = read_isis(nac_cube(tmp_path / "n.cub"), (1000, 64))
    line = np.array([0.5, 500.0, 999.5])
    found = to_lonlat(MOON, camera.origin(line, 30.0))
    expected = line * 0.5e-3 * 1.0045 * 1600.0 / (MOON.radius + 50e3)
    np.testing.assert_allclose(found[1], expected, rtol=0, atol=TURN)
    np.testing.assert_allclose(found[0], 0.0, rtol=0, atol=1e-12)
    ground = meet_sphere(camera.origin(line, 30.0), camera.ray(line, 30.0), MOON.radius)
    np.testing.assert_allclose(to_lonlat(MOON, ground)[1], expected, rtol=0, atol=2 * TURN)
    np.testing.assert_allclose(camera.project(ground), (line, [30.0] * 3), rtol=0, atol=1e-4)
    longitude = to_lonlat(MOON, camera.sun(line, 30.0))[0]
    np.testing.assert_allclose(longitude, 1.0, rtol=0, atol=1e-9)


def test_reduced_crop_of_a_line_scan_image_shows_the_same_ground(tmp_path):
    whole = read_isis(nac_cube(tmp_path / "n.cub"), (1000, 64))
    alpha = alpha_cube((1000, 64), (100.5, 20.5), (300.5, 60.5), (50, 10))
    path = nac_cube(tmp_path / "w.cub")
    text = path.read_bytes()
    cut = text.replace(b"Samples = 64\n", b"Samples = 10\n").replace(
        b"Lines = 1000\n", b"Lines = 50  \n"
    )
    end = cut.index(b"End_Object\nObject = Label")
    label = (cut[:end] + alpha.encode() + cut[end:LABEL_BYTES])[:LABEL_BYTES]
    path.write_bytes(label.ljust(LABEL_BYTES, b"\0") + text[LABEL_BYTES:])
    part = read_isis(path, (50, 10))
    line, sample = np.array([0.0, 25.0, 49.5]), np.array([0.5, 3.3, 9.9])
    np.testing.assert_allclose(
        part.ray(line, sample), whole.ray(100 + 4 * line, 20 + 4 * sample), rtol=0, atol=TURN
    )
    np.testing.assert_allclose(
        part.origin(line, sample), whole.origin(100 + 4 * line, sample), rtol=0, atol=1e-3
    )


TIFF = {"driver": "GTiff", "dtype": "float32", "count": 1}


def with_table_bytes(label, cube):
    """A label as GDAL 3.12 carries it: tables as hexadecimal text."""
    data = cube.read_bytes()
    for key, table in label.items():
        if key.startswith("Table_"):
            start = table["StartByte"] - 1
            table["_data"] = data[start : start + table["Bytes"]].hex().upper()
    return label


def geotiff_of(cube, path, **changes):
    """A GeoTIFF with the pixels and the label of a cube."""
    label = with_table_bytes(read_isis_label(cube) | changes, cube)
    values = read_pixels(cube)
    with rasterio.open(path, "w", height=values.shape[0], width=values.shape[1], **TIFF) as file:
        file.write(values, 1)
        file.update_tags(ns="json:ISIS3", doc=json.dumps(label))
    return path


@pytest.mark.filterwarnings(f"ignore::{NotGeoreferencedWarning.__module__}.NotGeoreferencedWarning")
def test_geotiff_that_carries_the_label_has_the_camera_of_the_cube(tmp_path):
    cube = write_cube(tmp_path / "a.cub")
    tiff = geotiff_of(cube, tmp_path / "a.tif")
    cube_camera = metric(cube)
    cube.unlink()
    assert find_camera(tiff) == tiff
    camera = read_camera(tiff, (20, 30))
    np.testing.assert_array_equal(camera.rotation, cube_camera.rotation)
    np.testing.assert_array_equal(camera.position, cube_camera.position)


def test_cube_is_its_own_camera_unless_a_file_stands_beside_it(tmp_path):
    cube = write_cube(tmp_path / "a.cub")
    assert find_camera(cube) == cube
    (tmp_path / "a.json").write_text('{"type": "Feature"}')  # some other JSON
    assert find_camera(cube) == cube
    (tmp_path / "a.json").write_text('{"name_model": "USGS_ASTRO_FRAME_SENSOR_MODEL"}')
    assert find_camera(cube) == tmp_path / "a.json"


# --- cubes that lie -------------------------------------------------------------------------------


def without(name):
    return {key: value for key, value in metric_tables().items() if key != name}


def with_rows(name, rows, fields=QUATERNIONS):
    return metric_tables() | {name: (fields, rows)}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tables": without("BodyRotation")}, "table BodyRotation is missing from the label"),
        ({"tables": without("InstrumentPosition")}, "table InstrumentPosition is missing"),
        ({"instrument": "InstrumentId = HRSC"}, r"images of HRSC .* are not supported; those of"),
        ({"instrument": "X = 1"}, "images of an unnamed instrument"),
        ({"extra": " Group = Mapping\n  A = 1\n End_Group\n"}, "is map-projected"),
        ({"code": "Null"}, "NaifFrameCode = Null; 1 finite number is needed"),
        ({"naif": ""}, "NaifKeywords: INS-915240_PP = None; 2 finite numbers are needed"),
        (
            {"naif": NAIF_METRIC.replace("(0.0, -0.005, 0.0)", "(0.0, 0.0, 0.005)")},
            "do not span the focal plane",
        ),
        ({"naif": NAIF_METRIC.replace("76.054", "-76.0")}, "focal_length = -76.0 is not positive"),
        (
            {"tables": with_rows("InstrumentPointing", [[2.0, 0.0, 0.0, 0.0, TIME]])},
            "holds a quaternion of length 2",
        ),
        (
            {"tables": with_rows("InstrumentPointing", [[np.nan, 0.0, 0.0, 0.0, TIME]])},
            "not finite numbers",
        ),
        (
            {"tables": with_rows("InstrumentPointing", [[1.0, 0.0]], ("J2000Q0", "ET"))},
            "J2000Q1, J2000Q2, J2000Q3 is missing",
        ),
        (
            {"tables": with_rows("BodyRotation", [[1.0, 0, 0, 0, TIME], [1.0, 0, 0, 0, TIME - 1]])},
            "do not ascend",
        ),
        (
            {"alpha": alpha_cube((100, 100), (0.5, 0.5), (50.5, 50.5), (10, 10))},
            "AlphaCube speaks of 10 lines from 0.5 to 50.5, the image has 20",
        ),
    ],
)
def test_label_that_cannot_give_a_camera_is_an_error(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        metric(write_cube(tmp_path / "a.cub", **changes))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"Records = 1\n", b"Records = 9\n", "claims 360 bytes from byte"),
        (b"Records = 1\n", b"Records = 0\n", "claims 0 records"),
        (b"Records = 1\n", b"Records = a\n", "has Records = a; a whole number is needed"),
        (b"StartByte = 18", b"StartByte = 98", "but they are not all there"),
        (b"StartByte = 18", b"StartByte = -8", "but they are not all there"),
        (b"1\n ByteOrder = Lsb", b"1\n ByteOrder = VAX", "has ByteOrder = VAX; Lsb and Msb"),
        (b"Name = J2000Q1", b"Name = J2000Q0", "J2000Q1 is missing|two of one name"),
        (b"Type = Double", b"Type = Single", "Type = Single"),
    ],
)
def test_table_that_lies_about_its_bytes_is_an_error(tmp_path, old, new, message):
    path = write_cube(tmp_path / "a.cub")
    data = path.read_bytes()
    assert old in data and len(old) == len(new)
    path.write_bytes(data.replace(old, new))
    with pytest.raises(InputError, match=message):
        metric(path)


def test_camera_of_an_image_of_another_size_is_an_error(tmp_path):
    path = write_cube(tmp_path / "a.cub")
    with pytest.raises(
        InputError, match="belongs to an image of 20 x 30 pixels, but the image has"
    ):
        read_camera(path, (21, 30))


@pytest.mark.filterwarnings(f"ignore::{NotGeoreferencedWarning.__module__}.NotGeoreferencedWarning")
def test_label_carried_over_to_an_image_of_another_size_is_an_error(tmp_path):
    cube = write_cube(tmp_path / "a.cub")
    label = read_isis_label(cube)["IsisCube"]
    label["Core"]["Dimensions"]["Lines"] = 40
    tiff = geotiff_of(cube, tmp_path / "a.tif", IsisCube=label)
    with pytest.raises(InputError, match="label speaks of 40 x 30 pixels, the image has 20 x 30"):
        metric(tiff)


@pytest.mark.filterwarnings(f"ignore::{NotGeoreferencedWarning.__module__}.NotGeoreferencedWarning")
def test_table_left_behind_by_an_older_gdal_is_an_error(tmp_path):
    cube = write_cube(tmp_path / "a.cub")
    label = read_isis_label(cube)
    values = read_pixels(cube)
    with rasterio.open(tmp_path / "a.tif", "w", height=20, width=30, **TIFF) as file:
        file.write(values, 1)
        file.update_tags(ns="json:ISIS3", doc=json.dumps(label))
    with pytest.raises(InputError, match="left behind in the cube: a GDAL older than 3.12"):
        metric(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"naif": NAIF_NAC.format(clock="soon")}, "time of the clock count, as 16 hexadecimal"),
        ({"naif": NAIF_NAC.format(clock="0000000000000000")}, "position is known from .* s, but"),
        ({"instrument": NAC.replace("0.5 <ms>", "0 <ms>")}, "a line took 0.0 s"),
        ({"instrument": NAC.replace("0.5 <ms>", "Null")}, "LineExposureDuration = Null; 1 finite"),
    ],
)
def test_line_scan_image_at_impossible_times_is_an_error(tmp_path, changes, message):
    path = nac_cube(tmp_path / "n.cub", **changes)
    with pytest.raises(InputError, match=rf"n\.cub: .*{message}"):
        read_camera(path, (1000, 64))


def test_label_of_ten_megabytes_is_read(tmp_path):
    path = write_cube(tmp_path / "a.cub")
    expected = metric(path)
    data = path.read_bytes()
    keys = "".join(f"  K{i} = {'x' * 1000}\n" for i in range(10_000))
    end = data.index(b"End_Object\nObject = Label")
    label = data[:end] + f" Group = Padding\n{keys} End_Group\n".encode()
    label += data[end:LABEL_BYTES].rstrip(b"\0")
    grown = len(label) + 100
    for start in sorted({int(part.split()[0]) for part in label.split(b"StartByte = ")[1:]})[::-1]:
        moved = start + grown - LABEL_BYTES
        label = label.replace(b"StartByte = %d\n" % start, b"StartByte = %d\n" % moved)
    label = label.replace(b"Bytes = %d\n" % LABEL_BYTES, b"Bytes = %d\n" % grown)
    path.write_bytes(label.ljust(grown) + data[LABEL_BYTES:])
    np.testing.assert_array_equal(metric(path).rotation, expected.rotation)


# rasterio trips over GDAL's messages that quote bytes which are no UTF-8, and goes on
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_damaged_cube_gives_a_camera_or_an_error(tmp_path, data):
    """Bytes of label and tables are changed, cut out and doubled."""
    source = tmp_path / "good.cub"
    if not source.exists():
        write_cube(source, (4, 5), instrument=METRIC)
    content = bytearray(source.read_bytes())
    used = content.index(0)
    places = st.one_of(st.integers(0, used), st.integers(LABEL_BYTES, len(content) - 1))
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(places)
        change = data.draw(st.sampled_from(["set", "cut", "double", "end"]))
        if change == "set":
            content[place : place + 1] = bytes([data.draw(st.integers(0, 255))])
        elif change == "cut":
            del content[place : place + data.draw(st.integers(1, 40))]
        elif change == "double":
            content[place:place] = content[place : place + data.draw(st.integers(1, 40))]
        else:
            del content[place:]
    path = tmp_path / "bad.cub"
    path.write_bytes(content)
    try:
        camera = read_camera(path, (4, 5))
    except LommelError:
        return
    assert np.isfinite(camera.position).all()


JUNK = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=3), inner)
    ),
    max_leaves=5,
)


def places(value, path=()):
    """Paths of everything in nested dicts."""
    yield path
    for key, inner in value.items() if isinstance(value, dict) else ():
        yield from places(inner, (*path, key))


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
@pytest.mark.filterwarnings(f"ignore::{NotGeoreferencedWarning.__module__}.NotGeoreferencedWarning")
def test_damaged_label_of_a_geotiff_gives_a_camera_or_an_error(tmp_path, data):
    """Any part of the JSON becomes any JSON."""
    cube = tmp_path / "good.cub"
    if not cube.exists():
        write_cube(cube, (4, 5))
    label = with_table_bytes(read_isis_label(cube), cube)
    for _ in range(data.draw(st.integers(1, 3))):
        *folders, key = data.draw(st.sampled_from([path for path in places(label) if path]))
        part = label
        for folder in folders:
            part = part[folder]
        part[key] = data.draw(JUNK)
    tiff = tmp_path / "bad.tif"
    with rasterio.open(tiff, "w", height=4, width=5, **TIFF) as file:
        file.write(np.ones((4, 5), np.float32), 1)
        file.update_tags(ns="json:ISIS3", doc=json.dumps(label))
    try:
        camera = read_camera(tiff, (4, 5))
    except LommelError:
        return
    assert np.isfinite(camera.position).all()
