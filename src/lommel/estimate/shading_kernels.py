r"""Compiled passes of shape from shading over the cells of all images.

`assemble` reduces the images to one 2x2 tensor and one 2-vector per cell; `predict` writes a
modelled image. Slowly varying geometry comes as planes on a lattice of nodes
(`lommel.estimate.surface`), which are linear along a row between two nodes. So a row of cells is
worked off in segments from node to node: what varies within a segment stays in a small buffer,
from one short loop to the next, and only the results go to memory. Sums are kept per block of rows,
so that results do not depend on the number of threads.
"""

import numpy as np
from numba import njit, prange

from lommel.core.normal_operator import BLOCK
from lommel.core.reflectance_kernels import blend, multiple_scattering, power

# Columns of the sums that `assemble` returns; f is albedo times reflectance, m the measured value
SUM_COST, SUM_W, SUM_F, SUM_FF, SUM_FM, SUM_M, SUM_RR, SUM_COUNT = range(8)

LONGEST = 64  # cells from node to node; 24 rows of the buffer then stay in a core's first cache
FAST = {"contract", "nsz", "reassoc", "arcp"}

# Places in the buffer of one segment, all in one array at constant offsets: only so does the
# compiler know that they do not overlap, and turn the loops into vector instructions.
P, Q, LENGTH, LENGTH_P, LENGTH_Q = (k * LONGEST for k in range(5))
COS_I, COS_IP, COS_IQ, COS_E, COS_EP, COS_EQ, SHARE, FACTOR = (k * LONGEST for k in range(5, 13))
R, R_I, R_E = (k * LONGEST for k in range(13, 16))
GPP, GPQ, GQQ, GP, GQ, AP, AQ, AA, GA = (k * LONGEST for k in range(16, 25))
BUFFER = 25 * LONGEST


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _lines(planes, i, t, j, step, out):
    """Value at the first cell and change per cell, of each plane along one segment of a row."""
    for k in range(planes.shape[0]):
        left = planes[k, i, j] + t * (planes[k, i + 1, j] - planes[k, i, j])
        right = planes[k, i, j + 1] + t * (planes[k, i + 1, j + 1] - planes[k, i, j + 1])
        slope = (right - left) / step
        out[2 * k] = left + np.float32(0.5) * slope
        out[2 * k + 1] = slope


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _normals(upper, lower, gram, inverse_row, inverse_col, w, n):
    """Slopes, inverse length of the normal, and the relative change of its length with them."""
    half, one, two = np.float32(0.5), np.float32(1.0), np.float32(2.0)
    for c in range(n):
        x = np.float32(c)
        p = half * inverse_col * (upper[c + 1] - upper[c] + lower[c + 1] - lower[c])
        q = half * inverse_row * (lower[c] - upper[c] + lower[c + 1] - upper[c + 1])
        g00, g01, g02 = gram[0] + x * gram[1], gram[2] + x * gram[3], gram[4] + x * gram[5]
        g11, g12, g22 = gram[6] + x * gram[7], gram[8] + x * gram[9], gram[10] + x * gram[11]
        square = g00 + two * (p * g01 + q * (g02 + p * g12)) + p * p * g11 + q * q * g22
        inverse = one / square
        w[P + c] = p
        w[Q + c] = q
        w[LENGTH + c] = np.sqrt(inverse)
        w[LENGTH_P + c] = (g01 + p * g11 + q * g12) * inverse
        w[LENGTH_Q + c] = (g02 + p * g12 + q * g22) * inverse


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _cosines(light, w, n):
    """Cosines of incidence and emission with their derivatives by the slopes; phase terms."""
    for c in range(n):
        x = np.float32(c)
        p, q, length, by_p, by_q = (
            w[P + c],
            w[Q + c],
            w[LENGTH + c],
            w[LENGTH_P + c],
            w[LENGTH_Q + c],
        )
        l1, l2 = light[2] + x * light[3], light[4] + x * light[5]
        v1, v2 = light[8] + x * light[9], light[10] + x * light[11]
        cos_i = (light[0] + x * light[1] + p * l1 + q * l2) * length
        cos_e = (light[6] + x * light[7] + p * v1 + q * v2) * length
        w[COS_I + c] = cos_i
        w[COS_IP + c] = l1 * length - cos_i * by_p
        w[COS_IQ + c] = l2 * length - cos_i * by_q
        w[COS_E + c] = cos_e
        w[COS_EP + c] = v1 * length - cos_e * by_p
        w[COS_EQ + c] = v2 * length - cos_e * by_q
        w[SHARE + c] = light[12] + x * light[13]
        w[FACTOR + c] = light[14] + x * light[15]


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _reflectances(kind, parameters, law, w, n):
    """Reflectance and its derivatives by the cosines."""
    k = np.float32(parameters[0]) if kind >= 0 else np.float32(0.0)
    if kind == 0:
        for c in range(n):
            w[R + c], w[R_I + c], w[R_E + c] = blend(
                k, w[COS_I + c], w[COS_E + c], w[SHARE + c], w[FACTOR + c]
            )
    elif kind == 1:
        for c in range(n):
            w[R + c], w[R_I + c], w[R_E + c] = power(
                k, w[COS_I + c], w[COS_E + c], w[SHARE + c], w[FACTOR + c]
            )
    elif kind == 2:
        for c in range(n):
            w[R + c], w[R_I + c], w[R_E + c] = multiple_scattering(
                k, w[COS_I + c], w[COS_E + c], w[SHARE + c], w[FACTOR + c]
            )
    else:  # a law without compiled twin: evaluated on whole arrays beforehand
        for c in range(n):
            w[R + c], w[R_I + c], w[R_E + c] = law[0, c], law[1, c], law[2, c]


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _accumulate(albedo, measured, image, inverse_row, inverse_col, w, n, sums):
    """Add one image to the segment's tensors, gradients and sums."""
    exposure, haze, weight, softness = image[0], image[1], image[2], image[3]
    zero, one, two = np.float32(0.0), np.float32(1.0), np.float32(2.0)
    cost = total = sf = sff = sfm = sm = srr = count = zero
    for c in range(n):
        r = w[R + c]
        is_used = (measured[c] == measured[c]) & (r > zero)
        m = measured[c] if is_used else zero
        f = albedo[c] * r
        residual = exposure * f + haze - m
        root = np.sqrt(one + softness * residual * residual)
        weighted = weight / root if is_used else zero
        # pseudo-Huber: 2 (root - 1) / softness, written so that softness 0 gives the square
        cost += (two * weight / (one + root) if is_used else zero) * residual * residual
        gain_p, gain_q = exposure * albedo[c] * inverse_col, exposure * albedo[c] * inverse_row
        rp = gain_p * (w[R_I + c] * w[COS_IP + c] + w[R_E + c] * w[COS_EP + c])
        rq = gain_q * (w[R_I + c] * w[COS_IQ + c] + w[R_E + c] * w[COS_EQ + c])
        by_albedo = exposure * r
        wp, wq, wa = weighted * rp, weighted * rq, weighted * by_albedo
        w[GPP + c] += wp * rp
        w[GPQ + c] += wp * rq
        w[GQQ + c] += wq * rq
        w[GP + c] += wp * residual
        w[GQ + c] += wq * residual
        w[AP + c] += wa * rp
        w[AQ + c] += wa * rq
        w[AA + c] += wa * by_albedo
        w[GA + c] += wa * residual
        total += weighted
        sf += weighted * f
        sff += weighted * f * f
        sfm += weighted * f * m
        sm += weighted * m
        srr += weighted * residual * residual
        count += one if is_used else zero
    sums[0] += cost
    sums[1] += total
    sums[2] += sf
    sums[3] += sff
    sums[4] += sfm
    sums[5] += sm
    sums[6] += srr
    sums[7] += count


@njit(cache=True, nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _eliminate_albedo(albedo, precision, w, n, best):
    r"""Take each cell's own albedo out of the segment's tensors and gradients.

    Albedo is expected to be 1 with a standard error whose inverse square is ``precision``. Its
    best value for given slopes is closed-form, and what is left is

    .. math:: G - c c^T / h, \quad g - c\, g_A / h, \quad Q - g_A^2 / 2 h,
              \quad h = h_{AA} + \mathrm{precision}

    Returns what expectation and elimination add to twice the cost; negative or zero on balance
    when the assumed albedo was the best already.
    """
    cost, one, tiny = np.float32(0.0), np.float32(1.0), np.float32(1e-30)
    for c in range(n):
        off = albedo[c] - one
        inverse = one / max(w[AA + c] + precision, tiny)
        slope = w[GA + c] + precision * off
        ap, aq = w[AP + c], w[AQ + c]
        w[GPP + c] -= ap * ap * inverse
        w[GPQ + c] -= ap * aq * inverse
        w[GQQ + c] -= aq * aq * inverse
        w[GP + c] -= ap * slope * inverse
        w[GQ + c] -= aq * slope * inverse
        w[GA + c] = slope * inverse
        cost += precision * off * off - slope * slope * inverse
    for c in range(n):
        best[c] = albedo[c] - w[GA + c]
    return cost


@njit(cache=True, nogil=True, forceinline=True)
def _start(slope, w, n):
    for k in range(GPP, BUFFER):
        w[k] = np.float32(0.0)
    for c in range(n):
        w[GPP + c] = slope[0]
        w[GQQ + c] = slope[1]


@njit(cache=True, nogil=True, forceinline=True)
def _copy(w, start, out, n):
    for c in range(n):
        out[c] = w[start + c]


@njit(cache=True, parallel=True, fastmath=FAST, error_model="numpy")
def assemble(
    u,
    gram,
    lights,
    step,
    spacing,
    kind,
    parameters,
    laws,
    albedo,
    cells,
    images,
    precision,
    slope,
    tensors,
    gradient,
    best,
    coupling,
):
    """Reduce the images to the normal equations of the slopes.

    Parameters
    ----------
    u : float32 array (rows, cols), m
    gram : float32 array (6, node_rows, node_cols)
        Inner products of the normal's vectors, `Frame.gram`.
    lights : float32 array (images, 8, node_rows, node_cols)
        The normal's vectors along the light (3) and the view (3); phase share and factor.
    step : int
        Cells from node to node, `LONGEST` at most.
    spacing : float32 array (2,), m
        Between rows and between columns.
    kind, parameters
        Of the reflectance model.
    laws : float32 array (images, 3, rows - 1, cols - 1) or (images, 3, 1, 1)
        Reflectance and its derivatives for a model without compiled twin (kind -1), from
        `cosines` and the model itself; not read otherwise.
    albedo : float32 array (rows - 1, cols - 1)
    cells : float32 array (images, rows - 1, cols - 1)
        Measured brightness, NaN where the cell is not used.
    images : float32 array (images, 4)
        Exposure, haze, weight 1 / noise^2, softness 1 / scale^2 of the pseudo-Huber loss.
    precision : float
        Inverse square of the standard error of each cell's albedo about 1, for which the equations
        hold with the albedo eliminated; negative when the albedo is known.
    slope : float32 array (2,)
        Added to Gpp and to Gqq.
    tensors : float32 array (3, rows - 1, cols - 1)
        Get Gpp, Gpq, Gqq per squared difference of heights.
    gradient : float32 array (2, rows - 1, cols - 1)
        Gets that of half the cost with respect to the differences.
    best : float32 array (rows - 1, cols - 1)
        Gets the albedo that fits best; not written when it is known.
    coupling : float32 array (4, rows - 1, cols - 1) or (4, 0, 0)
        Gets what ties the albedo to the differences of heights, its own second derivative and its
        gradient, for equations that keep it as an unknown.

    Returns
    -------
    sums : float64 array (images, 8)
        See the ``SUM_`` names.
    cost : float
        What the albedo's expectation and its elimination add to twice the cost.
    """
    count, rows, cols = cells.shape
    blocks = (rows + BLOCK - 1) // BLOCK
    sums, costs = np.zeros((blocks, count, 8)), np.zeros(blocks)
    inverse_row, inverse_col = np.float32(1.0) / spacing[0], np.float32(1.0) / spacing[1]
    for i in prange(blocks):
        block = np.int64(i)
        w = np.empty(BUFFER, np.float32)
        gram_lines, light_lines = np.empty(12, np.float32), np.empty(16, np.float32)
        for r in range(block * BLOCK, min(block * BLOCK + BLOCK, rows)):
            node = min(np.int64(r / step), gram.shape[1] - 2)
            t = np.float32((r + 0.5) / step - node)
            for j in range((cols + step - 1) // step):
                a, n = j * step, min(step, cols - j * step)
                _lines(gram, node, t, j, np.float32(step), gram_lines)
                _normals(u[r, a:], u[r + 1, a:], gram_lines, inverse_row, inverse_col, w, n)
                _start(slope, w, n)
                for k in range(count):
                    _lines(lights[k], node, t, j, np.float32(step), light_lines)
                    _cosines(light_lines, w, n)
                    law = laws[k, :, r, a:] if kind < 0 else laws[k, :, 0, :]
                    _reflectances(kind, parameters, law, w, n)
                    _accumulate(
                        albedo[r, a:],
                        cells[k, r, a:],
                        images[k],
                        inverse_row,
                        inverse_col,
                        w,
                        n,
                        sums[block, k],
                    )
                if precision >= 0:
                    costs[block] += _eliminate_albedo(albedo[r, a:], precision, w, n, best[r, a:])
                for k in range(4 if coupling.shape[1] else 0):
                    _copy(w, AP + k * LONGEST, coupling[k, r, a:], n)
                _copy(w, GPP, tensors[0, r, a:], n)
                _copy(w, GPQ, tensors[1, r, a:], n)
                _copy(w, GQQ, tensors[2, r, a:], n)
                _copy(w, GP, gradient[0, r, a:], n)
                _copy(w, GQ, gradient[1, r, a:], n)
    return sums.sum(axis=0), costs.sum()


@njit(cache=True, parallel=True, fastmath=FAST, error_model="numpy")
def predict(u, gram, light, step, spacing, kind, parameters, law, albedo, image, out):
    """Write one modelled image, ``out`` (rows - 1, cols - 1); arguments as in `assemble`."""
    rows, cols = out.shape
    inverse_row, inverse_col = np.float32(1.0) / spacing[0], np.float32(1.0) / spacing[1]
    for i in prange((rows + BLOCK - 1) // BLOCK):
        first = np.int64(i) * BLOCK
        w = np.empty(BUFFER, np.float32)
        gram_lines, light_lines = np.empty(12, np.float32), np.empty(16, np.float32)
        for r in range(first, min(first + BLOCK, rows)):
            node = min(np.int64(r / step), gram.shape[1] - 2)
            t = np.float32((r + 0.5) / step - node)
            for j in range((cols + step - 1) // step):
                a, n = j * step, min(step, cols - j * step)
                _lines(gram, node, t, j, np.float32(step), gram_lines)
                _lines(light, node, t, j, np.float32(step), light_lines)
                _normals(u[r, a:], u[r + 1, a:], gram_lines, inverse_row, inverse_col, w, n)
                _cosines(light_lines, w, n)
                at = law[:, r, a:] if kind < 0 else law[:, 0, :]
                _reflectances(kind, parameters, at, w, n)
                for c in range(n):
                    out[r, a + c] = image[0] * albedo[r, a + c] * w[R + c] + image[1]


@njit(cache=True, parallel=True, fastmath=FAST, error_model="numpy")
def cosines(u, gram, light, step, spacing, out):
    """Cosines of incidence and emission, phase share and factor: ``out`` (4, rows - 1, cols - 1).

    For models without compiled twin, whose share is the phase itself. Other arguments as in
    `assemble`.
    """
    rows, cols = out.shape[1:]
    inverse_row, inverse_col = np.float32(1.0) / spacing[0], np.float32(1.0) / spacing[1]
    for i in prange((rows + BLOCK - 1) // BLOCK):
        first = np.int64(i) * BLOCK
        w = np.empty(BUFFER, np.float32)
        gram_lines, light_lines = np.empty(12, np.float32), np.empty(16, np.float32)
        for r in range(first, min(first + BLOCK, rows)):
            node = min(np.int64(r / step), gram.shape[1] - 2)
            t = np.float32((r + 0.5) / step - node)
            for j in range((cols + step - 1) // step):
                a, n = j * step, min(step, cols - j * step)
                _lines(gram, node, t, j, np.float32(step), gram_lines)
                _lines(light, node, t, j, np.float32(step), light_lines)
                _normals(u[r, a:], u[r + 1, a:], gram_lines, inverse_row, inverse_col, w, n)
                _cosines(light_lines, w, n)
                _copy(w, COS_I, out[0, r, a:], n)
                _copy(w, COS_E, out[1, r, a:], n)
                _copy(w, SHARE, out[2, r, a:], n)
                _copy(w, FACTOR, out[3, r, a:], n)
