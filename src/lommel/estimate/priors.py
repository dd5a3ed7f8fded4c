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

from dataclasses import dataclass, replace

import numpy as np

from lommel.errors import InputError

TILE = 512  # cells along each side of the part that is analysed
ENOUGH_MODES = 10_000  # of one octave: they tell a level to 1 %
FIT_STEPS = 30  # of the multiplicative update; 10 settle it to 1 %
LEAST_NOISE = 1e-3  # share of the mean brightness: no imager's photometry is better
ROUGHNESS_OCTAVES = slice(1, 4)  # the shortest octave is dulled by the pixels' own size
# Photometric models and calibrations err at long waves, where a small error of brightness is a
# large one of height: 0.07 % of the brightness per octave is a contrast of 0.2 % per post.
LEAST_CONTRAST = 0.002
KNOWN_SHARE = 0.85  # of the terrain's power: the DEM knows the octaves in which it errs by less
LEAST_DIVERSITY = 0.1  # below it images under nearly one Sun cannot tell albedo from slope
ALBEDO_ERROR = 0.3  # of a cell's albedo about 1, rms: mare against highland
# Averages over 2^l posts let through waves half as long, in which the DEM errs more: without these
# factors on its errors it holds more than it knows. Under one Sun little else holds long waves
# against albedo, so there the DEM keeps more of its weight.
LEAK, LEAK_ONE_SUN = 2.0, 2.0**0.5
# Craters bend more light than random relief of the same spectrum: up to this factor
BEND_MARGIN = 8.0


@dataclass(frozen=True)
class Priors:
    """What is expected before the images are seen.

    Attributes
    ----------
    noise : array (images,), image units
        Standard error of a measured value.
    roughness : float, rad
        Standard deviation of the change of slope from post to post.
    albedo_contrast : float, dimensionless
        Standard deviation of the difference of albedo between neighbouring cells.
    dem_errors : array (depth,), m
        Standard error of the initial DEM averaged over 1, 2, 4, ... posts; infinite where that
        average tells nothing that shorter ones have not told.
    smoothing : float, posts
        The initial DEM is the better guess of the terrain only where it is smooth over so many
        posts (standard deviation of a Gaussian).
    albedo_error : float, dimensionless
        Standard error of each cell's albedo about 1, which is eliminated cell by cell; 0 where too
        few kinds of light tell albedo from slope.
    """

    noise: np.ndarray
    roughness: float
    albedo_contrast: float
    dem_errors: np.ndarray
    smoothing: float
    albedo_error: float = 0.0


@dataclass(frozen=True)
class PriorSettings:
    """What is known better than the images tell; None is estimated from them.

    Attributes
    ----------
    terrain_roughness : float, rad, or None
        Standard deviation of the change of slope from post to post.
    initial_dem_error : float, m, or None
        Standard error of the initial DEM, averaged over its resolution.
    initial_dem_resolution : float, m, or None
        Length down to which the initial DEM can be trusted.
    """

    terrain_roughness: float | None = None
    initial_dem_error: float | None = None
    initial_dem_resolution: float | None = None

    def __post_init__(self):
        """Refuse what cannot be."""
        for name, value in vars(self).items():
            if value is not None and not 0 < value < np.inf:
                raise InputError(f"{name} = {value} is not positive. Give a positive number.")

    def applied_to(self, priors, spacing):
        """Priors with the settings in place of the estimates.

        Parameters
        ----------
        priors : Priors
        spacing : float, m

        Returns
        -------
        priors : Priors
        """
        if self.terrain_roughness is not None:
            priors = replace(priors, roughness=self.terrain_roughness)
        if self.initial_dem_error is None and self.initial_dem_resolution is None:
            return priors
        known = np.flatnonzero(np.isfinite(priors.dem_errors))
        level = int(known[0]) if known.size else priors.dem_errors.size - 1
        if self.initial_dem_resolution is not None:
            level = max(int(round(np.log2(self.initial_dem_resolution / spacing))), 0)
        error = self.initial_dem_error
        if error is None:  # what the estimate holds at that length and longer ones, together
            held = (priors.dem_errors**-2.0 / 4.0 ** np.arange(priors.dem_errors.size)).sum()
            error = (max(held, 1e-12) * 4.0**level) ** -0.5
        errors = np.full(level + 1, np.inf)
        errors[level] = error
        return replace(priors, dem_errors=errors, smoothing=2.0**level / 2)


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
    k = error[0].wavenumber
    relief = _median([spectra.relief for spectra in error])
    terrain = _median(
        [separate(i, gain, spacing).relief for i, gain in zip(cells, gains, strict=True)]
    )
    observed = np.stack([spectra.noise for spectra in error])
    bend = _bend_spectra(relief, gains, spacing, respond, cells[0].shape)
    # resampling dulls the noise of the shortest octave, so the next one tells its level
    noise = np.sqrt(np.maximum(observed[:, 1] - bend[:, 1], observed[:, 0]))
    noise = np.maximum(noise, LEAST_NOISE * brightness)
    excess = np.maximum(observed - BEND_MARGIN * bend - noise[:, None] ** 2, 0.0)
    contrasts = np.median(np.sqrt(excess) * k / brightness[:, None], axis=0)
    contrast = max(float(contrasts[2:].min()), LEAST_CONTRAST)
    tells_albedo = _diversity(np.array(gains) / brightness[:, None]) > LEAST_DIVERSITY
    if tells_albedo:  # the images themselves hold albedo and slope apart: no need to doubt them
        contrast = LEAST_CONTRAST
    # albedo at long waves drowns the slopes: the relief counts less there by this factor
    drowned = 1 + (contrast * np.median(brightness / noise) / k) ** 2
    level = np.median((terrain * k**4)[ROUGHNESS_OCTAVES])
    mean_spacing = (spacing[0] * spacing[1]) ** 0.5
    is_unknown = relief[:-1] > KNOWN_SHARE * terrain[:-1]
    first = int(np.flatnonzero(is_unknown).max(initial=-1)) + 1
    # a DEM that knows the hills does not err more on longer waves; what looks so is albedo
    relief[first:] = np.minimum.accumulate(relief[first:])
    return Priors(
        noise=noise,
        roughness=float(level**0.5 / mean_spacing),
        albedo_contrast=contrast,
        dem_errors=_dem_errors(drowned / relief, first) * (LEAK if tells_albedo else LEAK_ONE_SUN),
        smoothing=2.0**first / 2,
        albedo_error=ALBEDO_ERROR if tells_albedo else 0.0,
    )


def _diversity(relative_gains):
    """Share of the slope signal that is left when every cell may have its own albedo."""
    apart = relative_gains - relative_gains.mean(axis=0)
    return float((apart**2).sum() / max((relative_gains**2).sum(), 1e-30))


def _bend_spectra(relief, gains, spacing, respond, shape):
    """What missing relief adds to the noise spectra because reflectance bends with slope.

    Relief with the DEM error's spectrum and random phases is added to the DEM and rendered: the
    part of the response that does not follow the slope is no noise, the solver models it.
    """
    field = np.zeros((shape[0] + 1, shape[1] + 1), np.float32)
    tile = _central_tile(field)
    tile[:] = _random_relief(relief, tile.shape)
    return np.stack(
        [separate(respond(field, k), gain, spacing).noise for k, gain in enumerate(gains)]
    )


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
    power, k_row, k_col = _periodogram(image)
    along = gain[0] / spacing[1] * 2 * np.sin(k_col / 2) * np.cos(k_row / 2)
    along = along + gain[1] / spacing[0] * 2 * np.sin(k_row / 2) * np.cos(k_col / 2)
    centres, relief, noise = [], [], []
    for centre, inside, fall in _octaves(k_row, k_col):
        p, n = _fit_two_spectra(power[inside], along[inside] ** 2 * fall)
        centres.append(centre)
        relief.append(p)
        noise.append(n)
    return Spectra(np.array(centres), np.array(relief), np.array(noise))


def _periodogram(image):
    """Windowed power of the central tile and its wave numbers, rad per post."""
    tile = _central_tile(image)
    known = np.isfinite(tile)
    along_rows, along_cols = (np.hanning(size).astype(np.float32) for size in tile.shape)
    window = along_rows[:, None] * along_cols * known
    tile = np.where(known, tile, np.float32(0))
    mean = np.vdot(window, tile) / max(window.sum(dtype=float), 1e-12)
    tile = (tile - np.float32(mean)) * window
    wave = np.fft.rfft2(tile)
    power = (wave.real**2 + wave.imag**2) / np.float32(max(np.vdot(window, window), 1e-12))
    k_row = 2 * np.pi * np.fft.fftfreq(tile.shape[0])[:, None]
    k_col = 2 * np.pi * np.fft.rfftfreq(tile.shape[1])[None, :]
    return power, k_row, k_col


def _octaves(k_row, k_col):
    """Centre, members, and the fall of terrain as k^-4 within, of each octave."""
    k = np.hypot(k_row, k_col)
    for octave in range(int(np.log2(min(k_row.size, 2 * k_col.size - 1))) - 2):
        high = np.pi / 2**octave
        inside = (k >= high / 2) & (k < high)
        centre = high / 2**0.5
        yield centre, inside, (centre / k[inside]) ** 4


def _fit_two_spectra(power, signal):
    """Whittle fit of ``power = p signal + n`` with p, n >= 0, by multiplicative updates."""
    every = max(power.size // ENOUGH_MODES, 1)
    power, signal = power[::every], signal[::every]
    p = power.mean() / (2 * max(signal.mean(), 1e-30))
    n = power.mean() / 2
    if not power.mean() > 0:
        return 0.0, 0.0
    for _ in range(FIT_STEPS):
        model = p * signal + n
        p *= (signal * power / model**2).sum() / max((signal / model).sum(), 1e-30)
        n *= (power / model**2).sum() / (1 / model).sum()
    return float(p), float(n)


def _dem_errors(precision, first):
    """Errors of averages over 1, 2, 4, ... posts that hold each octave with the given precision.

    Averages over 2^l posts hold waves from twice to four times that length on, octave l and all
    longer ones; so each level from the first known one adds what its octave still lacks. Errors of
    a DEM are correlated: averages over longer lengths are not believed to better than half the
    error of the first.
    """
    errors = np.full(precision.size, np.inf)
    held = 0.0
    for level in range(first, precision.size):
        lacking = precision[level] - held
        if lacking > 0:
            least = errors[first] / 2 if np.isfinite(errors[first]) else 0.0
            errors[level] = max(1 / np.sqrt(lacking * 4.0**level), least)
            held = precision[level]
    return errors


def _median(arrays):
    return np.median(np.stack(arrays), axis=0)


def _central_tile(image):
    rows, cols = (min(size, TILE) for size in image.shape)
    row, col = (image.shape[0] - rows) // 2, (image.shape[1] - cols) // 2
    return image[row : row + rows, col : col + cols]
