"""How the parts of a run are shared out: one after the other, to processes, or to Dask.

Jobs are a path and a number; arrays stay on the disk that all workers see. Most callers want
`solve_all`.
"""

import os
import signal
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from multiprocessing import Pipe, get_context
from queue import SimpleQueue
from threading import Lock, Thread

from lommel.errors import InputError, LommelError
from lommel.progress import silent
from lommel.run.machine import cores

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
    if tiling.engine == "serial":
        yield _serial
    elif tiling.engine == "processes":
        with _Processes(tiling.workers) as processes:
            yield processes.start
    else:
        with _dask_module().connected(tiling) as start:
            yield start


def _serial(solve, work, numbers):
    return [partial(solve, work, number) for number in numbers], 1


class _Processes:
    """Workers of their own, who share the cores among them; one that dies takes only its part.

    Each holds the end of a pipe whose other end this process has alone. When that is closed, by a
    run that is broken off or by the system because this process is gone, workers end at once.
    """

    def __init__(self, workers):
        self.workers, self.starting = workers, Lock()
        self.end_of_pipe, self.pipe = Pipe(duplex=False)
        self.threads = ThreadPoolExecutor(workers)  # each waits for a worker
        self.idle: SimpleQueue[ProcessPoolExecutor] = SimpleQueue()
        for _ in range(workers):
            self.idle.put(self._new_worker())

    def __enter__(self):
        return self

    def __exit__(self, error, *_):
        self.threads.shutdown(wait=False, cancel_futures=True)
        if error is not None:
            self.pipe.close()
        self.threads.shutdown()
        for _ in range(self.workers):
            self.idle.get().shutdown()
        self.pipe.close()
        self.end_of_pipe.close()

    def start(self, solve, work, numbers):
        """As of `open_engine`; workers that are lost are replaced."""
        futures = [self.threads.submit(self._solve, solve, work, number) for number in numbers]
        return [future.result for future in futures], self.workers

    def _new_worker(self):
        context = get_context("spawn")
        return ProcessPoolExecutor(1, context, _watch, (self.end_of_pipe,))

    def _solve(self, *job):
        worker = self.idle.get()
        try:
            with self.starting:
                future = self._submit(worker, job)
            return future.result()
        except BrokenProcessPool:
            worker = self._new_worker()
            return LOST
        finally:
            self.idle.put(worker)

    def _submit(self, worker, job):
        """A worker begins here, and takes the number of its threads from the environment."""
        before = os.environ.get("NUMBA_NUM_THREADS")
        os.environ["NUMBA_NUM_THREADS"] = str(max(cores() // self.workers, 1))
        try:
            return worker.submit(*job)
        finally:
            if before is None:
                del os.environ["NUMBA_NUM_THREADS"]
            else:
                os.environ["NUMBA_NUM_THREADS"] = before


def _watch(pipe):
    """Let this worker end with the process that has the other end of a pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other one is told too, and tells

    def end():
        with suppress(EOFError):
            pipe.recv()
        os._exit(1)

    Thread(target=end, daemon=True).start()


def _dask_module():
    try:
        from lommel.run import tiles_dask
    except ImportError as error:
        raise InputError(
            f"--engine dask needs Dask: {error}. Install it with pip install 'lommel[dask]', or "
            "take --engine processes."
        ) from error
    return tiles_dask
