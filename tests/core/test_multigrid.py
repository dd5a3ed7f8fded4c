"""The linear solver: right answers, in a bounded number of cycles at any size."""

import numba
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from lommel.core.multigrid import (
    NormalEquations,
    add_long_waves,
    coarse_masses,
    conjugate_gradients,
    dot,
)
from lommel.core.normal_operator import coarse_shape, restrict
from lommel.core.plane import remove_plane

STOP = 1e-4  # reduction of the preconditioned residual
ONE_IMAGE_CYCLES = 24  # measured 15 at every size; twice that would be a regression
FOUR_IMAGES_CYCLES = 6  # measured 3 to 4


def scene(size, images, seed=0, mass=1e-2):
    """Normal equations of slopes that vary over the scene, as shading gives them."""
    rng = np.random.default_rng(seed)
    relief = 3 * gaussian_filter(rng.normal(size=(size - 1, size - 1)), 3)
    tensors = np.zeros((3, size - 1, size - 1))
    for k in range(images):
        azimuth = np.radians(30 + 77 * k)
        rp, rq = np.cos(azimuth) * (1 + relief / 2), np.sin(azimuth) * (1 + relief / 2)
        tensors += np.array([rp * rp, rp * rq, rq * rq])
    curvature = np.array([0.1, 0.2, 0.1], np.float32)
    return NormalEquations(tuple(tensors.astype(np.float32)), curvature, [0.0, 0.0, 0.0, mass])


def solve(equations, seed=1):
    rng = np.random.default_rng(seed)
    truth = gaussian_filter(rng.normal(size=equations.shape), 4).astype(np.float32)
    right = np.empty_like(truth)
    equations.apply(truth, right)
    return truth, conjugate_gradients(equations, right, STOP, 100)


@pytest.mark.parametrize("size", [64, 129, 256, 512])
@pytest.mark.parametrize(("images", "cycles"), [(1, ONE_IMAGE_CYCLES), (4, FOUR_IMAGES_CYCLES)])
def test_cycles_do_not_grow_with_size(size, images, cycles):
    _, solution = solve(scene(size, images))
    assert solution.reduction <= STOP
    assert solution.iterations <= cycles


@pytest.mark.parametrize("mass", [1.0, 10.0])
def test_a_terrain_that_is_known_well_does_not_slow_the_solver(mass):
    _, solution = solve(scene(256, 1, mass=mass))
    assert solution.reduction <= STOP
    assert solution.iterations <= ONE_IMAGE_CYCLES


@pytest.mark.parametrize("images", [1, 4])
def test_the_best_surface_with_the_plane_kept_is_found_as_fast(images):
    equations = scene(129, images)
    right = np.random.default_rng(1).normal(size=equations.shape).astype(np.float32)
    free = conjugate_gradients(equations, right, STOP, 100).iterations
    solution = conjugate_gradients(equations, right, STOP, 100, keeps_plane=True)
    x, left = solution.x.copy(), np.empty_like(right)
    assert solution.iterations <= free + 2
    flat = x.copy()
    remove_plane(flat)
    np.testing.assert_allclose(x, flat, atol=1e-5 * np.abs(x).max())
    equations.apply(x, left)
    left -= right
    only_planes = left.copy()
    remove_plane(only_planes)  # at the minimum only planes are left of the gradient
    preconditioned = equations.precondition(only_planes)
    assert dot(only_planes, preconditioned) < (3 * STOP) ** 2 * dot(right, x)


def test_four_images_give_back_the_surface():
    truth, solution = solve(scene(200, 4))
    assert np.abs(solution.x - truth).max() < 2e-3 * np.abs(truth).max()


def test_energy_norm_of_the_error_falls_as_the_residual_says():
    equations = scene(100, 1)
    truth, solution = solve(equations)
    error, image = solution.x - truth, np.empty_like(truth)
    equations.apply(error, image)
    left = dot(error, image)
    equations.apply(truth, image)
    assert np.sqrt(left / dot(truth, image)) < 10 * STOP


def test_answer_does_not_depend_on_the_number_of_threads():
    threads = numba.get_num_threads()
    _, together = solve(scene(300, 1))
    numba.set_num_threads(1)
    try:
        _, alone = solve(scene(300, 1))
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(together.x, alone.x)


def test_zero_right_hand_side_needs_no_cycle():
    equations = scene(40, 1)
    solution = conjugate_gradients(equations, np.zeros(equations.shape, np.float32), STOP, 9)
    assert solution.iterations == 0
    assert not solution.x.any()


def test_long_waves_are_the_gradient_of_their_energy():
    rng = np.random.default_rng(5)
    u = rng.normal(size=(45, 38)).astype(np.float32)
    out = np.zeros_like(u)
    masses = [0.3, 0.0, 2.0, 5.0]
    energy = add_long_waves(u, masses, out)
    total, low = 0.0, u
    for mass in masses:
        total += mass * float(np.vdot(low, low))
        coarse = np.empty(coarse_shape(low.shape), np.float32)
        restrict(low, coarse)
        low = coarse / 4
    assert energy == pytest.approx(total, rel=1e-5)
    assert np.vdot(out.astype(float), u) == pytest.approx(total, rel=1e-5)


def test_masses_of_finer_grids_act_on_coarse_posts_times_four():
    assert coarse_masses([1.0, 10.0, 100.0], 0).tolist() == [1.0, 10.0, 100.0]
    assert coarse_masses([1.0, 10.0, 100.0], 1).tolist() == [14.0, 100.0]
    assert coarse_masses([1.0], 2).tolist() == [16.0]
