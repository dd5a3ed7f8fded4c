"""Both parametrisations: normals, drift, and the way from unknowns to heights and back."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from lommel.estimate.surface import Surface
from lommel.scene.body import MOON, to_lonlat
from lommel.scene.geometry import surface_normals

from .shading_scene import hills, patch_grid, positions

NORMAL = 2e-3  # rad; central differences over two posts against exact cell slopes of a plane
HEIGHT = 0.02  # m; cubic interpolation of hills of 6 m rms and 60 m correlation length


def surfaces():
    grid = patch_grid()
    _, camera = positions(100.0)
    return {"height": Surface(grid, 0.0), "ray": Surface(grid, 0.0, camera)}


@pytest.mark.parametrize("kind", ["height", "ray"])
def test_normal_is_affine_in_the_slopes(kind):
    """The normal of a tilted plane, from the frame's three vectors, is that of its posts."""
    surface = surfaces()[kind]
    grid = surface.grid
    rows, cols = np.indices(grid.shape)
    slope_col, slope_row = 0.1, -0.05
    u = slope_col * cols * grid.spacing[1] + slope_row * rows * grid.spacing[0]
    lattice = surface.lattice(grid.shape, 1, 55e3)
    base, direction, _ = surface._line(rows.astype(float), cols.astype(float))
    expected = surface_normals(base + u[..., None] * direction)[16, 32]
    node = int(16 / lattice.step), int(32 / lattice.step)
    frame = surface.frame(lattice, np.full((lattice.row.size, lattice.col.size), u[16, 32]))
    n = frame.c[0] + slope_col * frame.c[1] + slope_row * frame.c[2]
    n = n[node] / np.linalg.norm(n[node])
    assert lattice.row[node[0], 0] == 16 and lattice.col[0, node[1]] == 32
    assert np.arccos(np.clip(n @ expected, -1, 1)) < NORMAL


def test_heights_do_not_drift():
    surface = surfaces()["height"]
    lattice = surface.lattice(surface.grid.shape, 1, 110e3)
    frame = surface.frame(lattice, np.zeros((lattice.row.size, lattice.col.size)))
    assert np.abs(frame.drift).max() < 1e-12


def test_rays_drift_towards_the_camera():
    """The camera stands in azimuth 60 degrees, 70 up: 100 m up is 36 m towards east-north-east."""
    surface = surfaces()["ray"]
    lattice = surface.lattice(surface.grid.shape, 1, 110e3)
    frame = surface.frame(lattice, np.zeros((lattice.row.size, lattice.col.size)))
    row, col = frame.drift[:, frame.drift.shape[1] // 2, frame.drift.shape[2] // 2]
    toward = 1 / np.tan(np.radians(70.0)) / 20.0
    assert col == pytest.approx(toward * np.sin(np.radians(60.0)), rel=0.02)
    assert row == pytest.approx(-toward * np.cos(np.radians(60.0)), rel=0.02)


@pytest.mark.parametrize("kind", ["height", "ray"])
def test_heights_come_back_from_the_unknowns(kind):
    surface = surfaces()[kind]
    heights = hills(surface.grid.shape)
    again = surface.heights_from_posts(surface.posts_from_heights(heights))
    np.testing.assert_allclose(again[4:-4, 4:-4], heights[4:-4, 4:-4], atol=HEIGHT)


def test_ray_points_lie_on_the_terrain():
    """A point of the ray surface, brought to longitude and latitude, has the DEM's height."""
    surface = surfaces()["ray"]
    grid = surface.grid
    heights = hills(grid.shape, smooth=6.0)
    u = surface.posts_from_heights(heights)
    rows, cols = np.indices(grid.shape)
    base, direction, _ = surface._line(rows.astype(float), cols.astype(float))
    longitude, latitude, height = to_lonlat(MOON, base + u[..., None] * direction)
    there = map_coordinates(heights, np.stack(grid.index_at(longitude, latitude)), order=3)
    np.testing.assert_allclose(there[4:-4, 4:-4], height[4:-4, 4:-4], atol=HEIGHT)


def test_a_scarp_steeper_than_the_view_does_no_harm():
    """Where rays meet the terrain more than once, heights still stay between foot and plateau."""
    grid = patch_grid()
    _, camera = positions(100.0, view_elevation_deg=40.0)
    surface = Surface(grid, 0.0, camera)
    col = np.arange(grid.shape[1], dtype=np.float32)
    height, foot = 300.0, 20  # m, columns; the plateau lies in the east, where the camera is
    profile = height * np.clip((col - foot) / 5, 0, 1)  # 72 degrees
    heights = np.ascontiguousarray(np.broadcast_to(profile, grid.shape))
    again = surface.heights_from_posts(surface.posts_from_heights(heights))[12:-20]
    assert again.min() > -40 and again.max() < height + 40  # m, the splines' overshoot at edges
