"""Scenes cut into tiles: the same answer as in one piece, and runs that can be broken off."""

import json
import os
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from lommel.cli import app
from lommel.errors import InputError, LommelError
from lommel.io import raster
from lommel.io.raster import read_grid, read_on_grid, read_pixels
from lommel.run import tiles, tiles_plan, tiles_products
from lommel.run.records import digest_of, is_done, read_record, save_part
from lommel.run.shape_from_shading import run_shape_from_shading
from lommel.run.tiles_plan import (
    STEP,
    Tiling,
    blend_weights,
    coarse_grid,
    halo,
    make_plan,
    plan_tiles,
    read_memory,
    work_folder,
)
from lommel.run.tiles_records import part_folder, save_run
from lommel.scene.grid import Window

from .tiled_scene import SIDE, files_of, fingerprints

BORDER = 64  # posts at the outer border left out


@pytest.fixture(scope="module")
def whole(tile_scene, tmp_path_factory):
    output = tmp_path_factory.mktemp("whole") / "out"
    run_shape_from_shading(files_of(tile_scene), output)
    return output


def test_tiles_cover_every_post_once_and_share_every_post_wholly():
    plan = make_plan((700, 450), 2, 1e9, side=STEP)
    count, share = np.zeros(plan.shape, int), np.zeros(plan.shape)
    for tile in plan.tiles:
        count[tile.inner.slices] += 1
        share += blend_weights(tile, Window(0, 0, *plan.shape), plan.shape)
        assert tile.outer.row == max(tile.inner.row - halo(plan.side), 0)
    assert (count == 1).all()
    np.testing.assert_allclose(share, 1, atol=1e-6)  # float32


@pytest.mark.parametrize("memory", [1e9, 4e9])
def test_a_plan_stays_within_memory(memory):
    plan = make_plan((20_000, 20_000), 3, memory)
    assert plan.is_tiled
    assert plan.memory <= memory
    assert plan.side < 20_000 / len(plan.tiles) ** 0.5 + STEP  # all of them about as large
    assert plan.shape[0] * plan.shape[1] / plan.stride**2 * 250 < memory
    assert not make_plan((500, 500), 3, memory).is_tiled


def footprints_of(shape, images=1):
    """Images that all touch everything."""
    return SimpleNamespace(
        grid=SimpleNamespace(shape=shape),
        used=SimpleNamespace(images=[None] * images),
        uses=lambda window: np.ones(images, bool),
    )


@pytest.mark.parametrize(
    ("size", "memory", "workers"), [(20_000, 8e9, 2), (20_000, 64e9, 2), (4000, 1e9, 1)]
)
def test_tiles_go_to_processes_where_these_have_room_for_large_ones(
    size, memory, workers, monkeypatch, tmp_path
):
    monkeypatch.setattr(tiles_plan, "cores", lambda: 2)
    plan = plan_tiles(footprints_of((size, size)), Tiling(memory), tmp_path / "out")
    assert plan.workers == workers
    assert plan.memory <= memory
    assert Tiling(memory).settled(plan).workers == workers
    alone = plan_tiles(footprints_of((size, size)), Tiling(memory, "serial"), tmp_path / "out")
    assert (alone.workers, alone.stride) == (1, plan.stride)  # one process solves that at any rate


def test_the_tiles_of_an_earlier_run_are_not_too_much_for_processes(monkeypatch, tmp_path):
    """A tile of 5,120 posts needs 6.5 GB."""
    monkeypatch.setattr(tiles_plan, "cores", lambda: 2)
    monkeypatch.setattr(tiles_plan, "earlier_cut", lambda folder, shape: (5120, 4))
    plan = plan_tiles(footprints_of((20_000, 20_000)), Tiling(8e9), tmp_path / "out")
    assert (plan.side, plan.workers) == (5120, 1)
    plan = plan_tiles(footprints_of((20_000, 20_000)), Tiling(6e9), tmp_path / "out")
    assert plan.side < 5120 and plan.memory <= 6e9


def test_a_broken_run_goes_on_with_other_cores_and_engines(monkeypatch, tmp_path):
    footprints, plans = footprints_of((20_000, 20_000)), []
    for cores in (2, 16, 1):
        monkeypatch.setattr(tiles_plan, "cores", lambda cores=cores: cores)
        plans.append(plan_tiles(footprints, Tiling(8e9), tmp_path / "out"))
        work = tiles_plan.work_folder(tmp_path / "out")
        work.mkdir(exist_ok=True)
        save_run(work, SimpleNamespace(plan=plans[0]))
    plans.append(plan_tiles(footprints, Tiling(8e9, "serial"), tmp_path / "out"))
    assert [plan.cut for plan in plans] == [plans[0].cut] * 4


def test_too_little_memory_is_refused_with_what_is_needed():
    with pytest.raises(InputError, match=r"a tile of 256 posts needs 0\.\d+ GB"):
        make_plan((20_000, 20_000), 3, 3.2e8)


@pytest.mark.parametrize(("text", "size"), [("8GB", 8e9), ("500 mb", 5e8), ("2g", 2e9)])
def test_sizes_are_read(text, size):
    assert read_memory(text) == size


@pytest.mark.parametrize("text", ["", "much", "-3GB", "0", "1.2.3GB", "8 apples"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(InputError, match="8GB"):
        read_memory(text)


def test_posts_of_the_coarse_grid_are_posts_of_the_fine_one(tile_scene):
    grid = read_grid(tile_scene / "init_dem.tif")
    row, col = coarse_grid(grid, 4).lonlat_at(np.array([0, 5, 40]), np.array([3, 0, 77]))
    fine_row, fine_col = grid.index_at(row, col)
    np.testing.assert_allclose(fine_row, [0, 20, 160], atol=1e-5)
    np.testing.assert_allclose(fine_col, [12, 0, 308], atol=1e-5)


def test_tiles_give_nearly_the_heights_of_one_piece(tile_scene, whole, tiled):
    truth, one, many = (
        read_pixels(path / name)[BORDER:-BORDER, BORDER:-BORDER]
        for path, name in ((tile_scene, "truth_dem.tif"), (whole, "dem.tif"), (tiled, "dem.tif"))
    )
    error = np.std(one - truth)
    assert np.std(many - one) < 0.1 * error  # measured 0.04; larger tiles: docs/scaling.md
    assert np.std(many - truth) < 1.05 * error


def test_no_seam_shows_in_the_second_derivative(whole, tiled):
    change = read_pixels(tiled / "dem.tif") - read_pixels(whole / "dem.tif")
    for axis in (0, 1):
        bend = np.abs(np.diff(change, 2, axis=axis)).mean(axis=1 - axis)
        seams = np.concatenate([bend[k - 34 : k + 34] for k in (SIDE, 2 * SIDE - 8)])
        assert seams.max() < 3 * np.median(bend[BORDER:-BORDER]) + 1e-4  # m


def test_products_and_record_are_those_of_one_piece(whole, tiled):
    assert {p.name for p in whole.iterdir()} == {p.name for p in tiled.iterdir()}
    for name in ("albedo", "hillshade-after", "separation", "measured", "modelled"):
        one, many = (read_pixels(folder / f"{name}.tif") for folder in (whole, tiled))
        assert one.shape == many.shape
        assert np.nanmedian(np.abs(many - one)) < 0.02 * np.nanmedian(np.abs(one))
    record = json.loads((tiled / "run.json").read_text())
    assert record["outcome"]["name"] == "converged"
    assert len(record["settings"]["tiles"]) == record["results"]["tiles"] == 9


def test_a_broken_run_goes_on_and_gives_the_same_bytes(half_done, tile_scene, tiled, monkeypatch):
    solved, solve = [], tiles.solve_tile

    def solve_some(files, grid, tile, *rest):
        if len(solved) == 2:
            raise KeyboardInterrupt
        solved.append(tile.number)
        return solve(files, grid, tile, *rest)

    monkeypatch.setattr(tiles, "prepare_scene", None)  # done already
    monkeypatch.setattr(tiles, "solve_tile", solve_some)
    with pytest.raises(KeyboardInterrupt):
        run_shape_from_shading(files_of(tile_scene), half_done, tiling=Tiling(side=SIDE))
    assert not half_done.exists()
    (part_folder(work_folder(half_done), 2) / "record.json").write_text("{")  # cut off
    monkeypatch.setattr(
        tiles, "solve_tile", lambda *job: solved.append(job[2].number) or solve(*job)
    )
    run_shape_from_shading(files_of(tile_scene), half_done)  # the size of the tiles is remembered
    assert solved == [1, 3, 2, 5, 7]
    assert not work_folder(half_done).exists()
    assert fingerprints(half_done) == fingerprints(tiled)


def test_a_failing_tile_is_tried_again_and_told_while_the_others_finish(
    tile_scene, tmp_path, monkeypatch
):
    output, tried = tmp_path / "out", []
    solve = tiles.solve_tile

    def fail(files, grid, tile, *rest):
        tried.append(tile.number)
        if tile.number == 1:
            raise OSError("disk fell out")
        return solve(files, grid, tile, *rest)

    monkeypatch.setattr(tiles, "solve_tile", fail)
    with pytest.raises(LommelError, match="tile 1: OSError: disk fell out"):
        run_shape_from_shading(files_of(tile_scene), output, tiling=Tiling(side=256))
    assert tried == [0, 1, 2, 3, 1]
    digests = [read_record(work_folder(output) / f"tile-0000{k}").get("digest") for k in range(4)]
    assert digests[1] is None and None not in (digests[0], digests[2], digests[3])
    shutil.rmtree(work_folder(output))


def test_processes_give_the_same_bytes_and_share_the_cores(
    half_done, tile_scene, tiled, monkeypatch
):
    monkeypatch.setenv("NUMBA_NUM_THREADS", "7")
    monkeypatch.setattr(tiles_products, "_writers", lambda plan: 2)  # as where products are large
    tiling = Tiling(engine="processes", side=SIDE)
    run_shape_from_shading(files_of(tile_scene), half_done, tiling=tiling)
    assert fingerprints(half_done) == fingerprints(tiled)
    assert os.environ["NUMBA_NUM_THREADS"] == "7"  # as it was


def test_a_dry_run_shows_the_plan_and_writes_nothing(tile_scene, tmp_path):
    files = files_of(tile_scene)
    command = ["sfs", *map(str, files.images), "--dem", str(files.dems[0]), "--dry-run"]
    command += ["--sun-positions", str(files.sun_positions), "--output", str(tmp_path / "out")]
    shown = CliRunner().invoke(app, command)
    assert shown.exit_code == 0
    assert "320 x 320, 2 images" in shown.output
    assert [line.split()[0] for line in shown.output.splitlines()] == [
        "posts",
        "tiles",
        "memory",
        "disk",
        "time",
    ]
    assert not list(tmp_path.iterdir())


def test_a_part_made_from_other_settings_or_inputs_is_not_taken_for_done(tmp_path):
    part, digest = tmp_path / "tile", digest_of([{"max_steps": 8}, "inputs"])
    save_part(part, {"dem": np.ones(3)}, {"digest": digest})
    assert is_done(part, digest)
    assert not is_done(part, digest_of([{"max_steps": 9}, "inputs"]))
    assert not is_done(part, digest_of([{"max_steps": 8}, "other inputs"]))
    save_part(part, {"dem": np.zeros(3)}, {"digest": "new"})
    assert not is_done(part, digest)
    assert [path.name for path in tmp_path.iterdir()] == ["tile"]


def test_a_dem_read_by_halves_is_the_dem_read_at_once(tile_scene, monkeypatch):
    coarse = coarse_grid(read_grid(tile_scene / "init_dem.tif"), 4)
    at_once = read_on_grid(tile_scene / "init_dem.tif", coarse)
    monkeypatch.setattr(raster, "PIXELS_AT_ONCE", 5000)
    by_halves = read_on_grid(tile_scene / "init_dem.tif", coarse)
    np.testing.assert_allclose(by_halves, at_once, atol=1e-3)  # m, float32 sums of other order
