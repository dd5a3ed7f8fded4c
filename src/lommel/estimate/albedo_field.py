r"""Albedo on the cells of a known surface, as far as images and its own smoothness tell it.

What an image shows beyond the shading of the surface is albedo or noise. The albedo is the one that
minimises

.. math:: \sum_k \sum_{cells} \left(\frac{T^k A R^k - I^k}{\sigma^k}\right)^2
          + \sum_{cells} \left(\frac{|\nabla A|}{\sigma_A}\right)^2

with the differences of neighbouring cells expected to be of the size :math:`\sigma_A`: a field
whose spectrum falls as :math:`k^{-2}`, as albedo does. Most callers want `fit_albedo`.
"""

import numpy as np

from lommel.core.multigrid import NormalEquations, conjugate_gradients

REDUCTION = 1e-3  # of the linear residual: leaves errors far below the noise
MAX_CYCLES = 30


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
    albedo : float32 array (rows, cols), mean 1
    """
    weight = np.zeros(start.shape, np.float32)
    gradient = np.zeros(start.shape, np.float32)
    for shade, image, sigma in zip(shading, measured, noise, strict=True):
        used = np.where(np.isfinite(image), np.float32(sigma**-2.0), np.float32(0))
        weight += used * shade * shade
        gradient += used * shade * np.where(used > 0, image - start * shade, np.float32(0))
    rows, cols = start.shape
    stiff = np.full((rows - 1, cols - 1), contrast**-2.0, np.float32)
    none = np.zeros_like(stiff)
    # the cell's centre slopes do not feel a checkerboard; its twist does
    curvature = np.array([0.0, contrast**-2.0 / 4, 0.0])
    equations = NormalEquations((stiff, none, stiff), curvature, [0.0], posts=weight)
    smooth = np.empty_like(start)
    NormalEquations((stiff, none, stiff), curvature, [0.0]).apply(start, smooth)
    change = conjugate_gradients(equations, gradient - smooth, REDUCTION, MAX_CYCLES).x
    albedo = start + change
    return albedo / np.float32(albedo.mean(dtype=float))
