"""The Python interface gives what the commands write."""

import numpy as np

import lommel
from lommel.io.raster import read_pixels
from lommel.run.simulate import run_simulate


def test_shape_from_shading_returns_the_refined_dem(tmp_path):
    scene = run_simulate("sfs-four-suns", tmp_path / "scene")
    dataset = lommel.shape_from_shading(
        scene.images,
        scene.initial_dem,
        scene.sun_positions,
        scene.spacecraft_positions,
        output=tmp_path / "out",
    )
    assert dataset.dem.dims == ("y", "x")
    np.testing.assert_array_equal(dataset.dem, read_pixels(tmp_path / "out" / "dem.tif"))
    assert "1737400" in dataset.spatial_ref.attrs["crs_wkt"]
    assert dataset.attrs["record"]["outcome"]["name"] in ("converged", "step_limit")
    truth = read_pixels(scene.truth_dem)
    inside = np.s_[10:-10, 10:-10]
    before = np.std((dataset.initial_dem.values - truth)[inside])
    assert np.std((dataset.dem.values - truth)[inside]) < before / 3
