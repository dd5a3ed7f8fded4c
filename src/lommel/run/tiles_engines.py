"""How the tiles of a scene are shared out: one after the other, to processes, or to Dask.

Jobs are a path and a number; arrays stay on the disk that all workers see. Most callers want
`solve_all`.
"""

import os
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context

from lommel.errors import InputError, LommelError
from lommel.progress import silent
from lommel.run.tiles_plan import cores


def check_engine(tiling):
    """Refuse an engine that cannot work, before hours are spent on what it is needed for.

    Parameters
    ----------
    tiling : Tiling
    """
    if tiling.engine == "dask":
        _dask_module().check_scheduler(tiling.scheduler)


def solve_all(solve, work, numbers, tiling, progress=silent):
    """Solve tiles; those that fail are tried once more.

    Rounds go on while they finish tiles: a worker that dies takes others' tiles along.

    Parameters
    ----------
    solve : function (work, number)
        Gives the text of what went wrong, or None.
    work : Path
        Folder of the tiles.
    numbers : list of int
    tiling : Tiling
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.

    Returns
    -------
    failed : dict of int to str
        Reasons of the tiles that failed twice.
    """
    engine = {"serial": _serial, "processes": _processes, "dask": _dask}[tiling.engine]
    pending, failed, finished, attempts = list(numbers), {}, 0, 0
    while pending and (attempts < 2 or finished):
        failed = {}
        with engine(solve, work, pending, tiling) as (results, workers):
            tiles = list(zip(pending, results, strict=True))
            for number, result in progress(tiles, "tiles", at_once=workers):
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
def _serial(solve, work, numbers, tiling):
    yield [partial(solve, work, number) for number in numbers], 1


@contextmanager
def _processes(solve, work, numbers, tiling):
    """Workers of their own, who share the cores among them."""
    before = os.environ.get("NUMBA_NUM_THREADS")
    os.environ["NUMBA_NUM_THREADS"] = str(max(cores() // tiling.workers, 1))
    try:
        with ProcessPoolExecutor(tiling.workers, get_context("spawn")) as pool:
            futures = [pool.submit(solve, work, number) for number in numbers]
            yield [future.result for future in futures], tiling.workers
    finally:
        if before is None:
            del os.environ["NUMBA_NUM_THREADS"]
        else:
            os.environ["NUMBA_NUM_THREADS"] = before


@contextmanager
def _dask(solve, work, numbers, tiling):
    with _dask_module().submitted(solve, work, numbers, tiling) as submitted:
        yield submitted


def _dask_module():
    try:
        from lommel.run import tiles_dask
    except ImportError as error:
        raise InputError(
            f"--engine dask needs Dask: {error}. Install it with pip install 'lommel[dask]', or "
            "take --engine processes."
        ) from error
    return tiles_dask
