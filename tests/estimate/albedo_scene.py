"""A small strip of overlapping images with known albedo, exposure and haze."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from lommel.core.reflectance import reflectance_model
from lommel.estimate.albedo_samples import image_geometry
from lommel.estimate.albedo_settings import AlbedoSettings
from lommel.scene.body import MOON, local_frame, to_xyz
from lommel.scene.geometry import Observation
from lommel.scene.grid import Grid, Window, grid_from_bounds, read_crs

SPACING = 1000.0  # m
ROWS, COLS, WIDTH, STEP = 40, 120, 48, 12  # posts; three quarters of each image overlap the next
EXACT = AlbedoSettings(  # the scene's own photometry, nothing else fitted
    loss="least-squares",
    haze=False,
    phase_factor=None,
    fit_phase_factor=False,
    fit_falloff=False,
)


@dataclass(frozen=True, eq=False)
class Strip:
    grid: Grid
    heights: np.ndarray
    albedo: np.ndarray
    exposures: np.ndarray
    hazes: np.ndarray
    observations: list

    def without(self, *left_out):
        return [o for k, o in enumerate(self.observations) if k not in left_out]

    def changed(self, k, change):
        """The observations, the image of number k replaced by ``change(image)``."""
        images = list(self.observations)
        images[k] = replace(images[k], measured=change(images[k].measured.copy()))
        return images


def strip(noise=0.01, haze=0.0, phase_factor=None, falloff=(0.0, 0.0), mare=0.7, seed=3):
    """Images of a strip at the equator, Sun in the east; noise is a share of the brightness."""
    rng = np.random.default_rng(seed)
    crs = read_crs("+proj=eqc +R=1737400 +units=m +no_defs")
    grid = grid_from_bounds((0.0, 0.0, COLS * SPACING, ROWS * SPACING), SPACING, crs)
    relief = gaussian_filter(rng.normal(size=grid.shape), 3.0)
    heights = 300.0 * relief / relief.std()
    pattern = gaussian_filter(rng.normal(size=grid.shape), 5.0)
    border = np.where(np.arange(COLS) > 0.55 * COLS, mare, 1.0)  # across the strip
    albedo = border * np.exp(0.1 * pattern / pattern.std())
    starts = np.arange(0, COLS - WIDTH + 1, STEP)
    exposures = 100.0 * rng.uniform(0.7, 1.3, starts.size)
    hazes = haze * rng.normal(size=starts.size)
    model = reflectance_model("lunar-lambert", phase_factor)
    observations = []
    for k, start in enumerate(starts):
        window = Window(0, int(start), ROWS, WIDTH)
        image = place(grid, window, f"frame{k}.tif")
        geometry = image_geometry(grid, heights, image)
        brightness = model.reflectance(
            geometry.cos_incidence, geometry.cos_emission, geometry.phase
        )
        square = geometry.off_axis
        brightness = brightness * np.exp(-square * (falloff[0] + falloff[1] * square))
        measured = exposures[k] * albedo[window.slices] * brightness + hazes[k]
        measured = measured * (1.0 + noise * rng.normal(size=measured.shape))
        observations.append(replace(image, measured=measured.astype(np.float32)))
    return Strip(grid, heights, albedo, exposures, hazes, observations)


def place(grid, window, name):
    """An observation yet without brightness: camera 100 km over the middle, Sun in the east."""
    middle = window.row + window.rows / 2, window.col + window.cols / 2
    longitude, latitude = grid.lonlat_at(*middle)
    east, _, up = local_frame(*grid.lonlat_at(ROWS / 2, COLS / 2))
    sun = 1.5e11 * (np.cos(0.6) * east + np.sin(0.6) * up)
    camera = to_xyz(MOON, longitude, latitude, 100_000.0)
    return Observation(name, window, np.zeros(window.shape, np.float32), sun, camera)
