"""Means over cells of the ground: what they hold, and the exposures that come from them."""

import numpy as np

from lommel.core.reflectance import reflectance_model
from lommel.estimate.albedo_cells import Cells, cells_of
from lommel.estimate.albedo_samples import SampleBlocks
from lommel.scene.masks import MaskSettings

from .albedo_scene import strip

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
