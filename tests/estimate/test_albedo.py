import itertools
from dataclasses import replace

import numpy as np
import pytest

from lommel.core.reflectance import reflectance_model
from lommel.errors import InputError
from lommel.estimate import albedo as solver
from lommel.estimate.albedo import estimate_albedo
from lommel.estimate.albedo_arrays import OWN, SHARED, State
from lommel.estimate.albedo_equations import haze_spread, normal_equations, visit
from lommel.estimate.albedo_samples import SampleBlocks, collect_samples
from lommel.estimate.albedo_settings import AlbedoSettings, published_settings
from lommel.scene.masks import MaskSettings

from .albedo_scene import COLS, EXACT, ROWS, strip

ROUNDING = 1e-5  # share; images are stored as float32
PERCENT = 0.01
PHASE_FACTOR = (1.2, 0.4)


def relative(found, truth):
    """Error of each value as a share, after bringing both to one mean."""
    return found / np.mean(found) / (truth / np.mean(truth)) - 1.0


def albedo_error(result, scene):
    """Errors as a share, where at least two images see the ground, scale taken out."""
    seen = result.count >= 2
    ratio = result.albedo[seen] / scene.albedo[seen]
    return ratio / np.median(ratio) - 1.0


@pytest.fixture(scope="module")
def noisy():
    return strip(noise=0.02)


@pytest.fixture(scope="module")
def default_result(noisy):
    settings = AlbedoSettings(phase_factor=None, fit_phase_factor=False, fit_falloff=False)
    return estimate_albedo(noisy.observations, noisy.grid, noisy.heights, settings)


def test_exact_images_return_exposure_and_albedo():
    scene = strip(noise=0.0)
    result = estimate_albedo(
        scene.observations, scene.grid, scene.heights, replace(EXACT, tolerance=1e-12)
    )
    assert np.abs(relative(result.exposures, scene.exposures)).max() < 10 * ROUNDING
    assert np.abs(albedo_error(result, scene)).max() < 100 * ROUNDING


def test_default_recovers_exposures_within_a_per_cent_of_noisy_images(noisy, default_result):
    assert default_result.outcome == "converged"
    error = relative(default_result.exposures, noisy.exposures)
    assert np.abs(error).max() < PERCENT
    assert np.sqrt(np.mean(albedo_error(default_result, noisy) ** 2)) < 2 * PERCENT


def test_mean_exposure_is_one(default_result):
    assert np.mean(default_result.exposures) == pytest.approx(1.0, abs=1e-12)


def test_scaling_all_images_scales_the_albedo_only(noisy, default_result):
    brighter = [replace(o, measured=3.0 * o.measured) for o in noisy.observations]
    settings = AlbedoSettings(phase_factor=None, fit_phase_factor=False, fit_falloff=False)
    result = estimate_albedo(brighter, noisy.grid, noisy.heights, settings)
    np.testing.assert_allclose(result.exposures, default_result.exposures, rtol=10 * ROUNDING)
    seen = result.count > 0
    np.testing.assert_allclose(
        result.albedo[seen], 3.0 * default_result.albedo[seen], rtol=10 * ROUNDING
    )


def test_both_solvers_find_the_same_minimum(noisy):
    """Without haze, fits, robust loss and priors, both minimise the cost of the paper."""
    alternating = published_settings(reflectance="lunar-lambert", tolerance=1e-9, max_steps=3000)
    projection = replace(
        EXACT, slope_noise=None, albedo_contrast=1e4, haze_error=1e4, tolerance=1e-10
    )
    slow, fast = (
        estimate_albedo(noisy.observations, noisy.grid, noisy.heights, settings)
        for settings in (alternating, projection)
    )
    assert slow.outcome == fast.outcome == "converged"
    np.testing.assert_allclose(slow.exposures, fast.exposures, rtol=1e-3)
    assert len(fast.history) < len(slow.history) / 5


@pytest.mark.parametrize("settings", [published_settings(), AlbedoSettings(tolerance=1e-9)])
def test_cost_never_rises(noisy, settings):
    result = estimate_albedo(noisy.observations, noisy.grid, noisy.heights, settings)
    assert len(result.history) >= 2
    for before, after in itertools.pairwise(result.history):
        if before["counted_in"] == after["counted_in"]:
            assert after["cost"] <= before["cost"]


def test_published_step_is_the_papers():
    """Steps 2 and 3 written out with plain arrays give the same exposures as one compiled pass."""
    scene = strip(noise=0.05)
    settings = published_settings(max_steps=1)
    result = estimate_albedo(scene.observations, scene.grid, scene.heights, settings)
    model = reflectance_model(settings.reflectance)
    samples, levels, _ = collect_samples(
        scene.observations, scene.grid, scene.heights, model, settings.masks, None
    )
    exposure = levels / levels.mean()
    measured, reflectance, weight = (
        plane.reshape(len(levels), ROWS, -1).astype(float)
        for plane in (samples.measured, samples.reflectance, samples.weight)
    )
    top, bottom = np.zeros((2, ROWS, COLS))
    columns = [slice(w[1], w[1] + w[3]) for w in samples.windows]
    for k, here in enumerate(columns):  # step 2
        brightness = exposure[k] * reflectance[k]
        top[:, here] += weight[k] * brightness * measured[k]
        bottom[:, here] += weight[k] * brightness**2
    albedo = np.divide(top, bottom, out=np.zeros_like(top), where=bottom > 0)
    for k, here in enumerate(columns):  # step 3
        unit = albedo[:, here] * reflectance[k]
        residual = measured[k] - exposure[k] * unit
        exposure[k] += np.sum(weight[k] * residual * unit) / np.sum(weight[k] * unit**2)
    np.testing.assert_allclose(result.exposures, exposure / exposure.mean(), rtol=ROUNDING)


def problem_at(scene, settings, shift=0.0, seed=1):
    """A problem, and a function from parameters to the point of one least-squares pass."""
    model = reflectance_model(settings.reflectance)
    blocks = SampleBlocks(
        scene.observations, scene.grid, scene.heights, model, settings.masks, settings.slope_noise
    )
    levels = blocks.levels
    problem = solver._pose(blocks, settings)
    rng = np.random.default_rng(seed)
    size = OWN * problem.images + SHARED + 1
    start = shift * rng.normal(size=size)

    def point(change):
        parameters = start + change
        own = parameters[: OWN * problem.images].reshape(-1, OWN)
        state = State(
            levels / levels.mean() * np.exp(own[:, 0]),
            levels * own[:, 1],
            levels,
            problem.shared_start + parameters[-SHARED - 1 : -1],
        )
        return visit(problem, state, parameters[-1], 0.05, 2.0)

    return problem, point, size


def test_gradient_is_that_of_the_cost():
    """Central differences of the objective, for every parameter, far from the minimum."""
    scene = strip(noise=0.05, phase_factor=PHASE_FACTOR)
    problem, point, size = problem_at(scene, AlbedoSettings(loss="least-squares"), shift=0.05)
    _, gradient = normal_equations(problem, point(0.0))
    step = 1e-4
    expected = np.array(
        [
            (point(step * axis).objective - point(-step * axis).objective) / (2 * step)
            for axis in np.eye(size)
        ]
    )
    np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_matrix_is_the_curvature_where_the_model_fits():
    """At zero residual the Gauss-Newton matrix is the second derivative of the objective."""
    scene = strip(noise=0.0, phase_factor=PHASE_FACTOR)
    settings = AlbedoSettings(loss="least-squares", phase_factor=PHASE_FACTOR, albedo_contrast=1e3)
    problem, point, size = problem_at(scene, settings)
    exposure_shift = np.log(scene.exposures / scene.exposures.mean())
    levels = point(0.0).state.exposure
    change = np.zeros(size)
    change[: OWN * problem.images : OWN] = exposure_shift - np.log(levels / levels.mean())
    matrix, _ = normal_equations(problem, point(change))
    step = 1e-4
    columns = []
    for axis in step * np.eye(size):
        ahead = normal_equations(problem, point(change + axis))[1]
        behind = normal_equations(problem, point(change - axis))[1]
        columns.append((ahead - behind) / (2 * step))
    expected = np.array(columns)
    tolerance = 1e-3 * np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.all(np.abs(matrix.toarray() - expected) < tolerance)


def test_haze_is_found_where_it_differs():
    """Two revolutions would fix haze; the strip alone with its mare border does to a few DN."""
    scene = strip(noise=0.005, haze=4.0)
    settings = replace(EXACT, haze=True, loss="cauchy")
    result = estimate_albedo(scene.observations, scene.grid, scene.heights, settings)
    assert np.corrcoef(result.hazes, scene.hazes)[0, 1] > 0.9
    without = estimate_albedo(scene.observations, scene.grid, scene.heights, EXACT)
    assert result.disagreement < 0.75 * without.disagreement


def test_phase_factor_and_falloff_are_found():
    """On ground without a border of mare: a strip cannot tell such a border from phase."""
    scene = strip(noise=0.01, phase_factor=PHASE_FACTOR, falloff=(0.0, 0.6), mare=1.0)
    result = estimate_albedo(scene.observations, scene.grid, scene.heights)
    phase = np.linspace(0.4, 1.4, 20)

    def slope(c1, c2):
        return np.gradient(np.log(np.exp(-c1 * phase) + c2), phase)

    assert np.abs(slope(*result.shared[:2]) - slope(*PHASE_FACTOR)).max() < 0.1  # per rad
    square = np.radians(14.0) ** 2  # rad^2, the edge of these images
    assert result.shared[2] * square + result.shared[3] * square**2 == pytest.approx(
        0.6 * square**2, abs=0.005
    )
    assert np.abs(relative(result.exposures, scene.exposures)).max() < 3 * PERCENT


def test_outliers_hardly_move_the_robust_exposures(noisy, default_result):
    rng = np.random.default_rng(0)

    def spoil(image):
        hit = rng.random(image.shape) < 0.05
        image[hit] *= 2.0
        return image

    settings = AlbedoSettings(phase_factor=None, fit_phase_factor=False, fit_falloff=False)
    spoilt = noisy.changed(3, spoil)
    robust = estimate_albedo(spoilt, noisy.grid, noisy.heights, settings)
    plain = estimate_albedo(
        spoilt, noisy.grid, noisy.heights, replace(settings, loss="least-squares")
    )
    robust_error, plain_error = (
        abs(relative(r.exposures, noisy.exposures)[3]) for r in (robust, plain)
    )
    assert robust_error < PERCENT
    assert plain_error > 3 * robust_error


def test_standard_errors_are_those_of_the_scatter():
    """Errors over standard errors have unit spread, whether one or four images see the post."""
    scene = strip(noise=0.03)
    settings = replace(EXACT, loss="cauchy", slope_noise=0.0)
    result = estimate_albedo(scene.observations, scene.grid, scene.heights, settings)
    gauge = np.median(result.albedo[result.count > 0] / scene.albedo[result.count > 0])
    for count in (1, 2, 4):
        here = result.count == count
        normalised = (result.albedo[here] / gauge - scene.albedo[here]) / (
            result.albedo_error[here] / gauge
        )
        assert 0.8 < np.std(normalised) < 1.35, count  # robust weights lose a few per cent
    exposures = relative(result.exposures, scene.exposures) / (
        result.exposure_errors / result.exposures
    )
    assert 0.2 < np.sqrt(np.mean(exposures**2)) < 3.0


def test_image_all_in_shadow_is_left_out_with_its_reason(noisy):
    dark = noisy.changed(2, lambda image: np.full_like(image, 0.5))
    result = estimate_albedo(dark, noisy.grid, noisy.heights, EXACT)
    assert "every pixel is shadow" in result.reasons[2]
    assert np.isnan(result.exposures[2])
    assert np.isfinite(np.delete(result.exposures, 2)).all()


def test_night_is_told_from_shadow(noisy):
    night = [replace(o, sun_position=-o.sun_position) for o in noisy.observations]
    with pytest.raises(InputError, match="the Sun is below the horizon everywhere"):
        estimate_albedo(night, noisy.grid, noisy.heights, EXACT)


def test_one_image_gives_an_albedo_of_unknown_error(noisy):
    only = noisy.observations[:1]
    result = estimate_albedo(only, noisy.grid, noisy.heights)
    assert result.exposures[0] == pytest.approx(1.0)
    assert "One image only" in result.advice
    assert np.isnan(result.albedo_error).all()
    assert np.isnan(result.disagreement)
    np.testing.assert_allclose(result.shared[:2], AlbedoSettings().phase_factor, rtol=1e-3)


def test_one_image_of_feigned_haze_does_not_permit_it_to_all(noisy):
    blocks = SampleBlocks(
        noisy.observations,
        noisy.grid,
        noisy.heights,
        reflectance_model("lunar-lambert"),
        MaskSettings(),
        0.5,
    )
    problem = solver._pose(blocks, replace(EXACT, haze=True, haze_error=0.1))
    share = np.array([0.002, -0.001, 0.0, 0.3, -0.002, 0.001, 0.001])
    haze = share * blocks.levels
    state = State(noisy.exposures, haze, blocks.brightness, problem.shared_start)
    point = visit(problem, state, 0.0, 0.01, 1.0)
    assert haze_spread(problem, point, 0.1) < 0.01  # of the level; a mean gives the most, 0.1


def test_groups_without_overlap_are_reported(noisy):
    apart = noisy.without(2, 3, 4)
    assert apart[1].window.col + apart[1].window.cols < apart[2].window.col + 13
    apart = [apart[0], apart[-1]]
    result = estimate_albedo(apart, noisy.grid, noisy.heights, EXACT)
    assert result.groups == ((0,), (1,))
    assert "2 groups that share no usable ground" in result.advice


def test_holes_in_the_terrain_stay_holes(noisy):
    heights = noisy.heights.copy()
    heights[10:15, 50:60] = np.nan
    result = estimate_albedo(noisy.observations, noisy.grid, heights, EXACT)
    assert np.isnan(result.albedo[10:15, 50:60]).all()
    assert (result.count[10:15, 50:60] == 0).all()


def test_result_does_not_depend_on_the_order_of_images(noisy, default_result):
    settings = AlbedoSettings(phase_factor=None, fit_phase_factor=False, fit_falloff=False)
    result = estimate_albedo(noisy.observations[::-1], noisy.grid, noisy.heights, settings)
    np.testing.assert_allclose(result.exposures[::-1], default_result.exposures, rtol=1e-6)


def test_too_few_steps_are_an_outcome_with_advice(noisy):
    result = estimate_albedo(
        noisy.observations, noisy.grid, noisy.heights, AlbedoSettings(max_steps=5)
    )
    assert result.outcome == "step_limit"
    assert "raise max_steps" in result.advice


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"solver": "newton"}, "solver = 'newton' is unknown. Choose one of projection"),
        ({"loss": "absolute"}, "loss = 'absolute' is unknown. Choose one of least-squares"),
        ({"albedo_contrast": 0.0}, "albedo_contrast = 0.0 is not positive"),
        ({"reflectance": "mirror"}, "reflectance = 'mirror' is unknown"),
        (
            {"masks": MaskSettings(shadow_threshold=-0.2)},
            "shadow_threshold = -0.2 is negative",
        ),
    ],
)
def test_wrong_settings_are_named(noisy, change, message):
    with pytest.raises(InputError, match=message):
        estimate_albedo(
            noisy.observations, noisy.grid, noisy.heights, replace(AlbedoSettings(), **change)
        )
