"""Spectra behind an image: relief and noise are told apart by direction."""

import numpy as np
import pytest

from lommel.estimate.priors import estimate_priors, separate

SPACING = (20.0, 20.0)
FIT = 0.25  # relative; the shortest octaves hold thousands of modes, the longest used about 100


def relief(size, seed, level=4.0):
    """Heights with the spectrum level / k^4, k in rad per post."""
    rng = np.random.default_rng(seed)
    k = 2 * np.pi * np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :])
    white = np.fft.rfft2(rng.normal(size=(size, size)))
    return np.fft.irfft2(white * level**0.5 / np.maximum(k, 0.02) ** 2, s=(size, size))


def shade(heights, gain):
    p = (heights[:-1, 1:] - heights[:-1, :-1] + heights[1:, 1:] - heights[1:, :-1]) / 2
    q = (heights[1:, :-1] - heights[:-1, :-1] + heights[1:, 1:] - heights[:-1, 1:]) / 2
    return gain[0] * p / SPACING[1] + gain[1] * q / SPACING[0]


@pytest.mark.parametrize("gain", [(80.0, 0.0), (-40.0, 70.0)])
def test_relief_and_noise_are_separated(gain):
    rng = np.random.default_rng(1)
    heights = relief(385, 2)
    image = shade(heights, gain) + rng.normal(0, 1.5, (384, 384))
    spectra = separate(image, gain, SPACING)
    level = spectra.relief * spectra.wavenumber**4
    np.testing.assert_allclose(level[1:4], 4.0, rtol=FIT)
    np.testing.assert_allclose(spectra.noise[:2] ** 0.5, 1.5, rtol=FIT)


def test_albedo_is_not_taken_for_relief():
    """A field that does not know the Sun's azimuth is noise, whatever its spectrum."""
    heights = relief(385, 2)
    albedo = relief(384, 3, level=0.1)
    gain = (80.0, 0.0)
    spectra = separate(shade(heights, gain) + albedo, gain, SPACING)
    plain = separate(shade(heights, gain), gain, SPACING)
    np.testing.assert_allclose(spectra.relief[:3], plain.relief[:3], rtol=FIT)
    assert (spectra.noise[:3] > 5 * plain.noise[:3]).all()


def test_roughness_and_noise_of_a_scene_are_found():
    rng = np.random.default_rng(4)
    heights = relief(385, 5)
    gain = (80.0, 10.0)
    image = 60.0 + shade(heights, gain) + rng.normal(0, 1.0, (384, 384))
    flat = np.zeros_like(image)
    priors = estimate_priors(
        [image], [image - 60.0], [gain], SPACING, lambda field, _: shade(field, gain) + flat
    )
    assert priors.noise[0] == pytest.approx(1.0, rel=FIT)
    assert priors.roughness == pytest.approx(4.0**0.5 / 20.0, rel=FIT)


def test_missing_cells_do_not_disturb():
    rng = np.random.default_rng(6)
    gain = (80.0, 0.0)
    image = shade(relief(385, 7), gain) + rng.normal(0, 1.5, (384, 384))
    holed = image.copy()
    holed[rng.random(image.shape) < 0.01] = np.nan
    whole, part = separate(image, gain, SPACING), separate(holed, gain, SPACING)
    np.testing.assert_allclose(part.relief[2:4], whole.relief[2:4], rtol=FIT)


def test_blank_image_has_no_spectra():
    spectra = separate(np.full((64, 64), np.nan), (80.0, 0.0), SPACING)
    assert not spectra.relief.any() and not spectra.noise.any()
