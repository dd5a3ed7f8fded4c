import numpy as np
import pytest

from lommel.errors import InputError
from lommel.scene.body import MOON, to_xyz
from lommel.scene.camera import FrameCamera, nadir_rotation

PIXEL = 1e-3  # px, a tenth of the sub-pixel registration we rely on


@pytest.fixture
def camera():
    position = to_xyz(MOON, 0.3, -0.2, 110e3)
    rotation = nadir_rotation(position, np.array([0.1, 0.9, 0.2]))
    return FrameCamera(position, rotation, 2730.0, (2040.0, 2055.0), (4096, 4110))


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
