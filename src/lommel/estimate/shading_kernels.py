r"""Compiled passes of shape from shading over the cells of one image.

`sample_cells` brings an image onto the cells of the current surface; `assemble` adds one image's
share to the tensors of the normal equations; `predict` writes the modelled image. Slowly varying
geometry comes as planes on a lattice of nodes (`lommel.estimate.surface`), interpolated row by
row. All loops run along rows; sums are kept per block of rows, so that results do not depend on
the number of threads.
"""

import numpy as np
from numba import njit, prange

from lommel.core.normal_operator import BLOCK
from lommel.core.reflectance_kernels import reflectance_row

# Columns of the sums that `assemble` returns; f is albedo times reflectance, m the measured value
SUM_COST, SUM_W, SUM_F, SUM_FF, SUM_FM, SUM_M, SUM_RR, SUM_COUNT = range(8)
FAST = {"contract", "nsz"}


@njit(cache=True, nogil=True, fastmath=FAST)
def expand_row(plane, row, step, out):
    """Interpolate a lattice plane along one row of cells.

    Parameters
    ----------
    plane : float32 array (node_rows, node_cols)
    row : float
        Of the cells' centres, in node units.
    step : int
        Cells from node to node.
    out : float32 array (cols,)
    """
    i = min(np.int64(row), plane.shape[0] - 2)
    t = np.float32(row - i)
    upper, lower = plane[i], plane[i + 1]
    for j in range(plane.shape[1] - 1):
        first = j * step
        left = upper[j] + t * (lower[j] - upper[j])
        right = upper[j + 1] + t * (lower[j + 1] - upper[j + 1])
        slope = (right - left) / np.float32(step)
        start = left + np.float32(0.5) * slope
        part = out[first : min(first + step, out.size)]
        for c in range(part.size):
            part[c] = start + slope * np.float32(c)


@njit(cache=True, nogil=True, fastmath=FAST)
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


@njit(cache=True, nogil=True, fastmath=FAST)
def _sample(image, line, sample):
    """Cubic interpolation; bilinear beside missing pixels and the border; NaN outside."""
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
    upper = image[i, j] + h * (image[i, j + 1] - image[i, j])
    lower = image[i + 1, j] + h * (image[i + 1, j + 1] - image[i + 1, j])
    return upper + v * (lower - upper)


@njit(cache=True, parallel=True, fastmath=FAST)
def sample_cells(image, planes, step, u, reference, out):
    """Bring an image onto the cells of a surface.

    Parameters
    ----------
    image : float32 array (lines, samples)
        NaN where missing.
    planes : float32 array (6, node_rows, node_cols)
        Array coordinates of the surface point: line and sample at u = 0, both per metre of u,
        and both per metre that the point lies above the surface an orthoimage was made with.
    step : int
        Cells from node to node.
    u : float32 array (rows, cols), m
    reference : float32 array (rows, cols), m, or (1, 1)
        That surface, on posts; of size 1 when the image is a raw one.
    out : float32 array (rows - 1, cols - 1)
    """
    quarter = np.float32(0.25)
    for i in prange(out.shape[0]):
        r = np.int64(i)
        cols = out.shape[1]
        at = np.empty((6, cols), np.float32)
        for k in range(6):
            expand_row(planes[k], (r + 0.5) / step, step, at[k])
        upper, lower = u[r], u[r + 1]
        for c in range(cols):
            h = quarter * (upper[c] + upper[c + 1] + lower[c] + lower[c + 1])
            line, sample = at[0, c] + at[2, c] * h, at[1, c] + at[3, c] * h
            if reference.size > 1:  # the view ray meets the orthoimage's own surface elsewhere
                row, col = r + np.float32(0.5) + at[2, c] * h, c + np.float32(0.5) + at[3, c] * h
                rise_row = rise_col = np.float32(0.0)
                for _ in range(2):
                    there = _sample(reference, row + rise_row, col + rise_col)
                    rise = h - there if not np.isnan(there) else np.float32(0.0)
                    rise_row, rise_col = at[4, c] * rise, at[5, c] * rise
                line, sample = line + rise_row, sample + rise_col
            out[r, c] = _sample(image, line, sample)


@njit(cache=True, parallel=True, fastmath=FAST)
def cast_shadow(u, planes, step, highest, out):
    """True on cells from which the way to the Sun meets terrain.

    Parameters
    ----------
    u : float32 array (rows, cols), m
    planes : float32 array (2, node_rows, node_cols), posts per m
        How far a ray to the Sun goes along rows and columns while it rises by 1 m.
    step : int
        Cells from node to node.
    highest : float32, m
        Of ``u``.
    out : bool array (rows - 1, cols - 1)
    """
    rows, cols = u.shape
    for i in prange(rows - 1):
        r = np.int64(i)
        at = np.empty((2, cols - 1), np.float32)
        for k in range(2):
            expand_row(planes[k], (r + 0.5) / step, step, at[k])
        for c in range(cols - 1):
            out[r, c] = _meets_terrain(u, r, c, at[0, c], at[1, c], highest)


@njit(cache=True, nogil=True, fastmath=FAST)
def _meets_terrain(u, r, c, per_metre_row, per_metre_col, highest):
    """Follow the ray from a cell's centre, one post along the longer axis at a time."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    length = max(abs(per_metre_row), abs(per_metre_col))
    if length == 0:
        return False
    rise = np.float32(1.0) / length
    d_row, d_col = per_metre_row * rise, per_metre_col * rise
    height = quarter * (u[r, c] + u[r, c + 1] + u[r + 1, c] + u[r + 1, c + 1])
    row, col = r + half, c + half
    while True:
        row, col, height = row + d_row, col + d_col, height + rise
        inside = 0 <= row and 0 <= col and row <= u.shape[0] - 1 and col <= u.shape[1] - 1
        if not inside or height > highest:
            return False
        i, j = min(np.int64(row), u.shape[0] - 2), min(np.int64(col), u.shape[1] - 2)
        v, h = np.float32(row - i), np.float32(col - j)
        upper = u[i, j] + h * (u[i, j + 1] - u[i, j])
        lower = u[i + 1, j] + h * (u[i + 1, j + 1] - u[i + 1, j])
        if upper + v * (lower - upper) > height:
            return True


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
