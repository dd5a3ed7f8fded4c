"""Where view rays meet the ground: a sphere, an ellipsoid, or a terrain.

Rays come from a camera, ``camera.origin(line, sample)`` and ``camera.ray(line, sample)``. A sphere
and an ellipsoid are met in closed form. On a terrain a ray is followed from the height of its
highest post to that of its lowest, cell by cell. Between four posts the terrain is bilinear, hence
a parabola under a straight line, so a ray that only grazes a ridge meets it, and not the plain
behind it; the place is found to a tenth of a millimetre along the ray. Most callers want
`meet_sphere` and `meet_terrain`.
"""

import numpy as np

from lommel.core.multigrid import threads_for
from lommel.errors import InputError
from lommel.scene import intersection_kernels as kernels
from lommel.scene.body import to_lonlat

CLEAR = 1.0  # m above the highest and below the lowest post, where rays start and end
KNOT_SPACING = 10e3  # m; the map's curvature leaves a cubic through such knots below 1 mm
KNOTS = 5, 64  # at least, at most
CHUNK = 1 << 14  # rays at a time; bounds memory
MISPLACED = 0.02  # posts; a ray that bends more on the map than its knots can tell is given up


def meet_sphere(origin, direction, radius):
    """Where rays meet a sphere around the body's centre; see `meet_ellipsoid`.

    Examples
    --------
    >>> meet_sphere([10.0, 0.0, 0.0], [-1.0, 0.0, 0.0], 2.0).tolist()
    [2.0, 0.0, 0.0]
    """
    return meet_ellipsoid(origin, direction, (radius, radius, radius))


def meet_ellipsoid(origin, direction, radii):
    """Where rays meet an ellipsoid whose axes are those of the body.

    Parameters
    ----------
    origin : array (..., 3), m, body-fixed
    direction : array (..., 3), dimensionless
        Unit vectors, body-fixed.
    radii : array (3,), m

    Returns
    -------
    xyz : array (..., 3), m, body-fixed
        The first point in front of the origin; NaN where a ray misses.
    """
    radii = np.array(radii, dtype=float)
    if radii.shape != (3,) or not ((radii > 0) & np.isfinite(radii)).all():
        raise InputError(
            f"radii = {radii.tolist()} of the ellipsoid must be three positive metres."
        )
    origin, direction, shape = _flat(origin, direction)
    enter, leave = _crossings(origin, direction, radii)
    distance = np.where(enter >= 0, enter, np.where(leave >= 0, leave, np.nan))
    return (origin + distance[:, None] * direction).reshape(shape)


def meet_terrain(origin, direction, grid, heights):
    """Where rays meet a terrain.

    Parameters
    ----------
    origin : array (..., 3), m, body-fixed
        Above the terrain.
    direction : array (..., 3), dimensionless
        Unit vectors, body-fixed.
    grid : Grid
    heights : array (rows, cols), m
        NaN where unknown.

    Returns
    -------
    xyz : array (..., 3), m, body-fixed
        The first point in front of the origin; NaN where a ray misses, leaves the grid, or comes to
        known terrain from below.
    """
    heights = np.ascontiguousarray(heights, dtype=float)
    if heights.shape != tuple(grid.shape) or min(heights.shape) < 2:
        raise InputError(
            f"heights have shape {heights.shape}, the grid {tuple(grid.shape)}; both must agree, "
            "with two rows and two columns or more."
        )
    origin, direction, shape = _flat(origin, direction)
    xyz = np.full(origin.shape, np.nan)
    if np.isfinite(heights).any():
        low = grid.body.radius + np.nanmin(heights) - CLEAR
        high = grid.body.radius + np.nanmax(heights) + CLEAR
        for first in range(0, len(origin), CHUNK):
            part = slice(first, first + CHUNK)
            xyz[part] = _meet_terrain(origin[part], direction[part], grid, heights, low, high)
    return xyz.reshape(shape)


def _meet_terrain(origin, direction, grid, heights, low, high):
    start, end = _span(origin, direction, low, high)
    count = int(np.clip(np.fmax.reduce(end - start, initial=0.0) / KNOT_SPACING + 2, *KNOTS))
    along = start[:, None] + np.linspace(0.0, 1.0, count) * (end - start)[:, None]
    knots = _index_at(grid, origin[:, None] + along[..., None] * direction[:, None])
    distance, place = np.empty(len(origin)), np.full((len(origin), 2), np.nan)
    with threads_for((distance.size, 1)):
        kernels.meet_heights(
            origin, direction, start, end, knots, heights, grid.body.radius, distance, place
        )
    xyz = origin + distance[:, None] * direction
    bend = np.linalg.norm(_index_at(grid, xyz) - place, axis=1)
    xyz[~(bend <= MISPLACED)] = np.nan
    return xyz


def _span(origin, direction, low, high):
    """Distances between which a terrain between two spheres can be met; NaN where it cannot."""
    enter, leave = _crossings(origin, direction, np.full(3, high))
    ground, _ = _crossings(origin, direction, np.full(3, low))
    start = np.maximum(enter, 0.0)
    return start, np.where(ground >= start, ground, leave)


def _crossings(origin, direction, radii):
    """Distances at which lines enter and leave an ellipsoid; NaN where they pass by."""
    enter, leave = np.empty((2, len(origin)))
    with threads_for((enter.size, 1)):
        kernels.cross_ellipsoid(origin, direction, radii, enter, leave)
    return enter, leave


def _index_at(grid, xyz):
    longitude, latitude, _ = to_lonlat(grid.body, xyz)
    return np.stack(grid.index_at(longitude, latitude), axis=-1)


def _flat(origin, direction):
    origin, direction = np.broadcast_arrays(np.asarray(origin, float), np.asarray(direction, float))
    return (
        np.ascontiguousarray(origin).reshape(-1, 3),
        np.ascontiguousarray(direction).reshape(-1, 3),
        origin.shape,
    )
