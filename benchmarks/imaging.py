r"""Images of the benchmark scenes, formed without any part of the solver.

The ground is a lattice of vertices on a stereographic map, twice as fine as the posts of the DEM,
in the axes of the map's origin (east, north, up) from the body's centre. On a sphere of radius R
both directions of that projection are closed-form: with :math:`t = (x^2 + y^2) / 4 R^2` the place
(x, y) lies in the direction :math:`(x / R, y / R, 1 - t) / (1 + t)`, and the direction (e, n, u)
at :math:`x = 2 R e / (1 + u)`. Each facet is flat and has one brightness (McEwen's lunar-Lambert);
each pixel is the mean over 2x2 rays, found by walking along the ray to the terrain. Shadows that
one facet casts on others are left out. Most callers want `facet_brightness` and `pinhole_image`.
"""

import numpy as np
from numba import njit, prange

WALKS = 4  # steps from ray to terrain, beginning at its neighbour's height
RAYS = 2  # per pixel and axis


@njit(cache=True, nogil=True)
def _vertex_row(heights, r, origin, spacing, radius, out):
    """Points of one row of vertices, array (3, cols), m; the lattice is periodic in columns."""
    row = heights[r % heights.shape[0]]
    y = origin[1] - r * spacing
    for c in range(row.size):
        x = origin[0] + c * spacing
        t = (x * x + y * y) / (4 * radius * radius)
        scale = (radius + row[c]) / (1 + t)
        out[0, c] = x / radius * scale
        out[1, c] = y / radius * scale
        out[2, c] = (1 - t) * scale


@njit(cache=True, nogil=True)
def _lunar_lambert(cos_incidence, cos_emission, phase):
    """McEwen (1991) with the limb-darkening polynomial of McEwen (1996)."""
    degrees = np.degrees(phase)
    share = 1 + degrees * (-0.019 + degrees * (0.242e-3 - 1.46e-6 * degrees))
    blend = 2 * share / (cos_incidence + cos_emission) + 1 - share
    return cos_incidence * blend


@njit(cache=True, parallel=True)
def facet_brightness(heights, albedo, origin, spacing, radius, sun, camera, out):
    """Albedo times reflectance of every facet.

    Parameters
    ----------
    heights : float32 array (rows, cols), m above the sphere
        At the vertices.
    albedo : float32 array (rows, cols) or (1, 1)
    origin : float64 array (2,), m
        Map coordinates of the first vertex; rows run south.
    spacing, radius : float, m
    sun, camera : float64 array (3,), m
    out : float32 array (rows, cols)
        Facet (r, c) lies between the vertices (r, c) and (r + 1, c + 1).
    """
    rows, cols = heights.shape
    for i in prange(rows):
        r = np.int64(i)
        upper, lower = np.empty((3, cols)), np.empty((3, cols))
        _vertex_row(heights, r, origin, spacing, radius, upper)
        _vertex_row(heights, r + 1, origin, spacing, radius, lower)
        a = albedo[r % albedo.shape[0]]
        for c in range(cols):
            d = min(c + 1, cols - 1)
            east, north, up = upper[0, c], upper[1, c], upper[2, c]
            # the diagonals to the south-east and to the north-east
            e0, n0, u0 = lower[0, d] - east, lower[1, d] - north, lower[2, d] - up
            e1, n1, u1 = upper[0, d] - lower[0, c], upper[1, d] - lower[1, c], 0.0
            u1 = upper[2, d] - lower[2, c]
            ne, nn, nu = n0 * u1 - u0 * n1, u0 * e1 - e0 * u1, e0 * n1 - n0 * e1
            se, sn, su = sun[0] - east, sun[1] - north, sun[2] - up
            ve, vn, vu = camera[0] - east, camera[1] - north, camera[2] - up
            normal = np.sqrt(ne * ne + nn * nn + nu * nu)
            to_sun = np.sqrt(se * se + sn * sn + su * su)
            to_camera = np.sqrt(ve * ve + vn * vn + vu * vu)
            cos_incidence = (ne * se + nn * sn + nu * su) / (normal * to_sun)
            cos_emission = (ne * ve + nn * vn + nu * vu) / (normal * to_camera)
            cos_phase = (se * ve + sn * vn + su * vu) / (to_sun * to_camera)
            value = 0.0
            if cos_incidence > 0 and cos_emission > 0:
                value = _lunar_lambert(cos_incidence, cos_emission, np.arccos(cos_phase))
            out[r, c] = a[c % a.size] * value


@njit(cache=True, nogil=True)
def _bilinear(values, row, col):
    rows, cols = values.shape
    i, j = int(np.floor(row)), int(np.floor(col))
    v, h = row - i, col - j
    upper, lower = values[i % rows], values[(i + 1) % rows]
    left, right = j % cols, (j + 1) % cols
    return (1 - v) * ((1 - h) * upper[left] + h * upper[right]) + v * (
        (1 - h) * lower[left] + h * lower[right]
    )


@njit(cache=True, nogil=True)
def _ground(heights, origin, spacing, radius, camera, direction, height):
    """Vertex row, column and height where a ray (unit vector) meets the terrain."""
    row = col = 0.0
    along = camera[0] * direction[0] + camera[1] * direction[1] + camera[2] * direction[2]
    square = camera[0] ** 2 + camera[1] ** 2 + camera[2] ** 2
    for _ in range(WALKS):
        distance = -along - np.sqrt(along * along - square + (radius + height) ** 2)
        scale = 2 * radius / (radius + height + camera[2] + distance * direction[2])
        col = ((camera[0] + distance * direction[0]) * scale - origin[0]) / spacing
        row = (origin[1] - (camera[1] + distance * direction[1]) * scale) / spacing
        height = _bilinear(heights, row, col)
    return row, col, height


@njit(cache=True, parallel=True)
def pinhole_image(
    heights, brightness, origin, spacing, radius, camera, axes, focal_length, out, first, size
):
    """What a pinhole camera sees in some lines; arguments as in `facet_brightness`.

    Parameters
    ----------
    camera : float64 array (3,), m
    axes : float64 array (3, 3)
        Rows: along growing samples, along growing lines, into the scene.
    focal_length : float, px
        The principal point is the middle of the image.
    out : float32 array (lines, samples)
    first, size : int
        Number of the first of these lines, and of all lines of the image.
    """
    lines, samples = out.shape
    for i in prange(lines):
        direction = np.empty(3)
        height = np.float64(heights[0, 0])
        for j in range(samples):
            total = 0.0
            for ray in range(RAYS * RAYS):
                y = first + np.int64(i) + (ray // RAYS + 0.5) / RAYS - 0.5 * size
                x = j + (ray % RAYS + 0.5) / RAYS - 0.5 * samples
                length = np.sqrt(x * x + y * y + focal_length**2)
                for k in range(3):
                    direction[k] = (
                        x * axes[0, k] + y * axes[1, k] + focal_length * axes[2, k]
                    ) / length
                row, col, height = _ground(
                    heights, origin, spacing, radius, camera, direction, height
                )
                total += _bilinear(brightness, row - 0.5, col - 0.5)
            out[i, j] = total / (RAYS * RAYS)
