"""Ways that terrain bars: to the Sun (cast shadow) and to a camera (hidden ground).

From every post a ray marches towards its target, one post at a time, until terrain rises above it
or it has cleared the highest terrain of the grid. The ray's height over the reference sphere grows
as ``d tan(e) + d^2 (1 + 2 tan(e)^2) / 2 R``: distance d, elevation e of the target, radius R.
Most callers want `sunlit`.
"""

import numba
import numpy as np

from lommel.scene.geometry import unit


def sunlit(grid, heights, sun_position, window=None):
    """True where no other terrain hides the Sun; facets turned from it are not looked at.

    A camera's position in place of the Sun's tells which ground the camera sees.

    Parameters
    ----------
    grid : Grid
    heights : array (rows, cols), m
        NaN casts no shadow and is lit.
    sun_position : array (3,) or (window.rows, window.cols, 3), m, body-fixed
    window : Window, optional
        The posts asked for; the terrain around them is only looked at. All by default.

    Returns
    -------
    is_lit : bool array (window.rows, window.cols)
    """
    window = window or grid.window
    heights = np.ascontiguousarray(heights)
    if not np.isfinite(heights).any():
        return np.ones(window.shape, bool)
    ground = heights[window.slices]
    up = grid.cut(window).xyz(0.0)
    to_south, to_east = np.gradient(up, axis=(0, 1))
    up /= grid.body.radius
    to_sun = unit(np.asarray(sun_position, float) - (grid.body.radius + ground)[..., None] * up)
    sine = np.einsum("...i,...i", to_sun, up)
    tangent = sine / np.sqrt(np.maximum(1.0 - sine**2, 1e-30))
    row_step, col_step = _steps(to_sun - sine[..., None] * up, to_south, to_east)
    # one post along the longer of both steps, so that terrain is interpolated along a line only
    longest = np.maximum(np.maximum(np.abs(row_step), np.abs(col_step)), 1e-30)
    row_step /= longest
    col_step /= longest
    distance = np.linalg.norm(
        row_step[..., None] * to_south + col_step[..., None] * to_east, axis=-1
    )
    return _march(
        heights,
        (window.row, window.col),
        (row_step, col_step),
        distance,
        tangent,
        np.nanmax(heights),
        grid.body.radius,
    )


def _steps(horizontal, to_south, to_east):
    """Rows and columns to go along a tangent vector, given those of one row and one column."""
    ss = np.einsum("...i,...i", to_south, to_south)
    se = np.einsum("...i,...i", to_south, to_east)
    ee = np.einsum("...i,...i", to_east, to_east)
    s = np.einsum("...i,...i", to_south, horizontal)
    e = np.einsum("...i,...i", to_east, horizontal)
    determinant = ss * ee - se * se
    return (ee * s - se * e) / determinant, (ss * e - se * s) / determinant


@numba.njit(cache=True, parallel=True)
def _march(heights, first, steps, distance, tangent, highest, radius):
    rows, cols = distance.shape
    is_lit = np.ones((rows, cols), np.bool_)
    for index in numba.prange(rows):
        row = np.int64(index)
        for col in range(cols):
            is_lit[row, col] = _sees_sun(
                heights,
                first[0] + row,
                first[1] + col,
                steps[0][row, col],
                steps[1][row, col],
                distance[row, col],
                tangent[row, col],
                highest,
                radius,
            )
    return is_lit


@numba.njit(cache=True)
def _sees_sun(heights, row, col, row_step, col_step, distance, tangent, highest, radius):
    rows, cols = heights.shape
    bend = (1.0 + 2.0 * tangent * tangent) / (2.0 * radius)
    if not distance > 0.0:  # the target stands at the zenith
        return True
    count = 1
    while True:
        there_row, there_col = row + count * row_step, col + count * col_step
        if not (0.0 <= there_row <= rows - 1 and 0.0 <= there_col <= cols - 1):
            return True
        gone = count * distance
        ray = heights[row, col] + gone * tangent + gone * gone * bend
        if not ray <= highest:  # also where the post itself is NaN
            return True
        r0, c0 = min(int(there_row), rows - 2), min(int(there_col), cols - 2)
        r, c = there_row - r0, there_col - c0
        terrain = (1.0 - r) * ((1.0 - c) * heights[r0, c0] + c * heights[r0, c0 + 1]) + r * (
            (1.0 - c) * heights[r0 + 1, c0] + c * heights[r0 + 1, c0 + 1]
        )
        if terrain > ray:
            return False
        count += 1
