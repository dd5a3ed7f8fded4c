"""What an iterative solver hands back: the value, how it ended, and the way there."""

from dataclasses import dataclass, field
from typing import Any


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
