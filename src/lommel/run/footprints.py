"""Where the images of a run lie on its grid, from their headers and cameras alone.

Found once, it tells which images a part of the scene has to open. Most callers want
`find_footprints`.
"""

import copy
import hashlib
import os
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from lommel.errors import GeometryError, InputError, LommelError
from lommel.io.cameras import find_camera, read_camera
from lommel.io.raster import RasterInfo, grid_of, raster_info, read_grid, side_by_side
from lommel.run.apart import call_apart
from lommel.run.inputs import (
    DEM_IS_FINE_ENOUGH,
    GridSettings,
    SceneFiles,
    Skipped,
    choose_grid,
    known_heights,
    listing,
    refuse_duplicates,
    refuse_unusable,
)
from lommel.run.machine import cores
from lommel.run.tiles_plan import coarse_grid
from lommel.scene.body import MOON, Body, to_lonlat
from lommel.scene.grid import Grid, Window, bounds_in, grid_from_bounds, read_crs
from lommel.scene.intersection import meet_sphere

SIGHTS = 17  # pixels along each side of an image whose rays tell its footprint
PER_PROCESS = 250  # images that are worth a process of their own, which takes a second to start
COARSE = 64  # posts along the longer side of the terrain that tells between which heights it lies


@dataclass(frozen=True)
class Footprints:
    """Which image shows which part of a grid, and where it is used.

    Attributes
    ----------
    files : SceneFiles
        Only the images that touch the grid, with the camera of each; None for an orthoimage.
    grid : Grid
    windows : int array (images, 4), posts
        First row, first column, and the row and column behind the last ones; too large rather than
        too small.
    skipped : list of Skipped
        Images that touch nothing or cannot be read.
    patch : int, posts
        Side of the squares of ``is_used``.
    is_used : bool array (images, patch rows, patch cols)
        Squares of the grid for which an image was chosen; all of them where nothing was chosen.
    not_chosen : list of Skipped
    results : dict of str to float
        What the choice adds to the results of the run.
    key : str
        Digest of what the footprints follow from.
    looks : list of Look
        What has been seen of the files; not kept with the rest.
    """

    files: SceneFiles
    grid: Grid
    windows: np.ndarray
    skipped: list[Skipped]
    patch: int
    is_used: np.ndarray
    not_chosen: list[Skipped] = field(default_factory=list)
    results: dict[str, float] = field(default_factory=dict)
    key: str = ""
    looks: list = field(default_factory=list)

    def uses(self, window):
        """Which images are used in a window, bool array (images,)."""
        row, col, last_row, last_col = self.windows.T
        touches = (row < window.row + window.rows) & (last_row > window.row)
        touches &= (col < window.col + window.cols) & (last_col > window.col)
        first, last = (window.row, window.col), (window.row + window.rows, window.col + window.cols)
        squares = tuple(
            slice(max(a, 0) // self.patch, -(-b // self.patch))
            for a, b in zip(first, last, strict=True)
        )
        return touches & self.is_used[(slice(None), *squares)].any(axis=(1, 2))

    def within(self, window):
        """The files with only the images that are used in a window."""
        return _some(self.files, np.flatnonzero(self.uses(window)))

    def window(self, k):
        """The footprint of an image."""
        row, col, last_row, last_col = self.windows[k].tolist()
        return Window(row, col, last_row - row, last_col - col)

    def only(self, kept, skipped):
        """The same with some of the images, and the reasons why the others are left out."""
        return replace(
            self,
            files=_some(self.files, kept),
            windows=self.windows[kept],
            is_used=self.is_used[kept],
            skipped=[*self.skipped, *skipped],
            looks=[self.looks[k] for k in kept] if self.looks else [],
        )

    @property
    def used(self):
        """The files with only the images that are used anywhere."""
        return self.within(self.grid.window)

    @property
    def choice(self):
        """Digest of what is used where."""
        return hashlib.sha256(np.packbits(self.is_used)).hexdigest()

    def unused(self, files):
        """Paths of the images among files that are used nowhere, a set."""
        used = {os.path.abspath(path) for path in self.used.images}
        return {path for path in files.images if os.path.abspath(path) not in used}


@dataclass(frozen=True)
class Look:
    """What a look at an image's files tells.

    Attributes
    ----------
    path : Path
    info : RasterInfo
    camera_path : path or None
        None for an orthoimage.
    camera : Camera or None
    """

    path: object
    info: RasterInfo
    camera_path: object = None
    camera: object = None


def find_footprints(files, grid_settings=None, body=MOON, sketch=0):
    """Footprints of images on the grid that follows from them and the DEM.

    Parameters
    ----------
    files : SceneFiles
    grid_settings : GridSettings or Grid, optional
        A grid is taken as it is.
    body : Body
    sketch : int, pixels
        Of each orthoimage that are looked at along; see `raster_info`.

    Returns
    -------
    footprints : Footprints
    """
    refuse_duplicates(files.images)
    if not files.dems:
        raise InputError("No DEM given. Name at least one with --dem.")
    settings = grid_settings or GridSettings()
    dem_grids = [read_grid(path, body) for path in files.dems]
    headers, skipped = _read_headers(files, dem_grids, body, sketch)
    flat = [header.info.grid for header in headers if header.camera is None]
    cameras = [header.camera for header in headers if header.camera is not None]
    if not headers:
        raise InputError("No image can be used.\n" + listing(skipped))
    if flat:
        grid = choose_grid(flat, dem_grids, settings, "dem", body)
    else:
        grid = _terrain_grid(dem_grids, cameras, settings, body)
    refuse_unusable(grid)
    least, most = _between(files.dems, grid) if cameras else (0.0, 0.0)
    kept, windows = [], []
    for header in headers:
        if header.camera is None:
            window = header.info.grid.footprint(grid)
            reason = f"{header.path.name} does not overlap the output grid."
        else:
            window = camera_window(header.camera, grid, least, most)
            reason = not_seen(header.path)
        if window.is_empty:
            skipped.append(Skipped(header.path.name, reason))
            continue
        kept.append(header)
        windows.append((window.row, window.col, window.row + window.rows, window.col + window.cols))
    if not kept:
        raise InputError("No image can be used.\n" + listing(skipped))
    files = replace(
        files,
        images=tuple(header.path for header in kept),
        cameras=tuple(header.camera_path for header in kept),
    )
    everywhere = np.ones((len(kept), 1, 1), bool)
    side = max(grid.shape)
    return Footprints(files, grid, np.array(windows), skipped, side, everywhere, looks=kept)


def _some(files, kept):
    """The files with some of the images only."""
    cameras = tuple(files.cameras[k] for k in kept)
    return replace(files, images=tuple(files.images[k] for k in kept), cameras=cameras)


def named_cameras(files):
    """Camera file of each image as it was named; nothing where none was.

    Parameters
    ----------
    files : SceneFiles

    Returns
    -------
    cameras : tuple of path or None
    """
    if files.cameras and len(files.cameras) != len(files.images):
        raise InputError(
            f"--cameras names {len(files.cameras)} files for {len(files.images)} images. "
            "Name one per image, in the same order."
        )
    return files.cameras


def _read_headers(files, dem_grids, body, sketch):
    """Headers and cameras of the images that can be used, and the `Skipped` others."""
    named, images = named_cameras(files), files.images
    look = LookAt(dict(zip(images, named, strict=True)) if named else None, dem_grids, body, sketch)
    workers = min(cores(), len(images) // PER_PROCESS)
    if workers < 2:
        found = look(images)
    else:  # opening a file holds all threads of a process up
        ends = [len(images) * k // workers for k in range(workers + 1)]
        shares = [images[first:last] for first, last in pairwise(ends)]
        found = [one for some in call_apart(look, shares, workers) for one in some]
    headers = [one for one in found if isinstance(one, Look)]
    return headers, [one for one in found if isinstance(one, Skipped)]


@dataclass(frozen=True)
class LookAt:
    """Looks at the files of images.

    Attributes
    ----------
    cameras : dict of path to path or None, or None
        Camera file of each image; those found beside the images where this is None.
    dem_grids : list of Grid
    body : Body
    sketch : int, pixels
        As of `find_footprints`.
    """

    cameras: dict | None
    dem_grids: list[Grid]
    body: Body
    sketch: int

    def __call__(self, images):
        """`Look` of each image, or `Skipped` where it cannot be used."""
        return side_by_side(self._look, images)

    def _look(self, path):
        try:
            info = raster_info(path, self.body, self.sketch)
            camera_path = (
                find_camera(path, info.has_label) if self.cameras is None else self.cameras[path]
            )
            if camera_path is not None:
                return Look(path, info, camera_path, read_camera(camera_path, info.shape))
            grid = grid_of(info)
            if all(grid.footprint(dem).is_empty for dem in self.dem_grids):
                raise GeometryError(f"{path.name} does not overlap the DEM.")
            return Look(path, info)
        except LommelError as error:
            return Skipped(path.name, str(error))


def terrain_grid(grid, places):
    """A coarse grid over all of a grid, for what needs no detail of the terrain.

    Parameters
    ----------
    grid : Grid
    places : int
        Along the longer side.

    Returns
    -------
    coarse : Grid
    stride : int
        Posts of the grid per post of the coarse one.
    """
    stride = -(-max(grid.shape) // places)
    return coarse_grid(grid, stride), stride


def _between(dems, grid):
    """Heights between which all terrain lies, from means over squares, m.

    Terrain that is not steeper than 45 degrees from end to end of a square stays within half its
    diagonal of the mean.
    """
    coarse, stride = terrain_grid(grid, COARSE)
    heights = known_heights(dems, coarse, grid.body)
    if not np.isfinite(heights).any():
        return 0.0, 0.0  # refused when the terrain is read
    square = max(grid.spacing) * stride
    return float(np.nanmin(heights)) - square, float(np.nanmax(heights)) + square


def camera_window(camera, grid, least, most):
    """The posts of a grid that a camera may see, rather too many than too few.

    Parameters
    ----------
    camera : Camera
    grid : Grid
    least, most : float, m
        Heights between which the terrain lies.

    Returns
    -------
    window : Window
        Around the places where a lattice of pixels looks, widened by a step of the lattice;
        all of the grid when the image reaches beyond the limb or the projection.
    """
    camera = copy.copy(camera)  # which may keep tables of its lines, and they are large
    share = np.linspace(0.0, 1.0, SIGHTS)
    line, sample = np.meshgrid(*(share * size for size in camera.shape), indexing="ij")
    origin, ray = camera.origin(line, sample), camera.ray(line, sample)
    ground = [meet_sphere(origin, ray, grid.body.radius + height) for height in (least, most)]
    places = np.stack(grid.index_at(*to_lonlat(grid.body, np.stack(ground))[:2]))
    is_known = np.isfinite(places).all(axis=0)
    if not is_known.any():
        return Window(0, 0, 0, 0)
    if not is_known.all():
        return grid.window
    step = [max(np.abs(np.diff(place, axis=k)).max() for k in (1, 2)) for place in places]
    size = np.array(grid.shape)
    first = places.min(axis=(1, 2, 3)) - step - 1
    last = places.max(axis=(1, 2, 3)) + step + 1
    first = np.clip(np.floor(first), 0, size).astype(int)
    last = np.clip(np.ceil(last) + 1, 0, size).astype(int)
    return Window(*first.tolist(), *np.maximum(last - first, 0).tolist())


def not_seen(path):
    """Why an image with a camera is of no use."""
    return (
        f"{path.name}: its camera does not see the DEM. Check that camera and DEM belong to "
        "the same place, and the units of the camera file (metres)."
    )


def _terrain_grid(grids, cameras, settings, body):
    """The DEM's own posts, unless told otherwise or coarser than the images."""
    if isinstance(settings, Grid):
        return settings
    gsd = _median_gsd(cameras, grids[0])
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
    return grid_from_bounds(settings.bounds or union, spacing, crs, body)


def _median_gsd(cameras, grid):
    """Median ground sample distance of the images at the DEM's centre; None when none sees it."""
    found = [ground_sample_distance(copy.copy(camera), grid, 0.0) for camera in cameras]
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
