"""Raw images over a terrain: where each looks, and its pixels brought onto a grid, part by part.

Neither image nor DEM is ever held whole. Most callers want `read_raw_images` and `project_window`.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from affine import Affine

from lommel.errors import GeometryError, InputError, LommelError
from lommel.io.cameras import find_camera, read_camera
from lommel.io.positions import find_position, read_positions
from lommel.io.raster import raster_info, read_grid, read_pixels
from lommel.run.inputs import Skipped, known_heights, listing, refuse_duplicates
from lommel.scene.body import MOON, Body, to_lonlat
from lommel.scene.camera import Camera
from lommel.scene.grid import Grid, Window, bounds_in
from lommel.scene.intersection import meet_sphere
from lommel.scene.ortho import ground_tile, needed_pixels, resample_image
from lommel.scene.shadows import reach

SIGHTS = 33  # pixels along each side of an image whose rays tell its footprint
PIXELS_AT_ONCE = 2**23  # of an image held in memory: 32 MiB
POSTS_AT_ONCE = 2**22  # of a DEM held while its extremes are read


@dataclass(frozen=True)
class Terrain:
    """DEM files as one terrain.

    Attributes
    ----------
    paths : tuple of Path
    body : Body
    """

    paths: tuple[Path, ...]
    body: Body = MOON

    @cached_property
    def grids(self):
        """Grid of each DEM."""
        return [read_grid(path, self.body) for path in self.paths]

    @property
    def spacing(self):
        """Post spacing of the first DEM, m."""
        return max(self.grids[0].spacing)

    def heights(self, grid):
        """Heights on a grid, NaN where no DEM knows; see `known_heights`."""
        return known_heights(self.paths, grid, self.body)

    def bounds(self, crs):
        """Bounds of all DEMs together, in units of a CRS."""
        bounds = np.array([bounds_in(grid, crs) for grid in self.grids])
        return *bounds[:, :2].min(axis=0).tolist(), *bounds[:, 2:].max(axis=0).tolist()

    def extremes(self, area):
        """Lowest and highest terrain within a grid's area, m; read a few rows at a time."""
        least, most = np.inf, -np.inf
        for path, grid in zip(self.paths, self.grids, strict=True):
            part = area.footprint(grid)
            if part.is_empty:
                continue
            step = max(1, POSTS_AT_ONCE // part.cols)
            for row in range(0, part.rows, step):
                rows = replace(part, row=part.row + row, rows=min(step, part.rows - row))
                heights = known_heights([path], grid.cut(rows), self.body)
                if np.isfinite(heights).any():
                    least = min(least, float(np.nanmin(heights)))
                    most = max(most, float(np.nanmax(heights)))
        if least > most:
            raise GeometryError("The DEM has no height where the image looks.")
        return least, most


@dataclass(frozen=True, eq=False)
class RawImage:
    """An image as it was taken, with its camera.

    Attributes
    ----------
    path : Path
    camera : Camera
    sun_position : array (3,), m, body-fixed, or None
        From a table, where the camera does not tell it; None when nobody does.
    """

    path: Path
    camera: Camera
    sun_position: np.ndarray | None

    @property
    def name(self):
        """File name, the key in every table."""
        return self.path.name

    @property
    def sun(self):
        """Position of the Sun, of a moving camera at the middle of the image; None if unknown."""
        return self.camera.sun_position if self.sun_position is None else self.sun_position

    def with_camera(self, camera):
        """The same image with another camera."""
        return replace(self, camera=camera)

    def ground(self, height, body=MOON):
        """Where a lattice of pixels looks on a sphere, array (n, 3), m; rays that miss left out.

        Parameters
        ----------
        height : float, m
            Of the sphere above the body's.
        body : Body
        """
        share = np.linspace(0.0, 1.0, SIGHTS)
        line, sample = np.meshgrid(*(share * size for size in self.camera.shape), indexing="ij")
        xyz = self._meet(line, sample, body.radius + height).reshape(-1, 3)
        xyz = xyz[np.isfinite(xyz).all(axis=-1)]
        if xyz.size == 0:
            raise GeometryError(
                f"{self.name}: its camera does not see the {body.name}. Check that the camera "
                "belongs to the image, and the units of the camera file (metres)."
            )
        return xyz

    def gsd(self, height, body=MOON):
        """Ground sample distance in the middle of the image, m; NaN when it misses the body."""
        middle = np.array(self.camera.shape) / 2
        line = middle[0] + np.array([-0.5, 0.5, 0.0, 0.0])
        sample = middle[1] + np.array([0.0, 0.0, -0.5, 0.5])
        down, up, left, right = self._meet(line, sample, body.radius + height)
        return float(np.sqrt(np.linalg.norm(np.cross(up - down, right - left))))

    def _meet(self, line, sample, radius):
        camera = self.camera
        return meet_sphere(camera.origin(line, sample), camera.ray(line, sample), radius)


def read_raw_images(files, body=MOON):
    """Images with their cameras, and the reasons for those left out.

    Parameters
    ----------
    files : SceneFiles
    body : Body

    Returns
    -------
    images : list of RawImage
    skipped : list of Skipped
    """
    refuse_duplicates(files.images)
    if not files.dems:
        raise InputError("No DEM given. Name at least one with --dem.")
    if files.cameras and len(files.cameras) != len(files.images):
        raise InputError(
            f"--cameras names {len(files.cameras)} files for {len(files.images)} images. "
            "Name one per image, in the same order."
        )
    suns = None
    if files.sun_positions is not None:
        suns = read_positions(files.sun_positions, "sun", body, files.positions_unit)
    images, skipped = [], []
    for path, named in zip(files.images, files.cameras or [None] * len(files.images), strict=True):
        try:
            images.append(_read_raw_image(path, named, suns, files.sun_positions))
        except LommelError as error:
            skipped.append(Skipped(path.name, str(error)))
    if not images:
        raise InputError("No image can be used.\n" + listing(skipped))
    return images, skipped


def _read_raw_image(path, camera_path, suns, table):
    shape = raster_info(path).shape
    camera_path = camera_path or find_camera(path)
    if camera_path is None:
        raise InputError(
            f"{path.name}: no camera found, neither beside the image nor in it. Name one with "
            "--cameras."
        )
    camera = read_camera(camera_path, shape)
    sun = None
    if suns is not None and camera.sun_position is None:
        sun = find_position(suns, path.name, table)
    return RawImage(path, camera, sun)


def seen_bounds(image, crs, terrain, heights):
    """Bounds of the DEM's part that an image sees, in units of a CRS.

    Parameters
    ----------
    image : RawImage
    crs : pyproj.CRS
    terrain : Terrain
    heights : iterable of float, m
        Between which the ground lies.

    Returns
    -------
    bounds : tuple of float
        xmin, ymin, xmax, ymax.
    """
    body = terrain.body
    own = terrain.grids[0]
    if own.crs != crs:
        own = Grid((1, 1), Affine.scale(1.0, -1.0), crs, body)
    places = np.concatenate([image.ground(height, body) for height in heights])
    row, col = own.index_at(*to_lonlat(body, places)[:2])
    x, y = own.affine @ (col + 0.5, row + 0.5)
    x, y = x[np.isfinite(x)], y[np.isfinite(y)]
    if x.size == 0:
        raise GeometryError(f"{image.name}: the CRS {crs.name!r} does not reach where it looks.")
    xmin, ymin, xmax, ymax = terrain.bounds(crs)
    bounds = max(x.min(), xmin), max(y.min(), ymin), min(x.max(), xmax), min(y.max(), ymax)
    if not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
        raise GeometryError(
            f"{image.name}: its camera does not see the DEM. Check that camera and DEM belong to "
            "the same place, and the units of the camera file (metres)."
        )
    return tuple(float(bound) for bound in bounds)


def view_window(image, grid, window, terrain, relief):
    """The posts of a window as an image's camera sees them; the DEM is read as far as it matters.

    Parameters
    ----------
    image : RawImage
    grid : Grid
    window : Window
    terrain : Terrain
    relief : float, m
        Highest minus lowest terrain.

    Returns
    -------
    tile : GroundTile
    heights : float32 array (window.rows, window.cols), m
    """
    middle = grid.cut(Window(window.row + window.rows // 2, window.col + window.cols // 2, 1, 1))
    pixel = image.camera.project(middle.xyz(0.0)[0, 0])
    position = image.camera.origin(*pixel)
    if not np.isfinite(position).all():
        position = image.camera.position
    positions = [position] if image.sun is None else [position, image.sun]
    around = reach(grid, window, relief, *positions)
    part, inside = grid.cut(around), window.relative_to(around)
    heights = terrain.heights(part)
    tile = ground_tile(part, heights, inside, image.camera, image.sun_position)
    return tile, heights[inside.slices]


def show_pixels(image, tile):
    """Image values at the posts of a tile, those that the camera does not see NaN.

    Parameters
    ----------
    image : RawImage
    tile : GroundTile

    Returns
    -------
    values : float32 array (rows, cols)
    """
    values = _sample(image, tile.line, tile.sample, tile.per_post)
    values[~tile.is_seen] = np.nan
    return values


def _sample(image, line, sample, per_post):
    """Values of posts, quarter by quarter where they show more than fits in memory."""
    part = needed_pixels(line, sample, image.camera.shape)
    if part.is_empty:
        return np.full(line.shape, np.nan, np.float32)
    if part.rows * part.cols <= PIXELS_AT_ONCE or min(line.shape) < 8:
        pixels = read_pixels(image.path, part)
        return resample_image(pixels, line - part.row, sample - part.col, per_post)
    values = np.empty(line.shape, np.float32)
    for rows in np.array_split(np.arange(line.shape[0]), 2):
        for cols in np.array_split(np.arange(line.shape[1]), 2):
            quarter = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
            values[quarter] = _sample(image, line[quarter], sample[quarter], per_post[:, *quarter])
    return values
