import json

import numpy as np
import pytest

from lommel.errors import InputError
from lommel.io.raster import write_raster
from lommel.run.evaluate import evaluate_product, read_points
from lommel.scene.grid import grid_from_bounds, read_crs

CRS = read_crs("+proj=eqc +R=1737400 +units=m +type=crs")
GRID = grid_from_bounds((0.0, 0.0, 4000.0, 3000.0), 100.0, CRS)


def plane(grid):
    """A height that is linear in the map coordinates."""
    cols, rows = np.arange(grid.shape[1]) + 0.5, np.arange(grid.shape[0]) + 0.5
    x, y = grid.affine @ (cols[None, :], rows[:, None])
    return 0.05 * x - 0.02 * y


@pytest.fixture
def dem(tmp_path):
    write_raster(tmp_path / "dem.tif", plane(GRID) + 2.0, GRID, "height", "m")
    return tmp_path / "dem.tif"


def write_points(folder, text):
    path = folder / "points.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_reference_raster_is_brought_onto_the_grid_of_the_product(dem, tmp_path):
    wide = grid_from_bounds((-1000.0, -1000.0, 6000.0, 5000.0), 125.0, CRS)
    write_raster(tmp_path / "reference.tif", plane(wide), wide, "height", "m")
    errors = evaluate_product(dem, tmp_path / "reference.tif", border=3)
    assert errors["count"] == 24 * 34
    assert errors["height_median_m"] == pytest.approx(2.0, abs=1e-3)  # m, stored as float32
    assert errors["height_nmad_m"] == pytest.approx(0.0, abs=1e-3)
    assert errors["slope_rmse_deg"] == pytest.approx(0.0, abs=1e-2)


def test_points_may_carry_other_columns(dem, tmp_path):
    longitude, latitude = GRID.lonlat_at(np.array([10.0, 12.0]), np.array([20.0, 7.5]))
    heights = plane(GRID)[10, 20], 0.5 * (plane(GRID)[12, 7] + plane(GRID)[12, 8])
    rows = [
        f"2009-09-06,{height},{np.degrees(lat):.9f},{np.degrees(lon):.9f}"
        for height, lat, lon in zip(heights, latitude, longitude, strict=True)
    ]
    path = write_points(
        tmp_path, "\n".join(["date,height_m,latitude_deg,longitude_deg", *rows]) + "\n"
    )
    errors = evaluate_product(dem, path, json_path=tmp_path / "errors.json")
    assert errors["count"] == 2
    assert errors["height_rmse_m"] == pytest.approx(2.0, abs=1e-3)
    assert json.loads((tmp_path / "errors.json").read_text()) == errors


def test_albedo_is_compared_up_to_a_factor(tmp_path):
    albedo = 1.0 + 0.1 * np.sin(np.arange(40.0)) * np.ones((30, 1))
    write_raster(tmp_path / "albedo.tif", albedo, GRID, "albedo")
    write_raster(tmp_path / "truth.tif", 0.3 * albedo, GRID, "albedo")
    errors = evaluate_product(tmp_path / "albedo.tif", tmp_path / "truth.tif", quantity="albedo")
    assert errors["albedo_rms_percent"] == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lon,lat,height_m\n1,2,3\n", "has no column longitude_deg, latitude_deg"),
        ("", "it has no header line"),
        ("longitude_deg,latitude_deg,height_m\n", "holds no point"),
        ("longitude_deg,latitude_deg,height_m\n1,2,high\n", "must hold numbers under"),
        ("longitude_deg,latitude_deg,height_m\n1,2\n", "must hold numbers under"),
        ("longitude_deg,latitude_deg,height_m\n1,2,3\n1,2,nan\n", "point 2 holds a value"),
    ],
)
def test_unusable_points_are_an_error(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read_points(write_points(tmp_path, text))


def test_missing_points_file_is_an_error(dem, tmp_path):
    with pytest.raises(InputError, match="cannot be read as a table of points"):
        evaluate_product(dem, tmp_path / "nowhere.csv")


def test_points_elsewhere_are_an_error(dem, tmp_path):
    path = write_points(tmp_path, "longitude_deg,latitude_deg,height_m\n90.0,10.0,3.0\n")
    with pytest.raises(InputError, match="share no known height"):
        evaluate_product(dem, path)


def test_reference_elsewhere_is_an_error(dem, tmp_path):
    far = grid_from_bounds((1e6, 1e5, 1.004e6, 1.03e5), 100.0, CRS)
    write_raster(tmp_path / "reference.tif", plane(far), far, "height", "m")
    with pytest.raises(InputError, match="share no known height"):
        evaluate_product(dem, tmp_path / "reference.tif")


def test_points_are_not_albedo(dem, tmp_path):
    path = write_points(tmp_path, "longitude_deg,latitude_deg,height_m\n0.01,0.01,3.0\n")
    with pytest.raises(InputError, match="points hold heights"):
        evaluate_product(dem, path, quantity="albedo")
