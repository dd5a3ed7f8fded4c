"""Tiles as the shares of a job array: prepared once, solved apart, merged into the same bytes."""

import json
import os
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from lommel.cli import app
from lommel.errors import InputError, LommelError
from lommel.run import tiles
from lommel.run.shape_from_shading import SfsSettings
from lommel.run.shares import Share, read_share
from lommel.run.tiles_array import merge_tiles, prepare_array, solve_share
from lommel.run.tiles_plan import Tiling, work_folder

from .tiled_scene import SIDE, files_of, fingerprints

TILING = Tiling(side=SIDE)


def test_shares_and_merge_give_the_bytes_of_one_run(half_done, tile_scene, tiled):
    message = r"4 of 9 tiles are not solved: 1, 3, 5, 7\. .*--tiles 1/1"
    with pytest.raises(LommelError, match=message):
        merge_tiles(half_done)
    command = ["sfs", *map(str, files_of(tile_scene).images), "--dem"]
    command += [str(tile_scene / "init_dem.tif"), "--output", str(half_done), "--sun-positions"]
    command += [str(tile_scene / "sun_positions.txt"), "--tiles", "1/1"]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert not half_done.exists()
    merged = CliRunner().invoke(app, ["merge", str(half_done)])
    assert merged.exit_code == 0
    assert str(half_done / "dem.tif") in merged.stdout
    assert fingerprints(half_done) == fingerprints(tiled)
    assert not work_folder(half_done).exists()
    ones = [json.loads((path / "run.json").read_text()) for path in (half_done, tiled)]
    for name in ("results", "inputs", "outcome", "skipped"):
        assert ones[0][name] == ones[1][name]


def test_shares_are_every_tile_once(half_done, tile_scene, monkeypatch):
    solved = []
    monkeypatch.setattr(
        "lommel.run.tiles_array.solve_tiles", lambda _, part, *rest: solved.append(part)
    )
    request = files_of(tile_scene), half_done, SfsSettings(), None, TILING
    counts = [solve_share(*request, Share(k, 4)) for k in (1, 2, 3, 4)]
    assert counts == [3, 2, 2, 2]
    assert sorted(tile.number for part in solved for tile in part) == list(range(9))


def test_a_share_before_the_scene_is_prepared_says_so(tile_scene, tmp_path):
    request = files_of(tile_scene), tmp_path / "out", SfsSettings(), None, TILING
    with pytest.raises(LommelError, match="--tiles 0/3 first"):
        solve_share(*request, Share(1, 3))
    with pytest.raises(InputError, match="no tiles beside it"):
        merge_tiles(tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_share_of_another_request_is_refused(half_done, tile_scene):
    files, share = files_of(tile_scene), Share(2, 2)
    with pytest.raises(InputError, match="parametrisation: not as when"):
        solve_share(files, half_done, SfsSettings("ray"), None, TILING, share)
    fewer = replace(files, images=files.images[:1])
    with pytest.raises(InputError, match="not those the scene was prepared with"):
        solve_share(fewer, half_done, SfsSettings(), None, TILING, share)


def test_an_image_that_changed_after_the_preparation_is_noticed(half_done, tile_scene):
    files = files_of(tile_scene)
    before = os.stat(files.images[1])
    os.utime(files.images[1])
    try:
        with pytest.raises(InputError, match="img2.tif has changed"):
            solve_share(files, half_done, SfsSettings(), None, TILING, Share(2, 2))
    finally:
        os.utime(files.images[1], ns=(before.st_atime_ns, before.st_mtime_ns))


def test_what_cannot_be_shared_is_refused(tile_scene, tmp_path):
    request = files_of(tile_scene), tmp_path / "out"
    with pytest.raises(InputError, match="lommel register"):
        prepare_array(*request, SfsSettings(registers=True), None, TILING)
    with pytest.raises(InputError, match="fits in memory in one piece"):
        prepare_array(*request, SfsSettings(), None, Tiling(memory=4e9))


def test_work_of_another_version_is_refused(half_done, monkeypatch):
    monkeypatch.setattr("lommel.run.records.__version__", "0.0.0")
    assert "0.0.0" in tiles.solve_part(work_folder(half_done), 1)


@pytest.mark.parametrize("text", ["", "3", "0/0", "5/4", "-1/4", "1/4/2", "a/b"])
def test_what_is_no_share_is_refused(text):
    with pytest.raises(InputError, match="1/64 to 64/64"):
        read_share(text)
