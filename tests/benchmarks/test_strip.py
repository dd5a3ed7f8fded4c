"""The strip of a whole orbit, small, and what it found."""

import sys
from pathlib import Path

import pytest

from lommel.estimate.albedo import estimate_albedo
from lommel.run.inputs import SceneFiles, read_scene

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def strip():
    sys.path.insert(0, str(ROOT))
    from benchmarks import strip

    return strip


def test_flat_phase_factor_is_found_from_the_lunar_one(strip, tmp_path):
    """Phases of 30 to 120 degrees: c1 ended at 1.9 and the exposures 22 % off."""
    strip.make_strip(tmp_path, frames=12, size=70, seed=11, sun_longitude=100.0)
    scene = read_scene(
        SceneFiles(
            images=tuple(sorted(tmp_path.glob("frame*.tif"))),
            dems=(tmp_path / "dem.tif",),
            sun_positions=tmp_path / "sun.txt",
            spacecraft_positions=tmp_path / "spacecraft.txt",
        )
    )
    result = estimate_albedo(scene.observations, scene.grid, scene.heights)
    assert abs(result.shared[0]) < 0.1  # per rad; the ground has no phase factor, so 0
