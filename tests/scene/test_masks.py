import numpy as np
import pytest

from lommel.scene.masks import (
    MaskSettings,
    feathering,
    lit_brightness,
    pixel_weights,
    shadow_threshold,
    shadow_thresholds,
)


def ground(rng, size=20_000):
    """Lit pixels, brightness around 120, none below 40."""
    return 40.0 + 160.0 * rng.beta(3.0, 3.0, size)


@pytest.mark.parametrize("share", [0.002, 0.05, 0.4])
@pytest.mark.parametrize("black", [0.5, 8.0, 20.0])
def test_threshold_parts_shadow_from_ground(share, black):
    rng = np.random.default_rng(1)
    shadow = np.abs(rng.normal(black, 2.0, int(share * 20_000)))
    threshold = shadow_threshold(np.concatenate([ground(rng), shadow]))
    assert np.quantile(shadow, 0.95) < threshold < 45.0  # a few of the darkest lit pixels may go


def test_image_without_shadow_loses_nothing():
    assert shadow_threshold(ground(np.random.default_rng(2))) == 0.0


def test_threshold_scales_with_the_image():
    rng = np.random.default_rng(3)
    image = np.concatenate([ground(rng), np.abs(rng.normal(5.0, 2.0, 2000))])
    assert shadow_threshold(7.5 * image) == pytest.approx(7.5 * shadow_threshold(image))


def test_missing_pixels_do_not_count():
    rng = np.random.default_rng(4)
    image = np.concatenate([ground(rng), np.abs(rng.normal(5.0, 2.0, 2000))])
    with_holes = np.concatenate([image, np.full(500, np.nan)])
    assert shadow_threshold(with_holes) == pytest.approx(shadow_threshold(image))
    assert lit_brightness(with_holes) == lit_brightness(image)
    assert lit_brightness(np.full(3, np.nan)) == 0.0


def test_dark_image_is_judged_by_the_others():
    """An image all in shadow has no lit ground of its own to be compared with."""
    rng = np.random.default_rng(5)
    images = [ground(rng) for _ in range(4)] + [np.abs(rng.normal(2.0, 1.0, 20_000))]
    thresholds = shadow_thresholds(images, MaskSettings())
    assert thresholds[:4].max() == 0.0
    assert thresholds[4] > 0.99 * images[4].max()


def test_set_threshold_holds_for_every_image():
    images = [np.ones(5), np.zeros(5)]
    np.testing.assert_array_equal(
        shadow_thresholds(images, MaskSettings(shadow_threshold=0.3)), [0.3, 0.3]
    )


def test_feathering_falls_linearly_from_centre_to_border():
    weights = feathering((21, 41))
    assert weights[10, 20] == 1.0
    np.testing.assert_allclose(np.diff(weights[10, 20:]), -2 / 41, rtol=1e-5)
    assert weights[10, 0] == pytest.approx(1 / 41)  # half a pixel from the border
    np.testing.assert_array_equal(weights, weights[::-1, ::-1])


def test_feathering_ends_with_the_valid_pixels():
    valid = np.zeros((30, 30), bool)
    valid[5:26, 10:21] = True
    weights = feathering((30, 30), valid)
    assert weights[15, 15] == 1.0
    assert weights[:5].max() == weights[:, :10].max() == weights[:, 21:].max() == 0.0


def test_each_reason_to_leave_a_pixel_out_gives_weight_zero():
    measured = np.full((1, 12), 100.0, np.float32)
    measured[0, [2, 5, 8]] = np.nan, 3.0, 254.0
    cos_incidence, cos_emission = np.full((2, 1, 12), 0.7)
    cos_incidence[0, [10]] = 0.01
    cos_emission[0, [11]] = np.nan
    weights = pixel_weights(measured, cos_incidence, cos_emission, 5.0, 255.0, MaskSettings())
    assert np.flatnonzero(weights[0]).tolist() == [0]


def test_neighbours_of_dark_pixels_are_left_out_and_no_others():
    measured = np.full((7, 7), 100.0, np.float32)
    measured[3, 3] = 1.0
    angles = np.full((7, 7), 0.7)
    weights = pixel_weights(measured, angles, angles, 5.0, 255.0, MaskSettings())
    assert (weights == 0).sum() == 5
