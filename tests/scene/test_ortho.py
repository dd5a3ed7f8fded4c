import numpy as np
import pytest

from lommel.scene.body import MOON, local_frame, to_xyz
from lommel.scene.camera import FrameCamera
from lommel.scene.grid import Window, grid_from_bounds, read_crs
from lommel.scene.ortho import ground_tile, needed_pixels, resample_image
from lommel.scene.shadows import reach, sunlit

SPACING = 100.0  # m
POST = 1.5  # posts: a ray samples terrain once per post, the edge of a wall is one post wide
ALTITUDE = 100e3  # m
GRID = grid_from_bounds(
    (-8e3, -8e3, 8e3, 8e3), SPACING, read_crs(f"+proj=eqc +R={MOON.radius} +units=m +type=crs")
)
EAST, NORTH, UP = (axis[0] for axis in local_frame(np.zeros(1), np.zeros(1)))
CENTRE = to_xyz(MOON, 0.0, 0.0, 0.0)


def camera_at(east_angle_deg, pixels=200):
    """A camera that sees the middle of the grid from a side."""
    angle = np.radians(east_angle_deg)
    position = CENTRE + ALTITUDE * (np.cos(angle) * UP + np.sin(angle) * EAST)
    down = (CENTRE - position) / ALTITUDE
    rotation = np.stack([np.cross(-NORTH, down), -NORTH, down])  # samples east, lines south
    return FrameCamera(
        position=position,
        rotation=rotation,
        focal_length=ALTITUDE / SPACING,
        principal_point=(pixels / 2, pixels / 2),
        shape=(pixels, pixels),
        sun_position=CENTRE + 1.5e11 * (0.5 * UP - np.sqrt(0.75) * EAST),
    )


def per_post(line, sample):
    return np.stack([np.gradient(x, axis=axis) for axis in (0, 1) for x in (line, sample)])


@pytest.mark.parametrize("angle", [20.0, 40.0])
def test_ground_behind_a_wall_is_hidden_as_far_as_the_tangent_of_emission(angle):
    heights = np.zeros(GRID.shape)
    heights[:, 80] = 1000.0
    tile = ground_tile(GRID, heights, GRID.window, camera_at(angle))
    hidden = np.flatnonzero(~tile.is_seen[80] & tile.is_on_image[80])
    expected = 1000.0 * np.tan(np.radians(angle)) / SPACING
    assert hidden.max() <= 80  # the camera stands in the east
    assert hidden.size == pytest.approx(expected, abs=POST + 0.05 * expected)  # 5 %: perspective


def test_ground_in_shadow_is_cast_or_turned_away():
    heights = np.zeros(GRID.shape)
    heights[:, 80] = 500.0
    tile = ground_tile(GRID, heights, GRID.window, camera_at(0.0))
    dark = np.flatnonzero(~tile.is_lit[80])
    expected = 500.0 / np.tan(np.radians(30.0)) / SPACING  # the Sun stands 30 degrees up
    assert dark.min() >= 80  # the Sun stands in the west
    assert dark.size == pytest.approx(expected, abs=POST)


def test_angles_on_the_sphere_are_those_of_the_sphere():
    tile = ground_tile(GRID, np.zeros(GRID.shape), GRID.window, camera_at(25.0))
    incidence, emission = (
        np.degrees(np.arccos(plane[80, 80]))
        for plane in (tile.geometry.cos_incidence, tile.geometry.cos_emission)
    )
    assert incidence == pytest.approx(60.0, abs=0.01)  # deg; the post is 70 m from the centre
    assert emission == pytest.approx(25.0, abs=0.1)
    assert np.degrees(tile.geometry.phase[80, 80]) == pytest.approx(85.0, abs=0.1)


def test_a_window_with_its_reach_answers_like_the_whole():
    rng = np.random.default_rng(3)
    heights = 30.0 * np.cumsum(rng.standard_normal(GRID.shape), axis=1)
    camera = camera_at(35.0)
    whole = ground_tile(GRID, heights, GRID.window, camera)
    window = Window(60, 50, 30, 40)
    relief = float(heights.max() - heights.min())
    around = reach(GRID, window, relief, camera.position, camera.sun_position)
    around = around.intersection(GRID.window)
    assert around.cols < GRID.shape[1]
    part = ground_tile(GRID.cut(around), heights[around.slices], window.relative_to(around), camera)
    for name in ("is_lit", "is_seen", "is_on_image", "line", "sample"):
        expected = getattr(whole, name)[window.slices]
        np.testing.assert_allclose(getattr(part, name), expected, atol=1e-6)


def test_a_camera_at_the_zenith_sees_all():
    position = to_xyz(MOON, *GRID.lonlat_at(80.0, 80.0), ALTITUDE)
    assert sunlit(GRID, np.zeros(GRID.shape), position).all()


def test_without_a_sun_there_is_emission_and_no_incidence():
    camera = camera_at(10.0)
    camera = FrameCamera(
        camera.position,
        camera.rotation,
        camera.focal_length,
        camera.principal_point,
        camera.shape,
    )
    tile = ground_tile(GRID, np.zeros(GRID.shape), GRID.window, camera)
    assert np.isnan(tile.geometry.cos_incidence).all()
    assert np.isfinite(tile.geometry.cos_emission[80, 80])
    assert tile.is_lit.all()


def test_fine_pixels_are_averaged_over_a_turned_post():
    """A linear image has the same mean over any parallelogram: the value at its centre."""
    row, col = np.indices((20, 30)).astype(float)
    line = 100.0 + 3.0 * row + 2.0 * col
    sample = 100.0 - 2.0 * row + 3.0 * col
    lines, samples = np.indices((300, 300)) + 0.5
    image = (2.0 * lines - 5.0 * samples).astype(np.float32)
    values = resample_image(image, line, sample, per_post(line, sample))
    np.testing.assert_allclose(values, 2.0 * line - 5.0 * sample, atol=1e-3)


def test_fine_pixels_are_averaged_with_equal_weight():
    rng = np.random.default_rng(0)
    image = rng.standard_normal((160, 160)).astype(np.float32)
    place = 4.0 * np.arange(2, 38) + 2.0
    line, sample = np.meshgrid(place, place, indexing="ij")
    values = resample_image(image, line, sample, per_post(line, sample))
    expected = image.reshape(40, 4, 40, 4).mean(axis=(1, 3))[2:38, 2:38]
    np.testing.assert_allclose(values, expected, atol=1e-5)


def test_coarse_pixels_are_interpolated_to_the_third_power():
    lines, samples = np.indices((40, 40)) + 0.5
    image = (0.1 * lines**2 + samples).astype(np.float32)
    line, sample = np.meshgrid(np.linspace(5, 30, 60), np.linspace(5, 30, 70), indexing="ij")
    values = resample_image(image, line, sample, per_post(line, sample))
    np.testing.assert_allclose(values, 0.1 * line**2 + sample, rtol=1e-5)


@pytest.mark.parametrize("step", [0.5, 4.0])
def test_missing_pixels_do_not_leak(step):
    image = np.full((100, 100), 7.0, np.float32)
    image[40:60, 40:60] = np.nan
    place = np.arange(10.0, 90.0, step)
    line, sample = np.meshgrid(place, place, indexing="ij")
    values = resample_image(image, line, sample, per_post(line, sample))
    np.testing.assert_allclose(values[np.isfinite(values)], 7.0)
    assert np.isnan(values[np.hypot(line - 50, sample - 50) < 6]).all()
    assert np.isfinite(values[np.hypot(line - 50, sample - 50) > 22]).all()


def test_needed_pixels_are_none_beside_the_image():
    away = np.full((3, 3), -50.0)
    assert needed_pixels(away, away, (100, 100)).is_empty
    part = needed_pixels(np.full((1, 2), 30.0), np.array([[10.0, 200.0]]), (100, 100))
    assert part == Window(28, 8, 5, 5)
