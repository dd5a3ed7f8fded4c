r"""Noise, roughness of the terrain and errors of the initial DEM, read off the images themselves.

The difference between an image and the image that the initial DEM predicts has two causes. Relief
that the DEM lacks shows through its slope towards the Sun, so its power varies with direction as
:math:`\cos^2`; noise and albedo do not know the Sun's azimuth. With the linearised image

.. math:: \hat r(k) = i\,(\rho \cdot k)\, \hat d(k) + \hat n(k), \qquad
          P_r(k) = (\rho \cdot k)^2 P_d(|k|) + P_n(|k|)

(:math:`\rho` the change of brightness with slope, `d` the DEM's error, `n` everything that is not
slope) a fit over direction, octave by octave, separates :math:`P_d` from :math:`P_n`. The same fit
on the image itself gives the spectrum of the terrain, hence its roughness. Estimates of several
images are combined by their median. Most callers want `estimate_priors`.
"""

from dataclasses import dataclass

import numpy as np

TILE = 1024  # cells along each side of the part that is analysed
FIT_STEPS = 30  # of the multiplicative update; 10 settle it to 1 %
SMALLEST_NOISE = 1e-3  # share of the mean brightness: no imager's photometry is better
ROUGHNESS_OCTAVES = slice(1, 4)  # the shortest octave is dulled by the pixels' own size
# Photometric models and calibrations err at long waves, where a small error of brightness is a
# large one of height: this share of the brightness is doubted in every octave.
PHOTOMETRIC_ERROR = 0.0005
# Craters bend more light than random relief of the same spectrum: up to this factor
BEND_MARGIN = 8.0


@dataclass(frozen=True)
class Priors:
    """What is expected before the images are seen.

    Attributes
    ----------
    noise : array (images,), image units
        Standard error of a measured value, model errors included.
    roughness : float, rad
        Standard deviation of the change of slope from post to post.
    masses : array (depth,), 1/m^2
        Inverse square error of the initial DEM, averaged over 1, 2, 4, ... posts; zero where that
        average is not to be trusted by itself.
    albedo_contrast : float, dimensionless
        Standard deviation of the difference of albedo between neighbouring cells.
    """

    noise: np.ndarray
    roughness: float
    masses: np.ndarray
    albedo_contrast: float = 0.0


@dataclass(frozen=True)
class Spectra:
    """Power spectra per octave, shortest waves first.

    Attributes
    ----------
    wavenumber : array (octaves,), rad per post
        Geometric centre of the octave.
    relief : array (octaves,), m^2 post^2
    noise : array (octaves,), image units^2 post^2
    """

    wavenumber: np.ndarray
    relief: np.ndarray
    noise: np.ndarray


def estimate_priors(cells, residuals, gains, spacing, respond):
    """Priors from images and what the initial DEM leaves unexplained.

    Parameters
    ----------
    cells, residuals : list of float32 array (rows - 1, cols - 1), image units
        Images on the cells, and measured minus modelled there; NaN where missing.
    gains : list of (float, float), image units
        Change of brightness with the slopes along columns and rows.
    spacing : tuple of float, m
        Between rows and between columns.
    respond : function (relief, image number) -> float32 array (rows - 1, cols - 1)
        Change of a modelled image when relief (rows, cols) is added to the initial DEM.

    Returns
    -------
    priors : Priors
    """
    brightness = np.array([np.nanmean(image) for image in cells])
    error = [separate(r, gain, spacing) for r, gain in zip(residuals, gains, strict=True)]
    noise = np.array([np.sqrt(spectra.noise[:3].min()) for spectra in error])
    noise = np.maximum(noise, SMALLEST_NOISE * brightness)
    k = error[0].wavenumber
    relief = _median([spectra.relief for spectra in error])
    terrain = _median(
        [separate(i, gain, spacing).relief for i, gain in zip(cells, gains, strict=True)]
    )
    excess = _excess_noise(relief, error, gains, spacing, respond, cells[0].shape)
    red = (PHOTOMETRIC_ERROR * brightness[:, None]) ** 2 * 16 * np.pi / (3 * (2**0.5 * k) ** 2)
    share = _median([n**2 / (n**2 + e + r) for n, e, r in zip(noise, excess, red, strict=True)])
    mean_spacing = (spacing[0] * spacing[1]) ** 0.5
    slope_change = np.median((terrain * share * k**4)[ROUGHNESS_OCTAVES]) ** 0.5
    masses = _masses(k, relief * share, slope_change)
    contrast = np.median(np.sqrt(excess) * k / brightness[:, None])
    return Priors(noise, float(slope_change / mean_spacing), masses, float(contrast))


def _excess_noise(relief, error, gains, spacing, respond, shape):
    """Noise spectra beyond what the bend of the reflectance makes of missing relief.

    Relief with the DEM error's spectrum and random phases is added to the DEM and rendered: the
    part of the response that does not follow the slope is no noise, the solver models it.
    """
    field = _random_relief(relief, (shape[0] + 1, shape[1] + 1))
    excess = []
    for number, (spectra, gain) in enumerate(zip(error, gains, strict=True)):
        bend = separate(respond(field, number), gain, spacing).noise
        excess.append(np.maximum(spectra.noise - BEND_MARGIN * bend, 0.0))
    return excess


def _random_relief(relief, shape):
    """Gaussian field (rows, cols) with a given spectrum per octave, shortest waves first."""
    k = np.hypot(
        2 * np.pi * np.fft.fftfreq(shape[0])[:, None], 2 * np.pi * np.fft.rfftfreq(shape[1])[None]
    )
    octave = np.clip(np.log2(np.pi / np.maximum(k, 1e-9)), 0, relief.size - 1).astype(int)
    centre = np.pi / 2**0.5 / 2.0**octave
    power = np.where(k > 0, relief[octave] * (centre / np.maximum(k, centre / 2)) ** 4, 0.0)
    white = np.random.default_rng(0).standard_normal(shape)
    return np.fft.irfft2(np.fft.rfft2(white) * np.sqrt(power), shape).astype(np.float32)


def separate(image, gain, spacing):
    """Spectra of the relief behind an image and of what does not depend on the Sun's azimuth.

    Parameters
    ----------
    image : float32 array (rows, cols), image units
    gain : (float, float), image units
        Change of brightness with the slopes along columns and rows.
    spacing : tuple of float, m

    Returns
    -------
    spectra : Spectra
    """
    tile = _central_tile(image)
    window = np.hanning(tile.shape[0])[:, None] * np.hanning(tile.shape[1])[None, :]
    known = np.isfinite(tile)
    window = np.where(known, window, 0.0)
    tile = np.where(known, tile, 0.0)
    tile = (tile - (window * tile).sum() / max(window.sum(), 1e-12)) * window
    power = np.abs(np.fft.rfft2(tile)) ** 2 / max((window**2).sum(), 1e-12)
    k_row = 2 * np.pi * np.fft.fftfreq(tile.shape[0])[:, None]
    k_col = 2 * np.pi * np.fft.rfftfreq(tile.shape[1])[None, :]
    k = np.hypot(k_row, k_col)
    along = gain[0] / spacing[1] * 2 * np.sin(k_col / 2) * np.cos(k_row / 2)
    along = along + gain[1] / spacing[0] * 2 * np.sin(k_row / 2) * np.cos(k_col / 2)
    octaves = int(np.log2(min(tile.shape))) - 2
    centres, relief, noise = [], [], []
    for octave in range(octaves):
        high = np.pi / 2**octave
        inside = (k >= high / 2) & (k < high)
        centre = high / 2**0.5
        signal = along[inside] ** 2 * (centre / k[inside]) ** 4  # terrain falls as k^-4
        p, n = _fit_two_spectra(power[inside], signal)
        centres.append(centre)
        relief.append(p)
        noise.append(n)
    return Spectra(np.array(centres), np.array(relief), np.array(noise))


def _fit_two_spectra(power, signal):
    """Whittle fit of ``power = p signal + n`` with p, n >= 0, by multiplicative updates."""
    p = power.mean() / (2 * max(signal.mean(), 1e-30))
    n = power.mean() / 2
    if not power.mean() > 0:
        return 0.0, 0.0
    for _ in range(FIT_STEPS):
        model = p * signal + n
        p *= (signal * power / model**2).sum() / max((signal / model).sum(), 1e-30)
        n *= (power / model**2).sum() / (1 / model).sum()
    return float(p), float(n)


def _masses(k, relief, slope_change):
    """Masses per halving whose sum has the DEM error's inverse spectrum at each octave."""
    masses = np.zeros(k.size)
    gathered = k**4 / slope_change**2  # what the curvature term holds already, at each octave
    held = 0.0
    for level in range(1, k.size):
        # averages over 2^level posts hold waves from twice to four times that length on
        octave = level
        precision = 1 / max(relief[octave], 1e-30) - gathered[octave] - held
        masses[level] = max(precision, 0.0) * 4.0**level
        held += max(precision, 0.0)
    return masses


def _median(arrays):
    return np.median(np.stack(arrays), axis=0)


def _central_tile(image):
    rows, cols = (min(size, TILE) for size in image.shape)
    row, col = (image.shape[0] - rows) // 2, (image.shape[1] - cols) // 2
    return np.asarray(image[row : row + rows, col : col + cols], float)
