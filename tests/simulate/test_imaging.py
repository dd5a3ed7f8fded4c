from dataclasses import replace

import numpy as np
import pytest

from lommel.core.reflectance import reflectance_model
from lommel.scene.body import MOON, local_frame
from lommel.scene.geometry import unit
from lommel.simulate.imaging import (
    facet_surface,
    map_grid,
    record,
    reflected,
    vertex_lattice,
)
from lommel.simulate.settings import FilmSettings, GridSettings

SUN = np.array([1.2e11, 0.9e11, 1e9])  # m
CAMERA = np.array([1.6e6, 0.85e6, 0.3e6])  # m
MODEL = reflectance_model("lunar-lambert")
FLAT = GridSettings(rows=12, cols=16, spacing=1000.0)
SUB_POST = 1e-5  # dimensionless; the Sun's height changes by 3e-4 rad within a post, to both sides


def surface_of(heights, albedo=None, oversampling=2):
    grid = map_grid(FLAT)
    shape = vertex_lattice(grid, oversampling).shape
    albedo = np.ones(shape) if albedo is None else albedo
    return facet_surface(grid, oversampling, np.broadcast_to(heights, shape), albedo)


def image_of(surface, lit=None):
    lit = np.ones(surface.albedo.shape) if lit is None else lit
    return surface.mean(reflected(surface, lit, SUN, CAMERA, MODEL))


def test_flat_ground_reflects_as_the_model_says():
    surface = surface_of(0.0)
    xyz = surface.grid.xyz(0.0)
    normal, to_sun, to_camera = unit(xyz), unit(SUN - xyz), unit(CAMERA - xyz)
    expected = MODEL.reflectance(
        (normal * to_sun).sum(axis=-1),
        (normal * to_camera).sum(axis=-1),
        np.arccos((to_sun * to_camera).sum(axis=-1)),
    )
    np.testing.assert_allclose(image_of(surface), expected, rtol=0, atol=SUB_POST)


def test_posts_stand_in_the_middle_of_their_facets():
    surface = surface_of(0.0, oversampling=4)
    centres = surface.facets.reshape(12, 4, 16, 4, 3).mean(axis=(1, 3))
    off = np.linalg.norm(centres - surface.grid.xyz(0.0), axis=-1)
    assert off.max() < 0.2  # m; the ground is curved within 1 km posts


def test_normals_of_a_ramp_lean_downhill():
    grid = map_grid(FLAT)
    x = np.arange(33) * 500.0
    surface = surface_of(0.1 * x[None, :])
    longitude, latitude = grid.lonlat()
    east, _, up = local_frame(longitude, latitude)
    normals = surface.normals[::2, ::2]
    slope_east = -(normals * east).sum(axis=-1) / (normals * up).sum(axis=-1)
    np.testing.assert_allclose(slope_east, 0.1, atol=1e-3)  # map scale along a parallel, 0.1 %


def test_image_value_is_the_mean_over_the_facets_of_a_post():
    checkers = np.indices((24, 32)).sum(axis=0) % 2
    surface = replace(surface_of(0.0), albedo=checkers.astype(float))
    np.testing.assert_allclose(
        image_of(surface), 0.5 * image_of(surface_of(0.0)), rtol=1e-3
    )  # reflectance changes by 3e-4 within a post


def test_shadow_is_dark():
    lit = np.ones((24, 32))
    lit[:, :16] = 0.0
    image = image_of(surface_of(0.0), lit)
    assert (image[:, :8] == 0.0).all()
    assert (image[:, 8:] > 0.0).all()


def test_finer_facets_change_a_rough_image_little():
    """Images converge as facets shrink: second order in the facets' size."""
    grid = map_grid(FLAT)

    def image(oversampling):
        rows, cols = vertex_lattice(grid, oversampling).shape
        y, x = np.mgrid[0:rows, 0:cols] / oversampling
        return image_of(
            surface_of(300.0 * np.sin(x / 2.0) * np.cos(y / 3.0), oversampling=oversampling)
        )

    coarse, fine, finest = image(2), image(4), image(8)
    ratio = np.abs(coarse - finest).max() / np.abs(fine - finest).max()
    assert 4.0 < ratio < 6.0  # (1/4 - 1/64) / (1/16 - 1/64) = 5 for second order


def test_film_clips_rounds_and_adds_noise_that_grows_with_the_root():
    random = np.random.default_rng(0)
    film = FilmSettings(exposure=100.0, noise=0.01, bits=8)
    values = record(np.full(20_000, 0.64), 100.0, 5.0, film, random)
    assert values.mean() == pytest.approx(69.0, abs=0.05)
    assert values.std() == pytest.approx(np.hypot(0.83, 12**-0.5), rel=0.05)
    assert (values == np.rint(values)).all()
    assert (record(np.full(10, 9.0), 100.0, 0.0, film, random) == 255.0).all()


def test_map_is_true_to_scale_at_its_origin():
    grid = map_grid(GridSettings(rows=10, cols=10, spacing=420.0))
    assert grid.spacing == pytest.approx((420.0, 420.0), rel=1e-4)  # first order off the origin
    longitude, latitude = grid.lonlat_at(4.5, 4.5)
    half_a_post = np.degrees(210.0 / grid.body.radius)
    assert np.degrees([longitude, latitude]) == pytest.approx([26.0, 8.9], abs=1.1 * half_a_post)
    assert grid.affine.f % 420.0 == pytest.approx(0.0, abs=1e-6)
    assert grid.body is MOON
