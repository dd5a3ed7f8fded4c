import numpy as np
import pytest
from scipy.fft import irfft2, rfft2
from scipy.ndimage import fourier_shift, gaussian_filter

from lommel.estimate.registration_matching import bands, match

REACH = 12  # posts
PEAK = 0.05  # posts; the parabola through a sampled peak


def relief(seed, size=160, smooth=1.5):
    return gaussian_filter(np.random.default_rng(seed).standard_normal((size, size)), smooth)


def moved(picture, shift):
    """What stands at r in the picture stands at r + shift in the answer."""
    size = picture.shape[1]
    spectrum = fourier_shift(rfft2(picture), shift, n=size)
    return irfft2(spectrum, picture.shape)


def pair(shift, seed=1, noise=0.0):
    second = relief(seed)
    first = moved(second, (-shift[0], -shift[1]))[REACH:-REACH, REACH:-REACH]
    return first + noise * relief(seed + 100)[REACH:-REACH, REACH:-REACH], second


@pytest.mark.parametrize("shift", [(0.0, 0.0), (5.3, -7.8), (-11.0, 2.5)])
def test_shift_is_found_to_a_fraction_of_a_post(shift):
    found = match(*pair(shift), REACH)
    np.testing.assert_allclose(found.shift, shift, atol=PEAK)
    assert found.is_distinct
    assert found.correlation > 0.95


def test_contrast_and_brightness_do_not_matter():
    first, second = pair((3.0, 4.0))
    found = match(1000.0 + 5.0 * first, second, REACH)
    np.testing.assert_allclose(found.shift, (3.0, 4.0), atol=PEAK)


def test_missing_parts_do_not_matter():
    first, second = pair((3.0, 4.0))
    first[:, :40] = np.nan
    second[100:140, 60:100] = np.nan
    found = match(first, second, REACH)
    np.testing.assert_allclose(found.shift, (3.0, 4.0), atol=2 * PEAK)


def test_a_slow_brightness_change_does_not_matter():
    first, second = pair((3.0, 4.0))
    ramp = np.linspace(0, 20 * first.std(), first.shape[1])
    np.testing.assert_allclose(match(first + ramp, second, REACH).shift, (3.0, 4.0), atol=0.3)


@pytest.mark.parametrize("seed", range(8))
def test_unrelated_pictures_have_no_distinct_shift(seed):
    found = match(relief(seed)[REACH:-REACH, REACH:-REACH], relief(seed + 50), REACH)
    assert not found.is_distinct


def test_a_negative_is_not_a_match():
    first, second = pair((3.0, 4.0))
    assert not match(-first, second, REACH).is_distinct


def test_the_error_told_is_the_error_made():
    """Over many noisy pairs the scatter of the shift is what the covariance says, within half."""
    shifts, variances = [], []
    for seed in range(40):
        found = match(*pair((2.0, -3.0), seed, noise=2.0), REACH)
        shifts.append(found.shift - (2.0, -3.0))
        variances.append(np.trace(found.covariance) / 2)
    scatter = np.sqrt(np.mean(np.square(shifts)))
    assert scatter / np.sqrt(np.mean(variances)) == pytest.approx(1.0, abs=0.5)


def test_waves_that_a_coarse_picture_lacks_are_not_looked_at():
    first, second = pair((0.0, 0.0))
    fine = relief(9, smooth=1.0)
    noisy = first + fine[REACH:-REACH, REACH:-REACH]
    found = match(noisy, moved(fine, (6.0, 6.0)) * 3 + second, REACH, shortest=16.0)
    assert found.likelihood < match(first, second, REACH).likelihood


def test_pictures_without_common_ground_do_not_match():
    first, second = pair((0.0, 0.0))
    assert match(np.full_like(first, np.nan), second, REACH) is None


def test_a_flat_picture_has_no_waves():
    assert (next(bands(np.full((40, 40), 3.0), np.array([4.0]))) == 0).all()
    found = match(np.full((60, 60), 3.0), relief(1, 60 + 2 * REACH), REACH)
    assert found is None or not found.is_distinct
