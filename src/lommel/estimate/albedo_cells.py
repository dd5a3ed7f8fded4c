r"""Images as means over cells of the ground, from which exposures, haze and the rest are read.

A DEM is smoother than the ground, and an image has noise. Both blur the regression of one image on
another, post by post, and a haze feigned by that runs along a chain of images as a drift of their
exposures. Means over cells of many posts hold little of either, for the unknown slopes of a cell
cancel but for a difference of height across it:

.. math:: \bar I = T A \bar R f v + b

with means over the used posts of a cell. A cell of which many posts are not used tells nothing:
they are clipped or in shadow because of their brightness, and the mean of the others is not that of
the ground. Where images are some thousand posts wide a cell is some hundred times smaller than the
ground it replaces, and the steps of the solver cost nothing beside the one pass that makes the
cells. Most callers want `cells_of`.
"""

from functools import partial

import numpy as np

from lommel.estimate.albedo_arrays import BLOCKS, Samples
from lommel.jobs import InThreads

ACROSS = 32  # cells along an image: enough to see a lens, few enough to leave relief behind
FULLNESS = 8  # power of the used share of a cell in its weight: parts of it are other ground
WHOLE = 0.85  # least used share of a whole cell: 7 x 7 posts without one pixel and its neighbours
LEAST = 0.01  # least share of an image in whole cells; an exposure read from less is a guess
TOO_FEW = (
    "{:.1f} % of it is free of shadow, clipped and missing pixels over squares of {} x {} posts; "
    f"{100 * LEAST:g} % are needed to tell its exposure"
)


def cells_of(blocks):
    """Cells of the images, or the samples themselves where images are small.

    Images with next to no whole cell are left out of the cells and of ``blocks``, with the reason.
    Where this holds for all, holes are everywhere, and the samples themselves are the better
    choice.

    Parameters
    ----------
    blocks : SampleBlocks

    Returns
    -------
    blocks : Cells or SampleBlocks
    """
    size = cell_size(blocks.windows)
    if size < 2:
        return blocks
    cells = Cells(blocks, size)
    is_told = cells.whole >= LEAST
    if not is_told.any():
        return blocks
    if not is_told.all():
        blocks.keep(is_told, [TOO_FEW.format(100 * share, size, size) for share in cells.whole])
        cells.keep(is_told)
    return cells


def cell_size(windows):
    """Posts along a cell; 1 or less where images are too small for cells.

    Parameters
    ----------
    windows : int64 array (images, 4)
    """
    return int(np.sqrt(np.median(windows[:, 2] * windows[:, 3])) / ACROSS)


class Cells:
    """Means of samples over squares of posts, with the attributes and methods of `SampleBlocks`.

    Parameters
    ----------
    blocks : SampleBlocks
        Read once.
    size : int, posts

    Attributes
    ----------
    whole, completeness : float64 array (images,)
        Share of an image's window that its whole cells cover; the same over the largest of all.
    """

    def __init__(self, blocks, size):
        self.levels, self.brightness = blocks.levels, blocks.brightness
        self.shape = tuple(-(-posts // size) for posts in blocks.shape)
        first = blocks.windows[:, :2] // size
        last = -(-(blocks.windows[:, :2] + blocks.windows[:, 2:]) // size)
        self.windows = np.concatenate([first, last - first], axis=1)
        self.count = min(BLOCKS, self.shape[0])
        sums = [np.zeros((7, *window[2:])) for window in self.windows]
        for part in blocks.each(partial(_sums, blocks, size)):
            for k, row, values in part:
                top = row - self.windows[k, 0]
                sums[k][:, top : top + values.shape[1]] += values
        self.images = [_means(image, size**2) for image in sums]
        self.whole = np.array([np.mean(image[4] > 0) for image in self.images])
        self.completeness = self.whole / max(self.whole.max(), 1e-300)

    def keep(self, is_kept):
        """Leave out the images of which ``is_kept`` is False."""
        for name in ("levels", "brightness", "windows", "whole", "completeness"):
            setattr(self, name, getattr(self, name)[is_kept])
        self.images = [image for image, kept in zip(self.images, is_kept, strict=True) if kept]

    def each(self, visit, name=None, every=1):
        """As `SampleBlocks.each`, of which it is too quick to be told."""
        return InThreads().each(visit, range(0, self.count, every), name)

    def span(self, block):
        """First row of a block, and the row behind its last one."""
        return tuple(self.shape[0] * edge // self.count for edge in (block, block + 1))

    def block(self, block):
        """Samples of the rows of a block."""
        first, last = self.span(block)
        top = self.windows[:, 0]
        low = np.clip(first, top, top + self.windows[:, 2])
        high = np.clip(last, low, top + self.windows[:, 2])
        sizes = (high - low) * self.windows[:, 3]
        starts = np.cumsum(sizes) - sizes - (low - top) * self.windows[:, 3]
        parts = [
            image[:, a:b].reshape(len(image), -1)
            for image, a, b in zip(self.images, low - top, high - top, strict=True)
        ]
        return Samples(self.windows, starts, *np.concatenate(parts, axis=1))


def _sums(blocks, size, block):
    """For each image in a block of rows: its number, first row of cells, sums over used posts."""
    first, last = blocks.span(block)
    if first == last:
        return []
    samples, found = blocks.block(block), []
    for k, (row, col, rows, cols) in enumerate(samples.windows):
        low, high = max(row, first), min(row + rows, last)
        if low >= high:
            continue
        start = samples.starts[k] + (low - row) * cols
        part = slice(start, start + (high - low) * cols)
        used = (samples.weight[part] > 0).astype(np.float32)
        variance = used / np.where(used > 0, samples.precision[part], 1.0)
        given = (samples.measured, samples.reflectance, samples.phase, samples.off_axis)
        planes = [used, samples.weight[part], variance, *(plane[part] * used for plane in given)]
        values = np.stack(planes).reshape(len(planes), high - low, cols).astype(float)
        values = np.add.reduceat(values, _edges(low, high, size), axis=1)
        found.append((k, low // size, np.add.reduceat(values, _edges(col, col + cols, size), 2)))
    return found


def _edges(first, last, size):
    """Where cells begin in the posts from first to before last."""
    return np.maximum(np.arange(first // size, -(-last // size)) * size, first) - first


def _means(sums, posts):
    """Planes of `Samples` of one image, from its sums."""
    used, weight, variance, *given = sums
    safe = np.maximum(used, 1.0)
    measured, reflectance, phase, off_axis = (plane / safe for plane in given)
    share = np.where(used >= WHOLE * posts, used / posts, 0.0)
    weight = weight / safe * share ** (1 + FULLNESS)
    precision = np.divide(used, variance, out=np.zeros_like(used), where=used > 0)
    planes = measured, reflectance, phase, off_axis, weight, precision
    return np.stack(planes).astype(np.float32)
