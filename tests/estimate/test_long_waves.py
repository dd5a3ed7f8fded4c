"""Parts of a scene that were tilted against each other come to one surface."""

import numpy as np
import pytest

from lommel.estimate.long_waves import Part, remainder, settle, without_tilt
from lommel.estimate.priors import Priors
from lommel.estimate.problem import coarse_posts
from lommel.scene.grid import Window

from .shading_scene import exact_problem, hills, patch_grid

PRIORS = Priors(
    noise=np.array([0.3, 0.3]),
    roughness=0.05,
    dem_errors=np.array([np.inf, np.inf, np.inf, 3.0]),
    smoothing=0.0,
    albedo_contrast=0.0,
    albedo_error=0.0,
)
MIDDLE = 32  # column where the second half begins


@pytest.mark.parametrize(("halvings", "left_share"), [(1, 0.05), (2, 0.2)])  # 16 posts are few
def test_tilts_of_parts_are_taken_back(halvings, left_share):
    grid = patch_grid(40, 64)
    truth = hills(grid.shape, smooth=2.0)
    level = exact_problem(truth, grid, azimuths=(100.0, 200.0))
    level.expect(PRIORS)
    rows, cols = grid.shape
    row, col = (np.linspace(-1, 1, size, dtype=np.float32) for size in grid.shape)
    row, col = np.broadcast_arrays(row[:, None], col)
    # nothing is left to do at the truth; each half errs by a wave of its own, some cm
    errors = 0.05 * row, 0.05 * np.cos(2 * col) - 0.02 * row
    rise = np.clip((np.arange(cols, dtype=np.float32) - MIDDLE + 4) / 8, 0, 1)
    shares = [np.broadcast_to(share, grid.shape) for share in (1 - rise, rise)]
    stride = 2**halvings
    shape = coarse_posts(np.zeros(grid.shape, np.float32))
    for _ in range(halvings - 1):
        shape = coarse_posts(shape)
    shape = shape.shape
    whole, middle, parts = Window(0, 0, *shape), MIDDLE // stride, []
    places = Window(0, 0, shape[0], middle), Window(0, middle, shape[0], shape[1] - middle)
    owned = (slice(0, rows), slice(0, MIDDLE)), (slice(0, rows), slice(MIDDLE, cols))
    for own, place, error, share in zip(owned, places, errors, shares, strict=True):
        u = truth + error
        left = remainder(level, level.expand(u), u, own, halvings)
        coarse = share
        for _ in range(halvings):
            coarse = coarse_posts(coarse)
        parts.append(Part(left, whole, place, coarse))
    blended = sum(share * error for share, error in zip(shares, errors, strict=True))
    for _ in range(halvings):
        blended = coarse_posts(np.ascontiguousarray(blended))
    correction = settle(parts, shape, keeps_plane=False)
    assert np.std(blended + correction) < left_share * np.std(blended)
    assert abs(np.mean(correction)) < 1e-5  # m: the mean is left to the parts


def test_the_plane_stays_when_exposures_are_free():
    rng = np.random.default_rng(1)
    change = rng.normal(size=(9, 14)).astype(np.float32)
    row, col = np.mgrid[0:9, 0:14].astype(np.float32)
    np.testing.assert_allclose(
        without_tilt(change + 3 + 0.2 * row - 0.5 * col), without_tilt(change), atol=1e-5
    )  # m, float32
