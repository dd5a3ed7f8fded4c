"""One run at a time for an output; what killed runs left goes, what others need stays."""

import errno
import fcntl
import os
import signal
import subprocess
import sys

import pytest

from lommel.errors import InputError, LommelError
from lommel.run.locks import me, only_run, remove
from lommel.run.products import output_folder

WRITES = """
import sys, time
from lommel.run.products import output_folder

with output_folder(sys.argv[1], overwrite=True) as folder:
    (folder / "dem.tif").write_text("half")
    print("writing", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def other(tmp_path):
    """Another process that is writing into an output."""
    command = [sys.executable, "-c", WRITES, str(tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "writing\n"
        yield process
        process.kill()


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def write(path, **options):
    with output_folder(path, **options) as folder:
        (folder / "run.json").write_text("new")


def test_output_that_another_run_is_writing_is_refused(tmp_path, other):
    before = names(tmp_path)
    with pytest.raises(InputError, match=rf"out is being written by \S+\.{other.pid}\. Wait until"):
        write(tmp_path / "out", overwrite=True)
    assert names(tmp_path) == before
    write(tmp_path / "another")


def test_killed_run_hinders_nobody_and_its_leftovers_go(tmp_path, other):
    other.send_signal(signal.SIGKILL)
    other.wait()
    assert names(tmp_path) == [".out.lock", f".out.{me().split('.')[0]}.{other.pid}.partial"]
    write(tmp_path / "out")
    assert names(tmp_path) == ["out"]


def test_run_killed_while_it_replaced_an_earlier_one_has_taken_nothing(tmp_path):
    earlier = tmp_path / ".out.host.12.replaced"
    earlier.mkdir()
    (earlier / "run.json").write_text("earlier")
    with pytest.raises(KeyboardInterrupt), output_folder(tmp_path / "out", overwrite=True):
        assert names(tmp_path / "out") == ["run.json"]
        raise KeyboardInterrupt
    assert names(tmp_path) == ["out"]
    assert (tmp_path / "out" / "run.json").read_text() == "earlier"


def test_what_belongs_to_others_stays(tmp_path):
    others = [".out.tiles", ".out.b.host.12.partial", ".other.host.12.partial", ".out.12.partial"]
    gone = [".out.host.12.partial", "..out.tiles.a-host.3.gone.partial"]
    for name in (*others, *gone):
        (tmp_path / name).mkdir()
    write(tmp_path / "out")
    assert names(tmp_path) == sorted([*others, "out"])


def test_jobs_of_an_array_run_together_but_not_with_others(tmp_path):
    with only_run(tmp_path / "out", is_shared=True):
        with only_run(tmp_path / "out", is_shared=True) as is_alone:
            assert not is_alone
            with pytest.raises(InputError, match="being written by jobs of an array, like"):
                write(tmp_path / "out")
        assert names(tmp_path) == [".out.lock"]
    assert names(tmp_path) == []


def test_file_system_without_locks_leaves_all_as_it_is(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    (tmp_path / ".out.host.12.partial").mkdir()
    monkeypatch.setattr(fcntl, "flock", refuse)
    with only_run(tmp_path / "out") as is_alone:
        assert not is_alone
        write(tmp_path / "out")
    assert {"out", ".out.host.12.partial"} <= set(names(tmp_path))


def test_what_a_run_goes_on_with_stays_until_the_products_have_their_name(tmp_path):
    """It went before: a run that was killed in between, after hours, had nothing left."""
    work = tmp_path / ".out.tiles"
    work.mkdir()
    with pytest.raises(LommelError, match="could not be put in place"):
        with output_folder(tmp_path / "out", work=work) as folder:
            (folder / "run.json").write_text("new")
            (tmp_path / "out").mkdir()
            (tmp_path / "out" / "notes").touch()
    assert work.exists()
    remove(tmp_path / "out")
    write(tmp_path / "out", work=work)
    assert names(tmp_path) == ["out"]


def test_what_a_run_goes_on_with_stays_until_the_disk_has_the_products(tmp_path, monkeypatch):
    def refuse(_):
        raise OSError(errno.EIO, "Input/output error")

    (tmp_path / ".out.tiles").mkdir()
    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(LommelError, match="may not have reached its disk: Input/output error"):
        write(tmp_path / "out", work=tmp_path / ".out.tiles")
    assert names(tmp_path) == [".out.tiles", "out"]


def test_what_is_removed_loses_its_name_first(tmp_path, monkeypatch):
    """A folder that a killed process has removed by halves must not be taken for a whole one."""
    (tmp_path / "part").mkdir()
    monkeypatch.setattr("shutil.rmtree", lambda *_, **__: None)  # killed here
    remove(tmp_path / "part")
    assert names(tmp_path) == [f".part.{me()}.gone.partial"]
    remove(tmp_path / "not-there")
