from dataclasses import replace

import numpy as np
import pytest

from lommel.core.reflectance import reflectance_model
from lommel.estimate import albedo as solver
from lommel.estimate import albedo_samples
from lommel.estimate.albedo import estimate_albedo
from lommel.estimate.albedo_light import TerrainPart
from lommel.estimate.albedo_maps import WholeMaps
from lommel.estimate.albedo_samples import (
    SampleBlocks,
    block_edges,
    clipped,
    image_geometry,
)
from lommel.scene.grid import Window, grid_from_bounds, read_crs
from lommel.scene.masks import MaskSettings

from .albedo_scene import strip

ROUNDING = 1e-6  # rad and cosines; stored as float32
POLAR = "+proj=stere +lat_0=90 +R=1737400 +units=m +no_defs"


@pytest.mark.parametrize("crs", [None, POLAR])
def test_compiled_light_is_that_of_the_array_version(crs):
    scene = strip()
    grid, heights = scene.grid, scene.heights.copy()
    if crs is not None:
        grid = grid_from_bounds((0.0, 0.0, *np.array(grid.bounds)[2:]), 1000.0, read_crs(crs))
    heights[10:12, 20:30] = np.nan
    image = scene.observations[1]
    expected = image_geometry(grid, heights, image)
    rows = Window(image.window.row + 3, image.window.col, 20, image.window.cols)
    part = TerrainPart(grid, heights, Window(rows.row, 0, rows.rows, grid.shape[1]))
    found = part.geometry(rows, image.sun_position, image.spacecraft_position)
    for name in ("cos_incidence", "cos_emission", "phase", "off_axis"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name)[3:23], rtol=0, atol=ROUNDING
        )


def blocks_of(scene, **changes):
    model = reflectance_model("lunar-lambert")
    return SampleBlocks(
        scene.observations, scene.grid, scene.heights, model, MaskSettings(), 0.5, **changes
    )


def test_rows_hold_what_the_whole_holds():
    """Halos of masks and normals reach over the border of the rows."""
    scene = strip(noise=0.05)
    scene.observations[2].measured[13:16, 5:9] = np.nan
    blocks = blocks_of(scene)
    whole, part = blocks.rows(0, scene.grid.shape[0]), clipped(blocks.rows(14, 17), 14, 17)
    for k, (row, _, rows, cols) in enumerate(whole.windows):
        there = whole.starts[k] + (14 - row) * cols
        here = part.starts[k]
        assert part.windows[k, 2] == 3 and rows > 3
        for all_rows, some_rows in zip(whole[2:], part[2:], strict=True):
            np.testing.assert_array_equal(
                some_rows[here : here + 3 * cols], all_rows[there : there + 3 * cols]
            )


@pytest.mark.parametrize("kept_pixels", [0, 5000])
def test_samples_computed_anew_give_the_same_answer(kept_pixels):
    scene = strip(noise=0.02)
    given = scene.observations, scene.grid, scene.heights
    kept, anew = estimate_albedo(*given), estimate_albedo(*given, kept_pixels=kept_pixels)
    np.testing.assert_array_equal(anew.exposures, kept.exposures)
    np.testing.assert_array_equal(anew.albedo, kept.albedo)
    np.testing.assert_array_equal(anew.albedo_error, kept.albedo_error)
    assert anew.disagreement == kept.disagreement


def test_samples_are_kept_as_far_as_they_fit():
    blocks = blocks_of(strip(), kept_pixels=5000)
    sizes = [len(blocks.block(block).measured) for block in range(blocks.count)]
    kept = [blocks.block(block) is blocks.block(block) for block in range(blocks.count)]
    assert 0 < sum(kept) < blocks.count
    assert 5000 - max(sizes) < np.dot(sizes, kept) <= 5000
    assert sum(sizes) == blocks.pixels


def test_blocks_cover_all_rows_and_are_small_where_many_images_are():
    windows = np.array([[0, 0, 4000, 100], *[[1000, 0, 200, 20000]] * 50])
    edges, above = block_edges(windows, (4000, 20000))
    assert (edges[0], edges[-1]) == (0, 4000) and above[-1] == 4000 * 100 + 50 * 200 * 20000
    heights = np.diff(edges)
    assert heights.min() >= 1 and heights.max() * 20000 <= albedo_samples.POSTS_AT_ONCE
    assert np.diff(above[edges]).max() <= albedo_samples.PIXELS_AT_ONCE


def test_more_blocks_change_rounding_only(monkeypatch):
    scene = strip(noise=0.02)
    settings = replace(solver.AlbedoSettings(), tolerance=1e-9)
    few = estimate_albedo(scene.observations, scene.grid, scene.heights, settings)
    monkeypatch.setattr(albedo_samples, "PIXELS_AT_ONCE", 300)
    many = estimate_albedo(scene.observations, scene.grid, scene.heights, settings)
    np.testing.assert_allclose(many.exposures, few.exposures, rtol=1e-6)
    np.testing.assert_allclose(many.albedo, few.albedo, rtol=1e-6)


def test_thinned_images_tell_nearly_the_same_level(monkeypatch):
    scene = strip(noise=0.02)
    every = blocks_of(scene)
    monkeypatch.setattr(albedo_samples, "THIN", 700)
    monkeypatch.setattr(albedo_samples, "STRIP", 2)
    thinned = blocks_of(scene)
    np.testing.assert_allclose(thinned.levels, every.levels, rtol=0.05)  # of a start value


def test_rows_given_away_are_those_of_the_result():
    scene = strip(noise=0.02)
    whole = estimate_albedo(scene.observations, scene.grid, scene.heights)
    taken = WholeMaps(scene.grid.shape)
    result = estimate_albedo(scene.observations, scene.grid, scene.heights, take=taken)
    assert result.albedo is None
    np.testing.assert_array_equal(taken.rows.albedo, whole.albedo)
    np.testing.assert_array_equal(taken.rows.count, whole.count)
    assert result.passes == whole.passes
