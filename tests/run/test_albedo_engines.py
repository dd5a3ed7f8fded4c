"""`lommel albedo` by processes, by Dask and as a job array: the bytes of one process."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from lommel.cli import app
from lommel.errors import InputError, LommelError
from lommel.run import parts
from lommel.run.albedo import run_albedo
from lommel.run.albedo_array import merge_albedo, prepare_albedo, solve_albedo_share
from lommel.run.albedo_plan import plan_albedo
from lommel.run.albedo_records import work_folder
from lommel.run.mixed_scene import place_scene
from lommel.run.parts import Parts, job_folder
from lommel.run.shares import Share
from lommel.run.tiles_engines import open_engine
from lommel.run.tiles_plan import Tiling

from .albedo_scene import few_steps, files_of

PRODUCTS = ("albedo.tif", "orthomosaic.tif", "count.tif", "residual.tif", "exposures.csv")


def content(folder):
    return {name: (folder / name).read_bytes() for name in PRODUCTS}


@pytest.fixture(scope="module")
def serial(ground, tmp_path_factory):
    output = tmp_path_factory.mktemp("serial") / "out"
    run_albedo(files_of(ground), output, few_steps())
    return output


@pytest.mark.parametrize("engine", ["processes", "dask"])
def test_engines_give_the_bytes_of_one_process(ground, tmp_path, serial, engine):
    output = tmp_path / "out"
    run_albedo(files_of(ground), output, few_steps(), tiling=Tiling(engine=engine))
    assert content(output) == content(serial)
    records = [json.loads((path / "run.json").read_text()) for path in (output, serial)]
    for name in ("results", "inputs", "outcome", "skipped", "history"):
        assert records[0][name] == records[1][name]
    assert not work_folder(output).exists()


def test_shares_and_merge_give_the_bytes_of_one_run(ground, tmp_path, serial):
    files, output = files_of(ground), tmp_path / "out"
    command = ["albedo", *map(str, files.images), "--dem", str(files.dems[0])]
    command += ["--sun-positions", str(files.sun_positions), "--output", str(output)]
    command += ["--spacecraft-positions", str(files.spacecraft_positions)]
    request = files, output, few_steps(), None, Tiling()
    assert prepare_albedo(*request) == 9
    other = CliRunner().invoke(app, [*command, "--tiles", "2/2"])
    assert "max_steps: not as when" in str(other.exception)
    with pytest.raises(LommelError, match=r"of the step 'terrain' are not done"):
        merge_albedo(output)
    solve_albedo_share(*request, Share(2, 2))
    assert not output.exists()
    merged = CliRunner().invoke(app, ["merge", str(output)])
    assert merged.exit_code == 0
    assert str(output / "albedo.tif") in merged.stdout
    assert content(output) == content(serial)
    assert not work_folder(output).exists()


def test_shares_begin_with_their_own_jobs_and_leave_none(tmp_path, monkeypatch):
    done = []

    def solve_all(solve, work, numbers, *rest):
        done.append(numbers)
        return {}

    monkeypatch.setattr(parts, "solve_all", solve_all)
    with open_engine(Tiling()) as engine:
        terms = tmp_path, "digest", Tiling(), engine, 1, None
        Parts(*terms, Share(2, 3)).each(abs, range(7), "step")
        Parts(*terms, Share(3, 3)).each(abs, range(7), "step", together=3)
    assert done == [[1, 4, 6, 5, 3, 2, 0], [2, 1, 0]]


def test_jobs_that_are_done_are_not_done_again(tmp_path):
    with open_engine(Tiling()) as engine:
        jobs = Parts(tmp_path, "digest", Tiling(), engine, 2, lambda items, *_, **__: items)
        assert list(jobs.each(abs, [-3, 2, -1], "a step", together=2)) == [3, 2, 1]
        before = [os.stat(job_folder(tmp_path / "a-step", k)).st_mtime_ns for k in range(2)]
        assert list(jobs.each(abs, [-3, 2, -1], "a step", together=2)) == [3, 2, 1]
        after = [os.stat(job_folder(tmp_path / "a-step", k)).st_mtime_ns for k in range(2)]
        assert before == after
        other = Parts(tmp_path, "other", Tiling(), engine, 2, jobs.progress)
        assert list(other.each(np.negative, [1, 2, 3], "a step", together=2)) == [-1, -2, -3]


def test_job_that_fails_is_told_and_the_others_are_kept(tmp_path):
    with open_engine(Tiling()) as engine:
        jobs = Parts(tmp_path, "digest", Tiling(), engine, 1, lambda items, *_, **__: items)
        with pytest.raises(LommelError, match=r"1 of 3 jobs of the step 'roots'.*\n.*job 1: Value"):
            jobs.each(int, ["1", "two", "3"], "roots")
        assert list((tmp_path / "roots").glob("0*")) != []


@pytest.mark.parametrize("damage", ["cut off", "zeroed"])
def test_results_that_are_damaged_are_made_anew(tmp_path, damage):
    with open_engine(Tiling()) as engine:
        jobs = Parts(tmp_path, "digest", Tiling(), engine, 1, lambda items, *_, **__: items)
        assert list(jobs.each(abs, [-1, -2], "sizes")) == [1, 2]
        results = job_folder(tmp_path / "sizes", 0) / parts.RESULTS
        results.write_bytes(b"" if damage == "cut off" else bytes(results.stat().st_size))
        assert list(jobs.each(abs, [-1, -2], "sizes")) == [1, 2]


DIES_ONCE = """
import os, pathlib, signal
path = pathlib.Path({!r})
if not path.exists():
    path.touch()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_worker_that_dies_takes_no_result_along(tmp_path):
    tiling = Tiling(engine="processes")
    codes = [DIES_ONCE.format(str(tmp_path / "one")), "pass"]  # two deaths may take three rounds
    with open_engine(tiling) as engine:
        jobs = Parts(tmp_path, "digest", tiling, engine, 1, lambda items, *_, **__: items)
        assert list(jobs.each(exec, codes, "risk")) == [None, None]
        assert list(jobs.each(abs, [-1, -2], "after it")) == [1, 2]


def test_job_that_always_kills_its_worker_takes_no_other_along(tmp_path):
    """With one pool for all, whoever was at work or waited failed too, twice, and with it all."""
    tiling = Tiling(engine="processes")
    codes = ["import time; time.sleep(0.5)"] * 4
    codes[1] = "import os; os.kill(os.getpid(), 9)"
    with open_engine(tiling) as engine:
        jobs = Parts(tmp_path, "digest", tiling, engine, 1, lambda items, *_, **__: items)
        with pytest.raises(LommelError, match=r"1 of 4 jobs.*\n  job 1: its worker is gone: ended"):
            jobs.each(exec, codes, "risk")


AT_WORK = """
import signal, sys
from pathlib import Path
from lommel.run.parts import Parts
from lommel.run.tiles_engines import open_engine
from lommel.run.tiles_plan import Tiling

code = "import os, pathlib, time; pathlib.Path({!r}).write_text(str(os.getpid())); time.sleep(600)"
tiling, folder = Tiling(engine="processes"), Path(sys.argv[1])
with open_engine(tiling) as engine:
    jobs = Parts(folder, "digest", tiling, engine, 1, lambda items, *_, **__: items)
    jobs.each(exec, [code.format(str(folder / "pid"))], "wait")
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_the_command_however_it_ends(tmp_path, number):
    """They would go on beside the run that comes next, or wait for ever for more to do."""
    script, pid = tmp_path / "script.py", tmp_path / "pid"
    script.write_text(AT_WORK)
    command = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path)], stderr=subprocess.PIPE, text=True
    )
    within(60, lambda: pid.exists() and pid.read_text())
    command.send_signal(number)
    said = command.communicate(timeout=60)[1]
    assert said.count("Traceback") == (number == signal.SIGINT)  # its own, not of workers
    within(20, lambda: not is_alive(int(pid.read_text())))


def within(seconds, happens):
    end = time.monotonic() + seconds
    while not happens():
        assert time.monotonic() < end
        time.sleep(0.05)


def is_alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"  # its parent is gone
    except OSError:
        return False


def test_what_cannot_be_shared_is_refused(ground, tmp_path):
    request = files_of(ground), tmp_path / "out"
    alternating = replace(few_steps(), solver="alternating")
    with pytest.raises(InputError, match="alternating goes not with --tiles"):
        prepare_albedo(*request, alternating, None, Tiling())
    with pytest.raises(LommelError, match="--tiles 0/3 first"):
        solve_albedo_share(*request, few_steps(), None, Tiling(), Share(1, 3))
    command = ["albedo", str(ground.images[0]), "--dem", str(ground.initial_dem), "--register"]
    result = CliRunner().invoke(
        app, [*command, "--output", str(tmp_path / "out"), "--tiles", "0/2"]
    )
    assert isinstance(result.exception, InputError) and "lommel register" in str(result.exception)
    assert not list(tmp_path.iterdir())


def test_plan_shares_the_memory_among_workers(ground):
    placed = place_scene(files_of(ground))
    alone, two = (
        plan_albedo(placed, few_steps(), Tiling(4e9, engine)) for engine in ("serial", "processes")
    )
    assert not alone.is_shared and two.is_shared and two.waits_on_disk and two.kept_pixels == 0
    assert two.workers >= 1 and two.memory <= 4e9 and two.disk > alone.disk
    assert f"{two.workers} workers with" in str(two) or two.workers == 1


def test_array_reads_each_image_once(ground, tmp_path):
    """The second share finds all done that the first one left nothing of."""
    request = files_of(ground), tmp_path / "out", few_steps(), None, Tiling()
    prepare_albedo(*request)
    solve_albedo_share(*request, Share(1, 2))
    folder = work_folder(tmp_path / "out")
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    solve_albedo_share(*request, Share(2, 2))
    assert before == {path: path.stat().st_mtime_ns for path in before}
    assert set(before) == {path for path in folder.rglob("*") if path.is_file()}
