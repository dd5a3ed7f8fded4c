r"""From observations to the flat arrays that the albedo pass runs over.

For each image: reflectance, phase and the angle off nadir at every post of its window, its mask and
feathering, and the expected variance of its pixels. Most callers want `collect_samples`.
"""

from dataclasses import dataclass

import numpy as np

from lommel.estimate.albedo_arrays import Pairs, Samples
from lommel.scene.geometry import surface_normals, unit, viewing_geometry
from lommel.scene.grid import Window
from lommel.scene.masks import pixel_weights, shadow_thresholds

ROWS_AT_ONCE = 256  # rows of geometry in memory, 200 bytes per post


@dataclass(frozen=True)
class ImageGeometry:
    """What the position of Sun and camera decides at the posts of an image's window.

    Attributes
    ----------
    cos_incidence, cos_emission : float32 array (rows, cols); NaN where the terrain is unknown
    phase : float32 array (rows, cols), rad
    off_axis : float32 array (rows, cols), rad squared
        Square of the angle between view ray and nadir, at the camera.
    """

    cos_incidence: np.ndarray
    cos_emission: np.ndarray
    phase: np.ndarray
    off_axis: np.ndarray


def image_geometry(grid, heights, observation):
    """Geometry of an observation, computed some rows at a time.

    Parameters
    ----------
    grid : Grid
    heights : array (rows, cols) on the grid, m
    observation : Observation

    Returns
    -------
    geometry : ImageGeometry
    """
    window = observation.window
    planes = np.empty((4, *window.shape), np.float32)
    for first in range(0, window.rows, ROWS_AT_ONCE):
        rows = min(ROWS_AT_ONCE, window.rows - first)
        part = Window(window.row + first, window.col, rows, window.cols)
        planes[:, first : first + rows] = _geometry_of(grid, heights, observation, part)
    return ImageGeometry(*planes)


def _geometry_of(grid, heights, observation, part):
    halo = Window(part.row - 1, part.col - 1, part.rows + 2, part.cols + 2)
    halo = halo.intersection(grid.window)
    inside = part.relative_to(halo).slices
    xyz = grid.cut(halo).xyz(heights[halo.slices])
    normals = surface_normals(xyz)[inside]
    xyz = xyz[inside]
    spacecraft = np.asarray(observation.spacecraft_position, float)
    geometry = viewing_geometry(xyz, normals, observation.sun_position, spacecraft)
    cosine = unit(spacecraft - xyz) @ unit(spacecraft)
    return (
        geometry.cos_incidence,
        geometry.cos_emission,
        geometry.phase,
        np.arccos(np.minimum(cosine, 1.0)) ** 2,
    )


def slope_sensitivity(model, geometry):
    r"""Reflectance and the length of its gradient by the two slopes, per radian.

    .. math:: |\nabla R|^2 = R_i^2 \sin^2 i + R_e^2 \sin^2 e
              + 2 R_i R_e (\cos\alpha - \cos i \cos e)

    with the derivatives :math:`R_i, R_e` by the cosines of incidence and emission.

    Parameters
    ----------
    model : ReflectanceModel
    geometry : ImageGeometry

    Returns
    -------
    reflectance, gradient : float32 array (rows, cols)
    """
    mu0, mu = geometry.cos_incidence, geometry.cos_emission
    reflectance, by_mu0, by_mu = model.with_derivatives(mu0, mu, geometry.phase)
    square = by_mu0**2 * (1 - mu0**2) + by_mu**2 * (1 - mu**2)
    square += 2 * by_mu0 * by_mu * (np.cos(geometry.phase) - mu0 * mu)
    return reflectance, np.sqrt(np.maximum(square, 0.0))


def collect_samples(observations, grid, heights, model, masks, slope_noise):
    r"""Flat arrays of all images that can be used, and the reason for each that cannot.

    The expected variance of a pixel is that of the terrain's texture and of its slopes,

    .. math:: \sigma^2 \propto \ell^2 (R^2 + \kappa^2 |\nabla R|^2)

    with the image's level :math:`\ell = \sum w I / \sum w R`; images at low Sun, where a small
    error of slope is a large error of brightness, so get the weight they deserve.

    Parameters
    ----------
    observations : list of Observation
    grid : Grid
    heights : array (rows, cols), m
    model : ReflectanceModel
    masks : MaskSettings
    slope_noise : float, rad, or None
        :math:`\kappa`, slope error per relative error of brightness; None gives every pixel of
        every image the same variance.

    Returns
    -------
    samples : Samples
    levels : float64 array (used images,), image units
    reasons : list of str
        One per observation, empty where it is used.
    """
    thresholds = shadow_thresholds([image.measured for image in observations], masks)
    parts, levels, reasons = [], [], []
    for observation, threshold in zip(observations, thresholds, strict=True):
        geometry = image_geometry(grid, heights, observation)
        weight = pixel_weights(
            observation.measured,
            geometry.cos_incidence,
            geometry.cos_emission,
            threshold,
            observation.saturation,
            masks,
        )
        reflectance, gradient = slope_sensitivity(model, geometry)
        weight = np.where(reflectance > 0, weight, np.float32(0.0))
        reasons.append("" if weight.any() else _reason(observation, geometry, threshold))
        if not weight.any():
            continue
        level = float(np.sum(weight * np.nan_to_num(observation.measured), dtype=float))
        level /= float(np.sum(weight * np.nan_to_num(reflectance), dtype=float))
        levels.append(level)
        precision = _precision(level, reflectance, gradient, slope_noise)
        parts.append((observation, geometry, reflectance, weight, precision))
    if slope_noise is None and parts:
        common = np.float32(1.0 / np.median(levels) ** 2)
        parts = [(*part[:4], np.full_like(part[4], common)) for part in parts]
    return _concatenate(parts), np.array(levels), reasons


def _precision(level, reflectance, gradient, slope_noise):
    if slope_noise is None:
        return np.empty_like(reflectance)
    variance = level**2 * (reflectance**2 + (slope_noise * gradient) ** 2)
    return 1.0 / np.maximum(variance, 1e-6 * level**2)


def _reason(observation, geometry, threshold):
    """Why no pixel of an image is used."""
    known = np.isfinite(observation.measured) & np.isfinite(geometry.cos_incidence)
    if not known.any():
        return "no pixel lies on known terrain"
    if not (known & (geometry.cos_incidence > 0)).any():
        return "the Sun is below the horizon everywhere"
    if not (known & (observation.measured > threshold)).any():
        return (
            f"every pixel is shadow: no value above shadow_threshold = {threshold:.4g}; "
            "set a lower one if the image is lit"
        )
    return "every pixel is shadow, saturated or seen or lit too obliquely"


def _concatenate(parts):
    """Samples of the images, pixels without use set to 0."""
    windows = np.array(
        [
            [getattr(part[0].window, name) for name in ("row", "col", "rows", "cols")]
            for part in parts
        ],
        dtype=np.int64,
    ).reshape(-1, 4)
    sizes = windows[:, 2] * windows[:, 3]

    def flat(planes):
        known = [np.nan_to_num(plane.astype(np.float32), nan=0.0).ravel() for plane in planes]
        return np.concatenate(known) if known else np.zeros(0, np.float32)

    return Samples(
        windows=windows,
        starts=np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64),
        measured=flat([part[0].measured for part in parts]),
        reflectance=flat([part[2] for part in parts]),
        phase=flat([part[1].phase for part in parts]),
        off_axis=flat([part[1].off_axis for part in parts]),
        weight=flat([part[3] for part in parts]),
        precision=flat([part[4] for part in parts]),
    )


def overlapping_pairs(windows):
    """Pairs of images whose windows overlap, each image with itself included.

    Parameters
    ----------
    windows : int64 array (images, 4)

    Returns
    -------
    pairs : Pairs
    """
    low, high = windows[:, :2], windows[:, :2] + windows[:, 2:]
    second, first = [], [0]
    for i in range(len(windows)):
        overlaps = (np.maximum(low[i], low[i:]) < np.minimum(high[i], high[i:])).all(axis=1)
        second.append(i + np.flatnonzero(overlaps))
        first.append(first[-1] + len(second[-1]))
    return Pairs(np.array(first, np.int64), np.concatenate([np.zeros(0, int), *second]))


def orthomosaic(samples, shape):
    """Weighted mean of the images as they are, for comparison with the albedo.

    Parameters
    ----------
    samples : Samples
    shape : tuple of int

    Returns
    -------
    mosaic : float32 array (rows, cols), image units; NaN where no image is
    """
    total, weights = np.zeros(shape), np.zeros(shape)
    for (row, col, rows, cols), start in zip(samples.windows, samples.starts, strict=True):
        here = slice(row, row + rows), slice(col, col + cols)
        part = slice(start, start + rows * cols)
        weight = samples.weight[part].reshape(rows, cols)
        total[here] += weight * samples.measured[part].reshape(rows, cols)
        weights[here] += weight
    mosaic = np.full(shape, np.nan, np.float32)
    np.divide(total, weights, out=mosaic, where=weights > 0, casting="same_kind")
    return mosaic
