"""Which posts of a DEM were measured, and which were interpolated between measurements.

Altimeters measure along tracks; what lies between is usually filled with the planes of a
triangulation. Such a post is no evidence: the height in the middle of a plane may be off by
hundreds of metres. A plane shows in the second differences. They vanish along at least one
direction, where measured terrain, rough in every direction, is at most some times smoother in one
than in another. Most callers want `measured_posts`.
"""

import numpy as np

# As many as it takes for thin triangles, however they lie
DIRECTIONS = tuple(
    (row, col)
    for row, col in ((0, 1), (1, 0), (1, 1), (1, 2), (2, 1), (1, 3), (3, 1))
    for col in ({col, -col} if row * col else {col})
)
ENOUGH_DIRECTIONS = 6  # beside holes and the border not every direction can be looked at
# Least over largest second difference. Rounding leaves a thousandth in a plane; measured terrain,
# even blurred over 25 posts, exceeds the first bound at 97 % of its posts. Once that has shown that
# a DEM was interpolated, the second one also takes the flanks of the planes' edges for planes.
PLANE, NEARLY_PLANE = 0.01, 0.05
# Share of the 3x3 posts around a measured one that do not lie in planes: the edges between the
# triangles reach a third, tracks and their flanks more than half
TOGETHER = 0.5
SPARSE = 0.5  # share of measured posts from which a DEM counts as measured all over


def measured_posts(heights):
    """True where a DEM holds measurements; None where that is (nearly) everywhere.

    Parameters
    ----------
    heights : float32 array (rows, cols), m; NaN in holes

    Returns
    -------
    measured : bool array (rows, cols) or None
    """
    ratio = _evenness(heights)
    known = np.isfinite(heights)
    if (_share_around(ratio > PLANE) > TOGETHER).sum() > SPARSE * known.sum():
        return None
    measured = known & (_share_around(ratio > NEARLY_PLANE) > TOGETHER)
    return measured if measured.any() else None


def _evenness(heights):
    """Least over largest second difference of all directions; 0 where too few are known."""
    least = np.full(heights.shape, np.inf, np.float32)
    largest = np.zeros(heights.shape, np.float32)
    count = np.zeros(heights.shape, np.uint8)
    for direction in DIRECTIONS:
        ahead, behind = (_shifted(heights, direction, sign) for sign in (1, -1))
        length = direction[0] ** 2 + direction[1] ** 2
        bend = np.abs(ahead - 2 * heights + behind) / np.float32(length)
        along = bend + _shifted(bend, direction, 1) + _shifted(bend, direction, -1)
        least, largest = np.fmin(least, along), np.fmax(largest, along)  # NaN beyond the border
        count += np.isfinite(along)
    is_known = (count >= ENOUGH_DIRECTIONS) & (largest > 0)
    return np.where(is_known, least, 0) / np.where(is_known, largest, 1)


def _shifted(values, direction, sign):
    """Values of the neighbours in a direction; NaN beyond the border."""
    out = np.full_like(values, np.nan)
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
