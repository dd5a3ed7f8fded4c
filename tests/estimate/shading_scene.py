"""A small scene on the Moon with an oblique camera, shared by the tests of shape from shading."""

import numpy as np
from scipy.ndimage import gaussian_filter

from lommel.core.reflectance import reflectance_model
from lommel.estimate.problem import fresh_problem
from lommel.estimate.surface import Surface
from lommel.scene.body import MOON, local_frame, to_xyz
from lommel.scene.geometry import Observation
from lommel.scene.grid import grid_from_bounds, read_crs
from lommel.scene.view import OrthoView

STEREOGRAPHIC = "+proj=stere +lat_0=20 +lon_0=10 +R=1737400 +units=m +no_defs"
EXPOSURE = 100.0


def patch_grid(rows=48, cols=56, spacing=20.0):
    bounds = (-cols * spacing / 2, -rows * spacing / 2, cols * spacing / 2, rows * spacing / 2)
    return grid_from_bounds(bounds, spacing, read_crs(STEREOGRAPHIC))


def direction(azimuth_deg, elevation_deg):
    """Unit vector at the patch's centre, body-fixed."""
    east, north, up = local_frame(np.radians(10.0), np.radians(20.0))
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    flat = np.sin(azimuth) * east + np.cos(azimuth) * north
    return np.cos(elevation) * flat + np.sin(elevation) * up


def positions(sun_azimuth_deg, view_elevation_deg=70.0, altitude=110e3):
    centre = to_xyz(MOON, np.radians(10.0), np.radians(20.0), 0.0)
    sun = centre + 1.5e11 * direction(sun_azimuth_deg, 35.0)
    range_ = altitude / np.sin(np.radians(view_elevation_deg))
    camera = centre + range_ * direction(60.0, view_elevation_deg)
    return sun, camera


def hills(shape, seed=0, smooth=3.0, rms=6.0):
    rng = np.random.default_rng(seed)
    field = gaussian_filter(rng.normal(size=shape), smooth)
    return (rms * field / field.std()).astype(np.float32)


def blank_view(grid, azimuth_deg, **kwargs):
    sun, camera = positions(azimuth_deg, **kwargs)
    blank = np.full(grid.shape, np.nan, np.float32)
    return OrthoView(Observation(f"sun{azimuth_deg:g}.tif", grid.window, blank, sun, camera))


def exact_problem(truth, grid, azimuths=(100.0,), parametrisation="height", model=None):
    """A problem whose images are what the model itself predicts for the true surface."""
    views = [blank_view(grid, azimuth) for azimuth in azimuths]
    camera = views[0].position if parametrisation == "ray" else None
    surface = Surface(grid, 0.0, camera)
    problem = fresh_problem(surface, truth, views, model or reflectance_model(), None)
    problem.exposures[:] = EXPOSURE
    problem.prepare_geometry(truth)
    for k in range(len(views)):
        problem.cells[k][:] = problem.predict(truth, k)
    return problem
