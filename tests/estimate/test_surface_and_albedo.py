"""Heights, albedo, exposures and hazes solved together: the equations, and where they end."""

import numpy as np
import pytest

from estimate.shading_scene import blank_view, hills, patch_grid
from lommel.core.multigrid import NormalEquations
from lommel.core.reflectance import reflectance_model
from lommel.estimate.albedo_field import smoothness_cost, smoothness_equations
from lommel.estimate.priors import Priors
from lommel.estimate.problem import fresh_problem
from lommel.estimate.shape_from_shading import SolverSettings
from lommel.estimate.surface import Surface
from lommel.estimate.surface_and_albedo import JointEquations, _look, _State, solve_jointly

CONTRAST = 0.01
SHAPE = (48, 56)


@pytest.fixture
def level():
    """Two images of patchy ground, noise 1 %, a few posts pinned."""
    truth, grid = hills(SHAPE, rms=10.0), patch_grid(*SHAPE)
    views = [blank_view(grid, azimuth) for azimuth in (80.0, 150.0)]
    problem = fresh_problem(Surface(grid, 0.0), truth, views, reflectance_model(), None)
    problem.exposures, problem.hazes = np.array([100.0, 130.0]), np.zeros(2)
    problem.prepare_geometry(truth)
    rng = np.random.default_rng(1)
    problem.albedo = 1 + 0.05 * hills((SHAPE[0] - 1, SHAPE[1] - 1), seed=2, smooth=8.0, rms=1.0)
    noise = rng.normal(size=problem.cells.shape)
    problem.cells[:] = [problem.predict(truth, k) + noise[k] for k in range(2)]
    problem.albedo = np.ones_like(problem.albedo)
    problem.expect(Priors(np.array([1.0, 1.0]), 0.1, CONTRAST, np.array([np.inf]), 0.0))
    problem.pin(np.isin(np.arange(SHAPE[1]), (3, 30, 50)) & np.ones(SHAPE, bool), 1.0)
    problem.sample_images = lambda u: None  # the images are on the cells already
    problem.truth = truth
    return problem


def test_equations_are_symmetric(level):
    rng = np.random.default_rng(0)
    level.couples_albedo = True
    here = level.expand(level.truth)
    by_p, by_q, weight, _ = level.coupling
    heights = NormalEquations(here.tensors, level.curvature, level.masses, level.pins)
    stiffness = np.full(weight.shape, CONTRAST**-2.0, np.float32)
    albedo = smoothness_equations(stiffness, CONTRAST, np.pad(weight, (0, 1)))
    equations = JointEquations(heights, albedo, by_p, by_q)
    x, y = rng.normal(size=(2, *equations.shape)).astype(np.float32)
    ax, ay = np.empty_like(x), np.empty_like(y)
    equations.apply(x, ax)
    equations.apply(y, ay)
    assert np.vdot(y, ax) == pytest.approx(np.vdot(x, ay), rel=1e-4)  # float32
    assert np.vdot(x, ax) > 0


def test_gradient_of_the_smoothness_is_that_of_its_cost():
    rng = np.random.default_rng(0)
    albedo = (1 + 0.001 * rng.normal(size=SHAPE)).astype(np.float32)  # far below a border
    change = (0.001 * rng.normal(size=SHAPE)).astype(np.float32)
    stiffness = np.full((SHAPE[0] - 1, SHAPE[1] - 1), CONTRAST**-2.0, np.float32)
    image = np.empty_like(albedo)
    smoothness_equations(stiffness, CONTRAST, np.zeros_like(albedo)).apply(albedo, image)
    costs = [smoothness_cost(albedo + sign * change, CONTRAST) for sign in (1, -1)]
    assert (costs[0] - costs[1]) / 2 == pytest.approx(np.vdot(image, change), rel=0.02)


def test_no_direction_lowers_the_cost_where_the_solve_ends(level):
    """The cost along heights, albedo and exposure: a parabola whose vertex is near 0."""
    settings = SolverSettings(estimate_haze=True, gain_tolerance=1e-6)
    history = []
    start = np.full(SHAPE, level.truth.mean(), np.float32)
    u, _ = solve_jointly(level, start, CONTRAST, settings, history)
    assert len(history) < 10
    level.couples_albedo = True
    end = _State(u, np.pad(level.albedo, (0, 1), "edge"), level.exposures, level.hazes)
    _look(level, end, CONTRAST, settings)
    none, zero = np.zeros(SHAPE, np.float32), np.zeros(2)
    directions = [
        (hills(SHAPE, seed=7, smooth=6.0, rms=1.0), none, zero, zero),
        (none, hills(SHAPE, seed=8, smooth=6.0, rms=0.01), zero, zero),
        (none, none, np.array([0.0, 1.0]), zero),
    ]
    for direction in directions:
        costs = []
        for sign in (1, -1):
            moved = [x + sign * d for x, d in zip(vars(end).values(), direction, strict=False)]
            state = _State(*moved)
            _look(level, state, CONTRAST, settings)
            costs.append(state.cost - end.cost)
        slope, bending = (costs[0] - costs[1]) / 2, costs[0] + costs[1]
        assert bending > 0
        assert abs(slope / bending) < 0.02  # of the step tried: 2 cm, 0.02 % and 0.02 %


def test_photometry_is_found_with_the_surface(level):
    settings = SolverSettings(estimate_haze=True)
    start = np.full(SHAPE, level.truth.mean(), np.float32)
    u, converged = solve_jointly(level, start, CONTRAST, settings, [])
    assert converged
    assert np.std(u - level.truth) < 0.2 * np.std(level.truth)
    assert (level.hazes >= 0).all()
    assert level.exposures[1] / level.exposures[0] == pytest.approx(1.3, rel=0.02)
    assert level.albedo.mean() == pytest.approx(1.0, abs=1e-5)
