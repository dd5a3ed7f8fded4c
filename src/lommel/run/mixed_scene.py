"""What `lommel albedo` reads: orthoimages, and raw images brought onto the DEM on the way.

An image is raw when a camera is named for it, or when it has no CRS and its camera is in a file
beside it or in its ISIS label. Most callers want `read_mixed_scene`.
"""

from dataclasses import replace

import numpy as np

from lommel.errors import GeometryError, InputError, LommelError
from lommel.io.cameras import find_camera
from lommel.io.raster import raster_info
from lommel.progress import silent
from lommel.run.inputs import (
    GridSettings,
    Scene,
    Skipped,
    choose_grid,
    listing,
    observe,
    place_images,
    read_heights,
    read_position_tables,
    read_scene,
    refuse_duplicates,
    refuse_unusable,
)
from lommel.run.orthoproject import common_gsd, ortho_grid
from lommel.run.raw_images import Terrain, read_raw_images, show_pixels, view_window
from lommel.scene.body import MOON
from lommel.scene.geometry import Observation


def read_mixed_scene(files, grid_settings=None, body=MOON, progress=silent, store=None):
    """Terrain, orthoimages and raw images on one grid.

    Parameters
    ----------
    files : SceneFiles
    grid_settings : GridSettings, optional
    body : Body
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.
    store : function (observation), optional
        As in `read_scene`.

    Returns
    -------
    scene : Scene
        The spacecraft of a line-scan image stands where it was at the middle line.
    """
    refuse_duplicates(files.images)
    cameras = raw_cameras(files)
    if not any(cameras):
        return read_scene(files, grid_settings, "images", body, progress, store)
    settings = grid_settings or GridSettings()
    pairs = [pair for pair in zip(files.images, cameras, strict=True) if pair[1] is not None]
    images, skipped = read_raw_images(
        replace(files, images=tuple(i for i, _ in pairs), cameras=tuple(c for _, c in pairs)), body
    )
    terrain = Terrain(files.dems, body)
    placed, more = _place_raw(images, terrain, settings)
    flat = [path for path, camera in zip(files.images, cameras, strict=True) if camera is None]
    tables = read_position_tables(files, body) if flat else ()
    flat_grids, others = place_images(flat, terrain.grids, body)
    skipped += more + others
    grids = [*flat_grids.values(), *(grid for _, grid, _ in placed)]
    if not grids:
        raise InputError("No image can be used.\n" + listing(skipped))
    grid = choose_grid(grids, terrain.grids, settings, "images", body)
    refuse_unusable(grid)
    heights = read_heights(files.dems, grid, body)
    found = {}
    for task in progress([*placed, *flat_grids.items()], "images"):
        path = task[0].path if len(task) == 3 else task[0]
        try:
            if len(task) == 3:
                found[path] = _observe_raw(*task, grid, terrain)
            else:
                found[path] = observe(*task, grid, heights, tables, body)
            if store is not None:
                found[path] = store(found[path])
        except LommelError as error:
            skipped.append(Skipped(path.name, str(error)))
    if not found:
        raise InputError("No image can be used.\n" + listing(skipped))
    return Scene(grid, heights, [found[path] for path in files.images if path in found], skipped)


def raw_cameras(files):
    """Camera file of each image, None for an orthoimage."""
    if files.cameras and len(files.cameras) != len(files.images):
        raise InputError(
            f"--cameras names {len(files.cameras)} files for {len(files.images)} images. "
            "Name one per image, in the same order."
        )
    return list(files.cameras) or [_own_camera(path) for path in files.images]


def _own_camera(path):
    """Camera beside an image or in it; None when the image lies on a map."""
    try:
        return None if raster_info(path).grid is not None else find_camera(path)
    except LommelError:
        return None  # reported when the image is read


def _place_raw(images, terrain, settings):
    """Image, grid of its part of the DEM and relief there; and the images that cannot be placed."""
    placed, skipped = [], []
    gsd = common_gsd(images, terrain)
    for image in images:
        try:
            if image.sun is None:
                raise InputError(
                    f"{image.name}: the camera file does not tell where the Sun stood. Name a "
                    "table of lines KEY x y z with --sun-positions."
                )
            placed.append((image, *ortho_grid(image, terrain, settings, gsd)))
        except LommelError as error:
            skipped.append(Skipped(image.name, str(error)))
    return placed, skipped


def _observe_raw(image, image_grid, relief, grid, terrain):
    window = image_grid.footprint(grid)
    if window.is_empty or min(window.shape) < 2:
        raise GeometryError(f"{image.name} does not overlap the output grid.")
    tile, heights = view_window(image, grid, window, terrain, relief)
    values = show_pixels(image, tile)
    if not (np.isfinite(values) & np.isfinite(heights)).any():
        raise GeometryError(f"{image.name} has no valid pixel where the DEM is known.")
    saturation = raster_info(image.path).saturation
    position = image.camera.position
    return Observation(image.name, window, values, image.sun, position, saturation)
