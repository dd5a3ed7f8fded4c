from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lommel.errors import InputError
from lommel.scene.body import MOON
from lommel.scene.camera import FrameCamera, nadir_rotation
from lommel.scene.distortion import Distortion
from lommel.scene.line_scan import MARGIN, LineScanCamera
from lommel.scene.motion import Pointing, Trajectory

PIXEL = 1e-3  # px, a tenth of the sub-pixel registration we rely on
RADIUS = MOON.radius + 50e3  # m, of the orbit
RATE = 9.2e-4  # rad/s along the orbit
PERIOD = 1e-3  # s per line
SHAPE = (2000, 5064)
FOCAL_LENGTH, PIXELS_PER_MM = 699.62, 142.857  # of the LRO NAC
KAGUYA_TC = (-0.0725, -9.65e-4, 9.84e-4, 8.58e-6, -3.74e-6)
KAGUYA_TC += (0.0214, -1.38e-3, 1.35e-5, 2.73e-6, -6.19e-6)
DISTORTIONS = {
    "none": None,
    "lrolrocnac": Distortion("lrolrocnac", (1.81e-5,)),
    "kaguyalism": Distortion("kaguyalism", KAGUYA_TC),
}


def on_orbit(times):
    """Position and velocity on a polar circle."""
    angle = 0.3 + RATE * np.asarray(times)
    zero = np.zeros_like(angle)
    position = RADIUS * np.stack([np.cos(angle), zero, np.sin(angle)], axis=-1)
    velocity = RADIUS * RATE * np.stack([-np.sin(angle), zero, np.cos(angle)], axis=-1)
    return position, velocity


def shaken(times):
    """Rotations that look down, x along the flight, with jitter of several pixels."""
    nadir = np.stack([nadir_rotation(*pose) for pose in zip(*on_orbit(times), strict=True)])
    jitter = 5e-5 * np.stack([np.sin(9 * times), np.cos(7 * times), np.sin(5 * times)], axis=-1)
    return Rotation.from_rotvec(jitter).as_matrix() @ nadir


def camera_of(distortion=None, line_times=((0.0, 0.0, PERIOD),), flip=1.0):
    few, many = np.linspace(-0.1, 2.4, 6), np.linspace(-0.1, 2.4, 101)
    return LineScanCamera(
        Trajectory(few, *on_orbit(few)),
        Pointing(many, shaken(many)),
        np.array(line_times),
        FOCAL_LENGTH,
        (0.0, 2548.0),
        SHAPE,
        distortion,
        Trajectory(np.array([0.0, 2.0]), np.array([[1.5e11, 0.0, 0.0], [1.5e11, 4e5, 0.0]])),
        ((flip * PIXELS_PER_MM, 0.0), (0.0, PIXELS_PER_MM)),
    )


def ground_of(camera, line, sample):
    """Points at the distance of the ground, on the rays of pixels."""
    distance = np.random.default_rng(3).uniform(45e3, 55e3, np.shape(line))
    return camera.origin(line, sample) + distance[..., None] * camera.ray(line, sample)


@pytest.fixture
def pixels():
    random = np.random.default_rng(1)
    return random.uniform(0, SHAPE[0], 3000), random.uniform(0, SHAPE[1], 3000)


@pytest.mark.parametrize("distortion", DISTORTIONS.values(), ids=DISTORTIONS)
def test_ray_of_a_line_returns_to_its_pixel(distortion, pixels):
    camera = camera_of(distortion)
    found = camera.project(ground_of(camera, *pixels))
    np.testing.assert_allclose(found, pixels, rtol=0, atol=PIXEL)


@pytest.mark.parametrize(
    "line_times",
    [
        ((0.0, 0.0, 5e-4), (600.0, 0.3, PERIOD), (1400.0, 1.1, 1.5e-3)),
        ((0.0, 2.0, -PERIOD),),
    ],
    ids=["three rates", "stored backwards"],
)
def test_line_times_may_change_and_run_backwards(line_times, pixels):
    camera = camera_of(DISTORTIONS["lrolrocnac"], line_times)
    found = camera.project(ground_of(camera, *pixels))
    np.testing.assert_allclose(found, pixels, rtol=0, atol=PIXEL)


def test_ephemeris_time_does_not_shake_the_lines(pixels):
    """A double of 3e8 s steps by 6e-8 s: an orbiter moves by a ten-thousandth of a line."""
    early, epoch = camera_of(), 3.4e8
    camera = replace(
        early,
        trajectory=early.trajectory.since(-epoch),
        pointing=early.pointing.since(-epoch),
        line_times=np.array([[0.0, epoch, PERIOD]]),
    )
    found = camera.project(ground_of(camera, *pixels))
    np.testing.assert_allclose(found, pixels, rtol=0, atol=1e-6)


def test_detector_turned_round_sees_the_same_lines(pixels):
    """Yaw flips turn the detector's line axis against the flight; the sign is of no account."""
    ground = ground_of(camera_of(), *pixels)
    np.testing.assert_allclose(
        camera_of(flip=-1.0).project(ground), camera_of().project(ground), rtol=0, atol=PIXEL
    )


def test_level_flight_has_a_closed_form():
    """100 m/s at 1000 m over a plane, looking down: line = x / 0.1 m, sample = 50 + f y / 1000."""
    times = np.array([0.0, 10.0])
    camera = LineScanCamera(
        Trajectory(times, np.array([[0.0, 0.0, 1000.0], [1000.0, 0.0, 1000.0]])),
        Pointing(times, np.array(2 * [[[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]])),
        np.array([[0.0, 0.0, 1e-3]]),
        500.0,
        (0.0, 50.0),
        (10_000, 100),
    )
    x, y = np.array([0.0, 123.4, 999.9]), np.array([80.0, 0.0, -33.0])
    line, sample = camera.project(np.stack([x, y, np.zeros(3)], axis=-1))
    np.testing.assert_allclose(line, x / 0.1, rtol=0, atol=PIXEL)
    np.testing.assert_allclose(sample, 50.0 + 0.5 * y, rtol=0, atol=PIXEL)


def test_each_line_is_a_frame_camera_of_its_moment(pixels):
    line, sample = pixels
    camera = camera_of(DISTORTIONS["kaguyalism"])
    ground = ground_of(camera, line, sample)
    for i in range(0, 3000, 500):
        time = camera.time(line[i])
        moment = FrameCamera(
            camera.trajectory.at(time),
            camera.pointing.at(time),
            FOCAL_LENGTH,
            camera.principal_point,
            SHAPE,
            camera.distortion,
            to_pixels=camera.to_pixels,
        )
        assert moment.project(ground[i]) == pytest.approx((0.0, sample[i]), abs=PIXEL)


def test_points_that_no_line_sees_are_nowhere():
    camera = camera_of()
    beyond = on_orbit(10.0)[0] * MOON.radius / RADIUS
    above = camera.position + 60e3 * camera.position / np.linalg.norm(camera.position)
    for point in (beyond, above, np.full(3, np.nan)):
        assert np.isnan(camera.project(point)).all()
    assert np.isnan(camera.ray(SHAPE[0] + MARGIN + 2, 0.0)).all()


def test_lines_just_outside_the_image_are_still_projected():
    camera = camera_of()
    line, sample = np.array([-30.0, SHAPE[0] + 30.0]), np.array([-100.0, 6000.0])
    found = camera.project(ground_of(camera, line, sample))
    np.testing.assert_allclose(found, (line, sample), rtol=0, atol=PIXEL)


def test_projection_does_not_depend_on_what_is_projected_together(pixels):
    camera = camera_of(DISTORTIONS["lrolrocnac"])
    ground = ground_of(camera, *pixels)
    together = camera.project(np.tile(ground, (5, 1)).reshape(5, 3000, 3))
    np.testing.assert_array_equal(together[0][4, ::300], camera.project(ground[::300])[0])


def test_adjusted_camera_turns_and_moves_as_a_whole(pixels):
    camera = camera_of()
    turned = camera.adjusted([0.0, 0.0, 1e-3], [0.0, 0.0, 0.0])
    expected = Rotation.from_rotvec([0.0, 0.0, 1e-3]).as_matrix() @ camera.pointing.at(0.77)
    np.testing.assert_allclose(turned.pointing.at(0.77), expected, rtol=0, atol=1e-12)
    moved = camera.adjusted([0.0, 0.0, 0.0], [10.0, 20.0, -30.0])
    ground = ground_of(camera, *pixels)
    found = moved.project(ground + [10.0, 20.0, -30.0])
    np.testing.assert_allclose(found, pixels, rtol=0, atol=PIXEL)


def test_position_and_sun_are_those_of_the_line():
    camera = camera_of()
    np.testing.assert_allclose(camera.position, on_orbit(1.0)[0], rtol=0, atol=1e-3)
    line = np.array([[0.0], [1500.0]])
    origin = camera.origin(line, np.zeros(3))
    np.testing.assert_allclose(origin[1, 2], on_orbit(1.5)[0], rtol=0, atol=1e-3)
    np.testing.assert_allclose(camera.sun(line, np.zeros(3))[1, 0], [1.5e11, 3e5, 0.0])
    np.testing.assert_allclose(camera.sun_position, [1.5e11, 2e5, 0.0])


def test_trajectory_is_off_by_the_fourth_power_of_the_interval():
    errors = []
    for step in (40.0, 20.0):
        times = np.arange(-200.0, 201.0, step)
        between = np.linspace(-20.0, 20.0, 33)
        found = Trajectory(times, *on_orbit(times)).at(between)
        errors.append(np.abs(found - on_orbit(between)[0]).max())
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.05)


def test_velocities_left_out_are_taken_from_the_positions():
    times = np.array([-21.0, -12.0, -6.0, 0.0, 5.0, 11.0, 16.0])
    position, velocity = on_orbit(times)
    found = Trajectory(times, position).velocities
    np.testing.assert_allclose(found, velocity, rtol=0, atol=0.01)  # m/s, of 1600


def test_pointing_halves_a_turn_and_goes_on_behind_the_table():
    quarter = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2]]).as_matrix()
    pointing = Pointing(np.array([0.0, 2.0]), quarter)
    expected = Rotation.from_rotvec([[0.0, 0.0, np.pi / 4], [0.0, 0.0, np.pi]]).as_matrix()
    np.testing.assert_allclose(pointing.at([1.0, 4.0]), expected, rtol=0, atol=1e-14)


def test_camera_of_another_time_is_refused():
    with pytest.raises(InputError, match="Check that camera and image belong together"):
        camera_of(line_times=((0.0, 100.0, PERIOD),))


def test_times_out_of_order_are_refused():
    with pytest.raises(InputError, match="do not ascend, at entry 2 of 3"):
        Trajectory(np.array([0.0, 2.0, 1.0]), np.zeros((3, 3)))
