r"""The normal operator of one Gauss-Newton step, matrix-free, and its transfer between grids.

The unknowns are values ``u`` at posts (rows, cols). Three kinds of terms meet in the operator:

.. math:: A = D^T G D + K^T W K + m

`D` takes the two slope differences of a cell from its four posts,

.. math:: p = (u_{01} - u_{00} + u_{11} - u_{10}) / 2, \qquad
          q = (u_{10} - u_{00} + u_{11} - u_{01}) / 2,

`G` is one symmetric 2x2 tensor per cell (rows - 1, cols - 1), `K` the second differences
:math:`u_{xx}`, :math:`u_{yy}` (three posts each) and :math:`u_{xy}` (the cell's four posts), and
`m` a mass per post. Each is a sum of positive semidefinite elements of at most four posts, so the
eigenvalues of :math:`\mathrm{diag}(A)^{-1} A` lie in [0, 4] whatever the data: the smoother needs
no estimate. All arrays are float32; every loop runs along rows.
"""

import numpy as np
from numba import njit, prange

BLOCK = 32  # rows per parallel work item; fixed, so sums do not depend on the thread count
LARGEST_EIGENVALUE = 4.0  # of diag(A)^-1 A: the number of posts of the largest element


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract", "nsz"})
def _cell_flux(upper, lower, c, gpp, gpq, gqq, twist, hourglass):
    """What the cell right of the post ``c`` adds to its four posts, as three numbers.

    The upper left post gets bend - total, the upper right one difference - bend, the lower left
    one -difference - bend, the lower right one total + bend.
    """
    half = np.float32(0.5)
    left, right = lower[c] - upper[c], lower[c + 1] - upper[c + 1]
    p = half * ((upper[c + 1] - upper[c]) + (lower[c + 1] - lower[c]))
    q = half * (left + right)
    fp = half * (gpp[c] * p + gpq[c] * q)
    fq = half * (gpq[c] * p + gqq[c] * q)
    bend = (twist + hourglass * (gpp[c] + gqq[c])) * (right - left)
    return fp + fq, fp - fq, bend


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract", "nsz"})
def _cells_above(upper, lower, gpp, gpq, gqq, twist, hourglass, above):
    """``above[c]``: what the cells between two rows add to the posts of the lower one."""
    last_total = last_bend = np.float32(0)
    for c in range(gpp.size):
        total, difference, bend = _cell_flux(upper, lower, c, gpp, gpq, gqq, twist, hourglass)
        above[c] = (last_total + last_bend) - (difference + bend)
        last_total, last_bend = total, bend
    above[gpp.size] = last_total + last_bend


@njit(cache=True, nogil=True, forceinline=True)
def _column_weights(row, rows, weights):
    """Weights of rows - 2 ... + 2 in the second differences along columns and their transpose."""
    weights[:] = 0.0
    for centre, factor in ((row - 1, 1.0), (row, -2.0), (row + 1, 1.0)):
        if 1 <= centre <= rows - 2:
            at = centre - row + 2
            weights[at - 1] += factor
            weights[at] -= 2.0 * factor
            weights[at + 1] += factor


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract", "nsz"})
def _across(rows, w, c):
    """Second differences along the column ``c`` and their transpose, from five rows."""
    return (
        w[0] * rows[0][c]
        + w[1] * rows[1][c]
        + w[2] * rows[2][c]
        + w[3] * rows[3][c]
        + w[4] * rows[4][c]
    )


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract", "nsz"})
def _operator_row(rows, tensor, twist, hourglass, w, wxx, mass, above, subtract, out):
    """All terms at the posts of one row; ``above`` goes on to the next one.

    Each cell is computed once: what it adds to the post at its right is kept in a register, what
    it adds to the row below in ``above``.
    """
    zero, two = np.float32(0), np.float32(2)
    u, below = rows[2], rows[3]
    gpp, gpq, gqq = tensor
    n = u.size
    last_total = last_difference = last_bend = zero
    behind = here = zero  # second differences along the row at the last post and at this one
    for c in range(n - 2):
        total, difference, bend = _cell_flux(u, below, c, gpp, gpq, gqq, twist, hourglass)
        ahead = u[c] - two * u[c + 1] + u[c + 2]
        cells = above[c] + ((bend - total) + (last_difference - last_bend))
        along = wxx * (behind - two * here + ahead)
        value = cells + along + _across(rows, w, c) + mass[c] * u[c]
        above[c] = (last_total + last_bend) - (difference + bend)
        out[c] = out[c] - value if subtract else value
        last_total, last_difference, last_bend = total, difference, bend
        behind, here = here, ahead
    for c in range(max(n - 2, 0), n):
        total, difference, bend = zero, zero, zero
        if c < n - 1:
            total, difference, bend = _cell_flux(u, below, c, gpp, gpq, gqq, twist, hourglass)
        cells = above[c] + ((bend - total) + (last_difference - last_bend))
        along = wxx * (behind - two * here)
        value = cells + along + _across(rows, w, c) + mass[c] * u[c]
        above[c] = (last_total + last_bend) - (difference + bend)
        out[c] = out[c] - value if subtract else value
        last_total, last_difference, last_bend = total, difference, bend
        behind, here = here, zero


@njit(cache=True, parallel=True)
def _operator(u, gpp, gpq, gqq, curvature, hourglass, mass, subtract, out):
    """``out = A u`` or ``out -= A u``; arguments as in `apply_operator`."""
    rows, cols = u.shape
    blocks = (rows + BLOCK - 1) // BLOCK
    empty = np.zeros(max(cols - 1, 0), np.float32)
    none = np.float32(0)
    for block in prange(blocks):
        first = np.int64(block) * BLOCK
        last = min(first + BLOCK, rows)
        above = np.zeros(cols, np.float32)
        weights = np.zeros(5, np.float32)
        twist, stiff = curvature[1], np.float32(hourglass)
        if first > 0:
            r = first - 1
            k = min(r, gpp.shape[0] - 1)
            _cells_above(u[r], u[r + 1], gpp[k], gpq[k], gqq[k], twist, stiff, above)
        for r in range(first, last):
            _column_weights(r, rows, weights)
            weights *= curvature[2]
            k = min(r, gpp.shape[0] - 1)
            tensor = (gpp[k], gpq[k], gqq[k])
            if r == rows - 1:  # no cells below
                tensor, twist = (empty, empty, empty), none
            _operator_row(
                (
                    u[max(r - 2, 0)],
                    u[max(r - 1, 0)],
                    u[r],
                    u[min(r + 1, rows - 1)],
                    u[min(r + 2, rows - 1)],
                ),
                tensor,
                twist,
                stiff,
                weights,
                curvature[0],
                mass[min(r, mass.shape[0] - 1)],
                above,
                subtract,
                out[r],
            )


def apply_operator(u, gpp, gpq, gqq, curvature, hourglass, mass, out):
    """``out = A u``.

    Parameters
    ----------
    u, out : float32 array (rows, cols)
    gpp, gpq, gqq : float32 array (rows - 1, cols - 1) or (1, cols - 1)
        The tensor of each cell, per squared difference; one row serves all when they are the same.
    curvature : float32 array (3,)
        Weights of u_xx (along a row), u_xy and u_yy, per squared second difference.
    hourglass : float
        Share of tr(G) that resists a cell's twist.
    mass : float32 array (rows, cols) or (1, cols)
        Weight of each post; one row serves all when the weight is the same.
    """
    _operator(u, gpp, gpq, gqq, curvature, hourglass, mass, False, out)


def subtract_operator(u, gpp, gpq, gqq, curvature, hourglass, mass, out):
    """``out -= A u``: a residual after the step ``u``; arguments as in `apply_operator`."""
    _operator(u, gpp, gpq, gqq, curvature, hourglass, mass, True, out)


@njit(cache=True, parallel=True)
def inverse_diagonal(gpp, gpq, gqq, curvature, hourglass, mass, out):
    """``out = 1 / diag(A)``; arguments as in `apply_operator`."""
    rows, cols = out.shape
    along = np.zeros(cols, np.float32)
    weights = np.zeros(5, np.float32)
    for c in range(cols):
        _column_weights(c, cols, weights)
        along[c] = curvature[0] * weights[2]
    for i in prange(rows):
        r = np.int64(i)
        weights = np.zeros(5, np.float32)
        _column_weights(r, rows, weights)
        across = curvature[2] * weights[2]
        _fill_row(mass[min(r, mass.shape[0] - 1)], along, across, out[r])
        if r < rows - 1:
            _cell_diagonal(gpp[r], gpq[r], gqq[r], 1.0, curvature[1], hourglass, out[r])
        if r > 0:
            _cell_diagonal(
                gpp[r - 1], gpq[r - 1], gqq[r - 1], -1.0, curvature[1], hourglass, out[r]
            )
        _invert_row(out[r])


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract", "nsz"})
def _fill_row(mass, along, across, row):
    for c in range(row.size):
        row[c] = mass[c] + along[c] + across


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract", "nsz"})
def _invert_row(row):
    for c in range(row.size):
        row[c] = np.float32(1.0) / max(row[c], np.float32(1e-30))


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract", "nsz"})
def _cell_diagonal(gpp, gpq, gqq, sign, twist, hourglass, row):
    quarter, mixed = np.float32(0.25), np.float32(0.5 * sign)
    for c in range(gpp.size):
        trace = gpp[c] + gqq[c]
        row[c] += quarter * trace + mixed * gpq[c] + (twist + hourglass * trace)
    for c in range(gpp.size):
        trace = gpp[c] + gqq[c]
        row[c + 1] += quarter * trace - mixed * gpq[c] + (twist + hourglass * trace)


@njit(cache=True, parallel=True)
def slope_adjoint(gp, gq, out):
    """``out = D^T (gp, gq)``: the gradient at posts of a cost whose slope gradients are given.

    Parameters
    ----------
    gp, gq : float32 array (rows - 1, cols - 1)
    out : float32 array (rows, cols)
    """
    rows, cols = out.shape
    half = np.float32(0.5)
    for i in prange(rows):
        r = np.int64(i)
        row = out[r]
        row[:] = 0.0
        if r < rows - 1:
            for c in range(cols - 1):
                row[c] -= half * (gp[r, c] + gq[r, c])
            for c in range(cols - 1):
                row[c + 1] += half * (gp[r, c] - gq[r, c])
        if r > 0:
            for c in range(cols - 1):
                row[c] += half * (gq[r - 1, c] - gp[r - 1, c])
            for c in range(cols - 1):
                row[c + 1] += half * (gq[r - 1, c] + gp[r - 1, c])


@njit(cache=True, parallel=True)
def add_slopes(wp, wq, u, out):
    """``out += (wp, wq) D u``: the weighted slopes of cells, the adjoint of `slope_adjoint`.

    Parameters
    ----------
    wp, wq : float32 array (rows - 1, cols - 1)
    u : float32 array (rows, cols)
    out : float32 array (rows - 1, cols - 1)
    """
    half = np.float32(0.5)
    for i in prange(out.shape[0]):
        r = np.int64(i)
        for c in range(out.shape[1]):
            down = half * (u[r + 1, c + 1] - u[r, c])
            up = half * (u[r, c + 1] - u[r + 1, c])
            out[r, c] += wp[r, c] * (down + up) + wq[r, c] * (down - up)


def coarse_shape(shape):
    """Posts of the next coarser grid: every second one, and one beyond an even end."""
    return shape[0] // 2 + 1, shape[1] // 2 + 1


@njit(cache=True, parallel=True)
def coarsen_cells(fine, coarse):
    """Mean over 2x2 cells; cells beyond the border count as zero."""
    rows, cols = fine.shape
    quarter = np.float32(0.25)
    for i in prange(coarse.shape[0]):
        r = np.int64(i)
        for c in range(coarse.shape[1]):
            total = np.float32(0.0)
            for k in range(2 * r, min(2 * r + 2, rows)):
                for j in range(2 * c, min(2 * c + 2, cols)):
                    total += fine[k, j]
            coarse[r, c] = quarter * total


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract", "nsz"})
def _halve_row(row, out):
    """Transpose of linear interpolation along a row: out[c] = row[2c] + (neighbours) / 2."""
    half = np.float32(0.5)
    n = row.size
    out[0] = row[0] + half * row[1]
    for c in range(1, (n - 1) // 2):
        out[c] = half * row[2 * c - 1] + row[2 * c] + half * row[2 * c + 1]
    for c in range(max((n - 1) // 2, 1), out.size):
        total = half * row[2 * c - 1]
        if 2 * c < n:
            total += row[2 * c]
        if 2 * c + 1 < n:
            total += half * row[2 * c + 1]
        out[c] = total


@njit(cache=True, parallel=True)
def restrict(fine, coarse):
    """Transpose of `prolong`: each coarse post gathers its 3x3 fine posts, weights 1, 1/2, 1/4.

    Parameters
    ----------
    fine : float32 array (rows, cols)
    coarse : float32 array `coarse_shape` (rows, cols)
    """
    rows = fine.shape[0]
    half = np.float32(0.5)
    for i in prange(coarse.shape[0]):
        r = np.int64(i)
        line = np.zeros(fine.shape[1], np.float32)
        for k in range(max(2 * r - 1, 0), min(2 * r + 2, rows)):
            weight = np.float32(1.0) if k == 2 * r else half
            source = fine[k]
            for c in range(line.size):
                line[c] += weight * source[c]
        _halve_row(line, coarse[r])


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract", "nsz"})
def _add_interleaved(near, far, row):
    """Add the mean of two coarse rows, interpolated to every second column."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    here = near[0] + far[0]
    for c in range(row.size // 2):
        ahead = near[c + 1] + far[c + 1]
        row[2 * c] += half * here
        row[2 * c + 1] += quarter * (here + ahead)
        here = ahead
    if row.size % 2:
        row[row.size - 1] += half * here


@njit(cache=True, parallel=True)
def prolong_add(coarse, fine):
    """Add the bilinear interpolation of coarse posts to the fine ones."""
    for i in prange(fine.shape[0]):
        r = np.int64(i)
        near, far = coarse[r // 2], coarse[(r + 1) // 2]
        row = fine[r]
        _add_interleaved(near, far, row)


@njit(cache=True, parallel=True)
def prolong(coarse, fine):
    """Interpolate coarse posts bilinearly to the fine ones."""
    for i in prange(fine.shape[0]):
        r = np.int64(i)
        row = fine[r]
        for c in range(row.size):
            row[c] = np.float32(0.0)
        _add_interleaved(coarse[r // 2], coarse[(r + 1) // 2], row)
