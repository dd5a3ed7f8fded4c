"""Reflectance functions that users bring: finding them and checking their derivatives.

A function ``f(cos_incidence, cos_emission, phase, **parameters)`` returns the tuple
(R, dR/dcos_incidence, dR/dcos_emission), arrays shaped like the cosines. It is named as
``module:function``, or by an entry point of the group ``lommel.reflectance``.
"""

import inspect
from importlib import import_module
from importlib.metadata import entry_points

import numpy as np

from lommel.errors import InputError

GROUP = "lommel.reflectance"
STEP = 1e-5  # of the cosines in central differences: error 1e-10 R''', rounding 1e-11
MISMATCH = 1e-5  # of 1 + |derivative|: far above that error, far below a wrong formula's


def load_user_function(name: str):
    """Return the function that ``name`` points to, or None when it names no entry point.

    Raises
    ------
    InputError
        ``module:function`` whose module does not import or has no such function.

    Examples
    --------
    >>> load_user_function("no-such-entry-point") is None
    True
    """
    if ":" not in name:
        found = list(entry_points(group=GROUP, name=name))
        return found[0].load() if found else None
    module_name, _, function_name = name.partition(":")
    try:
        function = getattr(import_module(module_name), function_name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(
            f"reflectance = {name!r} cannot be loaded: {error}. "
            "Give module:function with the module on PYTHONPATH."
        ) from error
    return function


def user_parameters(function, name: str, parameters: dict[str, float]) -> dict[str, float]:
    """Return the function's own defaults, overridden by ``parameters``; all must have a value."""
    signature = list(inspect.signature(function).parameters.values())[3:]
    symbols = [item.name for item in signature]
    unknown = [symbol for symbol in parameters if symbol not in symbols]
    if unknown:
        raise InputError(
            f"reflectance {name} has no parameter {unknown[0]!r}. "
            f"It takes {', '.join(symbols) or 'no parameters'}."
        )
    chosen = {item.name: parameters.get(item.name, item.default) for item in signature}
    missing = [symbol for symbol, value in chosen.items() if value is inspect.Parameter.empty]
    if missing:
        raise InputError(
            f"reflectance {name} needs a value for {', '.join(missing)}. "
            "Give one, or a default in the function."
        )
    return chosen


def check_user_function(function, name: str, parameters: dict[str, float]) -> None:
    """Compare the derivatives of a function with central differences of its values.

    Raises
    ------
    InputError
        Naming the worst mismatch over 200 possible geometries up to 75 degrees from the normal.
    """
    mu0, mu, phase = _sample_geometries()

    def values(cos_incidence, cos_emission):
        answer = function(cos_incidence, cos_emission, phase, **parameters)
        if not isinstance(answer, tuple | list) or len(answer) != 3:
            raise InputError(
                f"reflectance {name} must return three arrays: "
                "R, dR/dcos_incidence, dR/dcos_emission."
            )
        terms = [np.asarray(term, dtype=float) for term in answer]
        if not all(np.isfinite(term).all() for term in terms):
            raise InputError(
                f"reflectance {name} is not finite for cosines in (0.2, 1). "
                "Return finite numbers there."
            )
        return [np.broadcast_to(term, mu0.shape) for term in terms]

    _, *given = values(mu0, mu)
    differences = [
        (values(mu0 + STEP, mu)[0] - values(mu0 - STEP, mu)[0]) / (2 * STEP),
        (values(mu0, mu + STEP)[0] - values(mu0, mu - STEP)[0]) / (2 * STEP),
    ]
    mismatch = np.abs(np.subtract(given, differences)) / (1 + np.abs(differences))
    which, at = np.unravel_index(np.argmax(mismatch), mismatch.shape)
    if mismatch[which, at] > MISMATCH:
        raise InputError(
            f"reflectance {name}: {('dR/dcos_incidence', 'dR/dcos_emission')[which]} is "
            f"{given[which][at]:.6g} at cos_incidence = {mu0[at]:.3f}, cos_emission = {mu[at]:.3f},"
            f" phase = {phase[at]:.3f} rad, but its values change by {differences[which][at]:.6g}."
            " Correct the derivative."
        )


def _sample_geometries():
    """Cosines and phases (200,) of facets lit and seen from within 75 degrees of the normal."""
    random = np.random.default_rng(1)
    incidence, emission = np.radians(random.uniform(2, 75, (2, 200)))
    azimuth = random.uniform(0, np.pi, 200)
    mu0, mu = np.cos(incidence), np.cos(emission)
    return mu0, mu, np.arccos(mu0 * mu + np.sin(incidence) * np.sin(emission) * np.cos(azimuth))
