r"""How good an albedo map is: agreement of the images, brightness ramp, shading left in it.

None of these measures needs the truth. Most callers want `disagreement`.
"""

import numpy as np
from scipy.ndimage import gaussian_filter

from lommel.errors import InputError
from lommel.scene.body import local_frame
from lommel.scene.geometry import surface_normals, unit

DETAIL = 5.0  # posts, scale up to which brightness counts as relief and not as large-scale albedo


def nmad(values):
    """Normalised median absolute deviation: the standard deviation, were the values Gaussian."""
    values = np.asarray(values)
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def modelled_brightness(samples, k, shared):
    """Reflectance times phase factor times falloff at the posts of image k, (rows, cols)."""
    rows, cols = samples.windows[k, 2:]
    part = slice(samples.starts[k], samples.starts[k] + rows * cols)
    c1, c2, v2, v4 = shared
    factor = np.exp(-c1 * samples.phase[part]) + c2
    square = samples.off_axis[part]
    brightness = samples.reflectance[part] * factor * np.exp(-square * (v2 + v4 * square))
    return brightness.reshape(rows, cols)


def log_ratio(samples, k, exposure, haze, shared):
    """Logarithm of (I - b) / (T R f v) in the window of image k; NaN where not used or not > 0."""
    rows, cols = samples.windows[k, 2:]
    part = slice(samples.starts[k], samples.starts[k] + rows * cols)
    value = samples.measured[part].reshape(rows, cols).astype(float) - haze
    usable = (samples.weight[part].reshape(rows, cols) > 0) & (value > 0)
    ratio = np.full((rows, cols), np.nan)
    modelled = 1.0 if shared is None else modelled_brightness(samples, k, shared)
    np.divide(value, exposure * modelled, out=ratio, where=usable)
    return np.log(ratio)


def disagreement(samples, shape, exposures=None, hazes=None, shared=None):
    r"""How much images of the same ground disagree, as a share of brightness.

    With :math:`z^k_{ij} = \ln(I - b) - \ln(T R f v)` at every used pixel, the measure is

    .. math:: 1.4826\,\mathrm{median}\,|d - \mathrm{median}\,d|, \quad
              d^k_{ij} = z^k_{ij} - \frac1n \sum_k z^k_{ij}

    over all images of all posts seen at least twice, every image counting the same.

    Parameters
    ----------
    samples : Samples
    shape : tuple of int
        Of the grid.
    exposures, hazes : array (images,), optional
        1 and 0 by default.
    shared : array (4,), optional
        c1, c2, v2, v4; without them R f v is 1, and with the other defaults the measure is that of
        the raw images.

    Returns
    -------
    disagreement : float; NaN when no post is seen twice
    """
    deviations = deviations_from_mean(samples, shape, exposures, hazes, shared)
    return nmad(deviations) if deviations.size else float("nan")


def deviations_from_mean(samples, shape, exposures=None, hazes=None, shared=None):
    """The d of `disagreement`, with its arguments: float32 array (n,)."""
    images = len(samples.starts)
    exposures = np.ones(images) if exposures is None else exposures
    hazes = np.zeros(images) if hazes is None else hazes
    total, count = np.zeros(shape), np.zeros(shape, np.int32)
    for k in range(images):
        ratio = log_ratio(samples, k, exposures[k], hazes[k], shared)
        here = _slices(samples.windows[k])
        total[here] += np.nan_to_num(ratio)
        count[here] += np.isfinite(ratio)
    mean = np.where(count > 1, total / np.maximum(count, 1), np.nan)
    deviations = []
    for k in range(images):
        ratio = log_ratio(samples, k, exposures[k], hazes[k], shared)
        deviation = (ratio - mean[_slices(samples.windows[k])]).astype(np.float32)
        deviations.append(deviation[np.isfinite(deviation)])
    return np.concatenate(deviations)


def _slices(window):
    row, col, rows, cols = window
    return slice(row, row + rows), slice(col, col + cols)


def predict_image(measured, modelled, haze_error, steps=30):
    """Exposure and haze of one image whose albedo is known, and how well they describe it.

    Parameters
    ----------
    measured : array (n,), image units
    modelled : array (n,), dimensionless
        Albedo times reflectance.
    haze_error : float
        Expected standard deviation of haze as a share of the mean brightness; 0 fits exposure only.
    steps : int

    Returns
    -------
    exposure : float
    haze : float, image units
    error : float
        NMAD of (measured - predicted) / predicted.
    """
    if measured.size < 2:
        raise InputError("An image needs at least two pixels to be predicted.")
    exposure, haze = float(np.median(measured / modelled)), 0.0
    level = float(np.mean(measured))
    for _ in range(steps):
        predicted = exposure * modelled + haze
        relative = (measured - predicted) / np.maximum(predicted, 0.05 * level)
        scale = max(nmad(relative), 1e-12)
        weight = 1.0 / (1.0 + (relative / (2.385 * scale)) ** 2)
        weight /= (scale * np.maximum(predicted, 0.05 * level)) ** 2
        columns = np.stack([modelled, np.ones_like(modelled)], axis=1)
        if haze_error == 0:
            columns = columns[:, :1]
        square = (columns * weight[:, None]).T @ columns
        pull = (columns * weight[:, None]).T @ measured
        if haze_error > 0:
            square[1, 1] += 1.0 / (haze_error * level) ** 2
        solution = np.linalg.solve(square, pull)
        exposure, haze = float(solution[0]), float(solution[1]) if haze_error > 0 else 0.0
    predicted = exposure * modelled + haze
    return exposure, haze, nmad((measured - predicted) / predicted)


def brightness_ramp(albedo, count, least_images=3):
    """Linear trend of log albedo along the strip, from one end to the other.

    The strip's direction is the longer axis of the posts that enough images see.

    Parameters
    ----------
    albedo : array (rows, cols); NaN where unknown
    count : int array (rows, cols)
    least_images : int

    Returns
    -------
    ramp : float
        Logarithm of the brightness of one end over the other, by the fitted line.
    """
    good = np.isfinite(albedo) & (albedo > 0) & (count >= min(least_images, count.max()))
    places = np.argwhere(good).astype(float)
    places -= places.mean(axis=0)
    along = places @ np.linalg.svd(places.T @ places)[0][:, 0]
    slope = float(along @ np.log(albedo[good])) / float(along @ along)
    return slope * float(along.max() - along.min())


def shading_in_albedo(albedo, slope_to_sun):
    """How much the fine detail of an albedo map looks like the terrain lit from one side.

    Parameters
    ----------
    albedo : array (rows, cols); NaN where unknown
    slope_to_sun : array (rows, cols), dimensionless
        Slope of the terrain, positive where it faces the Sun.

    Returns
    -------
    correlation : float
        Of log albedo and slope, both without their means over 5 posts; 0 is none.
    gain : float, per unit slope
        Regression of the one on the other: what remains of the shading, or is overdone.
    """
    good = np.isfinite(albedo) & (albedo > 0) & np.isfinite(slope_to_sun)
    brightness = _detail(np.where(good, np.log(np.where(good, albedo, 1.0)), 0.0), good)
    slope = _detail(np.where(good, slope_to_sun, 0.0), good)
    limits = np.percentile(brightness, [1, 99])  # outliers at the rim do not count as shading
    inside = (brightness > limits[0]) & (brightness < limits[1])
    brightness, slope = brightness[inside], slope[inside]
    correlation = float(np.corrcoef(brightness, slope)[0, 1])
    return correlation, correlation * float(brightness.std() / slope.std())


def slope_towards_sun(grid, heights, sun_positions):
    """Slope of the terrain along the mean direction of the Sun, positive where it faces the Sun.

    Parameters
    ----------
    grid : Grid
    heights : array (rows, cols), m
    sun_positions : list of array (3,), m, body-fixed

    Returns
    -------
    slope : array (rows, cols), dimensionless
    """
    normals = surface_normals(grid.xyz(heights))
    east, north, up = local_frame(*grid.lonlat())
    to_sun = np.mean([unit(np.asarray(sun, float)) for sun in sun_positions], axis=0)
    sun_east, sun_north = east @ to_sun, north @ to_sun
    towards = np.einsum("...i,...i", normals, east) * sun_east
    towards += np.einsum("...i,...i", normals, north) * sun_north
    return towards / np.einsum("...i,...i", normals, up) / np.hypot(sun_east, sun_north)


def _detail(values, good):
    share = np.maximum(gaussian_filter(good.astype(float), DETAIL), 1e-6)
    return (values - gaussian_filter(values, DETAIL) / share)[good]
