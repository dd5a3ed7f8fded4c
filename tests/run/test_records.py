"""Parts of a run on the disk: whole, damaged, made twice."""

import os

import numpy as np
import pytest

from lommel.errors import LommelError
from lommel.run.records import is_done, is_sound, load_pickled, read_array, save_part


@pytest.fixture
def part(tmp_path):
    save_part(tmp_path / "part", {"dem": np.arange(300.0)}, {"digest": "of it"})
    return tmp_path / "part"


def test_part_that_was_saved_is_done_and_sound(part):
    assert is_done(part, "of it") and is_sound(part, "of it")
    assert not is_done(part, "of another")
    assert not is_sound(part, "of another") and part.exists()


@pytest.mark.parametrize("file", ["dem.npy", "record.json"])
@pytest.mark.parametrize("content", [None, b"", b"\x00" * 10])
def test_part_that_lacks_bytes_is_not_done(part, file, content):
    (part / file).unlink() if content is None else (part / file).write_bytes(content)
    assert not is_done(part, "of it")
    save_part(part, {"dem": np.ones(3)}, {"digest": "of it"})
    assert read_array(part, "dem").tolist() == [1, 1, 1]


def test_part_with_other_bytes_than_it_had_is_removed(part):
    """A machine that loses its power may leave zeros under the name of a file."""
    size = (part / "dem.npy").stat().st_size
    (part / "dem.npy").write_bytes(bytes(size))
    assert is_done(part, "of it")
    assert not is_sound(part, "of it")
    assert not any(part.parent.iterdir())


def test_part_that_another_worker_has_made_stays(part):
    """Others may be reading it."""
    before = os.stat(part).st_ino
    save_part(part, {"dem": np.arange(300.0)}, {"digest": "of it"})
    assert os.stat(part).st_ino == before
    assert [path.name for path in part.parent.iterdir()] == ["part"]


@pytest.mark.parametrize("content", [b"", b"\x00\x01", b"\x80\x04K\x01.", b"cnowhere\nnothing\n."])
def test_damaged_run_is_told(tmp_path, content):
    (tmp_path / "run.pickle").write_bytes(content)
    with pytest.raises(LommelError, match=r"run.pickle is damaged .*Prepare the run anew"):
        load_pickled(tmp_path / "run.pickle")
