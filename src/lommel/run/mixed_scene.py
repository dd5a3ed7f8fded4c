"""What `lommel albedo` reads: orthoimages, and raw images brought onto the DEM on the way.

An image is raw when a camera is named for it, or when it has no CRS and its camera is in a file
beside it or in its ISIS label. Where images lie is told by headers and cameras (`place_scene`);
their pixels and the DEM are then read some rows at a time (`read_placed`), in parts that do not
depend on the memory there is. Most callers want `read_mixed_scene`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lommel.errors import GeometryError, InputError, LommelError
from lommel.io.cameras import find_camera
from lommel.io.positions import find_position
from lommel.io.raster import raster_info, read_image_on_grid
from lommel.jobs import InThreads
from lommel.progress import silent
from lommel.run.inputs import (
    GridSettings,
    Scene,
    Skipped,
    choose_grid,
    listing,
    place_images,
    read_position_tables,
    refuse_duplicates,
    refuse_unusable,
)
from lommel.run.orthoproject import common_gsd, ortho_grid
from lommel.run.raw_images import RawImage, Terrain, read_raw_images, show_pixels, view_window
from lommel.run.records import refuse_changed
from lommel.run.stored_rows import Held, stacked
from lommel.scene.body import MOON
from lommel.scene.geometry import Observation
from lommel.scene.grid import Grid, Window

BAND = 512  # rows read together: tiles of GeoTIFFs are as high, and each is unpacked once or twice
POSTS_AT_ONCE = 2**22  # of an orthoimage while it is read, at most, 40 bytes each
SQUARES = 4  # times as many of the terrain, which is put together of squares
SQUARE = 768  # posts along each side of the parts of a raw image, 500 bytes each


@dataclass(frozen=True)
class Place:
    """Where an image lies on the grid.

    Attributes
    ----------
    path : Path
    window : Window
    raw : RawImage or None
        None for an orthoimage.
    relief : float, m
        Highest minus lowest terrain that a raw image sees.
    """

    path: Path
    window: Window
    raw: RawImage | None = None
    relief: float = 0.0


@dataclass(frozen=True)
class PlacedScene:
    """A scene of which no pixel has been read.

    Attributes
    ----------
    grid : Grid
    terrain : Terrain
    places : list of Place
        In the order of the files.
    tables : list
        Positions for orthoimages, as `read_position_tables`.
    skipped : list of Skipped
    """

    grid: Grid
    terrain: Terrain
    places: list[Place]
    tables: list
    skipped: list[Skipped]

    @property
    def pixels(self):
        """Posts in the windows of all images."""
        return sum(place.window.rows * place.window.cols for place in self.places)

    @property
    def raw_pixels(self):
        """The same, of raw images alone."""
        windows = [place.window for place in self.places if place.raw is not None]
        return sum(window.rows * window.cols for window in windows)


def read_mixed_scene(files, grid_settings=None, body=MOON):
    """Terrain, orthoimages and raw images on one grid.

    Parameters
    ----------
    files : SceneFiles
    grid_settings : GridSettings, optional
    body : Body

    Returns
    -------
    scene : Scene
        The spacecraft of a line-scan image stands where it was at the middle line.
    """
    return read_placed(place_scene(files, grid_settings, body))


def place_scene(files, grid_settings=None, body=MOON, progress=silent):
    """The grid and where the images lie on it.

    Parameters
    ----------
    files : SceneFiles
    grid_settings : GridSettings, optional
    body : Body
    progress : callable

    Returns
    -------
    placed : PlacedScene
    """
    refuse_duplicates(files.images)
    if not files.dems:
        raise InputError("No DEM given. Name at least one with --dem.")
    cameras = dict(zip(files.images, raw_cameras(files), strict=True))
    settings, terrain, skipped = grid_settings or GridSettings(), Terrain(files.dems, body), []
    raw = {image: camera for image, camera in cameras.items() if camera is not None}
    flat = [path for path in files.images if path not in raw]
    tables = read_position_tables(files, body) if flat else []
    own, found = {}, {}
    if raw:
        pairs = replace(files, images=tuple(raw), cameras=tuple(raw.values()))
        images, skipped = read_raw_images(pairs, body)
        views, more = _place_raw(images, terrain, settings, progress)
        skipped += more
        found = {image.path: (image, relief) for image, _, relief in views}
        own = {image.path: grid for image, grid, _ in views}
    flat_grids, more = place_images(flat, terrain.grids, body)
    skipped += more
    own = flat_grids | own
    if not own:
        raise InputError("No image can be used.\n" + listing(skipped))
    grid = choose_grid(list(own.values()), terrain.grids, settings, "images", body)
    refuse_unusable(grid)
    places = []
    for path in (path for path in files.images if path in own):
        window = own[path].footprint(grid)
        if window.is_empty or (path in found and min(window.shape) < 2):
            skipped.append(Skipped(path.name, f"{path.name} does not overlap the output grid."))
            continue
        places.append(Place(path, window, *found.get(path, ())))
    return PlacedScene(grid, terrain, places, tables, skipped)


def read_placed(placed, jobs=None, store=Held.rows, stamps=None):
    """Terrain and images of a placed scene.

    Parameters
    ----------
    placed : PlacedScene
    jobs : InThreads, optional
        Reads bands of the terrain and images.
    store : function (name, shape, parts)
        Puts the arrays of an iterator, which follow each other from north to south, together to one
        of a shape; `Held.rows` in memory.
    stamps : dict, optional
        From `lommel.run.records.stamps`; a file that is not as they tell is an error.

    Returns
    -------
    scene : Scene
    """
    jobs, stamps = jobs or InThreads(), stamps or {}
    common = replace(placed, places=[], skipped=[])  # a job needs no place but its own
    grid, skipped = placed.grid, list(placed.skipped)
    numbered = list(enumerate(_bands(grid.window, SQUARES * POSTS_AT_ONCE)))
    found = list(jobs.each(ReadTerrain(common, store, stamps), numbered, "terrain", threads=1))
    if not any(is_known for _, is_known in found):
        raise InputError(
            "The DEM has no height inside the output grid. Check --bounds, and that DEM and "
            "images show the same region."
        )
    heights = stacked([rows for rows, _ in found])
    numbered = list(enumerate(placed.places))
    read = ReadImage(common, store, heights, stamps)
    images = list(jobs.each(read, numbered, "images", threads=1))
    skipped += [image for image in images if isinstance(image, Skipped)]
    observations = [image for image in images if not isinstance(image, Skipped)]
    if not observations:
        raise InputError("No image can be used.\n" + listing(skipped))
    return Scene(grid, heights, observations, skipped)


@dataclass(frozen=True)
class ReadTerrain:
    """Reads bands of the terrain.

    Attributes
    ----------
    placed : PlacedScene
    store : function
    stamps : dict
        As of `read_placed`.
    """

    placed: PlacedScene
    store: Callable
    stamps: dict

    def __call__(self, item):
        """Heights of a band and whether any is known, from its number and its window."""
        number, part = item
        rows = self.store(f"heights-{number:05d}", part.shape, self._heights(part))
        return rows, any(np.isfinite(row).any() for row in rows)

    def _heights(self, part):
        yield self.placed.terrain.heights(self.placed.grid.cut(part))
        refuse_changed(self.stamps, self.placed.terrain.paths)


@dataclass(frozen=True)
class ReadImage:
    """Reads images.

    Attributes
    ----------
    placed : PlacedScene
    store : function
        As of `read_placed`.
    heights : array (rows, cols), m
        Or what waits on the disk.
    stamps : dict
        As of `read_placed`.
    """

    placed: PlacedScene
    store: Callable
    heights: np.ndarray
    stamps: dict

    def __call__(self, item):
        """`Observation`, or `Skipped` where it cannot be used, from its number and its `Place`."""
        number, place = item
        try:
            sun, craft, saturation = _circumstances(place, self.placed)
            rows = self._unchanged(place, _checked_rows(place, self.placed, self.heights))
            measured = self.store(f"image-{number:05d}", place.window.shape, rows)
        except (InputError, GeometryError) as error:  # a full disk is none of them
            refuse_changed(self.stamps, [place.path])
            return Skipped(place.path.name, str(error))
        return Observation(place.path.name, place.window, measured, sun, craft, saturation)

    def _unchanged(self, place, rows):
        yield from rows
        refuse_changed(self.stamps, [place.path])


def _bands(window, posts):
    """All columns of some rows each, from north to south, so many posts at most."""
    return window.parts(max(1, min(BAND, posts // window.cols)))


def _circumstances(place, placed):
    """Where Sun and spacecraft stood, and the value at which the image clips."""
    info = raster_info(place.path, placed.terrain.body)
    if place.raw is not None:
        return place.raw.sun, place.raw.camera.position, info.saturation
    name = place.path.name
    sun, craft = (find_position(table, name, source) for source, table in placed.tables)
    return sun, craft, info.saturation


def _checked_rows(place, placed, heights):
    """Brightness in the window of an image, some rows at a time; an error at the end without."""
    read = _flat_rows if place.raw is None else _raw_rows
    has_value = has_ground = False
    for part, values in read(place, placed):
        is_known = np.isfinite(values)
        has_value = has_value or bool(is_known.any())
        has_ground = has_ground or bool((is_known & np.isfinite(heights[part.slices])).any())
        yield values
    name = place.path.name
    if not has_value and place.raw is None:
        raise GeometryError(f"{name} holds no brightness: all is shadow, clipped or no data.")
    if not has_ground:
        raise GeometryError(f"{name} has no valid pixel where the DEM is known.")


def _flat_rows(place, placed):
    for part in _bands(place.window, POSTS_AT_ONCE):
        yield part, read_image_on_grid(place.path, placed.grid.cut(part), placed.terrain.body)


def _raw_rows(place, placed):
    for row, rows in _shares(place.window.rows):
        part = replace(place.window, row=place.window.row + row, rows=rows)
        values = np.empty(part.shape, np.float32)
        for col, cols in _shares(part.cols):
            square = Window(part.row, part.col + col, rows, cols)
            tile, _ = view_window(place.raw, placed.grid, square, placed.terrain, place.relief)
            values[:, col : col + cols] = show_pixels(place.raw, tile)
        yield part, values


def _shares(size):
    """Begin and length of about equal parts of a side, `SQUARE` long at most."""
    edges = np.linspace(0, size, -(-size // SQUARE) + 1).astype(int).tolist()
    return [(first, last - first) for first, last in zip(edges[:-1], edges[1:], strict=True)]


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


def _place_raw(images, terrain, settings, progress):
    """Image, grid of its part of the DEM and relief there; and the images that cannot be placed."""
    placed, skipped = [], []
    gsd = common_gsd(images, terrain)
    for image in progress(images, "footprints"):
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
