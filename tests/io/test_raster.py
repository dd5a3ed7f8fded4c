"""Rasters in and out: what is missing, how grids meet, what a damaged file says."""

import resource

import numpy as np
import pytest
import rasterio
from affine import Affine
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import netcdf_file

from lommel.errors import InputError, LommelError
from lommel.io.raster import (
    raster_info,
    read_grid,
    read_image_on_grid,
    read_on_grid,
    read_pixels,
    write_raster,
)
from lommel.scene.grid import Grid, Window, grid_from_bounds, read_crs

FLOAT32 = 2e-7  # relative, one float32 step
GEOGRAPHIC = read_crs("IAU_2015:30100")
CYLINDRICAL = read_crs("+proj=eqc +R=1737400 +units=m +type=crs")
STEREOGRAPHIC = read_crs("+proj=stere +lat_0=0.5 +lon_0=0.8 +R=1737400 +units=m +type=crs")
GRID = grid_from_bounds((0.0, 0.0, 40e3, 30e3), 500.0, CYLINDRICAL)


def height(grid):
    """A height that is smooth and the same in every CRS, m."""
    longitude, latitude = np.degrees(grid.lonlat())
    return 300 * np.sin(3 * longitude) + 200 * latitude + 50 * longitude * latitude


def write_plain(path, values, grid=GRID, **changes):
    """A GeoTIFF as other programs write it."""
    values = np.atleast_3d(values) if np.ndim(values) == 3 else np.asarray(values)[None]
    profile = {
        "driver": "GTiff",
        "count": values.shape[0],
        "height": values.shape[1],
        "width": values.shape[2],
        "dtype": values.dtype,
        "crs": grid.crs.to_wkt(),
        "transform": grid.affine,
    }
    with rasterio.open(path, "w", **(profile | changes)) as file:
        file.write(values)
    return path


@pytest.mark.parametrize("crs", [GEOGRAPHIC, CYLINDRICAL, STEREOGRAPHIC])
def test_written_raster_returns_with_place_hole_unit_and_description(tmp_path, crs):
    bounds = (0.0, 0.0, 0.5, 0.3) if crs is GEOGRAPHIC else (-8e3, -5e3, 8e3, 7e3)
    grid = grid_from_bounds(bounds, 500.0, crs)
    values = height(grid)
    values[3, 4] = np.nan
    write_raster(tmp_path / "a.tif", values, grid, "height", "m")
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.tif"), values.astype(np.float32))
    assert read_grid(tmp_path / "a.tif").is_same(grid)
    with rasterio.open(tmp_path / "a.tif") as file:
        assert (file.descriptions[0], file.units[0]) == ("height", "m")
        assert np.isnan(file.nodata)
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]


def test_integers_are_stored_as_they_are(tmp_path):
    count = np.arange(np.prod(GRID.shape), dtype=np.uint16).reshape(GRID.shape)
    write_raster(tmp_path / "count.tif", count, GRID, "images used")
    info = raster_info(tmp_path / "count.tif")
    assert (info.dtype, info.nodata, info.bands) == ("uint16", None, 1)
    np.testing.assert_array_equal(read_pixels(tmp_path / "count.tif"), count)


def test_part_of_a_raster_is_that_part(tmp_path):
    path = write_plain(tmp_path / "a.tif", height(GRID).astype("f4"))
    window = Window(7, 11, 20, 13)
    np.testing.assert_array_equal(read_pixels(path, window), read_pixels(path)[window.slices])


def nodata_file(path, values):
    return write_plain(path, np.where(np.isnan(values), -32768, values).astype("i2"), nodata=-32768)


def double_nodata_file(path, values):
    lowest = np.finfo("f8").min
    return write_plain(path, np.where(np.isnan(values), lowest, values), nodata=lowest)


def second_band_file(path, values):
    bands = np.stack([np.nan_to_num(values), 255.0 * np.isfinite(values)]).astype("u1")
    return write_plain(path, bands, nodata=None)


def alpha_band_file(path, values):
    bands = np.stack([np.nan_to_num(values), 65535.0 * np.isfinite(values)]).astype("u2")
    return write_plain(path, bands, alpha="YES")


def nan_file(path, values):
    return write_plain(path, values.astype("f4"))


def isis_special_file(path, values):
    return write_plain(path, np.where(np.isnan(values), -3.4028226e38, values).astype("f4"))


def internal_mask_file(path, values):
    write_plain(path, np.nan_to_num(values).astype("u1"))
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as file:
        file.write_mask(np.isfinite(values))
    return path


@pytest.mark.parametrize(
    "write",
    [
        nodata_file,
        double_nodata_file,
        second_band_file,
        alpha_band_file,
        nan_file,
        isis_special_file,
        internal_mask_file,
    ],
)
def test_every_way_to_mark_a_missing_pixel_is_nan(tmp_path, write):
    values = np.random.default_rng(1).integers(1, 200, GRID.shape).astype(float)
    values[5:9, 6:20] = np.nan
    np.testing.assert_array_equal(read_pixels(write(tmp_path / "a.tif", values)), values)


def test_second_band_of_data_is_no_mask(tmp_path):
    bands = np.stack([height(GRID), 0 * height(GRID)]).astype("f4")
    path = write_plain(tmp_path / "a.tif", bands)
    assert not raster_info(path).has_mask_band
    assert np.isfinite(read_pixels(path)).all()


def test_scale_and_offset_of_the_file_are_applied(tmp_path):
    path = write_plain(tmp_path / "a.tif", np.full(GRID.shape, 100, "i2"))
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (0.5,), (1000.0,)
    assert (read_pixels(path) == 1050.0).all()


@pytest.mark.parametrize("crs", [GEOGRAPHIC, CYLINDRICAL, STEREOGRAPHIC])
def test_smooth_terrain_is_the_same_on_any_grid(tmp_path, crs):
    source = grid_from_bounds((0.0, 0.0, 1.6, 1.2), 500.0, GEOGRAPHIC)
    path = write_plain(tmp_path / "a.tif", height(source).astype("f4"), source)
    bounds = {GEOGRAPHIC: (0.3, 0.3, 1.2, 0.8), STEREOGRAPHIC: (-9e3, -9e3, 9e3, 8e3)}
    grid = grid_from_bounds(bounds.get(crs, (9e3, 9e3, 30e3, 25e3)), 410.0, crs)
    error = read_on_grid(path, grid) - height(grid)
    assert np.abs(error).max() < 0.01  # m, cubic interpolation of 300 m waves of 60 degrees


def test_posts_of_the_file_are_read_as_they_are(tmp_path):
    values = np.random.default_rng(1).normal(size=GRID.shape).astype("f4")
    values[12:14, 20] = np.nan
    path, window = write_plain(tmp_path / "a.tif", values), Window(7, 11, 20, 13)
    np.testing.assert_array_equal(read_on_grid(path, GRID.cut(window)), values[window.slices])


def test_finer_input_is_averaged(tmp_path):
    fine = Grid((240, 320), Affine(125, 0, 0, 0, -125, 30e3), CYLINDRICAL)
    values = np.random.default_rng(2).normal(size=fine.shape).astype("f4")
    path = write_plain(tmp_path / "a.tif", values, fine)
    means = values.reshape(60, 4, 80, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(read_on_grid(path, GRID), means, rtol=0, atol=1e-6)


@pytest.mark.parametrize("spacing", [400.0, 500.0, 2000.0])
def test_hole_keeps_its_place_and_does_not_leak(tmp_path, spacing):
    values = height(GRID).astype("f4")
    values[20:32, 20:40] = np.nan
    path = write_plain(tmp_path / "a.tif", values, nodata=np.nan)
    grid = grid_from_bounds((2e3, 2e3, 38e3, 28e3), spacing, CYLINDRICAL)
    found = read_on_grid(path, grid)
    row, col = GRID.index_at(*grid.lonlat())
    depth = np.minimum.reduce([row - 19.5, 31.5 - row, col - 19.5, 39.5 - col])  # posts, inside > 0
    reach = 0.5 * spacing / 500.0
    assert np.isnan(found[depth > reach]).all()
    assert np.isfinite(found[depth < -reach]).all()
    assert np.nanmax(np.abs(found - height(grid))) < 60.0  # m; a leaked 0 or nodata errs by more


def test_raster_elsewhere_has_nothing_on_the_grid(tmp_path):
    path = write_plain(tmp_path / "a.tif", height(GRID).astype("f4"))
    assert np.isnan(
        read_on_grid(path, grid_from_bounds((9e5, 0, 9.1e5, 1e4), 500.0, GRID.crs))
    ).all()


@pytest.mark.parametrize("west", [-4.0, 356.0])
def test_image_across_the_seam_of_a_global_dem_sees_it_sharp(tmp_path, west):
    """Across the 0/360 degree edge, GDAL took the image for the whole globe and blurred the DEM."""
    world = Grid((40, 720), Affine(0.5, 0, 0, 0, -0.5, 10), GEOGRAPHIC)
    longitude, latitude = world.lonlat()
    values = 1000 * np.sin(9 * longitude) + 0 * latitude
    path = write_plain(tmp_path / "dem.tif", values.astype("f4"), world)
    grid = grid_from_bounds((west, -4.0, west + 8.0, 4.0), 6e3, GEOGRAPHIC)
    expected = 1000 * np.sin(9 * grid.lonlat()[0]) + np.zeros(grid.shape)
    error = np.abs(read_on_grid(path, grid) - expected)
    half_pixel = 1000 * 9 * np.radians(0.25)  # m, the outermost pixels stand for their edges
    assert error.max() < 1.05 * half_pixel


def test_clipped_pixels_of_8_bit_images_are_unknown(tmp_path):
    values = np.random.default_rng(4).integers(1, 255, GRID.shape).astype("u1")
    values[3, 3], values[4, 8] = 0, 255
    path = write_plain(tmp_path / "a.tif", values)
    found = read_image_on_grid(path, GRID)
    assert list(map(tuple, np.argwhere(np.isnan(found)))) == [(3, 3), (4, 8)]
    assert raster_info(path).saturation == 255.0
    path = write_plain(tmp_path / "b.tif", values.astype("f4"))
    assert np.isfinite(read_image_on_grid(path, GRID)).all()
    assert raster_info(path).saturation == np.inf


@pytest.mark.parametrize(
    "changes",
    [
        {"crs": None},
        {"transform": Affine.identity()},
        {"crs": None, "transform": Affine.identity()},
    ],
)
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_raster_without_a_place_is_an_error_that_says_how_to_give_one(tmp_path, changes):
    path = write_plain(tmp_path / "a.tif", height(GRID).astype("f4"), **changes)
    assert raster_info(path).grid is None
    with pytest.raises(
        InputError, match=r"a\.tif has no CRS or no transform.*gdal_edit\.py -a_srs"
    ):
        read_grid(path)


def test_raster_of_another_body_is_an_error(tmp_path):
    path = write_plain(tmp_path / "a.tif", height(GRID).astype("f4"), crs="EPSG:4326")
    with pytest.raises(InputError, match=r"a\.tif: the CRS 'WGS 84' has a radius of 6378\.1 km"):
        raster_info(path)


def test_pixels_without_a_size_are_an_error(tmp_path):
    tiny = Affine(1e-9, 0, 0, 0, -1e-9, 0)
    path = write_plain(tmp_path / "a.tif", height(GRID).astype("f4"), transform=tiny)
    with pytest.raises(InputError, match=r"pixels of 1e-09 x 1e-09 m .* gdal_edit\.py -a_srs"):
        raster_info(path)


def test_complex_raster_is_an_error(tmp_path):
    path = write_plain(tmp_path / "a.tif", height(GRID).astype("c8"))
    with pytest.raises(InputError, match="band 1 is complex64. Give a raster of real numbers"):
        raster_info(path)


def test_file_that_only_lists_rasters_is_an_error(tmp_path):
    path = tmp_path / "two.nc"
    with netcdf_file(path, "w") as file:
        for name in ("x", "y"):
            file.createDimension(name, 5)
        for name in ("one", "other"):
            file.createVariable(name, "f4", ("y", "x"))[:] = 1.0
    with pytest.raises(InputError, match=r"two\.nc holds no band of its own. Name one"):
        raster_info(path)


def test_header_that_claims_the_moon_at_a_metre_is_not_believed(tmp_path):
    path = tmp_path / "a.tif"
    profile = {"driver": "GTiff", "height": 300_000, "width": 300_000, "count": 1, "dtype": "uint8"}
    with rasterio.open(
        path,
        "w",
        **profile,
        crs=GRID.crs.to_wkt(),
        transform=GRID.affine,
        sparse_ok=True,
        tiled=True,
        blockxsize=8192,
        blockysize=8192,
    ):
        pass
    with pytest.raises(InputError, match="the header claims 300000 x 300000 pixels"):
        raster_info(path)


def test_file_that_is_no_raster_is_an_error(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.tif cannot be opened .* there is no such file"):
        raster_info(tmp_path / "nowhere.tif")
    (tmp_path / "text.tif").write_text("not a raster")
    (tmp_path / "empty.tif").write_bytes(b"")
    for path in (tmp_path / "text.tif", tmp_path / "empty.tif", tmp_path):
        with pytest.raises(InputError, match="cannot be opened as a raster"):
            raster_info(path)


def test_raster_that_cannot_be_written_is_an_error_and_leaves_nothing(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "nowhere"):
        with pytest.raises(InputError, match=r"a\.tif cannot be written"):
            write_raster(folder / "a.tif", height(GRID), GRID, "height", "m")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_full_disk_is_an_error_and_leaves_nothing(tmp_path):
    """GDAL reported success and left a file that nothing could open."""
    noise = np.random.default_rng(5).normal(size=GRID.shape)
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limit[1]))
    try:
        with pytest.raises(
            InputError, match=r"a\.tif cannot be written: .*File too large; \d+\.\d MB of"
        ):
            write_raster(tmp_path / "a.tif", noise, GRID, "noise")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Folder of a compressed, tiled GeoTIFF and of a plain one."""
    folder = tmp_path_factory.mktemp("whole")
    write_raster(folder / "cog.tif", height(GRID), GRID, "height", "m")
    write_plain(folder / "plain.tif", height(GRID).astype("f4"))
    return folder


PLACES = st.one_of(st.integers(0, 600), st.integers(0, 30_000))  # the header, or anywhere


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # GDAL's own log
@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.sampled_from(["cog.tif", "plain.tif"]),
    st.lists(st.tuples(PLACES, st.integers(0, 255)), max_size=4),
    st.one_of(st.none(), PLACES),
)
def test_damaged_raster_is_read_or_is_an_error(tmp_path, whole, which, changes, cut):
    """Cut anywhere, with a few bytes changed: only our own errors may come out."""
    content = bytearray((whole / which).read_bytes())
    for place, value in changes:
        content[place % len(content)] = value
    if cut is not None:
        del content[cut % len(content) :]
    path = tmp_path / "damaged.tif"
    path.write_bytes(content)
    try:
        values = read_on_grid(path, GRID)
    except LommelError as error:
        assert "damaged.tif" in str(error)  # noqa: PT017
        return
    assert values.shape == GRID.shape
