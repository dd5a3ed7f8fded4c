"""Registration of raw images among each other, where they overlap under alike light.

Their orthoimages are matched, first the whole overlap, then patch by patch, and all cameras are
adjusted together: to the terrain, as well as it is known, and to each other.
Most callers want `tie_images`.
"""

from itertools import combinations

import numpy as np

from lommel.errors import LommelError
from lommel.estimate.registration import TERRAIN, join_matches
from lommel.estimate.registration_matching import SHORTEST
from lommel.progress import silent
from lommel.run.map_matching import match_patches, match_whole_map
from lommel.run.match_terrain import image_pair
from lommel.run.register_to_terrain import (
    PATCH_REACH,
    PATCH_SIZES,
    adjust,
    keep_matches,
    whole_spacing,
)
from lommel.scene.geometry import unit

ALIKE_SUN = np.cos(np.radians(30.0))  # images lit from farther apart look different
LEAST_SHARED = 64  # posts along each side of the overlap of two images


def tie_images(states, settings, progress=silent):
    """Match images with each other, and adjust all cameras together.

    Parameters
    ----------
    states : list of Registration
        Changed in place.
    settings : RegistrationSettings
    progress : callable
    """
    pairs = [pair for pair in combinations(range(len(states)), 2) if _are_alike(states, pair)]
    for find in (_match_overlap, _match_patches, _match_patches):
        found = [(pair, find(states, pair, settings)) for pair in progress(pairs, "image pairs")]
        pairs = [pair for pair, matches in found if matches is not None]
        if not pairs:
            return
        ties = [matches for _, matches in found if matches is not None]
        ground = [
            state.matches.renumbered(number, TERRAIN)
            for number, state in enumerate(states)
            if state.is_on_terrain
        ]
        matches = join_matches([*ground, *ties])
        adjustment = adjust(states, matches, settings)
        for number, state in enumerate(states):
            state.partners = {other for pair in pairs for other in pair if number in pair}
            if state.partners:
                keep_matches(state, matches, adjustment, number)
                _note_ties(state, number, matches, adjustment)


def _note_ties(state, number, matches, adjustment):
    own = (matches.first == number) | (matches.second == number)
    own &= matches.second != TERRAIN
    state.ties = int(own.sum())
    state.tie_residual = float(np.median(np.linalg.norm(adjustment.residual[own], axis=1)))


def _are_alike(states, pair):
    """True when two images show common ground under alike light."""
    first, second = (states[number].corrected for number in pair)
    ground = first.ground(0.0).mean(axis=0)
    if unit(first.sun - ground) @ unit(second.sun - ground) < ALIKE_SUN:
        return False
    try:
        return min(_overlap(states, pair).shape) >= LEAST_SHARED
    except LommelError:
        return False


def _overlap(states, pair, spacing=None):
    """Map of the ground that two images share; by default as fine as the coarser image."""
    first, second = (states[number] for number in pair)
    spacing = spacing or max(first.site.gsd, second.site.gsd)
    return first.site.grid([first.corrected, second.corrected], spacing)


def _pictures(states, pair, grid):
    first, second = (states[number] for number in pair)
    return image_pair(first.corrected, second.corrected, first.site, grid)


def _match_overlap(states, pair, settings):
    grid = _overlap(states, pair)
    grid = _overlap(states, pair, whole_spacing(grid))
    reach = int(np.ceil(settings.search_radius / max(grid.spacing)))
    found, matches = match_whole_map(grid, _pictures(states, pair, grid), reach, SHORTEST, pair)
    return matches if found is not None and found.is_distinct else None


def _match_patches(states, pair, settings):
    grid = _overlap(states, pair)
    pictures = _pictures(states, pair, grid)
    return match_patches(grid, pictures, PATCH_SIZES[-1], PATCH_REACH, SHORTEST, pair)


def placed(states):
    """Numbers of the images whose place is known: on the terrain, or tied to one that is.

    Parameters
    ----------
    states : list of Registration

    Returns
    -------
    numbers : set of int
    """
    known = {number for number, state in enumerate(states) if state.is_on_terrain}
    reached = set(known)
    while reached:
        reached = {other for number in reached for other in states[number].partners} - known
        known |= reached
    return known
