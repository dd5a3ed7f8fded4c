r"""Rows of the products, as the last pass over the images leaves them.

Most callers want `MapRows` and `WholeMaps`.
"""

from dataclasses import dataclass

import numpy as np

from lommel.estimate.albedo_kernels import Visitor
from lommel.estimate.albedo_quality import deviations_from_mean, nmad
from lommel.estimate.albedo_samples import clipped, orthomosaic

FREE_SHARE = 4.0  # images whose scatter the overall noise counts for in the error of one post
COMPARED = 2**22  # pixels of all images at most that tell how much these disagree


@dataclass(frozen=True, eq=False)
class MapRows:
    """The products on some rows of the grid.

    Attributes
    ----------
    albedo, albedo_error, orthomosaic : float32 array (rows, cols)
    count : int32 array (rows, cols)
    """

    albedo: np.ndarray
    albedo_error: np.ndarray
    orthomosaic: np.ndarray
    count: np.ndarray


class WholeMaps:
    """Keeps the products of the whole grid; a function (first row, rows).

    Parameters
    ----------
    shape : tuple of int

    Attributes
    ----------
    rows : MapRows
        All of them.
    """

    def __init__(self, shape):
        unknown = [np.full(shape, np.nan, np.float32) for _ in range(3)]
        self.rows = MapRows(*unknown, np.zeros(shape, np.int32))

    def __call__(self, first, rows):
        """Take some rows."""
        for name, part in vars(rows).items():
            getattr(self.rows, name)[first : first + len(part)] = part


@dataclass(frozen=True, eq=False)
class MapMaker:
    """What the last pass does with each block of rows.

    Attributes
    ----------
    visitor : Visitor
    noise : float
        Standard error of a residual, as a share of the image's level.
    """

    visitor: Visitor
    noise: float

    def __call__(self, block):
        """First row and `MapRows` of a block, and how the images deviate from each other there.

        Deviations are of the images as they are, and by the result; of the block's upper rows where
        all images together have more than `COMPARED` pixels.
        """
        blocks, state = self.visitor.blocks, self.visitor.state
        first, last = blocks.span(block)
        samples, maps, _ = self.visitor.visit(block)
        seen, gauge = maps.image_count > 0, state.exposure.mean()
        rows = MapRows(
            np.where(seen, gauge * maps.albedo, np.nan).astype(np.float32),
            np.where(seen, gauge * _albedo_error(maps, self.noise), np.nan).astype(np.float32),
            orthomosaic(clipped(samples, first, last), seen.shape),
            maps.image_count,
        )
        share = min(1.0, COMPARED / blocks.pixels)
        part = first + int(share * last) - int(share * first)
        here, shape = clipped(samples, first, part), (part - first, seen.shape[1])
        before = deviations_from_mean(here, shape)
        after = deviations_from_mean(here, shape, state.exposure, state.haze, state.shared)
        return first, rows, before, after


def disagreement_of(deviations):
    """Disagreement of images, from their deviations in each block; NaN without overlap."""
    values = np.concatenate(deviations)
    return nmad(values) if values.size else float("nan")


def _albedo_error(maps, noise):
    r"""Standard error of the albedo of each post.

    .. math:: \sigma_A^2 = \frac{\nu s^2 + \sum_k w r^2}{\nu + f} \;
              \frac{\sum_k w^2 M^2 / \pi}{(\sum_k w M^2)^2}

    with precision :math:`\pi`, the residuals r of the f free images of the post, and the overall
    noise s counting for :math:`\nu = 4` images more, so that a post seen once has an error too.
    NaN with one image, whose errors nothing shows.
    """
    variance = (FREE_SHARE * noise**2 + maps.scatter) / (FREE_SHARE + maps.freedom)
    information = np.maximum(maps.information, 1e-300)
    return np.sqrt(variance * maps.spread) / information
