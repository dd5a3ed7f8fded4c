"""The solver: converges quadratically, finds the truth, in both parametrisations alike."""

from dataclasses import replace

import numba
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, zoom

from lommel.core.multigrid import NormalEquations, conjugate_gradients
from lommel.core.normal_operator import slope_adjoint
from lommel.core.reflectance import reflectance_model
from lommel.estimate.holes import fill_holes
from lommel.estimate.measured_posts import measured_posts
from lommel.estimate.priors import Priors
from lommel.estimate.problem import fresh_problem
from lommel.estimate.shape_from_shading import SolverSettings, solve_surface
from lommel.estimate.surface import Surface
from lommel.scene.geometry import Observation, surface_normals, viewing_geometry
from lommel.scene.grid import Grid
from lommel.scene.view import OrthoView

from .shading_scene import EXPOSURE, blank_view, exact_problem, hills, patch_grid
from .test_measured_posts import triangulated

NOISE = 0.2  # image units, 0.3 % of the brightness
HEIGHT_SHARE = 0.4  # of the initial error may be left; measured 0.35 on this rough, small patch


def weak_priors(images, error=1.0):
    return Priors(
        noise=np.full(images, NOISE),
        roughness=0.2,
        albedo_contrast=0.002,
        dem_errors=np.array([np.inf, np.inf, np.inf, error, error / 4]),
        smoothing=4.0,
    )


def test_gauss_newton_converges_quadratically_on_an_exact_scene():
    """Zero residual at the solution: each error is a constant times the square of the last."""
    grid = patch_grid(64, 64)
    truth = hills(grid.shape, rms=8.0)
    problem = exact_problem(truth, grid, azimuths=(100.0, 190.0, 280.0))
    problem.curvature = np.zeros(3, np.float32)
    problem.masses = np.array([1e-4])  # fixes the mean height, else free
    u = truth + hills(grid.shape, seed=4, rms=3.0)
    errors = []
    for _ in range(4):
        tensors, gradient, *_ = problem.assemble(u)
        right = np.empty_like(u)
        slope_adjoint(gradient[0], gradient[1], right)
        right += np.float32(1e-4) * (u - truth)
        equations = NormalEquations(tuple(tensors), problem.curvature, problem.masses)
        u = u - conjugate_gradients(equations, right, 1e-6, 60).x
        errors.append(float(np.sqrt(np.mean((u - truth) ** 2))))
    assert errors[0] < 1.0  # m, from 3 m
    for last, error in zip(errors, errors[1:], strict=False):
        assert error < max(0.5 * last**2, 1e-3)  # m; float32 images know heights to about 1 mm


def simulated_views(truth, grid, azimuths, seed=7):
    """Noisy orthoimages of the truth, rendered on posts twice as dense as the solver's."""
    rng = np.random.default_rng(seed)
    fine_shape = (2 * grid.shape[0], 2 * grid.shape[1])
    affine = grid.affine @ grid.affine.scale(0.5)
    fine = Grid(fine_shape, affine, grid.crs, grid.body)
    heights = zoom(truth, 2, order=3, grid_mode=True, mode="nearest")
    xyz = fine.xyz(heights)
    normals = surface_normals(xyz)
    views = []
    for azimuth in azimuths:
        blank = blank_view(grid, azimuth, view_elevation_deg=88.0).observation
        geometry = viewing_geometry(xyz, normals, blank.sun_position, blank.spacecraft_position)
        image = EXPOSURE * reflectance_model().reflectance(
            geometry.cos_incidence, geometry.cos_emission, geometry.phase
        )
        image = image.reshape(grid.shape[0], 2, grid.shape[1], 2).mean(axis=(1, 3))
        image = (image + rng.normal(0, NOISE, image.shape)).astype(np.float32)
        views.append(
            OrthoView(
                Observation(
                    blank.name, grid.window, image, blank.sun_position, blank.spacecraft_position
                )
            )
        )
    return views


def rough_scene(size=160, seed=11):
    """Fractal terrain (k^-4) of about 5 degrees rms slope, and what a blurring stereo sees."""
    rng = np.random.default_rng(seed)
    k = np.hypot(np.fft.fftfreq(2 * size)[:, None], np.fft.rfftfreq(2 * size)[None, :])
    power = 1 / np.maximum(k, 0.01) ** 2 * np.exp(-((k / 0.3) ** 2))
    field = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(2 * size, 2 * size))) * power)
    field = field[:size, :size]
    field *= np.tan(np.radians(5.0)) * 20.0 / np.diff(field, axis=1).std()
    initial = gaussian_filter(field, 5.0) + rng.normal(0, 0.5, field.shape)
    return field.astype(np.float32), initial.astype(np.float32)


def rms(difference, border=10):
    inside = difference[border:-border, border:-border]
    return float(np.sqrt(np.mean(inside.astype(float) ** 2)))


@pytest.fixture(scope="module")
def solved():
    """Both parametrisations on one scene of two images, priors estimated."""
    truth, initial = rough_scene()
    grid = patch_grid(*truth.shape)
    views = simulated_views(truth, grid, (100.0, 215.0))
    answers = {}
    for kind in ("height", "ray"):
        surface = Surface(grid, 0.0, views[0].position if kind == "ray" else None)
        start = surface.posts_from_heights(initial)
        solution = solve_surface(surface, start, views, reflectance_model())
        answers[kind] = surface.heights_from_posts(solution.value.u), solution
    return truth, initial, answers


@pytest.mark.parametrize("kind", ["height", "ray"])
def test_heights_come_right_without_tuning(solved, kind):
    truth, initial, answers = solved
    assert rms(answers[kind][0] - truth) < HEIGHT_SHARE * rms(initial - truth)


def test_both_parametrisations_agree(solved):
    truth, _, answers = solved
    between = rms(answers["height"][0] - answers["ray"][0])
    assert between < 0.5 * rms(answers["height"][0] - truth)


def test_exposures_come_right(solved):
    for _, solution in solved[2].values():
        np.testing.assert_allclose(solution.value.exposures, EXPOSURE, rtol=0.01)


def test_estimated_noise_is_that_of_the_images(solved):
    for _, solution in solved[2].values():
        # sampling between pixels damps noise by up to half, bent shading adds some
        assert (solution.value.priors.noise > 0.5 * NOISE).all()
        assert (solution.value.priors.noise < 3 * NOISE).all()


def test_history_tells_every_step(solved):
    history = solved[2]["height"][1].history
    assert {"stride", "cost", "step_m", "cycles"} <= set(history[0])
    assert history[-1]["stride"] == 1


def test_single_image_improves_the_dem():
    truth, initial = rough_scene(seed=12)
    grid = patch_grid(*truth.shape)
    views = simulated_views(truth, grid, (100.0,))
    solution = solve_surface(Surface(grid, 0.0), initial, views, reflectance_model())
    assert rms(solution.value.u - truth) < 0.5 * rms(initial - truth)


def test_missing_pixels_leave_a_finite_surface():
    truth, initial = rough_scene(size=96, seed=13)
    grid = patch_grid(*truth.shape)
    (view,) = simulated_views(truth, grid, (100.0,))
    view.image[30:60, 20:50] = np.nan
    solution = solve_surface(
        Surface(grid, 0.0), initial, [view], reflectance_model(), weak_priors(1)
    )
    assert np.isfinite(solution.value.u).all()
    assert np.isnan(solution.value.measured[0][40, 30])


def test_step_limit_is_named():
    truth, initial = rough_scene(size=64, seed=14)
    grid = patch_grid(*truth.shape)
    views = simulated_views(truth, grid, (100.0,))
    settings = SolverSettings(max_steps=1, step_tolerance=1e-9)
    solution = solve_surface(
        Surface(grid, 0.0), initial, views, reflectance_model(), weak_priors(1), settings
    )
    assert solution.outcome == "step_limit"
    assert "max_steps" in solution.advice


def test_holes_are_filled_with_the_plane_around_them():
    rows, cols = np.indices((70, 90), dtype=np.float32)
    plane = 3 * rows - 2 * cols
    holed = plane.copy()
    holed[20:40, 30:60] = np.nan
    filled = fill_holes(holed)
    assert np.isfinite(filled).all()
    np.testing.assert_array_equal(filled[:20], plane[:20])
    np.testing.assert_allclose(filled, plane, atol=0.5)  # m, 1 % of the hole's relief


def test_odd_image_is_named():
    """One of four images was taken under another Sun than its table says."""
    truth, initial = rough_scene(size=96, seed=15)
    grid = patch_grid(*truth.shape)
    views = simulated_views(truth, grid, (40.0, 130.0, 220.0, 310.0))
    views[2] = views[2].with_image(views[0].image)
    solution = solve_surface(
        Surface(grid, 0.0), initial, views, reflectance_model(), weak_priors(4)
    )
    assert solution.outcome == "contradiction"
    assert views[2].name in solution.advice


@pytest.mark.parametrize(("smooth", "height"), [(0.0, 500.0), (8.0, 1000.0)])
def test_wildly_wrong_dem_is_reported_and_stays_finite(smooth, height):
    """Noise of 500 m, and hills of 1000 m that are not there; the truth has 20 m rms."""
    truth, _ = rough_scene(size=96, seed=16)
    grid = patch_grid(*truth.shape)
    views = simulated_views(truth, grid, (40.0, 160.0, 280.0))
    wild = hills(truth.shape, seed=17, smooth=smooth, rms=height)
    solution = solve_surface(Surface(grid, 0.0), wild, views, reflectance_model())
    assert solution.outcome != "converged"
    assert np.isfinite(solution.value.u).all()


def test_coarse_images_are_weighed_by_what_the_truth_leaves_of_them():
    """The residual of the true surface on coarse posts is about one of its standard errors.

    Its posts are averages, its cells means over rough ground: the noise of the pixels' mean is a
    fifth of the residual or less.
    """
    truth, _ = rough_scene(size=256)
    grid = patch_grid(*truth.shape)
    views = simulated_views(truth, grid, (100.0, 215.0))
    level = fresh_problem(Surface(grid, 0.0), truth, views, reflectance_model(), None)
    level.see(truth)
    level.exposures[:] = EXPOSURE
    level.expect(replace(weak_priors(2), roughness=0.155))  # what the priors find on this terrain
    for stride in (2, 4, 8):
        level = level.coarser()
        for k, weight in enumerate(level.weights):
            residual = (level.cells[k] - level.predict(level.initial, k))[2:-2, 2:-2]
            left = np.sqrt(np.nanmean(residual**2))
            assert left > 5 * NOISE / stride
            assert 0.4 < left * weight**0.5 < 1.6


def test_albedo_and_slope_are_told_apart_by_different_suns_only():
    truth, initial = rough_scene(size=64, seed=18)
    grid = patch_grid(*truth.shape)
    shares = []
    for azimuths in ((100.0,), (100.0, 100.0), (100.0, 280.0)):
        views = simulated_views(truth, grid, azimuths)
        views = [
            replace(view, observation=replace(view.observation, name=f"{k}.tif"))
            for k, view in enumerate(views)
        ]
        solution = solve_surface(
            Surface(grid, 0.0), initial, views, reflectance_model(), weak_priors(len(views))
        )
        shares.append(float(np.nanmedian(solution.value.separation)))
    assert shares[0] < 1e-3 and shares[1] < 1e-3
    assert shares[2] > 0.5


def test_albedo_is_recovered_under_three_suns():
    """A patchy albedo of 10 % rms neither spoils the terrain nor is spoiled by it."""
    truth, initial = rough_scene(seed=19)
    grid = patch_grid(*truth.shape)
    patches = gaussian_filter(np.random.default_rng(20).normal(size=truth.shape), 6.0)
    albedo = 1 + 0.1 * patches / patches.std()
    views = [
        view.with_image((view.image * albedo).astype(np.float32))
        for view in simulated_views(truth, grid, (40.0, 160.0, 280.0))
    ]
    solution = solve_surface(Surface(grid, 0.0), initial, views, reflectance_model())
    assert rms(solution.value.u - truth) < HEIGHT_SHARE * rms(initial - truth)
    on_cells = (albedo[1:, 1:] + albedo[1:, :-1] + albedo[:-1, 1:] + albedo[:-1, :-1]) / 4
    match = np.corrcoef(solution.value.albedo.ravel(), on_cells.ravel())[0, 1]
    assert match > 0.98


def test_haze_is_found_when_asked_for():
    truth, initial = rough_scene(seed=21)
    grid = patch_grid(*truth.shape)
    views = simulated_views(truth, grid, (40.0, 160.0, 280.0))
    views[1] = views[1].with_image(views[1].image + np.float32(6.0))
    found = {}
    for asked in (False, True):
        settings = SolverSettings(estimate_haze=asked)
        solution = solve_surface(
            Surface(grid, 0.0), initial, views, reflectance_model(), settings=settings
        )
        found[asked] = solution.value.hazes, rms(solution.value.u - truth)
    assert not found[False][0].any()
    haze = found[True][0]  # what all images share is the prior's; what they differ by is theirs
    assert haze[1] - (haze[0] + haze[2]) / 2 == pytest.approx(6.0, abs=0.5)  # image units of 60
    assert found[True][1] < HEIGHT_SHARE * rms(initial - truth)


def test_surface_does_not_depend_on_the_number_of_threads():
    truth, initial = rough_scene(
        size=280, seed=22
    )  # large enough for its levels to run in parallel
    grid = patch_grid(*truth.shape)
    views = simulated_views(truth, grid, (40.0, 160.0))
    surface, answers = Surface(grid, 0.0), []
    threads = numba.get_num_threads()
    for count in (threads, 1):
        numba.set_num_threads(count)
        try:
            solution = solve_surface(surface, initial, views, reflectance_model())
        finally:
            numba.set_num_threads(threads)
        answers.append(solution.value.u)
    np.testing.assert_array_equal(*answers)


def test_known_albedo_and_exposures_are_held_and_used():
    """Patches of 30 % under one Sun spoil the surface, unless their albedo is given."""
    truth, initial = rough_scene()
    grid = patch_grid(*truth.shape)
    rng = np.random.default_rng(3)
    patches = 1 + 0.3 * np.sign(gaussian_filter(rng.normal(size=grid.shape), 12))
    view = simulated_views(truth, grid, (100.0,))[0]
    view = view.with_image((view.image * patches).astype(np.float32))
    albedo = ((patches[1:, 1:] + patches[:-1, :-1]) / 2).astype(np.float32)
    surface = Surface(grid, 0.0)
    known = np.array([EXPOSURE]), np.array([0.0])
    told, alone = (
        solve_surface(surface, initial, [view], reflectance_model(), albedo=a, photometry=p).value
        for a, p in ((albedo, known), (None, None))
    )
    assert told.exposures[0] == EXPOSURE and told.hazes[0] == 0.0
    assert np.array_equal(told.albedo, albedo)
    assert rms(told.u - truth) < 0.8 * rms(alone.u - truth)


@pytest.mark.parametrize(
    ("azimuths", "share", "likeness"), [((95.0,), 0.25, 0.7), ((95.0, 150.0), 0.05, 0.99)]
)
def test_gaps_between_altimeter_tracks_are_filled_on_patchy_ground(azimuths, share, likeness):
    """Tracks 30 posts apart, light across them, albedo 5 % rms, which two Suns tell from relief."""
    truth, _ = rough_scene()
    grid = patch_grid(*truth.shape)
    dem, _ = triangulated(truth, range(2, truth.shape[1], 30))
    dem = np.where(np.isfinite(dem), dem, truth.mean()).astype(np.float32)
    patches = 1 + 0.05 * hills(grid.shape, seed=5, smooth=15.0, rms=1.0)
    views = [
        view.with_image((factor * view.image * patches).astype(np.float32))
        for factor, view in zip((1.0, 1.4), simulated_views(truth, grid, azimuths), strict=False)
    ]
    measured = measured_posts(dem)
    start = fill_holes(np.where(measured, dem, np.nan).astype(np.float32))
    found = solve_surface(
        Surface(grid, 0.0), start, views, reflectance_model(), measured=measured
    ).value
    assert rms(found.u - truth) < share * rms(dem - truth)
    albedo = (patches[1:, 1:] + patches[:-1, :-1]) / 2
    assert np.corrcoef(found.albedo.ravel(), albedo.ravel())[0, 1] > likeness
    if len(views) == 2:
        assert found.exposures[1] / found.exposures[0] == pytest.approx(1.4, rel=0.01)
