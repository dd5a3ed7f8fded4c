r"""Shape from shading: the surface whose images under the known light are the measured ones.

Minimises, by Gauss-Newton from coarse to fine grids,

.. math:: Q(u) = \frac12 \sum_k \sum_{cells}
          \rho\!\left(\frac{T^k A R^k(u) + b^k - I^k}{\sigma^k}\right)
          + \frac12 \sum \left(\frac{\Delta^2 v}{s\,\sigma_c}\right)^2
          + \frac12 \sum \left(\frac{\Delta v}{s\,\sigma_s}\right)^2
          + \frac12 \sum_l \sum_{coarse} \left(\frac{S_l v}{\sigma_l}\right)^2,
          \quad v = u - \bar u

The data term is that of the photoclinometry paper (its equation 1) over both of its
parametrisations (`lommel.estimate.surface`). The others act on the difference to the expected
surface :math:`\bar u`, the initial DEM smoothed over what it does not know: terrain changes its
slope by :math:`\sigma_c` per post; slopes beyond :math:`\sigma_s` are rather albedo; and the
averages :math:`S_l` of the initial DEM over :math:`2^l` posts err by :math:`\sigma_l`
(`lommel.estimate.priors`). One pass over the images leaves one 2x2 tensor per cell
(`lommel.estimate.shading_kernels`); the linear solve (`lommel.core.multigrid`) never sees an image.
Most callers want `solve_surface`.
"""

from dataclasses import dataclass, replace

import numpy as np

from lommel.core.least_squares import (
    ATTEMPTS,
    ROUNDING,
    Solution,
    less_damping,
    more_damping,
    stiffen,
)
from lommel.core.multigrid import (
    NormalEquations,
    conjugate_gradients,
    distance,
    dot,
    threads_for,
)
from lommel.core.normal_operator import prolong_add
from lommel.core.plane import remove_plane
from lommel.estimate.albedo_field import (
    albedo_information,
    fit_albedo,
    observed_contrast,
)
from lommel.estimate.long_waves import Remainder, remainder
from lommel.estimate.priors import Priors, PriorSettings, estimate_priors
from lommel.estimate.problem import (
    Surroundings,
    best_photometry,
    coarse_posts,
    exposure_gain,
    fresh_problem,
)
from lommel.estimate.shading_kernels import SUM_COUNT, SUM_RR
from lommel.estimate.surface_and_albedo import solve_jointly

COARSEST = 24  # posts along the shorter side of the coarsest level that sees the images
FLOOR = 1e-4  # gain, relative to the cost, that a step may promise and not keep at the very bottom
NEAR = 1e-3  # expected gain of a step, relative to the cost, that a user need not wait for
SETTLED = 0.1  # gain, relative to the cost, below which a surface moves shadows no more
COARSE_STEPS = 4  # Gauss-Newton steps per coarse level at most; 2 on the largest of them
ENOUGH_CELLS = 100_000  # of them tell a correlation to (1 - r^2) 0.3 %
EXPOSURE_GAIN = 0.01  # of twice the cost: exposures off by a tenth of their standard error
EXPLAINED = 0.5  # noise standard errors, rms: a surface that leaves less leaves nothing to albedo
# Where interpolation hides how far a DEM errs, albedo cannot be read off the images beforehand:
# units that differ by a tenth or two border on each other over some ten posts
PATCHY = 0.01
CELL_UNKNOWNS = 3  # two slopes and the albedo: what a cell's values determine
POOR_FIT = 2.5  # noise standard errors, rms: more is not noise
POOR_START = 0.25  # of the brightness taken for noise: the initial DEM explains nothing
ODD_IMAGE = 1.5  # times the median of the others, which a false image spoils as well


@dataclass(frozen=True)
class SolverSettings:
    """When to stop and what to estimate along.

    Attributes
    ----------
    max_steps : int
        Gauss-Newton steps on the finest grid.
    step_tolerance : float, dimensionless
        Step that counts as converged, as a share of the whole change so far (rms).
    gain_tolerance : float, dimensionless
        Expected fall of the cost in the next step, as a share of it, that counts as converged.
    cycle_tolerance : float
        Reduction of the linear residual per Gauss-Newton step.
    max_cycles : int
        V-cycles per Gauss-Newton step.
    estimate_exposure : bool
        Re-estimate the exposures after each step.
    estimate_haze : bool or None
        And an offset per image, expected to be small. None: where single measured posts hold the
        surface, which a DEM that is merely blurred does not do.
    estimate_albedo : bool
        Give albedo what the images show beyond shading; otherwise it stays 1, or as given.
    """

    max_steps: int = 8
    step_tolerance: float = 0.001
    gain_tolerance: float = 1e-5
    cycle_tolerance: float = 0.2
    max_cycles: int = 40
    estimate_exposure: bool = True
    estimate_haze: bool | None = None
    estimate_albedo: bool = True


@dataclass(frozen=True)
class SurfaceSolution:
    """The refined surface.

    Attributes
    ----------
    u : float32 array (rows, cols), m
        Unknowns of the surface at the posts.
    albedo : float32 array (rows - 1, cols - 1)
        Of mean 1 where exposures are estimated.
    exposures, hazes : array (images,)
    measured : list of float32 array (rows - 1, cols - 1), image units
        Images on the cells of the refined surface; NaN where not used.
    modelled : list of float32 array (rows - 1, cols - 1), image units
        What the refined surface predicts there.
    correlations : list of float
        Of the images with what the initial surface predicts.
    misfits : array (images,), dimensionless
        Root mean square residual of each image, in noise standard errors.
    separation : float32 array (rows - 1, cols - 1), dimensionless
        How well albedo and slope can be told apart, 0 to 1; see `separation`.
    priors : Priors
        As estimated or given.
    left : Remainder or None
        What a part leaves to the long waves of the whole scene.
    """

    u: np.ndarray
    albedo: np.ndarray
    exposures: np.ndarray
    hazes: np.ndarray
    measured: list
    modelled: list
    correlations: list
    misfits: np.ndarray
    separation: np.ndarray
    priors: Priors
    left: Remainder | None = None


@dataclass(frozen=True)
class Start:
    """A surface known from a coarser grid: the solver starts from it instead of from the DEM.

    Attributes
    ----------
    u : float32 array (rows, cols), m
        Unknowns at the posts.
    stride : int
        Posts per post of the coarser grid.
    hold : float32 array (rows, cols), 1/m^2
        Weight with which each post is held there: along the rim of a part of a larger scene.
    misfits : array (images,), dimensionless
        Residuals that the whole scene leaves, in noise standard errors: they tell, for all its
        parts alike, whether there is something left for albedo.
    own : tuple of slice
        Posts that are this part's and no other's.
    around : Surroundings
        The coarser surface of the whole scene, which casts shadow from outside.
    brightness : array (images,), image units
        Medians over the whole scene: a part may lie in shadow for the most.
    frees_exposures : bool
        The whole scene may still change the exposures, which a part holds fixed.
    """

    u: np.ndarray
    stride: int
    hold: np.ndarray
    misfits: np.ndarray
    own: tuple[slice, slice]
    around: Surroundings
    brightness: np.ndarray
    frees_exposures: bool


def solve_surface(
    surface,
    initial,
    views,
    model,
    priors=None,
    settings=None,
    albedo=None,
    photometry=None,
    measured=None,
    start=None,
    maps=True,
):
    """Refine a surface by the shading in images.

    Parameters
    ----------
    surface : Surface
    initial : float32 array (rows, cols), m
        Unknowns of the initial DEM at the posts; no holes.
    views : list of OrthoView or CameraView
    model : ReflectanceModel
    priors : Priors or PriorSettings, optional
        Estimated from images and initial DEM where not given.
    settings : SolverSettings, optional
    albedo : float32 array (rows - 1, cols - 1), optional
        Known albedo on the cells, held fixed.
    photometry : (array (images,), array (images,)), image units, optional
        Known exposures and hazes, held fixed.
    measured : bool array (rows, cols), optional
        Posts that were measured, the others being interpolated; all of them by default.
    start : Start, optional
    maps : bool
        Whether albedo, modelled images and `separation` are wanted, or the surface alone.

    Returns
    -------
    solution : Solution
        Its value is a `SurfaceSolution`; of maps that are not wanted, albedo is as it was and the
        others are empty.
    """
    settings = settings or SolverSettings()
    if albedo is not None:
        settings = replace(settings, estimate_albedo=False)
    if photometry is not None:
        settings = replace(settings, estimate_exposure=False, estimate_haze=False)
    finest = fresh_problem(surface, initial, views, model, albedo)
    if start is not None:
        finest.around, finest.brightness = start.around, start.brightness
    finest.see(finest.initial)
    if photometry is None:
        # a blurred DEM explains part of the contrast only: haze would seem to explain the rest
        first_sums = finest.assemble(finest.initial)[2]
        _set_photometry(finest, first_sums, replace(settings, estimate_haze=False))
    else:
        finest.exposures, finest.hazes = (np.array(values, float) for values in photometry)
    if not isinstance(priors, Priors):
        spacing = (surface.grid.spacing[0] * surface.grid.spacing[1]) ** 0.5
        priors = (priors or PriorSettings()).applied_to(_estimate_priors(finest), spacing)
    if not settings.estimate_albedo:
        priors = replace(priors, albedo_error=0.0)
    finest.expect(priors)
    if measured is not None:
        spacing = (surface.grid.spacing[0] * surface.grid.spacing[1]) ** 0.5
        priors = replace(priors, albedo_contrast=max(priors.albedo_contrast, PATCHY))
        finest.pin(measured, priors.roughness * spacing)
        if settings.estimate_haze is None:
            settings = replace(settings, estimate_haze=settings.estimate_exposure)
    if settings.estimate_haze:
        finest.hidden_slope = 0.0  # relief that coarse images are not believed would be haze
    if start is not None:
        finest.hold(start.u, start.hold)
    correlations = [
        correlation(cells, finest.predict(finest.initial, k))
        for k, cells in enumerate(finest.cells)
    ]
    history: list[dict] = []
    is_joint = measured is not None and settings.estimate_albedo
    if is_joint:
        u, converged = finest.initial, False
        for _ in range(2):  # shadows of the smooth start are not those of the relief found
            finest.see(u)
            u, converged = solve_jointly(finest, u, priors.albedo_contrast, settings, history)
    else:
        u, converged = _coarse_to_fine(finest, settings, history, start)
    left_over = None
    if start is None:
        sums = finest.assemble(u)[2]
    else:
        here = replace(finest, pins=None, pinned=None).expand(u)
        left_over = remainder(finest, here, u, start.own, start.stride, start.frees_exposures)
        sums = here.sums
    misfits = np.sqrt(sums[:, SUM_RR] / np.maximum(sums[:, SUM_COUNT], 1))
    left = misfits if start is None else start.misfits
    if maps and settings.estimate_albedo and not is_joint and left.max() > EXPLAINED:
        _fit_albedo(finest, u, priors, left, settings)
    modelled = [finest.predict(u, k) for k in range(len(views))] if maps else []
    value = SurfaceSolution(
        u,
        finest.albedo,
        finest.exposures,
        finest.hazes,
        finest.cells,
        modelled,
        correlations,
        misfits,
        separation(finest, u) if maps else np.empty((0, 0), np.float32),
        priors,
        left_over,
    )
    names = [view.name for view in views]
    noise = np.median([n / np.nanmean(i) for n, i in zip(priors.noise, finest.cells, strict=True)])
    outcome, advice = _outcome(converged, history, misfits, noise, names)
    return Solution(value, outcome, advice, history)


def separation(level, u):
    """Share of the slope signal that is left when each cell's albedo is free.

    Parameters
    ----------
    level : Problem
    u : float32 array (rows, cols), m

    Returns
    -------
    share : float32 array (rows - 1, cols - 1), dimensionless
        0 with one image or images under one Sun: there albedo and slope cannot be told apart.
        Towards 1 with Suns from all around. NaN where no image counts.
    """
    if len(level.views) == 1:
        return np.where(np.isfinite(level.cells[0]), np.float32(0), np.float32(np.nan))
    bound, free = (
        replace(level, albedo_error=error, slope=np.zeros(2, np.float32), memory={}).assemble(u)[0]
        for error in (0.0, np.inf)
    )
    signal = bound[0] + bound[2]
    share = (free[0] + free[2]) / np.where(signal > 0, signal, np.nan)
    return np.clip(share, 0, 1)


def correlation(measured, modelled):
    """Correlation of two images over the cells both have; large ones are thinned out evenly."""
    stride = max(int((measured.size / ENOUGH_CELLS) ** 0.5), 1)
    pair = np.stack([image[::stride, ::stride].ravel() for image in (measured, modelled)])
    pair = pair[:, np.isfinite(pair).all(axis=0)].astype(float)
    return float(np.corrcoef(pair)[0, 1])


def _coarse_to_fine(finest, settings, history, start=None):
    """Solve on ever finer grids, each starting from the correction found on the last."""
    levels = [finest]
    known = np.inf if start is None else start.stride  # this level and coarser ones are solved
    while min(levels[-1].initial.shape) >= 2 * COARSEST and 2 * levels[-1].stride < known:
        levels.append(levels[-1].coarser())
    u, converged = levels[-1].initial, False
    if start is not None:
        correction = start.u - finest.initial
        for _ in levels[1:]:
            correction = coarse_posts(correction)
        u = u + correction
    for depth in range(len(levels) - 1, -1, -1):
        level = levels[depth]
        if depth < len(levels) - 1:
            coarse = levels.pop()
            correction = np.zeros_like(level.initial)
            prolong_add(u - coarse.initial, correction)
            if settings.estimate_exposure:
                with threads_for(correction.shape):
                    remove_plane(correction)
            u = level.initial + correction
            level.exposures, level.hazes = coarse.exposures, coarse.hazes
        if level is finest:
            level.see(u)
        steps = settings.max_steps if level is finest else min(COARSE_STEPS, level.stride)
        if level.pins is not None and start is None:  # smooth: all relief is still to be found
            steps = settings.max_steps
        u, converged = _descend(level, u, steps, settings, history)
    return u, converged


def _descend(level, u, steps, settings, history):
    """Gauss-Newton steps on one level, damped (Levenberg) where the cost would rise."""
    here, last_gain, damping, equations = level.expand(u), 0.0, 0.0, None
    knows_shadows, is_near = level.stride > 1, False
    for _ in range(steps):
        last, start, hoped = _best_cost(here, level, settings), u, None
        for _ in range(ATTEMPTS):
            stiffen(here.tensors, damping)
            if equations is None:
                equations = NormalEquations(here.tensors, level.curvature, level.masses, level.pins)
            else:
                equations.renew(here.tensors)
            linear = conjugate_gradients(
                equations,
                np.negative(here.gradient, out=here.gradient),
                settings.cycle_tolerance,
                settings.max_cycles,
                # not where albedo is free: ratios of exposures then settle slowly against long
                # waves that the kept plane shapes; a plane that is free shows them at once
                settings.estimate_exposure and not level.frees_albedo,
            )
            gain = dot(here.gradient, linear.x) / 2
            hoped = gain if hoped is None else hoped
            if level.stride == 1:
                level.slide_along_views(linear.x, start)
            step = linear.x
            if settings.estimate_exposure:
                with threads_for(step.shape):
                    remove_plane(step)
            u = start + step
            here = _look(level, u)
            cost = _best_cost(here, level, settings)
            if cost <= last * (1 + ROUNDING):
                break
            damping = more_damping(damping)
            u, here = start, _look(level, start)
            if hoped < FLOOR * abs(last):
                return start, True
        else:  # no way down: stay
            return start, False
        level.albedo = here.albedo
        if not knows_shadows and gain < SETTLED * abs(cost):  # those of the start were its own
            level.see(u)
            here, knows_shadows = level.expand(u), True
        if settings.estimate_exposure and _exposures_are_off(here, level):
            _set_photometry(level, here.sums, settings, level.frees_albedo)
            level.share_scale()
            here = level.expand(u)
        history.append(
            {
                "stride": level.stride,
                "cost": cost,
                "step_m": distance(u, start),
                "cycles": linear.iterations,
                "reduction": linear.reduction,
                "damping": damping,
            }
        )
        # gains fall by a constant factor or faster, so the next one can be told
        next_gain, last_gain = gain * (min(gain / last_gain, 1.0) if last_gain else 1.0), gain
        is_done = next_gain < settings.gain_tolerance * abs(cost)
        if damping == 0 and (is_done or _is_small(u, start, level, settings)):
            return u, True
        is_near = damping == 0 and next_gain < NEAR * abs(cost)
        damping = less_damping(damping)
    return u, is_near


def _exposures_are_off(here, level):
    """True where better exposures lower the cost by more than rounding and noise of the fit."""
    gain = _exposure_gain(here, level) + level.scale_gain()
    return gain > EXPOSURE_GAIN


def _exposure_gain(here, level):
    return exposure_gain(here.sums, level.exposures, level.hazes, level.frees_albedo)


def _is_small(u, start, level, settings):
    return distance(u, start) < settings.step_tolerance * distance(u, level.initial)


def _best_cost(here, level, settings):
    """The cost with the exposures that fit this surface best, which are closed-form."""
    if not settings.estimate_exposure:
        return here.cost
    return here.cost - _exposure_gain(here, level) / 2


def _look(level, u):
    """The quadratic around ``u``; on the finest level the images are brought along."""
    if level.stride == 1:
        level.sample_images(u)
    return level.expand(u)


def _set_photometry(level, sums, settings, keeps_scale=False):
    level.exposures, level.hazes = best_photometry(
        sums, level.exposures, level.hazes, settings.estimate_haze, keeps_scale
    )


def _fit_albedo(level, u, priors, misfits, settings):
    """Albedo of the cells, given the surface; exposures that are free keep its mean at 1."""
    level.memory.clear()
    count, noise, contrast = len(level.views), priors.noise, priors.albedo_contrast
    shows_albedo = priors.albedo_error > 0
    if shows_albedo and count > CELL_UNKNOWNS:  # then the images themselves show their noise, too
        noise = noise * np.minimum(misfits * (count / (count - CELL_UNKNOWNS)) ** 0.5, 1.0)
    images = (
        ((level.predict(u, k) - haze) / level.albedo, level.cells[k] - haze, noise[k])
        for k, haze in enumerate(level.hazes.astype(np.float32))
    )
    weight, pull = albedo_information(level.albedo.shape, images)
    if shows_albedo:
        contrast = max(contrast, observed_contrast(weight, pull))
    level.albedo = fit_albedo(weight, pull, contrast, level.albedo)
    if settings.estimate_exposure:
        level.albedo /= np.float32(level.albedo.mean(dtype=float))
        _set_photometry(level, level.assemble(u)[2], settings)


def _estimate_priors(level):
    images = range(len(level.views))
    modelled = [level.predict(level.initial, k) for k in images]
    residuals = [cells - model for cells, model in zip(level.cells, modelled, strict=True)]
    gains = [level.mean_gain(level.initial, k) for k in images]

    def respond(relief, k):
        return level.predict(level.initial + relief, k) - modelled[k]

    return estimate_priors(level.cells, residuals, gains, level.surface.grid.spacing, respond)


def _outcome(converged, history, misfits, noise, names):
    """Name and sentence of how the solve ended."""
    step = history[-1]["step_m"] if history else 0.0
    worst = int(np.argmax(misfits))
    others = np.median(np.delete(misfits, worst)) if misfits.size > 1 else misfits[worst]
    if misfits.size > 2 and misfits[worst] > max(ODD_IMAGE * others, POOR_FIT):
        return "contradiction", (
            f"{names[worst]} contradicts the other images: it is left with residuals of "
            f"{misfits[worst]:.1f} noise standard errors, the others with {others:.1f}. Check its "
            "camera, Sun position and date, or leave it out."
        )
    if others > POOR_FIT:
        return "poor_fit", (
            f"The modelled images differ from the measured ones by {others:.1f} noise standard "
            "errors: the DEM may be too far off, or cameras and Sun wrong. Do not use the result."
        )
    if noise > POOR_START:
        return "poor_start", (
            f"The initial DEM leaves {100 * noise:.0f} % of the images' brightness unexplained, so "
            "nothing could be learnt from it. Check that DEM, images and positions belong together."
        )
    if converged:
        return "converged", f"Converged: the last step moved the surface by {step:.3g} m."
    return "step_limit", (
        f"Stopped while a step still moved the surface by {step:.3g} m; raise max_steps, or check "
        "the initial DEM."
    )
