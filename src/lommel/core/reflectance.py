r"""How bright a facet looks: reflectance models by name, with their derivatives.

Most callers want :func:`reflectance_model`, which turns a name and parameters into a
:class:`ReflectanceModel`. Parameters carry the symbols of the publications.

========================= ======================================== ===========================
name                      reflectance for albedo 1                 parameters
========================= ======================================== ===========================
lunar-lambert             :func:`lunar_lambert`, polynomial L      A, B, C per deg, deg², deg³
lunar-lambert-exponential :func:`lunar_lambert_exponential`        K in deg
lambert                   :func:`lambert`                          none
lommel-seeliger           :func:`lommel_seeliger`                  none
minnaert                  :func:`minnaert`                         k
hapke                     :func:`hapke`                            w, b, c, B0, h
========================= ======================================== ===========================

Any model may be multiplied by a :func:`phase_factor`, and a function of your own may take the place
of a name. The formulas are in :mod:`lommel.core.reflectance_formulas`, their compiled twins in
:mod:`lommel.core.reflectance_kernels`. To add a model, add its function there and its line here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from lommel.core.reflectance_formulas import (
    CUBIC,
    DECAY_DEG,
    LINEAR,
    QUADRATIC,
    blend,
    exponential_weight,
    hapke,
    hapke_share,
    lambert,
    lommel_seeliger,
    lunar_lambert,
    lunar_lambert_exponential,
    lunar_lambert_weight,
    minnaert,
    multiple_scattering,
    phase_factor,
    power,
    where_lit,
)
from lommel.core.reflectance_kernels import KINDS
from lommel.core.user_reflectance import check_user_function, load_user_function, user_parameters
from lommel.errors import InputError

__all__ = [
    "LAWS",
    "ReflectanceModel",
    "exponential_weight",
    "hapke",
    "lambert",
    "lommel_seeliger",
    "lunar_lambert",
    "lunar_lambert_exponential",
    "lunar_lambert_weight",
    "minnaert",
    "phase_factor",
    "reflectance_model",
    "user_model",
]


@dataclass(frozen=True)
class Law:
    """Formula behind a name, cut so that everything that depends on phase alone is one array.

    Attributes
    ----------
    kind : int
        Branch of the compiled twin, from ``KINDS``; -1 when there is none.
    evaluate : function (cos_incidence, cos_emission, share, *constants) -> (R, dR/dmu0, dR/dmu)
        Called with positive cosines only.
    constants : tuple of float or str
        What ``evaluate`` takes beside ``share``: numbers, or names of parameters.
    share : function (phase, **parameters) -> array like phase
    defaults : dict of str to float
    ranges : dict of str to (lowest, highest)
        Closed intervals; a parameter without one is free.
    """

    kind: int
    evaluate: Callable
    constants: tuple[float | str, ...]
    share: Callable
    defaults: Mapping[str, float] = field(default_factory=dict)
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class ReflectanceModel:
    """Reflectance of albedo 1, with its derivatives; made by :func:`reflectance_model`.

    Attributes
    ----------
    name : str
    parameters : dict of str to float
    phase_factor : (c1, c2) or None
        Multiplies the model by exp(-c1 phase) + c2; None is factor 1.
    law : Law
    """

    name: str
    parameters: Mapping[str, float]
    phase_factor: tuple[float, float] | None
    law: Law = field(repr=False)

    @property
    def kind(self) -> int:
        """Number of the twin in :mod:`lommel.core.reflectance_kernels`; -1 for user models."""
        return self.law.kind

    def parameter_array(self) -> np.ndarray:
        """Constants of the compiled twin, float64 (n,)."""
        return np.array(self._constants(), dtype=np.float64)

    def phase_terms(self, phase):
        """Arrays ``(share, factor)``, each shaped like ``phase``: all that phase alone decides.

        They vary slowly over a scene, so solvers compute them on a coarse grid and interpolate.
        """
        share = self.law.share(np.asarray(phase), **self.parameters)
        if self.phase_factor is None:
            return share, np.ones_like(share)
        return share, phase_factor(phase, *self.phase_factor)

    def with_derivatives(self, cos_incidence, cos_emission, phase):
        """Tuple (R, dR/dcos_incidence, dR/dcos_emission), arrays of the broadcast shape."""
        share, factor = self.phase_terms(phase)
        terms = where_lit(self.law.evaluate, cos_incidence, cos_emission, share, *self._constants())
        return tuple(factor * term for term in terms)

    def reflectance(self, cos_incidence, cos_emission, phase):
        """Array R of the broadcast shape; 0 where unlit or unseen."""
        return self.with_derivatives(cos_incidence, cos_emission, phase)[0]

    def _constants(self):
        """Constants of the law as plain floats, so that float32 arrays stay float32."""
        return [
            float(self.parameters[item] if isinstance(item, str) else item)
            for item in self.law.constants
        ]


def reflectance_model(
    name: str = "lunar-lambert",
    phase_factor: tuple[float, float] | None = None,
    **parameters: float,
) -> ReflectanceModel:
    """Model of that name, parameters checked.

    Parameters
    ----------
    name : str
        One of the table at the head of this module, an entry point of the group
        ``lommel.reflectance``, or ``module:function``.
    phase_factor : (c1, c2) or None
        c1 per radian, c2 not negative.
    **parameters : float
        Replace the defaults; symbols as in the table.

    Raises
    ------
    InputError
        Name or parameter unknown, value out of range, derivatives of a user function wrong.

    Examples
    --------
    >>> reflectance_model("minnaert", k=0.8).parameters
    {'k': 0.8}
    """
    if name in LAWS:
        law = LAWS[name]
    elif (function := load_user_function(name)) is not None:
        return user_model(function, name, phase_factor, **parameters)
    else:
        raise InputError(
            f"reflectance = {name!r} is unknown. Choose one of {', '.join(LAWS)}, "
            "or name a function of your own as module:function."
        )
    _check_parameters(name, law, parameters)
    _check_phase_factor(phase_factor)
    return ReflectanceModel(name, {**law.defaults, **parameters}, phase_factor, law)


def user_model(
    function: Callable,
    name: str,
    phase_factor: tuple[float, float] | None = None,
    **parameters: float,
) -> ReflectanceModel:
    """Model from ``function(cos_incidence, cos_emission, phase, **parameters)``.

    The function returns (R, dR/dcos_incidence, dR/dcos_emission) as arrays; it is called with
    positive cosines only and is checked here against central differences.

    Raises
    ------
    InputError
        A parameter the function does not take, or derivatives that do not fit its values.
    """
    chosen = user_parameters(function, name, parameters)
    check_user_function(function, name, chosen)
    _check_phase_factor(phase_factor)
    law = Law(-1, partial(_call_user, function, tuple(chosen)), tuple(chosen), _phase_itself)
    return ReflectanceModel(name, chosen, phase_factor, law)


def _call_user(function, symbols, mu0, mu, phase, *values):
    """Call the user's function; the share of its law is the phase itself."""
    return function(mu0, mu, phase, **dict(zip(symbols, values, strict=True)))


def _phase_itself(phase, **parameters):
    """Share of a user's law."""
    return phase


def _no_share(phase, **parameters):
    """Share of a law in which phase plays no part."""
    return np.zeros_like(phase)


def _full_share(phase, **parameters):
    """Share of Lommel-Seeliger among the lunar-Lambert blends."""
    return np.ones_like(phase)


def _hapke_share(phase, w, **parameters):
    """Hapke's phase-only part; w stands outside it."""
    return hapke_share(phase, **parameters)


BLEND, POWER, SCATTERING = KINDS["blend"], KINDS["power"], KINDS["multiple-scattering"]

LAWS = {
    "lunar-lambert": Law(
        BLEND, blend, (2.0,), lunar_lambert_weight, {"A": LINEAR, "B": QUADRATIC, "C": CUBIC}
    ),
    "lunar-lambert-exponential": Law(
        BLEND, blend, (1.0,), exponential_weight, {"K": DECAY_DEG}, {"K": (1.0, np.inf)}
    ),
    "lambert": Law(BLEND, blend, (2.0,), _no_share),
    "lommel-seeliger": Law(BLEND, blend, (2.0,), _full_share),
    "minnaert": Law(POWER, power, ("k",), _no_share, {"k": 0.7}, {"k": (0.0, 2.0)}),
    "hapke": Law(
        SCATTERING,
        multiple_scattering,
        ("w",),
        _hapke_share,
        {"w": 0.3, "b": 0.24, "c": 0.3, "B0": 1.8, "h": 0.07},
        {"w": (0, 1), "b": (0, 0.99), "c": (-1, 1), "B0": (0, 5), "h": (1e-3, 10)},
    ),
}


def _check_parameters(name, law, parameters):
    """Raise InputError for a parameter the law does not have or a value out of its range."""
    for symbol, value in parameters.items():
        if symbol not in law.defaults:
            allowed = ", ".join(law.defaults) or "no parameters"
            raise InputError(f"reflectance {name} has no parameter {symbol!r}. It takes {allowed}.")
        lowest, highest = law.ranges.get(symbol, (-np.inf, np.inf))
        if not (np.isfinite(value) and lowest <= value <= highest):
            raise InputError(
                f"{symbol} = {value} of reflectance {name} is out of range. "
                f"Give a finite value from {lowest:g} to {highest:g}."
            )


def _check_phase_factor(factor):
    """Raise InputError unless the factor is None or two numbers that keep it positive."""
    if factor is None:
        return
    if len(factor) != 2 or not np.isfinite(factor).all() or factor[1] < 0:
        raise InputError(
            f"phase_factor = {factor} is not usable. It is (c1, c2) of exp(-c1 phase) + c2, "
            "phase in radians; give two finite numbers, c2 not negative."
        )
