"""The memory that `lommel albedo` keeps to, and runs that are broken off and go on."""

import os
import re
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from lommel.errors import InputError, LommelError
from lommel.estimate import albedo_samples
from lommel.run import albedo_plan, albedo_records, mixed_scene
from lommel.run.albedo import run_albedo
from lommel.run.albedo_array import merge_albedo, prepare_albedo, solve_albedo_share
from lommel.run.albedo_plan import plan_albedo
from lommel.run.albedo_records import work_folder
from lommel.run.mixed_scene import Place, PlacedScene, place_scene
from lommel.run.records import save_part
from lommel.run.shares import Share
from lommel.run.tiles_plan import Tiling
from lommel.scene.grid import Window, grid_from_bounds, read_crs

from .albedo_scene import few_steps, files_of

PRODUCTS = ("albedo.tif", "orthomosaic.tif", "count.tif", "residual.tif", "exposures.csv")


@pytest.fixture(autouse=True)
def small_parts(monkeypatch):
    """Parts so small that the strip has many; images wait on the disk."""
    monkeypatch.setattr(albedo_plan, "HELD_BYTES", 0)
    monkeypatch.setattr(albedo_samples, "PIXELS_AT_ONCE", 1000)
    monkeypatch.setattr(mixed_scene, "POSTS_AT_ONCE", 300)


def content(folder):
    return {name: (folder / name).read_bytes() for name in PRODUCTS}


@pytest.fixture
def unbroken(ground, tmp_path):
    run_albedo(files_of(ground), tmp_path / "unbroken", few_steps())
    return content(tmp_path / "unbroken")


class Steps(list):
    """Notes the names of steps and how many parts of each were done."""

    def __call__(self, items, name, total=None, at_once=1):
        self.append(name)
        return items


def test_memory_does_not_change_the_products(ground, tmp_path, monkeypatch, unbroken):
    plans = []
    original = albedo_plan.AlbedoPlan.limits
    monkeypatch.setattr(
        albedo_plan.AlbedoPlan, "limits", lambda plan: plans.append(plan) or original(plan)
    )
    monkeypatch.setattr(albedo_plan, "SAMPLE", 24e4)  # as if a pixel took so much
    for name, size in (("little", 0.57e9), ("some", 1e9), ("all", 1e12)):
        if name == "all":
            monkeypatch.setattr(albedo_plan, "HELD_BYTES", 2**26)
        run_albedo(files_of(ground), tmp_path / name, few_steps(), tiling=Tiling(size))
        assert content(tmp_path / name) == unbroken
        assert not work_folder(tmp_path / name).exists()
    assert [plan.waits_on_disk for plan in plans] == [True, True, False]
    little, some, everything = (plan.kept_pixels for plan in plans)
    assert little < 100 < some < everything == plans[-1].pixels


KILLED = """
import os, signal, sys
from pathlib import Path
from lommel.run import albedo_plan, mixed_scene
from lommel.estimate import albedo_samples
from lommel.run.albedo import run_albedo
sys.path.insert(0, sys.argv[1])
from albedo_scene import files_of, few_steps
from lommel.run.simulate import SceneFolder

albedo_plan.HELD_BYTES, albedo_samples.PIXELS_AT_ONCE, mixed_scene.POSTS_AT_ONCE = 0, 1000, 300

def progress(items, name, total=None, at_once=1):
    for number, item in enumerate(items):
        if (name, number) == (sys.argv[4], 3):
            os.kill(os.getpid(), signal.SIGKILL)
        yield item

files = files_of(SceneFolder(Path(sys.argv[2])))
run_albedo(files, sys.argv[3], few_steps(), progress=progress)
"""


def kill_within(ground, output, step):
    here = os.path.dirname(__file__)
    command = [sys.executable, "-c", KILLED, here, str(ground.folder), str(output), step]
    assert subprocess.run(command).returncode == -signal.SIGKILL


def test_killed_run_goes_on_where_it_was(ground, tmp_path, unbroken):
    """Killed while images are read, then while maps are written, then with other settings."""
    output = tmp_path / "out"
    kill_within(ground, output, "images")
    kept = {path.name for path in work_folder(output).glob("[!.]*")}
    images = {name for name in kept if name.startswith("image")}
    assert images == {f"image-{k:05d}" for k in range(4)}
    assert kept - images == {f"heights-{k:05d}" for k in range(len(kept) - 4)}
    written = {name: (work_folder(output) / name / "rows").stat().st_mtime_ns for name in kept}
    kill_within(ground, output, "maps, block")
    assert {
        name: (work_folder(output) / name / "rows").stat().st_mtime_ns for name in kept
    } == written
    steps = Steps()
    run_albedo(files_of(ground), output, few_steps(), progress=steps)
    assert content(output) == unbroken
    assert "pass 1, block" not in steps and "maps, block" in steps
    assert not work_folder(output).exists()


def break_off(files, output):
    """A run that ends when the maps begin."""

    def progress(items, name, total=None, at_once=1):
        if name == "maps, block":
            raise KeyboardInterrupt
        return items

    with pytest.raises(KeyboardInterrupt):
        run_albedo(files, output, few_steps(), progress=progress)
    assert (work_folder(output) / "photometry").is_dir() and not output.exists()


@pytest.mark.parametrize("is_array", [False, True])
def test_what_a_crash_has_damaged_is_made_anew(ground, tmp_path, unbroken, is_array):
    """Files were cut off, zeroed or gone: a traceback, or products made of zeros."""
    output, work = tmp_path / "out", work_folder(tmp_path / "out")
    array = files_of(ground), output, few_steps(), None, Tiling()
    if is_array:
        prepare_albedo(*array)
        solve_albedo_share(*array, Share(1, 1))
    else:
        break_off(files_of(ground), output)
    (work / "heights-00000" / "rows").unlink()
    for name in ("heights-00001/rows", "image-00000/rows"):
        (work / name).write_bytes(bytes((work / name).stat().st_size))
    (work / "image-00001" / "rows").write_bytes(b"")
    (work / "photometry" / "record.json").write_text('{"digest": ')
    for results in work.glob("pass-1-block/*/results.pickle"):
        results.write_bytes(b"")
    if is_array:
        prepare_albedo(*array)
        solve_albedo_share(*array, Share(1, 1))
        merge_albedo(output)
    else:
        run_albedo(files_of(ground), output, few_steps())
    assert content(output) == unbroken
    assert [path.name for path in tmp_path.glob(".out*")] == []


@pytest.mark.parametrize("step", ["terrain", "images"])
@pytest.mark.parametrize("damage", ["gone", "cut off", "replaced"])
def test_input_that_changes_while_it_is_read_ends_the_run(ground, tmp_path, unbroken, step, damage):
    """Nothing that was read of it is kept, and no map is made without it."""
    output, path = tmp_path / "out", ground.initial_dem if step == "terrain" else ground.images[1]
    before = path.read_bytes()

    def progress(items, name, total=None, at_once=1):
        if name == step:
            path.unlink()
        if name == step and damage != "gone":
            path.write_bytes(before[:4000] if damage == "cut off" else before)
        return items

    try:
        with pytest.raises(LommelError, match=re.escape(path.name)):
            run_albedo(files_of(ground), output, few_steps(), progress=progress)
    finally:
        path.write_bytes(before)
    kept = {folder.name for folder in work_folder(output).iterdir()}
    assert not kept & {"photometry", "heights-00000" if step == "terrain" else "image-00001"}
    run_albedo(files_of(ground), output, few_steps())
    assert content(output) == unbroken


def test_image_that_a_worker_of_an_earlier_run_replaces_is_noticed(ground, tmp_path):
    """A Dask worker goes on when its run is killed, and leaves an image of another grid."""
    output = tmp_path / "out"

    def progress(items, name, total=None, at_once=1):
        yield from items
        if name == "maps, block":
            save_part(work_folder(output) / "image-00001", {}, {"digest": "of the earlier run"})

    with pytest.raises(LommelError, match="image-00001 was replaced meanwhile, by a worker"):
        run_albedo(files_of(ground), output, few_steps(), progress=progress)
    assert not output.exists()


def test_kept_rows_damaged_while_a_run_is_at_work_are_told(ground, tmp_path):
    output = tmp_path / "out"

    def progress(items, name, total=None, at_once=1):
        if name == "pass 1, block":
            (work_folder(output) / "image-00001" / "rows").write_bytes(bytes(8))
        return items

    with pytest.raises(LommelError, match="image-00001/rows is damaged .* The same command"):
        run_albedo(files_of(ground), output, few_steps(), progress=progress)


@pytest.mark.parametrize("change", ["settings", "inputs"])
def test_other_settings_or_inputs_begin_anew(ground, tmp_path, change):
    output, files, settings = tmp_path / "out", files_of(ground), few_steps()
    break_off(files, output)
    if change == "settings":
        settings = replace(settings, haze=False)
    else:
        files = files_of(ground, ground.images[:-1])
    steps = Steps()
    run_albedo(files, output, settings, progress=steps)
    assert {"terrain", "pass 1, block", "maps, block"} <= set(steps)
    run_albedo(files, tmp_path / "fresh", settings)
    assert content(output) == content(tmp_path / "fresh")


def test_photometry_comes_back_to_the_last_bit(ground, tmp_path, monkeypatch):
    found = []
    original = albedo_records.Kept.photometry

    def twice(kept, compute, names):
        found.extend([original(kept, compute, names), original(kept, None, names)])
        return found[1]

    monkeypatch.setattr(albedo_records.Kept, "photometry", twice)
    run_albedo(files_of(ground), tmp_path / "out", few_steps())
    fresh, read = (dict(vars(photometry)) for photometry in found)
    for one, other in zip(fresh.pop("state"), read.pop("state"), strict=True):
        np.testing.assert_array_equal(one, other)
    for name in ("errors", "shared_errors"):
        np.testing.assert_array_equal(fresh.pop(name), read.pop(name))
    assert fresh == read


def test_disk_without_room_is_told_before_images_are_read(ground, tmp_path, monkeypatch):
    monkeypatch.setattr(albedo_plan, "DISK_PER_POST", 1e15)
    steps = Steps()
    with pytest.raises(LommelError, match=r"\.albedo has \d.* MB free, \d.* MB are needed"):
        run_albedo(files_of(ground), tmp_path / "out", few_steps(), progress=steps)
    assert "images" not in steps


def test_least_memory_is_named_and_is_enough(ground):
    placed = place_scene(files_of(ground))
    with pytest.raises(InputError, match=r"--memory 0\.00 GB is too little.* need ") as error:
        plan_albedo(placed, few_steps(), Tiling(1e6))
    least = 1e9 * float(re.search(r"need ([0-9.]+) GB", str(error.value))[1])
    assert plan_albedo(placed, few_steps(), Tiling(least)).memory <= least


@pytest.mark.parametrize("side", [10_000, 30_000])
def test_least_memory_does_not_grow_with_the_scene(side, monkeypatch):
    """Frames of 10 000 posts, four at every post: 400 million pixels or ten times as many."""
    monkeypatch.undo()
    grid = grid_from_bounds(
        (0.0, 0.0, 10.0 * side, 10.0 * side),
        10.0,
        read_crs("+proj=eqc +R=1737400 +units=m +type=crs"),
    )
    starts = range(0, side, 10_000)
    windows = [Window(row, col, 10_000, 10_000) for row in starts for col in starts]
    places = [Place("image", window) for window in windows for _ in range(4)]
    placed = PlacedScene(grid, None, places, [], [])
    plan = plan_albedo(placed, few_steps(), Tiling(1e9))
    assert plan.memory <= 1e9 and plan.waits_on_disk and plan.passes == 4
    assert plan.pixels == 4 * side**2 and plan.kept_pixels < 1e8
    assert "memory   1.00 GB" in str(plan) and "images   " in str(plan)
