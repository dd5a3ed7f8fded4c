"""A whole scene: ground, initial DEM and images, from its settings.

Most callers want `simulate_scene`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from lommel.core.reflectance import reflectance_model
from lommel.errors import InputError
from lommel.progress import silent
from lommel.scene.camera import Camera
from lommel.scene.geometry import Observation
from lommel.scene.grid import Grid, Window
from lommel.simulate.imaging import (
    build_surface,
    lit_share,
    map_grid,
    place_on_map,
    record,
    reflected,
    seen_window,
)
from lommel.simulate.noise import spline_noise
from lommel.simulate.orbit import frame_cameras, sun_position
from lommel.simulate.projection import orthoimage
from lommel.simulate.terrain import DEM_ERROR

LEAST_MARGIN = 10  # posts around the grid, so that shadows fall in from outside
BLUR_REACH = 4.0  # standard deviations that the initial DEM's Gaussian looks out to


@dataclass(frozen=True, eq=False)
class SimulatedImage:
    """One image and the truth about it.

    Attributes
    ----------
    observation : Observation
        What a user has.
    camera : Camera
    exposure, haze : float, image units
    """

    observation: Observation
    camera: Camera
    exposure: float
    haze: float


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene with a known answer.

    Attributes
    ----------
    grid : Grid
    heights, initial_heights : array (rows, cols), m
        The truth, and what stereo would give.
    albedo : array (rows, cols), dimensionless
        The truth: mean over each post's area.
    images : tuple of SimulatedImage
    """

    grid: Grid
    heights: np.ndarray
    initial_heights: np.ndarray
    albedo: np.ndarray
    images: tuple[SimulatedImage, ...]


def simulate_scene(settings, progress=silent):
    """Ground, initial DEM and images of a scene.

    Parameters
    ----------
    settings : SceneSettings
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.

    Returns
    -------
    scene : Scene
    """
    spacing = settings.grid.spacing
    margin = max(LEAST_MARGIN, int(np.ceil(BLUR_REACH * settings.initial_dem.blur / spacing)))
    surface = build_surface(settings, margin)
    inside = Window(margin, margin, settings.grid.rows, settings.grid.cols)
    initial = _stereo_heights(settings, surface, inside)
    images = _take_images(settings, surface, inside, initial, progress)
    if not images:
        raise InputError(
            "No frame of the orbit sees the grid. Move grid.east and grid.north towards 0, or "
            "raise orbit.frames."
        )
    return Scene(
        grid=map_grid(settings.grid),
        heights=surface.heights[inside.slices],
        initial_heights=initial,
        albedo=surface.mean(surface.albedo)[inside.slices],
        images=tuple(images),
    )


def _take_images(settings, surface, inside, initial, progress):
    model = reflectance_model(settings.reflectance)
    cameras = frame_cameras(settings.orbit, settings.grid)
    posts = surface.grid.cut(inside).xyz(initial)
    suns = [sun_position(sun) for sun in settings.suns]
    lit = [lit_share(surface, sun) for sun in suns]
    images = []
    for revolution, frame in progress(list(np.ndindex(len(suns), len(cameras))), "frames"):
        camera, sun = cameras[frame], suns[revolution]
        window, is_seen = seen_window(camera, posts)
        if window.is_empty:
            continue
        around = _widen(window, inside)
        part = surface.cut(around)
        light = lit[revolution][surface.facets_of(around)]
        brightness = orthoimage(
            part,
            reflected(part, light, sun, camera.position, model),
            initial[window.slices],
            Window(inside.row, inside.col, *window.shape),
            camera.position,
        )
        # the frame's own stream: what it records does not depend on which frames see the grid
        random = np.random.default_rng([settings.seed, revolution, frame])
        exposure, haze = _exposure_and_haze(settings.film, random)
        measured = record(brightness, exposure, haze, settings.film, random)
        observation = Observation(
            name=f"orbit{revolution + 1}-frame{frame + 1:02d}.tif",
            window=window,
            measured=np.where(is_seen, measured, np.float32(np.nan)),
            sun_position=sun,
            spacecraft_position=camera.position,
            saturation=255.0 if settings.film.bits == 8 else np.inf,
        )
        images.append(SimulatedImage(observation, camera, exposure, haze))
    return images


def _widen(window, inside):
    """A window of the scene's posts with the margin around it, on the surface's grid."""
    return Window(
        window.row, window.col, window.rows + 2 * inside.row, window.cols + 2 * inside.col
    )


def _exposure_and_haze(film, random):
    exposure = film.exposure * (1.0 + film.exposure_spread * random.uniform(-1.0, 1.0))
    return exposure, film.haze * random.uniform()


def _stereo_heights(settings, surface, inside):
    """Heights as stereo gives them: blurred, with a smooth error."""
    dem, half = settings.initial_dem, surface.oversampling // 2
    sigma = dem.blur * surface.oversampling / settings.grid.spacing
    blurred = gaussian_filter(surface.vertices, sigma, truncate=BLUR_REACH)
    posts = blurred[half :: surface.oversampling, half :: surface.oversampling][inside.slices]
    x, y = place_on_map(map_grid(settings.grid), settings.grid)
    return posts + dem.error * spline_noise((settings.seed, DEM_ERROR), dem.error_length, x, y)
