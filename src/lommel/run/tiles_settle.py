"""Tiles become one surface: their long waves are settled for the whole scene.

Most callers want `settle_tiles`.
"""

import numpy as np

from lommel.estimate.long_waves import Part, Remainder, settle
from lommel.run.records import read_array, read_record
from lommel.run.tiles_plan import blend_weights
from lommel.run.tiles_records import part_folder
from lommel.run.tiles_solve import frees_exposures
from lommel.scene.grid import Window


def settle_tiles(run, work, known):
    """What is to be added to the blended tiles.

    Parameters
    ----------
    run : TiledRun
        All of whose tiles are done.
    work : Path
        Folder of the tiles.
    known : Known

    Returns
    -------
    correction : float32 array (coarse rows, coarse cols), m
    exposures : array (images,), image units
    """
    plan, parts, shape = run.plan, [], known.correction.shape
    for tile in plan.tiles:
        folder = part_folder(work, tile.number)
        names = read_record(folder).get("images")
        if not names:  # no image sees it
            continue
        left = _remainder(folder)
        rows, cols = left.change.shape
        place = Window(tile.outer.row // plan.stride, tile.outer.col // plan.stride, rows, cols)
        posts = Window(tile.outer.row, tile.outer.col, rows, cols)
        share = blend_weights(tile, posts, plan.shape, plan.stride)
        images = [known.names.index(name) for name in names]
        parts.append(Part(left, place, _own(tile, plan, shape), share, images))
    free = frees_exposures(run.settings)
    correction, change = settle(parts, shape, len(known.names), free, plan.stride, plan.shape)
    return correction, known.exposures + change


def _remainder(folder):
    """What a tile has left."""
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
