import numpy as np
import pytest

from lommel.scene.body import MOON, local_frame
from lommel.scene.grid import Grid, grid_from_bounds, read_crs
from lommel.scene.shadows import sunlit

SPACING = 100.0  # m
POST = 1.0  # posts: a ray samples terrain once per post


@pytest.fixture
def grid() -> Grid:
    crs = read_crs("+proj=eqc +R=1737400 +units=m +type=crs")
    return grid_from_bounds((-10e3, -5e3, 10e3, 5e3), SPACING, crs)


def sun_at(elevation_deg, azimuth_deg):
    """Position of a Sun that stands so over longitude 0, latitude 0."""
    east, north, up = (axis[0] for axis in local_frame(np.zeros(1), np.zeros(1)))
    elevation, azimuth = np.radians(elevation_deg), np.radians(azimuth_deg)
    horizontal = np.sin(azimuth) * east + np.cos(azimuth) * north
    return 1.5e11 * (np.cos(elevation) * horizontal + np.sin(elevation) * up) + MOON.radius * up


@pytest.mark.parametrize("elevation", [10.0, 20.0, 45.0])
def test_shadow_of_a_wall_is_as_long_as_its_height_over_the_tangent(grid, elevation):
    heights = np.zeros(grid.shape)
    heights[:, 100] = 1000.0
    is_lit = sunlit(grid, heights, sun_at(elevation, 90.0))
    dark = np.flatnonzero(~is_lit[50])
    expected = 1000.0 / np.tan(np.radians(elevation)) / SPACING
    assert dark.max() == 99
    assert dark.size == pytest.approx(expected, abs=POST + 0.02 * expected)  # 2 %: curvature


def test_shadow_turns_with_the_sun(grid):
    heights = np.zeros(grid.shape)
    heights[50, 100] = 1000.0
    is_lit = sunlit(grid, heights, sun_at(30.0, 0.0))
    rows, cols = np.nonzero(~is_lit)
    assert rows.min() > 50
    assert set(cols) <= {99, 100, 101}


def test_flat_ground_is_lit_until_the_sun_sets(grid):
    assert sunlit(grid, np.zeros(grid.shape), sun_at(1.0, 45.0)).all()


def test_no_shadow_under_an_overhead_sun(grid):
    heights = np.random.default_rng(0).normal(0.0, 100.0, grid.shape)
    is_lit = sunlit(grid, heights, sun_at(90.0, 0.0))
    assert is_lit.all()


def test_holes_cast_no_shadow_and_are_lit(grid):
    heights = np.zeros(grid.shape)
    heights[40:60, 100:110] = np.nan
    assert sunlit(grid, heights, sun_at(10.0, 90.0)).all()
