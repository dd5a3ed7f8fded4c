"""Tiles, and other parts of a run, as tasks of a Dask cluster of this machine, or one that runs.

A worker has one part at a time and computes it with as many threads as Dask gives the worker, so
that workers times threads are the cores, however the cluster was started. Dask takes the part of a
worker that is lost to another. Most callers want `connected`.
"""

import logging
from contextlib import contextmanager, nullcontext
from functools import partial
from uuid import uuid4

import numba
from distributed import Client, LocalCluster, SchedulerPlugin, WorkerPlugin, get_worker

from lommel.errors import InputError, LommelError
from lommel.run.machine import cores

TILE = "lommel-tile"  # the resource of which a worker has one
PATIENCE = "30s"  # until a scheduler must have answered
ATTEMPTS = 3  # to reach all workers


class OneTileAtATime(WorkerPlugin):
    """Gives each worker, also those that join later, one tile to hold at a time."""

    name = "lommel-one-tile-at-a-time"

    async def setup(self, worker):
        """Declare the resource, as Dask asks of a plugin."""
        await worker.set_resources(**{TILE: 1})


class OneTileForNewcomers(SchedulerPlugin):
    """Tells the scheduler the same of workers that join, before it looks for work for them.

    What a worker declares itself comes after that, and parts that had no worker would stay without.
    """

    name = "lommel-one-tile-for-newcomers"
    idempotent = True  # for several commands with one scheduler

    def add_worker(self, scheduler, worker):
        """Declare the resource, as Dask asks of a plugin."""
        scheduler.add_resources(worker=worker, resources={TILE: 1})


@contextmanager
def connected(tiling):
    """A cluster to hand parts to.

    Parameters
    ----------
    tiling : Tiling

    Yields
    ------
    start : function (solve, work, numbers)
        As of `lommel.run.tiles_engines.open_engine`; ``solve`` is found by its name on the workers,
        and ``work`` is on a disk that all of them see. A result is a `LommelError` when the
        scheduler is lost.
    """
    with _cluster(tiling) as cluster, _client(cluster) as client:
        client.register_plugin(OneTileForNewcomers())
        register_one_tile(client)
        yield partial(_submit, client)


def register_one_tile(client):
    """Tell the workers, also those that join later, that they have one tile at a time.

    Parameters
    ----------
    client : Client
    """
    for _ in range(ATTEMPTS):
        try:
            client.register_plugin(OneTileAtATime())
            return
        except OSError as error:  # a worker was lost while it was told
            lost = error
    raise LommelError(
        f"The workers of the Dask cluster end as soon as they are asked for something ({lost}). "
        "Look at what they and their scheduler write."
    ) from lost


def _submit(client, solve, work, numbers):
    run = uuid4().hex[:8]  # a part that is tried again is a new task
    futures = [
        client.submit(
            with_own_threads,
            solve,
            work,
            number,
            key=f"{work.name}-{number}-{run}",
            resources={TILE: 1},
            pure=False,
        )
        for number in numbers
    ]
    results = [partial(_result, client, future, work) for future in futures]
    return results, max(len(client.nthreads()), 1)


def check_scheduler(address):
    """Refuse the address of a scheduler that does not answer; None stands for none.

    Parameters
    ----------
    address : str or None
    """
    if address is not None:
        _client(address).close()


def with_own_threads(solve, work, number):
    """Solve a tile with the threads of the worker this runs in, as ``solve`` does."""
    threads = get_worker().state.nthreads
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    return solve(work, number)


def _cluster(tiling):
    """Address of the cluster that was named, or one of this machine's own."""
    if tiling.scheduler is not None:
        return nullcontext(tiling.scheduler)
    return LocalCluster(
        n_workers=tiling.workers,
        threads_per_worker=max(cores() // tiling.workers, 1),
        memory_limit=0,  # the size of the tiles keeps to the memory
        dashboard_address=":0",  # with None it asks for port 8787, and warns where that is taken
    )


def _client(cluster):
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # `_result` tells of losses
    try:
        return Client(cluster, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--dask-scheduler {cluster}: no scheduler answers there ({error}). Start one with "
            "`dask scheduler`, and give the address it prints, like tcp://10.0.0.1:8786."
        ) from error


def _result(client, future, work):
    try:
        return future.result()
    except Exception as error:
        if client.status == "running":
            raise
        raise LommelError(
            f"The Dask scheduler was lost ({error}). Parts that are done "
            f"wait in {work}: the same command, with a scheduler that runs, goes on from there."
        ) from error
