"""What a simulated scene holds: the settings and their presets.

Lengths are metres, angles degrees (these settings are written by people, in a file). ``east`` and
``north`` count from the map's origin, on the map. The defaults of `SceneSettings` describe the
strip of an orbit; `preset` gives it and the others by name.
"""

from dataclasses import dataclass, field, replace

from lommel.errors import InputError

FORBID_UNKNOWN = {"extra": "forbid"}  # what a reader that builds these from a file has to do


@dataclass(frozen=True)
class GridSettings:
    """The map: an equirectangular projection, true to scale at the latitude of its origin.

    Attributes
    ----------
    longitude_deg, latitude_deg : float, deg
        Origin of the map.
    east, north : float, m
        Centre of the grid; moved so that pixel edges are whole spacings, as maps have them.
    rows, cols : int
    spacing : float, m
    """

    longitude_deg: float = 26.0
    latitude_deg: float = 8.9
    east: float = 0.0
    north: float = 0.0
    rows: int = 400
    cols: int = 1200
    spacing: float = 420.0
    __pydantic_config__ = FORBID_UNKNOWN


@dataclass(frozen=True)
class TerrainSettings:
    """Highlands and maria: fractal relief, and craters of all sizes.

    Attributes
    ----------
    octave_slope_deg : float, deg
        Rms slope along one axis that the octave with nodes 1 km apart adds, in the highlands.
    hurst : float, dimensionless
        Octave slopes grow as (node distance / 1 km) ** (hurst - 1).
    longest_octave : float, m
        Node distance of the coarsest octave.
    finest_detail : float, posts
        Node distance of the finest octave and diameter of the smallest craters.
    crater_coverage : float, dimensionless
        Share of the area that the craters between two diameters D/2 and D cover, for every D:
        numbers fall as D ** -2, as on surfaces where new craters erase old ones.
    largest_crater : float, m
    fresh_share : float, dimensionless
        Share of the craters that keep their full depth and a sharp rim.
    mare_share : float, dimensionless
        Share of the area that lava covers; it is low, smooth and dark.
    mare_relief : float, dimensionless
        Relief of the maria relative to that of the highlands.
    """

    octave_slope_deg: float = 2.0
    hurst: float = 0.75
    longest_octave: float = 64_000.0
    finest_detail: float = 6.0
    crater_coverage: float = 0.1
    largest_crater: float = 40_000.0
    fresh_share: float = 0.05
    mare_share: float = 0.4
    mare_relief: float = 0.3
    __pydantic_config__ = FORBID_UNKNOWN


@dataclass(frozen=True)
class AlbedoSettings:
    """Brightness of the ground; its mean over highlands and maria is about 1.

    Attributes
    ----------
    contrast : float, dimensionless
        Highland albedo over mare albedo.
    halo : float, dimensionless
        Excess albedo in and around fresh craters.
    mottling : float, dimensionless
        Rms of the fine variations.
    mottling_length : float, m
        Node distance of these variations: they are smooth below.
    """

    contrast: float = 1.6
    halo: float = 0.15
    mottling: float = 0.015
    mottling_length: float = 5000.0
    __pydantic_config__ = FORBID_UNKNOWN


@dataclass(frozen=True)
class CraterSettings:
    """One crater put where it is wanted.

    Attributes
    ----------
    east, north : float, m
        Its centre.
    diameter : float, m
    depth_ratio : float, dimensionless
        Depth below the rim over diameter.
    rays : float, dimensionless
        Excess albedo of its rays at the rim; 0 for none.
    brightness : float, dimensionless
        Excess albedo of its interior.
    """

    east: float
    north: float
    diameter: float
    depth_ratio: float = 0.2
    rays: float = 0.0
    brightness: float = 0.0
    __pydantic_config__ = FORBID_UNKNOWN


@dataclass(frozen=True)
class OrbitSettings:
    """A circular orbit; the map's origin should lie at its turning point in latitude.

    Attributes
    ----------
    altitude : float, m
    inclination_deg : float, deg
        Beyond 90 the spacecraft flies west.
    frames : int
        Images per revolution, centred on the turning point.
    overlap : float, dimensionless
        Share of a footprint that the next one covers.
    focal_length_mm, frame_mm : float, mm
        Of the camera, which looks straight down; the frame is square.
    """

    altitude: float = 110_000.0
    inclination_deg: float = 171.1
    frames: int = 9
    overlap: float = 0.75
    focal_length_mm: float = 76.0
    frame_mm: float = 114.0
    __pydantic_config__ = FORBID_UNKNOWN


@dataclass(frozen=True)
class SunSettings:
    """Where the Sun stands during one revolution.

    Attributes
    ----------
    longitude_deg, latitude_deg : float, deg
        Sub-solar point.
    """

    longitude_deg: float
    latitude_deg: float = 1.0
    __pydantic_config__ = FORBID_UNKNOWN


@dataclass(frozen=True)
class FilmSettings:
    """From brightness to image values.

    Attributes
    ----------
    exposure : float, image units
        Mean image value of ground with albedo 1 and reflectance 1.
    exposure_spread : float, dimensionless
        Exposures lie evenly within this share of their mean.
    haze : float, image units
        Offsets lie evenly between 0 and this value.
    noise : float, dimensionless
        Rms noise over value where the value is ``exposure``; it grows as the root of the value.
    bits : int
        8 clips at 255 and rounds; 32 keeps real numbers.
    """

    exposure: float = 220.0
    exposure_spread: float = 0.3
    haze: float = 0.0
    noise: float = 0.0075
    bits: int = 8
    __pydantic_config__ = FORBID_UNKNOWN


@dataclass(frozen=True)
class InitialDemSettings:
    """How the initial DEM, as stereo would give it, differs from the truth.

    Attributes
    ----------
    blur : float, m
        Standard deviation of the Gaussian that smooths it.
    error : float, m
        Rms of the error added.
    error_length : float, m
        Node distance of that error: it is smooth below.
    """

    blur: float = 240.0
    error: float = 1.5
    error_length: float = 400.0
    __pydantic_config__ = FORBID_UNKNOWN


STRIP_CRATERS = (
    # steep and low under the Sun, so that its floor lies in cast shadow
    CraterSettings(east=-195_000.0, north=25_000.0, diameter=26_000.0, depth_ratio=0.2),
    CraterSettings(east=60_000.0, north=-30_000.0, diameter=11_000.0, depth_ratio=0.15, rays=0.5),
    # bright and high under the Sun, so that the film saturates
    CraterSettings(
        east=190_000.0,
        north=30_000.0,
        diameter=9_000.0,
        depth_ratio=0.15,
        rays=0.5,
        brightness=0.8,
    ),
)


@dataclass(frozen=True)
class SceneSettings:
    """A scene with a known answer; one seed gives one scene.

    Attributes
    ----------
    seed : int
        The same seed gives the same ground under every grid, so that a close-up of a strip shows
        the strip's own terrain, with finer detail.
    reflectance : str
        Name of the reflectance model.
    oversampling : int
        Facets per post along each axis from which images are formed; even.
    suns : tuple of SunSettings
        One revolution of the orbit for each.
    """

    seed: int = 1
    reflectance: str = "lunar-lambert"
    oversampling: int = 2
    grid: GridSettings = field(default_factory=GridSettings)
    terrain: TerrainSettings = field(default_factory=TerrainSettings)
    albedo: AlbedoSettings = field(default_factory=AlbedoSettings)
    craters: tuple[CraterSettings, ...] = STRIP_CRATERS
    orbit: OrbitSettings = field(default_factory=OrbitSettings)
    suns: tuple[SunSettings, ...] = (SunSettings(longitude_deg=86.0),)
    film: FilmSettings = field(default_factory=FilmSettings)
    initial_dem: InitialDemSettings = field(default_factory=InitialDemSettings)
    __pydantic_config__ = FORBID_UNKNOWN

    def __post_init__(self):
        """Check the values that would otherwise fail far from here."""
        for name, value, is_allowed, allowed in (
            ("oversampling", self.oversampling, _is_even(self.oversampling), "an even number"),
            ("grid.rows", self.grid.rows, self.grid.rows >= 8, "8 or more"),
            ("grid.cols", self.grid.cols, self.grid.cols >= 8, "8 or more"),
            ("grid.spacing", self.grid.spacing, self.grid.spacing > 0, "a positive length, m"),
            ("orbit.frames", self.orbit.frames, self.orbit.frames >= 1, "1 or more"),
            ("orbit.overlap", self.orbit.overlap, 0 <= self.orbit.overlap < 1, "0 to below 1"),
            ("film.bits", self.film.bits, self.film.bits in (8, 32), "8 or 32"),
            ("suns", len(self.suns), len(self.suns) >= 1, "at least one sub-solar point"),
        ):
            if not is_allowed:
                raise InputError(f"{name} = {value} cannot be simulated. Give {allowed}.")


def _is_even(number):
    return number >= 2 and number % 2 == 0


STRIP = SceneSettings()
CLOSE_UP = replace(
    STRIP,
    grid=replace(STRIP.grid, rows=300, cols=300, spacing=40.0, east=-19_000.0, north=-60_000.0),
    terrain=replace(STRIP.terrain, finest_detail=4.0),
    suns=(*STRIP.suns, SunSettings(longitude_deg=-30.0, latitude_deg=-1.0)),
)
PRESETS = {
    "apollo-orbit": STRIP,
    "sfs-patch": CLOSE_UP,
    "sfs-four-suns": replace(
        CLOSE_UP,
        orbit=replace(STRIP.orbit, frames=1),
        suns=tuple(
            SunSettings(26.0 + east, 8.9 + north)
            for east, north in ((60.0, 5.0), (-55.0, 10.0), (8.0, 55.0), (-10.0, -58.0))
        ),
    ),
}


def preset(name):
    """Settings of a preset.

    Parameters
    ----------
    name : {'apollo-orbit', 'sfs-patch', 'sfs-four-suns'}
        A strip of nine overlapping frames; a close-up of it at 40 m, which a second revolution
        sees under the evening Sun; the same ground seen from above under Suns from four sides.

    Returns
    -------
    settings : SceneSettings
    """
    if name not in PRESETS:
        raise InputError(
            f"{name!r} is not a preset. Choose {', '.join(PRESETS)}, or give a SCENE.toml."
        )
    return PRESETS[name]
