from dataclasses import replace

import numpy as np
import pytest

from lommel.errors import InputError
from lommel.scene.geometry import unit
from lommel.simulate import preset, simulate_scene
from lommel.simulate.orbit import footprint_half_angle, frame_cameras, sun_position
from lommel.simulate.settings import GridSettings, OrbitSettings, SceneSettings


def small(name="apollo-orbit", **changes):
    """A preset on so few posts that it takes no time."""
    settings = preset(name)
    grid = replace(settings.grid, rows=40, cols=120, spacing=4200.0)
    return replace(settings, grid=grid, **changes)


@pytest.fixture(scope="module")
def strip():
    return simulate_scene(small())


def test_one_seed_gives_one_scene(strip):
    again = simulate_scene(small())
    assert (again.heights == strip.heights).all()
    assert (again.initial_heights == strip.initial_heights).all()
    for one, other in zip(strip.images, again.images, strict=True):
        np.testing.assert_array_equal(one.observation.measured, other.observation.measured)
        assert one.exposure == other.exposure


def test_another_seed_gives_another_scene(strip):
    other = simulate_scene(small(seed=2))
    assert np.corrcoef(other.heights.ravel(), strip.heights.ravel())[0, 1] < 0.5


def test_neighbouring_footprints_overlap_by_three_quarters():
    orbit, grid = OrbitSettings(), GridSettings()
    directions = [unit(camera.position) for camera in frame_cameras(orbit, grid)]
    steps = [np.arccos(a @ b) for a, b in zip(directions, directions[1:], strict=False)]
    np.testing.assert_allclose(steps, 0.25 * 2 * footprint_half_angle(orbit), rtol=1e-6)


def test_field_of_view_is_that_of_the_metric_camera():
    camera = frame_cameras(OrbitSettings(), GridSettings())[0]
    lines, samples = camera.shape
    left, right = camera.ray(lines / 2, 0.0), camera.ray(lines / 2, float(samples))
    assert np.degrees(np.arccos(left @ right)) == pytest.approx(73.7, abs=0.05)


def test_middle_frame_stands_over_the_origin_of_the_map():
    camera = frame_cameras(OrbitSettings(), GridSettings())[4]
    x, y, z = camera.position / 1e3
    assert np.degrees(np.arctan2(y, x)) == pytest.approx(26.0)
    assert np.degrees(np.arcsin(z / 1847.4)) == pytest.approx(8.9)


def test_sun_stands_at_50_to_70_degrees_along_the_strip(strip):
    xyz = strip.grid.xyz(0.0)
    to_sun = unit(sun_position(SceneSettings().suns[0]) - xyz)
    incidence = np.degrees(np.arccos((to_sun * unit(xyz)).sum(axis=-1)))
    assert 50.0 < incidence.min() < 54.0
    assert 66.0 < incidence.max() < 70.0


def test_exposures_lie_within_their_spread(strip):
    exposures = np.array([image.exposure for image in strip.images])
    mean = SceneSettings().film.exposure
    assert (np.abs(exposures / mean - 1.0) <= 0.3).all()
    assert exposures.std() / mean > 0.1


def test_frames_cover_their_footprints_only(strip):
    for image in strip.images:
        window, measured = image.observation.window, image.observation.measured
        assert measured.shape == window.shape
        assert 37 <= window.cols <= 46  # 168 km and the sphere's curvature in posts of 4.2 km
        assert np.isfinite(measured).mean() > 0.85


def test_initial_dem_differs_by_its_error_where_the_blur_is_small():
    settings = small()
    dem = replace(settings.initial_dem, blur=1.0, error=20.0, error_length=30e3)
    scene = simulate_scene(replace(settings, initial_dem=dem))
    error = scene.initial_heights - scene.heights
    assert error.std() == pytest.approx(20.0, rel=0.35)  # some 70 independent nodes


def test_exposures_of_a_frame_do_not_depend_on_the_map():
    strip_images = {image.observation.name: image for image in simulate_scene(small()).images}
    close_up = simulate_scene(
        replace(
            preset("sfs-patch"),
            grid=replace(preset("sfs-patch").grid, rows=20, cols=20, spacing=400.0),
        )
    )
    shared = [image for image in close_up.images if image.observation.name in strip_images]
    assert len(shared) == 4
    for image in shared:
        assert image.exposure == strip_images[image.observation.name].exposure


def test_strip_holds_shadow_and_saturation():
    """At half the resolution, as the shadowed and the bright crater still have ten posts."""
    settings = preset("apollo-orbit")
    grid = replace(settings.grid, rows=200, cols=600, spacing=840.0)
    values = [
        image.observation.measured for image in simulate_scene(replace(settings, grid=grid)).images
    ]
    assert max((value < 5).sum() for value in values) > 100
    assert max((value >= 255).sum() for value in values) > 50


def test_grid_that_no_frame_sees_is_an_error():
    settings = small()
    with pytest.raises(InputError, match="No frame of the orbit sees the grid"):
        simulate_scene(replace(settings, grid=replace(settings.grid, north=900e3)))


def test_odd_oversampling_is_an_error():
    with pytest.raises(InputError, match="oversampling = 3 cannot be simulated"):
        replace(preset("sfs-patch"), oversampling=3)


def test_unknown_preset_is_an_error():
    with pytest.raises(InputError, match="Choose apollo-orbit, sfs-patch"):
        preset("apollo")
