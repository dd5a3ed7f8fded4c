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


def plane_between(coarse, stride, shape):
    """The mean plane of the posts between coarse ones, at the coarse ones.

    Coarse posts along the border stand for fewer posts than the others, and some beyond it for
    none, so their own mean plane is another one.

    Parameters
    ----------
    coarse : float32 array (coarse rows, coarse cols)
        Every so manieth post; the posts between are interpolated linearly.
    stride : int
    shape : tuple of int
        Posts of the field.

    Returns
    -------
    plane : float64 array (coarse rows, coarse cols)
        What `remove_plane` would take from the interpolated field.
    """
    (rows, row_tilt, row_place), (cols, col_tilt, col_place) = (
        _between(count, stride, size) for count, size in zip(coarse.shape, shape, strict=True)
    )
    along_cols = coarse @ cols, coarse @ col_tilt
    mean = rows @ along_cols[0] / (shape[0] * shape[1])
    down = row_tilt @ along_cols[0] / max(shape[1] * shape[0] * (shape[0] ** 2 - 1.0) / 12, 1.0)
    right = rows @ along_cols[1] / max(shape[0] * shape[1] * (shape[1] ** 2 - 1.0) / 12, 1.0)
    return mean + down * row_place[:, None] + right * col_place


def _between(count, stride, size):
    """For coarse posts along a side: sums of 1 and of the place of posts by their shares in them.

    The third is their own place; places are counted from the middle of the field, in posts.
    """
    post, middle = np.arange(size), 0.5 * (size - 1)
    before, share = post // stride, post % stride / stride
    places = np.concatenate([before, np.minimum(before + 1, count - 1)])
    shares = np.concatenate([1 - share, share])
    weights = (shares, shares * np.tile(post - middle, 2))
    sums = [np.bincount(places, values, minlength=count) for values in weights]
    return *sums, stride * np.arange(count) - middle
