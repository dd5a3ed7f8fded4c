"""Means over cells of the ground: what they hold, and the exposures that come from them."""

from dataclasses import replace

import numpy as np

from lommel.core.reflectance import reflectance_model
from lommel.estimate import albedo_cells
from lommel.estimate.albedo import estimate_albedo
from lommel.estimate.albedo_cells import WHOLE, Cells, cells_of
from lommel.estimate.albedo_samples import SampleBlocks
from lommel.scene.masks import MaskSettings

from .albedo_scene import EXACT, strip

SIZE = 5  # posts; the images' 40 x 48 posts and their windows are no multiples of it


def blocks_of(scene):
    model = reflectance_model("lunar-lambert")
    return SampleBlocks(scene.observations, scene.grid, scene.heights, model, MaskSettings(), 0.5)


def test_cells_are_means_of_the_used_posts_on_squares_of_the_grid():
    scene = strip(noise=0.05)
    scene.observations[2].measured[13:16, 5:9] = np.nan
    blocks = blocks_of(scene)
    cells = Cells(blocks, SIZE)
    samples = blocks.rows(0, scene.grid.shape[0])
    row, col, rows, cols = samples.windows[2]
    part = slice(samples.starts[2], samples.starts[2] + rows * cols)
    measured, weight = (
        plane[part].reshape(rows, cols) for plane in (samples.measured, samples.weight)
    )
    first_row, first_col = cells.windows[2, :2]
    for i, j in ((0, 0), (2, 1), (3, 4), (5, cells.windows[2, 3] - 1)):
        top, left = SIZE * (first_row + i) - row, SIZE * (first_col + j) - col
        square = np.s_[max(top, 0) : top + SIZE, max(left, 0) : left + SIZE]
        used = weight[square] > 0
        found = cells.images[2][0, i, j]
        expected = measured[square][used].mean() if used.any() else 0.0
        np.testing.assert_allclose(found, expected, rtol=1e-5)  # float32


def test_blocks_of_cells_hold_every_cell_once():
    cells = Cells(blocks_of(strip()), SIZE)
    found = np.zeros((len(cells.windows), *cells.shape))
    for block in range(cells.count):
        first, last = cells.span(block)
        samples = cells.block(block)
        for k, (row, col, rows, cols) in enumerate(samples.windows):
            for r in range(max(first, row), min(last, row + rows)):
                start = samples.starts[k] + (r - row) * cols
                line = samples.measured[start : start + cols]
                found[k, r, col : col + cols] += line
                np.testing.assert_array_equal(line, cells.images[k][0, r - row])
    for k, (row, col, rows, cols) in enumerate(cells.windows):
        there = found[k, row : row + rows, col : col + cols]
        np.testing.assert_array_equal(there, cells.images[k][0])


def test_small_images_are_taken_as_they_are():
    blocks = blocks_of(strip())
    assert cells_of(blocks) is blocks


def test_cells_of_which_much_is_missing_weigh_nothing():
    scene = strip()
    scene.observations[2].measured[11:13, 6:9] = np.nan
    blocks = blocks_of(scene)
    cells = Cells(blocks, SIZE)
    samples = blocks.rows(0, scene.grid.shape[0])
    row, col, rows, cols = samples.windows[2]
    part = slice(samples.starts[2], samples.starts[2] + rows * cols)
    used = np.zeros(scene.grid.shape, bool)
    used[row : row + rows, col : col + cols] = samples.weight[part].reshape(rows, cols) > 0
    share = used.reshape(len(used) // SIZE, SIZE, -1, SIZE).mean(axis=(1, 3))
    window = cells.windows[2]
    here = np.s_[window[0] : window[0] + window[2], window[1] : window[1] + window[3]]
    assert ((share[here] > 0) & (share[here] < WHOLE)).any()
    np.testing.assert_array_equal(cells.images[2][4] > 0, share[here] >= WHOLE)


def test_image_clipped_almost_everywhere_is_left_out_and_harms_no_other(monkeypatch):
    """Exposures read from what clipping had left of such images drifted by up to 13 per cent.

    Here the clipped image itself came out 3 per cent too bright.
    """
    monkeypatch.setattr(albedo_cells, "ACROSS", 8)  # cells of 5 posts in these small images
    scene = strip(noise=0.02, seed=5)
    for k in (2, 4):
        measured = scene.observations[k].measured
        measured[measured > np.quantile(measured, 0.2)] = np.nan
    settings = replace(EXACT, loss="cauchy", haze=True)
    result = estimate_albedo(scene.observations, scene.grid, scene.heights, settings)
    assert [bool(reason) for reason in result.reasons] == [k == 2 for k in range(7)]
    assert result.reasons[2].startswith("0.0 % of it is free of shadow, clipped and missing")
    error = np.log(result.exposures / scene.exposures)
    error -= np.nanmean(error)
    assert np.nanmax(np.abs(error)) < 0.01  # noise of 0.02 in the few hundred posts left of image 4


def test_images_full_of_holes_are_taken_as_they_are(monkeypatch):
    monkeypatch.setattr(albedo_cells, "ACROSS", 8)
    scene = strip()
    for observation in scene.observations:
        observation.measured[::4, ::4] = np.nan
    blocks = blocks_of(scene)
    assert cells_of(blocks) is blocks
    assert not any(blocks.reasons)


def test_image_left_out_stays_out_when_the_photometry_is_remembered(monkeypatch):
    monkeypatch.setattr(albedo_cells, "ACROSS", 8)
    scene, kept = strip(noise=0.02), []
    scene.observations[4].measured[::4, ::4] = np.nan
    given = scene.observations, scene.grid, scene.heights

    def remember(compute):
        kept[:] = kept or [compute()]
        return kept[0]

    fresh, again = (estimate_albedo(*given, remember=remember) for _ in range(2))
    assert [k for k, reason in enumerate(again.reasons) if reason] == [4]
    for name in ("albedo", "albedo_error", "count", "exposures"):
        np.testing.assert_array_equal(getattr(again, name), getattr(fresh, name))
    assert (again.groups, again.passes) == (fresh.groups, fresh.passes)
