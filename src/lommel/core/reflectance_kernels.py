"""Compiled twins of the reflectance laws, one row of pixels at a time.

Solvers call :func:`reflectance_row` inside their own kernels. What depends on phase alone comes in
as two arrays, ``share`` and ``factor`` of ``ReflectanceModel.phase_terms``, because phase varies
slowly over a scene. The switch on the law stands outside the loops and the loops are free of
branches, so that each of them becomes vector instructions. :mod:`lommel.core.reflectance_formulas`
defines what these functions mean.
"""

import numpy as np
from numba import njit

KINDS = {"blend": 0, "power": 1, "multiple-scattering": 2}


@njit(cache=True, error_model="numpy")
def reflectance_row(
    kind, parameters, cos_incidence, cos_emission, share, factor, r, dr_incidence, dr_emission
):
    """Write reflectance and derivatives of one row of facets; 0 where unlit or unseen.

    Parameters
    ----------
    kind : int
        ``ReflectanceModel.kind``, one of ``KINDS``; any other gives NaN.
    parameters : float64 array (n,)
        ``ReflectanceModel.parameter_array()``.
    cos_incidence, cos_emission, share, factor : array (cols,), float32 or float64
    r, dr_incidence, dr_emission : array (cols,)
        Overwritten: R, dR/dcos_incidence and dR/dcos_emission.
    """
    if kind == 0:
        _blend_row(
            parameters[0], cos_incidence, cos_emission, share, factor, r, dr_incidence, dr_emission
        )
    elif kind == 1:
        _power_row(parameters[0], cos_incidence, cos_emission, factor, r, dr_incidence, dr_emission)
    elif kind == 2:
        _multiple_scattering_row(
            parameters[0], cos_incidence, cos_emission, share, factor, r, dr_incidence, dr_emission
        )
    else:  # a user's law has no twin; its caller evaluates arrays
        r[:] = np.nan
        dr_incidence[:] = np.nan
        dr_emission[:] = np.nan


@njit(cache=True, error_model="numpy")
def _blend_row(scale, cos_incidence, cos_emission, share, factor, r, dr_incidence, dr_emission):
    """R = (1 - L) mu0 + scale L mu0 / (mu0 + mu), L the share."""
    number = cos_incidence.dtype.type  # keeps float32 rows in float32
    zero, one, scale = number(0), number(1), number(scale)
    for j in range(cos_incidence.size):
        lit_and_seen = (cos_incidence[j] > zero) & (cos_emission[j] > zero)
        mu0 = cos_incidence[j] if lit_and_seen else one
        mu = cos_emission[j] if lit_and_seen else one
        gain = factor[j] if lit_and_seen else zero
        inverse = one / (mu0 + mu)
        seeliger = scale * share[j] * inverse
        value = (one - share[j]) + seeliger
        d_emission = -seeliger * mu0 * inverse
        r[j] = gain * mu0 * value
        dr_incidence[j] = gain * (value + d_emission)
        dr_emission[j] = gain * d_emission


@njit(cache=True, error_model="numpy")
def _power_row(k, cos_incidence, cos_emission, factor, r, dr_incidence, dr_emission):
    """R = mu0^k mu^(k-1)."""
    number = cos_incidence.dtype.type
    zero, one, k = number(0), number(1), number(k)
    for j in range(cos_incidence.size):
        lit_and_seen = (cos_incidence[j] > zero) & (cos_emission[j] > zero)
        mu0 = cos_incidence[j] if lit_and_seen else one
        mu = cos_emission[j] if lit_and_seen else one
        gain = factor[j] if lit_and_seen else zero
        slope = gain * (mu0 * mu) ** (k - one)
        r[j] = mu0 * slope
        dr_incidence[j] = k * slope
        dr_emission[j] = (k - one) * mu0 * slope / mu


@njit(cache=True, error_model="numpy")
def _multiple_scattering_row(
    w, cos_incidence, cos_emission, share, factor, r, dr_incidence, dr_emission
):
    """R = w/4 mu0 / (mu0 + mu) (share + H(mu0) H(mu))."""
    number = cos_incidence.dtype.type
    zero, one, two = number(0), number(1), number(2)
    gamma, quarter = number((1 - w) ** 0.5), number(w / 4)
    for j in range(cos_incidence.size):
        lit_and_seen = (cos_incidence[j] > zero) & (cos_emission[j] > zero)
        mu0 = cos_incidence[j] if lit_and_seen else one
        mu = cos_emission[j] if lit_and_seen else one
        gain = factor[j] if lit_and_seen else zero
        inverse = one / (mu0 + mu)
        inverse0, inverse1 = one / (one + two * gamma * mu0), one / (one + two * gamma * mu)
        h0, h1 = (one + two * mu0) * inverse0, (one + two * mu) * inverse1
        dh0 = two * (one - gamma) * inverse0 * inverse0
        dh1 = two * (one - gamma) * inverse1 * inverse1
        single = gain * quarter * inverse
        bracket = share[j] + h0 * h1
        r[j] = single * mu0 * bracket
        dr_incidence[j] = single * (mu * bracket * inverse + mu0 * dh0 * h1)
        dr_emission[j] = single * mu0 * (h0 * dh1 - bracket * inverse)
