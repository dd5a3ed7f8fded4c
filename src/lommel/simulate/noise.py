"""Random numbers and smooth random surfaces that are functions of the place.

Every number comes from a hash of a key and of a lattice cell, so that any part of a surface, at any
spacing, can be made without the rest. Most callers want `spline_noise` and `uniform_hash`.
"""

import numpy as np
from scipy.sparse import csr_array

SPLINE_RMS = 151 / 315  # rms of a cubic B-spline surface whose nodes have variance 1
SPLINE_SLOPE = 1.18  # its rms slope along one axis, times node distance over rms


def spline_noise(key, distance, x, y):
    """A smooth random surface: cubic B-splines over a lattice of random nodes.

    Parameters
    ----------
    key : tuple of int
        Seed and stream; the same key gives the same surface.
    distance : float, m
        Between nodes.
    x, y : array (cols,), (rows,), m

    Returns
    -------
    noise : array (rows, cols), dimensionless
        Mean 0, rms 1 over large areas.
    """
    first_col, across = _spline_weights(x / distance)
    first_row, along = _spline_weights(y / distance)
    rows = first_row + np.arange(along.shape[1])
    cols = first_col + np.arange(across.shape[1])
    nodes = np.sqrt(12.0) * (uniform_hash(key, rows[:, None], cols[None, :]) - 0.5)
    return (along @ (across @ nodes.T).T) / SPLINE_RMS


def _spline_weights(position):
    """First node that matters, and the sparse matrix (positions, nodes) of B-spline weights."""
    node = np.floor(position).astype(np.int64)
    t = position - node
    weights = np.stack(
        [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=-1
    )
    first = node.min() - 1
    columns = node[:, None] - 1 - first + np.arange(4)
    starts = 4 * np.arange(position.size + 1)
    shape = position.size, int(columns.max()) + 1
    return first, csr_array((weights.ravel() / 6.0, columns.ravel(), starts), shape=shape)


def uniform_hash(key, row, col):
    """Numbers in [0, 1) that depend on a key and a lattice cell only (splitmix64).

    Parameters
    ----------
    key : tuple of int
    row, col : int array (...)

    Returns
    -------
    numbers : array (...)
    """
    row, col = np.broadcast_arrays(row, col)
    state = np.zeros(row.shape, np.uint64)
    for value in (*(np.full(row.shape, item) for item in key), row, col):
        state = state ^ value.astype(np.int64).view(np.uint64)
        state = state + np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state = state ^ (state >> np.uint64(31))
    return (state >> np.uint64(11)) * 2.0**-53
