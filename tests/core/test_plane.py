"""A mean plane taken out is an orthogonal projection, whatever the number of threads."""

import numba
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from lommel.core.plane import plane_between, remove_plane

ROUNDING = 2e-6  # of values of size 1, in float32


def field(shape, seed=2):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("shape", [(9, 14), (40, 3), (2, 2)])
def test_what_is_left_has_no_plane_and_does_not_change_again(shape):
    values = field(shape)
    remove_plane(values)
    row, col = np.mgrid[: shape[0], : shape[1]]
    for plane in (np.ones(shape), row - row.mean(), col - col.mean()):
        assert abs((plane * values).mean()) < ROUNDING * np.abs(plane).max()
    again = values.copy()
    remove_plane(again)
    np.testing.assert_allclose(again, values, atol=ROUNDING)


def test_planes_leave_no_trace():
    row, col = np.mgrid[0:9, 0:14].astype(np.float32)
    values = field((9, 14))
    tilted = values + 3 + 0.2 * row - 0.5 * col
    remove_plane(values)
    remove_plane(tilted)
    np.testing.assert_allclose(tilted, values, atol=5 * ROUNDING)  # of values up to 8


def test_any_number_of_threads_gives_the_same_bytes():
    one, all_of_them = field((300, 500)), field((300, 500))
    threads = numba.get_num_threads()
    remove_plane(all_of_them)
    numba.set_num_threads(1)
    try:
        remove_plane(one)
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(one, all_of_them)


@pytest.mark.parametrize(("shape", "stride"), [((33, 50), 2), ((41, 41), 4), ((30, 17), 8)])
def test_the_plane_between_coarse_posts_is_that_of_the_interpolated_field(shape, stride):
    coarse = field([-(-(size - 1) // stride) + 1 for size in shape])
    row, col = (np.arange(size) / stride for size in shape)
    inside = RegularGridInterpolator([np.arange(size) for size in coarse.shape], coarse)
    fine = inside(tuple(np.meshgrid(row, col, indexing="ij"))).astype(np.float32)
    level = fine.copy()
    remove_plane(level)
    plane = plane_between(coarse, stride, shape)
    np.testing.assert_allclose(
        plane[:-1, :-1],
        (fine - level)[::stride, ::stride][: coarse.shape[0] - 1, : coarse.shape[1] - 1],
        atol=5 * ROUNDING,
    )
