"""What a stage reads: one terrain, one grid, many images, and the reasons for images left out.

An image that cannot be used is reported and left out; a run ends only when none is left.
Most callers want `read_scene`.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lommel.errors import GeometryError, InputError, LommelError, UnreadableError
from lommel.io.positions import find_position, read_positions
from lommel.io.raster import raster_info, read_grid, read_image_on_grid, read_on_grid
from lommel.progress import silent
from lommel.scene.body import MOON
from lommel.scene.geometry import Observation
from lommel.scene.grid import Grid, Window, bounds_in, grid_from_bounds, read_crs

POST_LIMIT = 2**30  # posts of the products: 4 GiB for every float32 array of them
SQUARE = 4096  # posts along each side of the terrain while it is read, 30 bytes each
RADIUS_FROM = 0.5  # of the body's radius; no height comes near it
DEM_IS_FINE_ENOUGH = 1.5  # image pixels per DEM post up to which the DEM's own grid is kept


@dataclass(frozen=True)
class GridSettings:
    """Where the products' posts stand; every value left out is chosen from the inputs.

    Attributes
    ----------
    spacing : float, m, or None
    crs : str or None
        WKT, PROJ text or authority code.
    bounds : tuple of float or None
        xmin, ymin, xmax, ymax in units of the CRS.
    """

    spacing: float | None = None
    crs: str | None = None
    bounds: tuple[float, float, float, float] | None = None

    @property
    def is_automatic(self):
        """True when nothing was asked for."""
        return self.spacing is None and self.crs is None and self.bounds is None


@dataclass(frozen=True)
class SceneFiles:
    """The files that describe a scene.

    Attributes
    ----------
    images, dems : tuple of Path
    sun_positions, spacecraft_positions : Path or None
        Position tables.
    positions_unit : {'auto', 'm', 'km'}
    cameras : tuple of Path
        One camera file per image, in the same order; empty to look beside the images.
    """

    images: tuple[Path, ...]
    dems: tuple[Path, ...]
    sun_positions: Path | None = None
    spacecraft_positions: Path | None = None
    positions_unit: str = "auto"
    cameras: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Skipped:
    """An image that was left out.

    Attributes
    ----------
    name : str
    reason : str
    """

    name: str
    reason: str


@dataclass(frozen=True)
class Scene:
    """Everything an estimator needs, on one grid.

    Attributes
    ----------
    grid : Grid
    heights : float32 array (rows, cols), m
        The terrain; NaN in holes.
    observations : list of Observation
    skipped : list of Skipped
    """

    grid: Grid
    heights: np.ndarray
    observations: list[Observation]
    skipped: list[Skipped]


def read_scene(
    files,
    grid_settings=None,
    prefer="images",
    body=MOON,
    progress=silent,
    is_part=False,
):
    """Terrain and images on one grid.

    Parameters
    ----------
    files : SceneFiles
    grid_settings : GridSettings or Grid, optional
        A grid is taken as it is.
    prefer : {'images', 'dem'}
        Whose posts the automatic grid takes over.
    body : Body
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.
    is_part : bool
        The images have been read before, for all of the scene: one that cannot be read now is no
        longer left out, but an `UnreadableError`.

    Returns
    -------
    scene : Scene
    """
    refuse_duplicates(files.images)
    if not files.dems:
        raise InputError("No DEM given. Name at least one with --dem.")
    tables = read_position_tables(files, body)
    dem_grids = [read_grid(path, body) for path in files.dems]
    image_grids, skipped = place_images(files.images, dem_grids, body, is_part)
    if not image_grids:
        raise InputError("No image can be used.\n" + listing(skipped))
    grid = choose_grid(
        list(image_grids.values()), dem_grids, grid_settings or GridSettings(), prefer, body
    )
    refuse_unusable(grid)
    heights = read_heights(files.dems, grid, body)
    observations = []
    for path in progress(list(image_grids), "images"):
        try:
            observations.append(observe(path, image_grids[path], grid, heights, tables, body))
        except LommelError as error:
            skipped.append(left_out(path, error, is_part))
    if not observations:
        raise InputError("No image can be used.\n" + listing(skipped))
    return Scene(grid, heights, observations, skipped)


def choose_grid(image_grids, dem_grids, settings, prefer="images", body=MOON):
    """The grid of the products.

    Automatic: the area that images and DEM share, in the CRS of the preferred input, at the
    images' own spacing, and at their own posts where these coincide. With ``prefer='dem'`` the
    DEM's posts are kept as they are, unless the images are finer than the DEM by more than
    `DEM_IS_FINE_ENOUGH`.

    Parameters
    ----------
    image_grids, dem_grids : list of Grid
    settings : GridSettings or Grid
        A grid is taken as it is.
    prefer : {'images', 'dem'}
    body : Body

    Returns
    -------
    grid : Grid
    """
    if isinstance(settings, Grid):
        return settings
    preferred = dem_grids[0] if prefer == "dem" else image_grids[0]
    crs = read_crs(settings.crs, body, "--crs") if settings.crs else preferred.crs
    gsd = float(np.median([max(grid.spacing) for grid in image_grids]))
    dem_spacing = max(dem_grids[0].spacing)
    keeps_dem = prefer == "dem" and len(dem_grids) == 1 and dem_spacing < DEM_IS_FINE_ENOUGH * gsd
    if settings.is_automatic and (keeps_dem or len(image_grids) == 1):
        own = dem_grids[0] if keeps_dem else image_grids[0]
        others = image_grids if keeps_dem else dem_grids
        return own.cut(_enclosing([grid.footprint(own) for grid in others]))
    spacing = settings.spacing
    if spacing is None:
        spacing = dem_spacing if keeps_dem else gsd
    if settings.bounds is not None:
        return grid_from_bounds(settings.bounds, spacing, crs, body)
    is_theirs = settings.is_automatic and crs == image_grids[0].crs
    own = _common_lattice(image_grids) if is_theirs else None
    if own is None:
        bounds = np.array([bounds_in(grid, crs) for grid in image_grids])
        union = *bounds[:, :2].min(axis=0).tolist(), *bounds[:, 2:].max(axis=0).tolist()
        own = grid_from_bounds(union, spacing, crs, body)
    return own.cut(_enclosing([dem.footprint(own) for dem in dem_grids]))


def _common_lattice(grids):
    """The north-up grid around all of them whose posts are theirs; None where there is none."""
    if not grids[0].is_north_up:
        return None
    offsets = [grid.offset_in(grids[0]) for grid in grids]
    if None in offsets:
        return None
    first = np.array(offsets)
    last = first + [grid.shape for grid in grids]
    low = first.min(axis=0)
    return grids[0].cut(Window(*low.tolist(), *(last.max(axis=0) - low).tolist()))


def read_heights(paths, grid, body=MOON):
    """Terrain on a grid: the mean of the DEMs where they overlap (step 1 of the albedo paper).

    Parameters
    ----------
    paths : sequence of path
    grid : Grid
    body : Body

    Returns
    -------
    heights : float32 array (rows, cols), m; NaN where no DEM knows
    """
    heights = known_heights(paths, grid, body)
    if not np.isfinite(heights).any():
        raise InputError(
            "The DEM has no height inside the output grid. Check --bounds, and that DEM and "
            "images show the same region."
        )
    return heights


def known_heights(paths, grid, body=MOON):
    """The same as `read_heights`, also where no DEM knows anything.

    A DEM that holds planetary radii, as those of the PDS do, is told by its size.

    Parameters
    ----------
    paths : sequence of path
    grid : Grid
    body : Body

    Returns
    -------
    heights : float32 array (rows, cols), m; NaN where no DEM knows
    """
    heights = np.empty(grid.shape, np.float32)
    for part in grid.window.parts(SQUARE, SQUARE):
        heights[part.slices] = _mean_heights(paths, grid.cut(part), body)
    return heights


def _mean_heights(paths, grid, body):
    total = np.zeros(grid.shape)
    count = np.zeros(grid.shape, np.int16)
    for path in paths:
        window = read_grid(path, body).footprint(grid)
        if window.is_empty:
            continue
        part = read_on_grid(path, grid.cut(window), body)
        known = np.isfinite(part)
        if known.any() and np.median(part[known]) > RADIUS_FROM * body.radius:
            part = part.astype(float) - body.radius
        total[window.slices] += np.where(known, part, 0.0)
        count[window.slices] += known
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def left_out(path, error, is_part):
    """`Skipped` for an image that failed, but not for a part of a scene that was read before."""
    if is_part and isinstance(error, UnreadableError):
        raise error
    return Skipped(path.name, str(error))


def place_images(paths, dem_grids, body, is_part=False):
    """Grid of each orthoimage that overlaps a DEM, and the `Skipped` others."""
    grids, skipped = {}, []
    for path in paths:
        try:
            grid = read_grid(path, body)
            if all(dem.footprint(grid).is_empty for dem in dem_grids):
                raise GeometryError(f"{path.name} does not overlap the DEM.")
            grids[path] = grid
        except LommelError as error:
            skipped.append(left_out(path, error, is_part))
    return grids, skipped


def observe(path, image_grid, grid, heights, tables, body):
    """An orthoimage on the grid of the run, an `Observation`; tables as `read_position_tables`."""
    window = image_grid.footprint(grid)
    if window.is_empty:
        raise GeometryError(f"{path.name} does not overlap the output grid.")
    positions = [find_position(table, path.name, source) for source, table in tables]
    measured = read_image_on_grid(path, grid.cut(window), body)
    if not np.isfinite(measured).any():
        raise GeometryError(f"{path.name} holds no brightness: all is shadow, clipped or no data.")
    if not (np.isfinite(measured) & np.isfinite(heights[window.slices])).any():
        raise GeometryError(f"{path.name} has no valid pixel where the DEM is known.")
    info = raster_info(path, body)
    return Observation(path.name, window, measured, *positions, info.saturation)


def read_position_tables(files, body):
    """Path and content of the Sun's and of the spacecraft's table."""
    tables = []
    for kind, path in (("sun", files.sun_positions), ("spacecraft", files.spacecraft_positions)):
        if path is None:
            raise InputError(
                f"No {kind} positions given. Name a table of lines KEY x y z with "
                f"--{kind}-positions."
            )
        tables.append((path, read_positions(path, kind, body, files.positions_unit)))
    return tables


def refuse_duplicates(paths):
    """Raise `InputError` unless there are images, each with a name of its own."""
    if not paths:
        raise InputError("No image given. Name at least one image file.")
    counts = Counter(path.name for path in paths)
    twice = [name for name, count in counts.items() if count > 1]
    if twice:
        raise InputError(
            f"{', '.join(twice[:5])} given more than once. File names are the images' names in "
            "every table and product: give each image once."
        )


def refuse_unusable(grid):
    """Raise `InputError` when a grid has more posts than any machine holds, or none for slopes."""
    rows, cols = grid.shape
    if min(rows, cols) < 2:
        raise InputError(
            f"The products would have {rows} x {cols} posts; a slope needs 2 along each side. "
            "Give a smaller --spacing or wider --bounds, or images that share more with the DEM."
        )
    if rows * cols > POST_LIMIT:
        raise InputError(
            f"The products would have {rows} x {cols} posts, more than {POST_LIMIT}. "
            "Give a larger --spacing or narrower --bounds."
        )


def _enclosing(windows):
    windows = [window for window in windows if not window.is_empty]
    if not windows:
        raise InputError("Images and DEM share no area in the CRS of the products. Check --crs.")
    row = min(window.row for window in windows)
    col = min(window.col for window in windows)
    last_row = max(window.row + window.rows for window in windows)
    last_col = max(window.col + window.cols for window in windows)
    return Window(row, col, last_row - row, last_col - col)


def listing(skipped):
    """The reasons of skipped images, one per line, for a message."""
    lines = [f"  {skip.reason}" for skip in skipped[:20]]
    more = [f"  ... and {len(skipped) - 20} more"] if len(skipped) > 20 else []
    return "\n".join(lines + more)
