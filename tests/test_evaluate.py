import numpy as np
import pytest

from lommel.errors import InputError
from lommel.evaluate import (
    compare_albedo,
    compare_heights,
    compare_points,
    relative_errors,
    sample_bilinear,
    slope_angle,
)
from lommel.scene.grid import grid_from_bounds, read_crs

SPACING = 50.0  # m
ON_A_SPHERE = 5e-4  # share; 500 m of height widen the ground by as much
GRID = grid_from_bounds(
    (0.0, 0.0, 50 * SPACING, 40 * SPACING),
    SPACING,
    read_crs("+proj=eqc +R=1737400 +units=m +type=crs"),
)
ROWS, COLS = np.indices(GRID.shape)


def rough(seed=0):
    return np.random.default_rng(seed).normal(0.0, 5.0, GRID.shape)


def test_constant_offset_is_all_bias():
    errors = compare_heights(rough() + 3.0, rough(), GRID)
    assert errors["count"] == 2000
    for name in ("height_rmse_m", "height_mae_m", "height_median_m"):
        assert errors[name] == pytest.approx(3.0)
    assert errors["height_nmad_m"] == pytest.approx(0.0, abs=1e-9)
    assert errors["slope_rmse_deg"] == pytest.approx(0.0, abs=1e-3)  # the radius grew by 3 m


def test_tilted_plane_has_the_slope_error_of_its_tilt():
    errors = compare_heights(0.1 * SPACING * COLS, np.zeros(GRID.shape), GRID)
    assert errors["slope_rmse_deg"] == pytest.approx(np.degrees(np.arctan(0.1)), rel=1e-3)
    expected = np.sqrt(np.mean((0.1 * SPACING * np.arange(50)) ** 2))
    assert errors["height_rmse_m"] == pytest.approx(expected)


def test_slope_angle_does_not_depend_on_the_direction():
    east, north = 0.2 * SPACING * COLS, -0.2 * SPACING * ROWS
    assert slope_angle(east, GRID).mean() == pytest.approx(
        slope_angle(north, GRID).mean(), rel=ON_A_SPHERE
    )


def test_statistics_of_gaussian_errors_agree():
    error = np.random.default_rng(1).normal(0.0, 2.0, GRID.shape)
    errors = compare_heights(rough() + error, rough(), GRID)
    assert errors["height_rmse_m"] == pytest.approx(2.0, rel=0.06)  # 2000 posts
    assert errors["height_nmad_m"] == pytest.approx(2.0, rel=0.08)
    assert errors["height_mae_m"] == pytest.approx(2.0 * np.sqrt(2 / np.pi), rel=0.06)


def test_unknown_posts_and_the_border_do_not_count():
    heights, reference = rough(), rough()
    heights[0, :] += 1000.0
    reference[10, 10] = np.nan
    errors = compare_heights(heights, reference, GRID, border=2)
    assert errors["count"] == 36 * 46 - 1
    assert errors["height_rmse_m"] == 0.0
    assert errors["slope_rmse_deg"] == 0.0


def test_points_on_a_plane_are_met_exactly():
    heights = 2.0 * ROWS - 3.0 * COLS
    row, col = np.random.default_rng(2).uniform(0.0, 39.0, (2, 100))
    longitude, latitude = GRID.lonlat_at(row, col)
    errors = compare_points(heights, GRID, longitude, latitude, 2.0 * row - 3.0 * col - 1.5)
    assert errors["count"] == 100
    assert errors["height_median_m"] == pytest.approx(1.5)
    assert errors["height_nmad_m"] == pytest.approx(0.0, abs=1e-6)
    assert "slope_rmse_deg" not in errors


def test_points_outside_and_beside_holes_do_not_count():
    heights = np.zeros(GRID.shape)
    heights[20, 20] = np.nan
    row, col = np.array([5.0, 19.5, -3.0, 38.9]), np.array([5.0, 19.5, 5.0, 5.0])
    longitude, latitude = GRID.lonlat_at(row, col)
    assert compare_points(heights, GRID, longitude, latitude, np.zeros(4))["count"] == 2
    assert compare_points(heights, GRID, longitude, latitude, np.zeros(4), border=2)["count"] == 1


def test_bilinear_sampling_reaches_the_last_post():
    values = np.arange(6.0).reshape(2, 3)
    assert sample_bilinear(values, np.array([1.0]), np.array([2.0])) == [5.0]
    assert np.isnan(sample_bilinear(values, np.array([1.01]), np.array([2.0]))[0])


def test_common_factor_is_no_error():
    errors = relative_errors(np.array([2.0, 4.0, 6.0]), np.array([1.0, 2.0, 3.0]))
    assert errors["scale"] == 2.0
    assert errors["rms_percent"] == 0.0


def test_relative_error_is_in_per_cent_of_the_reference():
    reference = np.full(GRID.shape, 0.5)
    albedo = 3.0 * reference * (1.0 + 0.02 * (-1.0) ** (ROWS + COLS))
    errors = compare_albedo(albedo, reference)
    assert errors["albedo_rms_percent"] == pytest.approx(2.0, rel=1e-6)
    assert errors["albedo_scale"] == pytest.approx(3.0)


def test_nothing_in_common_is_an_error():
    with pytest.raises(InputError, match="share no known height"):
        compare_heights(np.full(GRID.shape, np.nan), rough(), GRID)
    with pytest.raises(InputError, match="share no known positive value"):
        compare_albedo(np.full(GRID.shape, np.nan), np.ones(GRID.shape))


def test_border_that_leaves_nothing_is_an_error():
    with pytest.raises(InputError, match="--border = 20 leaves nothing of 40 x 50 posts"):
        compare_heights(rough(), rough(), GRID, border=20)


def test_rasters_of_different_shape_are_an_error():
    with pytest.raises(InputError, match="Bring both onto one grid"):
        compare_heights(rough(), rough()[1:], GRID)
