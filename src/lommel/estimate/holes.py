"""Holes in a DEM, closed so that a solver sees a surface everywhere.

Most callers want `fill_holes`.
"""

import numpy as np

from lommel.core.multigrid import NormalEquations, conjugate_gradients, threads_for
from lommel.core.normal_operator import apply_operator, coarse_shape, prolong_add, restrict

HOLD = 100.0  # how much stiffer known heights are held than the plate that closes holes
REDUCTION, MAX_CYCLES = 1e-3, 60  # of the linear solve: leaves 1 % of a hole's relief at most


def fill_holes(heights):
    """Heights whose holes are closed by the thin plate through their surroundings.

    Parameters
    ----------
    heights : float32 array (rows, cols), m; NaN in holes

    Returns
    -------
    heights : float32 array (rows, cols), m
    """
    known = np.isfinite(heights)
    if known.all():
        return heights
    start = _pull_push(heights)
    rows, cols = heights.shape
    none = np.zeros((rows - 1, cols - 1), np.float32)
    plate = np.array([1.0, 2.0, 1.0], np.float32)
    posts = np.where(known, np.float32(HOLD), np.float32(0))
    bending = np.empty_like(start)
    with threads_for(start.shape):
        massless = np.zeros((1, cols), np.float32)
        apply_operator(start, none, none, none, plate, np.float32(0), massless, bending)
    equations = NormalEquations((none, none, none), plate, [0.0], posts)
    change = conjugate_gradients(equations, -bending, REDUCTION, MAX_CYCLES).x
    return np.where(known, heights, start + change)


def _pull_push(heights):
    """Holes filled with means of known posts around, from coarse grids."""
    known = np.isfinite(heights)
    if known.all():
        return heights
    if min(heights.shape) <= 2:
        return np.where(known, heights, np.nanmean(heights)).astype(np.float32)
    total = np.zeros(coarse_shape(heights.shape), np.float32)
    weight = np.zeros_like(total)
    restrict(np.where(known, heights, np.float32(0)).astype(np.float32), total)
    restrict(known.astype(np.float32), weight)
    missing = weight == 0
    coarse = _pull_push(np.where(missing, np.nan, total / np.where(missing, 1, weight)))
    filled = np.zeros_like(heights)
    prolong_add(coarse.astype(np.float32), filled)
    return np.where(known, heights, filled)
