r"""Shape from shading: the surface whose images under the known light are the measured ones.

Minimises, by Gauss-Newton from coarse to fine grids,

.. math:: Q(u) = \frac12 \sum_k \sum_{cells}
          \rho\!\left(\frac{T^k A R^k(u) + b^k - I^k}{\sigma^k}\right)
          + \frac12 \sum \left(\frac{\Delta^2 u}{s\,\sigma_c}\right)^2
          + \frac12 \sum_{coarse} \left(\frac{S (u - u_0)}{\sigma_0}\right)^2

The data term is that of the photoclinometry paper (its equation 1) over both of its
parametrisations (`lommel.estimate.surface`). The second term expects terrain whose slope changes
by :math:`\sigma_c` per post; the third holds the wavelengths that the initial DEM knows, with `S`
the repeated restriction to posts as far apart as that DEM can be trusted. One pass over the images
leaves one 2x2 tensor per cell (`lommel.estimate.shading_kernels`); the linear solve
(`lommel.core.multigrid`) never sees an image. Most callers want `solve_surface`.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from lommel.core.least_squares import Solution
from lommel.core.multigrid import (
    NormalEquations,
    add_long_waves,
    coarse_masses,
    conjugate_gradients,
    dot,
    threads_for,
)
from lommel.core.normal_operator import (
    apply_operator,
    coarse_shape,
    prolong_add,
    restrict,
    slope_adjoint,
)
from lommel.estimate.albedo_field import fit_albedo
from lommel.estimate.priors import Priors, estimate_priors
from lommel.estimate.shading_kernels import (
    SUM_COST,
    SUM_FF,
    SUM_FM,
    assemble,
    predict,
    sample_cells,
)

COARSEST = 24  # posts along the shorter side of the coarsest level that sees the images
COARSE_STEPS = 2  # Gauss-Newton steps per coarse level
SLOPE_STEP = 0.01  # for the change of brightness with slope: R bends little over half a degree
HOLD = 100.0  # how much stiffer known heights are held than the plate that closes holes
FILL_REDUCTION, FILL_CYCLES = 1e-3, 60
HUBER_SCALE = 3.0  # noise standard errors from which a residual counts as an outlier


@dataclass(frozen=True)
class SolverSettings:
    """When to stop and what to estimate along.

    Attributes
    ----------
    max_steps : int
        Gauss-Newton steps on the finest grid.
    step_tolerance : float, m
        Root mean square step that counts as converged.
    cycle_tolerance : float
        Reduction of the linear residual per Gauss-Newton step.
    max_cycles : int
        V-cycles per Gauss-Newton step.
    estimate_exposure : bool
        Re-estimate the exposures after each step.
    estimate_albedo : bool
        Give albedo what the images show beyond shading; otherwise it stays 1, or as given.
    """

    max_steps: int = 8
    step_tolerance: float = 0.01
    cycle_tolerance: float = 0.03
    max_cycles: int = 40
    estimate_exposure: bool = True
    estimate_albedo: bool = True


@dataclass
class Problem:
    """One level of the coarse-to-fine hierarchy."""

    surface: object
    model: object
    views: list
    exposures: np.ndarray
    hazes: np.ndarray
    weights: np.ndarray
    stride: int
    initial: np.ndarray
    cells: list
    albedo: np.ndarray
    curvature: np.ndarray
    masses: np.ndarray
    slope: np.ndarray
    expected: np.ndarray
    geometry: list = field(default_factory=list)

    def prepare_geometry(self, u):
        """Compute the lattice planes for the surface ``u``."""
        distance = min(
            np.linalg.norm(view.position) - self.surface.grid.body.radius for view in self.views
        )
        lattice = self.surface.lattice(u.shape, self.stride, distance)
        at_nodes = lattice_heights(u, lattice)
        frame = self.surface.frame(lattice, at_nodes)
        gram = frame.gram.astype(np.float32)
        lights = [light_planes(frame, view, self.model) for view in self.views]
        self.geometry = [lattice, at_nodes, frame, gram, lights]

    def assemble(self, u):
        """Tensors, gradient and cost at ``u``, data only."""
        lattice, _, _, gram, lights = self.geometry
        rows, cols = u.shape
        tensors = np.zeros((3, rows - 1, cols - 1), np.float32)
        tensors[0], tensors[2] = self.slope
        gradient = np.zeros((2, rows - 1, cols - 1), np.float32)
        spacing = np.array(self.surface.grid.spacing, np.float32) * self.stride
        parameters = self.model.parameter_array()
        sums = np.zeros((len(self.views), 8))
        for k, light in enumerate(lights):
            scale = self.weights[k]
            image = np.array(
                [self.exposures[k], self.hazes[k], scale * self.stride**2, scale / HUBER_SCALE**2],
                np.float32,
            )
            with threads_for(u.shape):
                sums[k] = assemble(
                    u,
                    gram,
                    light,
                    lattice.step,
                    spacing,
                    self.model.kind,
                    parameters,
                    self.albedo,
                    self.cells[k],
                    image,
                    tensors,
                    gradient,
                )
        return tensors, gradient, sums

    def predict(self, u, k):
        """Modelled image ``k`` on the cells."""
        lattice, _, _, gram, lights = self.geometry
        out = np.empty((u.shape[0] - 1, u.shape[1] - 1), np.float32)
        spacing = np.array(self.surface.grid.spacing, np.float32) * self.stride
        image = np.array([self.exposures[k], self.hazes[k]], np.float32)
        with threads_for(u.shape):
            predict(
                u,
                gram,
                lights[k],
                lattice.step,
                spacing,
                self.model.kind,
                self.model.parameter_array(),
                self.albedo,
                image,
                out,
            )
        return out

    def mean_gain(self, u, k):
        """Mean change of image ``k`` with the slopes along columns and rows, image units."""
        flat = np.zeros_like(u)
        tilt = np.float32(SLOPE_STEP)
        centre = self.predict(flat, k)
        gains = []
        for axis, spacing in ((1, self.surface.grid.spacing[1]), (0, self.surface.grid.spacing[0])):
            shape = [1, 1]
            shape[axis] = u.shape[axis]
            ramp = tilt * np.float32(spacing) * np.arange(u.shape[axis], dtype=np.float32)
            change = self.predict(np.ascontiguousarray(flat + ramp.reshape(shape)), k) - centre
            gains.append(float(change.mean() / tilt))
        return gains

    def expect(self, priors):
        """Take over priors: weights of every term, and the surface expected before the images."""
        s_row, s_col = self.surface.grid.spacing
        mean = (s_row * s_col) ** 0.5
        self.weights = np.asarray(priors.noise, float) ** -2.0
        curvature = np.array([1 / s_col**2, 2 / mean**2, 1 / s_row**2]) / priors.roughness**2
        brightness = np.array([np.nanmean(cells) for cells in self.cells])
        blur = (priors.albedo_contrast * np.median(brightness / priors.noise)) ** 2
        self.curvature = curvature.astype(np.float32)
        self.slope = (blur * curvature[[0, 2]]).astype(np.float32)
        self.masses = np.asarray(priors.dem_errors, float) ** -2.0
        self.expected = gaussian_filter(self.initial, priors.smoothing, mode="nearest")

    def prior_gradient(self, u):
        """Gradient of the prior terms at ``u``, and their cost."""
        rows, cols = u.shape
        change = u - self.expected
        along, across = (np.full((rows - 1, cols - 1), weight) for weight in self.slope)
        none = np.zeros_like(along)
        massless = np.zeros((1, cols), np.float32)
        out = np.empty_like(u)
        with threads_for(u.shape):
            apply_operator(
                change, along, none, across, self.curvature, np.float32(0), massless, out
            )
        cost = dot(change, out) / 2
        cost += add_long_waves(change, self.masses, out) / 2
        return out, cost


@dataclass(frozen=True)
class SurfaceSolution:
    """The refined surface.

    Attributes
    ----------
    u : float32 array (rows, cols), m
        Unknowns of the surface at the posts.
    albedo : float32 array (rows - 1, cols - 1), mean 1
    exposures, hazes : array (images,)
    measured : list of float32 array (rows - 1, cols - 1), image units
        Images on the cells of the refined surface; NaN where not used.
    modelled, started : list of float32 array (rows - 1, cols - 1), image units
        What the refined and the initial surface predict there.
    priors : Priors
        As estimated or given.
    """

    u: np.ndarray
    albedo: np.ndarray
    exposures: np.ndarray
    hazes: np.ndarray
    measured: list
    modelled: list
    started: list
    priors: Priors


def light_planes(frame, view, model):
    """Light and view along the normal's vectors, phase share and factor, at the nodes.

    Parameters
    ----------
    frame : Frame
    view : OrthoView or CameraView
    model : ReflectanceModel

    Returns
    -------
    planes : float32 array (8, node_rows, node_cols)
    """
    to_sun = view.sun_position - frame.xyz
    to_sun /= np.linalg.norm(to_sun, axis=-1, keepdims=True)
    to_camera = view.position - frame.xyz
    to_camera /= np.linalg.norm(to_camera, axis=-1, keepdims=True)
    phase = np.arccos(np.clip(np.einsum("...i,...i", to_sun, to_camera), -1, 1))
    share, factor = model.phase_terms(phase)
    planes = [np.einsum("...i,...i", frame.c[k], to_sun) for k in range(3)]
    planes += [np.einsum("...i,...i", frame.c[k], to_camera) for k in range(3)]
    return np.stack([*planes, share, factor]).astype(np.float32)


def lattice_heights(u, lattice):
    """Values of a post array at the nodes of a lattice, averaged over a cell of the lattice."""
    half = max(lattice.step // 2, 0)
    row = np.minimum((lattice.row[:, 0] / lattice.stride).astype(int), u.shape[0] - 1)
    col = np.minimum((lattice.col[0] / lattice.stride).astype(int), u.shape[1] - 1)
    total = np.zeros((row.size, col.size))
    offsets = sorted({-half, 0, half})
    for dr in offsets:
        for dc in offsets:
            rows = np.clip(row + dr, 0, u.shape[0] - 1)
            cols = np.clip(col + dc, 0, u.shape[1] - 1)
            total += u[rows[:, None], cols[None, :]]
    return total / len(offsets) ** 2


def coarse_cells(cells):
    """Mean of 2x2 cells; NaN where one is missing or beyond the border."""
    rows, cols = cells.shape
    out = np.full(((rows + 1) // 2, (cols + 1) // 2), np.nan, np.float32)
    even = cells[: rows // 2 * 2, : cols // 2 * 2]
    out[: rows // 2, : cols // 2] = 0.25 * (
        even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]
    )
    return out


def coarse_posts(posts):
    """Weighted mean around every second post."""
    total = np.zeros(coarse_shape(posts.shape), np.float32)
    weight = np.zeros_like(total)
    restrict(np.ascontiguousarray(posts), total)
    restrict(np.ones_like(posts), weight)
    return total / weight


def solve_surface(surface, initial, views, model, priors=None, settings=None, albedo=None):
    """Refine a surface by the shading in images.

    Parameters
    ----------
    surface : Surface
    initial : float32 array (rows, cols), m
        Unknowns of the initial DEM at the posts; no holes.
    views : list of OrthoView or CameraView
    model : ReflectanceModel
    priors : Priors, optional
        Estimated from images and initial DEM by default.
    settings : SolverSettings, optional
    albedo : float32 array (rows - 1, cols - 1), optional
        Known albedo on the cells; 1 by default.

    Returns
    -------
    solution : Solution
        Its value is a `SurfaceSolution`.
    """
    settings = settings or SolverSettings()
    finest = fresh_problem(surface, initial, views, model, albedo)
    finest.prepare_geometry(finest.initial)
    _sample_images(finest, finest.initial)
    _fit_exposures(finest)
    if priors is None:
        priors = _estimate_priors(finest)
    finest.expect(priors)
    started = [finest.predict(finest.initial, k) for k in range(len(views))]
    levels = [finest]
    while min(levels[-1].initial.shape) >= 2 * COARSEST:
        levels.append(_coarser(levels[-1]))
    history, correction, exposures = [], None, finest.exposures.copy()
    for level in reversed(levels):
        u = level.initial.copy()
        level.exposures[:] = exposures
        if correction is not None:
            prolong_add(correction, u)
        if level is finest:
            level.prepare_geometry(u)
            _sample_images(level, u)
        steps = settings.max_steps if level is finest else COARSE_STEPS
        u, converged = _descend(level, u, steps, settings, history)
        correction, exposures = u - level.initial, level.exposures.copy()
    outcome, advice = _outcome(converged, history)
    if settings.estimate_albedo:
        _fit_albedo(finest, u, priors)
    modelled = [finest.predict(u, k) for k in range(len(views))]
    value = SurfaceSolution(
        u, finest.albedo, finest.exposures, finest.hazes, finest.cells, modelled, started, priors
    )
    return Solution(value, outcome, advice, history)


def _descend(level, u, steps, settings, history):
    """Gauss-Newton steps on one level."""
    is_finest = level.stride == 1
    converged = False
    tensors, gradient, sums = level.assemble(u)
    prior, prior_cost = level.prior_gradient(u)
    cost = sums[:, SUM_COST].sum() / 2 + prior_cost
    for _ in range(steps):
        right = np.empty_like(u)
        with threads_for(u.shape):
            slope_adjoint(gradient[0], gradient[1], right)
        right = -(right + prior)
        equations = NormalEquations(tuple(tensors), level.curvature, level.masses)
        linear = conjugate_gradients(
            equations, right, settings.cycle_tolerance, settings.max_cycles
        )
        length, last = 1.0, cost
        while True:
            trial = u + np.float32(length) * linear.x
            if is_finest:
                _sample_images(level, trial)
            tensors, gradient, sums = level.assemble(trial)
            prior, prior_cost = level.prior_gradient(trial)
            cost = sums[:, SUM_COST].sum() / 2 + prior_cost
            if cost <= last or length < 0.1:
                break
            length /= 2
        u = trial
        step = float(length * np.sqrt(dot(linear.x, linear.x) / linear.x.size))
        history.append(
            {
                "stride": level.stride,
                "cost": float(cost),
                "step_m": step,
                "cycles": linear.iterations,
                "reduction": linear.reduction,
                "length": length,
            }
        )
        if settings.estimate_exposure:
            level.exposures[:] = _best_exposures(sums, level.exposures)
            tensors, gradient, sums = level.assemble(u)
            cost = sums[:, SUM_COST].sum() / 2 + prior_cost
        if step < settings.step_tolerance:
            converged = True
            break
    return u, converged


def _best_exposures(sums, exposures):
    has_data = sums[:, SUM_FF] > 0
    return np.where(has_data, sums[:, SUM_FM] / np.where(has_data, sums[:, SUM_FF], 1), exposures)


def fresh_problem(surface, initial, views, model, albedo):
    """The finest level before images are sampled and priors known; see `solve_surface`."""
    rows, cols = initial.shape
    count = len(views)
    if albedo is None:
        albedo = np.ones((rows - 1, cols - 1), np.float32)
    return Problem(
        surface,
        model,
        views,
        np.ones(count),
        np.zeros(count),
        np.ones(count),
        1,
        np.ascontiguousarray(initial, np.float32),
        [np.empty((rows - 1, cols - 1), np.float32) for _ in views],
        albedo,
        curvature=np.zeros(3, np.float32),
        masses=np.zeros(1),
        slope=np.zeros(2, np.float32),
        expected=initial,
    )


def _coarser(finer):
    coarse = replace(
        finer,
        exposures=finer.exposures.copy(),
        stride=2 * finer.stride,
        initial=coarse_posts(finer.initial),
        expected=coarse_posts(finer.expected),
        cells=[coarse_cells(cells) for cells in finer.cells],
        albedo=np.nan_to_num(coarse_cells(finer.albedo), nan=1.0),
        curvature=finer.curvature / 4,
        masses=coarse_masses(finer.masses, 1),
    )
    coarse.prepare_geometry(coarse.initial)
    return coarse


def _sample_images(level, u):
    lattice, at_nodes, frame, _, _ = level.geometry
    reference = level.initial
    for view, cells in zip(level.views, level.cells, strict=True):
        planes = view.coordinates(level.surface, lattice, frame, at_nodes)
        is_ortho = hasattr(view, "observation")
        surface_of_image = reference if is_ortho else np.zeros((1, 1), np.float32)
        with threads_for(u.shape):
            sample_cells(view.image, planes, lattice.step, u, surface_of_image, cells)


def _fit_exposures(level):
    """Exposures that match the initial surface."""
    _, _, sums = level.assemble(level.initial)
    level.exposures[:] = _best_exposures(sums, level.exposures)


def _fit_albedo(level, u, priors):
    """Albedo of the cells, given the surface; the exposures keep its mean at 1."""
    shading = [level.predict(u, k) / level.albedo for k in range(len(level.views))]
    level.albedo = fit_albedo(
        shading, level.cells, priors.noise, priors.albedo_contrast, level.albedo
    )
    _, _, sums = level.assemble(u)
    level.exposures[:] = _best_exposures(sums, level.exposures)


def _estimate_priors(level):
    images = range(len(level.views))
    modelled = [level.predict(level.initial, k) for k in images]
    residuals = [cells - model for cells, model in zip(level.cells, modelled, strict=True)]
    gains = [level.mean_gain(level.initial, k) for k in images]

    def respond(relief, k):
        return level.predict(level.initial + relief, k) - modelled[k]

    return estimate_priors(level.cells, residuals, gains, level.surface.grid.spacing, respond)


def fill_holes(heights):
    """Heights whose holes are closed by the thin plate through their surroundings.

    Parameters
    ----------
    heights : float32 array (rows, cols), m; NaN in holes

    Returns
    -------
    heights : float32 array (rows, cols), m
    """
    known = np.isfinite(heights)
    if known.all():
        return heights
    start = _pull_push(heights)
    rows, cols = heights.shape
    none = np.zeros((rows - 1, cols - 1), np.float32)
    plate = np.array([1.0, 2.0, 1.0], np.float32)
    posts = np.where(known, np.float32(HOLD), np.float32(0))
    bending = np.empty_like(start)
    with threads_for(start.shape):
        massless = np.zeros((1, cols), np.float32)
        apply_operator(start, none, none, none, plate, np.float32(0), massless, bending)
    equations = NormalEquations((none, none, none), plate, [0.0], posts)
    change = conjugate_gradients(equations, -bending, FILL_REDUCTION, FILL_CYCLES).x
    return np.where(known, heights, start + change)


def _pull_push(heights):
    """Holes filled with means of known posts around, from coarse grids."""
    known = np.isfinite(heights)
    if known.all():
        return heights
    if min(heights.shape) <= 2:
        return np.where(known, heights, np.nanmean(heights)).astype(np.float32)
    total = np.zeros(coarse_shape(heights.shape), np.float32)
    weight = np.zeros_like(total)
    restrict(np.where(known, heights, np.float32(0)).astype(np.float32), total)
    restrict(known.astype(np.float32), weight)
    missing = weight == 0
    coarse = _pull_push(np.where(missing, np.nan, total / np.where(missing, 1, weight)))
    filled = np.zeros_like(heights)
    prolong_add(coarse.astype(np.float32), filled)
    return np.where(known, heights, filled)


def _outcome(converged, history):
    last = history[-1]
    if converged:
        return "converged", f"Converged: the last step moved the surface by {last['step_m']:.3g} m."
    return "step_limit", (
        f"Stopped while a step still moved the surface by {last['step_m']:.3g} m; "
        "raise max_steps, or check the initial DEM."
    )
