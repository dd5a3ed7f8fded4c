r"""Albedo on the cells of a known surface, as far as images and its own smoothness tell it.

What an image shows beyond the shading of the surface is albedo or noise. The albedo is the one that
minimises

.. math:: \sum_k \sum_{cells} \left(\frac{T^k A R^k - I^k}{\sigma^k}\right)^2
          + \sum_{cells} \rho\!\left(\frac{|\nabla A|}{\sigma_A}\right)

with the differences of neighbouring cells expected to be of the size :math:`\sigma_A`: a field
whose spectrum falls as :math:`k^{-2}`, as albedo does. The pseudo-Huber loss grows linearly beyond
a few :math:`\sigma_A`, so that borders of units stay sharp (piecewise smooth); it is reached by
reweighting. Most callers want `fit_albedo`.
"""

import numpy as np

from lommel.core.multigrid import NormalEquations, conjugate_gradients

REDUCTION = 0.1  # of the linear residual per reweighting: leaves errors below the noise
MAX_CYCLES = 8
REWEIGHTINGS = 3  # the first is least squares; two more settle the borders
EDGE = 3.0  # times the expected difference: a border of units from there on


def albedo_information(shape, images):
    """What images tell of each cell's albedo.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns.
    images : iterable of (shading, measured, noise)
        Exposure times reflectance, and the measured brightness without haze, NaN where not used:
        float32 arrays (rows, cols), image units; and the standard error of the latter.

    Returns
    -------
    weight, pull : float32 array (rows, cols)
        Inverse squared standard error, and the same times the albedo.
    """
    weight, pull = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for shading, measured, noise in images:
        used = np.where(np.isfinite(measured), np.float32(noise**-2.0), np.float32(0)) * shading
        weight += used * shading
        pull += np.where(used > 0, used * measured, np.float32(0))
    return weight, pull


def fit_albedo(weight, pull, contrast, start):
    """Albedo of every cell.

    Parameters
    ----------
    weight, pull : float32 array (rows, cols)
        From `albedo_information`.
    contrast : float, dimensionless
        Standard deviation of the difference between neighbouring cells.
    start : float32 array (rows, cols)
        Albedo to start from.

    Returns
    -------
    albedo : float32 array (rows, cols)
    """
    albedo = start
    stiffness = np.full((start.shape[0] - 1, start.shape[1] - 1), contrast**-2.0, np.float32)
    for _ in range(REWEIGHTINGS):
        albedo = albedo + _step(albedo, weight, pull, stiffness)
        stiffness = _reweighted(albedo, contrast)
    return albedo


def observed_contrast(weight, pull):
    """Standard deviation of the albedo's difference between neighbours, as the images show it.

    Meant for images that tell each cell's albedo by themselves; their noise is taken off.

    Parameters
    ----------
    weight, pull : float32 array (rows, cols)
        From `albedo_information`.

    Returns
    -------
    contrast : float, dimensionless; 0 when noise explains all differences
    """
    seen = np.where(weight > 0, weight, np.float32(np.nan))
    albedo = pull / seen
    squares = [np.diff(albedo, axis=axis) ** 2 for axis in (0, 1)]
    count = sum(np.isfinite(square).sum() for square in squares)
    mean = sum(np.nansum(square, dtype=float) for square in squares) / max(count, 1)
    return float(max(mean - 2 * np.nanmean(1 / seen), 0.0) ** 0.5)


def _step(albedo, weight, pull, stiffness):
    """Change of the albedo that ends the least-squares problem with the given stiffness."""
    none = np.zeros_like(stiffness)
    # the centre slopes of 2x2 cells do not feel a checkerboard; their twist does
    twist = np.array([0.0, float(np.median(stiffness)) / 4, 0.0])
    equations = NormalEquations((stiffness, none, stiffness), twist, [0.0], posts=weight)
    image = np.empty_like(albedo)
    equations.apply(albedo, image)
    return conjugate_gradients(equations, pull - image, REDUCTION, MAX_CYCLES).x


def _reweighted(albedo, contrast):
    """Stiffness between cells under the pseudo-Huber loss: softer across borders of units."""
    half = np.float32(0.5)
    along = half * (np.diff(albedo, axis=1)[1:] + np.diff(albedo, axis=1)[:-1])
    across = half * (np.diff(albedo, axis=0)[:, 1:] + np.diff(albedo, axis=0)[:, :-1])
    square = (along**2 + across**2) / np.float32((EDGE * contrast) ** 2)
    return np.float32(contrast**-2.0) / np.sqrt(1 + square)
