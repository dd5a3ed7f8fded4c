"""Matches between two pictures of a map: as wholes, or patch by patch over parts of it.

A picture pair is a function from a window of the map to the first picture there, the second with a
rim, and the heights. Most callers want `match_whole_map` and `match_patches`.
"""

import numpy as np

from lommel.estimate.registration import Matches, join_matches
from lommel.estimate.registration_matching import match
from lommel.scene.body import to_xyz
from lommel.scene.geometry import unit
from lommel.scene.grid import Window

PLACES = 9  # along each side of a map, where the shift of the whole counts
TILE = 256  # posts along each side of what is looked at in one go
TILES = 25  # at most; of a large map, some are looked at
LEAST_KNOWN = 0.6  # share of a patch that both pictures must know


def match_whole_map(grid, pair, reach, shortest, members):
    """The shift of one picture of a map against another.

    Parameters
    ----------
    grid : Grid
    pair : function (Window, reach) -> (first, second, heights)
    reach : int, posts
        Largest shift.
    shortest : float, posts
        Wavelengths below are not looked at.
    members : tuple of int
        Numbers of the images, for `Matches`.

    Returns
    -------
    found : Match or None
        None when the pictures share too little.
    matches : Matches or None
        The shift at places all over the map, together as certain as it is.
    """
    first, second, heights = pair(grid.window, reach)
    found = match(first, second, reach, shortest)
    if found is None:
        return None, None
    row, col = (np.linspace(0, size - 1, PLACES).astype(int) for size in grid.shape)
    row, col = (index.ravel() for index in np.meshgrid(row, col, indexing="ij"))
    is_known = np.isfinite(first[row, col]) & np.isfinite(heights[row, col])
    row, col = row[is_known], col[is_known]
    if not row.size:
        return None, None
    shift = np.broadcast_to(found.shift, (row.size, 2))
    covariance = np.broadcast_to(found.covariance * row.size, (row.size, 2, 2))
    return found, map_matches(grid, row, col, heights[row, col], shift, covariance, members)


def match_patches(grid, pair, size, reach, shortest, members):
    """Shifts of patches all over a map.

    Parameters
    ----------
    grid : Grid
    pair : function (Window, reach) -> (first, second, heights)
    size : int, posts
        Side of a patch.
    reach : int, posts
        Largest shift.
    shortest : float, posts
    members : tuple of int

    Returns
    -------
    matches : Matches or None
        None when no patch matched.
    """
    parts = []
    for tile in spread_tiles(grid, max(size, TILE)):
        first, second, heights = pair(tile, reach)
        found = []
        for patch in _patches(tile, size):
            wide = Window(patch.row, patch.col, patch.rows + 2 * reach, patch.cols + 2 * reach)
            pictures = first[patch.slices], second[wide.slices]
            if min(np.isfinite(picture).mean() for picture in pictures) < LEAST_KNOWN:
                continue
            matched = match(*pictures, reach, shortest)
            height = heights[patch.slices]
            if matched is not None and matched.is_inside and np.isfinite(height).any():
                row, col = patch.row + (patch.rows - 1) / 2, patch.col + (patch.cols - 1) / 2
                found.append((tile.row + row, tile.col + col, np.nanmedian(height), matched))
        if found:
            row, col, height, matched = zip(*found, strict=True)
            shift = np.stack([each.shift for each in matched])
            covariance = np.stack([each.covariance for each in matched])
            places = np.array(row), np.array(col), np.array(height)
            parts.append(map_matches(grid, *places, shift, covariance, members))
    return join_matches(parts) if parts else None


def spread_tiles(grid, side, count=TILES):
    """Windows side by side all over a map; of many, every so-manyth.

    Parameters
    ----------
    grid : Grid
    side : int, posts
        Their sides are this long, or up to twice.
    count : int
        Windows at most.

    Returns
    -------
    tiles : list of Window
    """
    tiles = _split(grid.window, side)
    if len(tiles) > count:
        tiles = [tiles[k] for k in np.linspace(0, len(tiles) - 1, count).astype(int)]
    return tiles


def _patches(tile, size):
    """Squares side by side, counted from a tile's first post."""
    return _split(Window(0, 0, *tile.shape), size)


def _split(window, side):
    edges = [
        np.linspace(0, size, max(1, size // side) + 1).astype(int).tolist() for size in window.shape
    ]
    return [
        Window(row, col, last_row - row, last_col - col)
        for row, last_row in zip(edges[0][:-1], edges[0][1:], strict=True)
        for col, last_col in zip(edges[1][:-1], edges[1][1:], strict=True)
    ]


def map_matches(grid, row, col, height, shift, covariance, members):
    """Shifts in posts as `Matches`, in metres.

    Parameters
    ----------
    grid : Grid
    row, col : array (n,), posts
    height : array (n,), m
    shift : array (n, 2), posts
    covariance : array (n, 2, 2), posts^2
    members : tuple of int

    Returns
    -------
    matches : Matches
    """
    south, east = (
        _place(grid, row + down / 2, col + right / 2, height)
        - _place(grid, row - down / 2, col - right / 2, height)
        for down, right in ((1, 0), (0, 1))
    )
    post = np.stack([np.linalg.norm(south, axis=-1), np.linalg.norm(east, axis=-1)], axis=-1)
    first, second = (np.full(len(post), member) for member in members)
    return Matches(
        first,
        second,
        _place(grid, row, col, height),
        unit(south),
        unit(east),
        shift * post,
        covariance * post[:, :, None] * post[:, None, :],
    )


def _place(grid, row, col, height):
    return to_xyz(grid.body, *grid.lonlat_at(row, col), height)
