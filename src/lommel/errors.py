"""What can go wrong, by whose doing.

A message says what has which value, what is allowed, and what to do next. A single pixel that
misses the body, the image or the light is NaN with ``valid = False``, never an exception.
"""

from typing import Any


class LommelError(Exception):
    """Base of every error that lommel raises on purpose."""


class InputError(LommelError):
    """The request was wrong: a value, a file or a combination of options that cannot work."""


class UnreadableError(InputError):
    """A file is not there, damaged, or of another kind than it was taken for."""


class GeometryError(LommelError):
    """A whole image or tile cannot be placed on the body."""


class ConvergenceError(LommelError):
    """A solver ended without an acceptable answer.

    Parameters
    ----------
    message : str
        What was reached and what to change.
    solution : Solution
        The last state, its named outcome and the history of cost and step.
    """

    def __init__(self, message: str, solution: Any):
        super().__init__(message)
        self.solution = solution
