"""Ways that terrain bars: to the Sun (cast shadow) and to a camera (hidden ground).

From every post a ray marches towards its target, one post at a time, until terrain rises above it
or it has cleared the highest terrain of the grid. The ray's height over the reference sphere grows
as ``d tan(e) + d^2 (1 + 2 tan(e)^2) / 2 R``: distance d, elevation e of the target, radius R.
Most callers want `sunlit`.
"""

import numba
import numpy as np
from scipy.ndimage import maximum_filter

from lommel.scene.body import to_xyz
from lommel.scene.geometry import unit
from lommel.scene.grid import Window

BLOCK = 16  # posts along each side of the squares whose highest post lets rays leap
REACH_LIMIT = 3000  # posts; terrain farther away casts no shadow and hides nothing


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
        _highest_around(heights),
        (window.row, window.col),
        (row_step, col_step),
        distance,
        tangent,
        np.nanmax(heights),
        grid.body.radius,
    )


def reach(grid, window, relief, *positions):
    r"""A window with the terrain that may stand between its posts and Sun or camera.

    A ray that starts on the lowest ground clears the highest after the distance

    .. math:: d = R \left( \sqrt{\tan^2 e + 2 h / R} - \tan e \right)

    with the body's radius R, the relief h and the elevation e of its target.

    Parameters
    ----------
    grid : Grid
    window : Window
    relief : float, m
        Highest minus lowest terrain around.
    positions : array (3,), m, body-fixed
        Sun and camera.

    Returns
    -------
    window : Window
        Widened by 1 to `REACH_LIMIT` posts on each side, also beyond the grid.
    """
    radius = grid.body.radius
    row = window.row + np.array([0.0, 0.5, 1.0])[:, None] * (window.rows - 1)
    col = window.col + np.array([0.0, 0.5, 1.0]) * (window.cols - 1)
    here = to_xyz(grid.body, *grid.lonlat_at(row, col), 0.0)
    to_south = to_xyz(grid.body, *grid.lonlat_at(row + 1, col), 0.0) - here
    to_east = to_xyz(grid.body, *grid.lonlat_at(row, col + 1), 0.0) - here
    least, most = np.full(2, -1.0), np.full(2, 1.0)
    for position in positions:
        target, up = unit(np.asarray(position, float) - here), here / radius
        sine = np.einsum("...i,...i", target, up)
        cosine = np.sqrt(np.maximum(1.0 - sine**2, 1e-12))
        tangent = np.maximum(sine / cosine, 0.0)
        distance = radius * (np.sqrt(tangent**2 + 2.0 * relief / radius) - tangent)
        way = (distance / cosine)[..., None] * (target - sine[..., None] * up)
        steps = np.stack(_steps(way, to_south, to_east)).reshape(2, -1)
        steps = steps[:, np.isfinite(steps).all(axis=0)]
        least = np.minimum(least, steps.min(axis=1, initial=0.0) - 1.0)
        most = np.maximum(most, steps.max(axis=1, initial=0.0) + 1.0)
    least = np.clip(np.floor(least), -REACH_LIMIT, 0).astype(int)
    most = np.clip(np.ceil(most), 0, REACH_LIMIT).astype(int)
    first = np.array([window.row, window.col]) + least
    return Window(*first.tolist(), *(np.array(window.shape) + most - least).tolist())


def _steps(horizontal, to_south, to_east):
    """Rows and columns to go along a tangent vector, given those of one row and one column."""
    ss = np.einsum("...i,...i", to_south, to_south)
    se = np.einsum("...i,...i", to_south, to_east)
    ee = np.einsum("...i,...i", to_east, to_east)
    s = np.einsum("...i,...i", to_south, horizontal)
    e = np.einsum("...i,...i", to_east, horizontal)
    determinant = ss * ee - se * se
    return (ee * s - se * e) / determinant, (ss * e - se * s) / determinant


def _highest_around(heights):
    """Highest terrain in each square of `BLOCK` posts and the eight around it."""
    rows, cols = (-(-size // BLOCK) for size in heights.shape)
    padded = np.full((rows * BLOCK, cols * BLOCK), -np.inf, heights.dtype)
    padded[: heights.shape[0], : heights.shape[1]] = np.where(
        np.isfinite(heights), heights, -np.inf
    )
    squares = padded.reshape(rows, BLOCK, cols, BLOCK).max(axis=(1, 3))
    return maximum_filter(squares, 3, mode="nearest")


@numba.njit(cache=True, parallel=True)
def _march(heights, around, first, steps, distance, tangent, highest, radius):
    rows, cols = distance.shape
    is_lit = np.ones((rows, cols), np.bool_)
    for index in numba.prange(rows):
        row = np.int64(index)
        for col in range(cols):
            is_lit[row, col] = _sees_sun(
                heights,
                around,
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
def _sees_sun(heights, around, row, col, row_step, col_step, distance, tangent, highest, radius):
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
        if tangent >= 0.0 and ray > around[int(there_row) // BLOCK, int(there_col) // BLOCK]:
            count += BLOCK  # the ray rises: nothing up to there reaches it
            continue
        r0, c0 = min(int(there_row), rows - 2), min(int(there_col), cols - 2)
        r, c = there_row - r0, there_col - c0
        terrain = (1.0 - r) * ((1.0 - c) * heights[r0, c0] + c * heights[r0, c0 + 1]) + r * (
            (1.0 - c) * heights[r0 + 1, c0] + c * heights[r0 + 1, c0 + 1]
        )
        if terrain > ray:
            return False
        count += 1
