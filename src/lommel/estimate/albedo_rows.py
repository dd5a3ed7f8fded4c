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
    error_model="numpy",
    fastmath={"reassoc", "contract", "nsz"},  # sums in vector registers; NaN keeps its meaning
    forceinline=True,
    no_cpython_wrapper=True,
    no_cfunc_wrapper=True,
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
    total, image, model = 0.0, 0.0, 0.0
    by0, by1, by2, by3 = 0.0, 0.0, 0.0, 0.0
    d0, d1, d2, d3 = derivatives[0], derivatives[1], derivatives[2], derivatives[3]
    for j in range(measured.size):
        total += weight[j]
        image += weight[j] * measured[j]
        model += weight[j] * brightness[j]
        by0 += weight[j] * d0[j]
        by1 += weight[j] * d1[j]
        by2 += weight[j] * d2[j]
        by3 += weight[j] * d3[j]
    for place, value in enumerate((total, image, model, by0, by1, by2, by3)):
        means[place] += value


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
def brightness_row(
    reflectance, phase, off_axis, exposure, shared, is_step, brightness, derivatives
):
    """Brightness of albedo 1 along a row, and for a step its derivatives by c1, c2, v2 and v4.

    Parameters
    ----------
    reflectance, phase, off_axis : float32 array (cols,)
    exposure : float
    shared : float64 array (4,)
        c1 (per rad), c2, v2 (per rad^2), v4 (per rad^4).
    is_step : bool
    brightness : float64 array (cols,)
        Overwritten.
    derivatives : float64 array (4, cols)
        Overwritten for a step.
    """
    c1, c2, v2, v4 = shared[0], shared[1], shared[2], shared[3]
    for j in range(reflectance.size):
        square = off_axis[j]
        decay = np.exp(-c1 * phase[j])
        level = exposure * reflectance[j] * np.exp(-square * (v2 + v4 * square))
        brightness[j] = level * (decay + c2)
        if is_step:
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
    tt, t1, one, rt, r1 = 0.0, 0.0, 0.0, 0.0, 0.0
    u0, u1 = u[0], u[1]
    for j in range(brightness.size):
        jt = albedo[j] * brightness[j]
        wt, wb = w[j] * jt, w[j] * level
        tt += wt * jt
        t1 += wt
        one += w[j]
        rt += wt * residual[j]
        r1 += w[j] * residual[j]
        u0[j] = wt * brightness[j]
        u1[j] = wb * brightness[j]
    own[0, 0] += tt
    own[0, 1] += level * t1
    own[1, 1] += level * level * one
    gradient[0] += rt
    gradient[1] += level * r1
    for g in range(SHARED):
        by_exposure, by_haze = 0.0, 0.0
        derivative = derivatives[g]
        for j in range(brightness.size):
            term = w[j] * albedo[j] * derivative[j]
            by_exposure += term * albedo[j] * brightness[j]
            by_haze += term
        border[0, g] += by_exposure
        border[1, g] += level * by_haze


@inner
def shared_sums(brightness, derivatives, w, albedo, residual, square, gradient, u):
    """Sums of the shared parameters along a row; adds w M J of this image to ``u``."""
    for g in range(SHARED):
        total = 0.0
        derivative, out = derivatives[g], u[g]
        for j in range(brightness.size):
            wg = w[j] * albedo[j] * derivative[j]
            total += wg * residual[j]
            out[j] += wg * brightness[j]
        gradient[g] += total
        for h in range(g, SHARED):
            total = 0.0
            other = derivatives[h]
            for j in range(brightness.size):
                total += w[j] * albedo[j] * albedo[j] * derivative[j] * other[j]
            square[g, h] += total


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
