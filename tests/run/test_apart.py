"""Functions called in processes of their own."""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lommel.errors import InputError, LommelError
from lommel.run import apart
from lommel.run.apart import ProcessLost, Workers, call_apart
from lommel.run.tiles_plan import read_memory

SLEEPING = """
import time
from lommel.run.apart import call_apart
list(call_apart(time.sleep, [60], 1))
"""


def test_results_come_in_the_order_of_the_arguments():
    assert list(call_apart(math.sqrt, [1, 4, 9], 2)) == [1, 2, 3]


def test_processes_share_the_cores(monkeypatch):
    monkeypatch.setattr(apart, "cores", lambda: 6)
    assert list(call_apart(os.getenv, ["NUMBA_NUM_THREADS"], 2)) == ["3"]


def test_what_a_function_prints_is_no_result(capfd):
    assert list(call_apart(print, ["ink"], 1)) == [None]
    assert "ink" in capfd.readouterr().err


def test_what_a_function_raises_is_raised_here():
    with pytest.raises(ValueError, match="domain"):
        list(call_apart(math.sqrt, [1, -1], 2))
    with pytest.raises(InputError, match="'much' is not a size"):
        list(call_apart(read_memory, ["much"], 1))


def test_a_process_that_is_lost_is_told_and_the_others_end():
    start = time.monotonic()
    results = call_apart(eval, ["__import__('os')._exit(3)", "__import__('time').sleep(60)"], 2)
    with pytest.raises(LommelError, match="status 3"):
        list(results)
    assert time.monotonic() - start < 30  # s, of the 60 that the other one was to sleep


def test_a_process_answers_again_and_one_that_is_lost_is_replaced():
    with Workers(1) as workers:
        first, again = (workers.submit(os.getpid) for _ in range(2))
        assert first.result() == again.result() != os.getpid()
        with pytest.raises(ProcessLost, match="status -9"):
            workers.submit(os.kill, first.result(), signal.SIGKILL).result()
        assert workers.submit(os.getpid).result() not in (first.result(), os.getpid())


def test_what_cannot_be_sent_is_raised_and_the_process_goes_on():
    with Workers(1) as workers:
        with pytest.raises(Exception, match="pickle"):
            workers.submit(math.sqrt, lambda: 4).result()
        with pytest.raises(Exception, match="pickle"):
            workers.submit(eval, "lambda: 4").result()
        assert workers.submit(math.sqrt, 4).result() == 2


def test_a_process_that_cannot_be_started_is_an_error_of_its_call_alone(monkeypatch):
    with Workers(1) as workers:
        monkeypatch.setattr(apart, "CHILD", "raise SystemExit(5)")
        with pytest.raises(ProcessLost, match="status 5"):
            workers.submit(math.sqrt, 4).result()
        monkeypatch.setattr(sys, "executable", "/no/such/program")
        with pytest.raises(OSError, match="no/such/program"):
            workers.submit(math.sqrt, 4).result()
        monkeypatch.undo()
        assert workers.submit(math.sqrt, 4).result() == 2


def test_an_error_that_cannot_be_sent_is_told_in_words():
    code = "def f(n):\n class Own(Exception): pass\n raise Own('words')"
    with Workers(1) as workers, pytest.raises(LommelError, match="Own: words"):
        workers.submit(exec, f"{code}\nf(1)").result()


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
def test_processes_end_with_the_one_that_waits_for_them():
    waiting = subprocess.Popen([sys.executable, "-c", SLEEPING])
    try:
        assert _within(30, lambda: _children(waiting.pid))
        child = _children(waiting.pid)[0]
        waiting.send_signal(signal.SIGKILL)
        waiting.wait()
        assert _within(10, lambda: not Path(f"/proc/{child}").exists())
    finally:
        waiting.kill()


def _children(process):
    """Of all its threads."""
    try:
        threads = Path(f"/proc/{process}/task").iterdir()
        return [child for t in threads for child in (t / "children").read_text().split()]
    except OSError:
        return []


def _within(seconds, holds):
    """Whether something comes true in time."""
    end = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True
