"""The arrays that one pass of the albedo problem reads and writes.

Named tuples, because compiled code takes them as they are. Most callers want `Samples` and `Sums`.
"""

from typing import NamedTuple

import numpy as np

BLOCKS = 32  # of rows at least; the scene fixes them, so sums do not depend on the threads
OWN = 2  # parameters of one image: log exposure, haze
SHARED = 4  # parameters of all images: c1, c2, v2, v4
PATCHES = 8  # patches along each side of an image, in which residuals are summed
SCALE_BINS, SCALE_LOW, SCALE_STEP = 512, -14.0, 1.0 / 32.0  # of log2 |residual|, up to 2^2


class Samples(NamedTuple):
    """Pixels of all images, one image after the other, each row by row.

    Attributes
    ----------
    windows : int64 array (images, 4)
        First row, first column, rows and columns of each image in the grid.
    starts : int64 array (images,)
        Index of each image's first pixel in the arrays below.
    measured : float32 array (pixels,), image units
    reflectance : float32 array (pixels,)
        Of the model, without phase factor and falloff.
    phase : float32 array (pixels,), rad
    off_axis : float32 array (pixels,), rad squared
        Square of the angle between view ray and nadir at the camera.
    weight : float32 array (pixels,)
        Mask times feathering; 0 where the pixel is not used.
    precision : float32 array (pixels,), 1 / image units squared
        Inverse of the expected variance, up to one factor for all.
    """

    windows: np.ndarray
    starts: np.ndarray
    measured: np.ndarray
    reflectance: np.ndarray
    phase: np.ndarray
    off_axis: np.ndarray
    weight: np.ndarray
    precision: np.ndarray


class Pairs(NamedTuple):
    """Which images overlap: for image i its partners j >= i, itself included.

    Attributes
    ----------
    first : int64 array (images + 1,)
        Partners of i are ``second[first[i]:first[i + 1]]``.
    second : int64 array (pairs,)
    """

    first: np.ndarray
    second: np.ndarray


class Sums(NamedTuple):
    """What one pass leaves.

    Attributes
    ----------
    own : array (images, 2, 2)
        w J^T J of each image's parameters, upper triangle, before elimination.
    pairs : array (pairs, 2, 2)
        What the elimination of the albedo subtracts.
    shared_pixels : array (pairs,)
        Pixels that both images of a pair see.
    border : array (images, 2, 4)
        Image parameters against shared ones, eliminated.
    square : array (4, 4)
        Shared parameters, upper triangle, eliminated.
    gradient : array (images, 2)
    shared_gradient : array (4,)
    means : array (images, 7)
        Sums of weight, weight I, weight M and of weight times the derivatives of M.
    patches : array (images, 8, 8)
        Sum of the scores (derivative of the loss) in each patch of each image.
    score_square : array (1,)
    histogram : array (SCALE_BINS,)
        Sizes of residuals times the root of their precision.
    cost : array (1,)
    """

    own: np.ndarray
    pairs: np.ndarray
    shared_pixels: np.ndarray
    border: np.ndarray
    square: np.ndarray
    gradient: np.ndarray
    shared_gradient: np.ndarray
    means: np.ndarray
    patches: np.ndarray
    score_square: np.ndarray
    histogram: np.ndarray
    cost: np.ndarray


class State(NamedTuple):
    """Where the iteration stands.

    Attributes
    ----------
    exposure : float64 array (images,)
    haze : float64 array (images,), image units
    level : float64 array (images,), image units
        Unit in which haze is counted, so that it is of order 1.
    shared : float64 array (4,)
        c1 (per rad), c2, v2 (per rad^2), v4 (per rad^4).
    """

    exposure: np.ndarray
    haze: np.ndarray
    level: np.ndarray
    shared: np.ndarray


class Maps(NamedTuple):
    """Arrays on the grid, overwritten by each pass.

    Attributes
    ----------
    albedo : float64 array (rows, cols)
    information : float64 array (rows, cols)
        Sum of w M^2, the inverse variance of the albedo up to a factor.
    spread : float64 array (rows, cols)
        Sum of w^2 M^2 over the precision; over ``information`` squared, the variance of the albedo
        when residuals have unit variance (weights that fall to the border are not variances).
    scatter : float64 array (rows, cols)
        Sum of w times the squared residual.
    freedom : float64 array (rows, cols)
        Sum of weights times (n - 1) / n: the part of ``scatter`` that the fit leaves free.
    image_count : int32 array (rows, cols)
        Images that see the post.
    """

    albedo: np.ndarray
    information: np.ndarray
    spread: np.ndarray
    scatter: np.ndarray
    freedom: np.ndarray
    image_count: np.ndarray


class Work(NamedTuple):
    """Buffers of one row: per image (first axis) and per column (last axis)."""

    brightness: np.ndarray
    derivatives: np.ndarray
    w: np.ndarray
    u: np.ndarray
    u_shared: np.ndarray
    top: np.ndarray
    inverse: np.ndarray
    residual: np.ndarray


def empty_sums(images, pairs):
    """Sums of nothing."""
    return Sums(
        own=np.zeros((images, OWN, OWN)),
        pairs=np.zeros((pairs, OWN, OWN)),
        shared_pixels=np.zeros(pairs),
        border=np.zeros((images, OWN, SHARED)),
        square=np.zeros((SHARED, SHARED)),
        gradient=np.zeros((images, OWN)),
        shared_gradient=np.zeros(SHARED),
        means=np.zeros((images, 3 + SHARED)),
        patches=np.zeros((images, PATCHES, PATCHES)),
        score_square=np.zeros(1),
        histogram=np.zeros(SCALE_BINS),
        cost=np.zeros(1),
    )


def empty_maps(shape):
    """Maps of nothing."""
    return Maps(*(np.zeros(shape) for _ in range(5)), np.zeros(shape, np.int32))
