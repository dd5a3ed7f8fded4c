"""Output folders appear whole or not at all; records say what was done."""

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from lommel.errors import InputError, LommelError
from lommel.run.products import RunRecord, output_folder


def listing(folder):
    """Every file below a folder, hidden ones too, with its content."""
    return {
        str(path.relative_to(folder)): path.read_text() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


@pytest.fixture
def earlier(tmp_path):
    """The folder of an earlier run."""
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "run.json").write_text("{}")
    (folder / "dem.tif").write_text("the old one")
    return folder


def write_into(path, overwrite=False):
    with output_folder(path, overwrite) as staging:
        (staging / "dem.tif").write_text("new")


def test_folder_appears_when_all_is_written(tmp_path):
    with output_folder(tmp_path / "deep" / "out") as staging:
        (staging / "dem.tif").write_text("new")
        assert not (tmp_path / "deep" / "out").exists()
    assert listing(tmp_path) == {"deep": None, "deep/out": None, "deep/out/dem.tif": "new"}


def test_empty_folder_is_filled(tmp_path):
    (tmp_path / "out").mkdir()
    write_into(tmp_path / "out")
    assert listing(tmp_path) == {"out": None, "out/dem.tif": "new"}


@pytest.mark.parametrize("failure", [ValueError, InputError, KeyboardInterrupt, SystemExit])
def test_failure_leaves_nothing_not_even_the_parent_folders(tmp_path, failure):
    with pytest.raises(failure), output_folder(tmp_path / "deep" / "out") as staging:
        (staging / "dem.tif").write_text("half")
        raise failure
    assert listing(tmp_path) == {}


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt])
def test_failure_keeps_what_was_to_be_replaced(tmp_path, earlier, failure):
    before = listing(tmp_path)
    with pytest.raises(failure), output_folder(earlier, overwrite=True) as staging:
        (staging / "dem.tif").write_text("half")
        raise failure
    assert listing(tmp_path) == before


def test_earlier_run_is_replaced_whole(tmp_path, earlier):
    write_into(earlier, overwrite=True)
    assert listing(tmp_path) == {"out": None, "out/dem.tif": "new"}


def test_link_to_a_folder_stays_a_link(tmp_path, earlier):
    (tmp_path / "latest").symlink_to(earlier, target_is_directory=True)
    write_into(tmp_path / "latest", overwrite=True)
    assert (tmp_path / "latest").is_symlink()
    assert listing(earlier) == {"dem.tif": "new"}


def test_filled_folder_needs_overwrite(tmp_path, earlier):
    before = listing(tmp_path)
    with pytest.raises(InputError, match=r"out exists and is not empty.*replace it with --overw"):
        write_into(earlier)
    assert listing(tmp_path) == before


def test_folder_that_no_run_has_written_is_never_replaced(tmp_path):
    """--output . --overwrite would have removed the images of the user's folder."""
    (tmp_path / "image.tif").write_text("precious")
    with pytest.raises(InputError, match="holds no run.json, so it is not the folder of an ear"):
        write_into(tmp_path, overwrite=True)
    assert listing(tmp_path) == {"image.tif": "precious"}


def test_folder_filled_meanwhile_is_kept_and_the_products_too(tmp_path):
    """Two runs into one folder: the later one must not remove the earlier one's results."""
    with (
        pytest.raises(LommelError, match=r"could not be put in place.*whole and wait in (.*):"),
        output_folder(tmp_path / "out") as staging,
    ):
        (staging / "dem.tif").write_text("later")
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "dem.tif").write_text("earlier")
    assert (tmp_path / "out" / "dem.tif").read_text() == "earlier"
    assert (staging / "dem.tif").read_text() == "later"


def test_rename_that_fails_restores_what_stood_there(tmp_path, earlier, monkeypatch):
    before = listing(tmp_path)
    rename = Path.rename

    def fail_on_staging(self, target):
        if self.name.endswith(".partial"):
            raise OSError("no")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail_on_staging)
    with pytest.raises(LommelError, match="could not be put in place"):
        write_into(earlier, overwrite=True)
    monkeypatch.undo()
    assert before.items() <= listing(tmp_path).items()


def test_file_is_no_folder(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(InputError, match="out is a file. Name a folder"):
        write_into(tmp_path / "out", overwrite=True)


@pytest.mark.parametrize("place", ["file/out", "file/deep/out", "x" * 300])
def test_place_that_cannot_be_written_is_an_error(tmp_path, place):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot be written: .*\. Name a folder on a disk"):
        write_into(tmp_path / place)
    assert listing(tmp_path) == {"file": ""}


@dataclass
class Left:
    name: str
    reason: str


def test_record_is_plain_json_with_every_key(tmp_path):
    data = tmp_path / "dem.tif"
    data.write_bytes(b"heights")
    settings = {"spacing": np.float32(2.5), "path": data, "bounds": np.arange(2.0), "max": np.inf}
    record = RunRecord(
        "sfs", settings, results={"rmse_m": np.float64("nan"), "images": np.int64(3)}
    )
    record.add_inputs([data, tmp_path / "nowhere.tif"])
    record.add_skipped([Left("a.tif", "a.tif does not overlap the DEM.")])
    with record.stage("solve"):
        pass
    record.outcome = {"name": "done", "sentence": "Done."}
    record.history = [{"step": 1, "cost": 2.0, "change": float("nan")}]
    record.write(tmp_path)

    def refuse(word):
        raise ValueError(word)  # NaN and Infinity are no JSON

    found = json.loads((tmp_path / "run.json").read_text(), parse_constant=refuse)
    assert set(found) == {
        *("lommel", "created", "command", "settings", "inputs", "stages", "skipped", "results"),
        *("history", "outcome", "targets", "versions", "machine", "not_chosen"),
    }
    assert found["settings"] == {"spacing": 2.5, "path": str(data), "bounds": [0, 1], "max": None}
    assert found["results"] == {"rmse_m": None, "images": 3}
    digest = hashlib.sha256(b"heights").hexdigest()
    assert found["inputs"][0] == {"path": str(data), "bytes": 7, "sha256": digest}
    assert found["inputs"][1]["error"] == os.strerror(2)
    assert found["skipped"] == [{"image": "a.tif", "reason": "a.tif does not overlap the DEM."}]
    assert found["stages"][0]["name"] == "solve"
    assert found["stages"][0]["seconds"] >= 0
    assert found["stages"][0]["peak_memory_mb"] > 1
