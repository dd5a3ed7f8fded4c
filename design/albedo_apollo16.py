"""What decided the defaults of `lommel albedo`, measured on 46 Apollo 16 Metric images at 1280 m.

Each line changes one setting. Columns: disagreement of overlapping images; brightness ramp of the
albedo from end to end of the strip; correlation of its fine detail with the slope towards the Sun;
median error of images left out of the fit (mean over four choices of eight images); steps.

    python design/albedo_apollo16.py [CASE...]       # data in ../shared/data or $LOMMEL_DATA
"""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from lommel.estimate.albedo import estimate_albedo
from lommel.estimate.albedo_crosscheck import predict_left_out
from lommel.estimate.albedo_quality import (
    brightness_ramp,
    shading_in_albedo,
    slope_towards_sun,
)
from lommel.estimate.albedo_settings import AlbedoSettings, published_settings
from lommel.run.inputs import SceneFiles, read_scene

DEFAULT = AlbedoSettings()
CASES = {
    "published updates": published_settings(),
    "published, lunar-lambert": published_settings(reflectance="lunar-lambert"),
    "default": DEFAULT,
    "no haze": replace(DEFAULT, haze=False),
    "haze_error 0.05": replace(DEFAULT, haze_error=0.05),
    "haze_error 0.2": replace(DEFAULT, haze_error=0.2),
    "no phase factor": replace(DEFAULT, phase_factor=None),
    "phase factor fixed": replace(DEFAULT, fit_phase_factor=False),
    "no lens falloff": replace(DEFAULT, fit_falloff=False),
    "loss huber": replace(DEFAULT, loss="huber"),
    "loss least-squares": replace(DEFAULT, loss="least-squares"),
    "all pixels weigh alike": replace(DEFAULT, slope_noise=None),
    "slope_noise 0.25": replace(DEFAULT, slope_noise=0.25),
    "slope_noise 1": replace(DEFAULT, slope_noise=1.0),
    "albedo_contrast 0.025": replace(DEFAULT, albedo_contrast=0.025),
    "albedo_contrast 0.1": replace(DEFAULT, albedo_contrast=0.1),
    "albedo_contrast 0.2": replace(DEFAULT, albedo_contrast=0.2),
    "lunar-lambert-exponential": replace(DEFAULT, reflectance="lunar-lambert-exponential"),
    "lommel-seeliger": replace(DEFAULT, reflectance="lommel-seeliger"),
    "lambert": replace(DEFAULT, reflectance="lambert"),
}


def read_strip():
    """The scene as `lommel albedo` reads it."""
    repository = Path(__file__).resolve().parents[1]
    root = Path(os.environ.get("LOMMEL_DATA", repository.parent / "shared" / "data"))
    data = root / "apollo16-metric-orthoimages"
    return read_scene(
        SceneFiles(
            images=tuple(sorted((data / "images-1280m").glob("*.tif"))),
            dems=tuple(sorted((data / "dem").glob("*.tif"))),
            sun_positions=data / "sunpos.txt",
            spacecraft_positions=data / "spacecraftpos.txt",
        )
    )


def choices(images):
    """Eight images spread over the revolutions, and three random choices."""
    spread = np.linspace(2, images - 3, 8).round().astype(int)
    return [spread] + [np.random.default_rng(seed).permutation(images)[:8] for seed in range(3)]


def measure(scene, settings):
    """Line of the table, as a list of numbers."""
    inputs = scene.observations, scene.grid, scene.heights
    result = estimate_albedo(*inputs, settings)
    suns = [observation.sun_position for observation in scene.observations]
    slope = slope_towards_sun(scene.grid, scene.heights, suns)
    errors = [
        np.median(list(predict_left_out(*inputs, settings, left_out).values()))
        for left_out in choices(len(scene.observations))
    ]
    shading = shading_in_albedo(result.albedo, slope)[0]
    raw = shading_in_albedo(result.orthomosaic, slope)[0]
    return result, raw, shading, brightness_ramp(result.albedo, result.count), errors


def main(names):
    """Print the table."""
    scene = read_strip()
    print(f"{'':28} disagree    ramp   shading  left out   steps")
    for name in names or CASES:
        result, raw, shading, ramp, errors = measure(scene, CASES[name])
        if name == "published updates":
            before = result.disagreement_before
            print(f"{'raw images':28} {before:8.4f} {'':8} {raw:+8.3f}")
        print(
            f"{name:28} {result.disagreement:8.4f} {ramp:+8.2f} {shading:+8.3f} "
            f"{np.mean(errors):9.4f} {result.history[-1]['step']:6}  "
            f"[{min(errors):.4f}, {max(errors):.4f}]",
            flush=True,
        )


if __name__ == "__main__":
    main(sys.argv[1:])
