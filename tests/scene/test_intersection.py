import numpy as np
import pytest

from lommel.errors import InputError
from lommel.scene.body import MOON, local_frame, to_lonlat, to_xyz, up_vector
from lommel.scene.camera import FrameCamera, nadir_rotation
from lommel.scene.grid import grid_from_bounds, read_crs
from lommel.scene.intersection import meet_ellipsoid, meet_sphere, meet_terrain

MILLIMETRE = 1e-3
LONGITUDE, LATITUDE = np.radians(3.0), np.radians(26.0)


@pytest.fixture(scope="module")
def grid():
    crs = read_crs("+proj=stere +lat_0=26 +lon_0=3 +R=1737400 +units=m")
    return grid_from_bounds((-10e3, -10e3, 10e3, 10e3), 50.0, crs)


def ray_to(point, elevation_deg, azimuth=0.0, distance=200e3):
    """Origin and direction of a ray that comes down to a point."""
    longitude, latitude, _ = to_lonlat(MOON, point)
    east, north, up = local_frame(longitude, latitude)
    elevation = np.radians(elevation_deg)
    level = np.cos(azimuth) * east + np.sin(azimuth) * north
    away = np.cos(elevation) * level + np.sin(elevation) * up
    return point + distance * away, -away


def points_on(grid, heights, count):
    """Points between posts of a terrain, away from its edge, and their bilinear heights."""
    random = np.random.default_rng(5)
    row, col = random.uniform(40, np.array(grid.shape)[:, None] - 41, (2, count))
    i, j = row.astype(int), col.astype(int)
    v, h = row - i, col - j
    height = (1 - v) * ((1 - h) * heights[i, j] + h * heights[i, j + 1])
    height += v * ((1 - h) * heights[i + 1, j] + h * heights[i + 1, j + 1])
    return to_xyz(MOON, *grid.lonlat_at(row, col), height)


def hills(grid):
    """Rolling hills, slopes below 20 degrees."""
    row, col = np.indices(grid.shape) * 50.0
    return 200.0 * np.sin(row / 900.0) * np.cos(col / 700.0)


def test_ray_meets_a_sphere_where_it_was_aimed():
    point = 1737.4e3 * up_vector(LONGITUDE, LATITUDE)
    for elevation_deg in (90.0, 30.0, 0.5):
        found = meet_sphere(*ray_to(point, elevation_deg), MOON.radius)
        # a millimetre of height is a hundred times farther along a ray at half a degree
        np.testing.assert_allclose(found, point, rtol=0, atol=MILLIMETRE)


def test_sphere_is_met_to_the_millimetre_from_the_earth():
    point = 1737.4e3 * up_vector(LONGITUDE, LATITUDE)
    found = meet_sphere(*ray_to(point, 60.0, distance=3.8e8), MOON.radius)
    np.testing.assert_allclose(found, point, rtol=0, atol=MILLIMETRE)


def test_rays_that_pass_by_or_look_away_meet_nothing():
    origin = np.array([2.0, 0.0, 0.0])
    directions = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    assert np.isnan(meet_sphere(origin, directions, 1.0)).all()


def test_ray_from_inside_meets_the_far_side():
    assert meet_sphere([0.5, 0.0, 0.0], [1.0, 0.0, 0.0], 1.0).tolist() == [1.0, 0.0, 0.0]


def test_ellipsoid_is_met_on_its_surface_before_its_far_side():
    radii = np.array([3396.19e3, 3396.19e3, 3376.2e3])
    random = np.random.default_rng(0)
    target = random.normal(size=(200, 3)) * 1e6
    origin = 4e6 * np.array([1.0, 0.5, 0.7])
    direction = (target - origin) / np.linalg.norm(target - origin, axis=1)[:, None]
    found = meet_ellipsoid(origin, direction, radii)
    found = found[np.isfinite(found).all(axis=1)]
    assert len(found) > 150
    on_surface = np.sum((found / radii) ** 2, axis=1)
    np.testing.assert_allclose(on_surface, 1.0, rtol=0, atol=1e-13)
    facing = np.einsum("ij,ij->i", found / radii**2, origin - found)
    assert (facing > 0).all()


def test_level_terrain_is_a_sphere(grid):
    point = points_on(grid, np.full(grid.shape, 700.0), 50)
    origin, direction = ray_to(point, 35.0)
    found = meet_terrain(origin, direction, grid, np.full(grid.shape, 700.0))
    expected = meet_sphere(origin, direction, MOON.radius + 700.0)
    np.testing.assert_allclose(found, expected, rtol=0, atol=MILLIMETRE)


@pytest.mark.parametrize("elevation_deg", [90.0, 60.0, 25.0])
def test_ray_meets_hills_where_it_was_aimed(grid, elevation_deg):
    """Slopes stay below the elevation, so nothing stands between camera and point."""
    heights = hills(grid)
    point = points_on(grid, heights, 400)
    for azimuth in (0.0, 2.0, 4.5):
        found = meet_terrain(*ray_to(point, elevation_deg, azimuth), grid, heights)
        np.testing.assert_allclose(found, point, rtol=0, atol=MILLIMETRE)


@pytest.mark.parametrize("elevation_deg", [8.0, 2.0, 0.3])
def test_grazing_ray_meets_the_first_terrain_in_its_way(grid, elevation_deg):
    heights = hills(grid)
    point = points_on(grid, heights, 300)
    origin, direction = ray_to(point, elevation_deg)
    found = meet_terrain(origin, direction, grid, heights)
    known = np.isfinite(found).all(axis=1)
    assert known.sum() > 50
    ahead = np.einsum("ij,ij->i", point - found, direction)[known]
    assert (ahead > -0.01).all()  # m; on the point or before it
    for share in np.linspace(0.02, 0.98, 25):  # the way from the grid's edge is clear
        on_way = found[known] - (1 - share) * 8e3 * direction[known]
        longitude, latitude, height = to_lonlat(MOON, on_way)
        row, col = grid.index_at(longitude, latitude)
        inside = (row > 0) & (col > 0) & (row < grid.shape[0] - 1) & (col < grid.shape[1] - 1)
        terrain = 200.0 * np.sin(row * 50 / 900.0) * np.cos(col * 50 / 700.0)
        assert (height[inside] > terrain[inside] - 0.2).all()  # m, bilinear against smooth


def test_wall_hides_the_plain_behind_it(grid):
    heights = np.zeros(grid.shape)
    heights[:, 250:252] = 500.0  # seen from the east at 45 degrees
    point = to_xyz(MOON, *grid.lonlat_at(200.0, 244.0), 0.0)
    found = meet_terrain(*ray_to(point, 45.0), grid, heights)
    _, col = grid.index_at(*to_lonlat(MOON, found)[:2])
    assert 250.0 < col < 252.0


def test_unknown_terrain_is_not_met(grid):
    heights = np.zeros(grid.shape)
    heights[180:220, 180:220] = np.nan
    into_hole = to_xyz(MOON, *grid.lonlat_at(200.0, 200.0), 0.0)
    beside_grid = to_xyz(MOON, *grid.lonlat_at(200.0, 500.0), 0.0)
    for point in (into_hole, beside_grid):
        assert np.isnan(meet_terrain(*ray_to(point, 70.0), grid, heights)).all()


def test_ray_that_comes_from_under_the_edge_is_not_believed(grid):
    """It would have met terrain beyond the grid; the inside of a hill is no answer."""
    heights = np.full(grid.shape, 1000.0)
    heights[200, 200] = -1000.0
    edge = to_xyz(MOON, *grid.lonlat_at(200.0, grid.shape[1] - 1.0), 300.0)
    assert np.isnan(meet_terrain(*ray_to(edge, 30.0), grid, heights)).all()


def test_terrain_without_any_height_is_nowhere(grid):
    point = points_on(grid, np.zeros(grid.shape), 3)
    empty = np.full(grid.shape, np.nan)
    assert np.isnan(meet_terrain(*ray_to(point, 50.0), grid, empty)).all()


def test_camera_sees_the_terrain_where_its_pixels_meet_it(grid):
    heights = hills(grid)
    position = to_xyz(MOON, LONGITUDE, LATITUDE, 60e3)
    rotation = nadir_rotation(position, np.array([0.0, 1.0, 0.3]))
    camera = FrameCamera(position, rotation, 1500.0, (200.0, 200.0), (400, 400))
    line, sample = np.mgrid[5:400:30, 5:400:30].astype(float)
    found = meet_terrain(camera.origin(line, sample), camera.ray(line, sample), grid, heights)
    np.testing.assert_allclose(camera.project(found), (line, sample), rtol=0, atol=1e-5)  # px
    _, _, height = to_lonlat(MOON, found)
    row, col = grid.index_at(*to_lonlat(MOON, found)[:2])
    terrain = 200.0 * np.sin(row * 50 / 900.0) * np.cos(col * 50 / 700.0)
    assert np.abs(height - terrain).max() < 0.2  # m, bilinear against smooth


def test_heights_of_another_grid_are_refused(grid):
    with pytest.raises(InputError, match="both must agree"):
        meet_terrain(np.zeros(3), np.ones(3), grid, np.zeros((3, 3)))
