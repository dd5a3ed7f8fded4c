import numpy as np
import pytest

from lommel.core.reflectance import reflectance_model
from lommel.errors import InputError
from lommel.estimate.albedo_quality import (
    brightness_ramp,
    disagreement,
    nmad,
    predict_image,
    shading_in_albedo,
    slope_towards_sun,
)
from lommel.estimate.albedo_samples import collect_samples
from lommel.scene.masks import MaskSettings

from .albedo_scene import strip


def samples_of(scene):
    return collect_samples(
        scene.observations,
        scene.grid,
        scene.heights,
        reflectance_model("lunar-lambert"),
        MaskSettings(),
        None,
    )[0]


def test_nmad_is_the_standard_deviation_of_gaussian_values():
    values = np.random.default_rng(0).normal(3.0, 2.0, 100_000)
    assert nmad(values) == pytest.approx(2.0, rel=0.02)


def test_images_that_fit_exactly_do_not_disagree():
    scene = strip(noise=0.0, haze=3.0)
    samples = samples_of(scene)
    truth = disagreement(samples, scene.grid.shape, scene.exposures, scene.hazes, np.zeros(4))
    assert truth < 1e-5
    assert disagreement(samples, scene.grid.shape) > 0.1


def test_disagreement_is_the_noise_less_what_the_mean_takes_up():
    noise = 0.03
    scene = strip(noise=noise)
    found = disagreement(samples_of(scene), scene.grid.shape, scene.exposures, None, np.zeros(4))
    assert noise * np.sqrt(1 / 2) < found < noise * np.sqrt(3 / 4) * 1.05


def test_disagreement_of_one_image_is_unknown():
    scene = strip()
    scene.observations[1:] = []
    assert np.isnan(disagreement(samples_of(scene), scene.grid.shape))


def test_prediction_finds_exposure_and_haze_despite_outliers():
    rng = np.random.default_rng(1)
    modelled = rng.uniform(0.2, 1.0, 5000)
    measured = (80.0 * modelled + 6.0) * (1 + 0.02 * rng.normal(size=5000))
    measured[::20] *= 3.0
    exposure, haze, error = predict_image(measured, modelled, haze_error=0.5)
    assert exposure == pytest.approx(80.0, rel=0.01)
    assert haze == pytest.approx(6.0, abs=0.5)
    assert error == pytest.approx(0.02, rel=0.1)


def test_prediction_without_haze_fits_exposure_only():
    modelled = np.linspace(0.2, 1.0, 50)
    exposure, haze, error = predict_image(80.0 * modelled, modelled, haze_error=0.0)
    assert (exposure, haze) == (pytest.approx(80.0), 0.0)
    assert error < 1e-12


def test_prediction_of_nothing_is_refused():
    with pytest.raises(InputError, match="at least two pixels"):
        predict_image(np.ones(1), np.ones(1), 0.1)


def test_ramp_is_the_log_ratio_of_the_ends():
    along = np.linspace(0.0, 1.0, 200)
    albedo = np.broadcast_to(2.0 * np.exp(0.4 * along), (30, 200))
    assert brightness_ramp(albedo, np.full((30, 200), 5)) == pytest.approx(0.4)
    assert brightness_ramp(albedo[::-1].T, np.full((200, 30), 5)) == pytest.approx(0.4)


def test_albedo_that_is_a_hillshade_is_recognised():
    scene = strip()
    slope = slope_towards_sun(
        scene.grid, scene.heights, [o.sun_position for o in scene.observations]
    )
    correlation, gain = shading_in_albedo(np.exp(0.8 * slope), slope)
    assert correlation > 0.99
    assert gain == pytest.approx(0.8, rel=0.02)
    other = np.random.default_rng(3).normal(size=slope.shape)
    assert abs(shading_in_albedo(np.exp(0.1 * other), slope)[0]) < 0.05


def test_slope_faces_the_sun_where_the_ground_rises_away_from_it():
    scene = strip()  # Sun in the east
    heights = -50.0 * np.arange(scene.grid.shape[1]) * np.ones(scene.grid.shape)
    slope = slope_towards_sun(scene.grid, heights, [scene.observations[0].sun_position])
    np.testing.assert_allclose(slope, 50.0 / scene.grid.spacing[1], rtol=0.01)  # the body is round
