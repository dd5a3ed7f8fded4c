"""What goes wrong while tiles are solved: a full disk, an image that breaks."""

import os
import shutil
import subprocess

import numpy as np
import pytest

from lommel.errors import LommelError
from lommel.run import tiles
from lommel.run.records import RUN, disk_errors, is_done, read_record, save_part
from lommel.run.shape_from_shading import run_shape_from_shading
from lommel.run.tiles import solve_part
from lommel.run.tiles_array import merge_tiles
from lommel.run.tiles_plan import Tiling, work_folder
from lommel.run.tiles_records import load_run, part_folder

from .tiled_scene import SIDE, files_of, fingerprints

TILING = Tiling(side=SIDE)


def mount(folder, options):
    if shutil.which("mount") is None or os.geteuid() != 0:
        pytest.skip("needs the right to mount a small disk")
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"no small disk can be mounted here: {done.stderr.strip()}")


@pytest.fixture
def small_disk(tmp_path):
    folder = tmp_path / "disk"
    folder.mkdir()
    mount(folder, "size=64m")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_run_goes_on_when_a_full_disk_has_room_again(half_done, small_disk, tile_scene, tiled):
    output = small_disk / "out"
    shutil.move(work_folder(half_done), work_folder(output))
    used = shutil.disk_usage(small_disk).used
    mount(small_disk, f"remount,size={used + 200_000}")
    message = r"4 of 9 tiles failed.*\n  tile 1: the disk of .* has 0\.2 MB free, 1\.\d MB are"
    with pytest.raises(LommelError, match=message):
        run_shape_from_shading(files_of(tile_scene), output, tiling=TILING)
    assert not output.exists()
    mount(small_disk, "remount,size=64m")
    run_shape_from_shading(files_of(tile_scene), output, tiling=TILING)
    assert fingerprints(output) == fingerprints(tiled)


def test_what_the_disk_refuses_is_told_in_words(tmp_path):
    with (
        pytest.raises(LommelError, match=r"not-made cannot be written: too full; \d.* MB"),
        disk_errors(tmp_path / "not-made"),
    ):
        raise OSError(28, "too full")


@pytest.mark.parametrize("damage", ["gone", "truncated", "replaced"])
def test_a_tile_fails_when_its_image_breaks_and_is_not_solved_without_it(
    half_done, tile_scene, damage
):
    image, work = tile_scene / "img2.tif", work_folder(half_done)
    aside = image.rename(tile_scene / "aside")
    try:
        if damage != "gone":
            content = aside.read_bytes()
            image.write_bytes(content[:4000] if damage == "truncated" else content)
        assert str(image) in solve_part(work, 1)
        assert not part_folder(work, 1).exists()
    finally:
        aside.replace(image)
    assert solve_part(work, 1) is None
    assert is_done(part_folder(work, 1), load_run(work).digest)
    assert read_record(part_folder(work, 1))["images"] == ["img1.tif", "img2.tif"]


def test_parts_that_a_crash_has_damaged_are_made_anew(half_done, tile_scene, tiled):
    """Files were cut off, zeroed or gone: a traceback, or products made of zeros."""
    work = work_folder(half_done)
    damage(part_folder(work, 0) / "dem.npy", bytes)
    damage(part_folder(work, 2) / "albedo.npy", lambda size: b"")
    damage(part_folder(work, 4) / "record.json", bytes)
    (part_folder(work, 6) / "residual.npy").unlink()
    damage(work / "scene" / "correction.npy", bytes)
    damage(work / RUN, lambda size: bytes(range(256)))
    damage(work / "plan.json", bytes)
    run_shape_from_shading(files_of(tile_scene), half_done, tiling=TILING)
    assert fingerprints(half_done) == fingerprints(tiled)


def damage(path, content):
    path.write_bytes(content(path.stat().st_size))


def test_merge_tells_which_damaged_tiles_are_to_be_solved_again(half_done):
    damage(part_folder(work_folder(half_done), 4) / "dem.npy", bytes)
    with pytest.raises(LommelError, match="5 of 9 tiles are not solved: 1, 3, 4, 5, 7"):
        merge_tiles(half_done)
    damage(work_folder(half_done) / "scene" / "noise.npy", bytes)
    with pytest.raises(LommelError, match="is not prepared. Run --tiles 0/N again"):
        merge_tiles(half_done)


def test_tile_that_a_worker_of_an_earlier_run_replaces_is_noticed(
    half_done, tile_scene, monkeypatch
):
    """A Dask worker goes on when its run is killed; its tile, of other settings, was blended in."""
    finish = tiles.finish_products

    def replaced_after(run, work, *rest):
        finish(run, work, *rest)
        save_part(part_folder(work, 3), {"dem": np.zeros(3)}, {"digest": "of the earlier run"})

    monkeypatch.setattr(tiles, "finish_products", replaced_after)
    with pytest.raises(LommelError, match="tile-00003 was replaced meanwhile, by a worker"):
        run_shape_from_shading(files_of(tile_scene), half_done, tiling=TILING)
    assert not half_done.exists()
