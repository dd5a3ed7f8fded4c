"""The stage `lommel orthoproject`: images, cameras and a DEM in, orthoimages and backplanes out.

Most callers want `run_orthoproject`.
"""

from contextlib import ExitStack
from dataclasses import asdict

import numpy as np

from lommel.errors import InputError, LommelError
from lommel.io.raster import BLOCK, raster_writer
from lommel.progress import silent
from lommel.run.inputs import (
    DEM_IS_FINE_ENOUGH,
    GridSettings,
    SceneFiles,
    Skipped,
    listing,
    refuse_unusable,
)
from lommel.run.products import RunRecord, output_folder
from lommel.run.raw_images import (
    Terrain,
    read_raw_images,
    seen_bounds,
    show_pixels,
    view_window,
)
from lommel.scene.grid import Window, grid_from_bounds, read_crs

LIT, SHADOW, UNKNOWN = 0, 1, 255  # values of the shadow plane
PLANES = {  # suffix of the file: description, unit, type, nodata
    "": ("image", "", np.float32, np.nan),
    "-incidence": ("incidence", "deg", np.float32, np.nan),
    "-emission": ("emission", "deg", np.float32, np.nan),
    "-phase": ("phase", "deg", np.float32, np.nan),
    "-shadow": ("shadow: 0 lit, 1 cast or attached", "", np.uint8, UNKNOWN),
}
NEED_SUN = ("-incidence", "-phase", "-shadow")


def run_orthoproject(
    files: SceneFiles,
    output,
    grid_settings: GridSettings | None = None,
    overwrite: bool = False,
    progress=silent,
):
    """Bring raw images onto a DEM and write them with their backplanes.

    Parameters
    ----------
    files : SceneFiles
    output : path
        Folder that appears when the run is done.
    grid_settings : GridSettings, optional
    overwrite : bool
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.

    Returns
    -------
    results : dict of str to number
        As in ``run.json``.
    """
    settings = grid_settings or GridSettings()
    record = RunRecord("orthoproject", {"grid": asdict(settings)})
    with output_folder(output, overwrite) as folder:
        with record.stage("orthoproject"):
            images, skipped = read_raw_images(files)
            terrain = Terrain(files.dems)
            record.add_inputs([*files.images, *files.dems, *files.cameras], progress)
            done = {}
            gsd = common_gsd(images, terrain)
            for image in progress(images, "images"):
                try:
                    grid, relief = ortho_grid(image, terrain, settings, gsd)
                    done[image.name] = write_orthoimage(folder, image, grid, terrain, relief)
                except LommelError as error:
                    skipped.append(Skipped(image.name, str(error)))
        if not done:
            raise InputError("No image can be used.\n" + listing(skipped))
        record.add_skipped(skipped)
        record.results = {"images": len(done)} | {
            f"{name} covered_percent": share for name, share in done.items()
        }
        without_sun = [image.name for image in images if image.sun is None and image.name in done]
        record.outcome = {"name": "done", "sentence": _sentence(len(done), without_sun)}
        record.write(folder)
    return record.results


def _sentence(count, without_sun):
    sentence = f"Projected {count} image{'s' if count > 1 else ''} onto the DEM."
    if without_sun:
        sentence += (
            f" Nothing tells where the Sun stood for {', '.join(without_sun[:5])}: no incidence, "
            "phase and shadow. Give --sun-positions."
        )
    return sentence


def common_gsd(images, terrain):
    """Median ground sample distance of images on the sphere, to three digits, m.

    Parameters
    ----------
    images : list of RawImage
    terrain : Terrain

    Returns
    -------
    gsd : float, m
        The DEM's spacing when no image meets the body.
    """
    found = np.array([image.gsd(0.0, terrain.body) for image in images])
    found = found[np.isfinite(found)]
    return float(f"{np.median(found):.3g}") if found.size else terrain.spacing


def ortho_grid(image, terrain, settings, gsd):
    """The grid of an orthoimage: the part of the DEM that the image sees, at the images' spacing.

    The DEM's own posts are kept when they are about as far apart as the image's pixels. All images
    of a run lie on one lattice.

    Parameters
    ----------
    image : RawImage
    terrain : Terrain
    settings : GridSettings
    gsd : float, m
        Of the images of the run.

    Returns
    -------
    grid : Grid
    relief : float, m
        Highest minus lowest terrain in it.
    """
    dem = terrain.grids[0]
    crs = read_crs(settings.crs, terrain.body, "--crs") if settings.crs else dem.crs
    # where the camera looks depends on the height, so on the terrain there: twice is enough
    area = grid_from_bounds(
        seen_bounds(image, crs, terrain, (0.0,)), terrain.spacing, crs, terrain.body
    )
    extremes = terrain.extremes(area)
    bounds = settings.bounds or seen_bounds(image, crs, terrain, extremes)
    is_alike = 1 / DEM_IS_FINE_ENOUGH < terrain.spacing / gsd < DEM_IS_FINE_ENOUGH
    if settings.is_automatic and len(terrain.grids) == 1 and is_alike:
        around = grid_from_bounds(bounds, gsd, crs, terrain.body)
        grid = dem.cut(around.footprint(dem))
    else:
        grid = grid_from_bounds(bounds, settings.spacing or gsd, crs, terrain.body)
    refuse_unusable(grid)
    return grid, extremes[1] - extremes[0]


def write_orthoimage(folder, image, grid, terrain, relief):
    """Write an orthoimage and its backplanes, block by block.

    Parameters
    ----------
    folder : Path
    image : RawImage
    grid : Grid
    terrain : Terrain
    relief : float, m

    Returns
    -------
    covered : float, per cent of the posts that show the image
    """
    suffixes = [s for s in PLANES if image.sun is not None or s not in NEED_SUN]
    stem = image.path.stem
    count = 0
    with ExitStack() as stack:
        writers = {
            suffix: stack.enter_context(
                raster_writer(folder / f"{stem}{suffix}.tif", grid, *PLANES[suffix])
            )
            for suffix in suffixes
        }
        for window in _blocks(grid):
            tile, _ = view_window(image, grid, window, terrain, relief)
            if not tile.is_on_image.any():
                continue
            values = show_pixels(image, tile)
            count += int(np.isfinite(values).sum())
            planes = backplanes(tile) | {"": values}
            for suffix, write in writers.items():
                write(planes[suffix], window)
    if count == 0:
        raise InputError(f"{image.name} shows no pixel on the grid. Check --bounds.")
    return 100.0 * count / (grid.shape[0] * grid.shape[1])


def backplanes(tile):
    """Backplanes of a tile by the suffix of their file; angles in degrees.

    Parameters
    ----------
    tile : GroundTile

    Returns
    -------
    planes : dict of str to array (rows, cols)
    """
    geometry = tile.geometry
    angles = {
        "-incidence": np.arccos(geometry.cos_incidence),
        "-emission": np.arccos(geometry.cos_emission),
        "-phase": geometry.phase,
    }
    planes = {
        suffix: np.where(tile.is_on_image, np.degrees(angle), np.nan)
        for suffix, angle in angles.items()
    }
    shadow = np.where(tile.is_lit, LIT, SHADOW)
    return planes | {"-shadow": np.where(tile.is_on_image, shadow, UNKNOWN)}


def _blocks(grid):
    """Windows of one GeoTIFF tile each; what is left at the end has 2 rows and columns or more."""
    edges = []
    for size in grid.shape:
        ends = [*range(0, size, BLOCK), size]
        if len(ends) > 2 and ends[-1] - ends[-2] < 2:
            del ends[-2]
        edges.append(list(zip(ends[:-1], ends[1:], strict=True)))
    for row, last_row in edges[0]:
        for col, last_col in edges[1]:
            yield Window(row, col, last_row - row, last_col - col)
