from dataclasses import replace

import numpy as np
import pytest

from lommel.simulate import preset
from lommel.simulate.settings import CraterSettings, TerrainSettings
from lommel.simulate.terrain import ground, mare_cover

BARE = TerrainSettings(octave_slope_deg=0.0, crater_coverage=0.0, mare_share=0.0)


def test_mare_covers_about_its_share():
    x = np.arange(0.0, 20_000e3, 10e3)
    assert mare_cover(1, 0.3, x, x).mean() == pytest.approx(0.3, abs=0.03)


def test_bare_ground_is_flat_but_for_the_craters_asked_for():
    settings = replace(
        preset("sfs-patch"), terrain=BARE, craters=(CraterSettings(0.0, 0.0, 2e3, rays=0.5),)
    )
    x = np.arange(-6e3, 6e3, 100.0)
    heights, albedo = ground(settings, x, x)
    far = np.hypot(x[None, :], x[:, None]) > 3.3e3
    assert (heights[far] == 0.0).all()
    assert heights.min() < -300.0
    assert albedo.max() > 1.2 * np.median(albedo)


def test_close_up_shows_the_terrain_of_the_strip():
    """The finer grid adds detail; what both resolve is the same."""
    settings = preset("sfs-patch")
    finer = replace(settings, grid=replace(settings.grid, spacing=settings.grid.spacing / 2))
    x = np.arange(0.0, 8e3, 40.0)
    coarse, fine = ground(settings, x, x)[0], ground(finer, x, x)[0]
    assert coarse.std() > 30.0
    assert (fine - coarse).std() < 0.1 * coarse.std()


def test_highlands_are_brighter_than_maria_by_the_contrast():
    settings = preset("apollo-orbit")
    x, y = np.arange(-250e3, 250e3, 2e3), np.arange(-80e3, 80e3, 2e3)
    _, albedo = ground(replace(settings, craters=()), x, y)
    mare = mare_cover(settings.seed, settings.terrain.mare_share, x, y)
    ratio = np.median(albedo[mare < 0.01]) / np.median(albedo[mare > 0.99])
    assert ratio == pytest.approx(1.6, rel=0.03)  # mottling is 2 %
