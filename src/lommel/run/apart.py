"""Functions called in processes of their own, side by side.

A process is started with an interpreter of its own, not by `multiprocessing`, so that scripts which
call lommel need no ``if __name__ == "__main__"``. Most callers want `call_apart`.
"""

import os
import pickle
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Event, Thread

from lommel.errors import LommelError
from lommel.run.machine import cores

CHILD = "from lommel.run.apart import answer; answer()"


def call_apart(function, arguments, workers):
    """Results of a function for one argument after the other; several are worked on at a time.

    The processes share the cores, and end with this one and with the iterator that gives their
    results.

    Parameters
    ----------
    function : function (argument)
        Of a module; argument and result can be pickled.
    arguments : sequence
    workers : int
        Processes at a time.

    Yields
    ------
    result

    Raises
    ------
    LommelError
        When a process ends without a result; what the function raises is raised as it is.
    """
    alive: set[subprocess.Popen] = set()
    ended = Event()
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "NUMBA_NUM_THREADS": str(max(cores() // workers, 1)),
    }
    threads = ThreadPoolExecutor(workers)  # each waits for a process
    try:
        waiting = [
            threads.submit(_ask, function, one, environment, alive, ended) for one in arguments
        ]
        for future in waiting:
            yield future.result()
    finally:
        ended.set()
        threads.shutdown(wait=False, cancel_futures=True)
        for process in list(alive):
            process.kill()
        threads.shutdown()


def _ask(function, argument, environment, alive, ended):
    command = [sys.executable, "-c", CHILD]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment) as process:
        alive.add(process)
        if ended.is_set():  # while it was started
            process.kill()
        try:
            with suppress(BrokenPipeError):  # it has ended, as is told below
                pickle.dump((function, argument), process.stdin)
                process.stdin.flush()
            told = process.stdout.read()
        finally:
            alive.discard(process)
    if not told:
        raise LommelError(
            f"A process ended with status {process.returncode} before it was done: ended by "
            "someone, or by the system for want of memory. The same command goes on from there."
        )
    result, error = pickle.loads(told)
    if error is not None:
        raise error
    return result


def answer():
    """Be such a process: read what is asked, write the result, end when nobody waits any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other one is told too, and kills
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever libraries print does not come between
    function, argument = pickle.load(sys.stdin.buffer)
    Thread(target=_end_with_the_other, daemon=True).start()
    try:
        told = function(argument), None
    except Exception as error:  # raised where the result is waited for
        told = None, error
    pickle.dump(told, out)
    out.flush()
    os._exit(0)


def _end_with_the_other():
    sys.stdin.buffer.read()
    os._exit(1)
