"""Grids: places of posts, windows, footprints, and the CRSs they accept."""

from dataclasses import replace

import numpy as np
import pytest
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st

from lommel.errors import GeometryError, InputError
from lommel.scene.body import MOON
from lommel.scene.grid import (
    Grid,
    Window,
    bounds_in,
    grid_from_bounds,
    metres_per_unit,
    read_crs,
)

POST = 1e-6  # posts, a micrometre to a millimetre on the ground
METRES_PER_DEGREE = np.pi * MOON.radius / 180

SPHERE = "+R=1737400 +units=m +type=crs"
GEOGRAPHIC = read_crs("IAU_2015:30100")
CYLINDRICAL = read_crs(f"+proj=eqc {SPHERE}")
NORTH_POLE = read_crs(f"+proj=stere +lat_0=90 {SPHERE}")
SOUTH_POLE = read_crs(f"+proj=stere +lat_0=-90 {SPHERE}")
ORTHOGRAPHIC = read_crs(f"+proj=ortho +lat_0=10 +lon_0=20 {SPHERE}")

GRIDS = {
    "geographic": Grid((40, 60), Affine(0.1, 0, 20, 0, -0.1, 5), GEOGRAPHIC),
    "cylindrical": Grid((40, 60), Affine(500, 0, 3e4, 0, -500, 7e4), CYLINDRICAL),
    "south pole": Grid((50, 70), Affine(900, 0, -3e4, 0, -900, 2e4), SOUTH_POLE),
    "orthographic": Grid((40, 40), Affine(700, 0, -1e4, 0, -700, 1e4), ORTHOGRAPHIC),
    "turned": Grid((30, 30), Affine.rotation(30) @ Affine.scale(400, -400), CYLINDRICAL),
}

windows = st.builds(
    Window,
    st.integers(-50, 50),
    st.integers(-50, 50),
    st.integers(0, 60),
    st.integers(0, 60),
)


@given(windows, windows)
def test_intersection_holds_the_posts_of_both(one, other):
    canvas = np.zeros((2, 200, 200), bool)
    for plane, window in zip(canvas, (one, other), strict=True):
        plane[window.relative_to(Window(-50, -50, 0, 0)).slices] = True
    both = one.intersection(other)
    expected = canvas.all(axis=0)
    assert both.is_empty == (not expected.any())
    assert both.rows * both.cols == expected.sum()
    if not both.is_empty:
        assert expected[both.relative_to(Window(-50, -50, 0, 0)).slices].all()


@pytest.mark.parametrize("name", GRIDS)
def test_index_returns_from_longitude_and_latitude(name):
    grid = GRIDS[name]
    row, col = np.random.default_rng(3).uniform(-5, 60, (2, 40))
    found = grid.index_at(*grid.lonlat_at(row, col))
    np.testing.assert_allclose(found, (row, col), rtol=0, atol=POST)


def test_first_post_stands_at_the_centre_of_the_first_pixel():
    longitude, latitude = np.degrees(GRIDS["geographic"].lonlat_at(0, 0))
    assert longitude == pytest.approx(20.05)
    assert latitude == pytest.approx(4.95)


def test_lonlat_of_all_posts_equals_lonlat_of_each():
    grid = GRIDS["turned"]
    longitude, latitude = grid.lonlat()
    there = grid.lonlat_at(7, 11)
    assert (longitude[7, 11], latitude[7, 11]) == pytest.approx(there, abs=1e-15)


@pytest.mark.parametrize("name", GRIDS)
def test_spacing_is_the_distance_of_neighbouring_posts(name):
    grid = GRIDS[name]
    row, col = (grid.shape[0] - 1) // 2, (grid.shape[1] - 1) // 2
    xyz = grid.xyz(np.zeros(grid.shape))
    down = np.linalg.norm(xyz[row + 1, col] - xyz[row, col])
    right = np.linalg.norm(xyz[row, col + 1] - xyz[row, col])
    assert grid.spacing == pytest.approx((down, right), rel=2e-3)  # the posts beside the middle


def test_spacing_along_a_parallel_shrinks_with_the_cosine_of_latitude():
    grid = Grid((3, 3), Affine(0.01, 0, 0, 0, -0.01, 60.015), GEOGRAPHIC)
    expected = 0.01 * METRES_PER_DEGREE
    assert grid.spacing == pytest.approx((expected, expected / 2), rel=1e-6)


def test_cut_keeps_the_posts_in_place():
    grid = GRIDS["turned"]
    part = grid.cut(Window(4, 9, 10, 6))
    assert part.shape == (10, 6)
    np.testing.assert_allclose(part.lonlat_at(2, 3), grid.lonlat_at(6, 12), rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", GRIDS)
def test_footprint_of_a_part_in_its_grid_is_that_part(name):
    grid = GRIDS[name]
    part = Window(5, 8, 12, 9)
    assert grid.cut(part).footprint(grid) == part


def test_footprint_holds_the_posts_whose_pixels_are_touched():
    grid = GRIDS["cylindrical"]
    small = grid_from_bounds((30_600.0, 60_100.0, 31_400.0, 60_900.0), 100.0, CYLINDRICAL)
    assert small.footprint(grid) == Window(18, 1, 2, 2)


@pytest.mark.parametrize("name", GRIDS)
def test_a_part_of_a_grid_knows_its_place_there(name):
    grid = GRIDS[name]
    part = grid.cut(Window(3, 5, 20, 11))
    assert part.place_in(grid) == Window(3, 5, 20, 11)
    assert grid.offset_in(part) == (-3, -5)
    assert grid.place_in(part) is None  # it reaches beyond


def test_posts_that_do_not_coincide_have_no_place():
    grid = GRIDS["cylindrical"]
    moved = replace(grid, affine=grid.affine @ Affine.translation(0.3, 0))
    wider = replace(grid, affine=grid.affine @ Affine.scale(1.001))  # 0.06 posts at the far end
    turned = replace(grid, affine=grid.affine @ Affine.rotation(0.1))
    elsewhere = replace(grid, crs=GEOGRAPHIC)
    assert {g.offset_in(grid) for g in (moved, wider, turned, elsewhere)} == {None}


def test_parts_of_a_window_cover_it_once():
    window = Window(2, 3, 10, 7)
    seen = np.zeros((15, 12), int)
    for part in window.parts(4, 3):
        seen[part.slices] += 1
    assert seen[window.slices].min() == 1 and seen.sum() == 70
    assert [part.shape for part in window.parts(6)] == [(6, 7), (4, 7)]


def test_footprint_of_a_grid_elsewhere_is_empty():
    far = Grid((40, 60), Affine(0.1, 0, -100, 0, -0.1, 60), GEOGRAPHIC)
    assert far.footprint(GRIDS["geographic"]).is_empty
    assert GRIDS["geographic"].footprint(far).is_empty


def test_meridians_written_360_degrees_away_are_the_same():
    east = Grid((40, 60), Affine(0.1, 0, -10, 0, -0.1, 5), GEOGRAPHIC)
    west = Grid((40, 60), Affine(0.1, 0, 350, 0, -0.1, 5), GEOGRAPHIC)
    assert east.is_same(west)
    assert east.footprint(west) == west.window


@pytest.mark.parametrize("crs", [GEOGRAPHIC, CYLINDRICAL])
def test_grid_over_the_pole_covers_every_longitude_of_a_global_grid(crs):
    """Only the edge of the polar grid was looked at, so the ground at the pole was left out."""
    step = 0.1 if crs is GEOGRAPHIC else 0.1 * METRES_PER_DEGREE
    world = Grid((1800, 3600), Affine(step, 0, -1800 * step, 0, -step, 900 * step), crs)
    window = GRIDS["south pole"].footprint(world)
    assert window.row + window.rows == 1800
    assert window.cols == 3600


@pytest.mark.parametrize("name", GRIDS)
def test_global_grid_covers_every_local_one(name):
    """A corner beyond the projection's reach made the whole globe count as elsewhere."""
    world = Grid((180, 360), Affine(1, 0, 0, 0, -1, 90), GEOGRAPHIC)
    local = GRIDS[name]
    assert world.footprint(local) == local.window


def test_grid_the_projection_does_not_reach_has_no_footprint():
    behind = Grid((10, 10), Affine(1, 0, -165, 0, -1, -5), GEOGRAPHIC)
    assert behind.footprint(GRIDS["orthographic"]).is_empty
    with pytest.raises(GeometryError, match="does not reach"):
        bounds_in(behind, ORTHOGRAPHIC)


@pytest.mark.parametrize("name", GRIDS)
def test_bounds_in_the_own_crs_are_the_outer_edges(name):
    grid = GRIDS[name]
    np.testing.assert_allclose(bounds_in(grid, grid.crs), grid.bounds, rtol=1e-12, atol=1e-6)


def test_bounds_of_a_polar_grid_reach_the_pole():
    west, south, east, north = bounds_in(GRIDS["south pole"], GEOGRAPHIC)
    assert south == pytest.approx(-90.0)
    assert (west, east) == pytest.approx((-180.0, 180.0))
    assert -89.0 < north < -88.0


def test_same_grid_through_a_geotiff_is_the_same():
    grid = GRIDS["south pole"]
    written = Grid(grid.shape, grid.affine, read_crs(grid.crs.to_wkt("WKT1_GDAL")))
    assert grid.is_same(written)
    assert not grid.is_same(grid.cut(Window(0, 1, *grid.shape)))
    assert not grid.is_same(grid.cut(Window(0, 0, 10, 10)))


@settings(max_examples=50)
@given(
    st.tuples(*[st.floats(-1e6, 1e6)] * 2),
    st.tuples(*[st.floats(1.0, 1e5)] * 2),
    st.floats(0.5, 5e3),
)
def test_grid_from_bounds_covers_them_with_less_than_a_post_to_spare(corner, size, spacing):
    bounds = (*corner, corner[0] + size[0], corner[1] + size[1])
    xmin, ymin, xmax, ymax = grid_from_bounds(bounds, spacing, CYLINDRICAL).bounds
    slack = np.array([bounds[0] - xmin, bounds[1] - ymin, xmax - bounds[2], ymax - bounds[3]])
    assert (slack > -1e-5 * spacing).all()
    assert (slack < 1.001 * spacing).all()


def test_spacing_in_metres_holds_in_degrees_too():
    grid = grid_from_bounds((10.0, -1.0, 12.0, 1.0), 303.0, GEOGRAPHIC)
    assert grid.spacing == pytest.approx((303.0, 303.0), rel=1e-4)
    assert metres_per_unit(GEOGRAPHIC) == pytest.approx(METRES_PER_DEGREE)
    assert metres_per_unit(CYLINDRICAL) == 1.0


@pytest.mark.parametrize(
    "bounds", [(1, 0, 1, 2), (0, 3, 1, 2), (np.nan, 0, 1, 2), (0, 0, np.inf, 2)]
)
def test_bounds_that_hold_no_area_are_an_error(bounds):
    with pytest.raises(InputError, match=r"are empty or not finite\. Give xmin ymin xmax ymax"):
        grid_from_bounds(bounds, 10.0, CYLINDRICAL)


@pytest.mark.parametrize("spacing", [0.0, -5.0, np.nan, np.inf, 1e-300])
def test_spacing_that_is_no_length_is_an_error(spacing):
    with pytest.raises(InputError, match="is not a post spacing. Give metres"):
        grid_from_bounds((0, 0, 1e3, 1e3), spacing, CYLINDRICAL)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EPSG:4326", r"radius of 6378\.1 km, the Moon has 1737\.4 km\. Use rasters of one body"),
        ("IAU_2015:49900", r"radius of 3396\.2 km"),
        ("moonish", r"--crs: 'moonish' is not a CRS\. Give WKT, PROJ text or an authority code"),
        ("", "is not a CRS"),
        ('LOCAL_CS["plan",UNIT["metre",1]]', "has no reference body. Assign a Moon CRS"),
    ],
)
def test_unusable_crs_is_an_error(text, message):
    with pytest.raises(InputError, match=message):
        read_crs(text, source="--crs")


@pytest.mark.parametrize("radius", [1735.0e3, 1737.4e3, 1738.1e3])
def test_every_lunar_radius_in_use_passes(radius):
    assert read_crs(f"+proj=longlat +R={radius} +type=crs").is_geographic
