"""CSM image support data: what is written reads back, what cannot be read is named."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lommel.errors import InputError, LommelError
from lommel.io.cameras import read_camera
from lommel.io.isd import is_isd, isd_shape, read_isd, write_isd
from lommel.io.isis import read_isis
from lommel.io.raster import raster_info
from lommel.scene.body import MOON, to_lonlat, to_xyz
from lommel.scene.camera import FrameCamera, ReducedCamera, nadir_rotation
from lommel.scene.distortion import MODELS, Distortion
from lommel.scene.intersection import meet_sphere
from lommel.scene.line_scan import LineScanCamera
from lommel.scene.motion import Pointing, Trajectory

PIXEL = 1e-6  # px
POSITION = to_xyz(MOON, 0.3, -0.2, 100e3)
ROTATION = nadir_rotation(POSITION, np.array([0.0, 0.0, 1.0]))
LENSES = {
    "none": (),
    "radial": (1e-5, 2e-6, 1e-9),
    "brown-conrady": (0.1, -0.2, 1e-6, 1e-9, 0.0, 1e-6, 1e-9, 0.5),
    "radtan": (0.1, 0.01, 1e-3, 2e-3, 0.0),
    "transverse": (0.1, 1.01, 0, 1e-4, 0, 0, 0, 0, 0, 0, 0.2, 0, 0.99, 0, 0, 1e-4, 0, 0, 0, 0),
    "kaguyalism": (-0.07, -1e-3, 1e-3, 8e-6, -4e-6, 0.02, -1e-3, 1e-5, 3e-6, -6e-6),
    "lrolrocnac": (1.81e-5,),
}


def frame(distortion=None, **changes):
    settings = {
        "position": POSITION,
        "rotation": ROTATION,
        "focal_length": 70.0,
        "principal_point": (52.0, 47.5),
        "shape": (100, 90),
        "distortion": distortion,
        "sun_position": to_xyz(MOON, 1.0, 0.1, 1.5e11),
        "to_pixels": ((0.3, 9.0), (-10.0, 0.1)),
    }
    return FrameCamera(**(settings | changes))


def line_scan(distortion=None):
    times = 3e8 + np.array([-1.0, 0.5, 1.7, 3.0])
    angles = np.linspace(0.0, 3e-3, 4)[:, None] * [0.0, 0.0, 1.0]
    turns = Rotation.from_rotvec(angles + np.array([0.0, 1e-4, -1e-4, 0.0])[:, None])
    places = turns.apply(POSITION)
    return LineScanCamera(
        trajectory=Trajectory(times, places),
        pointing=Pointing(times, ROTATION @ turns.inv().as_matrix()),
        line_times=np.array([[0.0, 3e8, 1e-3], [50.0, 3e8 + 0.05, 2e-3]]),
        focal_length=700.0,
        principal_point=(0.3, 47.5),
        shape=(100, 90),
        distortion=distortion,
        sun_trajectory=Trajectory(times, np.tile(to_xyz(MOON, 1.0, 0.1, 1.5e11), (4, 1))),
        to_pixels=((0.0, -140.0), (140.0, 0.1)),
    )


def assert_same(camera, other):
    """Both cameras see the same pixels, and the same Sun."""
    line, sample = np.meshgrid(*(np.linspace(0, size, 7) for size in camera.shape))
    ground = meet_sphere(camera.origin(line, sample), camera.ray(line, sample), MOON.radius)
    assert np.isfinite(ground).any()
    expected = np.array(camera.project(ground))
    assert np.isfinite(expected).any()
    np.testing.assert_allclose(other.project(ground), expected, rtol=0, atol=PIXEL)
    if camera.sun_position is None:
        assert other.sun_position is None
    else:
        np.testing.assert_allclose(other.sun(line, sample), camera.sun(line, sample), rtol=1e-12)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("make", [frame, line_scan])
def test_written_camera_reads_back_to_the_same_projections(tmp_path, make, model):
    focal_length = make().focal_length
    camera = make(Distortion(model, LENSES[model], focal_length if model == "radtan" else 1.0))
    write_isd(tmp_path / "camera.json", camera)
    assert isd_shape(tmp_path / "camera.json") == camera.shape
    assert_same(camera, read_camera(tmp_path / "camera.json", camera.shape))


def test_lens_fitted_in_millimetres_on_a_plane_in_pixels_reads_back(tmp_path):
    """The ISD has no unit of the lens: the plane is written in the lens's."""
    lens = Distortion("brown-conrady", LENSES["brown-conrady"], 200.0)
    camera = frame(lens, focal_length=14000.0, to_pixels=((0.0, 1.0), (1.0, 0.0)))
    write_isd(tmp_path / "a.isd", camera)
    assert_same(camera, read_camera(tmp_path / "a.isd", camera.shape))


def test_camera_without_a_sun_reads_back_without_one(tmp_path):
    write_isd(tmp_path / "a.isd", frame(sun_position=None))
    assert read_isd(tmp_path / "a.isd", (100, 90)).sun_position is None


def test_lines_are_taken_in_their_middle(tmp_path):
    """CSM's line 0.5 is the centre of the first line, half a period after it began."""
    write_isd(tmp_path / "a.json", line_scan())
    isd = json.loads((tmp_path / "a.json").read_text())
    start = isd["starting_ephemeris_time"] - isd["center_ephemeris_time"]
    assert isd["line_scan_rate"][0] == [0.5, start, 1e-3]
    camera = read_isd(tmp_path / "a.json", (100, 90))
    assert camera.time(0.5) == pytest.approx(3e8 + 0.5e-3, abs=1e-7)


def test_reduced_image_has_no_isd(tmp_path):
    with pytest.raises(InputError, match="a ReducedCamera has no ISD"):
        write_isd(tmp_path / "a.json", ReducedCamera(frame(), 2))
    assert not list(tmp_path.iterdir())


@pytest.mark.real_data
@pytest.mark.parametrize(
    "name",
    ["apollo15-hadley-lola/AS15-M-1134-hadley.cub", "lro-nac/M143947267L.cal.echo.crop.cub"],
)
def test_isd_of_a_real_cube_has_its_projections(real_data, tmp_path, name):
    path = real_data(name.split("/")[0]) / name.split("/")[1]
    camera = read_isis(path, raster_info(path).shape)
    write_isd(tmp_path / "a.json", camera)
    assert_same(camera, read_isd(tmp_path / "a.json", camera.shape))


@pytest.mark.real_data
@pytest.mark.parametrize(
    "name", ["apollometric_isd", "lrolroc_isd", "lro_isis_isd", "kaguyatc_isd"]
)
def test_camera_of_ale_sees_the_moon_and_returns_to_its_pixel(real_data, name):
    path = real_data("isd") / f"{name}.json"
    camera = read_isd(path, isd_shape(path))
    line, sample = np.array(camera.shape) / 2
    ground = meet_sphere(camera.origin(line, sample), camera.ray(line, sample), MOON.radius)
    assert camera.project(ground) == pytest.approx((line, sample), abs=1e-4)  # px
    below = to_lonlat(MOON, camera.position)
    assert 40e3 < below[2] < 160e3
    # all four look down, Apollo's by some 25 degrees aside
    distance = MOON.radius * np.arccos(
        ground @ camera.position / MOON.radius / (below[2] + MOON.radius)
    )
    assert distance < 1.1 * below[2]


@pytest.mark.real_data
def test_two_isds_of_one_image_agree(real_data):
    """From ISIS's tables and from SPICE kernels; the first has an entry per few lines only."""
    folder = real_data("isd")
    isis, naif = (
        read_isd(folder / f"{name}.json", isd_shape(folder / f"{name}.json"))
        for name in ("lro_isis_isd", "lrolroc_isd")
    )
    np.testing.assert_allclose(isis.origin(0.5, 0.5), naif.origin(0.5, 0.5), rtol=0, atol=1e-4)
    np.testing.assert_allclose(isis.ray(0.5, 0.5), naif.ray(0.5, 0.5), rtol=0, atol=1e-10)


# --- ISDs that cannot be read ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Keys of a frame camera's and of a line-scan camera's ISD."""
    folder = tmp_path_factory.mktemp("isd")
    write_isd(folder / "frame.json", frame(Distortion("radial", LENSES["radial"])))
    write_isd(folder / "scan.json", line_scan(Distortion("lrolrocnac", (1.81e-5,))))
    return [json.loads((folder / name).read_text()) for name in ("frame.json", "scan.json")]


def set_key(isd, path, value):
    isd = json.loads(json.dumps(isd))
    *folders, key = path.split("/")
    part = isd
    for folder in folders:
        part = part[folder]
    part[key] = value
    return isd


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("name_model", "USGS_ASTRO_SAR_SENSOR_MODEL", "needs the CSM model USGS_ASTRO_SAR_SENSOR"),
        ("name_model", 5, "needs the CSM model 5, which is not supported. Supported are"),
        ("image_lines", 200, "belongs to an image of 200 x 90 pixels"),
        ("image_lines", 0.5, "image_lines = 0.5 is not a count"),
        ("optical_distortion", {"cahvor": {}}, "distortion model cahvor is not supported"),
        ("optical_distortion", {}, "distortion model None is not supported"),
        ("optical_distortion/radial", {"coefficients": [0] * 4}, "4 coefficients; 3 are known"),
        ("optical_distortion/radial", {"coefficients": "0"}, "is not n finite numbers"),
        ("focal_length_model", None, "focal_length_model is missing or no object"),
        ("focal_length_model/focal_length", -1.0, "focal_length = -1.0 is not positive"),
        ("focal2pixel_lines", [0, 0, 0], "does not map the focal plane"),
        ("focal2pixel_lines", [0, 1], "focal2pixel_lines = .* is not 3 finite numbers"),
        ("detector_line_summing", 0, "summing = .* is not positive"),
        ("body_rotation/quaternions", [[0, 0, 0, 0]], "quaternion of length 0"),
        ("body_rotation/quaternions", [[1, 0, 0]], "is not 1 x 4 finite numbers"),
        ("instrument_position/positions", [[1e400, 0, 0]], "is not 1 x 3 finite numbers"),
        ("instrument_position/ephemeris_times", [], "is not 0 x 3 finite numbers"),
        ("instrument_pointing", {}, "ephemeris_times = None is not n finite numbers"),
        ("center_ephemeris_time", "now", "center_ephemeris_time = now is not one finite number"),
    ],
)
def test_unusable_key_is_an_error(tmp_path, good, key, value, message):
    (tmp_path / "a.json").write_text(json.dumps(set_key(good[0], key, value)))
    with pytest.raises(InputError, match=message):
        read_isd(tmp_path / "a.json", (100, 90))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("line_scan_rate", [[0.5, 100.0, 1e-3]], "position is known from .* s, but the image was"),
        ("line_scan_rate", [], "line_scan_rate = .* is not n x 3|ascending first lines"),
        ("line_scan_rate", [[0.5, 0.0, 0.0]], "no line of zero seconds"),
        ("instrument_pointing/ephemeris_times", [4, 3, 2, 1], "do not ascend"),
    ],
)
def test_line_scan_at_impossible_times_is_an_error(tmp_path, good, key, value, message):
    (tmp_path / "a.json").write_text(json.dumps(set_key(good[1], key, value)))
    with pytest.raises(InputError, match=message):
        read_isd(tmp_path / "a.json", (100, 90))


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{", b"\xff\xfe", b"[" * 100_000, b'{"a": ' * 50_000]
)
def test_file_that_is_no_isd_is_an_error(tmp_path, content):
    path = tmp_path / "a.isd"
    path.write_bytes(content)
    assert not is_isd(path)
    with pytest.raises(InputError, match="cannot be read as an ISD|is JSON, but not an ISD"):
        read_isd(path, (100, 90))
    with pytest.raises(InputError, match="cannot be read as an ISD"):
        read_isd(tmp_path / "nowhere.isd", (100, 90))


JUNK = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=3), inner)
    ),
    max_leaves=6,
)


def places(value, path=()):
    """Paths of everything in nested dicts and lists; of long lists the first entries."""
    yield path
    items = value.items() if isinstance(value, dict) else ()
    if isinstance(value, list):
        items = enumerate(value[:2])
    for key, inner in items:
        yield from places(inner, (*path, key))


@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_damaged_isd_gives_a_camera_or_an_error(tmp_path, good, data):
    isd = json.loads(json.dumps(data.draw(st.sampled_from(good))))
    for _ in range(data.draw(st.integers(1, 3))):
        *folders, key = data.draw(st.sampled_from([path for path in places(isd) if path]))
        part = isd
        for folder in folders:
            part = part[folder]
        part[key] = data.draw(JUNK)
    (tmp_path / "a.json").write_text(json.dumps(isd))
    try:
        camera = read_isd(tmp_path / "a.json", (100, 90))
    except LommelError:
        return
    assert np.isfinite(camera.position).all()
