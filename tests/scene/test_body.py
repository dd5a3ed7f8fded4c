"""The reference sphere and its frame."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lommel.scene.body import MOON, local_frame, to_lonlat, to_xyz, up_vector

MILLIMETRE = 1e-3  # m, a thousandth of the finest post spacing in use
ROUNDING = 1e-14  # dimensionless, a few float64 steps

longitudes = st.floats(-np.pi + 1e-9, np.pi)
latitudes = st.floats(-np.pi / 2, np.pi / 2)


@pytest.mark.parametrize(
    ("longitude_deg", "latitude_deg", "axis"),
    [
        (0, 0, (1, 0, 0)),
        (90, 0, (0, 1, 0)),
        (180, 0, (-1, 0, 0)),
        (270, 0, (0, -1, 0)),
        (0, 90, (0, 0, 1)),
        (77, -90, (0, 0, -1)),
    ],
)
def test_axes_of_the_body_leave_it_at_their_places(longitude_deg, latitude_deg, axis):
    up = up_vector(np.radians(longitude_deg), np.radians(latitude_deg))
    np.testing.assert_allclose(up, axis, rtol=0, atol=ROUNDING)


@given(longitudes, latitudes, st.floats(-9e3, 1.1e6))
def test_lonlat_height_returns_to_its_point(longitude, latitude, height):
    there = to_lonlat(MOON, to_xyz(MOON, longitude, latitude, height))
    again = to_xyz(MOON, *there)
    np.testing.assert_allclose(
        again, to_xyz(MOON, longitude, latitude, height), rtol=0, atol=MILLIMETRE
    )
    assert there[2] == pytest.approx(height, abs=MILLIMETRE)


@given(longitudes, latitudes)
def test_local_frame_is_right_handed_and_orthonormal(longitude, latitude):
    frame = np.stack(local_frame(longitude, latitude))
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), rtol=0, atol=ROUNDING)
    assert np.linalg.det(frame) == pytest.approx(1.0, abs=ROUNDING)


def test_local_frame_points_where_coordinates_grow():
    longitude, latitude, step = 0.4, -0.7, 1e-6
    east, north, up = local_frame(longitude, latitude)
    here = to_xyz(MOON, longitude, latitude, 0.0)
    towards = {
        "east": to_xyz(MOON, longitude + step, latitude, 0.0),
        "north": to_xyz(MOON, longitude, latitude + step, 0.0),
        "up": to_xyz(MOON, longitude, latitude, 1.0),
    }
    for direction, vector in (("east", east), ("north", north), ("up", up)):
        move = towards[direction] - here
        assert move @ vector / np.linalg.norm(move) == pytest.approx(1.0, abs=1e-9)


def test_shapes_broadcast_and_vectors_come_last():
    longitude, latitude = np.zeros((1, 5)), np.linspace(-1, 1, 4)[:, None]
    xyz = to_xyz(MOON, *np.broadcast_arrays(longitude, latitude), np.zeros((4, 5)))
    assert xyz.shape == (4, 5, 3)
    assert local_frame(longitude, latitude)[1].shape == (4, 5, 3)
    assert to_lonlat(MOON, xyz)[2].shape == (4, 5)


def test_unknown_height_is_unknown_place():
    assert np.isnan(to_xyz(MOON, 0.1, 0.2, np.nan)).all()
