"""46 Apollo 16 Metric images of the region between Ptolemaeus and the landing site, 1280 m.

Raw images of the same ground disagree by 0.20, after the published updates by 0.12.
"""

import csv
import json

import numpy as np
import pytest

from lommel.core.reflectance import reflectance_model
from lommel.estimate.albedo import estimate_albedo
from lommel.estimate.albedo_crosscheck import predict_left_out
from lommel.estimate.albedo_quality import disagreement
from lommel.estimate.albedo_samples import collect_samples, image_geometry
from lommel.estimate.albedo_settings import AlbedoSettings, published_settings
from lommel.run.albedo import run_albedo
from lommel.run.inputs import SceneFiles, read_scene
from lommel.scene.masks import MaskSettings

pytestmark = pytest.mark.real_data

LEFT_OUT = np.linspace(2, 43, 8).round().astype(int)  # spread over the revolutions


@pytest.fixture(scope="module")
def files(real_data):
    data = real_data("apollo16-metric-orthoimages")
    return SceneFiles(
        images=tuple(sorted((data / "images-1280m").glob("*.tif"))),
        dems=tuple(sorted((data / "dem").glob("*.tif"))),
        sun_positions=data / "sunpos.txt",
        spacecraft_positions=data / "spacecraftpos.txt",
    )


@pytest.fixture(scope="module")
def scene(files):
    return read_scene(files)


@pytest.fixture(scope="module")
def product(files, tmp_path_factory):
    output = tmp_path_factory.mktemp("apollo16") / "default"
    return output, run_albedo(files, output)


@pytest.fixture(scope="module")
def published(files, tmp_path_factory):
    return run_albedo(files, tmp_path_factory.mktemp("apollo16") / "pub", published_settings())


def test_raw_images_and_published_updates_disagree_as_known(scene):
    """The reference numbers 0.204 and 0.118 count pixels beside holes and shadow too."""
    settings = published_settings(reflectance="lunar-lambert")
    assert all_pixels_disagree(scene, None) == pytest.approx(0.204, abs=0.003)
    assert all_pixels_disagree(scene, settings) == pytest.approx(0.118, abs=0.003)
    assert all_pixels_disagree(scene, AlbedoSettings()) < 0.1


def all_pixels_disagree(scene, settings):
    """Disagreement over every pixel that has a value and is lit at less than 86 degrees."""
    masks = MaskSettings(shadow_threshold=0.0)
    model = reflectance_model("lunar-lambert")
    samples, _, _ = collect_samples(
        scene.observations, scene.grid, scene.heights, model, masks, None
    )
    cosine = np.concatenate(
        [
            image_geometry(scene.grid, scene.heights, image).cos_incidence.ravel()
            for image in scene.observations
        ]
    )
    lit = (samples.measured > 0) & (cosine > np.cos(masks.max_incidence))
    samples = samples._replace(weight=lit.astype(np.float32))
    if settings is None:
        return disagreement(samples, scene.grid.shape)
    result = estimate_albedo(scene.observations, scene.grid, scene.heights, settings)
    return disagreement(samples, scene.grid.shape, result.exposures, result.hazes, result.shared)


def test_images_agree_to_a_tenth(product):
    output, results = product
    assert results["disagreement_after_percent"] < 10.0
    record = json.loads((output / "run.json").read_text(encoding="utf-8"))
    assert record["outcome"]["name"] == "converged"


def test_image_of_another_region_is_reported(product):
    output, results = product
    assert results["images"] == 46
    with open(output / "exposures.csv", newline="", encoding="utf-8") as file:
        unused = [row for row in csv.DictReader(file) if row["used"] == "0"]
    assert [row["image"] for row in unused] == ["AS15-M-0073.tif"]
    assert "does not overlap" in unused[0]["reason"]


def test_images_left_out_are_predicted(scene):
    def median_error(settings):
        errors = predict_left_out(scene.observations, scene.grid, scene.heights, settings, LEFT_OUT)
        assert len(errors) == len(LEFT_OUT)
        return np.median(list(errors.values()))

    default = median_error(AlbedoSettings())
    assert default < 0.105
    assert default < 0.8 * median_error(published_settings())


def test_albedo_carries_no_ramp_along_the_strip(product, published):
    """End over end by a fitted line: the published updates leave nine tenths of darkening."""
    assert abs(product[1]["brightness_ramp_percent"]) < 25.0
    assert published["brightness_ramp_percent"] < -70.0


def test_craters_are_not_lit_from_one_side(product, published):
    """Correlation of the albedo's fine detail with the slope towards the Sun."""
    assert abs(product[1]["shading_correlation"]) < 0.25
    assert abs(published["shading_correlation"]) > 0.3
