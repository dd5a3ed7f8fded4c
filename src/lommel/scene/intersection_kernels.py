"""Compiled meeting of rays with an ellipsoid and with a terrain.

Most callers want `lommel.scene.intersection`.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from lommel.scene.camera_kernels import PARALLEL
from lommel.scene.distortion_kernels import FAST, SERIAL

BLOCK = 1024  # rays per parallel work item
INSIDE = 1e-6  # posts; clearances of a cell are taken this far from its border
LEAST_STEP = 1e-6  # knots, for rays that come down almost upright
CLOSE = 1e-4  # m along the ray, to which the place is found
UNKNOWN, ABOVE, UNDERGROUND, MET = range(4)


class Ray(NamedTuple):
    """A ray over a terrain; knots are counted from `start` and lie `pace` apart."""

    origin: np.ndarray  # m
    direction: np.ndarray
    start: float  # m
    pace: float  # m
    radius: float  # m, from which heights count


@njit(**PARALLEL)
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


@njit(**SERIAL, fastmath=FAST)
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


@njit(**SERIAL, fastmath=FAST)
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


@njit(**SERIAL)
def _clearance(ray, at, knots, heights):
    """Height of a ray above the terrain, at a knot or between; NaN where terrain is unknown."""
    row, col = _cubic(knots, at)
    distance = ray.start + at * ray.pace
    x = ray.origin[0] + distance * ray.direction[0]
    y = ray.origin[1] + distance * ray.direction[1]
    z = ray.origin[2] + distance * ray.direction[2]
    return np.sqrt(x * x + y * y + z * z) - ray.radius - _bilinear(heights, row, col)


@njit(**SERIAL)
def _to_border(index, rate):
    """How far to the next whole row or column, in knots, at a rate of rows or columns per knot."""
    if rate > 0.0:
        return (np.floor(index) + 1.0 - index) / rate
    if rate < 0.0:
        return (np.ceil(index) - 1.0 - index) / rate
    return np.inf


@njit(**SERIAL)
def _dip(above, below, guess, ray, knots, heights):
    """Place between one above the terrain and one below it where the ray goes under.

    A good guess is only checked on both sides; from a bad one the interval is halved.
    """
    reach = 0.5 * CLOSE / ray.pace
    for place in (guess - reach, guess + reach):
        if above < place < below:
            if _clearance(ray, place, knots, heights) > 0.0:
                above = place
            else:
                below = place
    while (below - above) * ray.pace > 1.1 * CLOSE:
        middle = 0.5 * (above + below)
        if middle in (above, below):
            break
        if _clearance(ray, middle, knots, heights) > 0.0:
            above = middle
        else:
            below = middle
    return 0.5 * (above + below)


@njit(**SERIAL)
def _meet_in_cell(first, last, was_above, ray, knots, heights):
    """Place in a cell where a ray meets the terrain, and how it fares behind the cell.

    A bilinear surface under a straight line is a parabola, so three clearances tell all.
    """
    near = _clearance(ray, first, knots, heights)
    middle = _clearance(ray, 0.5 * (first + last), knots, heights)
    far = _clearance(ray, last, knots, heights)
    if np.isnan(near + middle + far):
        return np.nan, UNKNOWN
    if near <= 0.0:
        return (first, MET) if was_above else (np.nan, UNDERGROUND)
    bend, slope = 2.0 * (near - 2.0 * middle + far), 4.0 * middle - 3.0 * near - far
    if far > 0.0 and not (bend > 0.0 and 0.0 < -slope < 2.0 * bend):
        return np.nan, ABOVE
    below = last if far <= 0.0 else first - 0.5 * slope / bend * (last - first)
    if far <= 0.0 or _clearance(ray, below, knots, heights) <= 0.0:
        root = 2.0 * near / (np.sqrt(max(slope * slope - 4.0 * bend * near, 0.0)) - slope)
        return _dip(first, below, first + root * (last - first), ray, knots, heights), MET
    return np.nan, ABOVE


@njit(**SERIAL)
def _meet(ray, knots, heights):
    """Place on a ray, in knots, where it first dips into the terrain, cell by cell."""
    spans = knots.shape[0] - 1
    state = UNKNOWN
    for span in range(spans):
        row_rate = knots[span + 1, 0] - knots[span, 0]
        col_rate = knots[span + 1, 1] - knots[span, 1]
        if np.isnan(row_rate + col_rate):
            state = UNKNOWN
            continue
        nudge = min(INSIDE / max(abs(row_rate), abs(col_rate), INSIDE), LEAST_STEP)
        at, end = np.float64(span), span + 1.0
        while at < end:
            row, col = _cubic(knots, at)
            step = min(_to_border(row, row_rate), _to_border(col, col_rate), end - at)
            last = max(at + step - nudge, at)
            place, state = _meet_in_cell(at, last, state == ABOVE, ray, knots, heights)
            if state == MET or state == UNDERGROUND:
                return place
            at += max(step + nudge, LEAST_STEP)
    return np.nan


@njit(**PARALLEL)
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
                pace = (end[i] - start[i]) / (knots.shape[1] - 1)
                ray = Ray(origin[i], direction[i], start[i], pace, radius)
                at = _meet(ray, knots[i], heights)
                out[i] = start[i] + at * pace
                if not np.isnan(at):
                    place[i] = _cubic(knots[i], at)
