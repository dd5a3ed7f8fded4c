import numpy as np
import pytest

from lommel.simulate.craters import crater_population, crater_profile, fresh_depth
from lommel.simulate.settings import TerrainSettings


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
