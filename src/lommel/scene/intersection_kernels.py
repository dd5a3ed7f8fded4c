"""Compiled meeting of rays with an ellipsoid and with a terrain.

Most callers want `lommel.scene.intersection`.
"""

import numpy as np
from numba import njit, prange

FAST = {"contract", "nsz"}
BLOCK = 1024  # rays per parallel work item
STRIDE = 0.5  # posts walked at a time; a ridge narrower than this along the ray may be missed
CLOSE = 1e-4  # m along the ray, where bisection ends


@njit(cache=True, parallel=True)
def cross_ellipsoid(origin, direction, radii, enter, leave):
    """Distances at which lines enter and leave an ellipsoid; NaN where they pass by.

    Taken from the point of the line that is closest to the centre once the axes are scaled to one,
    which keeps the digits that the distance of a remote origin would cost.

    Parameters
    ----------
    origin, direction : float64 array (n, 3), m and unit vectors
    radii : float64 array (3,), m
    enter, leave : float64 array (n,), m
        Filled; negative behind the origin.
    """
    for block in prange((enter.size + BLOCK - 1) // BLOCK):
        first = np.int64(block) * BLOCK
        for i in range(first, min(first + BLOCK, enter.size)):
            squared, middle, miss = 0.0, 0.0, 0.0
            for k in range(3):
                squared += (direction[i, k] / radii[k]) ** 2
                middle -= origin[i, k] * direction[i, k] / radii[k] ** 2
            middle /= squared
            for k in range(3):
                miss += ((origin[i, k] + middle * direction[i, k]) / radii[k]) ** 2
            half = np.sqrt((1.0 - miss) / squared) if miss <= 1.0 else np.nan
            enter[i], leave[i] = middle - half, middle + half


@njit(cache=True, nogil=True, fastmath=FAST)
def _cubic(knots, at):
    """Row and column on a ray, between knots of equal distance, by cubic interpolation."""
    i = min(max(np.int64(at) - 1, 0), knots.shape[0] - 4)
    t = at - i - 1.0
    a = -t * (t - 1.0) * (t - 2.0) / 6.0
    b = (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0
    c = -(t + 1.0) * t * (t - 2.0) / 2.0
    d = (t + 1.0) * t * (t - 1.0) / 6.0
    row = a * knots[i, 0] + b * knots[i + 1, 0] + c * knots[i + 2, 0] + d * knots[i + 3, 0]
    col = a * knots[i, 1] + b * knots[i + 1, 1] + c * knots[i + 2, 1] + d * knots[i + 3, 1]
    return row, col


@njit(cache=True, nogil=True, fastmath=FAST)
def _bilinear(heights, row, col):
    """Height of the terrain; NaN outside and beside missing posts."""
    rows, cols = heights.shape
    if not (0.0 <= row <= rows - 1 and 0.0 <= col <= cols - 1):
        return np.nan
    i, j = min(np.int64(row), rows - 2), min(np.int64(col), cols - 2)
    v, h = row - i, col - j
    upper = heights[i, j] + h * (heights[i, j + 1] - heights[i, j])
    lower = heights[i + 1, j] + h * (heights[i + 1, j + 1] - heights[i + 1, j])
    return upper + v * (lower - upper)


@njit(cache=True, nogil=True)
def _clearance(o, d, distance, start, pace, knots, heights, radius):
    """Height of a ray above the terrain; NaN where the terrain is unknown."""
    row, col = _cubic(knots, (distance - start) / pace)
    x, y, z = o[0] + distance * d[0], o[1] + distance * d[1], o[2] + distance * d[2]
    return np.sqrt(x * x + y * y + z * z) - radius - _bilinear(heights, row, col)


@njit(cache=True, nogil=True)
def _meet(o, d, start, end, knots, heights, radius):
    """Walk along a ray until it dips into the terrain, then halve the last step."""
    spans = knots.shape[0] - 1
    pace = (end - start) / spans
    above, was_known, was_above = start, False, False
    for span in range(spans):
        run = np.hypot(knots[span + 1, 0] - knots[span, 0], knots[span + 1, 1] - knots[span, 1])
        if np.isnan(run):
            was_known = was_above = False
            continue
        steps = np.int64(min(run / STRIDE, 1e7)) + 1
        for step in range(1 if span > 0 else 0, steps + 1):
            distance = start + (span + step / steps) * pace
            clearance = _clearance(o, d, distance, start, pace, knots, heights, radius)
            is_known = not np.isnan(clearance)
            if clearance > 0.0:
                above = distance
            elif is_known and was_above:
                below = distance
                while below - above > CLOSE:
                    middle = 0.5 * (above + below)
                    if middle in (above, below):
                        break
                    if _clearance(o, d, middle, start, pace, knots, heights, radius) > 0.0:
                        above = middle
                    else:
                        below = middle
                return 0.5 * (above + below)
            elif is_known and not was_known:
                return np.nan  # it came through unknown ground
            was_known, was_above = is_known, clearance > 0.0
    return np.nan


@njit(cache=True, parallel=True)
def meet_heights(origin, direction, start, end, knots, heights, radius, out, place):
    """Distance to the first point of a terrain in front of each ray's origin.

    Parameters
    ----------
    origin, direction : float64 array (n, 3), m and unit vectors
    start, end : float64 array (n,), m
        Where each ray can meet the terrain at all.
    knots : float64 array (n, m, 2), posts
        Row and column at m >= 4 equal distances from start to end.
    heights : float64 array (rows, cols), m
        NaN where unknown.
    radius : float, m
        From which heights count.
    out : float64 array (n,), m
        Filled; NaN where a ray misses, or meets the terrain where it is unknown.
    place : float64 array (n, 2), posts
        Filled with the row and column of the point, as the knots tell them.
    """
    for block in prange((out.size + BLOCK - 1) // BLOCK):
        first = np.int64(block) * BLOCK
        for i in range(first, min(first + BLOCK, out.size)):
            out[i] = np.nan
            if start[i] < end[i]:
                out[i] = _meet(origin[i], direction[i], start[i], end[i], knots[i], heights, radius)
            pace = (end[i] - start[i]) / (knots.shape[1] - 1)
            if not np.isnan(out[i]):
                place[i] = _cubic(knots[i], (out[i] - start[i]) / pace)
