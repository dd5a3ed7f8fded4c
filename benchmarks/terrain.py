r"""Terrain of the benchmark scenes: a fractal by spectral synthesis, and simple craters.

White noise is given the power spectrum :math:`P(k) \propto (k^2 + k_0^2)^{-(H + 1)}` of a surface
with Hurst exponent `H` and an outer scale :math:`2 \pi / k_0`; craters with the equilibrium size
distribution :math:`N(> D) \propto D^{-2}` are stamped on it. Lattices are periodic, so nothing
special happens at their edges. Most callers want `fractal` and `add_craters`.
"""

import numpy as np
from numba import njit
from scipy import fft

THREADS = 2
REACH = 3.0  # crater radii at which the ejecta end


def fractal(rng, shape, hurst, outer_scale):
    """Gaussian random field on a periodic lattice, standard deviation 1.

    Parameters
    ----------
    rng : numpy.random.Generator
    shape : tuple of int
    hurst : float
        0.5 is rough, 1 is smooth.
    outer_scale : float, lattice spacings
        Longer waves grow no further.

    Returns
    -------
    values : float32 array
    """
    spectrum = fft.rfft2(rng.standard_normal(shape, np.float32), workers=THREADS)
    k_row = fft.fftfreq(shape[0])[:, None].astype(np.float32)
    k_col = fft.rfftfreq(shape[1])[None, :].astype(np.float32)
    k_square = k_row**2 + k_col**2 + np.float32(outer_scale**-2.0)
    spectrum *= k_square ** np.float32(-(hurst + 1) / 2)
    spectrum[0, 0] = 0
    values = fft.irfft2(spectrum, shape, workers=THREADS, overwrite_x=True)
    return values / np.float32(values.std(dtype=float))


def blur(values, sigma):
    """Convolve a periodic lattice with a Gaussian of ``sigma`` lattice spacings."""
    spectrum = fft.rfft2(values, workers=THREADS)
    for axis, frequency in (
        (0, fft.fftfreq(values.shape[0])),
        (1, fft.rfftfreq(values.shape[1])),
    ):
        window = np.exp(-2 * (np.pi * sigma * frequency) ** 2).astype(np.float32)
        spectrum *= np.expand_dims(window, 1 - axis)
    return fft.irfft2(spectrum, values.shape, workers=THREADS, overwrite_x=True)


def add_craters(rng, heights, spacing, largest, smallest, coverage):
    """Stamp craters on periodic heights, in place.

    Parameters
    ----------
    rng : numpy.random.Generator
    heights : float32 array (rows, cols), m
    spacing, largest, smallest : float, m
        Of the lattice; diameters.
    coverage : float
        Share of the area that the craters of each octave of diameter cover.
    """
    area = heights.size * spacing**2
    octaves = np.log2(largest / smallest)
    # of N(> D) = n D^-2 the share of area per octave is n pi/4 2 ln 2
    density = coverage / (np.pi / 2 * np.log(2))
    count = rng.poisson(density * area * smallest**-2.0 * (1 - 4.0**-octaves))
    share = rng.random(count) * (1 - 4.0**-octaves)
    diameter = np.sort(smallest / np.sqrt(1 - share))[::-1]
    row, col = (rng.random(count) * size for size in heights.shape)
    depth_ratio = 0.02 + 0.18 * rng.random(count) ** 3  # few are fresh; Pike (1977) has 0.2
    _stamp(heights, row, col, diameter / (2 * spacing), depth_ratio * diameter)


@njit(cache=True)
def _stamp(heights, row, col, radius, depth):
    """Bowl, rim and ejecta of each crater, joined by a smooth minimum; lengths in spacings."""
    rows, cols = heights.shape
    for k in range(row.size):
        rim = 0.2 * depth[k]
        softness = 0.15 * depth[k]
        reach = REACH * radius[k]
        for r in range(int(row[k] - reach), int(row[k] + reach) + 2):
            for c in range(int(col[k] - reach), int(col[k] + reach) + 2):
                square = ((r - row[k]) ** 2 + (c - col[k]) ** 2) / radius[k] ** 2
                if square < REACH**2:
                    bowl = rim - depth[k] * (1 - square)
                    ejecta = rim * max(square, 0.1) ** -1.5
                    low = 0.5 * (bowl + ejecta - np.sqrt((bowl - ejecta) ** 2 + softness**2))
                    fade = 1 - (square / REACH**2) ** 2
                    heights[r % rows, c % cols] += low * fade
