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
# Share of the stiffness against the twist of four cells: slopes at their centre do not feel a
# checkerboard
TWIST = 0.25


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
        equations = smoothness_equations(stiffness, contrast, weight)
        image = np.empty_like(albedo)
        equations.apply(albedo, image)
        albedo = albedo + conjugate_gradients(equations, pull - image, REDUCTION, MAX_CYCLES).x
        stiffness = albedo_stiffness(albedo, contrast)
    return albedo


def smoothness_equations(stiffness, contrast, weight):
    """Normal equations of an albedo that is smooth, and measured with a weight.

    Parameters
    ----------
    stiffness : float32 array (rows - 1, cols - 1)
        From `albedo_stiffness`.
    contrast : float, dimensionless
    weight : float32 array (rows, cols)

    Returns
    -------
    equations : NormalEquations
    """
    none = np.zeros_like(stiffness)
    twist = np.array([0.0, TWIST * contrast**-2.0, 0.0])
    return NormalEquations((stiffness, none, stiffness), twist, [0.0], posts=weight)


def albedo_stiffness(albedo, contrast):
    """Stiffness between cells under the pseudo-Huber loss: softer across borders of units.

    Parameters
    ----------
    albedo : float32 array (rows, cols)
    contrast : float, dimensionless

    Returns
    -------
    stiffness : float32 array (rows - 1, cols - 1)
    """
    return np.float32(contrast**-2.0) / np.sqrt(1 + _squared_slope(albedo, contrast))


def smoothness_cost(albedo, contrast):
    """Half of what an albedo's differences cost; its gradient is that of `smoothness_equations`.

    Parameters
    ----------
    albedo : float32 array (rows, cols)
    contrast : float, dimensionless

    Returns
    -------
    cost : float
    """
    slope = np.sqrt(1 + _squared_slope(albedo, contrast)) - 1
    twist = np.diff(np.diff(albedo, axis=0), axis=1)
    twisted = TWIST * contrast**-2.0 / 2 * np.sum(twist**2, dtype=float)
    return float(EDGE**2 * slope.sum(dtype=float) + twisted)


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


def _squared_slope(albedo, contrast):
    """Squared difference of neighbouring cells, in units of a border's."""
    half = np.float32(0.5)
    along = half * (np.diff(albedo, axis=1)[1:] + np.diff(albedo, axis=1)[:-1])
    across = half * (np.diff(albedo, axis=0)[:, 1:] + np.diff(albedo, axis=0)[:, :-1])
    return (along**2 + across**2) / np.float32((EDGE * contrast) ** 2)
