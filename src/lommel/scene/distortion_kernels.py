"""Compiled lens distortion: the closed form of each model with its derivatives, and its inverse.

Every closed form takes focal-plane coordinates in the model's own unit and returns

    u, v, du/dx, du/dy, dv/dx, dv/dy.

Most callers want `lommel.scene.distortion.Distortion`, which says what the models mean.
"""

from typing import Any

import numpy as np
from numba import njit

NONE, RADIAL, BROWN_CONRADY, RADTAN, TRANSVERSE, KAGUYA, LRO_NAC = range(7)

STEPS = 30  # Newton needs 3 to 6; more only where nothing can be found
CONVERGED = 1e-7  # relative length of a Newton step; the error after it is its square
# 1 / 0 is infinite, as for arrays; damaged coefficients must not end the program
SERIAL: dict[str, Any] = {"cache": True, "nogil": True, "forceinline": True, "error_model": "numpy"}
FAST = {"contract", "nsz"}


@njit(**SERIAL, fastmath=FAST)
def _radial(c, x, y):
    rr = x * x + y * y
    factor = 1.0 - c[0] - rr * (c[1] + rr * c[2])
    twice = -2.0 * (c[1] + 2.0 * rr * c[2])  # d factor / d(r^2), twice
    return (
        x * factor,
        y * factor,
        factor + twice * x * x,
        twice * x * y,
        twice * x * y,
        factor + twice * y * y,
    )


@njit(**SERIAL, fastmath=FAST)
def _brown_conrady(c, x, y):
    x, y = x - c[0], y - c[1]
    rr = x * x + y * y
    factor = 1.0 + rr * (c[2] + rr * (c[3] + rr * c[4]))
    twice = 2.0 * (c[2] + rr * (2.0 * c[3] + 3.0 * rr * c[4]))
    sine, cosine = np.sin(c[7]), np.cos(c[7])
    shift = rr * (c[5] + rr * c[6])
    slope = 2.0 * (c[5] + 2.0 * rr * c[6])
    return (
        x * factor - shift * sine,
        y * factor + shift * cosine,
        factor + twice * x * x - slope * x * sine,
        twice * x * y - slope * y * sine,
        twice * x * y + slope * x * cosine,
        factor + twice * y * y + slope * y * cosine,
    )


@njit(**SERIAL, fastmath=FAST)
def _radtan(c, x, y):
    rr = x * x + y * y
    factor = 1.0 + rr * (c[0] + rr * (c[1] + rr * c[4]))
    twice = 2.0 * (c[0] + rr * (2.0 * c[1] + 3.0 * rr * c[4]))
    p1, p2 = c[2], c[3]
    cross = twice * x * y + 2.0 * (p1 * x + p2 * y)
    return (
        x * factor + 2.0 * p1 * x * y + p2 * (rr + 2.0 * x * x),
        y * factor + 2.0 * p2 * x * y + p1 * (rr + 2.0 * y * y),
        factor + twice * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        cross,
        cross,
        factor + twice * y * y + 2.0 * p2 * x + 6.0 * p1 * y,
    )


@njit(**SERIAL, fastmath=FAST)
def _cubic(c, first, x, y):
    """Polynomial in 1, x, y, x^2, xy, y^2, x^3, x^2 y, x y^2, y^3 and its two derivatives."""
    c0, cx, cy, cxx, cxy, cyy = (
        c[first],
        c[first + 1],
        c[first + 2],
        c[first + 3],
        c[first + 4],
        c[first + 5],
    )
    cxxx, cxxy, cxyy, cyyy = c[first + 6], c[first + 7], c[first + 8], c[first + 9]
    value = c0 + x * (cx + x * (cxx + x * cxxx + y * cxxy) + y * (cxy + y * cxyy))
    value += y * (cy + y * (cyy + y * cyyy))
    along_x = cx + x * (2.0 * cxx + 3.0 * x * cxxx + 2.0 * y * cxxy) + y * (cxy + y * cxyy)
    along_y = cy + y * (2.0 * cyy + 3.0 * y * cyyy + 2.0 * x * cxyy) + x * (cxy + x * cxxy)
    return value, along_x, along_y


@njit(**SERIAL, fastmath=FAST)
def _transverse(c, x, y):
    u, ux, uy = _cubic(c, 0, x, y)
    v, vx, vy = _cubic(c, 10, x, y)
    return u, v, ux, uy, vx, vy


@njit(**SERIAL, fastmath=FAST)
def _kaguya(c, x, y):
    r = np.sqrt(x * x + y * y) + 1e-300  # not zero, for the direction below
    to_x, to_y = x / r, y / r
    slope_u = c[2] + r * (2.0 * c[3] + 3.0 * r * c[4])
    slope_v = c[7] + r * (2.0 * c[8] + 3.0 * r * c[9])
    return (
        x + c[0] + c[1] + r * (c[2] + r * (c[3] + r * c[4])),
        y + c[5] + c[6] + r * (c[7] + r * (c[8] + r * c[9])),
        1.0 + slope_u * to_x,
        slope_u * to_y,
        slope_v * to_x,
        1.0 + slope_v * to_y,
    )


@njit(**SERIAL, fastmath=FAST)
def _lro_nac(c, x, y):
    share = 1.0 / (1.0 + c[0] * y * y)
    # the share is negative behind the pole of a negative k; so is the derivative then
    return x, y * share, 1.0, 0.0, 0.0, (2.0 * share - 1.0) * abs(share)


@njit(**SERIAL)
def closed_form(kind, c, x, y):
    """Closed form of a model by its number; both argument and result in the model's unit."""
    if kind == RADIAL:
        return _radial(c, x, y)
    if kind == BROWN_CONRADY:
        return _brown_conrady(c, x, y)
    if kind == RADTAN:
        return _radtan(c, x, y)
    if kind == TRANSVERSE:
        return _transverse(c, x, y)
    if kind == KAGUYA:
        return _kaguya(c, x, y)
    if kind == LRO_NAC:
        return _lro_nac(c, x, y)
    return x, y, 1.0, 0.0, 0.0, 1.0


@njit(**SERIAL)
def reach(kind, c, radii, azimuths):
    """Distance from the axis within which the closed form keeps its orientation.

    Parameters
    ----------
    kind : int
    c : array (n,)
        Coefficients.
    radii : array (n,), model units
        Where to look, ascending.
    azimuths : int
        Directions to look in.

    Returns
    -------
    reach : float, model units
        The last of the radii before the image folds over; infinite if it never does.
    """
    for i in range(radii.size):
        for j in range(azimuths):
            angle = 2.0 * np.pi * j / azimuths
            x, y = radii[i] * np.cos(angle), radii[i] * np.sin(angle)
            _, _, a, b, d, e = closed_form(kind, c, x, y)
            if not a * e - b * d > 0.0:
                return radii[max(i - 1, 0)]
    return np.inf


@njit(**SERIAL)
def _direct(kind, c, limit, x, y):
    if not x * x + y * y <= limit * limit:
        return np.nan, np.nan
    u, v, _, _, _, _ = closed_form(kind, c, x, y)
    return u, v


@njit(**SERIAL)
def _inverse(kind, c, limit, u, v):
    """Newton from the target itself, kept within the reach of the model."""
    if not (np.isfinite(u) and np.isfinite(v)):
        return np.nan, np.nan
    x, y = u, v
    for _ in range(STEPS):
        radius = np.sqrt(x * x + y * y)
        if radius > limit:
            x, y = x * (limit / radius), y * (limit / radius)
        found_u, found_v, a, b, d, e = closed_form(kind, c, x, y)
        determinant = a * e - b * d
        if determinant == 0.0:
            return np.nan, np.nan
        miss_u, miss_v = u - found_u, v - found_v
        step_x = (e * miss_u - b * miss_v) / determinant
        step_y = (a * miss_v - d * miss_u) / determinant
        x, y = x + step_x, y + step_y
        if abs(step_x) + abs(step_y) <= CONVERGED * (abs(u) + abs(v) + abs(x) + abs(y)):
            if x * x + y * y <= limit * limit:
                return x, y
            return np.nan, np.nan
    return np.nan, np.nan


@njit(**SERIAL)
def distort(lens, x, y):
    """Distorted focal-plane coordinates of undistorted ones; NaN beyond the model's reach.

    Parameters
    ----------
    lens : Lens
    x, y : float, the focal plane's unit
    """
    if lens.kind == NONE:
        return x, y
    x, y = x / lens.unit, y / lens.unit
    if lens.removes:
        u, v = _inverse(lens.kind, lens.coefficients, lens.reach, x, y)
    else:
        u, v = _direct(lens.kind, lens.coefficients, lens.reach, x, y)
    return u * lens.unit, v * lens.unit


@njit(**SERIAL)
def undistort(lens, x, y):
    """Undistorted focal-plane coordinates of distorted ones; the inverse of `distort`."""
    if lens.kind == NONE:
        return x, y
    x, y = x / lens.unit, y / lens.unit
    if lens.removes:
        u, v = _direct(lens.kind, lens.coefficients, lens.reach, x, y)
    else:
        u, v = _inverse(lens.kind, lens.coefficients, lens.reach, x, y)
    return u * lens.unit, v * lens.unit


@njit(**SERIAL)
def distort_all(lens, x, y, u, v):
    """`distort` for flat arrays."""
    for i in range(x.size):
        u[i], v[i] = distort(lens, x[i], y[i])


@njit(**SERIAL)
def undistort_all(lens, x, y, u, v):
    """`undistort` for flat arrays."""
    for i in range(x.size):
        u[i], v[i] = undistort(lens, x[i], y[i])
