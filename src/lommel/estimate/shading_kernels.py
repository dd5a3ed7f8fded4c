r"""Compiled passes of shape from shading over the cells of one image.

`assemble` adds one image's share to the tensors of the normal equations; `predict` writes the
modelled image. Slowly varying geometry comes as planes on a lattice of nodes
(`lommel.estimate.surface`), interpolated row by row. All loops run along rows; sums are kept per
block of rows, so that results do not depend on the number of threads.
"""

import numpy as np
from numba import njit, prange

from lommel.core.normal_operator import BLOCK
from lommel.core.reflectance_kernels import reflectance_row
from lommel.estimate.sampling_kernels import FAST, expand_row

# Columns of the sums that `assemble` returns; f is albedo times reflectance, m the measured value
SUM_COST, SUM_W, SUM_F, SUM_FF, SUM_FM, SUM_M, SUM_RR, SUM_COUNT = range(8)


@njit(cache=True, nogil=True, fastmath=FAST)
def _slopes_row(upper, lower, inverse_row, inverse_col, p, q):
    half = np.float32(0.5)
    for c in range(p.size):
        p[c] = half * inverse_col * (upper[c + 1] - upper[c] + lower[c + 1] - lower[c])
        q[c] = half * inverse_row * (lower[c] - upper[c] + lower[c + 1] - upper[c + 1])


@njit(cache=True, nogil=True, fastmath=FAST)
def _normal_row(p, q, gram, length, dp, dq):
    """Inverse length of the normal, and the relative change of its length with the slopes."""
    one, two = np.float32(1.0), np.float32(2.0)
    g00, g01, g02, g11, g12, g22 = gram[0], gram[1], gram[2], gram[3], gram[4], gram[5]
    for c in range(p.size):
        square = (
            g00[c]
            + two * (p[c] * g01[c] + q[c] * (g02[c] + p[c] * g12[c]))
            + p[c] * p[c] * g11[c]
            + q[c] * q[c] * g22[c]
        )
        inverse = one / square
        length[c] = np.sqrt(inverse)
        dp[c] = (g01[c] + p[c] * g11[c] + q[c] * g12[c]) * inverse
        dq[c] = (g02[c] + p[c] * g12[c] + q[c] * g22[c]) * inverse


@njit(cache=True, nogil=True, fastmath=FAST)
def _cosine_row(p, q, terms, length, dp, dq, cosine, cosine_p, cosine_q):
    """Cosine between normal and a direction, and its derivatives with respect to the slopes."""
    t0, t1, t2 = terms[0], terms[1], terms[2]
    for c in range(p.size):
        value = (t0[c] + p[c] * t1[c] + q[c] * t2[c]) * length[c]
        cosine[c] = value
        cosine_p[c] = t1[c] * length[c] - value * dp[c]
        cosine_q[c] = t2[c] * length[c] - value * dq[c]


@njit(cache=True, nogil=True, fastmath=FAST)
def _cosines_row(r, u, gram, light, step, inverse_row, inverse_col, work):
    """Cosines of one row of cells, with derivatives, in work[16:22]; phase terms in work[14:16]."""
    p, q, length, dp, dq = work[3], work[4], work[5], work[6], work[7]
    row = (r + 0.5) / step
    _slopes_row(u[r], u[r + 1], inverse_row, inverse_col, p, q)
    for k in range(6):
        expand_row(gram[k], row, step, work[8 + k])
    _normal_row(p, q, work[8:14], length, dp, dq)
    for k in range(8):
        expand_row(light[k], row, step, work[8 + k])
    _cosine_row(p, q, work[8:11], length, dp, dq, work[16], work[17], work[18])
    _cosine_row(p, q, work[11:14], length, dp, dq, work[19], work[20], work[21])


@njit(cache=True, nogil=True, fastmath=FAST)
def _shade_row(r, u, gram, light, step, inverse_row, inverse_col, kind, parameters, law, work):
    """Reflectance of one row of cells in work[0], its slope derivatives in work[1] and work[2]."""
    _cosines_row(r, u, gram, light, step, inverse_row, inverse_col, work)
    if kind < 0:  # a law without compiled twin: evaluated on whole arrays beforehand
        work[0] = law[0, r]
        work[22] = law[1, r]
        work[23] = law[2, r]
    else:
        reflectance_row(
            kind, parameters, work[16], work[19], work[14], work[15], work[0], work[22], work[23]
        )
    by_incidence, by_emission = work[22], work[23]
    for c in range(u.shape[1] - 1):
        work[1, c] = by_incidence[c] * work[17, c] + by_emission[c] * work[20, c]
        work[2, c] = by_incidence[c] * work[18, c] + by_emission[c] * work[21, c]


WORK_ROWS = 24


@njit(cache=True, nogil=True, fastmath={"contract", "nsz", "reassoc"})
def _accumulate_row(
    reflectance, by_p, by_q, albedo, measured, image, tensors, gradient, shared, r, sums
):
    """Add one row of one image to tensors, gradients and sums."""
    gpp, gpq, gqq = tensors[0, r], tensors[1, r], tensors[2, r]
    gp, gq = gradient[0, r], gradient[1, r]
    ap, aq, aa, ga = shared[0, r], shared[1, r], shared[2, r], shared[3, r]
    exposure, haze, weight, softness = image[0], image[1], image[2], image[3]
    zero, one, two = np.float32(0.0), np.float32(1.0), np.float32(2.0)
    cost = total = sf = sff = sfm = sm = srr = 0.0
    count = 0
    for c in range(measured.size):
        is_used = (measured[c] == measured[c]) & (reflectance[c] > zero)
        m = measured[c] if is_used else zero
        f = albedo[c] * reflectance[c]
        gain = exposure * albedo[c]
        residual = exposure * f + haze - m
        root = np.sqrt(one + softness * residual * residual)
        w = weight / root if is_used else zero
        # pseudo-Huber: 2 (root - 1) / softness, written so that softness 0 gives the square
        cost += (two * weight / (one + root) if is_used else zero) * residual * residual
        rp, rq = gain * by_p[c], gain * by_q[c]
        gpp[c] += w * rp * rp
        gpq[c] += w * rp * rq
        gqq[c] += w * rq * rq
        gp[c] += w * residual * rp
        gq[c] += w * residual * rq
        by_albedo = exposure * reflectance[c]
        ap[c] += w * by_albedo * rp
        aq[c] += w * by_albedo * rq
        aa[c] += w * by_albedo * by_albedo
        ga[c] += w * by_albedo * residual
        total += w
        sf += w * f
        sff += w * f * f
        sfm += w * f * m
        sm += w * m
        srr += w * residual * residual
        count += is_used
    sums[0] += cost
    sums[1] += total
    sums[2] += sf
    sums[3] += sff
    sums[4] += sfm
    sums[5] += sm
    sums[6] += srr
    sums[7] += count


@njit(cache=True, parallel=True)
def assemble(
    u,
    gram,
    light,
    step,
    spacing,
    kind,
    parameters,
    law,
    albedo,
    measured,
    image,
    tensors,
    gradient,
    shared,
):
    """Add one image to the normal equations.

    Parameters
    ----------
    u : float32 array (rows, cols), m
    gram : float32 array (6, node_rows, node_cols)
        Inner products of the normal's vectors, `Frame.gram`.
    light : float32 array (8, node_rows, node_cols)
        The normal's vectors along the light (3) and the view (3); phase share and factor.
    step : int
        Cells from node to node.
    spacing : float32 array (2,), m
        Between rows and between columns.
    kind, parameters
        Of the reflectance model.
    law : float32 array (3, rows - 1, cols - 1) or (3, 1, 1)
        Reflectance and its derivatives for a model without compiled twin (kind -1), from
        `cosines` and the model itself; any array of three dimensions otherwise.
    albedo, measured : float32 array (rows - 1, cols - 1)
        ``measured`` is NaN where the cell is not used.
    image : float32 array (4,)
        Exposure, haze, weight 1 / noise^2, softness 1 / scale^2 of the pseudo-Huber loss.
    tensors : float32 array (3, rows - 1, cols - 1)
        Gpp, Gpq, Gqq per squared difference of heights; added to.
    gradient : float32 array (2, rows - 1, cols - 1)
        Of half the cost with respect to the differences; added to.
    shared : float32 array (4, rows - 1, cols - 1)
        What the cell's albedo shares with the differences: the two mixed second derivatives, its
        own second derivative, and its gradient; added to.

    Returns
    -------
    sums : float64 array (8,)
        See the ``SUM_`` names.
    """
    rows, cols = measured.shape
    blocks = (rows + BLOCK - 1) // BLOCK
    sums = np.zeros((blocks, 8))
    inverse_row, inverse_col = np.float32(1.0) / spacing[0], np.float32(1.0) / spacing[1]
    for block in prange(blocks):
        first = np.int64(block) * BLOCK
        work = np.empty((WORK_ROWS, cols), np.float32)
        for r in range(first, min(first + BLOCK, rows)):
            _shade_row(
                r, u, gram, light, step, inverse_row, inverse_col, kind, parameters, law, work
            )
            for c in range(cols):  # per difference of heights from here on
                work[1, c] *= inverse_col
                work[2, c] *= inverse_row
            _accumulate_row(
                work[0],
                work[1],
                work[2],
                albedo[r],
                measured[r],
                image,
                tensors,
                gradient,
                shared,
                r,
                sums[np.int64(block)],
            )
    return sums.sum(axis=0)


@njit(cache=True, parallel=True, fastmath=FAST)
def eliminate_albedo(albedo, tensors, gradient, shared, precision, best):
    r"""Take each cell's own albedo out of the normal equations.

    Albedo is expected to be 1 with a standard error whose inverse square is ``precision``. Its
    best value for given slopes is closed-form, and what is left is

    .. math:: G - c c^T / h, \quad g - c\, g_A / h, \quad Q - g_A^2 / 2 h,
              \quad h = h_{AA} + \mathrm{precision}

    Parameters
    ----------
    albedo : float32 array (rows - 1, cols - 1)
        As assumed by `assemble`.
    tensors, gradient, shared
        As `assemble` leaves them; the first two are changed.
    precision : float
    best : float32 array (rows - 1, cols - 1)
        Gets the albedo that fits best.

    Returns
    -------
    cost : float
        What expectation and elimination add to twice the cost; negative or zero on balance
        when the assumed albedo was the best already.
    """
    rows, cols = albedo.shape
    costs = np.zeros(rows)
    for i in prange(rows):
        r = np.int64(i)
        ap, aq, aa, ga = shared[0, r], shared[1, r], shared[2, r], shared[3, r]
        cost = 0.0
        for c in range(cols):
            off = albedo[r, c] - np.float32(1.0)
            inverse = np.float32(1.0) / max(aa[c] + precision, np.float32(1e-30))
            slope = ga[c] + precision * off
            tensors[0, r, c] -= ap[c] * ap[c] * inverse
            tensors[1, r, c] -= ap[c] * aq[c] * inverse
            tensors[2, r, c] -= aq[c] * aq[c] * inverse
            gradient[0, r, c] -= ap[c] * slope * inverse
            gradient[1, r, c] -= aq[c] * slope * inverse
            best[r, c] = albedo[r, c] - slope * inverse
            cost += precision * off * off - slope * slope * inverse
        costs[r] = cost
    return costs.sum()


@njit(cache=True, parallel=True)
def predict(u, gram, light, step, spacing, kind, parameters, law, albedo, image, out):
    """Write the modelled image on the cells; arguments as in `assemble`."""
    rows, cols = out.shape
    inverse_row, inverse_col = np.float32(1.0) / spacing[0], np.float32(1.0) / spacing[1]
    for block in prange((rows + BLOCK - 1) // BLOCK):
        first = np.int64(block) * BLOCK
        work = np.empty((WORK_ROWS, cols), np.float32)
        for r in range(first, min(first + BLOCK, rows)):
            _shade_row(
                r, u, gram, light, step, inverse_row, inverse_col, kind, parameters, law, work
            )
            for c in range(cols):
                out[r, c] = image[0] * albedo[r, c] * work[0, c] + image[1]


@njit(cache=True, parallel=True)
def cosines(u, gram, light, step, spacing, out):
    """Cosines of incidence and emission, phase share and factor: ``out`` (4, rows - 1, cols - 1).

    For models without compiled twin, whose share is the phase itself. Other arguments as in
    `assemble`.
    """
    rows, cols = out.shape[1:]
    inverse_row, inverse_col = np.float32(1.0) / spacing[0], np.float32(1.0) / spacing[1]
    for block in prange((rows + BLOCK - 1) // BLOCK):
        first = np.int64(block) * BLOCK
        work = np.empty((WORK_ROWS, cols), np.float32)
        for r in range(first, min(first + BLOCK, rows)):
            _cosines_row(r, u, gram, light, step, inverse_row, inverse_col, work)
            out[0, r], out[1, r] = work[16], work[19]
            out[2, r], out[3, r] = work[14], work[15]
