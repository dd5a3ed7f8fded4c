"""The ground of a simulated scene: heights and albedo at any place, from a seed.

Relief and albedo are functions of the place: every random number comes from a hash of the seed and
of the lattice cell it belongs to. Two grids over the same ground, coarse and fine, therefore see
the same mountains and craters; the finer one sees more of them. Relief is the sum of octaves of
spline noise, each with half the node distance of the one before, and of craters.
Most callers want `ground`.
"""

import numpy as np
from scipy.special import ndtri

from lommel.simulate.craters import (
    add_craters,
    add_rays,
    brighten,
    crater_population,
    single_crater,
)
from lommel.simulate.noise import SPLINE_SLOPE, spline_noise

MARE_OCTAVES = (96e3, 48e3, 24e3, 12e3, 6e3)  # m; outlines of the maria
MARE_DEPTH = 800.0  # m; lava fills what lies low
REGOLITH = 2500.0  # m; smaller craters bring up no bright rock
MARE, RELIEF, MOTTLING, DEM_ERROR = 1, 3, 4, 5  # streams of random numbers


def ground(settings, x, y):
    """Heights and albedo on a rectangular lattice of map coordinates.

    Parameters
    ----------
    settings : SceneSettings
    x : array (cols,), m
        East of the map's origin.
    y : array (rows,), m
        North of it.

    Returns
    -------
    heights : array (rows, cols), m above the reference sphere
    albedo : array (rows, cols), dimensionless
    """
    seed, terrain, bright = settings.seed, settings.terrain, settings.albedo
    resolution = terrain.finest_detail * settings.grid.spacing
    mare = mare_cover(seed, terrain.mare_share, x, y)
    craters = crater_population(seed, terrain, resolution, x, y)
    is_fresh = craters.freshness == 1.0

    heights = fractal_relief(seed, terrain, resolution, x, y)
    add_craters(heights, craters.where(~is_fresh), x, y)
    heights *= 1.0 - (1.0 - terrain.mare_relief) * mare  # lava buries what came before it
    heights -= MARE_DEPTH * mare
    add_craters(heights, craters.where(is_fresh), x, y)

    albedo = 2.0 * (bright.contrast + (1.0 - bright.contrast) * mare) / (1.0 + bright.contrast)
    albedo *= 1.0 + bright.mottling * spline_noise((seed, MOTTLING), bright.mottling_length, x, y)
    brighten(albedo, craters.where(is_fresh & (craters.diameter > REGOLITH)), bright.halo, x, y)
    for crater in settings.craters:
        one = single_crater(crater)
        add_craters(heights, one, x, y)
        brighten(albedo, one, crater.brightness, x, y)
        add_rays(albedo, one, crater.rays, x, y)
    return heights, albedo


def fractal_relief(seed, terrain, resolution, x, y):
    """Octaves of spline noise whose slopes follow ``octave_slope (d / 1 km) ** (hurst - 1)``.

    Parameters
    ----------
    seed : int
    terrain : TerrainSettings
    resolution : float, m
        Octaves with nodes closer than this are left out.
    x, y : array (cols,), (rows,), m

    Returns
    -------
    heights : array (rows, cols), m
    """
    heights = np.zeros((y.size, x.size))
    distance, octave = terrain.longest_octave, 0
    while distance >= resolution:
        slope = np.tan(np.radians(terrain.octave_slope_deg))
        slope *= (distance / 1e3) ** (terrain.hurst - 1.0)
        amplitude = slope * distance / SPLINE_SLOPE
        heights += amplitude * spline_noise((seed, RELIEF, octave), distance, x, y)
        distance, octave = distance / 2, octave + 1
    return heights


def mare_cover(seed, share, x, y):
    """How much of the ground is mare: 0 in the highlands, 1 in the maria, steep in between."""
    if share <= 0:
        return np.zeros((y.size, x.size))
    level = sum(
        0.5**octave * spline_noise((seed, MARE, octave), distance, x, y)
        for octave, distance in enumerate(MARE_OCTAVES)
    )
    level /= np.sqrt(sum(0.25**octave for octave in range(len(MARE_OCTAVES))))
    return 1.0 / (1.0 + np.exp((level - ndtri(min(share, 1.0 - 1e-9))) / 0.04))
