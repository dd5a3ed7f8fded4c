"""What `lommel sfs` reads: one terrain and the images as they see it.

An image with a camera (named, or in a file beside it) is used as it was taken; one without is an
orthoimage. Most callers want `read_views`.
"""

from dataclasses import dataclass, replace

import numpy as np

from lommel.errors import GeometryError, InputError, LommelError
from lommel.io.cameras import find_camera, read_camera
from lommel.io.positions import find_position, read_positions
from lommel.io.raster import raster_info, read_pixels
from lommel.progress import silent
from lommel.run.footprints import (
    camera_window,
    find_footprints,
    ground_sample_distance,
    named_cameras,
    not_seen,
)
from lommel.run.inputs import (
    Skipped,
    left_out,
    listing,
    read_heights,
    read_scene,
    refuse_duplicates,
)
from lommel.scene.body import MOON, to_xyz
from lommel.scene.camera import ReducedCamera
from lommel.scene.grid import Grid, Window
from lommel.scene.masks import CLIPPED, MARGIN, MaskSettings, shadow_thresholds, widened
from lommel.scene.ortho import needed_pixels
from lommel.scene.view import CameraView, OrthoView

LEAST_SHARED = 8  # rows and columns of posts; a thinner sliver of an image tells no slope apart
SIGHTS = 65  # posts along each side of where a camera may look: does it see the DEM, and how
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
    if thresholds is not None and not files.images:
        raise InputError("No image shows this part of the scene.")
    refuse_duplicates(files.images)
    grid, skipped = grid_settings, []
    if not isinstance(grid, Grid):
        found = find_footprints(files, grid_settings, body)
        files, grid, skipped = found.files, found.grid, list(found.skipped)
    cameras, is_part = _camera_files(files), thresholds is not None
    flat = tuple(path for path in files.images if path not in cameras)
    views = []
    if flat:
        only_flat = replace(files, images=flat)
        scene = read_scene(only_flat, grid, "dem", body, progress, is_part=is_part)
        heights = scene.heights
        skipped += scene.skipped
        views = [
            (OrthoView(observation), observation.saturation)
            for observation in scene.observations
            if min(observation.window.shape) >= LEAST_SHARED
        ]
        skipped += [_sliver(o) for o in scene.observations if min(o.window.shape) < LEAST_SHARED]
    else:
        heights = read_heights(files.dems, grid, body)
    suns = sun_table(files, body) if cameras else None
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
    paths = named_cameras(files) or [find_camera(path) for path in files.images]
    return {image: path for image, path in zip(files.images, paths, strict=True) if path}


def _camera_view(path, camera_path, suns, files, grid, heights, body, is_part):
    info = raster_info(path, body)
    camera = read_camera(camera_path, info.shape)
    height = float(np.nanmean(heights, dtype=float))
    ends = np.nanmin(heights), np.nanmax(heights)
    shown = camera_window(camera, grid, *ends)
    if shown.is_empty:
        raise GeometryError(not_seen(path))
    posts = (
        shown.row + np.linspace(0, shown.rows - 1, SIGHTS)[:, None],
        shown.col + np.linspace(0, shown.cols - 1, SIGHTS),
    )
    at_posts = grid.lonlat_at(*posts)
    line, sample = camera.project(to_xyz(body, *at_posts, height))
    if not camera.contains(line, sample).any():
        raise GeometryError(not_seen(path))
    gsd = ground_sample_distance(camera, grid, height)
    factor = int(min(grid.spacing) / gsd + 0.5) if np.isfinite(gsd) else 1
    window = Window(0, 0, *info.shape)
    if is_part:
        window = _shown_part(
            [camera.project(to_xyz(body, *at_posts, end)) for end in ends], info.shape
        )
    image, first = _read_reduced(path, window, factor)
    if factor > 1:  # finer pixels than posts: their means are what the cells can explain
        camera = ReducedCamera(camera, factor)
    sun = sun_of(camera, path, suns, files)
    return CameraView(path.name, image, camera, sun, first), info.saturation


def sun_of(camera, path, suns, files):
    """Where the Sun stood: as the camera tells, or a table.

    Parameters
    ----------
    camera : Camera
    path : Path
        Of the image.
    suns : dict or None
        As `sun_table` reads it.
    files : SceneFiles

    Returns
    -------
    sun_position : array (3,), m, body-fixed
    """
    if camera.sun_position is not None:
        return camera.sun_position
    if suns is None:
        raise InputError(
            f"{path.name}: the camera file does not tell where the Sun stood. Name a table of "
            "lines KEY x y z with --sun-positions."
        )
    return find_position(suns, path.name, files.sun_positions)


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


def sun_table(files, body):
    """The table of Sun positions for cameras that know none; None when there is no table."""
    if files.sun_positions is None:
        return None
    return read_positions(files.sun_positions, "sun", body, files.positions_unit)
