import pytest

from lommel.estimate.albedo_crosscheck import predict_left_out

from .albedo_scene import EXACT, strip


def test_image_left_out_is_predicted_to_its_noise():
    noise = 0.02
    scene = strip(noise=noise)
    errors = predict_left_out(scene.observations, scene.grid, scene.heights, EXACT, [3])
    assert list(errors) == ["frame3.tif"]
    # its own noise, and that of an albedo from three to five other images
    assert errors["frame3.tif"] == pytest.approx(noise * (1 + 1 / 4) ** 0.5, rel=0.1)


def test_wrong_terrain_predicts_worse():
    scene = strip(noise=0.02)
    right, wrong = (
        predict_left_out(scene.observations, scene.grid, heights, EXACT, [2, 4])
        for heights in (scene.heights, 0 * scene.heights)
    )
    assert all(wrong[name] > right[name] for name in right)
