"""Albedo of a known surface: noise goes, borders of units stay."""

import numpy as np
import pytest

from lommel.estimate.albedo_field import albedo_information, fit_albedo

NOISE = 3.0  # image units of 60
CONTRAST = 0.005  # rms difference of neighbouring cells


def two_units(shape=(80, 90), step=0.3):
    albedo = np.full(shape, 1 - step / 2, np.float32)
    albedo[:, shape[1] // 2 :] += step
    return albedo


def pictures(albedo, seeds=(0, 1, 2)):
    shading = [np.full(albedo.shape, 60.0, np.float32) for _ in seeds]
    noise = [np.random.default_rng(seed).normal(0, NOISE, albedo.shape) for seed in seeds]
    return shading, [
        (s * albedo + n).astype(np.float32) for s, n in zip(shading, noise, strict=True)
    ]


def fit(albedo, measured, shading):
    start = np.ones(albedo.shape, np.float32)
    images = ((*pair, NOISE) for pair in zip(shading, measured, strict=True))
    return fit_albedo(*albedo_information(albedo.shape, images), CONTRAST, start)


def test_noise_is_smoothed_away():
    albedo = two_units(step=0.0)
    shading, measured = pictures(albedo)
    single = measured[0] / 60.0
    assert (fit(albedo, measured, shading) - 1).std() < 0.25 * single.std()


def test_border_of_units_stays_sharp():
    """Least squares would spread the step of 60 contrasts evenly over some ten cells."""
    albedo = two_units()
    shading, measured = pictures(albedo)
    found = fit(albedo, measured, shading).mean(axis=0)
    middle = albedo.shape[1] // 2
    assert found[middle] - found[middle - 1] > 0.05  # of 0.3; least squares leaves 0.02
    assert found[-5] - found[4] == pytest.approx(0.3, abs=0.03)


def test_cells_without_images_take_the_albedo_around_them():
    albedo = two_units(step=0.0)
    shading, measured = pictures(albedo)
    for image in measured:
        image[30:40, 30:40] = np.nan
    found = fit(albedo, measured, shading)
    assert np.isfinite(found).all()
    assert np.abs(found[30:40, 30:40] - 1).max() < 0.05
