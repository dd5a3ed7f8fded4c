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

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from lommel.core.reflectance import reflectance_model
from lommel.errors import InputError
from lommel.estimate.albedo_kernels import (
    CAUCHY,
    HUBER,
    LEAST_SQUARES,
    OWN,
    SCALE_LOW,
    SCALE_STEP,
    SHARED,
    Maps,
    State,
    Sums,
    accumulate,
    empty_sums,
)
from lommel.estimate.albedo_quality import disagreement
from lommel.estimate.albedo_samples import collect_samples, overlapping_pairs
from lommel.scene.masks import MaskSettings

LOSSES = {"least-squares": LEAST_SQUARES, "huber": HUBER, "cauchy": CAUCHY}
SOLVERS = ("projection", "alternating")
PHASE_START = (1.383488, 0.501149)  # c1 per rad, c2: lunar values of the Ames photometry toolkit
SHARED_ERROR = np.array([1.0, 1.0, 3.0, 3.0])  # prior standard error of c1, c2, v2, v4: loose
SETTLING = 4  # passes after which noise scale and repetition are kept, so that the cost is one
FREE_SHARE = 4.0  # images whose scatter the overall noise counts for in the error of one post
PIN = 1e-9  # of the diagonal, added where the gauge would make the matrix singular


@dataclass(frozen=True)
class AlbedoSettings:
    """How albedo and exposures are estimated.

    Attributes
    ----------
    reflectance : str
        Name of a reflectance model.
    solver : {'projection', 'alternating'}
        Albedo eliminated, or the published iteration.
    loss : {'cauchy', 'huber', 'least-squares'}
    haze : bool
        Estimate an offset per image.
    phase_factor : (c1, c2) or None
        Multiplies the reflectance by exp(-c1 phase) + c2, phase in rad; None multiplies by 1.
    fit_phase_factor : bool
        Estimate c1 and c2, starting from ``phase_factor``.
    fit_falloff : bool
        Estimate the lens falloff, v2 and v4 about 0.
    slope_noise : float, rad, or None
        Slope error of the DEM per relative error of brightness; None weighs all pixels alike.
    albedo_contrast : float
        Expected standard deviation of the logarithm of mean albedo from image to image.
    haze_error : float
        Expected standard deviation of haze, as a share of the image's level.
    masks : MaskSettings
    max_steps : int
        Passes over the images.
    tolerance : float
        The iteration ends when the cost falls by less than this share in one step.
    """

    reflectance: str = "lunar-lambert"
    solver: str = "projection"
    loss: str = "cauchy"
    haze: bool = True
    phase_factor: tuple[float, float] | None = PHASE_START
    fit_phase_factor: bool = True
    fit_falloff: bool = True
    slope_noise: float | None = 0.5
    albedo_contrast: float = 0.1
    haze_error: float = 0.1
    masks: MaskSettings = field(default_factory=MaskSettings)
    max_steps: int = 30
    tolerance: float = 1e-5


def published_settings(**changes):
    """The albedo paper as printed: alternating updates, least squares, nothing else fitted."""
    paper = AlbedoSettings(
        reflectance="lunar-lambert-exponential",
        solver="alternating",
        loss="least-squares",
        haze=False,
        phase_factor=None,
        fit_phase_factor=False,
        fit_falloff=False,
        slope_noise=None,
        max_steps=100,
    )
    return replace(paper, **changes)


@dataclass(frozen=True, eq=False)
class AlbedoResult:
    """Albedo, exposures and how they were found.

    Attributes
    ----------
    albedo : float32 array (rows, cols), dimensionless; NaN where no image sees the ground
    albedo_error : float32 array (rows, cols)
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
    history : list of dict
    outcome, advice : str
    """

    albedo: np.ndarray
    albedo_error: np.ndarray
    orthomosaic: np.ndarray
    count: np.ndarray
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
    history: list[dict]
    outcome: str
    advice: str


@dataclass(frozen=True, eq=False)
class Problem:
    """Samples, settings and the layout of the unknowns.

    Attributes
    ----------
    samples : Samples
    pairs : Pairs
    shape : tuple of int
        Of the grid.
    settings : AlbedoSettings
    is_fitted : bool array (2 K + 5,)
        Log exposure and haze of each image, then c1, c2, v2, v4 and the mean log albedo.
    shared_start : float64 array (4,)
    """

    samples: object
    pairs: object
    shape: tuple[int, int]
    settings: AlbedoSettings
    is_fitted: np.ndarray
    shared_start: np.ndarray

    @property
    def images(self):
        """Number of images used."""
        return len(self.samples.starts)


@dataclass(eq=False)
class Point:
    """One pass: the parameters, and the sums and maps that belong to them.

    Attributes
    ----------
    state : State
    mean_log_albedo : float
    scale, repetition : float
        What the pass was weighted with.
    maps : Maps
    sums : Sums, blocks added up
    objective : float
    """

    state: State
    mean_log_albedo: float
    scale: float
    repetition: float
    maps: Maps
    sums: Sums
    objective: float


def estimate_albedo(observations, grid, heights, settings=None, progress=None):
    """Albedo, exposures and haze from images on one grid.

    Parameters
    ----------
    observations : list of Observation
    grid : Grid
    heights : array (rows, cols), m
    settings : AlbedoSettings, optional
    progress : callable, optional
        Called with (pass, objective) after each pass over the images.

    Returns
    -------
    result : AlbedoResult
    """
    settings = settings or AlbedoSettings()
    _check(settings)
    model = reflectance_model(settings.reflectance)
    samples, levels, reasons = collect_samples(
        observations, grid, heights, model, settings.masks, settings.slope_noise
    )
    if not len(levels):
        listing = [f"  {o.name}: {r}" for o, r in zip(observations, reasons, strict=True)]
        raise InputError("No image can be used.\n" + "\n".join(listing[:20]))
    problem = _pose(samples, grid.shape, settings)
    point, history, outcome, advice = _iterate(problem, levels, progress or (lambda *_: None))
    return _result(problem, point, reasons, history, outcome, advice)


def _check(settings):
    if settings.solver not in SOLVERS:
        raise InputError(
            f"solver = {settings.solver!r} is unknown. Choose one of {', '.join(SOLVERS)}."
        )
    if settings.loss not in LOSSES:
        raise InputError(f"loss = {settings.loss!r} is unknown. Choose one of {', '.join(LOSSES)}.")
    for name in ("albedo_contrast", "haze_error", "tolerance", "max_steps"):
        value = getattr(settings, name)
        if not value > 0:
            raise InputError(f"{name} = {value} is not positive. Give a number above 0.")
    threshold = settings.masks.shadow_threshold
    if threshold is not None and not threshold >= 0:
        raise InputError(
            f"shadow_threshold = {threshold} is negative. It is the image value up to which a "
            "pixel counts as shadow; give 0 or more."
        )


def _pose(samples, shape, settings):
    """Layout of the unknowns; the alternating solver knows exposure and haze only."""
    images = len(samples.starts)
    with_priors = settings.solver == "projection"
    own = np.tile([True, settings.haze], images)
    fits_phase = with_priors and settings.fit_phase_factor and settings.phase_factor is not None
    fits_falloff = with_priors and settings.fit_falloff
    shared = [fits_phase, fits_phase, fits_falloff, fits_falloff, with_priors]
    start = np.array([*(settings.phase_factor or (0.0, 0.0)), 0.0, 0.0])
    is_fitted = np.concatenate([own, shared])
    return Problem(samples, overlapping_pairs(samples.windows), shape, settings, is_fitted, start)


def _iterate(problem, levels, progress):
    """Steps until the cost stays; returns the last point, the history and the outcome."""
    settings = problem.settings
    state = State(
        levels / levels.mean(),
        np.zeros(problem.images),
        _mean_brightness(problem.samples),
        problem.shared_start,
    )
    maps = Maps(*(np.zeros(problem.shape) for _ in range(5)), np.zeros(problem.shape, np.int32))
    point = _visit(problem, state, 0.0, 1.0, 1.0, maps, LEAST_SQUARES)
    settling = (
        SETTLING if settings.loss != "least-squares" or settings.solver == "projection" else 0
    )
    damping, history = 0.0, []
    for step in range(settings.max_steps):
        scale, repetition = point.scale, point.repetition
        if step < settling:
            scale, repetition = noise_scale(point.sums.histogram), effective_repetition(point.sums)
        trial_state, mean = _step(problem, point, damping)
        trial = _visit(problem, trial_state, mean, scale, repetition, _copy(point.maps), None)
        change = (point.objective - trial.objective) / max(abs(point.objective), 1e-300)
        is_comparable = step > settling or settling == 0
        is_accepted = change >= -1e-9 or not is_comparable
        history.append(
            {"step": step + 1, "cost": trial.objective, "change": -change, "noise": scale}
        )
        progress(step + 1, trial.objective)
        if is_accepted:
            point, damping = trial, damping / 10 if damping > 1e-6 else 0.0
        else:
            damping = max(10 * damping, 1e-3)
        if is_comparable and is_accepted and change < settings.tolerance:
            return point, history, "converged", f"Converged after {step + 1} passes."
    advice = (
        f"Stopped after {settings.max_steps} passes while the cost still changed by "
        f"{100 * abs(change):.2g} % per pass; raise max_steps."
    )
    return point, history, "step_limit", advice


def _mean_brightness(samples):
    """Weighted mean of each image's used pixels, image units."""
    weight = np.add.reduceat(samples.weight.astype(float), samples.starts)
    return np.add.reduceat(samples.weight.astype(float) * samples.measured, samples.starts) / weight


def _copy(maps):
    return Maps(*(plane.copy() for plane in maps))


def _visit(problem, state, mean_log_albedo, scale, repetition, maps, loss):
    """One pass over the images; the robust weights come from the albedo in ``maps``."""
    loss = LOSSES[problem.settings.loss] if loss is None else loss
    blocks = empty_sums(problem.images, len(problem.pairs.second))
    accumulate(problem.samples, problem.pairs, state, scale, loss, maps, blocks)
    sums = Sums(*(part.sum(axis=0) for part in blocks))
    point = Point(state, mean_log_albedo, scale, repetition, maps, sums, 0.0)
    point.objective = float(sums.cost) / repetition
    if problem.settings.solver == "projection":
        residual, _, error = _priors(problem, point)
        point.objective += 0.5 * float(np.sum((residual / error) ** 2))
    return point


def noise_scale(histogram):
    """Normalised median absolute deviation, from a histogram of residual sizes.

    Parameters
    ----------
    histogram : array (SCALE_BINS,)

    Returns
    -------
    scale : float; 1 when the histogram is empty, as with one image
    """
    below = np.cumsum(histogram)
    if below[-1] == 0:
        return 1.0
    place = np.interp(0.5 * below[-1], below, np.arange(1, len(below) + 1))
    return float(1.4826 * 2.0 ** (SCALE_LOW + SCALE_STEP * place))


def effective_repetition(sums):
    r"""Pixels per independent residual, at least 1.

    Model errors are alike over patches of an image, and over the same patch of all images (where
    phase and lens are alike). The scores :math:`\psi = \rho'` of the robust loss, summed over
    patches, show it: with independent residuals the ratio is 1.

    .. math:: \varphi = \max\left(1, \frac{\sum_{k,p} (\sum \psi)^2}{\sum \psi^2},
              \frac{\sum_p (\sum_k \sum \psi)^2}{\sum \psi^2}\right)

    Parameters
    ----------
    sums : Sums

    Returns
    -------
    repetition : float
    """
    total = max(float(sums.score_square), 1e-300)
    apart = float(np.sum(sums.patches**2)) / total
    together = float(np.sum(sums.patches.sum(axis=0) ** 2)) / total
    return max(1.0, apart, together)


def _priors(problem, point):
    """Prior residuals, their Jacobian (sparse, all unknowns) and their standard errors."""
    settings, state = problem.settings, point.state
    images = problem.images
    weight, measured, modelled = point.sums.means[:, 0], *point.sums.means[:, 1:3].T
    measured = measured / weight - state.haze
    measured = np.maximum(measured, 0.01 * state.level)
    modelled = modelled / weight
    contrast = np.log(modelled) - np.log(measured) + point.mean_log_albedo
    haze = state.haze / state.level
    residual = np.concatenate([contrast, haze, state.shared - problem.shared_start])
    error = np.concatenate(
        [
            np.full(images, settings.albedo_contrast),
            np.full(images, settings.haze_error),
            SHARED_ERROR,
        ]
    )
    jacobian = np.zeros((images, SHARED + 1))
    jacobian[:, :SHARED] = point.sums.means[:, 3:] / point.sums.means[:, 2:3]
    jacobian[:, SHARED] = 1.0
    k = np.arange(images)
    last = OWN * images
    rows = [k, k, np.repeat(k, SHARED + 1), images + k, 2 * images + np.arange(SHARED)]
    cols = [OWN * k, OWN * k + 1, np.tile(last + np.arange(SHARED + 1), images), OWN * k + 1]
    cols.append(last + np.arange(SHARED))
    values = [np.ones(images), state.level / measured, jacobian.ravel(), np.ones(images + SHARED)]
    triplets = np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))
    return residual, csr_matrix(triplets, shape=(residual.size, last + SHARED + 1)), error


def normal_equations(problem, point):
    """Matrix and gradient of the objective over all unknowns, albedo eliminated.

    Parameters
    ----------
    problem : Problem
    point : Point

    Returns
    -------
    matrix : scipy.sparse.csr_matrix (2 K + 5, 2 K + 5)
    gradient : float64 array (2 K + 5,)
    """
    sums, images = point.sums, problem.images
    last = OWN * images
    size = last + SHARED + 1
    entries = []

    def put(row, col, value):
        entries.append([np.broadcast_to(part, value.shape).ravel() for part in (row, col, value)])

    k, p = np.arange(images)[:, None, None], np.arange(OWN)
    own = sums.own + np.triu(sums.own, 1).transpose(0, 2, 1)
    put(OWN * k + p[:, None], OWN * k + p, own)
    i = np.repeat(np.arange(images), np.diff(problem.pairs.first))[:, None, None]
    j = problem.pairs.second[:, None, None]
    put(OWN * i + p[:, None], OWN * j + p, -sums.pairs)
    others = (i != j)[:, 0, 0]
    put(
        (OWN * j + p[:, None])[others],
        (OWN * i + p)[others],
        -sums.pairs[others].transpose(0, 2, 1),
    )
    g = last + np.arange(SHARED)
    put(OWN * k + p[:, None], g, sums.border)
    put(g, OWN * k + p[:, None], sums.border)
    put(g[:, None], g, sums.square + np.triu(sums.square, 1).T)
    rows, cols, values = (np.concatenate(part) for part in zip(*entries, strict=True))
    factor = 1.0 / (point.scale**2 * point.repetition)
    matrix = coo_matrix((factor * values, (rows, cols)), shape=(size, size)).tocsr()
    gradient = np.zeros(size)
    gradient[:last] = factor * sums.gradient.ravel()
    gradient[g] = factor * sums.shared_gradient
    if problem.settings.solver == "projection":
        residual, jacobian, error = _priors(problem, point)
        scaled = jacobian.multiply(1.0 / error[:, None] ** 2).tocsr()
        matrix, gradient = matrix + jacobian.T @ scaled, gradient + scaled.T @ residual
    return matrix, gradient


def _step(problem, point, damping):
    """The next state and mean log albedo."""
    change = np.zeros(problem.is_fitted.size)
    if problem.settings.solver == "alternating":
        change[: OWN * problem.images] = _published_step(problem, point)
    else:
        matrix, gradient = normal_equations(problem, point)
        fitted = np.flatnonzero(problem.is_fitted)
        matrix = matrix[fitted][:, fitted].tocsc()
        matrix.setdiag(matrix.diagonal() * (1.0 + damping + PIN))
        change[fitted] = -splu(matrix).solve(gradient[fitted])
    own = change[: OWN * problem.images].reshape(-1, OWN)
    state = point.state
    exposure = state.exposure * np.exp(np.clip(own[:, 0], -1.0, 1.0))
    if problem.settings.solver == "alternating":  # step 3 is linear in T
        exposure = state.exposure * (1.0 + own[:, 0])
    moved = State(
        exposure,
        state.haze + state.level * own[:, 1],
        state.level,
        state.shared + change[-SHARED - 1 : -1],
    )
    return moved, point.mean_log_albedo + change[-1]


def _published_step(problem, point):
    """Step 3 of the albedo paper, for exposure and, on request, haze: albedo held fixed."""
    own, gradient = point.sums.own, point.sums.gradient
    change = np.zeros_like(gradient)
    if problem.settings.haze:
        square = own + np.triu(own, 1).transpose(0, 2, 1)
        change = -np.linalg.solve(square, gradient[..., None])[..., 0]
    else:
        change[:, 0] = -gradient[:, 0] / own[:, 0, 0]
    return change.ravel()


def _result(problem, point, reasons, history, outcome, advice):
    """Bring the gauge to mean exposure 1, and collect."""
    used = np.array([not reason for reason in reasons])
    point.scale, point.repetition = (
        noise_scale(point.sums.histogram),
        effective_repetition(point.sums),
    )
    state, maps = point.state, point.maps
    gauge = state.exposure.mean()
    errors = _standard_errors(problem, point)
    own = errors[: OWN * problem.images].reshape(-1, OWN)

    def per_image(values):
        everyone = np.full(len(reasons), np.nan)
        everyone[used] = values
        return everyone

    seen = maps.count > 0
    groups = _groups(problem, point)
    indices = np.flatnonzero(used)
    return AlbedoResult(
        albedo=np.where(seen, gauge * maps.albedo, np.nan).astype(np.float32),
        albedo_error=np.where(seen, gauge * _albedo_error(point), np.nan).astype(np.float32),
        orthomosaic=orthomosaic(problem.samples, problem.shape),
        count=maps.count,
        exposures=per_image(state.exposure / gauge),
        exposure_errors=per_image(state.exposure / gauge * own[:, 0]),
        hazes=per_image(state.haze),
        haze_errors=per_image(state.level * own[:, 1]),
        reasons=tuple(reasons),
        shared=state.shared,
        shared_errors=np.where(
            problem.is_fitted[-SHARED - 1 : -1], errors[-SHARED - 1 : -1], np.nan
        ),
        groups=tuple(tuple(indices[group].tolist()) for group in groups),
        disagreement_before=disagreement(problem.samples, problem.shape),
        disagreement=disagreement(
            problem.samples, problem.shape, state.exposure, state.haze, state.shared
        ),
        noise=point.scale,
        repetition=point.repetition,
        history=history,
        outcome=outcome,
        advice=advice + _remarks(problem, groups),
    )


def _remarks(problem, groups):
    """What the user should know about the gauge."""
    if problem.images == 1:
        return " One image only: its exposure is 1 by definition, nothing checks the albedo."
    if len(groups) > 1:
        return (
            f" The images form {len(groups)} groups without overlap; the brightness of one against "
            "the other rests on albedo_contrast alone."
        )
    return ""


def _groups(problem, point):
    """Images connected by pixels that both see, as arrays of indices."""
    i = np.repeat(np.arange(problem.images), np.diff(problem.pairs.first))
    links = (point.sums.shared_pixels, (i, problem.pairs.second))
    graph = coo_matrix(links, shape=(problem.images,) * 2).tocsr()
    graph.eliminate_zeros()
    count, label = connected_components(graph, directed=False)
    return [np.flatnonzero(label == group) for group in range(count)]


def _albedo_error(point):
    r"""Standard error of the albedo of each post.

    .. math:: \sigma_A^2 = \frac{\nu s^2 + \sum_k w r^2}{\nu + f} \;
              \frac{\sum_k w^2 M^2 / \pi}{(\sum_k w M^2)^2}

    with precision :math:`\pi`, the residuals r of the f free images of the post, and the overall
    noise s counting for :math:`\nu = 4` images more, so that a post seen once has an error too.
    """
    maps = point.maps
    variance = (FREE_SHARE * point.scale**2 + maps.scatter) / (FREE_SHARE + maps.freedom)
    information = np.maximum(maps.information, 1e-300)
    return np.sqrt(variance * maps.spread) / information


def _standard_errors(problem, point):
    """Standard errors of all unknowns with the mean log exposure held; 0 where not fitted."""
    matrix, _ = normal_equations(problem, point)
    fitted = np.flatnonzero(problem.is_fitted)
    matrix = matrix[fitted][:, fitted].tocsc()
    matrix.setdiag(matrix.diagonal() * (1.0 + PIN))
    factors = splu(matrix)
    # Projected onto mean log exposure 0: P C P^T with P = 1 - (mean over log exposures)
    is_exposure = (fitted < OWN * problem.images) & (fitted % OWN == 0)
    unit_mean = is_exposure / problem.images
    total = factors.solve(unit_mean)
    mean_variance = float(unit_mean @ total)
    variance = np.empty(fitted.size)
    for first in range(0, fitted.size, 256):
        part = np.arange(first, min(first + 256, fitted.size))
        unit_vectors = np.zeros((fitted.size, part.size))
        unit_vectors[part, part - first] = 1.0
        variance[part] = factors.solve(unit_vectors)[part, part - first]
    variance -= np.where(is_exposure, 2 * total - mean_variance, 0.0)
    errors = np.zeros(problem.is_fitted.size)
    errors[fitted] = np.sqrt(np.maximum(variance, 0.0))
    return errors


def orthomosaic(samples, shape):
    """Weighted mean of the images as they are, for comparison with the albedo.

    Parameters
    ----------
    samples : Samples
    shape : tuple of int

    Returns
    -------
    mosaic : float32 array (rows, cols), image units; NaN where no image is
    """
    total, weights = np.zeros(shape), np.zeros(shape)
    for (row, col, rows, cols), start in zip(samples.windows, samples.starts, strict=True):
        here = slice(row, row + rows), slice(col, col + cols)
        part = slice(start, start + rows * cols)
        weight = samples.weight[part].reshape(rows, cols)
        total[here] += weight * samples.measured[part].reshape(rows, cols)
        weights[here] += weight
    mosaic = np.full(shape, np.nan, np.float32)
    np.divide(total, weights, out=mosaic, where=weights > 0, casting="same_kind")
    return mosaic
