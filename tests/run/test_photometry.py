"""Known albedo and exposures, as files of an earlier run hold them."""

import numpy as np
import pytest

from lommel.errors import InputError
from lommel.io.raster import write_raster
from lommel.run.photometry import read_known
from lommel.scene.body import MOON
from lommel.scene.grid import grid_from_bounds, read_crs

GRID = grid_from_bounds((0, 0, 800, 600), 20.0, read_crs("IAU_2015:30110", MOON), MOON)


def table(folder, text):
    path = folder / "exposures.csv"
    path.write_text(text)
    return path


def test_exposures_come_in_the_order_of_the_images(tmp_path):
    path = table(tmp_path, "image,exposure,haze,used\nb.tif,2.5,-0.5,1\na.tif,100,,1\n")
    albedo, (exposures, hazes) = read_known(None, path, GRID, ["a.tif", "b.tif"])
    assert albedo is None
    assert exposures.tolist() == [100.0, 2.5] and hazes.tolist() == [0.0, -0.5]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("image,exposure\nb.tif,1\n", "no line for a.tif"),
        ("image,exposure\na.tif,-1\n", "'-1'"),
        ("image,exposure\na.tif,\n", "number above 0"),
        ("image,exposure\na.tif,nan\n", "'nan'"),
        ("", "no line for a.tif"),
    ],
)
def test_bad_tables_are_refused_in_words(tmp_path, text, words):
    with pytest.raises(InputError, match=words):
        read_known(None, table(tmp_path, text), GRID, ["a.tif"])


def test_albedo_is_brought_onto_the_grid_and_completed(tmp_path):
    values = np.full(GRID.shape, 0.8, np.float32)
    values[:5] = np.nan
    write_raster(tmp_path / "albedo.tif", values, GRID, "albedo")
    albedo, photometry = read_known(tmp_path / "albedo.tif", None, GRID, [])
    assert photometry is None
    np.testing.assert_array_equal(albedo, np.float32(0.8))


def test_albedo_of_another_place_is_refused(tmp_path):
    elsewhere = grid_from_bounds((9000, 0, 9800, 600), 20.0, GRID.crs, MOON)
    write_raster(tmp_path / "albedo.tif", np.ones(elsewhere.shape), elsewhere, "albedo")
    with pytest.raises(InputError, match="no positive albedo"):
        read_known(tmp_path / "albedo.tif", None, GRID, [])
