"""Registration of one raw image to the terrain, coarse to fine.

The image is first matched with the rendered terrain as a whole, which finds offsets up to the
search radius, then patch by patch with the corrected camera, as long as the patches agree more than
chance would have it. Most callers want `register_to_terrain`.
"""

from dataclasses import dataclass, field

import numpy as np

from lommel.core.reflectance import reflectance_model
from lommel.errors import InputError
from lommel.estimate.registration import (
    TERRAIN,
    AdjustmentSettings,
    Matches,
    adjust_cameras,
    chance_of_agreement,
    mean_error,
)
from lommel.estimate.registration_matching import SHORTEST, Match
from lommel.run.map_matching import match_patches, match_whole_map
from lommel.run.match_terrain import DEM_WAVELENGTH, Site, find_site, terrain_pair
from lommel.run.raw_images import RawImage

WHOLE_POSTS = 2**20  # of the map on which an image is matched as a whole
PATCH_SIZES = (128, 64)  # posts
PATCH_REACH = 8  # posts
ROUNDS = 2  # of matching and adjusting with patches of one size
AGREEMENT = 2.0  # posts; patches within it of the adjusted camera agree
LEAST_AGREEING = 6
COMMON_ERROR = 0.03  # of the shortest wavelength matched; measured on simulated scenes
MOST_CHANCE = -4.0  # log10 of the odds that patches agree by chance


@dataclass(frozen=True)
class RegistrationSettings:
    """What `lommel register` can be told.

    Attributes
    ----------
    search_radius : float, m
        Largest offset that is looked for.
    adjust : {'pointing', 'position'}
        What is corrected: the pointing, or pointing and position.
    reflectance : str
        Name of a reflectance model.
    position_error : float, m
        Standard error of a position that is corrected.
    """

    search_radius: float = 3000.0
    adjust: str = "pointing"
    reflectance: str = "lunar-lambert"
    position_error: float = 500.0

    def __post_init__(self):
        """Check the values."""
        if self.adjust not in ("pointing", "position"):
            raise InputError(f"adjust = {self.adjust!r} is not known. Choose pointing or position.")
        if not 0 < self.search_radius <= 1e5:
            raise InputError(
                f"search_radius = {self.search_radius:g} is not usable. Give metres, above 0 and "
                "up to 100000."
            )

    @property
    def adjustment(self):
        """What the adjustment may change."""
        return AdjustmentSettings(
            position_error=self.position_error if self.adjust == "position" else 0.0
        )


@dataclass(eq=False)
class Registration:
    """How an image stands on the terrain.

    Attributes
    ----------
    image : RawImage
        With its camera as it was.
    site : Site
    corrected : RawImage
        With its camera as it is now.
    correction : array (6,)
        Rotation (rad, camera frame) and move (m, body-fixed) so far.
    whole : Match or None
        Of the image as a whole against the terrain.
    matches : Matches or None
        Shifts against the terrain that hold, counted from the corrected camera.
    patches, agreeing : int
        Patches matched with the terrain; those that agree with the camera.
    chance : float
        log10 of the odds that they do by chance.
    patch_size : (int, float)
        Posts along each side of a patch, and their spacing in m.
    ties : int
        Patches matched with other images.
    tie_residual : float, m
        Median of what the images disagree by in them.
    partners : set of int
        Numbers of the images it is tied to.
    """

    image: RawImage
    site: Site
    corrected: RawImage
    correction: np.ndarray = field(default_factory=lambda: np.zeros(6))
    whole: Match | None = None
    matches: Matches | None = None
    patches: int = 0
    agreeing: int = 0
    chance: float = 0.0
    patch_size: tuple[int, float] = (0, 0.0)
    ties: int = 0
    tie_residual: float = np.nan
    partners: set[int] = field(default_factory=set)

    @property
    def is_on_terrain(self):
        """True when the terrain itself says where the image lies."""
        return self.matches is not None

    @property
    def shift(self):
        """How far the ground moved in the image, median over it: lines and samples, px."""
        ground = self.image.ground(float(np.mean(self.site.extremes)), self.site.terrain.body)
        before, after = (
            np.stack(image.camera.project(ground)) for image in (self.image, self.corrected)
        )
        return np.nanmedian(after - before, axis=1)

    @property
    def residual(self):
        """Median distance between agreeing patches and the terrain, m; NaN without patches."""
        if not self.patches:
            return np.nan
        distance = np.linalg.norm(self.matches.shift, axis=1)
        return float(np.median(np.sort(distance)[: self.agreeing]))

    @property
    def error(self):
        """Standard error of the image's place on the terrain, along one axis, m; NaN off it.

        From the scatter of the matches and from what they have in common: hills that look
        different from what the DEM and one albedo would show.
        """
        if not self.is_on_terrain:
            return np.nan
        longest = max(DEM_WAVELENGTH * self.site.terrain.spacing, SHORTEST * self.site.gsd)
        return float(np.hypot(mean_error(self.matches), COMMON_ERROR * longest))

    def correct(self, rotation, move):
        """Correct the camera by so much more."""
        self.correction = self.correction + np.concatenate([rotation, move])
        self.corrected = self.corrected.with_camera(self.corrected.camera.adjusted(rotation, move))


def register_to_terrain(image, terrain, settings):
    """Register one image to the terrain.

    Parameters
    ----------
    image : RawImage
    terrain : Terrain
    settings : RegistrationSettings

    Returns
    -------
    state : Registration
        Without matches when the image's place was not found.
    """
    state, matches, spacing = place_whole(image, terrain, settings)
    if state.whole is None or not state.whole.is_distinct:
        return state
    keep_matches(state, matches, adjust([state], matches, settings))
    while True:
        for size in np.repeat(PATCH_SIZES, ROUNDS).tolist():
            _refine(state, spacing, size, settings)
        if spacing <= state.site.finest_spacing:
            return state
        spacing = max(spacing / 4, state.site.finest_spacing)


def place_whole(image, terrain, settings, posts=WHOLE_POSTS):
    """Match an image with the terrain as a whole.

    Parameters
    ----------
    image : RawImage
    terrain : Terrain
    settings : RegistrationSettings
    posts : int
        Of the map, at most about.

    Returns
    -------
    state : Registration
        With ``whole``; its camera is not corrected yet.
    matches : Matches or None
    spacing : float, m
        Of the map.
    """
    site = find_site(image, terrain, reflectance_model(settings.reflectance))
    spacing = whole_spacing(site.grid([image], site.finest_spacing), posts)
    grid = site.grid([image], spacing)
    reach = int(np.ceil(settings.search_radius / spacing))
    pair = terrain_pair(image, site, grid)
    whole, matches = match_whole_map(grid, pair, reach, site.shortest(spacing), (0, TERRAIN))
    return Registration(image, site, image, whole=whole), matches, spacing


def whole_spacing(grid, posts=WHOLE_POSTS):
    """Spacing at which a map has at most about so many posts, m."""
    return max(grid.spacing) * max(1.0, float(np.sqrt(np.prod(grid.shape, dtype=float) / posts)))


def _refine(state, spacing, size, settings):
    """Match patches and correct the camera by them, if they agree."""
    site = state.site
    grid = site.grid([state.corrected], spacing)
    if min(grid.shape) < 2 * size:
        return
    pair = terrain_pair(state.corrected, site, grid)
    matches = match_patches(grid, pair, size, PATCH_REACH, site.shortest(spacing), (0, TERRAIN))
    if matches is None:
        return
    adjustment = adjust([state], matches, settings)
    distance = np.linalg.norm(adjustment.residual, axis=1) / spacing
    agreeing = int((distance < AGREEMENT).sum())
    chance = chance_of_agreement(agreeing, len(matches), AGREEMENT, PATCH_REACH)
    # smaller patches may be too weak to agree as well: then the larger ones stay
    is_better = chance < state.chance or (size, spacing) == state.patch_size
    if agreeing >= LEAST_AGREEING and chance < MOST_CHANCE and is_better:
        state.patches, state.agreeing, state.chance = len(matches), agreeing, chance
        state.patch_size = size, spacing
        keep_matches(state, matches, adjustment)


def adjust(states, matches, settings):
    """Corrections of the images' cameras; see `adjust_cameras`."""
    return adjust_cameras(
        [state.corrected.camera for state in states],
        matches,
        settings.adjustment,
        np.stack([state.correction for state in states]),
    )


def keep_matches(state, matches, adjustment, number=0):
    """Correct a camera; its matches with the terrain count from the corrected one.

    Parameters
    ----------
    state : Registration
    matches : Matches
    adjustment : Adjustment
    number : int
        Of the image in both.
    """
    state.correct(adjustment.rotation[number], adjustment.move[number])
    own = (matches.first == number) & (matches.second == TERRAIN)
    if own.any():
        state.matches = matches.of(own).renumbered(0, TERRAIN).left(adjustment.residual[own])
