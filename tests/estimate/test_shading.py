"""The compiled passes: Jacobian against finite differences, sums, sampling, missing cells."""

import numpy as np
import pytest
from affine import Affine
from scipy.ndimage import binary_dilation, zoom

from lommel.core.normal_operator import slope_adjoint
from lommel.core.reflectance import reflectance_model, user_model
from lommel.estimate.problem import fresh_problem
from lommel.estimate.sampling_kernels import sample_cells
from lommel.estimate.shading_kernels import SUM_COUNT, SUM_FF, SUM_FM
from lommel.estimate.surface import Surface
from lommel.scene.geometry import surface_normals, unit, viewing_geometry
from lommel.scene.grid import Grid
from lommel.scene.shadows import sunlit

from .shading_scene import EXPOSURE, blank_view, exact_problem, hills, patch_grid

# Central differences with steps of 0.05 m against the analytic derivative: float32 images carry
# 1e-5, a step changes the cost by more than 1e-3 of itself, and rays leave out a term of the size
# spacing / distance = 2e-4.
JACOBIAN = 5e-3
MODELS = ["lunar-lambert", "lambert", "lommel-seeliger", "minnaert", "hapke"]


def moved_problem(parametrisation="height", azimuths=(100.0, 220.0), model=None):
    grid = patch_grid()
    truth = hills(grid.shape)
    problem = exact_problem(truth, grid, azimuths, parametrisation, model)
    u = truth + hills(grid.shape, seed=1, rms=2.0)
    return problem, u


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("parametrisation", ["height", "ray"])
def test_gradient_is_that_of_the_cost(parametrisation, model):
    problem, u = moved_problem(parametrisation, model=reflectance_model(model))
    gradient = problem.assemble(u)[1]
    at_posts = np.empty_like(u)
    slope_adjoint(gradient[0], gradient[1], at_posts)
    direction = hills(u.shape, seed=2, smooth=2.0, rms=1.0)
    step = np.float32(0.05)
    ahead, behind = (problem.assemble(u + s * direction)[2][:, 0].sum() for s in (step, -step))
    numeric = (ahead - behind) / (2 * float(step)) / 2  # the gradient is that of half the cost
    assert np.vdot(at_posts, direction) == pytest.approx(numeric, rel=JACOBIAN)


@pytest.mark.parametrize("parametrisation", ["height", "ray"])
def test_tensors_are_the_squared_jacobian(parametrisation):
    """For small steps the images change by the Jacobian, whose squares the tensors hold."""
    problem, u = moved_problem(parametrisation, azimuths=(100.0,))
    problem.cells[0][:] = problem.predict(u, 0)  # no residual: the cost is the squared change
    tensors = problem.assemble(u)[0]
    tensors[0] -= problem.slope[0]
    tensors[2] -= problem.slope[1]
    direction = hills(u.shape, seed=3, smooth=2.0, rms=1.0)
    step = 0.02
    change = (problem.predict(u + np.float32(step) * direction, 0) - problem.cells[0]) / step
    p = (direction[:-1, 1:] - direction[:-1, :-1] + direction[1:, 1:] - direction[1:, :-1]) / 2
    q = (direction[1:, :-1] - direction[:-1, :-1] + direction[1:, 1:] - direction[:-1, 1:]) / 2
    expected = (tensors[0] * p * p + 2 * tensors[1] * p * q + tensors[2] * q * q).sum()
    assert (change.astype(float) ** 2).sum() == pytest.approx(expected, rel=0.01)


def test_modelled_image_is_exposure_times_reflectance_of_the_terrain():
    """Against the plain array geometry, whose normals span two posts instead of one cell."""
    grid = patch_grid()
    heights = hills(grid.shape, smooth=8.0)
    problem = exact_problem(heights, grid)
    xyz = grid.xyz(heights)
    view = problem.views[0]
    geometry = viewing_geometry(xyz, surface_normals(xyz), view.sun_position, view.position)
    plain = EXPOSURE * reflectance_model().reflectance(
        geometry.cos_incidence, geometry.cos_emission, geometry.phase
    )
    cells = problem.cells[0]
    posts = (cells[1:, 1:] + cells[1:, :-1] + cells[:-1, 1:] + cells[:-1, :-1]) / 4
    # hills of 160 m correlation length: slopes over 20 and over 40 m differ by 1 % of the shading
    np.testing.assert_allclose(posts[3:-3, 3:-3], plain[4:-4, 4:-4], atol=0.01 * EXPOSURE)


def lambert_of_a_user(cos_incidence, cos_emission, phase, gain=1.0):
    """A user's own law, without compiled twin."""
    return gain * cos_incidence, gain * np.ones_like(cos_incidence), np.zeros_like(cos_incidence)


def test_law_of_a_user_gives_the_same_as_the_compiled_one():
    compiled, u = moved_problem(model=reflectance_model("lambert"))
    own, _ = moved_problem(model=user_model(lambert_of_a_user, "own"))
    for mine, theirs in zip(own.assemble(u)[:3], compiled.assemble(u)[:3], strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-3)


def test_missing_cells_do_not_count():
    problem, u = moved_problem()
    problem.cells[0][:10] = np.nan
    tensors, gradient, sums, *_ = problem.assemble(u)
    assert np.isfinite(tensors).all() and np.isfinite(gradient).all()
    assert sums[0, SUM_COUNT] == problem.cells[0][10:].size
    assert sums[1, SUM_COUNT] == problem.cells[1].size


def test_exposure_of_an_exact_scene_is_found_from_the_sums():
    problem, _ = moved_problem()
    truth = problem.initial
    problem.exposures[:] = 50.0
    sums = problem.assemble(truth)[2]
    np.testing.assert_allclose(sums[:, SUM_FM] / sums[:, SUM_FF], EXPOSURE, rtol=1e-4)


def planes(line, sample, shape=(4, 4)):
    """Lattice planes of cells that fall on line + row, sample + col of the image."""
    rows, cols = 16.0 * np.arange(shape[0])[:, None], 16.0 * np.arange(shape[1])[None, :]
    zero = np.zeros(shape)
    at = [rows + line + zero, cols + sample + zero, zero, zero, zero, zero]
    return np.stack(at).astype(np.float32)


def sample(image, line, sample_, shape=(30, 30)):
    out = np.empty((shape[0] - 1, shape[1] - 1), np.float32)
    u = np.zeros(shape, np.float32)
    sample_cells(image, planes(line, sample_), 16, u, np.zeros((1, 1), np.float32), out)
    return out


def test_sampling_reproduces_quadratics():
    """Catmull-Rom interpolation is exact for second-degree polynomials away from the border."""
    rows, cols = np.indices((40, 40), dtype=float)

    def surface(r, c):
        return 1 + 0.2 * r - 0.1 * c + 0.01 * r * r + 0.02 * r * c

    image = surface(rows, cols).astype(np.float32)
    out = sample(image, 3.2, 4.7)
    r, c = np.indices(out.shape) + 0.5
    np.testing.assert_allclose(out, surface(r + 3.2, c + 4.7), rtol=2e-6)


def test_sampling_outside_the_image_is_missing():
    out = sample(np.ones((20, 20), np.float32), 0.0, 0.0)
    assert np.isfinite(out[:18, :18]).all()
    assert np.isnan(out[20:]).all() and np.isnan(out[:, 20:]).all()


def test_missing_pixels_do_not_spread_beyond_their_neighbours():
    image = np.ones((40, 40), np.float32)
    image[20, 20] = np.nan
    out = sample(image, 2.0, 2.0)
    assert np.isnan(out).sum() == 4


def test_cast_shadow_agrees_with_ray_marching_on_the_sphere():
    """Against `lommel.scene.shadows`, which follows each post's own ray over the curved body."""
    grid = patch_grid(96, 96)
    heights = hills(grid.shape, smooth=4.0, rms=40.0)
    view = blank_view(grid, 100.0)
    problem = fresh_problem(Surface(grid, 0.0), heights, [view], reflectance_model(), None)
    problem.prepare_geometry(heights)
    problem.cells[0][:] = 0.0  # dark everywhere: the image denies no shadow
    problem.find_shadows(heights)
    fine = Grid((191, 191), grid.affine @ Affine.scale(0.5), grid.crs, grid.body)
    fine_heights = zoom(heights, 191 / 96, order=1, grid_mode=False)
    lit = sunlit(fine, fine_heights, view.sun_position)[1::2, 1::2]
    shadow = problem.shadows[0]
    assert 0.02 < (~lit).mean() < 0.6
    assert shadow[~lit].mean() > 0.97  # all of it, but for rims thinner than a post
    grown = binary_dilation(~lit, iterations=3)
    assert shadow[~grown].mean() < 0.01


def test_points_that_rise_along_the_view_take_the_slope_of_the_ground_along():
    """On a plane the surface through points moved along their rays is known in closed form."""
    grid = patch_grid()
    row, col = np.indices(grid.shape).astype(np.float32)
    u = 3 * row - 2 * col  # m; 9 and 6 degrees
    problem = exact_problem(u, grid)
    lattice, at_nodes, frame, _, _ = problem.geometry
    to_camera = unit(problem.views[0].position - frame.xyz)
    rise = np.einsum("...i,...i", to_camera, frame.up)[..., None]
    crossed = problem.surface.posts_crossed(lattice, at_nodes, to_camera / rise - frame.up)
    drift = crossed.mean(axis=(1, 2))  # posts per m: 20 degrees from the vertical, 20 m posts
    assert np.hypot(*drift) == pytest.approx(np.tan(np.radians(20)) / 20, rel=0.02)
    step = np.full(grid.shape, 0.5, np.float32)
    problem.slide_along_views(step, u)
    np.testing.assert_allclose(step, 0.5 * (1 - 3 * drift[0] + 2 * drift[1]), rtol=2e-3)
