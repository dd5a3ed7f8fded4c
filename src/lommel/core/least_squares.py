"""Gauss-Newton steps that do not diverge, and what an iterative solver hands back."""

from dataclasses import dataclass, field
from typing import Any

ATTEMPTS = 6  # per step, each damped more: a cost that still rises has no way down
LEAST_DAMPING, DAMPING_FACTOR = 0.1, 5.0  # first try, and factor to the next
ROUNDING = 1e-5  # relative, of a cost summed from float32 residuals


@dataclass(frozen=True)
class Solution:
    """End of an iteration.

    Attributes
    ----------
    value : object
        What was solved for.
    outcome : str
        One word, for example ``converged`` or ``step_limit``.
    advice : str
        A sentence that says what happened and, if it is not good, what to change.
    history : list of dict
        One entry per step: cost, size of the step, and what else the solver counts.
    """

    value: Any
    outcome: str
    advice: str
    history: list[dict] = field(default_factory=list)


def more_damping(damping):
    """Damping of the next attempt, after one that raised the cost."""
    return max(DAMPING_FACTOR * damping, LEAST_DAMPING)


def less_damping(damping):
    """Damping of the next step, after one that lowered the cost."""
    return damping / DAMPING_FACTOR if damping > LEAST_DAMPING else 0.0


def stiffen(tensors, damping):
    """Resist changes of slope with a share ``damping`` of the images' mean resistance (Levenberg).

    Parameters
    ----------
    tensors : float32 array (3, rows - 1, cols - 1)
        Gpp, Gpq, Gqq; changed in place.
    damping : float, dimensionless
    """
    if damping > 0:
        mean = (tensors[0].mean(dtype=float) + tensors[2].mean(dtype=float)) / 2
        tensors[0] += tensors.dtype.type(damping * mean)
        tensors[2] += tensors.dtype.type(damping * mean)
