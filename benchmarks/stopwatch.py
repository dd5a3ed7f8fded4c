"""Seconds per stage of a run, each moment counted for the innermost stage that it belongs to."""

import functools
import time


class Stopwatch:
    """Times functions of other modules while they run as usual.

    Attributes
    ----------
    seconds : dict of str to float
        Per stage, without the stages called from within.
    """

    def __init__(self):
        self.seconds = {}
        self._inner = []

    def watch(self, owner, name, stage):
        """Count the time of ``owner.name`` for a stage.

        Parameters
        ----------
        owner : module or class
        name : str
        stage : str or function (arguments of the call) -> str
        """
        function = getattr(owner, name)

        @functools.wraps(function)
        def timed(*args, **kwargs):
            start = time.perf_counter()
            self._inner.append(0.0)
            try:
                return function(*args, **kwargs)
            finally:
                total, inner = time.perf_counter() - start, self._inner.pop()
                label = stage if isinstance(stage, str) else stage(*args)
                self.seconds[label] = self.seconds.get(label, 0.0) + total - inner
                if self._inner:
                    self._inner[-1] += total

        setattr(owner, name, timed)
