"""Compiled passes that bring images and light onto the cells of a surface.

`sample_cells` interpolates an image where the surface's points fall in it; `cast_shadow` follows
the way to the Sun from every cell. Slowly varying geometry comes as planes on a lattice of nodes
(`lommel.estimate.surface`), interpolated row by row with `expand_row`.
"""

import numpy as np
from numba import njit, prange

from lommel.core.interpolation import sample_cubic

FAST = {"contract", "nsz"}


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST)
def expand_row(plane, row, step, out):
    """Interpolate a lattice plane along one row of cells.

    Parameters
    ----------
    plane : float32 array (node_rows, node_cols)
    row : float
        Of the cells' centres, in node units.
    step : int
        Cells from node to node.
    out : float32 array (cols,)
    """
    i = min(np.int64(row), plane.shape[0] - 2)
    t = np.float32(row - i)
    upper, lower = plane[i], plane[i + 1]
    for j in range(plane.shape[1] - 1):
        first = j * step
        left = upper[j] + t * (lower[j] - upper[j])
        right = upper[j + 1] + t * (lower[j + 1] - upper[j + 1])
        slope = (right - left) / np.float32(step)
        start = left + np.float32(0.5) * slope
        part = out[first : min(first + step, out.size)]
        for c in range(part.size):
            part[c] = start + slope * np.float32(c)


@njit(cache=True, parallel=True, fastmath=FAST)
def sample_cells(image, planes, step, u, reference, out):
    """Bring an image onto the cells of a surface.

    Parameters
    ----------
    image : float32 array (lines, samples)
        NaN where missing.
    planes : float32 array (6, node_rows, node_cols)
        Array coordinates of the surface point: line and sample at u = 0, both per metre of u,
        and both per metre that the point lies above the surface an orthoimage was made with.
    step : int
        Cells from node to node.
    u : float32 array (rows, cols), m
    reference : float32 array (rows, cols), m, or (1, 1)
        That surface, on posts; of size 1 when the image is a raw one.
    out : float32 array (rows - 1, cols - 1)
    """
    quarter = np.float32(0.25)
    for i in prange(out.shape[0]):
        r = np.int64(i)
        cols = out.shape[1]
        at = np.empty((6, cols), np.float32)
        for k in range(6):
            expand_row(planes[k], (r + 0.5) / step, step, at[k])
        upper, lower = u[r], u[r + 1]
        for c in range(cols):
            h = quarter * (upper[c] + upper[c + 1] + lower[c] + lower[c + 1])
            line, sample = at[0, c] + at[2, c] * h, at[1, c] + at[3, c] * h
            if reference.size > 1:  # the view ray meets the orthoimage's own surface elsewhere
                row, col = r + np.float32(0.5) + at[2, c] * h, c + np.float32(0.5) + at[3, c] * h
                rise_row = rise_col = np.float32(0.0)
                for _ in range(2):
                    there = sample_cubic(reference, row + rise_row, col + rise_col)
                    rise = h - there if not np.isnan(there) else np.float32(0.0)
                    rise_row, rise_col = at[4, c] * rise, at[5, c] * rise
                line, sample = line + rise_row, sample + rise_col
            out[r, c] = sample_cubic(image, line, sample)


@njit(cache=True, parallel=True, error_model="numpy", fastmath=FAST)
def slide_along(step, u, planes, lattice_step):
    """Turn a step of points along view rays into one of the surface above the posts, in place.

    A point that rises by ``step`` towards the camera also moves sideways, and takes the slope of
    the ground along: to first order what is left above its post is the step times one minus the
    slope in that direction, per unit of rise.

    Parameters
    ----------
    step : float32 array (rows, cols), m
    u : float32 array (rows, cols), m
        The surface.
    planes : float32 array (2, node_rows, node_cols), posts per m
        Rows and columns that rays to the camera cross per metre of rise.
    lattice_step : int
        Cells from node to node.
    """
    rows, cols = u.shape
    for i in prange(rows):
        r = np.int64(i)
        upper, lower = max(r - 1, 0), min(r + 1, rows - 1)
        at = np.empty((2, cols), np.float32)
        centre = (min(r, rows - 2) + 0.5) / lattice_step
        expand_row(planes[0], centre, lattice_step, at[0, : cols - 1])
        expand_row(planes[1], centre, lattice_step, at[1, : cols - 1])
        at[0, cols - 1], at[1, cols - 1] = at[0, cols - 2], at[1, cols - 2]
        for c in range(cols):
            left, right = max(c - 1, 0), min(c + 1, cols - 1)
            by_row = (u[lower, c] - u[upper, c]) / np.float32(lower - upper)
            by_col = (u[r, right] - u[r, left]) / np.float32(right - left)
            share = np.float32(1.0) - at[0, c] * by_row - at[1, c] * by_col
            step[r, c] *= min(max(share, np.float32(0.0)), np.float32(2.0))


@njit(cache=True, parallel=True, fastmath=FAST)
def cast_shadow(u, planes, step, around, place, highest, cells, darkest, out):
    """True on dark cells from which the way to the Sun meets terrain.

    Parameters
    ----------
    u : float32 array (rows, cols), m
    planes : float32 array (2, node_rows, node_cols), posts per m
        Rows and columns that the way to the Sun crosses per metre of rise.
    step : int
        Cells from node to node.
    around : float32 array (rows, cols), m
        Every so manieth post of a larger surface, which shadow is followed on beyond the ends of
        ``u``; of no rows where there is none.
    place : int64 array (3,)
        Row and column of the first post of ``u`` among those of the larger surface at full
        resolution, and the posts of that per post of ``around``.
    highest : float, m
        Of both surfaces: above it nothing casts shadow.
    cells : float32 array (rows - 1, cols - 1), image units
    darkest : float, image units
        Cells that are brighter are not in shadow, whatever the terrain says.
    out : bool array (rows - 1, cols - 1)
    """
    for i in prange(out.shape[0]):
        r = np.int64(i)
        at = np.empty((2, out.shape[1]), np.float32)
        expand_row(planes[0], (r + 0.5) / step, step, at[0])
        expand_row(planes[1], (r + 0.5) / step, step, at[1])
        for c in range(out.shape[1]):
            out[r, c] = cells[r, c] <= darkest and _meets_terrain(
                u, r, c, at[0, c], at[1, c], around, place, highest
            )


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST)
def _meets_terrain(u, r, c, per_metre_row, per_metre_col, around, place, highest):
    """Follow the ray from a cell's centre, one post along the longer axis at a time."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    length = max(abs(per_metre_row), abs(per_metre_col))
    if length == 0:
        return False
    rise = np.float32(1.0) / length
    d_row, d_col = per_metre_row * rise, per_metre_col * rise
    height = quarter * (u[r, c] + u[r, c + 1] + u[r + 1, c] + u[r + 1, c + 1])
    row, col = r + half, c + half
    while True:
        row, col, height = row + d_row, col + d_col, height + rise
        if height > highest:
            return False
        if _holds(u, row, col):
            ground = _ground(u, row, col)
        else:
            far_row, far_col = (row + place[0]) / place[2], (col + place[1]) / place[2]
            if not _holds(around, far_row, far_col):
                return False
            ground = _ground(around, far_row, far_col)
        if ground > height:
            return True


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST)
def _holds(u, row, col):
    """Whether a place lies on a surface."""
    return 0 <= row and 0 <= col and row <= u.shape[0] - 1 and col <= u.shape[1] - 1


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST)
def _ground(u, row, col):
    """Height of a surface between its posts."""
    i, j = min(np.int64(row), u.shape[0] - 2), min(np.int64(col), u.shape[1] - 2)
    v, h = np.float32(row - i), np.float32(col - j)
    upper = u[i, j] + h * (u[i, j + 1] - u[i, j])
    lower = u[i + 1, j] + h * (u[i + 1, j + 1] - u[i + 1, j])
    return upper + v * (lower - upper)
