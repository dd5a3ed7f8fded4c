"""Which few of many images tell the slopes of a place."""

import numpy as np
import pytest

from lommel.core.reflectance import reflectance_model
from lommel.estimate.image_choice import (
    LEAST_NOISE,
    NODES,
    PAIRS,
    PIXEL_NOISE,
    SHARES,
    SLOPE_ERROR,
    SLOPE_LIMIT,
    Sights,
    choose_images,
    information,
)

MODEL = reflectance_model()
PLACES = 5


def direction(azimuth_deg, elevation_deg):
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    flat = np.cos(elevation)
    return np.array([[flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation)]])


def tells(azimuth_deg, elevation_deg, pixels=1.0, slope=(0.0, 0.0), camera=(0.0, 88.0)):
    to_sun, to_camera = direction(azimuth_deg, elevation_deg), direction(*camera)
    return information(MODEL, np.array([slope]), to_sun, to_camera, pixels)[0]


def sights(suns):
    """Images of every place, each under a Sun of its own."""
    values = np.concatenate([np.repeat(tells(*sun)[None], PLACES, axis=0) for sun in suns])
    image = np.repeat(np.arange(len(suns)), PLACES)
    return Sights(image, np.tile(np.arange(PLACES), len(suns)), values)


def chosen(suns, **options):
    found = sights(suns)
    is_chosen, _ = choose_images(found, len(suns), PLACES, **options)
    assert len(set(np.bincount(found.place, is_chosen))) == 1  # all places are alike
    return sorted(set(found.image[is_chosen].tolist()))


def test_information_is_that_of_finite_differences():
    sun, camera, slope, step = (70.0, 40.0), (200.0, 75.0), np.array([0.05, -0.02]), 1e-6
    to_sun, to_camera = direction(*sun)[0], direction(*camera)[0]
    phase = np.arccos(to_sun @ to_camera)

    def brightness(p, q):
        normal = np.array([-p, -q, 1.0]) / np.sqrt(1 + p * p + q * q)
        return float(MODEL.reflectance(normal @ to_sun, normal @ to_camera, phase))

    nodes, shares = [], []
    for a, share_a in zip(NODES, SHARES, strict=True):
        for b, share_b in zip(NODES, SHARES, strict=True):
            p, q = slope + SLOPE_ERROR * np.array([a, b])
            by_p = (brightness(p + step, q) - brightness(p - step, q)) / (2 * step)
            by_q = (brightness(p, q + step) - brightness(p, q - step)) / (2 * step)
            nodes.append((by_p, by_q, brightness(p, q)))
            shares.append(share_a * share_b)
    gradient, shares = np.array(nodes), np.array(shares)
    noise = np.hypot(PIXEL_NOISE, LEAST_NOISE) * (shares @ gradient[:, 2])
    variance = noise**2 + SLOPE_LIMIT**2 * (shares @ (gradient[:, :2] ** 2).sum(axis=1))
    expected = [shares @ (gradient[:, i] * gradient[:, j]) / variance for i, j in PAIRS]
    found = tells(*sun, slope=slope, camera=camera)
    np.testing.assert_allclose(found, expected, rtol=1e-6)  # of the differences


def test_turning_sun_and_camera_by_a_quarter_turns_what_is_told():
    east, north, both = tells(50.0, 30.0, camera=(100.0, 80.0))[[0, 2, 1]]
    turned = tells(140.0, 30.0, camera=(190.0, 80.0))[[0, 2, 1]]
    np.testing.assert_allclose(turned, [north, east, -both], rtol=1e-9)


def test_an_image_tells_nothing_of_ground_turned_away_from_sun_or_camera():
    assert not tells(90.0, -20.0).any()
    assert not tells(90.0, 40.0, camera=(0.0, -30.0)).any()
    assert tells(90.0, 12.0, slope=(-0.2, 0.0))[0] > 0
    assert tells(90.0, 12.0, slope=(0.6, 0.0))[0] == 0


def test_coarse_pixels_tell_less_and_fine_ones_no_more_than_their_noise_allows():
    albedo = [tells(90.0, 60.0, pixels)[5] for pixels in (0.25, 1.0, 4.0, 1e4, 1e8)]
    assert (np.diff(albedo) > 0).all()
    assert albedo[1] > 2 * albedo[0]
    assert albedo[4] < 1.01 * albedo[3]


def test_every_light_there_is_is_chosen_before_more_of_the_same():
    suns = [(90.0 + k / 10, 30.0) for k in range(20)]
    many = chosen(suns)
    assert 0 < len(many) < 20
    assert {20, 21} <= set(chosen([*suns, (200.0, 35.0), (330.0, 40.0)]))


def test_the_order_of_the_images_does_not_matter():
    random = np.random.default_rng(1)
    suns = [(random.uniform(0, 360), random.uniform(15, 60)) for _ in range(24)]
    order = random.permutation(24)
    assert sorted(order[chosen([suns[k] for k in order])].tolist()) == chosen(suns)
    assert len(chosen(suns)) < 16


def test_what_only_one_image_shows_is_not_given_up():
    suns = [(360.0 * k / 12, 40.0) for k in range(12)]
    common = sights(suns)
    alone = Sights(  # the same light again, and one place that nothing else shows
        np.append(common.image, np.full(PLACES + 1, 12)),
        np.append(common.place, np.arange(PLACES + 1)),
        np.append(common.information, np.repeat(tells(*suns[0])[None], PLACES + 1, 0), axis=0),
    )
    is_chosen, _ = choose_images(alone, 13, PLACES + 1)
    assert alone.place[is_chosen & (alone.image == 12)].max() == PLACES


def test_a_known_albedo_needs_no_more_images():
    suns = [(360.0 * k / 24, 40.0) for k in range(24)]
    assert len(chosen(suns, knows_albedo=True)) <= len(chosen(suns))


def test_gains_of_images_not_chosen_are_small_and_tell_why():
    found = sights([(360.0 * k / 24, 40.0) for k in range(24)])
    is_chosen, gains = choose_images(found, 24, PLACES)
    others = np.setdiff1d(np.arange(24), found.image[is_chosen])
    assert ((gains[others] > 0) & (gains[others] < 0.05)).all()
    assert gains[found.image[is_chosen]] == pytest.approx(0)
