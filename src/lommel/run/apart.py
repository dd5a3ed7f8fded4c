"""Functions called in processes of their own, side by side.

A process is started with an interpreter of its own, not by `multiprocessing`, so that scripts which
call lommel need no ``if __name__ == "__main__"``. Most callers want `Workers` or `call_apart`.
"""

import os
import pickle
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from threading import Event, Thread

from lommel.errors import LommelError
from lommel.run.machine import cores

CHILD = "from lommel.run.apart import answer; answer()"
LENGTH = 8  # bytes before a pickle that tell how many follow


class ProcessLost(LommelError):
    """A process ended before it had answered."""


class Workers:
    """Processes that share the cores and call functions; one that is lost is replaced.

    They start when they are needed, and end with the block, or with this process.

    Parameters
    ----------
    count : int
        Processes at a time.
    """

    def __init__(self, count):
        self.count, self.ended = count, Event()
        self.threads = ThreadPoolExecutor(count)  # each waits for a process
        self.alive: set[subprocess.Popen] = set()
        self.idle: SimpleQueue[subprocess.Popen | None] = SimpleQueue()  # None: to be started
        for _ in range(count):
            self.idle.put(None)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.ended.set()
        self.threads.shutdown(wait=False, cancel_futures=True)
        for process in list(self.alive):
            process.kill()
        self.threads.shutdown()
        for process in list(self.alive):
            self._bury(process)

    def submit(self, function, *arguments):
        """Call a function.

        Parameters
        ----------
        function : function (*arguments)
            Of a module; arguments and result can be pickled.
        *arguments

        Returns
        -------
        future : concurrent.futures.Future
            Raises what the function raises, and `ProcessLost`.
        """
        return self.threads.submit(self._call, function, arguments)

    def _call(self, function, arguments):
        question = pickle.dumps((function, arguments))
        process = self.idle.get()
        try:
            process = process or self._start()
            told = _ask(process, question)
            if told is None:
                raise ProcessLost(
                    f"A process ended with status {process.wait()} before it was done: ended "
                    "by someone, or by the system for want of memory. The same command goes on "
                    "from there."
                )
        except BaseException:  # what it would still say is no answer to the next question
            if process is not None:
                self._bury(process)
            process = None
            raise
        finally:
            self.idle.put(process)
        result, error = pickle.loads(told)
        if error is not None:
            raise error
        return result

    def _start(self):
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            "NUMBA_NUM_THREADS": str(max(cores() // self.count, 1)),
        }
        command, pipe = [sys.executable, "-c", CHILD], subprocess.PIPE
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment)
        self.alive.add(process)
        if self.ended.is_set():  # while it was started
            process.kill()
        return process

    def _bury(self, process):
        process.kill()
        process.communicate()  # closes the pipes
        self.alive.discard(process)


def _ask(process, question):
    """The answer of a process, bytes; None when it has ended."""
    try:
        process.stdin.write(len(question).to_bytes(LENGTH) + question)
        process.stdin.flush()
    except BrokenPipeError:
        return None
    return _read(process.stdout)


def _read(pipe):
    """What comes next through a pipe, bytes; None when it is closed before all has come."""
    length = pipe.read(LENGTH)
    size = int.from_bytes(length)
    told = pipe.read(size)
    return told if len(length) == LENGTH and len(told) == size else None


def call_apart(function, arguments, workers):
    """Results of a function for one argument after the other; several are worked on at a time.

    The processes end with the iterator that gives their results.

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
    """
    with Workers(workers) as processes:
        waiting = [processes.submit(function, one) for one in arguments]
        for future in waiting:
            yield future.result()


def answer():
    """Be such a process: answer what is asked, end when nobody asks or waits any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other one is told too, and kills
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever libraries print does not come between
    questions: SimpleQueue[bytes] = SimpleQueue()
    Thread(target=_listen, args=(questions,), daemon=True).start()
    while True:
        told = _answer(questions.get())
        out.write(len(told).to_bytes(LENGTH) + told)
        out.flush()


def _answer(question):
    try:
        function, arguments = pickle.loads(question)
        return pickle.dumps((function(*arguments), None))
    except Exception as error:  # raised where the result is waited for
        try:
            told = pickle.dumps((None, error))
            pickle.loads(told)
        except Exception:  # not everything can be sent
            return pickle.dumps((None, LommelError(f"{type(error).__name__}: {error}")))
        return told


def _listen(questions):
    """Also while an answer is worked on, so that this process ends with the other one at once."""
    while (question := _read(sys.stdin.buffer)) is not None:
        questions.put(question)
    os._exit(1)
