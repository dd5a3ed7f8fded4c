"""Tiles become one surface: their long waves are settled for the whole scene.

Most callers want `settle_tiles`.
"""

import numpy as np

from lommel.estimate.long_waves import Part, Remainder, settle
from lommel.run.records import read_array, read_record
from lommel.run.tiles_plan import blend_weights
from lommel.run.tiles_records import part_folder
from lommel.scene.grid import Window


def settle_tiles(run, work, shape):
    """What is to be added to the blended tiles.

    Parameters
    ----------
    run : TiledRun
        All of whose tiles are done.
    work : Path
        Folder of the tiles.
    shape : tuple of int
        Coarse posts of the scene.

    Returns
    -------
    correction : float32 array (coarse rows, coarse cols), m
    """
    plan, parts = run.plan, []
    for tile in plan.tiles:
        left = _remainder(work, tile)
        if left is None:
            continue
        rows, cols = left.change.shape
        place = Window(tile.outer.row // plan.stride, tile.outer.col // plan.stride, rows, cols)
        posts = Window(tile.outer.row, tile.outer.col, rows, cols)
        share = blend_weights(tile, posts, plan.shape, plan.stride)
        parts.append(Part(left, place, _own(tile, plan, shape), share))
    free = run.settings.solver.estimate_exposure and run.settings.exposures is None
    return settle(parts, shape, keeps_plane=free)


def _remainder(work, tile):
    """What a tile has left; None when no image sees it."""
    folder = part_folder(work, tile.number)
    if "images" not in read_record(folder):
        return None
    names = Remainder.__dataclass_fields__
    return Remainder(*(np.array(read_array(folder, f"left-{name}")) for name in names))


def _own(tile, plan, shape):
    """The coarse posts that belong to a tile, to the scene's end."""
    ends = []
    for first, size, posts, coarse in zip(
        (tile.inner.row, tile.inner.col), tile.inner.shape, plan.shape, shape, strict=True
    ):
        is_last = first + size >= posts
        ends.append((first // plan.stride, coarse if is_last else (first + size) // plan.stride))
    (row, last_row), (col, last_col) = ends
    return Window(row, col, last_row - row, last_col - col)
