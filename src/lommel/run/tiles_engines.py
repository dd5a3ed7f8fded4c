"""How the parts of a run are shared out: one after the other, to processes, or to Dask.

Jobs are a path and a number; arrays stay on the disk that all workers see. Most callers want
`solve_all`.
"""

from contextlib import contextmanager, nullcontext
from functools import partial

from lommel.errors import InputError, LommelError
from lommel.progress import silent
from lommel.run.apart import ProcessLost, Workers

LOST = (
    "its worker is gone: ended by someone, or by the system for want of memory; with less --memory "
    "parts are smaller"
)


def check_engine(tiling):
    """Refuse an engine that cannot work, before hours are spent on what it is needed for.

    Parameters
    ----------
    tiling : Tiling
    """
    if tiling.engine == "dask":
        _dask_module().check_scheduler(tiling.scheduler)


def solve_all(solve, work, numbers, tiling, progress=silent, name="tiles", engine=None):
    """Solve tiles, or other numbered parts; those that fail are tried once more.

    Rounds go on while they finish parts: a Dask worker that dies may take others' parts along.

    Parameters
    ----------
    solve : function (work, number)
        Gives the text of what went wrong, or None.
    work : Path
        Folder of the parts.
    numbers : list of int
    tiling : Tiling
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.
    name : str
        Of the step.
    engine : function, optional
        From `open_engine`, where several steps share it.

    Returns
    -------
    failed : dict of int to str
        Reasons of the parts that failed twice.
    """
    pending, failed, finished, attempts = list(numbers), {}, 0, 0
    with open_engine(tiling) if engine is None else nullcontext(engine) as start:
        while pending and (attempts < 2 or finished):
            failed = {}
            results, workers = start(solve, work, pending)
            parts = list(zip(pending, results, strict=True))
            for number, result in progress(parts, name, at_once=workers):
                try:
                    reason = result()
                except LommelError:
                    raise
                except Exception as error:  # of a worker that is gone
                    reason = f"{type(error).__name__}: {error}"
                if reason is not None:
                    failed[number] = reason
            finished, pending, attempts = len(pending) - len(failed), list(failed), attempts + 1
    return failed


@contextmanager
def open_engine(tiling):
    """Those who work.

    Parameters
    ----------
    tiling : Tiling

    Yields
    ------
    start : function (solve, work, numbers)
        Gives functions without arguments that wait for one result each, and the number of workers.
    """
    if tiling.is_alone:
        yield _serial
    elif tiling.engine == "processes":
        with Workers(tiling.workers) as workers:
            yield _processes(workers)
    else:
        with _dask_module().connected(tiling) as start:
            yield start


def _serial(solve, work, numbers):
    return [partial(solve, work, number) for number in numbers], 1


def _processes(workers):
    def start(solve, work, numbers):
        futures = [workers.submit(solve, work, number) for number in numbers]
        return [partial(_result, future) for future in futures], workers.count

    return start


def _result(future):
    try:
        return future.result()
    except ProcessLost:
        return LOST


def _dask_module():
    try:
        from lommel.run import tiles_dask
    except ImportError as error:
        raise InputError(
            f"--engine dask needs Dask: {error}. Install it with pip install 'lommel[dask]', or "
            "take --engine processes."
        ) from error
    return tiles_dask
