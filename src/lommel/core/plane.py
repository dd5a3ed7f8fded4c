"""The mean plane of a field, taken out: what exposures and the tilt of a surface share.

An exposure and the tilt of a whole surface towards the Sun do the same to an image; what tells
them apart is the initial DEM, whose mean plane is kept. Most callers want `remove_plane`.
"""

import numpy as np
from numba import njit, prange


@njit(cache=True, parallel=True, fastmath={"contract", "reassoc", "nsz"})
def remove_plane(values):
    """Subtract the mean and the mean tilts, in place: an orthogonal projection.

    Sums are taken row by row in float64, so they do not depend on the number of threads.

    Parameters
    ----------
    values : float32 array (rows, cols)
    """
    rows, cols = values.shape
    sums, tilts = np.empty(rows), np.empty(rows)
    middle = 0.5 * (cols - 1)
    for i in prange(rows):
        row = values[i]
        total, tilt = 0.0, 0.0
        for c in range(cols):
            total += np.float64(row[c])
            tilt += (c - middle) * np.float64(row[c])
        sums[i], tilts[i] = total, tilt
    mean, along, across = 0.0, 0.0, 0.0
    for i in range(rows):
        mean += sums[i]
        across += (i - 0.5 * (rows - 1)) * sums[i]
        along += tilts[i]
    mean /= rows * cols
    along /= max(rows * (cols * (cols * cols - 1.0)) / 12.0, 1.0)
    across /= max(cols * (rows * (rows * rows - 1.0)) / 12.0, 1.0)
    for i in prange(rows):
        row = values[i]
        start = mean + (np.float64(i) - 0.5 * (rows - 1)) * across
        for c in range(cols):
            row[c] -= np.float32(start + (c - middle) * along)
