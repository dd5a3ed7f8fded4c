r"""Heights, albedo and photometry as the unknowns of one Gauss-Newton step.

Where single measured posts hold the surface, what an image shows between them is partly relief and
partly albedo, and each explains long waves nearly as well as the other. Solving for one and then
for the other takes hundreds of rounds there, and stops early at the wrong place. Here all are
unknowns of one linear system,

.. math:: \begin{pmatrix} A & C & c_T \\ C^T & P & d_T \\ c_T^T & d_T^T & E \end{pmatrix}
          \begin{pmatrix} \delta u \\ \delta a \\ \delta(T, b) \end{pmatrix} = -g

with `A` the normal operator of the heights (`lommel.core.multigrid`), `P` that of the albedo
(`lommel.estimate.albedo_field`), each with its own V-cycle as preconditioner, and `C` what the
images leave to tie them, cell by cell. The few exposures and hazes are eliminated by one more solve
each. Haze is not negative: relief that is too flat under too high an exposure fits as well and
costs the prior less, which nothing but this bound stops. Most callers want `solve_jointly`.
"""

from dataclasses import dataclass

import numpy as np

from lommel.core.least_squares import ATTEMPTS, ROUNDING, less_damping, more_damping, stiffen
from lommel.core.multigrid import NormalEquations, conjugate_gradients, dot, threads_for
from lommel.core.normal_operator import add_slopes, slope_adjoint
from lommel.estimate.albedo_field import (
    albedo_stiffness,
    smoothness_cost,
    smoothness_equations,
)
from lommel.estimate.problem import HAZE_ERROR
from lommel.estimate.shading_kernels import SUM_F, SUM_FF, SUM_FM, SUM_M, SUM_W

# Long waves, in which albedo and heights are hard to tell apart, need a tight solve
REDUCTION, MAX_CYCLES = 0.01, 100
STEPS = 10  # Gauss-Newton steps at most


class JointEquations:
    """Normal equations of heights and albedo, for `lommel.core.multigrid.conjugate_gradients`.

    Both stand in one array (2 rows, cols): above the posts, below the cells, with a row and a
    column more that nothing measures.

    Parameters
    ----------
    heights, albedo : NormalEquations
        Each for (rows, cols) unknowns.
    by_p, by_q : float32 array (rows - 1, cols - 1)
        What ties a cell's albedo to the two differences of its posts.
    """

    def __init__(self, heights, albedo, by_p, by_q):
        self.heights, self.albedo, self.by_p, self.by_q = heights, albedo, by_p, by_q
        self.rows, cols = heights.shape
        self.shape = 2 * self.rows, cols
        *self.vectors, self._preconditioned = (np.empty(self.shape, np.float32) for _ in range(5))
        self._pull = np.empty(heights.shape, np.float32)

    def apply(self, x, out):
        """``out = A x``."""
        u, a = x[: self.rows], x[self.rows :]
        self.heights.apply(u, out[: self.rows])
        self.albedo.apply(a, out[self.rows :])
        with threads_for(self.shape):
            slope_adjoint(self.by_p * a[:-1, :-1], self.by_q * a[:-1, :-1], self._pull)
            add_slopes(self.by_p, self.by_q, u, out[self.rows : -1, :-1])
        out[: self.rows] += self._pull

    def precondition(self, right_hand_side):
        """One V-cycle for each; a work array, overwritten by the next call."""
        out = self._preconditioned
        out[: self.rows] = self.heights.precondition(right_hand_side[: self.rows])
        out[self.rows :] = self.albedo.precondition(right_hand_side[self.rows :])
        return out


@dataclass
class _State:
    """A surface with its albedo (rows, cols) and photometry, and the cost there."""

    u: np.ndarray
    albedo: np.ndarray
    exposures: np.ndarray
    hazes: np.ndarray
    cost: float = np.inf


def solve_jointly(level, u, contrast, settings, history):
    """Gauss-Newton steps in heights, albedo, exposures and hazes together.

    Parameters
    ----------
    level : Problem
        The finest; gets albedo, exposures and hazes.
    u : float32 array (rows, cols), m
        Start.
    contrast : float, dimensionless
        Expected difference of the albedos of neighbouring cells.
    settings : SolverSettings
        What is estimated, and when to stop.
    history : list of dict
        Gets one entry per step.

    Returns
    -------
    u : float32 array (rows, cols), m
    converged : bool
    """
    level.couples_albedo = True
    state = _State(u, np.pad(level.albedo, (0, 1), "edge"), level.exposures, level.hazes)
    here = _look(level, state, contrast, settings)
    damping, converged = 0.0, False
    for _ in range(STEPS):
        for _ in range(ATTEMPTS):
            change, photometry, cycles = _step(level, here, state, contrast, settings, damping)
            tried = _State(
                state.u + change[: u.shape[0]],
                state.albedo + change[u.shape[0] :],
                state.exposures + photometry[0],
                state.hazes + photometry[1],
            )
            there = _look(level, tried, contrast, settings)
            if tried.cost <= state.cost * (1 + ROUNDING):
                break
            damping = more_damping(damping)
            here = _look(level, state, contrast, settings)
        else:  # no way down: stay
            break
        gain, moved = state.cost - tried.cost, tried.u - state.u
        state, here = tried, there
        history.append(
            {
                "stride": level.stride,
                "cost": state.cost,
                "step_m": float(np.sqrt(dot(moved, moved) / moved.size)),
                "cycles": cycles,
                "reduction": REDUCTION,
                "damping": damping,
            }
        )
        if damping == 0 and gain < settings.gain_tolerance * state.cost:
            converged = True
            break
        damping = less_damping(damping)
    level.couples_albedo = False
    if settings.estimate_exposure:
        mean = level.albedo.mean(dtype=float)
        level.albedo /= np.float32(mean)
        level.exposures = level.exposures * mean
    return state.u, converged


def _look(level, state, contrast, settings):
    """The quadratic around a state, whose cost is filled in."""
    level.albedo = np.ascontiguousarray(state.albedo[:-1, :-1])
    level.exposures, level.hazes = state.exposures, state.hazes
    level.sample_images(state.u)
    here = level.expand(state.u)
    state.cost = here.cost + smoothness_cost(state.albedo, contrast)
    if settings.estimate_haze:
        state.cost += float((_haze_pull(here.sums) * state.hazes**2).sum()) / 2
    return here


def _haze_pull(sums):
    """Inverse squared standard error with which each haze is expected to be 0."""
    weight, brightness = sums[:, SUM_W], sums[:, SUM_M]
    mean = brightness / np.where(weight > 0, weight, 1)
    return np.where(mean > 0, HAZE_ERROR * mean, np.inf) ** -2.0


def _step(level, here, state, contrast, settings, damping):
    """Change of heights and albedo, those of exposures and hazes, and V-cycles taken."""
    rows = state.u.shape[0]
    by_p, by_q, weight, gradient = level.coupling
    columns, bending, slope, places = _photometry(level, here.sums, state, settings)
    lowest = np.array([-state.hazes[k] if kind else -np.inf for kind, k in places])
    stiffen(here.tensors, damping)
    heights = NormalEquations(here.tensors, level.curvature, level.masses, level.pins)
    albedo = smoothness_equations(
        albedo_stiffness(state.albedo, contrast), contrast, np.pad(weight, (0, 1))
    )
    equations = JointEquations(heights, albedo, by_p, by_q)
    g = np.empty(equations.shape, np.float32)
    g[:rows] = here.gradient
    # the weight that the cells' own values add to the operator is in their gradient already
    albedo.apply(state.albedo, g[rows:])
    g[rows:-1, :-1] += gradient - weight * state.albedo[:-1, :-1]
    linear = conjugate_gradients(equations, -g, REDUCTION, MAX_CYCLES)
    change, cycles = linear.x.copy(), linear.iterations
    photometry = np.zeros((2, len(level.views)))
    if places:
        answers = []
        for column in columns:
            linear = conjugate_gradients(equations, column, REDUCTION, MAX_CYCLES)
            answers.append(linear.x.copy())
            cycles += linear.iterations
        schur = bending - np.array([[dot(c, x) for x in answers] for c in columns])
        best = _bounded(schur, -slope - [dot(c, change) for c in columns], lowest)
        for place, value, answer in zip(places, best, answers, strict=True):
            photometry[place] = value
            change -= np.float32(value) * answer
    return change, photometry, cycles


def _bounded(matrix, right_hand_side, lowest):
    """Solve for the unknowns that do not fall below their bounds; the others stay on them."""
    x, free = np.maximum(lowest, 0), np.ones(lowest.size, bool)
    while free.any():
        rest = right_hand_side[free] - matrix[np.ix_(free, ~free)] @ x[~free]
        x[free] = np.linalg.solve(matrix[np.ix_(free, free)], rest)
        below = free & (x < lowest)
        if not below.any():
            break
        x[below], free = lowest[below], free & ~below
    return x


def _photometry(level, sums, state, settings):
    """What ties free exposures and hazes to heights and albedo, and to each other.

    The first exposure is not free: the albedo's mean does the same.

    Returns
    -------
    columns : list of float32 array (2 rows, cols)
    bending : array (free, free)
        Second derivatives of the cost.
    slope : array (free,)
        Its gradient.
    places : list of (int, int)
        0 for an exposure or 1 for a haze, and the image.
    """
    count = len(level.views)
    places = [(0, k) for k in range(1, count) if settings.estimate_exposure]
    places += [(1, k) for k in range(count) if settings.estimate_haze]
    places = [place for place in places if sums[place[1], SUM_FF] > 0]
    columns = []
    bending, slope = np.zeros((len(places), len(places))), np.zeros(len(places))
    pull = _haze_pull(sums)
    for n, (kind, k) in enumerate(places):
        w, f, ff, fm, m = (sums[k, c] for c in (SUM_W, SUM_F, SUM_FF, SUM_FM, SUM_M))
        exposure, haze = state.exposures[k], state.hazes[k]
        columns.append(_column(level, state, k, kind))
        if kind == 0:
            bending[n, n], slope[n] = ff, exposure * ff + haze * f - fm
        else:
            bending[n, n] = w + pull[k]
            slope[n] = exposure * f + haze * w - m + pull[k] * haze
        for other, place in enumerate(places[:n]):
            if place[1] == k:
                bending[n, other] = bending[other, n] = f
    return columns, bending, slope, places


def _column(level, state, k, kind):
    """Derivative of the gradient with respect to an exposure (kind 0) or a haze (1)."""
    one, rows = level, state.u.shape[0]
    if len(level.views) > 1:
        one = level.single_image(k)
        one.assemble(state.u)
    by_p, by_q, weight, _ = one.coupling
    if kind == 0:  # brightness grows by a R with T, where by T R with a
        factor = level.albedo / np.float32(state.exposures[k])
    else:  # by 1
        lit = level.predict(state.u, k) - np.float32(state.hazes[k])
        factor = level.albedo / np.where(weight > 0, lit, np.float32(1))
    column = np.zeros((2 * rows, state.u.shape[1]), np.float32)
    slope_adjoint(by_p * factor, by_q * factor, column[:rows])
    column[rows:-1, :-1] = weight * factor
    return column
