r"""Albedo map and the exposure of every image, from images, terrain and light.

Image formation, with reflectance R from the terrain, phase factor f and lens falloff v:

.. math:: I^k_{ij} = T^k A_{ij} R^k_{ij} f(\alpha^k_{ij}) v(\theta^k_{ij}) + b^k, \quad
          f = e^{-c_1 \alpha} + c_2, \quad v = e^{-v_2 \theta^2 - v_4 \theta^4}

The default solver eliminates the albedo (variable projection: given the rest, the best albedo of a
post is a weighted mean) and takes Gauss-Newton steps on the image parameters alone, whose matrix
couples only images that overlap. It minimises

.. math:: \frac{1}{\varphi} \sum_k \sum_{ij} S w\, \rho\!\left(\frac{I - A M - b}{s \sigma}\right)
          + \frac12 \sum_k \frac{q_k^2}{\sigma_A^2} + \frac12 \sum_k \frac{(b^k / \ell^k)^2}
          {\sigma_b^2} + \frac12 \sum_c \frac{(c - c_0)^2}{\sigma_c^2}

with :math:`M = T R f v`, noise scale s from the data, and :math:`\varphi`, how many times fewer
independent residuals there are than pixels (`effective_repetition`). The brightness ramp that T, b,
f and A can share unseen by the images is held by the prior on :math:`q_k`, the logarithm of the
mean albedo that image k alone sees, about its mean over the images.

``solver='alternating'`` repeats the two updates of the albedo paper instead. Most callers want
`estimate_albedo`.
"""

from dataclasses import dataclass

import numpy as np

from lommel.core.reflectance import reflectance_model
from lommel.errors import InputError
from lommel.estimate.albedo_arrays import OWN, SHARED, State
from lommel.estimate.albedo_cells import cells_of
from lommel.estimate.albedo_equations import (
    Problem,
    connected_groups,
    noise_scale,
    standard_errors,
    visitor_of,
)
from lommel.estimate.albedo_kernels import accumulate
from lommel.estimate.albedo_maps import MapMaker, MapRows, WholeMaps, disagreement_of
from lommel.estimate.albedo_samples import SampleBlocks, overlapping_pairs
from lommel.estimate.albedo_settings import AlbedoSettings, check_settings
from lommel.estimate.albedo_solver import solve, weighting

WEIGHINGS = 2  # passes over posts that tell the noise scale, once exposures come from cells
FEW_BLOCKS = 64  # of rows, spread evenly, are enough for all but the last of them


@dataclass(frozen=True, eq=False)
class AlbedoResult:
    """Albedo, exposures and how they were found.

    Attributes
    ----------
    albedo : float32 array (rows, cols), dimensionless; NaN where no image sees the ground
        Like the next three, None when the rows were taken by a function.
    albedo_error : float32 array (rows, cols); NaN with one image
        Standard error from the scatter of the images, and of all residuals where few see the post.
    orthomosaic : float32 array (rows, cols), image units
        Weighted mean of the images as they are.
    count : int32 array (rows, cols)
        Images that see the post.
    exposures, exposure_errors : float64 array (images,); mean exposure is 1, NaN where not used
    hazes, haze_errors : float64 array (images,), image units
    reasons : tuple of str
        Why an image was not used; empty where it was.
    shared, shared_errors : float64 array (4,)
        c1 (per rad), c2, v2 (per rad^2) and v4 (per rad^4); error NaN where not fitted.
    groups : tuple of tuple of int
        Images connected by overlap; the scale between two groups is set by the prior alone.
    disagreement_before, disagreement : float
        Of the images as they are, and by the result; `lommel.estimate.albedo_quality`.
    noise : float
        Standard error of a residual, as a share of the image's level.
    repetition : float
        Pixels per independent residual.
    passes : int
        Over all images.
    history : list of dict
        Cost, its change and what it is counted in, for each step from which the noise was kept.
    outcome, advice : str
    """

    albedo: np.ndarray | None
    albedo_error: np.ndarray | None
    orthomosaic: np.ndarray | None
    count: np.ndarray | None
    exposures: np.ndarray
    exposure_errors: np.ndarray
    hazes: np.ndarray
    haze_errors: np.ndarray
    reasons: tuple[str, ...]
    shared: np.ndarray
    shared_errors: np.ndarray
    groups: tuple[tuple[int, ...], ...]
    disagreement_before: float
    disagreement: float
    noise: float
    repetition: float
    passes: int
    history: list[dict]
    outcome: str
    advice: str


@dataclass(frozen=True, eq=False)
class Photometry:
    """What the images tell but for the maps, which one more pass then makes.

    Attributes
    ----------
    state : State
    errors : float64 array (images, 2)
        Of log exposure, and of haze in units of the image's level.
    shared_errors : float64 array (4,); NaN where not fitted
    mean_log_albedo, weighted_with, noise, repetition : float
        The second is the noise scale that weighs the pixels of the maps.
    groups : list of list of int
        Of the images used.
    reasons : list of str
        Why an image was not used; empty where it was.
    passes : int
    history : list of dict
    outcome, advice : str
    """

    state: State
    errors: np.ndarray
    shared_errors: np.ndarray
    mean_log_albedo: float
    weighted_with: float
    noise: float
    repetition: float
    groups: list[list[int]]
    reasons: list[str]
    passes: int
    history: list[dict]
    outcome: str
    advice: str


def estimate_albedo(
    observations,
    grid,
    heights,
    settings=None,
    jobs=None,
    take=None,
    kept_pixels=None,
    remember=None,
):
    """Albedo, exposures and haze from images on one grid.

    Parameters
    ----------
    observations : list of Observation
    grid : Grid
    heights : array (rows, cols), m
    settings : AlbedoSettings, optional
    jobs : InThreads, optional
        Works on the images and on blocks of rows.
    take : function (first row, MapRows), optional
        Takes the maps some rows at a time, from north to south; else the result holds them whole.
    kept_pixels : int, optional
        As `SampleBlocks` takes it.
    remember : function (compute), optional
        Gives the `Photometry` that ``compute()`` gives, perhaps from a run that was broken off.

    Returns
    -------
    result : AlbedoResult
    """
    given = observations, grid, heights, settings or AlbedoSettings()
    problem, found = find_photometry(*given, jobs, kept_pixels, remember)
    whole = WholeMaps(grid.shape) if take is None else None
    return collect(problem, found, make_maps(problem, found), take or whole, whole)


def find_photometry(
    observations, grid, heights, settings, jobs=None, kept_pixels=None, remember=None
):
    """All but the maps.

    Parameters
    ----------
    observations, grid, heights, settings, jobs, kept_pixels, remember
        As of `estimate_albedo`.

    Returns
    -------
    problem : Problem
    found : Photometry
    """
    check_settings(settings)
    model = reflectance_model(settings.reflectance)
    terms = model, settings.masks, settings.slope_noise, kept_pixels, jobs
    blocks = SampleBlocks(observations, grid, heights, *terms)
    if not len(blocks.levels):
        listing = [f"  {o.name}: {r}" for o, r in zip(observations, blocks.reasons, strict=True)]
        raise InputError("No image can be used.\n" + "\n".join(listing[:20]))
    remember = remember or (lambda compute: compute())
    found = remember(lambda: _fit(blocks, settings))
    if found.reasons != blocks.reasons:  # known from an earlier run
        used = [
            reason for reason, own in zip(found.reasons, blocks.reasons, strict=True) if not own
        ]
        blocks.keep(np.array([not reason for reason in used]), used)
    return _pose(blocks, settings), found


def _pose(blocks, settings):
    """Layout of the unknowns; the alternating solver knows exposure and haze only."""
    images = len(blocks.levels)
    with_priors = settings.solver == "projection"
    own = np.tile([True, settings.haze], images)
    fits_phase = with_priors and settings.fit_phase_factor and settings.phase_factor is not None
    fits_falloff = with_priors and settings.fit_falloff
    shared = [fits_phase, fits_phase, fits_falloff, fits_falloff, with_priors]
    start = np.array([*(settings.phase_factor or (0.0, 0.0)), 0.0, 0.0])
    is_fitted = np.concatenate([own, shared])
    return Problem(blocks, overlapping_pairs(blocks.windows), settings, is_fitted, start)


def _fit(blocks, settings):
    """Photometry; images that tell none are left out of the blocks."""
    cells = cells_of(blocks) if settings.solver == "projection" else blocks
    problem = _pose(blocks, settings)
    solved, solution = solve(_pose(cells, settings))
    point = solution.value
    sums, weighted_with = point.sums, point.scale
    point.scale, point.repetition = scale, repetition = weighting(sums)
    errors = standard_errors(solved, point)
    if cells is not blocks:
        for left in reversed(range(WEIGHINGS)):
            every = max(1, blocks.count // FEW_BLOCKS) if left else 1
            weighted_with = scale
            visitor = visitor_of(problem, point.state, weighted_with, is_step=False)
            sums = accumulate(visitor, every)
            if every == 1 or np.isfinite(noise_scale(sums.histogram)):  # else no overlap is there
                scale, repetition = weighting(sums)
    groups = connected_groups(solved, solution.value)
    shared = slice(-SHARED - 1, -1)
    return Photometry(
        state=point.state,
        errors=errors[: OWN * problem.images].reshape(-1, OWN),
        shared_errors=np.where(problem.is_fitted[shared], errors[shared], np.nan),
        mean_log_albedo=float(point.mean_log_albedo),
        weighted_with=weighted_with,
        noise=noise_scale(sums.histogram),
        repetition=repetition,
        groups=[group.tolist() for group in groups],
        reasons=list(blocks.reasons),
        passes=blocks.passes,
        history=solution.history,
        outcome=solution.outcome,
        advice=solution.advice + _remarks(problem, groups),
    )


def make_maps(problem, found):
    """The last pass over the images.

    Parameters
    ----------
    problem : Problem
    found : Photometry

    Returns
    -------
    maps : iterator
        What `MapMaker` gives of each block, from north to south.
    """
    visitor = visitor_of(problem, found.state, found.weighted_with, is_step=False)
    return problem.blocks.each(MapMaker(visitor, found.noise), "maps")


def collect(problem, found, maps, take, whole=None):
    """Hand on the maps, bring the gauge to mean exposure 1, and collect.

    Parameters
    ----------
    problem : Problem
    found : Photometry
    maps : iterator
        From `make_maps`.
    take : function (first row, MapRows)
    whole : WholeMaps, optional
        That ``take`` fills.

    Returns
    -------
    result : AlbedoResult
    """
    state, reasons = found.state, problem.blocks.reasons
    used = np.array([not reason for reason in reasons])
    gauge = state.exposure.mean()

    def per_image(values):
        everyone = np.full(len(reasons), np.nan)
        everyone[used] = values
        return everyone

    before, after = [], []
    for first, rows, *deviations in maps:
        take(first, rows)
        before.append(deviations[0])
        after.append(deviations[1])
    indices = np.flatnonzero(used)
    return AlbedoResult(
        **(dict.fromkeys(MapRows.__annotations__) if whole is None else vars(whole.rows)),
        exposures=per_image(state.exposure / gauge),
        exposure_errors=per_image(state.exposure / gauge * found.errors[:, 0]),
        hazes=per_image(state.haze),
        haze_errors=per_image(state.level * found.errors[:, 1]),
        reasons=tuple(reasons),
        shared=state.shared,
        shared_errors=found.shared_errors,
        groups=tuple(tuple(indices[group].tolist()) for group in found.groups),
        disagreement_before=disagreement_of(before),
        disagreement=disagreement_of(after),
        noise=found.noise,
        repetition=found.repetition,
        passes=found.passes + 1,
        history=found.history,
        outcome=found.outcome,
        advice=found.advice,
    )


def _remarks(problem, groups):
    """What the user should know about the gauge."""
    if problem.images == 1:
        return " One image only: its exposure is 1 by definition, nothing checks the albedo."
    if len(groups) > 1:
        return (
            f" The images form {len(groups)} groups that share no usable ground; the brightness of "
            "one against the other rests on albedo_contrast alone."
        )
    return ""
