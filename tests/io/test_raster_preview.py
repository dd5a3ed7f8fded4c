"""Previews of rasters: small, in place, blind to what is missing."""

import numpy as np
import pytest

from lommel.errors import InputError
from lommel.io.raster import read_preview, write_raster
from lommel.scene.grid import grid_from_bounds, read_crs

PLACE = 1e-9  # degrees, rounding of the bounds
MEAN = 1e-6  # relative, float32


@pytest.fixture
def grid():
    return grid_from_bounds((0.0, 0.0, 4.0, 2.0), 1000.0, read_crs("IAU_2015:30100"))


def test_small_raster_comes_back_as_it_is(tmp_path, grid):
    values = np.arange(np.prod(grid.shape), dtype=np.float32).reshape(grid.shape)
    write_raster(tmp_path / "a.tif", values, grid, "ramp", "m")
    preview = read_preview(tmp_path / "a.tif", 500)
    np.testing.assert_array_equal(preview.values, values)
    assert (preview.unit, preview.shrink) == ("m", 1.0)
    assert preview.grid.is_same(grid)


def test_large_raster_is_shrunk_by_area_means_of_known_pixels(tmp_path, grid):
    grid = grid_from_bounds((0.0, 0.0, 4.0, 2.0), 500.0, grid.crs)
    rows, cols = (side // 2 * 2 for side in grid.shape)
    grid = grid.cut(type(grid.window)(0, 0, rows, cols))
    values = np.random.default_rng(1).normal(size=(rows, cols)).astype(np.float32)
    values[:40, :60] = np.nan
    values[60, 80] = np.nan
    write_raster(tmp_path / "a.tif", values, grid, "noise")
    preview = read_preview(tmp_path / "a.tif", cols // 2)
    blocks = values.reshape(rows // 2, 2, cols // 2, 2)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    means = np.where(known, blocks, 0).sum(axis=(1, 3)) / np.where(count, count, np.nan)
    np.testing.assert_allclose(preview.values, means, rtol=MEAN, atol=MEAN)
    np.testing.assert_allclose(preview.grid.bounds, grid.bounds, atol=PLACE)
    assert preview.shrink == 2.0


def test_preview_of_a_truncated_raster_names_the_file(tmp_path, grid):
    path = tmp_path / "a.tif"
    write_raster(path, np.random.default_rng(1).random(grid.shape), grid, "noise")
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(InputError, match=r"a\.tif cannot be"):
        read_preview(path, 500)
