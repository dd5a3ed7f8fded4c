"""Which posts of a DEM were measured, and which were interpolated between measurements.

Altimeters measure along tracks; what lies between is usually filled with the planes of a
triangulation. Such a post is no evidence: the height in the middle of a plane may be off by
hundreds of metres. It shows by lying on a straight line with its neighbours, in one direction at
least, to the last digits of its height; measured terrain bends in every direction.
Most callers want `measured_posts`.
"""

from itertools import product

import numpy as np
from scipy.ndimage import label

# As many as it takes for thin triangles, however they lie
SLANTS = ((0, 1), (1, 1), (1, 2), (1, 3), (1, 4), (1, 5), (1, 7), (2, 3), (2, 5), (2, 7), (3, 4))
DIRECTIONS = sorted(
    {(row, sign * col) for slant in SLANTS for row, col in (slant, slant[::-1]) for sign in (1, -1)}
    - {(0, -1)}
)
ROUNDING = 32  # float32 steps of the largest height: a bend that arithmetic alone leaves in a plane
STRAIGHT = 2  # of a post's three bends in a row: the third may cross the edge of a triangle
# Least over largest bend; beside the edges of triangles arithmetic leaves more than rounding, and
# a kink many times more. Longer directions look too far from the post.
EVEN, EVEN_REACH = 0.05, 3
ENOUGH_DIRECTIONS = 8  # beside holes and the border not every direction can be looked at
# Share of the 3x3 posts around a measured one that bend: the edges between the triangles reach a
# third, tracks and their flanks more than half
TOGETHER = 0.6
TRACK = 12  # posts that hang together at least; where thin triangles meet in a fan, fewer do
SPARSE = 0.5  # share of measured posts from which a DEM counts as measured all over
WINDOWS, SIDE = 3, 96  # windows along rows and columns, and their posts, that are looked at first
REPEATED = 0.5  # distinct heights per post below which heights are rounded, in whole metres say


def measured_posts(heights):
    """True where a DEM holds measurements; None where that is (nearly) everywhere.

    Parameters
    ----------
    heights : float32 array (rows, cols), m; NaN in holes

    Returns
    -------
    measured : bool array (rows, cols) or None
        None as well where heights are rounded so much that planes and terrain look alike.
    """
    windows = [_bending(window) for window in _windows(heights)]
    known = sum(np.isfinite(window).sum() for window in _windows(heights))
    if sum(window.sum() for window in windows) > SPARSE * known or _are_rounded(heights):
        return None
    measured = _tracks(_bending(heights))
    share = measured.sum() / max(np.isfinite(heights).sum(), 1)
    return measured if 0 < share <= SPARSE else None


def _windows(heights):
    """Windows spread evenly over a DEM, or all of it where it is not larger."""
    starts = (np.linspace(0, max(size - SIDE, 0), WINDOWS).astype(int) for size in heights.shape)
    return [heights[row : row + SIDE, col : col + SIDE] for row, col in product(*starts)]


def _are_rounded(heights):
    known = heights[np.isfinite(heights)]
    sample = known[:: max(known.size // (WINDOWS * SIDE) ** 2, 1)]
    return np.unique(sample).size < REPEATED * sample.size


def _bending(heights):
    """Posts that bend in every direction, or about as much in one as in another."""
    known = np.isfinite(heights)
    rounding = np.float32(ROUNDING) * np.spacing(np.float32(np.abs(heights[known]).max(initial=0)))
    bends = known.copy()
    least = np.full(heights.shape, np.inf, np.float32)
    largest = np.zeros(heights.shape, np.float32)
    count = np.zeros(heights.shape, np.uint8)
    for direction in DIRECTIONS:
        ahead, behind = (_shifted(heights, direction, sign, np.nan) for sign in (1, -1))
        bend = np.abs(ahead - 2 * heights + behind)
        straight = (bend <= rounding).astype(np.uint8)
        bends &= sum(_beside(straight, direction, 0)) < STRAIGHT
        if max(map(abs, direction)) <= EVEN_REACH:
            along = sum(_beside(bend, direction, np.nan)) / (direction[0] ** 2 + direction[1] ** 2)
            least, largest = np.fmin(least, along), np.fmax(largest, along)
            count += np.isfinite(along)
    bends |= known & (least > EVEN * largest) & (count >= ENOUGH_DIRECTIONS)
    return known & (_share_around(bends) > TOGETHER)


def _beside(values, direction, beyond):
    """The neighbours' values on both sides, and the post's own between them."""
    return [_shifted(values, direction, sign, beyond) for sign in (-1, 0, 1)]


def _tracks(posts):
    """Posts that hang together with others, also across corners."""
    number, _ = label(posts, np.ones((3, 3)))
    return posts & (np.bincount(number.ravel()) >= TRACK)[number]


def _shifted(values, direction, sign, beyond):
    """Values of the neighbours in a direction, and ``beyond`` where the border cuts them off."""
    out = np.full_like(values, beyond)
    rows, cols = values.shape
    row, col = sign * direction[0], sign * direction[1]
    to = (slice(max(-row, 0), rows - max(row, 0)), slice(max(-col, 0), cols - max(col, 0)))
    of = (slice(max(row, 0), rows - max(-row, 0)), slice(max(col, 0), cols - max(-col, 0)))
    out[to] = values[of]
    return out


def _share_around(mask):
    """Share of the 3x3 posts around each one that are True."""
    padded = np.pad(mask, 1).astype(np.float32)
    by_row = padded[:-2] + padded[1:-1] + padded[2:]
    return (by_row[:, :-2] + by_row[:, 1:-1] + by_row[:, 2:]) / 9
