"""The normal operator against its definition in plain arrays."""

import numpy as np
import pytest

from lommel.core.normal_operator import (
    LARGEST_EIGENVALUE,
    add_slopes,
    apply_operator,
    coarse_shape,
    coarsen_cells,
    inverse_diagonal,
    prolong_add,
    restrict,
    slope_adjoint,
)

FLOAT32 = 2e-5  # relative; a few hundred float32 roundings in a sum
SHAPES = [(37, 52), (36, 51), (9, 8), (5, 5), (70, 33)]


def random_terms(shape, seed=0):
    """Tensors of rank 1 and 2, curvature weights and masses."""
    rng = np.random.default_rng(seed)
    cells = (shape[0] - 1, shape[1] - 1)
    d = rng.normal(size=(2, *cells, 2))
    d[1, : cells[0] // 2] = 0.0
    tensors = [(d[..., a] * d[..., b]).sum(axis=0) for a, b in ((0, 0), (0, 1), (1, 1))]
    curvature = np.array([0.3, 0.6, 0.2], np.float32)
    mass = rng.uniform(0.0, 0.1, shape).astype(np.float32)
    return [t.astype(np.float32) for t in tensors], curvature, np.float32(0.1), mass


def slope_differences(u):
    p = (u[:-1, 1:] - u[:-1, :-1] + u[1:, 1:] - u[1:, :-1]) / 2
    q = (u[1:, :-1] - u[:-1, :-1] + u[1:, 1:] - u[:-1, 1:]) / 2
    return p, q


def energy(u, tensors, curvature, hourglass, mass):
    """The quadratic form whose gradient the operator is, in float64."""
    u = u.astype(float)
    gpp, gpq, gqq = tensors
    p, q = slope_differences(u)
    twist = u[1:, 1:] - u[1:, :-1] - u[:-1, 1:] + u[:-1, :-1]
    return (
        (gpp * p * p + 2 * gpq * p * q + gqq * q * q).sum()
        + ((curvature[1] + hourglass * (gpp + gqq)) * twist**2).sum()
        + curvature[0] * (np.diff(u, 2, axis=1) ** 2).sum()
        + curvature[2] * (np.diff(u, 2, axis=0) ** 2).sum()
        + (mass * u * u).sum()
    )


def operator(u, terms):
    out = np.empty_like(u)
    tensors, curvature, hourglass, mass = terms
    apply_operator(u, *tensors, curvature, hourglass, mass, out)
    return out


@pytest.mark.parametrize("shape", SHAPES)
def test_operator_is_the_gradient_of_its_energy(shape):
    rng = np.random.default_rng(1)
    u = rng.normal(size=shape).astype(np.float32)
    terms = random_terms(shape)
    value = float(np.vdot(u.astype(float), operator(u, terms)))
    assert value == pytest.approx(energy(u, *terms), rel=FLOAT32)


@pytest.mark.parametrize("shape", SHAPES)
def test_operator_is_symmetric(shape):
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(2, *shape)).astype(np.float32)
    terms = random_terms(shape)
    left = np.vdot(operator(x, terms).astype(float), y)
    right = np.vdot(x.astype(float), operator(y, terms))
    assert left == pytest.approx(right, rel=FLOAT32, abs=1e-3)


def test_diagonal_is_what_unit_vectors_give():
    shape = (9, 11)
    tensors, curvature, hourglass, mass = terms = random_terms(shape)
    inverse = np.empty(shape, np.float32)
    inverse_diagonal(*tensors, curvature, hourglass, mass, inverse)
    for place in np.ndindex(shape):
        e = np.zeros(shape, np.float32)
        e[place] = 1.0
        assert operator(e, terms)[place] * inverse[place] == pytest.approx(1.0, rel=FLOAT32)


@pytest.mark.parametrize("azimuth_deg", [0, 30, 45, 90, 135])
def test_scaled_spectrum_never_exceeds_the_bound(azimuth_deg):
    """Also for one image at any Sun azimuth, where estimates of the eigenvalue have failed."""
    shape = (12, 13)
    azimuth = np.radians(azimuth_deg)
    rp, rq = np.cos(azimuth), np.sin(azimuth)
    cells = (shape[0] - 1, shape[1] - 1)
    tensors = [np.full(cells, value, np.float32) for value in (rp * rp, rp * rq, rq * rq)]
    curvature = np.array([1e-3, 2e-3, 1e-3], np.float32)
    terms = tensors, curvature, np.float32(0), np.zeros((1, shape[1]), np.float32)
    matrix = np.stack([operator(e.reshape(shape), terms).ravel() for e in np.eye(156, dtype="f4")])
    scale = np.sqrt(np.diag(matrix))
    largest = np.linalg.eigvalsh(matrix / scale[:, None] / scale[None, :]).max()
    assert largest <= LARGEST_EIGENVALUE * (1 + FLOAT32)


def test_slope_adjoint_is_the_transpose_of_the_differences():
    rng = np.random.default_rng(3)
    u = rng.normal(size=(17, 23)).astype(np.float32)
    gp, gq = rng.normal(size=(2, 16, 22)).astype(np.float32)
    out = np.empty_like(u)
    slope_adjoint(gp, gq, out)
    p, q = slope_differences(u)
    assert np.vdot(out, u) == pytest.approx(np.vdot(gp, p) + np.vdot(gq, q), abs=1e-3)
    slopes = np.ones((16, 22), np.float32)
    add_slopes(gp, gq, u, slopes)
    np.testing.assert_allclose(slopes, 1 + gp * p + gq * q, atol=1e-5)  # float32 rounding


@pytest.mark.parametrize("shape", SHAPES)
def test_restriction_is_the_transpose_of_prolongation(shape):
    rng = np.random.default_rng(4)
    fine = rng.normal(size=shape).astype(np.float32)
    coarse = rng.normal(size=coarse_shape(shape)).astype(np.float32)
    down, up = np.empty_like(coarse), np.zeros_like(fine)
    restrict(fine, down)
    prolong_add(coarse, up)
    assert np.vdot(down, coarse) == pytest.approx(np.vdot(up, fine), abs=1e-3)


@pytest.mark.parametrize("shape", SHAPES)
def test_prolongation_keeps_planes(shape):
    rows, cols = np.indices(coarse_shape(shape))
    fine = np.zeros(shape, np.float32)
    prolong_add((2.0 * (3 * rows + 5 * cols)).astype(np.float32), fine)
    rows, cols = np.indices(shape)
    np.testing.assert_allclose(fine, 3 * rows + 5 * cols, rtol=1e-6)


def test_coarse_energy_of_a_smooth_surface_is_the_fine_one():
    """A plane has the same slope energy on both grids when tensors are averaged."""
    tensors = [np.full((32, 32), value, np.float32) for value in (1.0, 0.3, 2.0)]
    half = [np.empty((16, 16), np.float32) for _ in range(3)]
    for fine, coarse in zip(tensors, half, strict=True):
        coarsen_cells(fine, coarse)
    rows, cols = np.indices((33, 33))
    u = (0.2 * rows - 0.7 * cols).astype(np.float32)
    flat = np.zeros(3, np.float32)
    fine = energy(u, tensors, flat, 0.0, 0.0)
    coarse = energy(u[::2, ::2], half, flat, 0.0, 0.0)
    assert coarse == pytest.approx(fine, rel=1e-6)
