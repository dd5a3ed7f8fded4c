"""What `lommel sfs` reads: one terrain and the images as they see it.

An image with a camera (named, or in a file beside it) is used as it was taken; one without is an
orthoimage. Most callers want `read_views`.
"""

from dataclasses import dataclass, replace

import numpy as np

from lommel.errors import GeometryError, InputError, LommelError
from lommel.io.cameras import find_camera, read_camera
from lommel.io.positions import find_position, read_positions
from lommel.io.raster import raster_info, read_grid, read_pixels
from lommel.progress import silent
from lommel.run.inputs import (
    DEM_IS_FINE_ENOUGH,
    GridSettings,
    Skipped,
    choose_grid,
    left_out,
    listing,
    place_images,
    read_heights,
    read_scene,
    refuse_duplicates,
    refuse_unusable,
)
from lommel.scene.body import MOON, to_xyz
from lommel.scene.camera import ReducedCamera
from lommel.scene.grid import Grid, Window, bounds_in, grid_from_bounds, read_crs
from lommel.scene.masks import CLIPPED, MARGIN, MaskSettings, shadow_thresholds, widened
from lommel.scene.ortho import needed_pixels
from lommel.scene.view import CameraView, OrthoView

LEAST_SHARED = 8  # rows and columns of posts; a thinner sliver of an image tells no slope apart
SIGHTS = 65  # posts along each side that are tried to see whether a camera sees the DEM
PIXELS_AT_ONCE = 2**23  # of an image read for their means: 32 MiB
EDGE = 8  # pixels read around those that show the ground: slopes and relief move points
LEAST_LIT = 0.01  # share of an image's pixels that must be lit and unclipped for it to be used


@dataclass(frozen=True)
class ViewedTerrain:
    """Terrain and the images that see it.

    Attributes
    ----------
    grid : Grid
    heights : float32 array (rows, cols), m
        NaN in holes.
    views : list of OrthoView or CameraView
        Shadow and clipped pixels are NaN.
    skipped : list of Skipped
    thresholds : dict of str to float, image units
        Shadow threshold of each image by its name.
    """

    grid: Grid
    heights: np.ndarray
    views: list
    skipped: list[Skipped]
    thresholds: dict[str, float]


def read_views(files, grid_settings=None, masks=None, body=MOON, progress=silent, thresholds=None):
    """Terrain and images for shape from shading.

    Parameters
    ----------
    files : SceneFiles
    grid_settings : GridSettings or Grid, optional
        A grid is taken as it is.
    masks : MaskSettings, optional
    body : Body
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.
    thresholds : dict of str to float, image units, optional
        Shadow thresholds found on the whole scene, of which the grid is a part: of raw images
        only what falls on it is read, and one that cannot be read any more is an error.

    Returns
    -------
    terrain : ViewedTerrain
    """
    refuse_duplicates(files.images)
    grid_settings = grid_settings or GridSettings()
    cameras, is_part = _camera_files(files), thresholds is not None
    flat = tuple(path for path in files.images if path not in cameras)
    views, skipped = [], []
    if flat:
        only_flat = replace(files, images=flat)
        scene = read_scene(only_flat, grid_settings, "dem", body, progress, is_part=is_part)
        grid, heights, skipped = scene.grid, scene.heights, list(scene.skipped)
        views = [
            (OrthoView(observation), observation.saturation)
            for observation in scene.observations
            if min(observation.window.shape) >= LEAST_SHARED
        ]
        skipped += [_sliver(o) for o in scene.observations if min(o.window.shape) < LEAST_SHARED]
    else:
        grid = _terrain_grid(files.dems, cameras, grid_settings, body)
        heights = read_heights(files.dems, grid, body)
    suns = _sun_table(files, body) if cameras else None
    for path in progress(list(cameras), "images") if cameras else ():
        try:
            views.append(
                _camera_view(path, cameras[path], suns, files, grid, heights, body, is_part)
            )
        except LommelError as error:
            skipped.append(left_out(path, error, is_part))
    order = {path.name: number for number, path in enumerate(files.images)}
    views.sort(key=lambda pair: order[pair[0].name])
    if thresholds is None:
        found = shadow_thresholds([view.image for view, _ in views], masks or MaskSettings())
        names = (view.name for view, _ in views)
        thresholds = dict(zip(names, found.tolist(), strict=True))
    usable, unusable = mask_views(views, thresholds)
    skipped += unusable
    if not usable:
        raise InputError("No image can be used.\n" + listing(skipped))
    return ViewedTerrain(grid, heights, usable, skipped, thresholds)


def view_grid(files, grid_settings=None, body=MOON):
    """The grid that `read_views` would choose, from the headers of the files alone.

    Parameters
    ----------
    files : SceneFiles
    grid_settings : GridSettings, optional
    body : Body

    Returns
    -------
    grid : Grid
    """
    refuse_duplicates(files.images)
    settings = grid_settings or GridSettings()
    cameras = _camera_files(files)
    flat = [path for path in files.images if path not in cameras]
    if not flat:
        return _terrain_grid(files.dems, cameras, settings, body)
    if not files.dems:
        raise InputError("No DEM given. Name at least one with --dem.")
    dem_grids = [read_grid(path, body) for path in files.dems]
    image_grids, skipped = place_images(flat, dem_grids, body)
    if not image_grids:
        raise InputError("No image can be used.\n" + listing(skipped))
    grid = choose_grid(list(image_grids.values()), dem_grids, settings, "dem", body)
    refuse_unusable(grid)
    return grid


def _sliver(observation):
    rows, cols = observation.window.shape
    return Skipped(
        observation.name,
        f"{observation.name} shares only {rows} x {cols} posts with the DEM; {LEAST_SHARED} along "
        "each side are needed.",
    )


def mask_views(views, thresholds):
    """Blank shadow and clipped pixels; an image that keeps too little is left out.

    Parameters
    ----------
    views : list of (OrthoView or CameraView, float)
        Each with the value at which its image clips.
    thresholds : dict of str to float, image units
        Image value up to which a pixel is shadow, by the image's name.

    Returns
    -------
    usable : list of OrthoView or CameraView
    skipped : list of Skipped
    """
    usable, skipped = [], []
    for view, saturation in views:
        threshold = thresholds[view.name]
        is_used = (view.image > threshold) & (view.image < CLIPPED * saturation)
        # what lies beside shadow, clipping or no data holds part of it: read as slope, a scarp
        is_used = ~widened(~is_used, MARGIN)
        if is_used.mean() >= LEAST_LIT:
            usable.append(view.with_image(np.where(is_used, view.image, np.float32(np.nan))))
            continue
        reason = (
            f"{view.name} has {100 * is_used.mean():.2g} % of its pixels between the shadow "
            f"threshold {threshold:.4g} and saturation; {100 * LEAST_LIT:g} % are needed. "
            "Give a lit image, or a lower --shadow-threshold."
        )
        skipped.append(Skipped(view.name, reason))
    return usable, skipped


def _camera_files(files):
    """Camera file of each image that has one."""
    if files.cameras and len(files.cameras) != len(files.images):
        raise InputError(
            f"--cameras names {len(files.cameras)} files for {len(files.images)} images. "
            "Name one per image, in the same order."
        )
    paths = files.cameras or [find_camera(path) for path in files.images]
    return {image: path for image, path in zip(files.images, paths, strict=True) if path}


def _terrain_grid(dems, cameras, settings, body):
    """The DEM's own posts, unless told otherwise or coarser than the images."""
    if isinstance(settings, Grid):
        return settings
    if not dems:
        raise InputError("No DEM given. Name at least one with --dem.")
    grids = [read_grid(path, body) for path in dems]
    gsd = _least_gsd(cameras, grids[0])
    dem_spacing = max(grids[0].spacing)
    is_fine_enough = gsd is None or dem_spacing < DEM_IS_FINE_ENOUGH * gsd
    if settings.is_automatic and len(grids) == 1 and is_fine_enough:
        return grids[0]
    crs = read_crs(settings.crs, body, "--crs") if settings.crs else grids[0].crs
    bounds = np.array([bounds_in(grid, crs) for grid in grids])
    union = *bounds[:, :2].min(axis=0).tolist(), *bounds[:, 2:].max(axis=0).tolist()
    spacing = settings.spacing
    if spacing is None:
        spacing = dem_spacing if is_fine_enough else gsd
    grid = grid_from_bounds(settings.bounds or union, spacing, crs, body)
    refuse_unusable(grid)
    return grid


def _least_gsd(cameras, grid):
    """Median ground sample distance of the images at the DEM's centre; None when none sees it."""
    found = []
    for image, path in cameras.items():
        try:
            camera = read_camera(path, raster_info(image).shape)
        except LommelError:
            continue  # reported when the image is read
        found.append(ground_sample_distance(camera, grid, 0.0))
    found = [gsd for gsd in found if np.isfinite(gsd)]
    return float(np.median(found)) if found else None


def ground_sample_distance(camera, grid, height):
    """Ground distance between pixels at the centre of a grid, m; NaN when out of view.

    Parameters
    ----------
    camera : Camera
    grid : Grid
    height : float, m
    """
    middle = grid.cut(
        replace(grid.window, row=grid.shape[0] // 2, col=grid.shape[1] // 2, rows=2, cols=2)
    )
    line, sample = camera.project(middle.xyz(height))
    along_row = np.hypot(line[0, 1] - line[0, 0], sample[0, 1] - sample[0, 0])
    along_col = np.hypot(line[1, 0] - line[0, 0], sample[1, 0] - sample[0, 0])
    pixels = (along_row * along_col) ** 0.5
    return (grid.spacing[0] * grid.spacing[1]) ** 0.5 / pixels if pixels > 0 else np.nan


def _camera_view(path, camera_path, suns, files, grid, heights, body, is_part):
    info = raster_info(path, body)
    camera = read_camera(camera_path, info.shape)
    height = float(np.nanmean(heights, dtype=float))
    posts = (
        np.linspace(0, grid.shape[0] - 1, SIGHTS)[:, None],
        np.linspace(0, grid.shape[1] - 1, SIGHTS),
    )
    at_posts = grid.lonlat_at(*posts)
    line, sample = camera.project(to_xyz(body, *at_posts, height))
    if not camera.contains(line, sample).any():
        raise GeometryError(
            f"{path.name}: its camera does not see the DEM. Check that camera and DEM belong to "
            "the same place, and the units of the camera file (metres)."
        )
    gsd = ground_sample_distance(camera, grid, height)
    factor = int(min(grid.spacing) / gsd + 0.5) if np.isfinite(gsd) else 1
    window = Window(0, 0, *info.shape)
    if is_part:
        ends = [
            camera.project(to_xyz(body, *at_posts, end))
            for end in (np.nanmin(heights), np.nanmax(heights))
        ]
        window = _shown_part(ends, info.shape)
    image, first = _read_reduced(path, window, factor)
    if factor > 1:  # finer pixels than posts: their means are what the cells can explain
        camera = ReducedCamera(camera, factor)
    sun = camera.sun_position
    if sun is None and suns is None:
        raise InputError(
            f"{path.name}: the camera file does not tell where the Sun stood. Name a table of "
            "lines KEY x y z with --sun-positions."
        )
    if sun is None:
        sun = find_position(suns, path.name, files.sun_positions)
    return CameraView(path.name, image, camera, sun, first), info.saturation


def _shown_part(ends, shape):
    """The part of an image that shows ground, from a lattice at its least and its most height."""
    line, sample = (np.stack(coordinates) for coordinates in zip(*ends, strict=True))
    steps = [
        np.nanmax(np.abs(np.diff(x, axis=k)), initial=0) for x in (line, sample) for k in (1, 2)
    ]
    window = needed_pixels(line, sample, shape, int(max(steps)) + EDGE)
    if window.is_empty:
        raise GeometryError("The image does not show this part of the terrain.")
    return window


def _read_reduced(path, window, factor):
    """Means over squares of pixels, read some lines at a time, and the first one's place."""
    line, sample = window.row // factor, window.col // factor
    lines = (window.row + window.rows) // factor - line
    samples = (window.col + window.cols) // factor - sample
    image = np.empty((lines, samples), np.float32)
    at_once = max(PIXELS_AT_ONCE // (samples * factor**2), 1)
    for begin in range(0, lines, at_once):
        strip = image[begin : begin + at_once]
        part = Window(
            (line + begin) * factor, sample * factor, strip.shape[0] * factor, samples * factor
        )
        strip[:] = _reduce(read_pixels(path, part), factor)
    return image, (line, sample)


def _reduce(image, factor):
    if factor == 1:
        return image
    lines, samples = (size // factor for size in image.shape)
    squares = image.reshape(lines, factor, samples, factor)
    return squares.mean(axis=(1, 3), dtype=np.float32)


def _sun_table(files, body):
    """The table of Sun positions for cameras that know none; None when there is no table."""
    if files.sun_positions is None:
        return None
    return read_positions(files.sun_positions, "sun", body, files.positions_unit)
