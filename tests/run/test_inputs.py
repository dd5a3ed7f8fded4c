"""One terrain, one grid, many images: what is chosen, and why an image is left out."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from affine import Affine
from pyproj import CRS

from lommel.errors import InputError
from lommel.io.raster import write_raster
from lommel.run.inputs import GridSettings, SceneFiles, choose_grid, read_heights, read_scene
from lommel.scene.body import MOON, to_xyz
from lommel.scene.grid import Grid, Window, grid_from_bounds, metres_per_unit, read_crs

METRE = 1e-3  # m, float32 of heights up to some hundreds
CYLINDRICAL = read_crs("+proj=eqc +R=1737400 +units=m +type=crs")
GEOGRAPHIC = read_crs("IAU_2015:30100")
NORTH_POLE = read_crs("+proj=stere +lat_0=90 +R=1737400 +units=m +type=crs")
DEM = grid_from_bounds((0.0, 0.0, 8e3, 6e3), 200.0, CYLINDRICAL)
IMAGE = grid_from_bounds((2e3, 1e3, 11e3, 5e3), 100.0, CYLINDRICAL)


def plane(grid):
    longitude, latitude = np.degrees(grid.lonlat())
    return 1000.0 * longitude + 300.0 * latitude


def position(height):
    return to_xyz(MOON, 0.3 if height > 1e9 else 0.0, 0.0, height)


@pytest.fixture
def world(tmp_path):
    """A folder with a DEM, two images and their tables; returns a function that adds images."""

    def add(name, grid=IMAGE, value=120.0):
        write_raster(tmp_path / name, np.full(grid.shape, value), grid, "brightness")
        return tmp_path / name

    write_raster(tmp_path / "dem.tif", plane(DEM), DEM, "height", "m")
    images = add("a.tif"), add("b.tif")
    for name, height in (("sun", 1.5e11), ("craft", 1.1e5)):
        xyz = " ".join(repr(float(value)) for value in position(height))
        (tmp_path / f"{name}.txt").write_text("".join(f"{key} {xyz}\n" for key in "abcd"))
    files = SceneFiles(
        images, (tmp_path / "dem.tif",), tmp_path / "sun.txt", tmp_path / "craft.txt"
    )
    return SimpleNamespace(add=add, files=files, folder=tmp_path)


def reasons(scene):
    return {skip.name: skip.reason for skip in scene.skipped}


def test_scene_holds_terrain_images_and_positions_on_one_grid(world):
    scene = read_scene(world.files)
    assert scene.skipped == []
    assert [observation.name for observation in scene.observations] == ["a.tif", "b.tif"]
    inside = (slice(None), slice(0, -1))  # the last column lies beyond the DEM's last posts
    np.testing.assert_allclose(scene.heights[inside], plane(scene.grid)[inside], atol=METRE)
    for observation in scene.observations:
        assert observation.window == scene.grid.window
        assert (observation.measured == 120.0).all()
        np.testing.assert_allclose(observation.sun_position, position(1.5e11), rtol=1e-15)
        np.testing.assert_allclose(observation.spacecraft_position, position(1.1e5), rtol=1e-15)


@pytest.mark.parametrize("prefer", ["images", "dem"])
def test_products_cover_what_images_and_dem_share(world, prefer):
    grid = read_scene(world.files, prefer=prefer).grid
    assert grid.bounds == pytest.approx((2e3, 1e3, 8e3, 5e3))
    assert grid.affine.a == pytest.approx(100.0, rel=1e-9)


def test_posts_of_a_dem_that_is_fine_enough_are_kept():
    dem = grid_from_bounds((0.0, 0.0, 8e3, 6e3), 140.0, CYLINDRICAL)
    grid = choose_grid([IMAGE, IMAGE], [dem], GridSettings(), prefer="dem")
    assert grid.affine.a == 140.0
    row, col = dem.index_at(*grid.lonlat_at(0, 0))
    assert (row % 1, col % 1) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_posts_of_a_single_image_are_kept():
    shifted = replace(IMAGE, affine=IMAGE.affine @ Affine.translation(0.3, 0.4))
    grid = choose_grid([shifted], [DEM], GridSettings(), prefer="images")
    row, col = shifted.index_at(*grid.lonlat_at(0, 0))
    assert (row, col) == pytest.approx((round(float(row)), round(float(col))), abs=1e-6)


def test_posts_that_images_have_in_common_are_kept():
    """Far from the equator of this map a post is not as wide as it is high."""
    crs = read_crs("+proj=eqc +lat_ts=40 +R=1737400 +units=m +type=crs")
    mosaic = grid_from_bounds((0.0, 0.0, 60e3, 50e3), 100.0, crs)
    images = [mosaic.cut(Window(60, 200, 90, 80)), mosaic.cut(Window(20, 70, 100, 150))]
    grid = choose_grid(images, [mosaic], GridSettings())
    assert grid.is_same(mosaic.cut(Window(20, 70, 130, 210)))
    south_up = [replace(g, affine=g.affine @ Affine.scale(1, -1)) for g in images]
    assert choose_grid(south_up, [mosaic], GridSettings()).is_north_up
    moved = replace(images[1], affine=images[1].affine @ Affine.translation(0.5, 0))
    assert choose_grid([images[0], moved], [mosaic], GridSettings()).offset_in(mosaic) is None


def test_spacing_is_the_median_of_the_images():
    grids = [grid_from_bounds(IMAGE.bounds, spacing, CYLINDRICAL) for spacing in (80, 100, 400)]
    grid = choose_grid(grids, [DEM], GridSettings())
    assert grid.affine.a == pytest.approx(100.0, rel=1e-5)


def test_spacing_crs_and_bounds_are_obeyed():
    settings = GridSettings(303.0, "IAU_2015:30100", (0.05, 0.05, 0.15, 0.1))
    grid = choose_grid([IMAGE], [DEM], settings)
    assert grid.crs.is_geographic
    assert grid.affine.a * metres_per_unit(GEOGRAPHIC) == pytest.approx(303.0)
    xmin, ymin, xmax, ymax = grid.bounds
    assert xmin <= 0.05 < 0.15 <= xmax
    assert ymin <= 0.05 < 0.1 <= ymax


@pytest.mark.parametrize("first", [-180.0, 0.0])
def test_global_dem_in_degrees_meets_images_west_of_greenwich(first):
    """A DEM from 0 to 360 degrees and images at -10 degrees were found to share nothing."""
    dem = Grid((180, 360), Affine(1, 0, first, 0, -1, 90), GEOGRAPHIC)
    images = [Grid((20, 20), Affine(0.1, 0, west, 0, -0.1, 5), GEOGRAPHIC) for west in (-11, -10)]
    grid = choose_grid(images, [dem], GridSettings())
    assert grid.bounds == pytest.approx((-11.0, 3.0, -8.0, 5.0), abs=0.21)  # rounded to posts


def test_global_dem_meets_images_of_the_pole():
    """A corner that the polar projection does not reach made the area empty."""
    dem = Grid((180, 360), Affine(1, 0, 0, 0, -1, 90), GEOGRAPHIC)
    image = Grid((30, 40), Affine(1e3, 0, -2e4, 0, -1e3, 1e4), NORTH_POLE)
    grid = choose_grid([image, image], [dem], GridSettings())
    assert grid.bounds == pytest.approx(image.bounds, abs=1e3)


def test_heights_are_the_mean_where_tiles_overlap(tmp_path):
    west, east = DEM.cut(Window(0, 0, 30, 25)), DEM.cut(Window(0, 15, 30, 25))
    write_raster(tmp_path / "w.tif", np.full(west.shape, 10.0), west, "height", "m")
    hole = np.full(east.shape, 30.0)
    hole[5, 3] = np.nan
    write_raster(tmp_path / "e.tif", hole, east, "height", "m")
    heights = read_heights([tmp_path / "w.tif", tmp_path / "e.tif"], DEM)
    assert (heights[:, :15] == 10.0).all()
    assert (heights[:, 25:] == 30.0).all()
    overlap = heights[:, 15:25]
    assert overlap[5, 3] == 10.0  # only one tile knows the post
    assert (np.delete(overlap.ravel(), 5 * 10 + 3) == 20.0).all()


def test_hole_of_the_dem_is_unknown_height(world):
    heights = plane(DEM)
    heights[12:16, 20:26] = np.nan
    write_raster(world.folder / "dem.tif", heights, DEM, "height", "m")
    scene = read_scene(world.files)
    share = np.isnan(scene.heights).mean() * scene.heights.size / 4  # posts of the DEM, 2 x 2 each
    assert share == pytest.approx(24, abs=1)


# --- Images that are left out ---------------------------------------------------------------------


def leave_out(world, path):
    """Reason for leaving out one image while the run goes on with the others."""
    scene = read_scene(replace(world.files, images=(*world.files.images, path)))
    assert [observation.name for observation in scene.observations] == ["a.tif", "b.tif"]
    assert list(reasons(scene)) == [path.name]
    return reasons(scene)[path.name]


def test_image_elsewhere_is_left_out(world):
    far = grid_from_bounds((9e5, 1e3, 9.05e5, 5e3), 100.0, CYLINDRICAL)
    assert leave_out(world, world.add("c.tif", far)) == "c.tif does not overlap the DEM."


def test_image_without_an_entry_in_a_table_is_left_out(world):
    reason = leave_out(world, world.add("x.tif"))
    assert "sun.txt has no entry for x.tif. Add a line KEY x y z" in reason


def test_image_over_holes_only_is_left_out(world):
    heights = plane(DEM)
    heights[:, 25:] = np.nan
    write_raster(world.folder / "dem.tif", heights, DEM, "height", "m")
    east = grid_from_bounds((6e3, 1e3, 7.5e3, 5e3), 100.0, CYLINDRICAL)
    reason = leave_out(world, world.add("c.tif", east))
    assert reason == "c.tif has no valid pixel where the DEM is known."


@pytest.mark.parametrize("value", [0, 255])
def test_image_all_black_or_all_white_is_left_out(world, value):
    path = world.folder / "c.tif"
    write_raster(path, np.full(IMAGE.shape, value, np.uint8), IMAGE, "brightness")
    assert "holds no brightness: all is shadow, clipped or no data" in leave_out(world, path)


def test_image_of_another_body_is_left_out(world):
    path = world.add("c.tif", replace(IMAGE, crs=CRS.from_user_input("IAU_2015:49900")))
    assert "radius of 3396.2 km, the Moon has 1737.4 km" in leave_out(world, path)


def test_damaged_image_is_left_out(world):
    noise = np.random.default_rng(0).uniform(1, 200, IMAGE.shape)
    path = world.folder / "c.tif"
    write_raster(path, noise, IMAGE, "brightness")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    assert "c.tif cannot be" in leave_out(world, path)


def test_missing_image_is_left_out(world):
    reason = leave_out(world, world.folder / "c.tif")
    assert "c.tif cannot be opened as a raster: there is no such file" in reason


# --- Requests that cannot work --------------------------------------------------------------------


def refused(world, message, settings=None, **changes):
    with pytest.raises(InputError, match=message):
        read_scene(replace(world.files, **changes), settings)


def test_run_without_a_usable_image_lists_the_reasons(world):
    far = grid_from_bounds((9e5, 1e3, 9.05e5, 5e3), 100.0, CYLINDRICAL)
    images = tuple(world.add(f"far{k:02}.tif", far) for k in range(23))
    refused(
        world,
        r"No image can be used\.\n  far00\.tif does not overlap the DEM\.\n(?s:.*)and 3 more",
        images=images,
    )


def test_duplicate_names_are_refused(world):
    (world.folder / "other").mkdir()
    again = world.folder / "other" / "a.tif"
    again.write_bytes((world.folder / "a.tif").read_bytes())
    refused(
        world,
        r"a\.tif given more than once\. File names are the images' names",
        images=(*world.files.images, again),
    )


def test_empty_lists_are_refused(world):
    refused(world, "No image given. Name at least one image file", images=())
    refused(world, "No DEM given. Name at least one with --dem", dems=())


def test_missing_tables_are_refused(world):
    refused(world, "No sun positions given.*--sun-positions", sun_positions=None)
    refused(world, "No spacecraft positions given", spacecraft_positions=None)
    refused(world, r"nowhere\.txt cannot be read", sun_positions=world.folder / "nowhere.txt")


def test_dem_that_cannot_be_placed_is_refused(world):
    refused(world, "there is no such file", dems=(world.folder / "nowhere.tif",))
    nowhere = replace(DEM, crs=SimpleNamespace(to_wkt=lambda: None))
    write_raster(world.folder / "dem.tif", plane(DEM), nowhere, "height", "m")
    refused(world, r"dem\.tif has no CRS or no transform.*gdal_edit\.py")


def test_dem_without_a_height_is_refused(world):
    write_raster(world.folder / "dem.tif", np.full(DEM.shape, np.nan), DEM, "height", "m")
    refused(world, "The DEM has no height inside the output grid. Check --bounds")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (GridSettings(bounds=(9e6, 0.0, 9.1e6, 1e4)), "has no height inside the output grid"),
        (GridSettings(bounds=(2e3, 1e3, 1e3, 5e3)), "are empty or not finite"),
        (GridSettings(spacing=0.0), "spacing = 0.0 is not a post spacing"),
        (GridSettings(spacing=-5.0), "spacing = -5.0 is not a post spacing"),
        (GridSettings(spacing=0.01), "would have 400000 x .* Give a larger --spacing"),
        (GridSettings(bounds=(3e3, 2e3, 4e3, 2.1e3)), "would have 1 x 10 posts; a slope needs 2"),
        (GridSettings(crs="EPSG:4326"), "--crs: the CRS 'WGS 84' has a radius of 6378.1 km"),
        (GridSettings(crs="moonish"), "--crs: 'moonish' is not a CRS"),
    ],
)
def test_grid_that_cannot_be_made_is_refused(world, settings, message):
    refused(world, message, settings)
