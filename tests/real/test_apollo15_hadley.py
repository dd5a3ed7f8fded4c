"""The photoclinometry paper's site: one Apollo Metric image over a stereo DEM full of jitter."""

import json

import numpy as np
import pytest

from lommel.io.raster import read_pixels
from lommel.run.inputs import SceneFiles
from lommel.run.shape_from_shading import SfsSettings, run_shape_from_shading

pytestmark = pytest.mark.real_data


@pytest.fixture(scope="module", params=["height", "ray"])
def refined(request, real_data, tmp_path_factory):
    data = real_data("apollo15-hadley-stereo")
    files = SceneFiles(
        images=(data / "AS15-M-1134.ortho.tif",),
        dems=(data / "stereo-dem.tif",),
        sun_positions=data / "sunpos.txt",
        spacecraft_positions=data / "spacecraftpos.txt",
    )
    folder = tmp_path_factory.mktemp("hadley") / request.param
    results = run_shape_from_shading(files, folder, SfsSettings(parametrisation=request.param))
    return folder, results


def test_modelled_image_is_like_the_measured_one(refined):
    _, results = refined
    assert results["image_correlation_before"] < 0.2
    assert results["image_correlation_after"] > 0.9


def test_shape_alone_explains_most_of_the_image(refined):
    """Without albedo the correlation is 0.73; the bright ejecta are not for shape to explain."""
    _, results = refined
    assert results["image_correlation_without_albedo"] > 0.65


def test_stripes_vanish_from_the_terrain(refined):
    """How much of the jitter's hillshade is still there, by regression of after on before.

    The stereo DEM's own hillshade is nearly all jitter. A surface that kept it would have a
    coefficient near 1; the large craters, which both show, leave about 0.1.
    """
    folder, _ = refined
    before = read_pixels(folder / "hillshade-before.tif")
    after = read_pixels(folder / "hillshade-after.tif")
    kept = np.cov(before.ravel(), after.ravel())[0, 1] / before.var()
    assert kept < 0.15


def test_solver_ends_by_itself(refined):
    folder, _ = refined
    record = json.loads((folder / "run.json").read_text())
    assert record["outcome"]["name"] == "converged"
