"""Tiles on a Dask cluster: the bytes of a run without one, also when workers are lost."""

import os
import signal
from threading import Timer

import pytest
from distributed import LocalCluster
from distributed.comm import CommClosedError

from lommel.errors import InputError, LommelError
from lommel.run import tiles_dask
from lommel.run.shape_from_shading import run_shape_from_shading
from lommel.run.tiles_plan import Tiling, work_folder

from .tiled_scene import SIDE, files_of, fingerprints


def test_a_cluster_of_its_own_gives_the_same_bytes(half_done, tile_scene, tiled):
    tiling = Tiling(engine="dask", side=SIDE)
    run_shape_from_shading(files_of(tile_scene), half_done, tiling=tiling)
    assert fingerprints(half_done) == fingerprints(tiled)
    assert not work_folder(half_done).exists()


def test_the_tile_of_a_worker_that_is_killed_goes_to_another(half_done, tile_scene, tiled):
    killed = []
    with LocalCluster(
        n_workers=2, threads_per_worker=2, memory_limit=0, dashboard_address=":0"
    ) as cluster:

        def progress(items, name, total=None, at_once=1):
            for done, item in enumerate(items):
                if name == "tiles" and done == 2 and not killed:
                    killed.append(cluster.workers[0].pid)
                    os.kill(killed[0], signal.SIGKILL)
                yield item

        tiling = Tiling(engine="dask", side=SIDE, scheduler=cluster.scheduler_address)
        run_shape_from_shading(files_of(tile_scene), half_done, tiling=tiling, progress=progress)
    assert killed
    assert fingerprints(half_done) == fingerprints(tiled)


def test_workers_that_come_when_tiles_wait_for_them_solve_them(half_done, tile_scene, tiled):
    """Jobs of a batch system start late; tiles handed out before waited for ever."""
    with LocalCluster(
        n_workers=0, threads_per_worker=1, memory_limit=0, dashboard_address=":0"
    ) as cluster:

        def progress(items, name, total=None, at_once=1):
            if name == "tiles":
                cluster.scale(2)
            return items

        tiling = Tiling(engine="dask", side=SIDE, scheduler=cluster.scheduler_address)
        patience = Timer(120, cluster.close)  # s; then the run ends and says why
        patience.start()
        try:
            run_shape_from_shading(
                files_of(tile_scene), half_done, tiling=tiling, progress=progress
            )
        finally:
            patience.cancel()
    assert fingerprints(half_done) == fingerprints(tiled)


def test_a_run_that_loses_its_scheduler_goes_on_with_another(half_done, tile_scene, tiled):
    for is_lost in (True, False):
        with LocalCluster(
            n_workers=1, threads_per_worker=1, memory_limit=0, dashboard_address=":0"
        ) as cluster:

            def progress(items, name, total=None, at_once=1, cluster=cluster, is_lost=is_lost):
                for done, item in enumerate(items):
                    if name == "tiles" and done == 1 and is_lost:
                        cluster.close()
                    yield item

            tiling = Tiling(engine="dask", side=SIDE, scheduler=cluster.scheduler_address)
            request = files_of(tile_scene), half_done
            if is_lost:
                with pytest.raises(LommelError, match="with a scheduler that runs, goes on"):
                    run_shape_from_shading(*request, tiling=tiling, progress=progress)
                assert not half_done.exists()
            else:
                run_shape_from_shading(*request, tiling=tiling, progress=progress)
    assert fingerprints(half_done) == fingerprints(tiled)


def test_a_scheduler_that_does_not_answer_is_named_before_anything_is_solved(
    tile_scene, tmp_path, monkeypatch
):
    monkeypatch.setattr(tiles_dask, "PATIENCE", "0.2s")
    tiling = Tiling(engine="dask", side=SIDE, scheduler="tcp://127.0.0.1:9")
    with pytest.raises(InputError, match="tcp://127.0.0.1:9: no scheduler answers"):
        run_shape_from_shading(files_of(tile_scene), tmp_path / "out", tiling=tiling)
    assert not list(tmp_path.iterdir())


class Losing:
    """A client of a cluster that loses some workers one by one."""

    def __init__(self, count):
        self.left, self.told = count, []

    def register_plugin(self, plugin):
        self.left -= 1
        if self.left >= 0:
            raise CommClosedError("in <TCP (closed) ConnectionPool.register_worker_plugin>")
        self.told.append(plugin.name)


def test_worker_that_is_lost_while_it_is_told_what_to_hold_does_not_end_the_run():
    """A worker killed in this moment ended the command with a traceback."""
    client = Losing(2)
    tiles_dask.register_one_tile(client)
    assert client.told == ["lommel-one-tile-at-a-time"]
    with pytest.raises(LommelError, match="workers of the Dask cluster end as soon as"):
        tiles_dask.register_one_tile(Losing(9))
