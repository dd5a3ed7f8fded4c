"""Compiled twins of the reflectance laws, for one facet.

Solvers call these functions inside their own loops; they are free of branches, so that such a loop
becomes vector instructions. What depends on phase alone comes in as ``share`` and ``factor``, from
``ReflectanceModel.phase_terms``, because phase varies slowly over a scene. All arguments are
float32 scalars; each function returns R, dR/dcos_incidence and dR/dcos_emission, all 0 where the
facet is unlit or unseen. :mod:`lommel.core.reflectance_formulas` defines what they mean.
"""

import numpy as np
from numba import njit

KINDS = {"blend": 0, "power": 1, "multiple-scattering": 2}
ZERO, QUARTER, ONE, TWO = np.float32(0), np.float32(0.25), np.float32(1), np.float32(2)


@njit(cache=True, nogil=True, forceinline=True, error_model="numpy")
def blend(scale, cos_incidence, cos_emission, share, factor):
    """R = (1 - L) mu0 + scale L mu0 / (mu0 + mu), L the share."""
    lit_and_seen = (cos_incidence > ZERO) & (cos_emission > ZERO)
    mu0 = cos_incidence if lit_and_seen else ONE
    mu = cos_emission if lit_and_seen else ONE
    gain = factor if lit_and_seen else ZERO
    inverse = ONE / (mu0 + mu)
    seeliger = scale * share * inverse
    value = (ONE - share) + seeliger
    d_emission = -seeliger * mu0 * inverse
    return gain * mu0 * value, gain * (value + d_emission), gain * d_emission


@njit(cache=True, nogil=True, forceinline=True, error_model="numpy")
def power(k, cos_incidence, cos_emission, share, factor):
    """R = mu0^k mu^(k-1); no share in it."""
    lit_and_seen = (cos_incidence > ZERO) & (cos_emission > ZERO)
    mu0 = cos_incidence if lit_and_seen else ONE
    mu = cos_emission if lit_and_seen else ONE
    gain = factor if lit_and_seen else ZERO
    slope = gain * (mu0 * mu) ** (k - ONE)
    return mu0 * slope, k * slope, (k - ONE) * mu0 * slope / mu


@njit(cache=True, nogil=True, forceinline=True, error_model="numpy")
def multiple_scattering(w, cos_incidence, cos_emission, share, factor):
    """R = w/4 mu0 / (mu0 + mu) (share + H(mu0) H(mu))."""
    lit_and_seen = (cos_incidence > ZERO) & (cos_emission > ZERO)
    mu0 = cos_incidence if lit_and_seen else ONE
    mu = cos_emission if lit_and_seen else ONE
    gain = factor if lit_and_seen else ZERO
    gamma = np.sqrt(ONE - w)
    inverse = ONE / (mu0 + mu)
    inverse0, inverse1 = ONE / (ONE + TWO * gamma * mu0), ONE / (ONE + TWO * gamma * mu)
    h0, h1 = (ONE + TWO * mu0) * inverse0, (ONE + TWO * mu) * inverse1
    dh0 = TWO * (ONE - gamma) * inverse0 * inverse0
    dh1 = TWO * (ONE - gamma) * inverse1 * inverse1
    single = gain * QUARTER * w * inverse
    bracket = share + h0 * h1
    return (
        single * mu0 * bracket,
        single * (mu * bracket * inverse + mu0 * dh0 * h1),
        single * mu0 * (h0 * dh1 - bracket * inverse),
    )
