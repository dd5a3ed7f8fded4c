"""Normals and photometric angles."""

import numpy as np
import pytest
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st

from lommel.scene.body import MOON, local_frame, to_xyz
from lommel.scene.geometry import surface_normals, unit, viewing_geometry
from lommel.scene.grid import Grid, read_crs

FAR = 1.5e11  # m, the Sun
ANGLE = 1e-7  # rad, arccos near 1 loses half of the digits
CURVATURE = 1e-7  # rad, central differences of a sphere over posts 1e-4 radii apart

GRID = Grid((9, 11), Affine(0.01, 0, 30, 0, -0.01, -40), read_crs("IAU_2015:30100"))


def frame():
    return local_frame(*GRID.lonlat())


def plane(slope_east, slope_north):
    """Heights over a flat patch in the sky of the body-fixed frame: posts 10 m apart."""
    north, east = -10.0 * np.arange(9.0)[:, None], 10.0 * np.arange(11.0)
    heights = slope_east * east + slope_north * north
    return np.stack(np.broadcast_arrays(east, north, heights), axis=-1)


def test_normals_of_the_sphere_are_its_verticals():
    normals = surface_normals(GRID.xyz(np.zeros(GRID.shape)))
    inner = (slice(1, -1), slice(1, -1))  # one-sided differences at the edge are first order
    np.testing.assert_allclose(normals[inner], frame()[2][inner], rtol=0, atol=CURVATURE)


@given(st.floats(-2, 2), st.floats(-2, 2))
def test_normal_of_a_ramp_leans_against_its_slope(slope_east, slope_north):
    expected = unit(np.array([-slope_east, -slope_north, 1.0]))
    normals = surface_normals(plane(slope_east, slope_north))
    np.testing.assert_allclose(normals, np.broadcast_to(expected, normals.shape), atol=1e-13)


def test_hole_spreads_to_the_four_neighbours_only():
    xyz = plane(0.1, 0.2)
    xyz[4, 5] = np.nan
    unknown = np.isnan(surface_normals(xyz)).any(axis=-1)
    assert sorted(map(tuple, np.argwhere(unknown))) == [(3, 5), (4, 4), (4, 6), (5, 5)]


def test_sun_and_camera_overhead_give_zero_angles():
    longitude, latitude = 0.3, -0.2
    ground = to_xyz(MOON, longitude, latitude, 0.0)
    up = local_frame(longitude, latitude)[2]
    geometry = viewing_geometry(ground, up, 1e5 * ground, 2 * ground)
    assert geometry.cos_incidence == pytest.approx(1.0)
    assert geometry.cos_emission == pytest.approx(1.0)
    assert geometry.phase == pytest.approx(0.0, abs=ANGLE)


@pytest.mark.parametrize("incidence", np.radians([0.0, 30.0, 60.0, 89.0, 100.0]))
@pytest.mark.parametrize("emission", np.radians([0.0, 20.0, 70.0]))
@pytest.mark.parametrize("opposite", [False, True])
def test_angles_in_the_principal_plane_add_up(incidence, emission, opposite):
    ground = to_xyz(MOON, 0.3, -0.2, 0.0)
    east, _, up = local_frame(0.3, -0.2)
    side = -1 if opposite else 1
    sun = ground + FAR * (np.sin(incidence) * east + np.cos(incidence) * up)
    camera = ground + 1e5 * (side * np.sin(emission) * east + np.cos(emission) * up)
    geometry = viewing_geometry(ground, up, sun, camera)
    assert geometry.cos_incidence == pytest.approx(np.cos(incidence), abs=1e-9)
    assert geometry.cos_emission == pytest.approx(np.cos(emission), abs=1e-9)
    assert geometry.phase == pytest.approx(abs(incidence - side * emission), abs=ANGLE)


def test_turning_the_scene_keeps_the_angles():
    random = np.random.default_rng(5)
    turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
    xyz, sun, camera = (
        GRID.xyz(random.normal(0, 50, GRID.shape)),
        [1e11, 5e10, -9e10],
        [2e6, 1e6, 0],
    )
    normals = surface_normals(xyz)
    straight = viewing_geometry(xyz, normals, sun, camera)
    turned = viewing_geometry(xyz @ turn, normals @ turn, sun @ turn, camera @ turn)
    for name in ("cos_incidence", "cos_emission", "phase"):
        np.testing.assert_allclose(getattr(straight, name), getattr(turned, name), atol=ANGLE)


def test_swapping_sun_and_camera_swaps_incidence_and_emission():
    xyz = GRID.xyz(np.random.default_rng(6).normal(0, 50, GRID.shape))
    normals, sun, camera = surface_normals(xyz), np.array([1e11, 5e10, -9e10]), 1.1 * xyz[4, 5]
    one = viewing_geometry(xyz, normals, sun, camera)
    other = viewing_geometry(xyz, normals, camera, sun)
    np.testing.assert_array_equal(one.cos_incidence, other.cos_emission)
    np.testing.assert_array_equal(one.phase, other.phase)


def test_unknown_heights_have_unknown_angles_and_no_exception():
    heights = np.zeros(GRID.shape)
    heights[2, 3] = np.nan
    xyz = GRID.xyz(heights)
    geometry = viewing_geometry(xyz, surface_normals(xyz), [1e11, 0, 0], [2e6, 0, 0])
    assert np.isnan(geometry.phase).sum() == 1
    assert np.isnan(geometry.cos_incidence).sum() == 5
