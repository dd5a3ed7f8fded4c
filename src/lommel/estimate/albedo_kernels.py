r"""One compiled pass over all images of the albedo problem.

`accumulate` visits every image pixel once and leaves the best albedo for the given image parameters
and the sums of one Gauss-Newton step on those parameters, albedo eliminated. With the modelled
brightness :math:`A_{ij} M^k_{ij} + b^k`,

.. math:: M = T R (e^{-c_1 \alpha} + c_2) e^{-v_2 \theta^2 - v_4 \theta^4}

.. math:: A = \frac{\sum_k w M (I - b)}{\sum_k w M^2}, \qquad
          H = \sum w J^T J - \sum_{ij} \frac{(\sum_k w M J)^T (\sum_k w M J)}{\sum_k w M^2}

where J are the derivatives of the brightness by the image parameters (log exposure, haze in units
of the image's level) and by the shared ones (c1, c2, v2, v4). Loops run along rows of the grid;
sums are kept per block of rows, so that results do not depend on the number of threads.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

BLOCKS = 32  # blocks of rows, fixed so that sums do not depend on the number of threads
OWN = 2  # parameters of one image: log exposure, haze
SHARED = 4  # parameters of all images: c1, c2, v2, v4
PATCHES = 8  # patches along each side of an image, in which residuals are summed
SCALE_BINS, SCALE_LOW, SCALE_STEP = 512, -14.0, 1.0 / 32.0  # of log2 |residual|, up to 2^2
LEAST_SQUARES, HUBER, CAUCHY = 0, 1, 2
HUBER_TUNING, CAUCHY_TUNING = 1.345, 2.385  # 95 % efficient on Gaussian noise (Holland & Welsch)


class Samples(NamedTuple):
    """Pixels of all images, one image after the other, each row by row.

    Attributes
    ----------
    windows : int64 array (images, 4)
        First row, first column, rows and columns of each image in the grid.
    starts : int64 array (images,)
        Index of each image's first pixel in the arrays below.
    measured : float32 array (pixels,), image units
    reflectance : float32 array (pixels,)
        Of the model, without phase factor and falloff.
    phase : float32 array (pixels,), rad
    off_axis : float32 array (pixels,), rad squared
        Square of the angle between view ray and nadir at the camera.
    weight : float32 array (pixels,)
        Mask times feathering; 0 where the pixel is not used.
    precision : float32 array (pixels,), 1 / image units squared
        Inverse of the expected variance, up to one factor for all.
    """

    windows: np.ndarray
    starts: np.ndarray
    measured: np.ndarray
    reflectance: np.ndarray
    phase: np.ndarray
    off_axis: np.ndarray
    weight: np.ndarray
    precision: np.ndarray


class Pairs(NamedTuple):
    """Which images overlap: for image i its partners j >= i, itself included.

    Attributes
    ----------
    first : int64 array (images + 1,)
        Partners of i are ``second[first[i]:first[i + 1]]``.
    second : int64 array (pairs,)
    """

    first: np.ndarray
    second: np.ndarray


class Sums(NamedTuple):
    """What one pass leaves; the first axis counts blocks of rows.

    Attributes
    ----------
    own : array (blocks, images, 2, 2)
        w J^T J of each image's parameters, upper triangle, before elimination.
    pairs : array (blocks, pairs, 2, 2)
        What the elimination of the albedo subtracts.
    shared_pixels : array (blocks, pairs)
        Pixels that both images of a pair see.
    border : array (blocks, images, 2, 4)
        Image parameters against shared ones, eliminated.
    square : array (blocks, 4, 4)
        Shared parameters, upper triangle, eliminated.
    gradient : array (blocks, images, 2)
    shared_gradient : array (blocks, 4)
    means : array (blocks, images, 7)
        Sums of weight, weight I, weight M and of weight times the derivatives of M.
    patches : array (blocks, images, 8, 8)
        Sum of the scores (derivative of the loss) in each patch of each image.
    score_square : array (blocks,)
    histogram : array (blocks, SCALE_BINS)
        Sizes of residuals times the root of their precision.
    cost : array (blocks,)
    """

    own: np.ndarray
    pairs: np.ndarray
    shared_pixels: np.ndarray
    border: np.ndarray
    square: np.ndarray
    gradient: np.ndarray
    shared_gradient: np.ndarray
    means: np.ndarray
    patches: np.ndarray
    score_square: np.ndarray
    histogram: np.ndarray
    cost: np.ndarray


class State(NamedTuple):
    """Where the iteration stands.

    Attributes
    ----------
    exposure : float64 array (images,)
    haze : float64 array (images,), image units
    level : float64 array (images,), image units
        Unit in which haze is counted, so that it is of order 1.
    shared : float64 array (4,)
        c1 (per rad), c2, v2 (per rad^2), v4 (per rad^4).
    """

    exposure: np.ndarray
    haze: np.ndarray
    level: np.ndarray
    shared: np.ndarray


class Maps(NamedTuple):
    """Arrays on the grid, overwritten by each pass.

    Attributes
    ----------
    albedo : float64 array (rows, cols)
    information : float64 array (rows, cols)
        Sum of w M^2, the inverse variance of the albedo up to a factor.
    spread : float64 array (rows, cols)
        Sum of w^2 M^2 over the precision; over ``information`` squared, the variance of the albedo
        when residuals have unit variance (weights that fall to the border are not variances).
    scatter : float64 array (rows, cols)
        Sum of w times the squared residual.
    freedom : float64 array (rows, cols)
        Sum of weights times (n - 1) / n: the part of ``scatter`` that the fit leaves free.
    count : int32 array (rows, cols)
        Images that see the post.
    """

    albedo: np.ndarray
    information: np.ndarray
    spread: np.ndarray
    scatter: np.ndarray
    freedom: np.ndarray
    count: np.ndarray


class Work(NamedTuple):
    """Buffers of one row: per image (first axis) and per column (last axis)."""

    brightness: np.ndarray
    derivatives: np.ndarray
    w: np.ndarray
    u: np.ndarray
    u_shared: np.ndarray
    top: np.ndarray
    inverse: np.ndarray
    residual: np.ndarray


def empty_sums(images, pairs):
    """Sums of nothing."""
    return Sums(
        own=np.zeros((BLOCKS, images, OWN, OWN)),
        pairs=np.zeros((BLOCKS, pairs, OWN, OWN)),
        shared_pixels=np.zeros((BLOCKS, pairs)),
        border=np.zeros((BLOCKS, images, OWN, SHARED)),
        square=np.zeros((BLOCKS, SHARED, SHARED)),
        gradient=np.zeros((BLOCKS, images, OWN)),
        shared_gradient=np.zeros((BLOCKS, SHARED)),
        means=np.zeros((BLOCKS, images, 3 + SHARED)),
        patches=np.zeros((BLOCKS, images, PATCHES, PATCHES)),
        score_square=np.zeros(BLOCKS),
        histogram=np.zeros((BLOCKS, SCALE_BINS)),
        cost=np.zeros(BLOCKS),
    )


@njit(cache=True, error_model="numpy")
def robust_weight(x, loss):
    """Derivative of the loss by x, divided by x; x is a residual in standard errors."""
    if loss == HUBER:
        return min(1.0, HUBER_TUNING / max(abs(x), 1e-30))
    if loss == CAUCHY:
        return 1.0 / (1.0 + (x / CAUCHY_TUNING) ** 2)
    return 1.0


@njit(cache=True, error_model="numpy")
def robust_loss(x, loss):
    """Loss of a residual x in standard errors; x^2/2 near zero."""
    if loss == HUBER:
        size = abs(x)
        if size > HUBER_TUNING:
            return HUBER_TUNING * (size - 0.5 * HUBER_TUNING)
    elif loss == CAUCHY:
        return 0.5 * CAUCHY_TUNING**2 * np.log1p((x / CAUCHY_TUNING) ** 2)
    return 0.5 * x * x


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def dot3(a, b, c):
    """Sum of a b c over a row."""
    total = 0.0
    for j in range(a.size):
        total += a[j] * b[j] * c[j]
    return total


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _first_sweep(
    row, samples, images, state, scale, loss, work, albedo, bottom, spread, freedom, count
):
    """Brightness and robust weights of every image in this row, then the best albedo."""
    top = work.top
    top[:], bottom[:], spread[:], freedom[:], count[:] = 0.0, 0.0, 0.0, 0.0, 0
    for a in range(images.size):
        k = images[a]
        first, width, part = _place(samples, k, row)
        cols = slice(first, first + width)
        brightness = work.brightness[a, :width]
        brightness_row(
            samples.reflectance[part],
            samples.phase[part],
            samples.off_axis[part],
            state.exposure[k],
            state.shared,
            brightness,
            work.derivatives[a, :, :width],
        )
        weight = samples.weight[part]
        weigh_row(
            samples.measured[part],
            weight,
            samples.precision[part],
            brightness,
            state.haze[k],
            albedo[cols],
            scale,
            loss,
            work.w[a, :width],
            top[cols],
            bottom[cols],
            spread[cols],
        )
        _count(weight, count[cols], freedom[cols])
    for j in range(albedo.size):
        work.inverse[j] = 1.0 / bottom[j] if bottom[j] > 0.0 else 0.0
        albedo[j] = top[j] * work.inverse[j]
        if count[j] > 0:
            freedom[j] *= (count[j] - 1) / count[j]


@njit(cache=True, error_model="numpy")
def _count(weight, count, freedom):
    for j in range(weight.size):
        count[j] += weight[j] > 0.0
        freedom[j] += weight[j]


@njit(cache=True, error_model="numpy")
def _second_sweep(row, samples, images, state, scale, loss, work, sums, albedo, scatter, count):
    """Sums of every image in this row, given the albedo."""
    work.u_shared[:] = 0.0
    scatter[:] = 0.0
    for a in range(images.size):
        k = images[a]
        first, width, part = _place(samples, k, row)
        cols = slice(first, first + width)
        measured, weight = samples.measured[part], samples.weight[part]
        brightness, w = work.brightness[a, :width], work.w[a, :width]
        derivatives, residual = work.derivatives[a, :, :width], work.residual[:width]
        for j in range(width):
            residual[j] = albedo[first + j] * brightness[j] + state.haze[k] - measured[j]
        image_sums(
            brightness,
            derivatives,
            w,
            albedo[cols],
            residual,
            state.level[k],
            sums.own[k],
            sums.border[k],
            sums.gradient[k],
            work.u[a, :, :width],
        )
        shared_sums(
            brightness,
            derivatives,
            w,
            albedo[cols],
            residual,
            sums.square,
            sums.shared_gradient,
            work.u_shared[:, cols],
        )
        _mean_sums(measured, weight, brightness, derivatives, sums.means[k])
        patch = (row - samples.windows[k, 0]) * PATCHES // samples.windows[k, 2]
        cost, score_square = residual_sums(
            residual,
            weight,
            samples.precision[part],
            w,
            count[cols],
            scale,
            loss,
            scatter[cols],
            sums.histogram,
            sums.patches[k, patch],
        )
        sums.cost[0] += cost
        sums.score_square[0] += score_square


@njit(cache=True, error_model="numpy")
def _mean_sums(measured, weight, brightness, derivatives, means):
    for j in range(measured.size):
        means[0] += weight[j]
        means[1] += weight[j] * measured[j]
        means[2] += weight[j] * brightness[j]
        for g in range(SHARED):
            means[3 + g] += weight[j] * derivatives[g, j]


@njit(cache=True, error_model="numpy")
def _eliminate(samples, images, pairs, place_of, work, sums):
    """Subtract what the albedo takes up: products of w M J over every pair of images."""
    for g in range(SHARED):
        for h in range(g, SHARED):
            sums.square[g, h] -= dot3(work.u_shared[g], work.u_shared[h], work.inverse)
    for a in range(images.size):
        i = images[a]
        first, width = samples.windows[i, 1], samples.windows[i, 3]
        cols = slice(first, first + width)
        for p in range(OWN):
            for g in range(SHARED):
                sums.border[i, p, g] -= dot3(
                    work.u[a, p, :width], work.u_shared[g, cols], work.inverse[cols]
                )
        for pair in range(pairs.first[i], pairs.first[i + 1]):
            j = pairs.second[pair]
            b = place_of[j]
            if b < 0:
                continue
            low = max(first, samples.windows[j, 1])
            high = min(first + width, samples.windows[j, 1] + samples.windows[j, 3])
            if low >= high:
                continue
            inverse = work.inverse[low:high]
            for p in range(OWN):
                ui = work.u[a, p, low - first : high - first]
                for q in range(OWN):
                    start = low - samples.windows[j, 1]
                    uj = work.u[b, q, start : start + high - low]
                    sums.pairs[pair, p, q] += dot3(ui, uj, inverse)
            sums.shared_pixels[pair] += _seen_by_both(work, a, b, low, high, first, samples, j)


@njit(cache=True, error_model="numpy")
def _seen_by_both(work, a, b, low, high, first, samples, j):
    total = 0.0
    for col in range(low, high):
        total += (work.w[a, col - first] > 0.0) & (work.w[b, col - samples.windows[j, 1]] > 0.0)
    return total


@njit(cache=True, error_model="numpy")
def _place(samples, k, row):
    """First column, width and flat slice of image k in this row of the grid."""
    first, width = samples.windows[k, 1], samples.windows[k, 3]
    start = samples.starts[k] + (row - samples.windows[k, 0]) * width
    return first, width, slice(start, start + width)


@njit(cache=True, error_model="numpy")
def _images_in(row, samples, place_of):
    """Images whose window holds this row; ``place_of`` receives their place in the list."""
    images = np.empty(samples.starts.size, np.int64)
    count = 0
    for k in range(samples.starts.size):
        place_of[k] = -1
        if samples.windows[k, 0] <= row < samples.windows[k, 0] + samples.windows[k, 2]:
            images[count] = k
            place_of[k] = count
            count += 1
    return images[:count]


@njit(cache=True, error_model="numpy")
def _most_images(first_row, last_row, samples):
    """Largest number of images in one row of the block."""
    change = np.zeros(last_row - first_row + 1, np.int64)
    for k in range(samples.starts.size):
        low = max(samples.windows[k, 0], first_row)
        high = min(samples.windows[k, 0] + samples.windows[k, 2], last_row)
        if low < high:
            change[low - first_row] += 1
            change[high - first_row] -= 1
    return np.cumsum(change).max()


@njit(cache=True, error_model="numpy")
def _block_of(sums, block):
    """The sums of one block, as views."""
    return Sums(
        sums.own[block],
        sums.pairs[block],
        sums.shared_pixels[block],
        sums.border[block],
        sums.square[block],
        sums.gradient[block],
        sums.shared_gradient[block],
        sums.means[block],
        sums.patches[block],
        sums.score_square[block : block + 1],
        sums.histogram[block],
        sums.cost[block : block + 1],
    )


@njit(cache=True, error_model="numpy")
def _work_for(images, cols):
    return Work(
        np.zeros((images, cols)),
        np.zeros((images, SHARED, cols)),
        np.zeros((images, cols)),
        np.zeros((images, OWN, cols)),
        np.zeros((SHARED, cols)),
        np.zeros(cols),
        np.zeros(cols),
        np.zeros(cols),
    )


@njit(cache=True, parallel=True, error_model="numpy")
def accumulate(samples, pairs, state, scale, loss, maps, sums):
    """Visit every pixel once: best albedo, then the sums of a Gauss-Newton step.

    Parameters
    ----------
    samples : Samples
    pairs : Pairs
    state : State
        Image parameters and shared parameters.
    scale : float
        Standard error of a residual times the root of its precision.
    loss : int
        LEAST_SQUARES, HUBER or CAUCHY.
    maps : Maps
        The albedo of the pass before (robust weights come from it) is replaced.
    sums : Sums
        Zeros from `empty_sums`; added to.
    """
    rows, cols = maps.albedo.shape
    size = (rows + BLOCKS - 1) // BLOCKS
    for index in prange(BLOCKS):
        block = np.int64(index)
        first_row, last_row = block * size, min((block + 1) * size, rows)
        if first_row < last_row:
            here = _block_of(sums, block)
            work = _work_for(_most_images(first_row, last_row, samples), cols)
            place_of = np.empty(samples.starts.size, np.int64)
            for row in range(first_row, last_row):
                images = _images_in(row, samples, place_of)
                albedo, scatter, count = maps.albedo[row], maps.scatter[row], maps.count[row]
                _first_sweep(
                    row,
                    samples,
                    images,
                    state,
                    scale,
                    loss,
                    work,
                    albedo,
                    maps.information[row],
                    maps.spread[row],
                    maps.freedom[row],
                    count,
                )
                _second_sweep(
                    row, samples, images, state, scale, loss, work, here, albedo, scatter, count
                )
                _eliminate(samples, images, pairs, place_of, work, here)
