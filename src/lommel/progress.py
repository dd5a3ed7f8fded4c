"""How far a long step is and what time it still takes, as plain lines for logs.

Stages call ``progress(items, name)`` around the parts of each step and hand ``progress`` on to what
they call; `silent` shows nothing. Most callers want `Lines`.
"""

import math
import time
from contextlib import contextmanager

EVERY = 60.0  # s between two lines
WORTH_TELLING = 5.0  # s that a step must take to be told of at its end


def silent(items, name, total=None, at_once=1):
    """The items as they are.

    Parameters
    ----------
    items : iterable
        Parts of the step; one counts as done when the next one is asked for.
    name : str
        Of the step.
    total : int, optional
        How many there are; by default the length of ``items``, if it has one.
    at_once : int
        Parts that are worked on side by side.
    """
    return items


@contextmanager
def step(progress, name):
    """A step without parts, around the code that does it.

    Parameters
    ----------
    progress : callable (items, name)
    name : str
    """
    for _ in progress((name,), name):
        yield


def count_of(items, total):
    """Number of items where it is known, else None."""
    return len(items) if total is None and hasattr(items, "__len__") else total


def seconds_left(done, total, seconds, at_once=1):
    """Time that the rest of a step takes if it goes on as before.

    Parts that are worked on side by side end about together, so before the first round is over
    all of it counts as done.

    Parameters
    ----------
    done, total : int
        Parts; at least one is done.
    seconds : float, s
        Since the beginning of the step.
    at_once : int

    Returns
    -------
    left : float, s

    Examples
    --------
    >>> seconds_left(12, 48, 60.0)
    180.0
    >>> seconds_left(1, 48, 60.0, at_once=8)
    300.0
    """
    known = max(done, min(at_once, total))
    return seconds * (total - known) / known


def spoken(seconds):
    """A time as people say it.

    Examples
    --------
    >>> [spoken(x) for x in (0.4, 89, 91, 5000, 5400, 200000)]
    ['0 s', '89 s', '2 min', '83 min', '1 h 30 min', '2 d 8 h']
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"{minutes} min"
    hours = round(seconds / 3600)
    if hours < 48:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{hours // 24} d {hours % 24} h"


class Lines:
    """Tells of steps in lines, about one a minute and one at the end of each; see `silent`.

    Parameters
    ----------
    write : function (text)
    clock : function (), s
    """

    def __init__(self, write, clock=time.monotonic):
        self.write, self.clock = write, clock
        self.shown = -math.inf

    def __call__(self, items, name, total=None, at_once=1):
        """The items, told of on the way."""
        total, done = count_of(items, total), 0
        start = self.clock()
        self.shown = max(self.shown, start)
        for item in items:
            yield item
            done += 1
            now = self.clock()
            if now - self.shown >= EVERY and done != total:
                self.shown = now
                left = "" if total is None else seconds_left(done, total, now - start, at_once)
                left = left and f", {spoken(left)} left"
                self.write(f"{_count(name, done, total)}, {spoken(now - start)} so far{left}")
        seconds = self.clock() - start
        if seconds >= WORTH_TELLING:
            self.write(f"{_count(name, done, total)}, {spoken(seconds)}")


def _count(name, done, total):
    if total == 1:
        return name
    return f"{name} {done}" if total is None else f"{name} {done} of {total}"
