import numpy as np
import pytest

from lommel.estimate.registration import (
    TERRAIN,
    AdjustmentSettings,
    Matches,
    adjust_cameras,
    chance_of_agreement,
    join_matches,
    mean_error,
)
from lommel.scene.body import MOON, local_frame, to_lonlat, to_xyz
from lommel.scene.camera import FrameCamera, nadir_rotation
from lommel.scene.intersection import meet_sphere

SIGMA = 5.0  # m, of a shift
PIXELS = 500
GSD = 50.0  # m
POINTING = 0.1  # px; the mean of a hundred shifts of a tenth of a pixel, with some to spare


def camera_over(longitude_deg):
    position = to_xyz(MOON, np.radians(longitude_deg), np.radians(20.0), 110e3)
    return FrameCamera(
        position=position,
        rotation=nadir_rotation(position, np.array([0.0, 0.0, 1.0])),
        focal_length=110e3 / GSD,
        principal_point=(PIXELS / 2, PIXELS / 2),
        shape=(PIXELS, PIXELS),
    )


def where_it_shows(camera, believed, xyz):
    """The place on the sphere where a camera believed to be another one shows ground."""
    line, sample = camera.project(xyz)
    return meet_sphere(believed.origin(line, sample), believed.ray(line, sample), MOON.radius)


def shifts(first, second, xyz, displacement, seed=0):
    """Matches of what ``first`` shows at places; ``displacement`` as it should be measured."""
    longitude, latitude, _ = to_lonlat(MOON, xyz)
    east, north, _ = local_frame(longitude, latitude)
    south = -north
    noise = SIGMA * np.random.default_rng(seed).standard_normal((len(xyz), 2))
    shift = np.stack([(displacement * south).sum(-1), (displacement * east).sum(-1)], -1)
    return Matches(
        np.full(len(xyz), first),
        np.full(len(xyz), second),
        xyz,
        south,
        east,
        shift + noise,
        np.broadcast_to(SIGMA**2 * np.eye(2), (len(xyz), 2, 2)),
    )


def ground_of(camera, count=10):
    line, sample = np.meshgrid(*[np.linspace(20, PIXELS - 20, count)] * 2)
    xyz = meet_sphere(camera.origin(line, sample), camera.ray(line, sample), MOON.radius)
    return xyz.reshape(-1, 3)


def terrain_matches(truth, believed, number=0, seed=0):
    """What an image shows where it is believed to look, against where that belongs."""
    places = ground_of(believed)
    line, sample = believed.project(places)
    true_places = meet_sphere(truth.origin(line, sample), truth.ray(line, sample), MOON.radius)
    return shifts(number, TERRAIN, places, true_places - places, seed)


def misplacement(truth, found):
    xyz = ground_of(truth)
    return np.hypot(*(a - b for a, b in zip(truth.project(xyz), found.project(xyz), strict=True)))


def corrected(camera, adjustment, number=0):
    return camera.adjusted(adjustment.rotation[number], adjustment.move[number])


@pytest.mark.parametrize("rotation", [(2e-3, -1e-3, 0.0), (1e-3, 1e-3, 3e-3)])
def test_a_known_turn_is_found(rotation):
    truth = camera_over(10.0)
    believed = truth.adjusted(rotation, np.zeros(3))
    assert misplacement(truth, believed).max() > 3
    matches = terrain_matches(truth, believed)
    adjustment = adjust_cameras([believed], matches, AdjustmentSettings())
    assert misplacement(truth, corrected(believed, adjustment)).max() < POINTING
    assert (adjustment.weight > 0.3).all()


def test_wrong_matches_are_not_believed():
    truth = camera_over(10.0)
    believed = truth.adjusted((2e-3, -1e-3, 1e-3), np.zeros(3))
    matches = terrain_matches(truth, believed)
    matches.shift[::3] = np.random.default_rng(1).uniform(-500, 500, matches.shift[::3].shape)
    adjustment = adjust_cameras([believed], matches, AdjustmentSettings())
    assert misplacement(truth, corrected(believed, adjustment)).max() < 2 * POINTING
    assert np.median(adjustment.weight[::3]) < 0.05


def test_a_move_is_found_when_it_may_be():
    truth = camera_over(10.0)
    believed = truth.adjusted((0.0, 0.0, 0.0), 300.0 * truth.position / 1.8474e6)
    matches = terrain_matches(truth, believed)
    turned = adjust_cameras([believed], matches, AdjustmentSettings())
    moved = adjust_cameras([believed], matches, AdjustmentSettings(position_error=500.0))
    assert misplacement(truth, corrected(believed, turned)).max() > 0.5  # px: 300 m in height
    assert misplacement(truth, corrected(believed, moved)).max() < 2 * POINTING


def test_without_matches_that_say_otherwise_nothing_moves():
    camera = camera_over(10.0)
    matches = terrain_matches(camera, camera)
    matches.shift[:] = 0.0
    adjustment = adjust_cameras([camera], matches, AdjustmentSettings())
    assert np.abs(adjustment.rotation).max() < 1e-12


def test_an_image_is_placed_by_its_tie_to_another():
    """Only the first image is matched with the terrain; the second hangs on the first."""
    truths = [camera_over(10.0), camera_over(10.3)]
    believed = [
        truths[0].adjusted((2e-3, 0.0, 0.0), np.zeros(3)),
        truths[1].adjusted((0.0, -3e-3, 1e-3), np.zeros(3)),
    ]
    ground = terrain_matches(truths[0], believed[0])
    shared = ground_of(truths[0])
    shared = shared[truths[1].contains(*truths[1].project(shared))]
    places = where_it_shows(truths[0], believed[0], shared)
    others = where_it_shows(truths[1], believed[1], shared)
    ties = shifts(0, 1, places, others - places, seed=4)
    matches = join_matches([ground, ties])
    adjustment = adjust_cameras(believed, matches, AdjustmentSettings())
    found = [corrected(camera, adjustment, k) for k, camera in enumerate(believed)]
    assert misplacement(truths[0], found[0]).max() < POINTING
    lines, samples = truths[1].project(shared)
    there = found[1].project(shared)
    assert np.hypot(there[0] - lines, there[1] - samples).max() < 3 * POINTING


def test_what_is_left_of_shifts_is_what_the_corrected_camera_would_measure():
    truth = camera_over(10.0)
    believed = truth.adjusted((1e-3, 0.0, 0.0), np.zeros(3))
    matches = terrain_matches(truth, believed)
    adjustment = adjust_cameras([believed], matches, AdjustmentSettings())
    left = matches.left(adjustment.residual)
    again = adjust_cameras([corrected(believed, adjustment)], left, AdjustmentSettings())
    assert np.abs(again.rotation).max() < 2e-6  # rad; 0.2 m on the ground
    assert mean_error(left) == pytest.approx(SIGMA / 10, rel=0.3)  # of 100 matches


def test_chance_is_small_only_when_many_agree():
    assert chance_of_agreement(0, 20, 2.0, 8.0) == 0.0
    assert chance_of_agreement(3, 60, 2.0, 8.0) > -2
    assert chance_of_agreement(20, 60, 2.0, 8.0) < -8
