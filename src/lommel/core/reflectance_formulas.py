r"""Formulas of the reflectance models: lunar-Lambert, Lambert, Lommel-Seeliger, Minnaert, Hapke.

Each public function is pure: cosines, and where needed the phase angle, in; reflectance for albedo
1 out. Symbols, throughout:

- ``cos_incidence``, :math:`\mu_0 = \cos i`, normal against direction to the Sun,
- ``cos_emission``, :math:`\mu = \cos e`, normal against direction to the camera,
- ``phase``, :math:`\alpha`, angle between Sun and camera in radians.

A facet that is unlit (:math:`\mu_0 \le 0`) or unseen (:math:`\mu \le 0`) has reflectance 0 and
derivatives 0 in every model, NaN cosines included. The three families that the laws reduce to,
``blend``, ``power`` and ``multiple_scattering``, also give the derivatives; they expect positive
cosines, and take as ``share`` all that depends on phase alone.
"""

import numpy as np

LINEAR, QUADRATIC, CUBIC = -0.019, 0.242e-3, -1.46e-6  # of L, per deg, deg², deg³; McEwen (1996)
DECAY_DEG = 60.0  # K of the exponential form


def lunar_lambert_weight(phase, A=LINEAR, B=QUADRATIC, C=CUBIC):
    r"""Lommel-Seeliger share of the lunar-Lambert model, polynomial in the phase angle.

    .. math:: L = 1 + A\alpha + B\alpha^2 + C\alpha^3 \quad (\alpha \text{ in degrees})

    Parameters
    ----------
    phase : array (...), radians
    A, B, C : float, per degree, degree², degree³

    Returns
    -------
    weight : array (...), dimensionless
        Held within [0, 1]. The printed polynomial falls all the way and passes through 0 at
        104 degrees, beyond the images it was fitted to; from there on it stays 0 (Lambert).

    References
    ----------
    McEwen (1991), Icarus 92, 298-311; McEwen (1996), LPSC XXVII, 841-842.

    Examples
    --------
    >>> round(float(lunar_lambert_weight(np.radians(50.0))), 4)
    0.4725
    """
    degrees = np.degrees(phase)
    return np.clip(1 + degrees * (A + degrees * (B + degrees * C)), 0.0, 1.0)


def exponential_weight(phase, K=DECAY_DEG):
    r"""Lommel-Seeliger share :math:`L = e^{-\alpha/K}`, both angles in degrees in the formula.

    Parameters
    ----------
    phase : array (...), radians
    K : float, degrees

    Returns
    -------
    weight : array (...), dimensionless, in (0, 1]

    Examples
    --------
    >>> round(float(exponential_weight(np.radians(60.0))), 4)
    0.3679
    """
    return np.exp(-np.degrees(phase) / K)


def lunar_lambert(cos_incidence, cos_emission, weight):
    r"""Lunar-Lambert reflectance, a blend of Lommel-Seeliger and Lambert.

    .. math:: R = (1 - L)\,\mu_0 + 2 L \frac{\mu_0}{\mu_0 + \mu}

    Parameters
    ----------
    cos_incidence, cos_emission : array (...), dimensionless, in [-1, 1]
    weight : float or array (...), dimensionless
        Lommel-Seeliger share L; 0 gives Lambert, 1 gives Lommel-Seeliger.

    Returns
    -------
    reflectance : array (...), dimensionless
        1 when Sun and camera are both overhead; 0 where the facet is unlit or unseen.

    References
    ----------
    McEwen (1991), Icarus 92, 298-311.

    Examples
    --------
    >>> float(lunar_lambert(0.5, 1.0, weight=0.0))
    0.5
    """
    return where_lit(blend, cos_incidence, cos_emission, weight, 2.0)[0]


def lunar_lambert_exponential(cos_incidence, cos_emission, weight):
    r"""Lunar-Lambert reflectance as printed with the exponential weight, without the factor 2.

    .. math:: R = (1 - L)\,\mu_0 + L \frac{\mu_0}{\mu_0 + \mu}

    Arguments and result as in :func:`lunar_lambert`; with Sun and camera overhead it is 1 - L/2.

    Examples
    --------
    >>> float(lunar_lambert_exponential(1.0, 1.0, weight=1.0))
    0.5
    """
    return where_lit(blend, cos_incidence, cos_emission, weight, 1.0)[0]


def lambert(cos_incidence, cos_emission):
    r"""Lambert reflectance :math:`R = \mu_0`: equally bright from every side.

    Examples
    --------
    >>> float(lambert(0.25, 0.9))
    0.25
    """
    return lunar_lambert(cos_incidence, cos_emission, 0.0)


def lommel_seeliger(cos_incidence, cos_emission):
    r"""Lommel-Seeliger reflectance :math:`R = 2\mu_0/(\mu_0 + \mu)`: single scattering, dark soil.

    Scaled, as in ISIS, to 1 when Sun and camera are both overhead.

    Examples
    --------
    >>> float(lommel_seeliger(0.5, 0.5))
    1.0
    """
    return lunar_lambert(cos_incidence, cos_emission, 1.0)


def minnaert(cos_incidence, cos_emission, k=0.7):
    r"""Minnaert reflectance :math:`R = \mu_0^k\,\mu^{k-1}`; k = 1 gives Lambert.

    References
    ----------
    Minnaert (1941), Astrophysical Journal 93, 403-410.

    Examples
    --------
    >>> round(float(minnaert(0.25, 1.0, k=0.5)), 12)
    0.5
    """
    return where_lit(power, cos_incidence, cos_emission, 0.0, k)[0]


def hapke(cos_incidence, cos_emission, phase, w=0.3, b=0.24, c=0.3, B0=1.8, h=0.07):
    r"""Hapke's isotropic multiple scattering approximation for a smooth surface, as I/F.

    .. math::
        R &= \frac{w}{4} \frac{\mu_0}{\mu_0 + \mu}
             \left[ (1 + B) P - 1 + H(\mu_0) H(\mu) \right], \qquad
        H(x) = \frac{1 + 2x}{1 + 2x\sqrt{1 - w}} \\
        B &= \frac{B_0}{1 + \tan(\alpha/2)/h}, \qquad
        P = \frac{1 + c}{2} \frac{1 - b^2}{(1 - 2b\cos\alpha + b^2)^{3/2}}
          + \frac{1 - c}{2} \frac{1 - b^2}{(1 + 2b\cos\alpha + b^2)^{3/2}}

    Parameters
    ----------
    cos_incidence, cos_emission : array (...), dimensionless, in [-1, 1]
    phase : array (...), radians
    w : float, single-scattering albedo, in [0, 1]
    b, c : float, width and backward share of the double Henyey-Greenstein function,
        in [0, 1) and [-1, 1]; ISIS writes (1 + c)/2 for the share
    B0, h : float, height and angular width of the shadow-hiding opposition surge

    Returns
    -------
    reflectance : array (...), dimensionless
        The radiance factor :math:`\pi r`. The defaults are round numbers for lunar highlands.

    References
    ----------
    Hapke (1981), J. Geophys. Res. 86, 3039-3054; Hapke (2012), Theory of Reflectance and
    Emittance Spectroscopy, 2nd ed., Cambridge.

    Examples
    --------
    >>> float(hapke(0.5, 1.0, 1.0, w=0.0))
    0.0
    """
    return where_lit(
        multiple_scattering, cos_incidence, cos_emission, hapke_share(phase, b, c, B0, h), w
    )[0]


def phase_factor(phase, c1, c2):
    r"""Factor :math:`e^{-c_1 \alpha} + c_2` that dims any model with phase, in radians.

    Examples
    --------
    >>> float(phase_factor(0.0, 1.4, 0.5))
    1.5
    """
    return np.exp(-c1 * np.asarray(phase)) + c2


def where_lit(evaluate, cos_incidence, cos_emission, share, *constants):
    """Law evaluated on lit and seen facets, zeros elsewhere: (R, dR/dmu0, dR/dmu)."""
    lit_and_seen = (np.asarray(cos_incidence) > 0) & (np.asarray(cos_emission) > 0)
    mu0 = np.where(lit_and_seen, cos_incidence, 1.0)
    mu = np.where(lit_and_seen, cos_emission, 1.0)
    terms = evaluate(mu0, mu, share, *constants)
    return tuple(np.where(lit_and_seen, term, 0.0) for term in terms)


def blend(mu0, mu, share, scale):
    """R = (1 - L) mu0 + scale L mu0 / (mu0 + mu), with derivatives."""
    seeliger = scale * share / (mu0 + mu)
    d_emission = -seeliger * mu0 / (mu0 + mu)
    d_incidence = (1 - share) + seeliger + d_emission
    return mu0 * ((1 - share) + seeliger), d_incidence, d_emission


def power(mu0, mu, share, k):
    """R = mu0^k mu^(k-1), with derivatives; ``share`` plays no part."""
    slope = (mu0 * mu) ** (k - 1)
    return mu0 * slope, k * slope, (k - 1) * mu0 * slope / mu


def multiple_scattering(mu0, mu, share, w):
    """R = w/4 mu0 / (mu0 + mu) (share + H(mu0) H(mu)), with derivatives."""
    gamma = (1 - w) ** 0.5
    h0, dh0 = (1 + 2 * mu0) / (1 + 2 * gamma * mu0), 2 * (1 - gamma) / (1 + 2 * gamma * mu0) ** 2
    h1, dh1 = (1 + 2 * mu) / (1 + 2 * gamma * mu), 2 * (1 - gamma) / (1 + 2 * gamma * mu) ** 2
    single = w / 4 / (mu0 + mu)
    bracket = share + h0 * h1
    d_incidence = single * (mu * bracket / (mu0 + mu) + mu0 * dh0 * h1)
    d_emission = single * mu0 * (h0 * dh1 - bracket / (mu0 + mu))
    return single * mu0 * bracket, d_incidence, d_emission


def hapke_share(phase, b, c, B0, h):
    """(1 + B) P - 1, the phase-only part of Hapke's bracket."""
    surge = 1 + B0 / (1 + np.tan(np.asarray(phase) / 2) / h)
    lobe = 1 + b**2
    backward = (1 - b**2) / (lobe - 2 * b * np.cos(phase)) ** 1.5
    forward = (1 - b**2) / (lobe + 2 * b * np.cos(phase)) ** 1.5
    return surge * ((1 + c) / 2 * backward + (1 - c) / 2 * forward) - 1
