import numpy as np
import pytest

from lommel.scene.body import MOON, to_xyz
from lommel.scene.camera import FrameCamera, nadir_rotation
from lommel.scene.geometry import unit
from lommel.scene.grid import Window
from lommel.simulate.imaging import facet_surface, map_grid, vertex_lattice
from lommel.simulate.projection import camera_image, ground_points, orthoimage
from lommel.simulate.settings import GridSettings

GRID = map_grid(GridSettings(rows=40, cols=60, spacing=100.0))
FACTOR = 2
SHAPE = vertex_lattice(GRID, FACTOR).shape
INSIDE = Window(10, 10, 20, 40)
FACET = 0.02  # vertices; 1 m on the ground, a hundredth of a post
ORIGIN = to_xyz(MOON, np.radians(24.0), np.radians(8.9), 110e3)  # 29 degrees off, to the west


def surface_of(vertices):
    return facet_surface(GRID, FACTOR, np.broadcast_to(vertices, SHAPE).copy(), np.ones(SHAPE))


def hills():
    rows, cols = np.indices(SHAPE)
    return 150.0 * np.sin(cols / 9.0) * np.cos(rows / 11.0)


def test_ray_through_a_vertex_meets_the_ground_there():
    vertices = hills()
    surface = surface_of(vertices)
    xyz = surface.vertex_grid.xyz(vertices)[10:-10, 10:-10]
    row, col = ground_points(surface, ORIGIN, unit(xyz - ORIGIN))
    expected_row, expected_col = np.indices(SHAPE)[:, 10:-10, 10:-10]
    np.testing.assert_allclose(row, expected_row, atol=FACET)
    np.testing.assert_allclose(col, expected_col, atol=FACET)


def test_orthoimage_on_the_true_dem_is_the_mean_over_each_post():
    surface = surface_of(hills())
    brightness = np.random.default_rng(0).uniform(size=surface.albedo.shape)
    brightness = np.cumsum(np.cumsum(brightness - 0.5, axis=0), axis=1)  # smooth, but not much
    image = orthoimage(surface, brightness, surface.heights[INSIDE.slices], INSIDE, ORIGIN)
    expected = surface.mean(brightness)[INSIDE.slices]
    assert np.abs(image - expected).max() < FACET * np.abs(np.gradient(brightness)).max()


def test_orthoimage_on_a_wrong_dem_moves_by_the_parallax():
    surface = surface_of(0.0)
    cols = np.broadcast_to(np.arange(surface.albedo.shape[1], dtype=float), surface.albedo.shape)
    right = orthoimage(surface, cols, np.zeros(INSIDE.shape), INSIDE, ORIGIN)
    wrong = orthoimage(surface, cols, np.full(INSIDE.shape, 60.0), INSIDE, ORIGIN)
    xyz = GRID.cut(INSIDE).xyz(0.0)
    emission = np.arccos((unit(ORIGIN - xyz) * unit(xyz)).sum(axis=-1))
    # the camera stands in the west: its rays pass 60 m up before they land farther east
    expected = 60.0 * np.tan(emission) / 100.0 * FACTOR
    np.testing.assert_allclose(wrong - right, expected, rtol=0.02)


def test_camera_image_shows_each_place_at_its_pixel():
    """An image of the map's own columns, read back where the camera projects the ground."""
    vertices = hills()
    surface = surface_of(vertices)
    position = to_xyz(MOON, np.radians(25.9), np.radians(8.87), 60e3)
    rotation = nadir_rotation(position, np.array([-0.4, 0.9, 0.0]))
    camera = FrameCamera(position, rotation, 1200.0, (100.0, 150.0), (200, 300))
    cols = np.broadcast_to(np.arange(surface.albedo.shape[1]) + 0.5, surface.albedo.shape)
    image = camera_image(surface, cols, camera, rays_per_pixel=2)
    line, sample = camera.project(surface.vertex_grid.xyz(vertices)[10:-10:7, 10:-10:7])
    expected = np.indices(SHAPE)[1, 10:-10:7, 10:-10:7]
    seen = camera.contains(line - 1.0, sample - 1.0) & camera.contains(line + 1.0, sample + 1.0)
    found = image[line[seen].astype(int), sample[seen].astype(int)]
    assert seen.sum() > 40
    pixel = 50.0 / 50.0  # vertices: 60 km / 1200 px is one vertex distance
    assert np.abs(found - expected[seen]).max() < 0.75 * pixel  # its centre is half a pixel off


def test_camera_image_is_nothing_beyond_the_surface():
    surface = surface_of(0.0)
    position = to_xyz(MOON, np.radians(26.0), np.radians(8.9), 60e3)
    camera = FrameCamera(
        position, nadir_rotation(position, np.array([0.0, 1.0, 0.0])), 100.0, (8.0, 8.0), (16, 16)
    )
    image = camera_image(surface, np.ones(surface.albedo.shape), camera)
    assert np.isnan(image[0]).all()
    assert image[8, 8] == pytest.approx(1.0)
