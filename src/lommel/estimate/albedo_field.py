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


def fit_albedo(shading, measured, noise, contrast, start):
    """Albedo of every cell.

    Parameters
    ----------
    shading : list of float32 array (rows, cols), image units
        Exposure times reflectance of each image.
    measured : list of float32 array (rows, cols), image units
        Haze subtracted; NaN where not used.
    noise : array (images,), image units
    contrast : float, dimensionless
        Standard deviation of the difference between neighbouring cells.
    start : float32 array (rows, cols)
        Albedo to start from.

    Returns
    -------
    albedo : float32 array (rows, cols)
    """
    weight, pull = _information(shading, measured, noise)
    albedo = start
    stiffness = np.full((start.shape[0] - 1, start.shape[1] - 1), contrast**-2.0, np.float32)
    for _ in range(REWEIGHTINGS):
        albedo = albedo + _step(albedo, weight, pull, stiffness)
        stiffness = _reweighted(albedo, contrast)
    return albedo


def observed_contrast(shading, measured, noise):
    """Standard deviation of the albedo's difference between neighbours, as the images show it.

    Meant for images that tell each cell's albedo by themselves; their noise is taken off.

    Parameters
    ----------
    shading, measured, noise
        As in `fit_albedo`.

    Returns
    -------
    contrast : float, dimensionless; 0 when noise explains all differences
    """
    weight, pull = _information(shading, measured, noise)
    seen = np.where(weight > 0, weight, np.float32(np.nan))
    albedo = pull / seen
    differences = np.concatenate([np.diff(albedo, axis=axis).ravel() ** 2 for axis in (0, 1)])
    return float(max(np.nanmean(differences) - 2 * np.nanmean(1 / seen), 0.0) ** 0.5)


def _information(shading, measured, noise):
    """Weight of each cell's albedo, and weight times albedo, summed over the images."""
    weight = np.zeros(shading[0].shape, np.float32)
    pull = np.zeros_like(weight)
    for shade, image, sigma in zip(shading, measured, noise, strict=True):
        used = np.where(np.isfinite(image), np.float32(sigma**-2.0), np.float32(0))
        weight += used * shade * shade
        pull += used * shade * np.where(used > 0, image, np.float32(0))
    return weight, pull


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
