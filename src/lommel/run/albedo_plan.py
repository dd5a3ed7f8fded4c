"""How much of an albedo run is held in memory, and what it needs before it has begun.

The parts that are read and summed are the same whatever the memory; it decides how many of them
there are at a time and what is kept between passes. Most callers want `plan_albedo`.
"""

from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil

import numpy as np
from numba import get_num_threads, set_num_threads

from lommel.errors import InputError
from lommel.estimate.albedo import WEIGHINGS
from lommel.estimate.albedo_cells import cell_size
from lommel.estimate.albedo_samples import block_edges
from lommel.estimate.albedo_settings import check_settings
from lommel.run.machine import free_memory
from lommel.run.tiles_plan import MEMORY_SHARE, Tiling

AT_REST = 560e6  # bytes of a process that reads images: its parts, GDAL's blocks, what is judged
PER_IMAGE = 100e3  # bytes: its cells and its share of the sums
BYTES_PER_PIXEL = 45  # of all images in one block of rows
BYTES_PER_POST = 130  # of the grid in one block of rows
SAMPLE, VALUE = 24, 4  # bytes of a pixel that is kept between passes, or as it is
PART_MAPS = 2e8  # bytes: maps of the blocks of one part, and of the next one as it is read
DISK_PER_POST = 4 * 3.5 * 2  # bytes: four products, as scratch, and compressed
DISK_PER_PART_POST = 16  # bytes: the maps in parts, until they are written
TERRAIN_SECONDS, READ_SECONDS, RAW_SECONDS = 0.13e-6, 0.06e-6, 0.9e-6  # per pixel, on one core
PASS_SECONDS, SAMPLE_SECONDS = 0.03e-6, 0.035e-6  # per pixel, on two cores
WITH_CELLS, PASSES = 2 + WEIGHINGS, 30  # passes with cells; a guess where the number is not known
HELD_BYTES = 2**26  # of images and terrain that are held; more is worth keeping for another run


@dataclass(frozen=True)
class AlbedoPlan:
    """What a run takes.

    Attributes
    ----------
    shape : tuple of int
        Posts of the products.
    images : int
    pixels, raw_pixels : int
        Posts in the windows of all images, and of raw images.
    passes : int or None
        Over all pixels; None where it is not known before.
    workers : int
        Processes of this machine at work at a time.
    threads, most_threads : int
        Of a process on this machine, and of one that has as many cores as memory has room for.
    kept_pixels : int
        Whose samples are kept from pass to pass.
    waits_on_disk : bool
        Images and terrain wait in a folder beside the output.
    is_shared : bool
        Other processes do the work, and their results wait there as well.
    memory : float, bytes
        At most, of all processes of this machine; of one worker of a cluster that runs already.
    """

    shape: tuple[int, int]
    images: int
    pixels: int
    raw_pixels: int
    passes: int | None
    workers: int
    threads: int
    most_threads: int
    kept_pixels: int
    waits_on_disk: bool
    is_shared: bool
    memory: float

    @property
    def disk(self):
        """Bytes of disk while the run lasts, at most."""
        posts = self.shape[0] * self.shape[1]
        per_post = DISK_PER_POST + self.is_shared * DISK_PER_PART_POST
        return per_post * posts + self.waits_on_disk * VALUE * (self.pixels + posts)

    @property
    def seconds(self):
        """Estimated time on two cores."""
        flat = self.pixels - self.raw_pixels
        anew = max(self.pixels - self.kept_pixels, 0)
        passes = self.passes or PASSES
        visits = PASS_SECONDS * passes * self.pixels
        samples = SAMPLE_SECONDS * (self.pixels + anew * (passes - 1))
        reading = READ_SECONDS * flat + RAW_SECONDS * self.raw_pixels
        terrain = TERRAIN_SECONDS * self.shape[0] * self.shape[1]
        return terrain + reading + visits + samples

    def __str__(self):
        """Lines for people: posts, images, passes, memory, disk, time."""
        passes = "until the cost stays, mostly 10 to 60" if self.passes is None else self.passes
        where = "wait on the disk" if self.waits_on_disk else "are held"
        kept = 100 * min(self.kept_pixels / self.pixels, 1) if self.pixels else 100
        workers = f"{self.workers} workers with " if self.workers > 1 else ""
        return (
            f"posts    {self.shape[0]} x {self.shape[1]}\n"
            f"images   {self.images}, {self.pixels / 1e6:.4g} million pixels on these posts\n"
            f"passes   {passes}\n"
            f"memory   {self.memory / 1e9:.2f} GB: {workers}{self.threads} "
            f"thread{'s' if self.threads > 1 else ''}; images {where}, samples "
            f"of {kept:.0f} % of their pixels are kept from pass to pass\n"
            f"disk     {self.disk / 1e9:.2f} GB at most while it runs\n"
            f"time     about {max(self.seconds / 60, 0.1):.1f} min on two cores"
        )

    @contextmanager
    def limits(self):
        """Keep to the threads of the plan."""
        before = get_num_threads()
        set_num_threads(self.threads)
        try:
            yield
        finally:
            set_num_threads(before)


def plan_albedo(placed, settings, tiling=None, is_shared=False):
    """The plan of a run.

    Parameters
    ----------
    placed : PlacedScene
    settings : AlbedoSettings
    tiling : Tiling, optional
        Memory and engine; a safe share of what is free, and this process, by default.
    is_shared : bool
        Also the ``serial`` engine keeps results for other processes, as a job of an array does.

    Returns
    -------
    plan : AlbedoPlan
    """
    tiling = tiling or Tiling()
    is_shared, workers = is_shared or not tiling.is_alone, tiling.workers
    check_settings(settings)
    windows = [place.window for place in placed.places]
    windows = np.array([(w.row, w.col, w.rows, w.cols) for w in windows], np.int64).reshape(-1, 4)
    shape, images, pixels = placed.grid.shape, len(windows), placed.pixels
    edges, above = block_edges(windows, shape)
    block = int(np.diff(above[edges]).max()), int(np.diff(edges).max()) * shape[1]
    per_thread = BYTES_PER_PIXEL * block[0] + BYTES_PER_POST * block[1]
    always = AT_REST + PER_IMAGE * images + is_shared * PART_MAPS
    least = always + per_thread
    asked = free_memory() * MEMORY_SHARE if tiling.memory is None else tiling.memory
    given = asked / workers
    if given < least:
        name = (
            f"{100 * MEMORY_SHARE:.0f} % of what is free," if tiling.memory is None else "--memory"
        )
        raise InputError(
            f"{name} {asked / 1e9:.2f} GB is too little: {shape[0]} x {shape[1]} posts and "
            f"{images} images need {ceil(workers * least / 1e7) / 100:.2f} GB. Give that, a larger "
            "--spacing, narrower --bounds or fewer images."
        )
    most_threads = int((given - always) // per_thread)
    threads = min(max(get_num_threads() // workers, 1), most_threads)
    used = always + threads * per_thread
    values = VALUE * (pixels + shape[0] * shape[1])
    waits = is_shared or values > min(HELD_BYTES, given - used)
    used += 0 if waits else values
    kept = 0 if is_shared else int(min(pixels, (given - used) // SAMPLE))
    has_cells = settings.solver == "projection" and images > 0 and cell_size(windows) > 1
    passes = WITH_CELLS if has_cells else None
    return AlbedoPlan(
        shape,
        images,
        pixels,
        placed.raw_pixels,
        passes,
        workers,
        threads,
        most_threads,
        kept,
        waits,
        is_shared,
        workers * (used + SAMPLE * kept),
    )
