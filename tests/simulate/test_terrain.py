from dataclasses import replace

import numpy as np
import pytest

from lommel.simulate import preset
from lommel.simulate.settings import CraterSettings, TerrainSettings
from lommel.simulate.terrain import (
    SPLINE_SLOPE,
    crater_population,
    crater_profile,
    fresh_depth,
    ground,
    mare_cover,
    spline_noise,
    uniform_hash,
)

BARE = TerrainSettings(octave_slope_deg=0.0, crater_coverage=0.0, mare_share=0.0)


def test_hash_is_even_and_without_memory():
    numbers = uniform_hash((1, 2), np.arange(200)[:, None], np.arange(-100, 100)[None, :])
    assert numbers.mean() == pytest.approx(0.5, abs=0.01)  # 7 standard errors
    assert numbers.std() == pytest.approx(12**-0.5, abs=0.01)
    neighbours = np.corrcoef(numbers[:, :-1].ravel(), numbers[:, 1:].ravel())[0, 1]
    assert abs(neighbours) < 0.03


def test_spline_noise_has_unit_rms_and_the_stated_slope():
    x = np.arange(0.0, 400.0, 0.25)
    noise = spline_noise((3,), 2.0, x, x)
    slope = np.gradient(noise, 0.25, axis=1)
    assert noise.std() == pytest.approx(1.0, rel=0.03)  # 40 000 nodes
    assert slope.std() == pytest.approx(SPLINE_SLOPE / 2.0, rel=0.03)


def test_spline_noise_is_a_function_of_the_place():
    x, y = np.arange(0.0, 30.0), np.arange(0.0, -20.0, -1.0)
    whole = spline_noise((5,), 7.0, x, y)
    part = spline_noise((5,), 7.0, x[10:20], y[5:9])
    np.testing.assert_allclose(part, whole[5:9, 10:20], atol=1e-12)


def test_mare_covers_about_its_share():
    x = np.arange(0.0, 20_000e3, 10e3)
    assert mare_cover(1, 0.3, x, x).mean() == pytest.approx(0.3, abs=0.03)


def test_numbers_of_craters_fall_with_the_square_of_the_diameter():
    terrain = TerrainSettings(largest_crater=32e3, crater_coverage=0.1)
    x = np.arange(0.0, 4000e3, 100e3)
    diameter = crater_population(1, terrain, 1e3, x, x).diameter
    larger = [np.count_nonzero(diameter > size) for size in (2e3, 4e3, 8e3)]
    assert larger[0] / larger[1] == pytest.approx(4.0, rel=0.1)  # Poisson, 1 % of larger[1]
    assert larger[1] / larger[2] == pytest.approx(4.0, rel=0.15)


def test_craters_of_one_class_cover_the_share_asked_for():
    terrain = TerrainSettings(largest_crater=20e3, crater_coverage=0.1)
    x = np.arange(0.0, 4000e3, 100e3)
    diameter = crater_population(1, terrain, 10e3, x, x).diameter
    reach = 1.5 * 20e3
    area = (x[-1] - x[0] + 2 * reach) ** 2
    covered = np.pi / 4 * np.sum(diameter**2) / area
    assert covered == pytest.approx(0.1, rel=0.05)


def test_fresh_crater_has_its_depth_rim_and_reach():
    distance = np.linspace(0.0, 20e3, 2001)
    profile = crater_profile(distance, 10e3, fresh_depth(10e3), 1.0)
    assert profile.max() - profile[0] == pytest.approx(2000.0, rel=0.1)  # the crest is rounded
    assert distance[profile.argmax()] == pytest.approx(5e3, rel=0.1)
    assert profile.max() > 200.0
    assert (profile[distance >= 15e3] == 0.0).all()


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
