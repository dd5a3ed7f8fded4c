import numpy as np
import pytest

from lommel.simulate.noise import SPLINE_SLOPE, spline_noise, uniform_hash


def test_hash_is_even_and_without_memory():
    numbers = uniform_hash((1, 2), np.arange(200)[:, None], np.arange(-100, 100)[None, :])
    assert numbers.mean() == pytest.approx(0.5, abs=0.01)  # 7 standard errors
    assert numbers.std() == pytest.approx(12**-0.5, abs=0.01)
    neighbours = np.corrcoef(numbers[:, :-1].ravel(), numbers[:, 1:].ravel())[0, 1]
    assert abs(neighbours) < 0.03


def test_spline_noise_has_unit_rms_and_the_stated_slope():
    x = np.arange(0.0, 400.0, 0.25)
    noise = spline_noise((3,), 2.0, x, x)
    slope = np.gradient(noise, 0.25, axis=1)
    assert noise.std() == pytest.approx(1.0, rel=0.03)  # 40 000 nodes
    assert slope.std() == pytest.approx(SPLINE_SLOPE / 2.0, rel=0.03)


def test_spline_noise_is_a_function_of_the_place():
    x, y = np.arange(0.0, 30.0), np.arange(0.0, -20.0, -1.0)
    whole = spline_noise((5,), 7.0, x, y)
    part = spline_noise((5,), 7.0, x[10:20], y[5:9])
    np.testing.assert_allclose(part, whole[5:9, 10:20], atol=1e-12)
