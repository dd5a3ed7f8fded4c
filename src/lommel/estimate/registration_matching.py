r"""How far one picture of the ground is shifted against another: masked correlation by octaves.

Both pictures are cut into octaves of wavelength. In each octave the correlation :math:`\rho` of the
two at every shift says how much more likely that shift makes the one picture, given the other, than
no relation does:

.. math:: \ln \Lambda = -\tfrac{1}{2} N \ln(1 - \rho |\rho|), \quad
          N = n / \sum_\tau R_a(\tau) R_b(\tau)

with the n posts known to both and their autocorrelations R: N counts the independent samples, so
that correlations without relation scatter by :math:`N^{-1/2}` (Bartlett 1935).

The octaves' logarithms add up. An octave that the pictures do not share (a DEM knows the hills, not
the boulders; albedo is not in it) has correlations of order :math:`N^{-1/2}` everywhere and adds
nothing but a constant. The curvature at the peak gives the standard error of the shift.
Most callers want `match`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter, maximum_filter

SHORTEST = 4.0  # posts; wavelength of the finest octave, above the grain of the sampling
SIGMA_PER_WAVELENGTH = 0.19  # of the Gaussian that halves a wavelength's amplitude
CLIP = 3.0  # rms; one bright crater must not decide
LEAST_OVERLAP = 0.4  # of the largest overlap, for a shift to be looked at
LEAST_SAMPLES = 8.0  # independent ones, for an octave to be looked at
CHANCE_PEAK = 5.0  # ln likelihood that the best of a hundred unrelated shifts reaches
LEAST_GAIN = 10.0  # ln of the likelihood by which a shift must beat the next one
FLATTEST = 1e-3  # 1 / posts^2; least information that a peak is taken to hold
LEAST_ERROR = 0.03  # posts; the parabola through the peak is no better


@dataclass(frozen=True)
class Match:
    """A shift between two pictures.

    Attributes
    ----------
    shift : array (2,), posts
        Rows and columns: what the first picture shows at a post, the second shows shifted by this.
    covariance : array (2, 2), posts^2
    likelihood : float
        ln of the likelihood ratio against no relation, at the peak.
    runner_up : float
        The same for the best peak elsewhere.
    correlation : float
        At the peak, of the octaves together.
    is_inside : bool
        The peak does not lie on the rim of the search.
    """

    shift: np.ndarray
    covariance: np.ndarray
    likelihood: float
    runner_up: float
    correlation: float
    is_inside: bool

    @property
    def is_distinct(self):
        """True when the shift beats every other by far."""
        gain = self.likelihood - self.runner_up
        return self.is_inside and gain > LEAST_GAIN and self.likelihood > 2.0 * self.runner_up


def octaves(shape, shortest):
    """Wavelengths, in posts, of the octaves that fit into a picture at least four times."""
    count = int(np.floor(np.log2(max(min(shape) / 4.0 / shortest, 1.0)))) + 1
    return shortest * 2.0 ** np.arange(count)


def bands(values, wavelengths):
    """Octaves of a picture: its waves from each wavelength to the double, 0 where unknown.

    Parameters
    ----------
    values : array (rows, cols)
        NaN where unknown; unknown places do not leak.
    wavelengths : float array (n,), posts
        Each twice the one before.

    Yields
    ------
    octave : float64 array (rows, cols)
        Of mean square 1 where known; no value beyond `CLIP`.
    """
    known = np.isfinite(values)
    filled = np.where(known, values, 0.0).astype(float)
    floor = 1e-12 * np.abs(filled).max(initial=0.0)
    fine = _smooth(filled, known, wavelengths[0])
    for wavelength in wavelengths:
        coarse = _smooth(filled, known, 2.0 * wavelength)
        octave, fine = np.where(known, fine - coarse, 0.0), coarse
        rms = np.sqrt(np.mean(octave[known] ** 2)) if known.any() else 0.0
        yield np.clip(octave / rms, -CLIP, CLIP) if rms > floor else np.zeros_like(filled)


def _smooth(filled, known, wavelength):
    sigma = SIGMA_PER_WAVELENGTH * wavelength
    weight = gaussian_filter(known.astype(float), sigma, mode="constant")
    return gaussian_filter(filled, sigma, mode="constant") / np.maximum(weight, 1e-6)


def match(first, second, reach, shortest=SHORTEST):
    """The shift at which a second picture of the ground looks most like the first.

    Parameters
    ----------
    first : array (rows, cols)
        NaN where unknown.
    second : array (rows + 2 reach, cols + 2 reach)
        The same place with a rim; NaN where unknown.
    reach : int, posts
        Largest shift along each axis.
    shortest : float, posts
        Wavelengths below are not looked at.

    Returns
    -------
    match : Match or None
        None when the pictures share too little.
    """
    known_first, known_second = (np.isfinite(x).astype(float) for x in (first, second))
    shape = tuple(next_fast_len(size, real=True) for size in second.shape)
    overlap = _correlate(rfft2(known_first, shape), rfft2(known_second, shape), shape, reach)
    if not overlap.max() > 1.0:
        return None
    is_allowed = overlap >= LEAST_OVERLAP * overlap.max()
    total, samples = np.zeros(overlap.shape), 0.0
    wavelengths = octaves(first.shape, max(shortest, SHORTEST))
    for a, b in zip(bands(first, wavelengths), bands(second, wavelengths), strict=True):
        spectra = rfft2(a, shape), rfft2(b, shape)
        power = _correlate(rfft2(a * a, shape), rfft2(known_second, shape), shape, reach)
        power *= _correlate(rfft2(known_first, shape), rfft2(b * b, shape), shape, reach)
        rho = _correlate(*spectra, shape, reach)
        rho /= np.sqrt(np.maximum(power, 1e-9 * overlap.max() ** 2))
        rho = np.clip(rho, -0.999, 0.999)
        independent = overlap / _shared_autocorrelation(*spectra, shape)
        if independent.max() < LEAST_SAMPLES:
            break
        total -= 0.5 * independent * np.log1p(-rho * np.abs(rho))
        samples += float(independent.max())
    if not samples:
        return None
    return _peak(np.where(is_allowed, total, -np.inf), samples, shortest)


def _correlate(first, second, shape, reach):
    """Sums of first(r) second(r + shift) from spectra, array (2 reach + 1, 2 reach + 1)."""
    return irfft2(np.conj(first) * second, shape)[: 2 * reach + 1, : 2 * reach + 1]


def _shared_autocorrelation(first, second, shape):
    """Sum over all shifts of the product of two autocorrelations, 1 or more posts."""
    own = [irfft2(np.abs(spectrum) ** 2, shape) for spectrum in (first, second)]
    peaks = [max(float(correlation[0, 0]), 1e-300) for correlation in own]
    return max(float((own[0] / peaks[0] * (own[1] / peaks[1])).sum()), 1.0)


def _peak(likelihood, samples, shortest):
    size = likelihood.shape[0]
    row, col = np.unravel_index(int(np.argmax(likelihood)), likelihood.shape)
    highest = float(likelihood[row, col])
    others = np.where(likelihood == maximum_filter(likelihood, 3), likelihood, -np.inf)
    far = np.hypot(*(np.ogrid[:size, :size][axis] - (row, col)[axis] for axis in (0, 1))) > shortest
    runner_up = float(np.max(others[far], initial=0.0))
    correlation = float(np.sqrt(-np.expm1(-2.0 * max(highest, 0.0) / samples)))
    around = likelihood[row - 1 : row + 2, col - 1 : col + 2]
    is_inside = around.shape == (3, 3) and bool(np.isfinite(around).all())
    shift, covariance = np.zeros(2), np.eye(2)
    if is_inside:
        shift, covariance = _parabola(np.exp(-2.0 * (around - highest) / samples), samples)
    place = np.array([row, col]) - size // 2
    covariance *= max(1.0, runner_up / CHANCE_PEAK)  # what is no noise makes higher peaks elsewhere
    return Match(place + shift, covariance, highest, runner_up, correlation, is_inside)


def _parabola(misfit, samples):
    """Minimum of the quadratic through 3 x 3 values of the misfit, and the shift's covariance.

    The misfit 1 - rho^2 is quadratic around its minimum, where its logarithm may have a cusp.
    """
    slope = np.array([misfit[2, 1] - misfit[0, 1], misfit[1, 2] - misfit[1, 0]]) / 2.0
    middle = 2.0 * misfit[1, 1]
    mixed = (misfit[2, 2] - misfit[2, 0] - misfit[0, 2] + misfit[0, 0]) / 4.0
    curvature = np.array(
        [
            [misfit[2, 1] + misfit[0, 1] - middle, mixed],
            [mixed, misfit[1, 2] + misfit[1, 0] - middle],
        ]
    )
    eigenvalues, axes = np.linalg.eigh(curvature)
    inverse = (axes / np.maximum(eigenvalues, FLATTEST / samples)) @ axes.T
    shift = np.clip(-inverse @ slope, -1.0, 1.0)
    least = max(misfit[1, 1] + slope @ shift / 2.0, LEAST_ERROR**2)
    information = np.clip(samples / 2.0 * eigenvalues / least, FLATTEST, LEAST_ERROR**-2)
    return shift, (axes / information) @ axes.T
