"""Compiled steps of the albedo pass along one row of one image.

`lommel.estimate.albedo_kernels` says what the sums mean and calls these row by row.
"""

import numpy as np
from numba import njit

from lommel.estimate.albedo_arrays import PATCHES, SCALE_BINS, SCALE_LOW, SCALE_STEP, SHARED

LEAST_SQUARES, HUBER, CAUCHY = 0, 1, 2
HUBER_TUNING, CAUCHY_TUNING = 1.345, 2.385  # 95 % efficient on Gaussian noise (Holland & Welsch)
LOSSES = {"least-squares": LEAST_SQUARES, "huber": HUBER, "cauchy": CAUCHY}

# For functions that only compiled code calls: a third less time to compile. The type stubs of
# Numba do not know these two options.
inner = njit(  # type: ignore[call-overload]
    error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True
)


@inner
def count_row(weight, count, freedom):
    """Add a row of an image to the number of images and to the sum of weights."""
    for j in range(weight.size):
        count[j] += weight[j] > 0.0
        freedom[j] += weight[j]


@inner
def mean_sums(measured, weight, brightness, derivatives, means):
    """Sums of weight, weight times I, times M and times the derivatives of M, along a row."""
    for j in range(measured.size):
        means[0] += weight[j]
        means[1] += weight[j] * measured[j]
        means[2] += weight[j] * brightness[j]
        for g in range(SHARED):
            means[3 + g] += weight[j] * derivatives[g, j]


@inner
def robust_weight(x, loss):
    """Derivative of the loss by x, divided by x; x is a residual in standard errors."""
    if loss == HUBER:
        return min(1.0, HUBER_TUNING / max(abs(x), 1e-30))
    if loss == CAUCHY:
        return 1.0 / (1.0 + (x / CAUCHY_TUNING) ** 2)
    return 1.0


@inner
def robust_loss(x, loss):
    """Loss of a residual x in standard errors; x^2/2 near zero."""
    if loss == HUBER:
        size = abs(x)
        if size > HUBER_TUNING:
            return HUBER_TUNING * (size - 0.5 * HUBER_TUNING)
    elif loss == CAUCHY:
        return 0.5 * CAUCHY_TUNING**2 * np.log1p((x / CAUCHY_TUNING) ** 2)
    return 0.5 * x * x


@inner
def brightness_row(reflectance, phase, off_axis, exposure, shared, brightness, derivatives):
    """Brightness of albedo 1 along a row, and its derivatives by c1, c2, v2 and v4.

    Parameters
    ----------
    reflectance, phase, off_axis : float32 array (cols,)
    exposure : float
    shared : float64 array (4,)
        c1 (per rad), c2, v2 (per rad^2), v4 (per rad^4).
    brightness : float64 array (cols,)
    derivatives : float64 array (4, cols)
        Overwritten, as is ``brightness``.
    """
    c1, c2, v2, v4 = shared[0], shared[1], shared[2], shared[3]
    for j in range(reflectance.size):
        square = off_axis[j]
        decay = np.exp(-c1 * phase[j])
        level = exposure * reflectance[j] * np.exp(-square * (v2 + v4 * square))
        brightness[j] = level * (decay + c2)
        derivatives[0, j] = -phase[j] * decay * level
        derivatives[1, j] = level
        derivatives[2, j] = -square * brightness[j]
        derivatives[3, j] = -square * square * brightness[j]


@inner
def weigh_row(
    measured, weight, precision, brightness, haze, albedo, scale, loss, w, top, bottom, spread
):
    """Robust weights of a row from the last albedo; adds to the sums per post."""
    for j in range(measured.size):
        value = measured[j] - haze
        x = (albedo[j] * brightness[j] - value) * np.sqrt(precision[j]) / scale
        share = weight[j] * robust_weight(x, loss)
        w[j] = share * precision[j]
        top[j] += w[j] * brightness[j] * value
        bottom[j] += w[j] * brightness[j] * brightness[j]
        spread[j] += share * w[j] * brightness[j] * brightness[j]


@inner
def image_sums(brightness, derivatives, w, albedo, residual, level, own, border, gradient, u):
    """Sums of one image along a row before elimination; ``u`` receives w M J per pixel."""
    for j in range(brightness.size):
        jt = albedo[j] * brightness[j]
        wt, wb = w[j] * jt, w[j] * level
        own[0, 0] += wt * jt
        own[0, 1] += wt * level
        own[1, 1] += wb * level
        gradient[0] += wt * residual[j]
        gradient[1] += wb * residual[j]
        u[0, j] = wt * brightness[j]
        u[1, j] = wb * brightness[j]
        for g in range(SHARED):
            border[0, g] += wt * albedo[j] * derivatives[g, j]
            border[1, g] += wb * albedo[j] * derivatives[g, j]


@inner
def shared_sums(brightness, derivatives, w, albedo, residual, square, gradient, u):
    """Sums of the shared parameters along a row; adds w M J of this image to ``u``."""
    for g in range(SHARED):
        for j in range(brightness.size):
            wg = w[j] * albedo[j] * derivatives[g, j]
            gradient[g] += wg * residual[j]
            u[g, j] += wg * brightness[j]
        for h in range(g, SHARED):
            for j in range(brightness.size):
                square[g, h] += w[j] * albedo[j] ** 2 * derivatives[g, j] * derivatives[h, j]


@inner
def dot3(a, b, c):
    """Sum of a b c over a row."""
    total = 0.0
    for j in range(a.size):
        total += a[j] * b[j] * c[j]
    return total


@inner
def residual_sums(residual, weight, precision, w, count, scale, loss, scatter, histogram, patches):
    """Cost and squared scores of a row; adds to the scatter per pixel and to the sums per patch.

    The histogram counts pixels seen at least twice, residuals enlarged by sqrt(n / (n - 1))
    because the albedo was fitted to n values.
    """
    cost, score_square = 0.0, 0.0
    cols = residual.size
    for j in range(cols):
        if weight[j] <= 0.0:
            continue
        size = residual[j] * np.sqrt(precision[j])
        x = size / scale
        cost += weight[j] * robust_loss(x, loss)
        score = weight[j] * robust_weight(x, loss) * x
        score_square += score * score
        patches[j * PATCHES // cols] += score
        scatter[j] += w[j] * residual[j] * residual[j]
        if count[j] > 1:
            enlarged = abs(size) * np.sqrt(count[j] / (count[j] - 1.0))
            place = np.int64((np.log2(max(enlarged, 1e-30)) - SCALE_LOW) / SCALE_STEP)
            histogram[min(max(place, 0), SCALE_BINS - 1)] += 1.0
    return cost, score_square
