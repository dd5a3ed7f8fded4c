"""Parts of a scene that were tilted against each other come to one surface."""

import numpy as np
import pytest

from lommel.estimate.long_waves import Part, _limited, remainder, settle
from lommel.estimate.priors import Priors
from lommel.estimate.problem import coarse_posts
from lommel.scene.grid import Window

from .shading_scene import EXPOSURE, exact_problem, hills, patch_grid

PRIORS = Priors(
    noise=np.array([0.3, 0.3]),
    roughness=0.05,
    dem_errors=np.array([np.inf, np.inf, np.inf, 3.0]),
    smoothing=0.0,
    albedo_contrast=0.0,
    albedo_error=0.0,
)
MIDDLE = 32  # column where the second half begins


@pytest.mark.parametrize(("halvings", "left_share"), [(1, 0.05), (2, 0.2)])  # 16 posts are few
def test_tilts_of_parts_are_taken_back(halvings, left_share):
    grid = patch_grid(40, 64)
    truth = hills(grid.shape, smooth=2.0)
    level = exact_problem(truth, grid, azimuths=(100.0, 200.0))
    level.expect(PRIORS)
    rows, cols = grid.shape
    row, col = (np.linspace(-1, 1, size, dtype=np.float32) for size in grid.shape)
    row, col = np.broadcast_arrays(row[:, None], col)
    # nothing is left to do at the truth; each half errs by a wave of its own, some cm
    errors = 0.05 * row, 0.05 * np.cos(2 * col) - 0.02 * row
    rise = np.clip((np.arange(cols, dtype=np.float32) - MIDDLE + 4) / 8, 0, 1)
    shares = [np.broadcast_to(share, grid.shape) for share in (1 - rise, rise)]
    stride = 2**halvings
    shape = coarse_posts(np.zeros(grid.shape, np.float32))
    for _ in range(halvings - 1):
        shape = coarse_posts(shape)
    shape = shape.shape
    whole, middle, parts = Window(0, 0, *shape), MIDDLE // stride, []
    places = Window(0, 0, shape[0], middle), Window(0, middle, shape[0], shape[1] - middle)
    owned = (slice(0, rows), slice(0, MIDDLE)), (slice(0, rows), slice(MIDDLE, cols))
    for own, place, error, share in zip(owned, places, errors, shares, strict=True):
        u = truth + error
        left = remainder(level, level.expand(u), u, own, stride, free=False)
        coarse = share
        for _ in range(halvings):
            coarse = coarse_posts(coarse)
        parts.append(Part(left, whole, place, coarse, [0, 1]))
    blended = sum(share * error for share, error in zip(shares, errors, strict=True))
    for _ in range(halvings):
        blended = coarse_posts(np.ascontiguousarray(blended))
    correction, _ = settle(parts, shape, 2, False, stride, grid.shape)
    assert np.std(blended + correction) < left_share * np.std(blended)
    assert abs(np.mean(correction)) < 1e-5  # m: the mean is left to the parts


def test_an_exposure_that_is_off_is_found_by_the_whole():
    """Each half has settled on a surface of its own under a false exposure."""
    grid = patch_grid(40, 64)
    truth = hills(grid.shape, smooth=2.0)
    level = exact_problem(truth, grid, azimuths=(100.0, 200.0))
    level.expect(PRIORS)
    level.exposures *= [1.0004, 0.9998]
    shape = coarse_posts(np.zeros(grid.shape, np.float32)).shape
    middle, parts = MIDDLE // 2, []
    places = Window(0, 0, shape[0], middle), Window(0, middle, shape[0], shape[1] - middle)
    owned = slice(0, MIDDLE), slice(MIDDLE, grid.shape[1])
    u = truth + np.linspace(-0.02, 0.02, grid.shape[1], dtype=np.float32) ** 2
    for own, place in zip(owned, places, strict=True):
        left = remainder(level, level.expand(u), u, (slice(0, grid.shape[0]), own), 2)
        share = np.zeros(shape, np.float32)
        share[place.slices] = 1
        parts.append(Part(left, Window(0, 0, *shape), place, share, [0, 1]))
    _, change = settle(parts, shape, 2, True, 2, grid.shape)
    np.testing.assert_allclose(level.exposures + change, EXPOSURE, rtol=4e-5)


@pytest.mark.parametrize("albedo_error", [0.0, 0.02])
def test_derivatives_by_exposures_are_those_of_the_cost(albedo_error):
    grid = patch_grid(24, 30)
    level = exact_problem(hills(grid.shape, smooth=2.0), grid, azimuths=(100.0, 200.0))
    level.expect(PRIORS)
    level.albedo_error = albedo_error
    u = level.initial + hills(grid.shape, seed=5, smooth=2.0, rms=0.02)
    whole = tuple(slice(0, size) for size in grid.shape)
    left = remainder(level, level.expand(u), u, whole, 1)
    start, step = level.exposures.copy(), 0.05  # of 100, a fiftieth of the noise
    cost, gradients = np.empty((2, 2)), np.empty((2, 2, *grid.shape))
    for k in range(2):
        for side, sign in enumerate((-1, 1)):
            level.exposures = start + sign * step * np.eye(2)[k]
            here = level.expand(u)
            cost[k, side], gradients[k, side] = here.cost, here.gradient
    level.exposures = start
    middle = level.expand(u).cost
    np.testing.assert_allclose(
        left.exposure_gradient, np.diff(cost)[:, 0] / (2 * step), rtol=0.02, atol=0.02
    )
    by_twice = (cost.sum(axis=1) - 2 * middle) / step**2
    np.testing.assert_allclose(np.diag(left.exposure_stiffness), by_twice, rtol=0.03)
    np.testing.assert_allclose(left.exposure_stiffness, left.exposure_stiffness.T, rtol=1e-4)
    for k in range(2):
        expected = (gradients[k, 1] - gradients[k, 0]) / (2 * step)
        np.testing.assert_allclose(left.coupling[k], expected, atol=0.03 * np.abs(expected).max())


def test_no_place_is_moved_by_more_than_roughness_allows():
    """Small steps stay as they are; of one that went astray 2 m are left."""
    step = np.random.default_rng(5).normal(0, 0.05, (40, 50)).astype(np.float32)
    step -= step.mean(dtype=float).astype(np.float32)
    astray = step.copy()
    astray[20, 30] = 80.0  # m
    limited = _limited(astray, np.float32(2.0**-2))
    assert np.abs(limited).max() <= 2.0
    np.testing.assert_allclose(_limited(step, np.float32(2.0**-2)), step, atol=1e-3)  # m
