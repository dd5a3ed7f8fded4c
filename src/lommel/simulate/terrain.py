"""The ground of a simulated scene: heights and albedo at any place, from a seed.

Relief and albedo are functions of the place: every random number comes from a hash of the seed and
of the lattice cell it belongs to. Two grids over the same ground, coarse and fine, therefore see
the same mountains and craters; the finer one sees more of them.

Relief is the sum of octaves of spline noise, each with half the node distance of the one before,
and of craters: a bowl, a raised rim and ejecta that thin out with the cube of the distance.
Most callers want `ground`.

References
----------
Pike (1977), in Impact and Explosion Cratering, 489-509: depth and rim height of fresh craters.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.special import ndtri

SPLINE_RMS = 151 / 315  # rms of a cubic B-spline surface whose nodes have variance 1
SPLINE_SLOPE = 1.18  # its rms slope along one axis, times node distance over rms
MARE_OCTAVES = (96e3, 48e3, 24e3, 12e3, 6e3)  # m; outlines of the maria
MARE_DEPTH = 800.0  # m; lava fills what lies low
REGOLITH = 2500.0  # m; smaller craters bring up no bright rock
EJECTA_REACH = 3.0  # crater radii
RAY_REACH = 20.0  # crater radii
RAYS = 16  # bright rays around a crater
MARE, CRATERS, RELIEF, MOTTLING, DEM_ERROR = 1, 2, 3, 4, 5  # streams of random numbers


@dataclass(frozen=True)
class Craters:
    """A set of craters, one entry of each array per crater.

    Attributes
    ----------
    x, y : array (n,), m
        Centres, map coordinates.
    diameter, depth : array (n,), m
        Rim to rim; floor below rim.
    freshness : array (n,), dimensionless
        1 has a sharp rim, 0 a washed-out one.
    """

    x: np.ndarray
    y: np.ndarray
    diameter: np.ndarray
    depth: np.ndarray
    freshness: np.ndarray

    def where(self, chosen):
        """The craters of a mask or of indices."""
        fields = self.x, self.y, self.diameter, self.depth, self.freshness
        return Craters(*(values[chosen] for values in fields))


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
        one = _single(crater)
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


def crater_population(seed, terrain, resolution, x, y):
    """The craters that touch a lattice: numbers fall as diameter ** -2.

    The plane is cut into square cells as wide as the largest crater of a class (diameters
    D/2 to D); each cell holds one crater of the class or none.

    Parameters
    ----------
    seed : int
    terrain : TerrainSettings
    resolution : float, m
        Craters smaller than this are left out.
    x, y : array (cols,), (rows,), m

    Returns
    -------
    craters : Craters, largest class first
    """
    classes = []
    largest, number = terrain.largest_crater, 0
    while largest >= 2 * resolution:
        classes.append(_crater_class(seed, number, largest, terrain, x, y))
        largest, number = largest / 2, number + 1
    if not classes:
        return Craters(*np.zeros((5, 0)))
    names = ("x", "y", "diameter", "depth", "freshness")
    return Craters(*(np.concatenate([getattr(one, name) for one in classes]) for name in names))


def _crater_class(seed, number, largest, terrain, x, y):
    cell = largest
    reach = 0.5 * EJECTA_REACH * largest
    col, row = np.meshgrid(_cells(x, cell, reach), _cells(y, cell, reach))
    col, row = col.ravel(), row.ravel()
    chance, east, north, size, age = (
        uniform_hash((seed, CRATERS, number, item), row, col) for item in range(5)
    )
    diameter = largest / np.sqrt(1.0 + 3.0 * size)
    # E[D^2] is largest^2 ln(4)/3 for this distribution
    exists = chance < terrain.crater_coverage * cell**2 / (np.pi / 4 * largest**2 * np.log(4) / 3)
    is_fresh = age < terrain.fresh_share
    wear = np.where(is_fresh, 1.0, (1.0 - age) / (1.0 - terrain.fresh_share))
    depth = fresh_depth(diameter) * np.where(is_fresh, 1.0, 0.15 + 0.65 * wear)
    craters = Craters((col + east) * cell, (row + north) * cell, diameter, depth, wear)
    return craters.where(exists)


def _cells(coordinates, cell, reach):
    first = np.floor((coordinates.min() - reach) / cell)
    return np.arange(first, np.floor((coordinates.max() + reach) / cell) + 1).astype(np.int64)


def fresh_depth(diameter):
    """Depth of fresh craters, bowls below 11 km and flat floors above (Pike 1977), m."""
    return np.minimum(0.2 * diameter, 1044.0 * (diameter / 1e3) ** 0.301)


def crater_profile(distance, diameter, depth, freshness):
    r"""Height of one crater above the old surface.

    With the radius R, r the distance over R, depth d and rim height w, the smooth minimum of the
    bowl :math:`w - d (1 - r^n)` and of the ejecta :math:`w r^{-3}`, which end at 3 R.

    Parameters
    ----------
    distance : array (...), m
        From the centre.
    diameter, depth : float, m
    freshness : float, dimensionless
        Sharpness of the rim, 0 to 1.

    Returns
    -------
    height : array (...), m
    """
    radius, full = 0.5 * diameter, fresh_depth(diameter)
    rim = min(36.0 * (diameter / 1e3) ** 1.014, 236.0 * (diameter / 1e3) ** 0.399) * depth / full
    steepness = max(2.0, 0.75 * radius / full)  # walls of about 37 degrees at the rim
    r = distance / radius
    bowl = rim - depth * (1.0 - r**steepness)
    ejecta = rim / np.maximum(r, 0.3) ** 3
    softness = depth * (0.45 - 0.4 * freshness)
    crater = 0.5 * (bowl + ejecta - np.sqrt((bowl - ejecta) ** 2 + softness**2))
    return crater * _fade(r, 2.0, EJECTA_REACH)


def add_craters(heights, craters, x, y):
    """Add the relief of craters to heights, in place."""
    for index in range(craters.x.size):
        diameter = craters.diameter[index]
        part, distance, angle = _around(craters, index, 0.5 * EJECTA_REACH * diameter, x, y)
        heights[part] += crater_profile(
            distance * _outline(angle, craters.x[index]),
            diameter,
            craters.depth[index],
            craters.freshness[index],
        )


def _outline(angle, place):
    """No crater is round: share by which distances stretch in each direction."""
    return 1.0 + 0.05 * np.cos(2 * angle + place) + 0.03 * np.cos(3 * angle + 2 * place)


def brighten(albedo, craters, excess, x, y):
    """Brighten craters and their surroundings by a share of the albedo, in place."""
    for index in range(craters.x.size):
        radius = 0.5 * craters.diameter[index]
        part, distance, _ = _around(craters, index, EJECTA_REACH * radius, x, y)
        r = distance / radius
        albedo[part] *= 1.0 + excess * np.exp(-((r / 1.3) ** 2)) * _fade(r, 2.0, EJECTA_REACH)


def add_rays(albedo, craters, excess, x, y):
    """Add bright rays that leave craters, in place; they fade with distance."""
    for index in range(craters.x.size if excess > 0 else 0):
        radius = 0.5 * craters.diameter[index]
        part, distance, angle = _around(craters, index, RAY_REACH * radius, x, y)
        r = np.maximum(distance / radius, 1.0)
        key = CRATERS, int(craters.x[index]), int(craters.y[index])
        numbers = np.arange(RAYS)
        centre, strength, width = (uniform_hash(key, numbers, item) for item in range(3))
        star = _fade(distance / radius, 1.0, 2.5)
        for ray in range(RAYS):
            sharpness = 20.0 + 100.0 * width[ray]
            across = (np.cos(angle - 2 * np.pi * centre[ray]) - 1.0) * sharpness * np.sqrt(r)
            star += strength[ray] * np.exp(across)
        star = np.minimum(star, 1.0)
        albedo[part] *= 1.0 + excess * star * r**-0.5 * _fade(r, 5.0, RAY_REACH)


def _single(crater):
    values = crater.east, crater.north, crater.diameter, crater.depth_ratio * crater.diameter, 1.0
    return Craters(*(np.array([value]) for value in values))


def _around(craters, index, reach, x, y):
    """The part of a lattice near a crater; distance and direction there."""
    cols = np.flatnonzero(np.abs(x - craters.x[index]) < reach)
    rows = np.flatnonzero(np.abs(y - craters.y[index]) < reach)
    if cols.size == 0 or rows.size == 0:
        return (slice(0, 0), slice(0, 0)), np.zeros((0, 0)), np.zeros((0, 0))
    part = slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)
    east, north = x[part[1]] - craters.x[index], y[part[0], None] - craters.y[index]
    return part, np.hypot(east, north), np.arctan2(north, east)


def _fade(r, start, end):
    """1 up to ``start``, 0 from ``end``, smooth in between."""
    share = np.clip((end - r) / (end - start), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def spline_noise(key, distance, x, y):
    """A smooth random surface: cubic B-splines over a lattice of random nodes.

    Parameters
    ----------
    key : tuple of int
        Seed and stream; the same key gives the same surface.
    distance : float, m
        Between nodes.
    x, y : array (cols,), (rows,), m

    Returns
    -------
    noise : array (rows, cols), dimensionless
        Mean 0, rms 1 over large areas.
    """
    first_col, across = _spline_weights(x / distance)
    first_row, along = _spline_weights(y / distance)
    rows = first_row + np.arange(along.shape[1])
    cols = first_col + np.arange(across.shape[1])
    nodes = np.sqrt(12.0) * (uniform_hash(key, rows[:, None], cols[None, :]) - 0.5)
    return (along @ (across @ nodes.T).T) / SPLINE_RMS


def _spline_weights(position):
    """First node that matters, and the sparse matrix (positions, nodes) of B-spline weights."""
    node = np.floor(position).astype(np.int64)
    t = position - node
    weights = np.stack(
        [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=-1
    )
    first = node.min() - 1
    columns = node[:, None] - 1 - first + np.arange(4)
    starts = 4 * np.arange(position.size + 1)
    shape = position.size, int(columns.max()) + 1
    return first, csr_array((weights.ravel() / 6.0, columns.ravel(), starts), shape=shape)


def uniform_hash(key, row, col):
    """Numbers in [0, 1) that depend on a key and a lattice cell only (splitmix64).

    Parameters
    ----------
    key : tuple of int
    row, col : int array (...)

    Returns
    -------
    numbers : array (...)
    """
    row, col = np.broadcast_arrays(row, col)
    state = np.zeros(row.shape, np.uint64)
    for value in (*(np.full(row.shape, item) for item in key), row, col):
        state = state ^ value.astype(np.int64).view(np.uint64)
        state = state + np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state = state ^ (state >> np.uint64(31))
    return (state >> np.uint64(11)) * 2.0**-53
