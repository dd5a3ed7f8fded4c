from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lommel.errors import InputError
from lommel.scene.body import MOON, to_xyz
from lommel.scene.camera import FrameCamera, ReducedCamera, nadir_rotation
from lommel.scene.distortion import Distortion

PIXEL = 1e-3  # px, a tenth of the sub-pixel registration we rely on


@pytest.fixture
def camera():
    position = to_xyz(MOON, 0.3, -0.2, 110e3)
    rotation = nadir_rotation(position, np.array([0.1, 0.9, 0.2]))
    return FrameCamera(position, rotation, 2730.0, (2040.0, 2055.0), (4096, 4110))


@pytest.fixture
def metric(camera):
    """Apollo's Metric camera: a plane in mm with turned axes, a lens, and a known Sun."""
    return replace(
        camera,
        focal_length=76.054,
        principal_point=(11449.5, 11450.5),
        shape=(22900, 22900),
        distortion=Distortion(
            "brown-conrady",
            (-0.006, -0.002, -1.34e-6, 5.23e-10, -5.07e-14, -5.50e-7, -4.61e-11, 2.966),
        ),
        sun_position=np.array([1e11, 1e11, 0.0]),
        to_pixels=((0.0, 200.0), (-200.0, 0.0)),
    )


def ground_of(camera, line, sample, distance=120e3):
    return camera.origin(line, sample) + distance * camera.ray(line, sample)


def test_frame_camera_ray_returns_to_its_pixel(camera):
    random = np.random.default_rng(0)
    line, sample = random.uniform(0, 4096, (2, 50))
    ground = camera.position + random.uniform(1e4, 3e5, (50, 1)) * camera.ray(line, sample)
    found = camera.project(ground)
    np.testing.assert_allclose(found, (line, sample), rtol=0, atol=PIXEL)


def test_point_below_a_nadir_camera_lies_at_the_principal_point(camera):
    line, sample = camera.project(to_xyz(MOON, 0.3, -0.2, 0.0))
    assert abs(line - 2040.0) < PIXEL
    assert abs(sample - 2055.0) < PIXEL


def test_samples_of_a_nadir_camera_grow_along_the_heading(camera):
    _, behind = camera.project(to_xyz(MOON, 0.3, -0.2, 0.0) - 1e3 * camera.rotation[0])
    _, ahead = camera.project(to_xyz(MOON, 0.3, -0.2, 0.0) + 1e3 * camera.rotation[0])
    expected = 2e3 / 110e3 * camera.focal_length
    assert ahead - behind == pytest.approx(expected, abs=PIXEL)


def test_nadir_image_is_not_mirrored(camera):
    """Seen from above, lines grow to the right-hand side of the flight."""
    east, south = camera.rotation[0], camera.rotation[1]
    up = camera.position / np.linalg.norm(camera.position)
    assert np.dot(np.cross(east, south), up) < 0


def test_points_behind_the_camera_are_nowhere(camera):
    line, sample = camera.project(2.0 * camera.position)
    assert np.isnan(line)
    assert np.isnan(sample)


def test_image_ends_at_its_outer_pixel_edges(camera):
    line, sample = np.array([0.0, 4096.0, 4096.1]), np.array([0.0, 4110.0, 1.0])
    assert camera.contains(line, sample).tolist() == [True, True, False]


def test_mirrored_rotation_is_refused():
    with pytest.raises(InputError, match="rotation is not a rotation"):
        FrameCamera(np.zeros(3), np.diag([1.0, 1.0, -1.0]), 1.0, (0.0, 0.0), (1, 1))


def test_camera_with_a_lens_returns_to_its_pixel(metric):
    line, sample = np.random.default_rng(1).uniform(0, 22900, (2, 500))
    found = metric.project(ground_of(metric, line, sample))
    np.testing.assert_allclose(found, (line, sample), rtol=0, atol=PIXEL)


def test_projection_is_rotation_division_and_lens(metric):
    """The formula of the module, written with whole arrays."""
    xyz = ground_of(metric, *np.random.default_rng(2).uniform(0, 22900, (2, 500)))
    x, y, z = ((xyz - metric.position) @ metric.rotation.T).T
    x, y = metric.distortion.distort(76.054 * x / z, 76.054 * y / z)
    expected = 11449.5 + 200.0 * y, 11450.5 - 200.0 * x
    np.testing.assert_allclose(metric.project(xyz), expected, rtol=0, atol=1e-8)


def test_crop_of_a_reduced_image_has_the_same_camera(metric):
    line, sample = 300.0, 250.0
    begin, times = np.array([7996.0, 4396.0]), 4
    cropped = replace(
        metric,
        principal_point=tuple((np.array(metric.principal_point) - begin) / times),
        to_pixels=np.array(metric.to_pixels) / times,
        shape=(750, 750),
    )
    expected = metric.ray(begin[0] + times * line, begin[1] + times * sample)
    np.testing.assert_allclose(cropped.ray(line, sample), expected, rtol=0, atol=1e-12)


def test_projection_takes_any_shape_and_type(metric):
    line, sample = np.meshgrid([100.0, 9000.0], [50.0, 20000.0, 30000.0])
    ground = ground_of(metric, line, sample)
    found = np.stack(metric.project(ground))
    assert found.shape == (2, 3, 2)
    assert found[:, 1, 1] == pytest.approx(metric.project(ground[1, 1]))
    np.testing.assert_array_equal(metric.project(ground[::2, ::-1])[0], found[0, ::2, ::-1])
    assert np.shape(metric.project(np.zeros((0, 3)))[0]) == (0,)
    assert np.isnan(metric.project(np.array([np.nan, 0.0, 0.0]))).all()
    single_precision = metric.project(ground.astype(np.float32))
    np.testing.assert_allclose(single_precision, found, rtol=0, atol=0.02)  # px; 0.06 m of ground


def test_turn_about_the_optical_axis_turns_the_image(camera):
    """A right-handed turn of the camera by +90 degrees takes samples' axis to lines' axis."""
    turned = camera.adjusted([0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.0])
    line, sample = turned.project(ground_of(camera, 2040.0, 2155.0))
    assert (line, sample) == pytest.approx((2140.0, 2055.0), abs=PIXEL)


def test_adjustments_add_up_as_rotation_vectors(metric):
    small = np.array([2e-4, -1e-4, 3e-4])
    turned = metric.adjusted(small, [0.0, 0.0, 0.0])
    expected = Rotation.from_rotvec(small).as_matrix() @ metric.rotation
    np.testing.assert_allclose(turned.rotation, expected, rtol=0, atol=1e-14)
    back = turned.adjusted(-small, [0.0, 0.0, 0.0])
    np.testing.assert_allclose(back.rotation, metric.rotation, rtol=0, atol=1e-14)


def test_shifted_camera_sees_shifted_ground_in_the_same_place(metric):
    shift = np.array([30.0, -20.0, 10.0])
    line, sample = np.array([100.0, 9000.0]), np.array([50.0, 20000.0])
    moved = metric.adjusted([0.0, 0.0, 0.0], shift)
    found = moved.project(ground_of(metric, line, sample) + shift)
    np.testing.assert_allclose(found, (line, sample), rtol=0, atol=PIXEL)


def test_reduced_camera_answers_in_its_own_pixels(metric):
    reduced = ReducedCamera(metric, 4)
    assert reduced.shape == (5725, 5725)
    ground = ground_of(metric, 4000.0, 8000.0)
    assert reduced.project(ground) == pytest.approx((1000.0, 2000.0), abs=PIXEL)
    np.testing.assert_array_equal(reduced.ray(1000.0, 2000.0), metric.ray(4000.0, 8000.0))
    np.testing.assert_array_equal(reduced.origin(1.0, [2.0, 3.0]), metric.origin(1.0, [2.0, 3.0]))
    np.testing.assert_array_equal(reduced.sun_position, metric.sun_position)
    turned = reduced.adjusted([0.0, 0.0, 1e-3], [1.0, 2.0, 3.0])
    expected = metric.adjusted([0.0, 0.0, 1e-3], [1.0, 2.0, 3.0]).project(ground)
    assert turned.project(ground) == pytest.approx(np.divide(expected, 4), abs=PIXEL)


def test_sun_is_asked_for_where_the_file_tells_nothing(camera, metric):
    assert metric.sun(np.zeros(3), 0.0).shape == (3, 3)
    with pytest.raises(InputError, match="--sun-positions"):
        camera.sun(0.0, 0.0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"focal_length": -1.0}, "focal_length = -1.0 is not positive"),
        ({"principal_point": (np.nan, 0.0)}, "principal_point"),
        ({"to_pixels": ((1.0, 1.0), (1.0, 1.0))}, "one to one"),
        ({"position": np.array([np.inf, 0.0, 0.0])}, "not three finite numbers"),
    ],
)
def test_wrong_numbers_are_refused(camera, wrong, message):
    with pytest.raises(InputError, match=message):
        replace(camera, **wrong)
