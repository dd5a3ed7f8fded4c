"""How a scene that does not fit in memory is cut: tiles, halos, and the coarse grid before them.

Most callers want `make_plan`.
"""

import json
import os
import re
from dataclasses import asdict, dataclass, replace
from math import ceil, inf
from pathlib import Path

import numpy as np
from affine import Affine

from lommel.errors import InputError
from lommel.run.machine import cores, free_memory
from lommel.scene.grid import Grid, Window

BYTES_PER_POST, BYTES_PER_IMAGE = 200, 16  # measured: 211 with one image, 235 with four
AT_REST = 300e6  # bytes of a process with its modules and compiled code
MEMORY_SHARE = 0.6  # of what is free now: a safe share, others work here as well
ENGINES = ("serial", "processes", "dask")
WIDE_HALO, NARROW_HALO = 256, 128  # posts; under one Sun stripes carry far what happens at a rim
WIDE_TILE = 2048  # posts; of tiles as wide, rims are so small a part that the narrow halo does
BLEND = 64  # posts over which a tile goes over into the next
STEP = 128  # posts; tiles begin at multiples of it, so that coarse levels have the same posts
LEAST_SIDE = 256  # posts; smaller tiles would be mostly halo
SECONDS_PER_POST = 1.6e-6  # and image set, on two cores
DISK_PER_POST = 9 * 4 * 3.4  # bytes: nine products in the tiles, as scratch, and compressed
# Measured on two cores, 20,000 x 20,000 posts: 591 s in one process, 433 s in two
CORE_SECONDS_PER_POST, SIDE_BY_SIDE = 1.75e-6, 0.6  # by one core; share that several cores share
START_SECONDS = 3.0  # until processes are at work
UNITS = {"": 1.0, "KB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12}


@dataclass(frozen=True)
class Tiling:
    """How a large scene is to be cut and worked on.

    Attributes
    ----------
    memory : float, bytes, or None
        Of the whole run, but of one worker where ``scheduler`` is given; None takes a safe share of
        what is free.
    engine : {'serial', 'processes', 'dask'} or None
        None: tiles go to processes where that is quicker, all else is done by this one.
    side : int, posts, or None
        Of a tile without its halo; None takes what fits in memory.
    scheduler : str or None
        Address of a Dask cluster that runs already; None starts one on this machine.
    processes : int or None
        At work at a time, where they do the work; None takes one per core.
    """

    memory: float | None = None
    engine: str | None = None
    side: int | None = None
    scheduler: str | None = None
    processes: int | None = None

    def __post_init__(self):
        """Refuse what cannot be."""
        if self.engine not in (None, *ENGINES):
            raise InputError(f"engine = {self.engine!r} is not known. Choose {', '.join(ENGINES)}.")
        if self.scheduler is None:
            return
        if self.engine != "dask":
            raise InputError(
                f"--dask-scheduler {self.scheduler} needs --engine dask"
                + (f", not {self.engine}." if self.engine else ".")
            )
        if self.memory is None and self.side is None:
            raise InputError(
                "--dask-scheduler needs --memory: what one worker of that cluster may take, like "
                "--memory 8GB."
            )

    @property
    def workers(self):
        """Processes of this machine at work at a time."""
        return 1 if self.is_alone or self.scheduler else self.processes or cores()

    @property
    def is_alone(self):
        """Whether the one process does everything."""
        return self.engine in (None, "serial")

    def settled(self, plan):
        """The same with an engine, that of a plan where none was chosen."""
        if self.engine is not None:
            return self
        engine = "processes" if plan.workers > 1 else "serial"
        return replace(self, engine=engine, processes=plan.workers)


@dataclass(frozen=True)
class Tile:
    """A part of the scene.

    Attributes
    ----------
    number : int
    inner : Window
        Posts that only this tile writes before blending.
    outer : Window
        With its halo: what is read and solved.
    """

    number: int
    inner: Window
    outer: Window


@dataclass(frozen=True)
class Plan:
    """How a scene is cut.

    Attributes
    ----------
    shape : tuple of int
        Posts of the scene.
    images : int
    stride : int
        Posts of the scene per post of the coarse grid that is solved first.
    tiles : tuple of Tile
    memory : float, bytes
        What all processes of this machine take at most.
    workers : int
        Processes of this machine at work on tiles at a time.
    """

    shape: tuple[int, int]
    images: int
    stride: int
    tiles: tuple[Tile, ...]
    memory: float
    workers: int = 1

    @property
    def is_tiled(self):
        """False when one tile is all."""
        return len(self.tiles) > 1

    @property
    def cut(self):
        """All of it that products depend on."""
        return asdict(self) | {"memory": None, "workers": None}

    @property
    def side(self):
        """Posts along a tile without its halo."""
        return max(self.tiles[0].inner.shape)

    @property
    def posts(self):
        """Posts solved at full resolution, halos included."""
        return sum(tile.outer.rows * tile.outer.cols for tile in self.tiles)

    @property
    def seconds(self):
        """Estimated time on two cores."""
        return SECONDS_PER_POST * (self.posts + self.shape[0] * self.shape[1] / self.stride**2)

    @property
    def disk(self):
        """Bytes of disk while the run lasts, at most."""
        return DISK_PER_POST * self.shape[0] * self.shape[1]

    def __str__(self):
        """Lines for people: tiles, memory, disk, time."""
        largest = max(tile.outer.rows * tile.outer.cols for tile in self.tiles)
        workers = f": {self.workers} processes" if self.workers > 1 else ""
        side = largest**0.5
        return (
            f"posts    {self.shape[0]} x {self.shape[1]}, {self.images} images\n"
            f"tiles    {len(self.tiles)}, the largest of about {side:.0f} x {side:.0f} posts"
            + (f"; before them every {self.stride}th post at once\n" if self.stride > 1 else "\n")
            + f"memory   {self.memory / 1e9:.2f} GB{workers}\n"
            f"disk     {self.disk / 1e9:.2f} GB at most while it runs\n"
            f"time     about {max(self.seconds / 60, 0.1):.1f} min on two cores"
        )


def make_plan(shape, images, memory, side=None, stride=None, count=None, workers=1):
    """Tiles of a scene that stay within memory; one tile when all of it does.

    Parameters
    ----------
    shape : tuple of int
        Posts of the scene.
    images : int
        Of the whole scene.
    memory : float, bytes
        Of all processes together; before the tiles, one has it alone.
    side : int, posts, optional
        Of a tile without its halo, in place of what follows from memory; a multiple of `STEP`.
    stride : int, posts, optional
        Of the coarse grid, in place of what follows from memory.
    count : function (window) -> int, optional
        Images of a window; all of them by default.
    workers : int
        Processes at work on tiles at a time.

    Returns
    -------
    plan : Plan
    """
    per_post = BYTES_PER_POST + BYTES_PER_IMAGE * images
    posts = (memory - AT_REST) / per_post
    rows, cols = shape
    if side is None and rows * cols <= posts:
        whole = Window(0, 0, rows, cols)
        return Plan(shape, images, 1, (Tile(0, whole, whole),), AT_REST + rows * cols * per_post)
    count = count or (lambda window: images)
    if side is None:
        side = _largest_side(shape, count, memory / workers)
    tiles = _tiles(shape, side)
    needs = [_memory(tile.outer.shape, count(tile.outer)) for tile in tiles]
    if stride is None:
        stride = 2
        posts = max(posts, (max(needs) - AT_REST) / per_post)  # with all images, in a tile's memory
        while rows * cols / stride**2 > posts:
            stride *= 2
    coarse = _memory((rows / stride, cols / stride), images)
    return Plan(shape, images, stride, tuple(tiles), max(workers * max(needs), coarse), workers)


def _memory(shape, images):
    """What solving so many posts takes, bytes."""
    return AT_REST + (BYTES_PER_POST + BYTES_PER_IMAGE * images) * shape[0] * shape[1]


def _largest_side(shape, count, memory):
    """Side of the fewest tiles that memory has room for, posts."""
    widest = -(-max(shape) // STEP) * STEP
    for most_posts in range(widest, 0, -STEP):
        side = _even_side(shape, most_posts)
        most = max(count(tile.outer) for tile in _tiles(shape, side))
        if _memory((side + 2 * halo(side),) * 2, most) <= memory:
            return side
    raise InputError(
        f"--memory {memory / 1e9:.2f} GB is too little for {most} images: a tile of {LEAST_SIDE} "
        f"posts needs {_memory((3 * LEAST_SIDE,) * 2, most) / 1e9:.2f} GB. Give more, or "
        "fewer images."
    )


def halo(side):
    """Posts beside a tile that are solved along: no more than it has, fewer where it is large.

    Parameters
    ----------
    side : int, posts
        Of the tile.
    """
    return min(side, WIDE_HALO) if side < WIDE_TILE else NARROW_HALO


def _tiles(shape, side):
    rows, cols = shape
    rim = halo(side)
    tiles: list[Tile] = []
    for row, last_row in _cuts(rows, side):
        for col, last_col in _cuts(cols, side):
            inner = Window(row, col, last_row - row, last_col - col)
            around = Window(row - rim, col - rim, inner.rows + 2 * rim, inner.cols + 2 * rim)
            outer = around.intersection(Window(0, 0, rows, cols))
            tiles.append(Tile(len(tiles), inner, outer))
    return tiles


def plan_tiles(footprints, tiling, output):
    """The plan of a run; that of an earlier one that was broken off goes on.

    Parameters
    ----------
    footprints : Footprints
    tiling : Tiling or None
    output : path
        Of the run, beside which a broken run has left its tiles.

    Returns
    -------
    plan : Plan
    """
    tiling, shape = tiling or Tiling(), footprints.grid.shape
    free = free_memory()
    memory = free * MEMORY_SHARE if tiling.memory is None else tiling.memory
    images = len(footprints.used.images)

    def count(window):
        return int(footprints.uses(window).sum())

    def quickest(side, stride, most):
        plans = []
        for workers in [tiling.workers] if tiling.engine else range(1, cores() + 1):
            try:
                plans.append(make_plan(shape, images, memory, side, stride, count, workers))
            except InputError:
                if not plans:
                    raise
                break  # too little memory for so many
        return min((p for p in plans if p is plans[0] or p.memory <= most), key=_tile_time)

    cut = earlier_cut(work_folder(output), shape) if tiling.side is None else None
    if cut is not None:
        most = free if tiling.memory is None else memory
        plan = quickest(*cut, most)
        if plan.memory <= most:
            return plan
    return quickest(tiling.side, None, memory)


def _tile_time(plan):
    """Seconds that the tiles of a plan take on this machine, about."""
    rounds = ceil(len(plan.tiles) / plan.workers) / len(plan.tiles)
    alone = 1 - SIDE_BY_SIDE + SIDE_BY_SIDE / max(cores() // plan.workers, 1)
    start = 0.0 if plan.workers == 1 else START_SECONDS
    return start + rounds * alone * CORE_SECONDS_PER_POST * plan.posts


def work_folder(output):
    """Where a run keeps its tiles until all are done."""
    output = Path(os.path.realpath(output))
    return output.with_name(f".{output.name}.tiles")


def earlier_cut(folder, shape):
    """Side of the tiles and stride of the coarse grid of a broken run, posts; None without one."""
    try:
        plan = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
        return (int(plan["side"]), int(plan["stride"])) if plan["shape"] == list(shape) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _even_side(shape, most):
    """The least side that cuts the scene into no more tiles than the largest one does."""
    counts = [-(-size // most) for size in shape]
    least = max(-(-size // count) for size, count in zip(shape, counts, strict=True))
    return -(-least // STEP) * STEP


def _cuts(size, side):
    """Begin and end of each tile along one side."""
    begins = list(range(0, size, side))
    return list(zip(begins, [*begins[1:], size], strict=True))


def coarse_grid(grid, stride):
    """Every so manieth post of a grid, as a grid of its own.

    Parameters
    ----------
    grid : Grid
    stride : int

    Returns
    -------
    coarse : Grid
        Post (i, j) stands where post (stride i, stride j) of ``grid`` does; the last ones may stand
        beyond it.
    """
    shift = (1 - stride) / 2
    affine = grid.affine @ Affine.translation(shift, shift) @ Affine.scale(stride)
    shape = tuple(-(-(size - 1) // stride) + 1 for size in grid.shape)
    return Grid(shape, affine, grid.crs, grid.body)


def read_memory(text):
    """Bytes from a text such as ``8GB``.

    Parameters
    ----------
    text : str

    Returns
    -------
    size : float, bytes

    Examples
    --------
    >>> read_memory("1.5 GB")
    1500000000.0
    """
    found = re.fullmatch(r"\s*([0-9.]+)\s*([KMGT]?B?)\s*", text, re.IGNORECASE)
    unit = found[2].upper() if found else ""
    unit = f"{unit}B" if unit and not unit.endswith("B") else unit
    try:
        size = float(found[1]) * UNITS["" if unit == "B" else unit] if found else 0.0
    except ValueError:
        size = 0.0
    if not 0 < size < inf:
        raise InputError(f"memory = {text!r} is not a size. Give one like 8GB or 500MB.")
    return size


def blend_weights(tile, window, shape, stride=1):
    """Share of a tile at posts of the scene; the shares of all tiles sum to 1.

    Parameters
    ----------
    tile : Tile
    window : Window
        Where the first of these posts is, and how many there are.
    shape : tuple of int
        Of the scene.
    stride : int
        From one of these posts to the next.

    Returns
    -------
    weights : float32 array (rows, cols)
    """
    along = []
    ends = (tile.inner.row, tile.inner.rows), (tile.inner.col, tile.inner.cols)
    places = (window.row, window.rows), (window.col, window.cols)
    for (first, size), (begin, count), whole in zip(ends, places, shape, strict=True):
        post = begin + stride * np.arange(count)
        is_last = first + size >= whole
        share = np.ones(count) if first == 0 else _rise(post - first)
        along.append(share if is_last else share - _rise(post - first - size))
    return (along[0][:, None] * along[1]).astype(np.float32)


def _rise(offset):
    """From 0 to 1 across a border between tiles, flat to the second derivative at both ends."""
    t = np.clip((offset + 0.5) / BLEND + 0.5, 0.0, 1.0)
    return t**3 * (10 - 15 * t + 6 * t**2)
