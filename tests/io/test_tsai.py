"""Pinhole cameras of the Ames Stereo Pipeline."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lommel.errors import InputError, LommelError
from lommel.io.tsai import read_tsai
from lommel.scene.body import MOON, to_xyz
from lommel.scene.camera import nadir_rotation

PIXEL = 1e-6  # px, far below any registration
POSITION = to_xyz(MOON, 0.06, 0.45, 100e3)
ROTATION = nadir_rotation(POSITION, np.array([0.0, 0.0, 1.0]))

GOOD = {
    "fu": "3.0",
    "fv": "3.0",
    "cu": "0.75",
    "cv": "0.5",
    "u_direction": "1 0 0",
    "v_direction": "0 1 0",
    "w_direction": "0 0 1",
    "C": " ".join(repr(float(value)) for value in POSITION),
    "R": " ".join(repr(float(value)) for value in ROTATION.T.ravel()),
    "pitch": "0.005",
}
TSAI = {"k1": "-0.1", "k2": "0.05", "p1": "1e-3", "p2": "-2e-3"}
BROWN_CONRADY = {
    "xp": "-0.006",
    "yp": "-0.002",
    "k1": "-0.13361854e-5",
    "k2": "0.52261757e-09",
    "k3": "-0.50728336e-13",
    "p1": "-0.54958195e-06",
    "p2": "-0.46089420e-10",
    "phi": "2.9659070",
}


def write(folder, lens="NULL", **changes):
    lines = [f"{key} = {value}" for key, value in (GOOD | changes).items() if value is not None]
    path = folder / "camera.tsai"
    path.write_text("\n".join(["VERSION_4", "PINHOLE", *lines, lens]) + "\n", encoding="utf-8")
    return path


def test_optical_axis_meets_the_principal_point_half_a_pixel_further(tmp_path):
    """ASP counts (0, 0) at the first pixel's centre, where ours is (0.5, 0.5)."""
    camera = read_tsai(write(tmp_path), (200, 300))
    line, sample = camera.project(to_xyz(MOON, 0.06, 0.45, 0.0))
    assert line == pytest.approx(100.5, abs=PIXEL)
    assert sample == pytest.approx(150.5, abs=PIXEL)
    assert camera.shape == (200, 300)


def test_focal_length_counts_in_pixels(tmp_path):
    camera = read_tsai(write(tmp_path), (200, 300))
    assert camera.focal_length == pytest.approx(600.0)
    here = camera.project(camera.position + 1e5 * ROTATION[2])
    right = camera.project(camera.position + 1e5 * ROTATION[2] + 1e3 * ROTATION[0])
    assert right[1] - here[1] == pytest.approx(6.0, abs=PIXEL)
    assert right[0] == pytest.approx(here[0], abs=PIXEL)


def test_tsai_lens_moves_points_in_focal_lengths(tmp_path):
    """The formula of the Vision Workbench at (x, y) = (0.1, 0.05) focal lengths."""
    camera = read_tsai(write(tmp_path, "TSAI", **TSAI), (200, 300))
    x, y, rr = 0.1, 0.05, 0.0125
    radial = 1 - 0.1 * rr + 0.05 * rr**2
    found = camera.project(camera.position + 1e5 * np.array([x, y, 1.0]) @ ROTATION)
    expected = (
        100.5 + 600 * (y * radial + 1e-3 * (rr + 2 * y * y) - 2 * 2e-3 * x * y),
        150.5 + 600 * (x * radial + 2 * 1e-3 * x * y - 2e-3 * (rr + 2 * x * x)),
    )
    assert found == pytest.approx(expected, abs=PIXEL)


def test_brown_conrady_lens_undistorts_in_the_files_unit(tmp_path):
    """The Metric camera of Apollo: 76.054 mm, pixels of 5 micrometres."""
    size = {"fu": "76.054", "fv": "76.054", "cu": "57.25", "cv": "57.25"}
    lens = {"lens": "BROWN_CONRADY", **size, **BROWN_CONRADY}
    camera = read_tsai(write(tmp_path, **lens), (22900, 22900))
    x, y = 30.0 + 0.006, -20.0 + 0.002  # mm, from the lens's own centre
    rr = x * x + y * y
    radial = 1 - 0.13361854e-5 * rr + 0.52261757e-9 * rr**2 - 0.50728336e-13 * rr**3
    decentring = -0.54958195e-6 * rr - 0.46089420e-10 * rr**2
    ideal = [
        x * radial - decentring * np.sin(2.965907),
        y * radial + decentring * np.cos(2.965907),
        76.054,
    ]
    found = camera.project(camera.position + 1e4 * np.array(ideal) @ ROTATION)
    pixel = 57.25 / 0.005 + 0.5
    assert found == pytest.approx((pixel - 20.0 / 0.005, pixel + 30.0 / 0.005), abs=1e-4)


@pytest.mark.parametrize("lens", [{}, {"lens": "TSAI", **TSAI}])
def test_ray_returns_to_its_pixel(tmp_path, lens):
    camera = read_tsai(write(tmp_path, **lens), (200, 300))
    line, sample = np.random.default_rng(2).uniform(0, 200, (2, 20))
    found = camera.project(camera.position + 1e5 * camera.ray(line, sample))
    np.testing.assert_allclose(found, (line, sample), rtol=0, atol=PIXEL)


@pytest.mark.real_data
def test_camera_of_a_peer_scene_sees_its_dem(real_data):
    from lommel.io.raster import raster_info, read_grid

    folder = real_data("peer-scenes") / "s500_1"
    paths = sorted(folder.glob("*.tsai"))
    assert paths
    dem = next(path for path in sorted(folder.glob("*.tif")) if "dem" in path.name.lower())
    grid = read_grid(dem)
    centre = to_xyz(MOON, *grid.lonlat_at(*(np.array(grid.shape) / 2)), 0.0)
    for path in paths:
        image = path.with_suffix(".tif")
        camera = read_tsai(path, raster_info(image).shape)
        assert camera.contains(*camera.project(centre))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"C": None}, r"C is missing or malformed; a \.tsai camera needs fu, fv"),
        ({"C": "1 2"}, "C is missing or malformed"),
        ({"fu": "wide"}, "fu is missing or malformed"),
        ({"R": "nan 0 0 0 1 0 0 0 1"}, "R is missing or malformed"),
        ({"R": "1 0 0 0 1 0 0 0 2"}, "rotation is not a rotation"),
        ({"R": "1 0 0 0 1 0 0 0 -1"}, "rotation is not a rotation"),
        ({"R": "1e200 -1e200 0 1e200 1e200 0 0 0 1"}, "rotation is not a rotation"),
        ({"pitch": "0"}, r"pitch = 0\.0 must be positive"),
        ({"fv": "3.5"}, r"fu = 3\.0 equal to fv = 3\.5"),
        ({"fu": "-3", "fv": "-3"}, "focal_length = -600.0 is not positive and finite"),
        ({"fu": "1e300", "fv": "1e300", "pitch": "1e-300"}, "focal_length = inf"),
        ({"u_direction": "0 1 0"}, "u, v and w_direction must be the unit axes"),
        ({"lens": "RPC"}, r"lens distortion RPC is not supported\. Supported are NULL, TSAI"),
        ({"lens": "TSAI", "k1": "0"}, "k2 is missing or malformed; the lens TSAI needs k1, k2"),
        ({"lens": "TSAI", **TSAI, "p1": "1 2"}, "p1 is missing or malformed; the lens TSAI"),
        ({"lens": "TSAI", **TSAI, "p1": "inf"}, "it needs 5 finite numbers"),
    ],
)
def test_unusable_camera_is_an_error(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        read_tsai(write(tmp_path, **changes), (200, 300))


def test_file_that_is_no_text_is_an_error(tmp_path):
    (tmp_path / "noise.tsai").write_bytes(bytes(range(256)))
    for path in (tmp_path / "nowhere.tsai", tmp_path, tmp_path / "noise.tsai"):
        with pytest.raises(InputError, match=r"cannot be read as a \.tsai camera"):
            read_tsai(path, (200, 300))


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.one_of(
        st.binary(max_size=300),
        st.dictionaries(
            st.sampled_from(sorted(GOOD)),
            st.one_of(
                st.none(),
                st.floats().map(repr),
                st.lists(st.floats().map(repr), max_size=9).map(" ".join),
            ),
            max_size=3,
        ),
    )
)
def test_any_bytes_give_a_camera_or_an_error(tmp_path, content):
    path = tmp_path / "camera.tsai"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path = write(tmp_path, **content)
    try:
        camera = read_tsai(path, (200, 300))
    except LommelError:
        return
    assert camera.focal_length > 0
