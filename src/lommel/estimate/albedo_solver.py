"""Steps of both solvers until the cost stays. Most callers want `solve`.

The cost is counted in a noise scale, in pixels per independent residual and in a spread of haze
that the residuals themselves show. The default solver minimises it with these held, reads them anew
and minimises again, until they stay.
"""

from dataclasses import replace

import numpy as np

from lommel.core.least_squares import Solution
from lommel.estimate.albedo_arrays import OWN, SHARED, State
from lommel.estimate.albedo_equations import (
    Factors,
    effective_repetition,
    haze_spread,
    noise_scale,
    normal_equations,
    visit,
)

SETTLED = 0.02  # change of the log noise scale from which it is kept
STEADY = 0.1  # the same for repetition and spread of haze, which the answer feels less
SETTLING = 8  # steps at most until the noise scale is kept; from there on the cost has a meaning
TURNS = 8  # minimisations at most
ALONE = 0.01  # repetition to start with: the noise scale is read where hardly a prior speaks
ROUGH = 1e-3  # tolerance there: only the noise scale is kept
LONGEST = 0.5  # change of any unknown in one step; all are logarithms or of order 1


def solve(problem):
    """Minimise the cost.

    Parameters
    ----------
    problem : Problem

    Returns
    -------
    problem : Problem
        With the spread of haze that the images show.
    solution : Solution
        Its value is the last `Point`.
    """
    settings, levels = problem.settings, problem.blocks.levels
    state = State(
        levels / levels.mean(),
        np.zeros(problem.images),
        problem.blocks.brightness,
        _shared_start(problem),
    )
    point = visit(problem, state, np.log(levels.mean()), 1.0, ALONE)
    is_settled = settings.solver == "alternating" and settings.loss == "least-squares"
    if settings.solver == "alternating":
        return problem, _descend(problem, point, [], is_settled)
    rough = replace(problem, settings=replace(settings, tolerance=max(ROUGH, settings.tolerance)))
    solution = _descend(rough, point, [], is_settled)
    for _ in range(TURNS):
        point = solution.value
        scale, repetition = weighting(point.sums)
        if abs(np.log(scale / point.scale)) < SETTLED and point.repetition == 1.0:
            break
        point = visit(problem, point.state, point.mean_log_albedo, scale, 1.0)
        solution = _descend(problem, point, solution.history, True)
    for _ in range(TURNS):
        point = visit(problem, point.state, point.mean_log_albedo, scale, repetition)
        solution = _descend(problem, point, solution.history, True)
        point, before = solution.value, problem.settings.haze_error
        spread = haze_spread(problem, point, settings.haze_error)
        if abs(np.log(spread / before)) < STEADY:
            break
        problem = replace(problem, settings=replace(settings, haze_error=spread))
    return problem, solution


def _shared_start(problem):
    """The shared parameters expected, but c1 = 0 where it is fitted.

    How steeply f falls with phase grows with c1 up to about its lunar value and shrinks beyond.
    From there a step towards a flatter f may go either way, and the far way ends in a wrong
    minimum; from 0 on there is one way.
    """
    start = problem.shared_start.copy()
    if problem.is_fitted[OWN * problem.images]:
        start[0] = 0.0
    return start


def weighting(sums):
    """Noise scale and repetition that the residuals show; 1 where one image shows none."""
    scale = noise_scale(sums.histogram)
    return scale if np.isfinite(scale) else 1.0, effective_repetition(sums)


def _descend(problem, point, history, is_settled):
    """Steps until the cost stays; until settled, the noise scale follows them."""
    settings = problem.settings
    history, done = list(history), history[-1]["step"] if history else 0
    damping, change = 0.0, np.inf
    for step in range(done, settings.max_steps):
        scale = point.scale
        if not is_settled:
            scale = weighting(point.sums)[0]
            is_settled = abs(np.log(scale / point.scale)) < SETTLED or step >= SETTLING
        moved, mean = _step(problem, point, damping)
        trial = visit(problem, moved, mean, scale, point.repetition)
        if scale != point.scale:
            point = trial  # the cost has changed its meaning
            continue
        change = (trial.objective - point.objective) / max(abs(point.objective), 1e-300)
        if change <= 0:
            point, damping = trial, damping / 4
        else:
            damping = max(4 * damping, 1e-3)
        counted = {"noise": scale, "repetition": point.repetition, "haze": settings.haze_error}
        history.append(
            {"step": step + 1, "cost": point.objective, "change": change, "counted_in": counted}
        )
        if abs(change) < settings.tolerance:
            return Solution(point, "converged", f"Converged after {step + 1} steps.", history)
    advice = (
        f"Stopped after {settings.max_steps} steps while the cost still changed by "
        f"{100 * abs(change):.2g} % per step; raise max_steps."
    )
    return Solution(point, "step_limit", advice, history)


def _step(problem, point, damping):
    """The next state and mean log albedo."""
    change = np.zeros(problem.is_fitted.size)
    if problem.settings.solver == "alternating":
        change[: OWN * problem.images] = _published_step(problem, point)
    else:
        matrix, gradient = normal_equations(problem, point)
        factors = Factors(problem, matrix, damping)
        change[factors.fitted] = -factors.solve(gradient[factors.fitted])
        change *= min(1.0, LONGEST / np.abs(change).max())
    own = change[: OWN * problem.images].reshape(-1, OWN)
    state = point.state
    exposure = state.exposure * np.exp(own[:, 0])
    if problem.settings.solver == "alternating":  # step 3 is linear in T
        exposure = state.exposure * (1.0 + own[:, 0])
    shared = state.shared + change[-SHARED - 1 : -1]
    shared[1] = max(shared[1], 0.0)  # a negative c2 could make the brightness negative
    moved = State(exposure, state.haze + state.level * own[:, 1], state.level, shared)
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
