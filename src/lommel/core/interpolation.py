"""Values between the pixels of an image, one place at a time, and between coarse posts."""

import numpy as np
from numba import njit, prange

FAST = {"contract", "nsz"}


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST)
def _cubic_weights(t):
    """Catmull-Rom weights of four neighbours, at a fraction t behind the second one."""
    s = np.float32(1.0) - t
    half = np.float32(0.5)
    outer_left = -half * t * s * s
    outer_right = -half * s * t * t
    inner_right = t * (half + t * (np.float32(2.0) - np.float32(1.5) * t))
    return (
        outer_left,
        np.float32(1.0) - outer_left - outer_right - inner_right,
        inner_right,
        outer_right,
    )


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST)
def sample_linear(image, line, sample):
    """Value between pixels, bilinear; NaN outside and beside missing pixels; see `sample_cubic`."""
    lines, samples = image.shape
    if not (line >= 0 and sample >= 0 and line <= lines - 1 and sample <= samples - 1):
        return np.float32(np.nan)
    i = min(np.int64(line), lines - 2)
    j = min(np.int64(sample), samples - 2)
    v, h = np.float32(line - i), np.float32(sample - j)
    upper = image[i, j] + h * (image[i, j + 1] - image[i, j])
    lower = image[i + 1, j] + h * (image[i + 1, j + 1] - image[i + 1, j])
    return upper + v * (lower - upper)


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST)
def sample_cubic(image, line, sample):
    """Value between pixels: cubic; bilinear beside missing pixels and the border; NaN outside.

    Parameters
    ----------
    image : float32 array (lines, samples)
        NaN where missing.
    line, sample : float32
        Array coordinates: the first pixel's centre is (0, 0).
    """
    lines, samples = image.shape
    if not (line >= 0 and sample >= 0 and line <= lines - 1 and sample <= samples - 1):
        return np.float32(np.nan)
    i = min(np.int64(line), lines - 2)
    j = min(np.int64(sample), samples - 2)
    v, h = np.float32(line - i), np.float32(sample - j)
    if 0 < i < lines - 2 and 0 < j < samples - 2:
        h0, h1, h2, h3 = _cubic_weights(h)
        v0, v1, v2, v3 = _cubic_weights(v)
        a, b, c, d = image[i - 1], image[i], image[i + 1], image[i + 2]
        value = (
            v0 * (h0 * a[j - 1] + h1 * a[j] + h2 * a[j + 1] + h3 * a[j + 2])
            + v1 * (h0 * b[j - 1] + h1 * b[j] + h2 * b[j + 1] + h3 * b[j + 2])
            + v2 * (h0 * c[j - 1] + h1 * c[j] + h2 * c[j + 1] + h3 * c[j + 2])
            + v3 * (h0 * d[j - 1] + h1 * d[j] + h2 * d[j + 1] + h3 * d[j + 2])
        )
        if not np.isnan(value):
            return value
    return sample_linear(image, line, sample)


@njit(cache=True, parallel=True, error_model="numpy", fastmath=FAST)
def refine_spline(coefficients, stride, first_row, first_col, out):
    """A cubic spline on coarse posts, at the posts between them.

    Parameters
    ----------
    coefficients : float32 array (coarse rows, coarse cols)
        Of B-splines that are mirrored at the ends, as of `scipy.ndimage.spline_filter`.
    stride : int
        Posts per coarse post.
    first_row, first_col : int
        Post (0, 0) of the result, counted from the first coarse post.
    out : float32 array (rows, cols)
    """
    weights = np.empty((stride, 4), np.float32)
    for phase in range(stride):
        t = phase / stride
        s = 1.0 - t
        weights[phase, 0] = s * s * s / 6
        weights[phase, 1] = (4 - 6 * t * t + 3 * t * t * t) / 6
        weights[phase, 2] = (4 - 6 * s * s + 3 * s * s * s) / 6
        weights[phase, 3] = t * t * t / 6
    rows, cols = coefficients.shape
    for i in prange(out.shape[0]):
        post = first_row + np.int64(i)
        w, r = weights[post % stride], post // stride
        above, here = coefficients[abs(r - 1)], coefficients[r]
        below = coefficients[rows - 1 - abs(rows - 2 - r)]
        beyond = coefficients[rows - 1 - abs(rows - 3 - r)]
        line = np.empty(cols + 3, np.float32)
        for c in range(cols):
            line[c + 1] = w[0] * above[c] + w[1] * here[c] + w[2] * below[c] + w[3] * beyond[c]
        line[0], line[cols + 1], line[cols + 2] = line[2], line[cols - 1], line[cols - 2]
        for j in range(out.shape[1]):
            c, phase = (first_col + j) // stride, (first_col + j) % stride
            v = weights[phase]
            out[i, j] = (
                v[0] * line[c] + v[1] * line[c + 1] + v[2] * line[c + 2] + v[3] * line[c + 3]
            )
