"""Craters: where they are, how deep, how bright.

A crater is a bowl, a raised rim and ejecta that thin out with the cube of the distance; wear makes
it shallow and its rim soft. Young ones are brighter than what lies around, some have rays.
Most callers want `crater_population`, `add_craters` and `brighten`.

References
----------
Pike (1977), in Impact and Explosion Cratering, 489-509: depth and rim height of fresh craters.
"""

from dataclasses import dataclass

import numpy as np

from lommel.simulate.noise import uniform_hash

STREAM = 2  # of random numbers, beside those of `lommel.simulate.terrain`
EJECTA_REACH = 3.0  # crater radii
RAY_REACH = 20.0  # crater radii
RAYS = 16  # bright rays around a crater


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
        uniform_hash((seed, STREAM, number, item), row, col) for item in range(5)
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
        key = STREAM, int(craters.x[index]), int(craters.y[index])
        numbers = np.arange(RAYS)
        centre, strength, width = (uniform_hash(key, numbers, item) for item in range(3))
        star = _fade(distance / radius, 1.0, 2.5)
        for ray in range(RAYS):
            sharpness = 20.0 + 100.0 * width[ray]
            across = (np.cos(angle - 2 * np.pi * centre[ray]) - 1.0) * sharpness * np.sqrt(r)
            star += strength[ray] * np.exp(across)
        star = np.minimum(star, 1.0)
        albedo[part] *= 1.0 + excess * star * r**-0.5 * _fade(r, 5.0, RAY_REACH)


def single_crater(crater):
    """A set of one, from its `CraterSettings`."""
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
