"""Jobs that do not depend on each other, worked on side by side, their results in order.

What has many of them calls ``jobs.each``; who runs it decides where they are worked on: in threads
of this process (`InThreads`), or in other processes (`lommel.run.parts`). Most callers want
`InThreads`.
"""

from collections import deque
from concurrent.futures import ThreadPoolExecutor

from numba import get_num_threads

from lommel.progress import silent


class InThreads:
    """Works on jobs in threads of this process.

    Parameters
    ----------
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.
    """

    def __init__(self, progress=silent):
        self.progress = progress

    def each(self, function, items, name, together=1, threads=None):
        """What a function gives for each item, in the order of the items.

        Parameters
        ----------
        function : callable (item)
            Of a module, or an object that can be pickled, as are the items and the results.
        items : sequence
        name : str
            Of the step; no other step of a run has the same.
        together : int
            Items that are worth a job where jobs are processes.
        threads : int, optional
            Items side by side in a process; as many as Numba may use by default, and 1 for
            functions that use these themselves.

        Yields
        ------
        result : object
        """
        threads = threads or get_num_threads()
        return self.progress(in_order(function, items, threads), name, len(items), threads)


def in_order(function, items, threads):
    """What a function gives for each item, in order, by threads that are a few items ahead.

    Parameters
    ----------
    function : callable (item)
    items : iterable
    threads : int

    Yields
    ------
    result : object

    Examples
    --------
    >>> list(in_order(abs, (-3, 2, -1), 2))
    [3, 2, 1]
    """
    if threads == 1:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        ahead = deque()
        for item in items:
            ahead.append(pool.submit(function, item))
            if len(ahead) > threads:  # no more: results wait in memory
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
