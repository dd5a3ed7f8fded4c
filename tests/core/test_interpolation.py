"""Splines on coarse posts against SciPy's, which evaluates them place by place."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter

from lommel.core.interpolation import refine_spline


@pytest.mark.parametrize(("stride", "first"), [(2, (0, 0)), (4, (3, 9)), (8, (16, 5))])
def test_a_refined_spline_is_the_spline_at_each_post(stride, first):
    rng = np.random.default_rng(stride)
    coarse = rng.normal(size=(14, 11)).astype(np.float32)
    last = [stride * (size - 1) for size in coarse.shape]
    rows, cols = (np.arange(begin, end + 1) for begin, end in zip(first, last, strict=True))
    out = np.empty((rows.size, cols.size), np.float32)
    refine_spline(spline_filter(coarse, 3, np.float32, "mirror"), stride, *first, out)
    places = np.meshgrid(rows / stride, cols / stride, indexing="ij")
    expected = map_coordinates(coarse.astype(float), places, order=3, mode="mirror")
    np.testing.assert_allclose(out, expected, atol=1e-5)  # float32
