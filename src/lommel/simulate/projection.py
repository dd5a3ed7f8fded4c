"""From ground to image: which ground a camera's rays meet, and what they see there.

Every ray is a line on the map: where it is at the lowest and at the highest terrain fixes it. The
height at which it meets the terrain is found by walking to and fro between line and terrain.
Orthoimages are made as users make them: onto the initial DEM, so that where it is wrong by h the
image is displaced by h tan(emission). Most callers want `orthoimage` or `camera_image`.
"""

import numpy as np
from scipy.ndimage import map_coordinates

from lommel.scene.body import to_lonlat
from lommel.scene.geometry import unit

WALKS = 12  # steps between ray and terrain; each shrinks the error by slope times tan(emission)


def ground_points(surface, origin, direction):
    """Where rays meet the ground.

    Parameters
    ----------
    surface : Surface
    origin : array (3,), m, body-fixed
    direction : array (..., 3), dimensionless
        Unit vectors.

    Returns
    -------
    row, col : array (...), vertices
        Fractional indices on the vertex lattice; beyond it the terrain goes on as at its edge.
    """
    low, high = float(surface.vertices.min()), float(surface.vertices.max()) + 1.0
    ends = [_index_at_height(surface, origin, direction, height) for height in (low, high)]
    start, run = ends[0], (ends[1] - ends[0]) / (high - low)
    height = np.full(direction.shape[:-1], 0.5 * (low + high))
    for _ in range(WALKS):
        place = start + run * (height - low)
        height = map_coordinates(surface.vertices, place, order=1, mode="nearest")
    row, col = start + run * (height - low)
    return row, col


def _index_at_height(surface, origin, direction, height):
    """Vertex indices of rays where they pass a height, array (2, ...)."""
    approach = direction @ origin
    radius = surface.grid.body.radius + height
    distance = -approach - np.sqrt(approach**2 - origin @ origin + radius**2)
    xyz = origin + distance[..., None] * direction
    longitude, latitude, _ = to_lonlat(surface.grid.body, xyz)
    return np.stack(surface.vertex_grid.index_at(longitude, latitude))


def orthoimage(surface, brightness, heights, window, origin):
    """Brightness on the map grid, projected onto a DEM that need not be the true one.

    Parameters
    ----------
    surface : Surface
    brightness : array (facet rows, facet cols), dimensionless
    heights : array (window.rows, window.cols), m
        The DEM used.
    window : Window
        The posts wanted, counted on the surface's grid.
    origin : array (3,), m, body-fixed
        The camera.

    Returns
    -------
    values : array (window.rows, window.cols), dimensionless
        Means over squares of one post.
    """
    factor = surface.oversampling
    rays = unit(surface.grid.cut(window).xyz(heights) - origin)
    row, col = ground_points(surface, origin, rays)
    corner = [row - factor / 2, col - factor / 2]
    return map_coordinates(_box_means(brightness, factor), corner, order=1, mode="nearest")


def _box_means(values, factor):
    """Means over ``factor`` x ``factor`` facets, at the index of the first of them."""
    rows, cols = values.shape[0] - factor + 1, values.shape[1] - factor + 1
    along = sum(values[shift : shift + rows] for shift in range(factor))
    return sum(along[:, shift : shift + cols] for shift in range(factor)) / factor**2


def camera_image(surface, brightness, camera, rays_per_pixel=2):
    """Brightness in the geometry of a camera, as it would leave the spacecraft.

    Parameters
    ----------
    surface : Surface
    brightness : array (facet rows, facet cols), dimensionless
    camera : Camera
    rays_per_pixel : int
        Along each axis of a pixel; enough that rays are no farther apart than facets.

    Returns
    -------
    values : array (lines, samples), dimensionless
        NaN where a pixel looks beyond the surface.
    """
    lines, samples = camera.shape
    line = (np.arange(lines * rays_per_pixel) + 0.5) / rays_per_pixel
    sample = (np.arange(samples * rays_per_pixel) + 0.5) / rays_per_pixel
    rays = camera.ray(line[:, None], sample[None, :])
    row, col = ground_points(surface, camera.position, rays)
    values = map_coordinates(brightness, [row - 0.5, col - 0.5], order=1, mode="nearest")
    rows, cols = surface.vertex_grid.shape
    values[(row < 0) | (row > rows - 1) | (col < 0) | (col > cols - 1)] = np.nan
    pixels = values.reshape(lines, rays_per_pixel, samples, rays_per_pixel)
    return pixels.mean(axis=(1, 3))
