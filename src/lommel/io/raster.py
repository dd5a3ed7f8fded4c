"""GeoTIFFs and every other raster GDAL reads: frames, pixels on a grid, and products.

Reading is windowed: only the part of a file that a grid needs leaves the disk. Whatever marks a
pixel as missing (nodata, mask, alpha or a second band that is zero) becomes NaN.
Products are Cloud-Optimized GeoTIFFs, written beside their place and renamed when whole.
rasterio lives in this module only. Most callers want `read_on_grid` and `write_raster`.
"""

import json
import os
import shutil
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio
import rasterio.shutil
from affine import Affine
from numba import get_num_threads
from rasterio._env import set_gdal_config
from rasterio._err import CPLE_BaseError
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.warp import reproject
from rasterio.windows import Window as FileWindow

from lommel.errors import InputError, UnreadableError
from lommel.scene.body import MOON
from lommel.scene.grid import LEAST_SPACING, Grid, Window, read_crs

PIXEL_LIMIT = 2**34  # pixels of one raster side by side; beyond it the header is not believable
DOWNSAMPLING = 1.5  # input pixels per post from which area means replace interpolation
CLIPPED_8_BIT = (0.0, 255.0)  # image values that only say "at most" and "at least"
GDAL_ERRORS = (RasterioError, CPLE_BaseError, OSError, ValueError)  # rasterio mixes them
SPECIAL = 1e38  # ISIS marks missing pixels by values beyond it, double nodata is cut down to it
PIXELS_AT_ONCE = 2**25  # of a raster held to make a smaller one: 128 MiB
BLOCK = 512  # pixels along each side of a GeoTIFF's tiles
WRITING_SPACE = 2.7  # of a raster's plain size, while it is written: itself, overviews, the copy
COG = {
    "driver": "COG",
    "compress": "zstd",  # half the time of deflate for the same size
    "predictor": "yes",
    "level": 1,
    "overview_resampling": "average",
    "num_threads": 2,
}
# Packing the overviews that GDAL lays aside for a moment takes a quarter of the time of a copy
LAID_ASIDE = {"COG_TMP_COMPRESSION": "NONE"}
SCRATCH_ROWS = 128  # of these tiles while they are written: rows of all of them are in memory
CACHE_MB = 128  # of blocks that GDAL holds; its default is a share of the machine
ISIS_LABEL = "json:ISIS3"  # GDAL's domain of metadata that holds it
FILES_AT_ONCE = 8  # whose headers are read side by side: a shared disk answers after milliseconds
MARGIN = 4  # pixels read around a window so that interpolation sees its neighbours

if "GDAL_CACHEMAX" not in os.environ:
    set_gdal_config("GDAL_CACHEMAX", CACHE_MB)


@dataclass(frozen=True)
class RasterInfo:
    """What a raster's header says.

    Attributes
    ----------
    path : Path
    shape : tuple of int
        Rows and columns.
    bands : int
    dtype : str
        Of the first band.
    nodata : float or None
    has_mask_band : bool
        The second band is an 8-bit mask or alpha, not data.
    has_label : bool
        An ISIS label, which may tell of a camera.
    grid : Grid or None
        None when the raster carries no CRS or no transform.
    sketch : bool array (rows, cols) or None
        True on pixels of a lattice that are known and not black, where that was asked for.
    """

    path: Path
    shape: tuple[int, int]
    bands: int
    dtype: str
    nodata: float | None
    has_mask_band: bool
    has_label: bool
    grid: Grid | None
    sketch: np.ndarray | None = None

    @property
    def saturation(self):
        """The value at which 8-bit images clip; infinity for every other type."""
        return 255.0 if self.dtype == "uint8" else np.inf


def raster_info(path, body=MOON, sketch=0):
    """Header of a raster, checked to be usable.

    Parameters
    ----------
    path : path
    body : Body
        The CRS, if any, must be one of this body.
    sketch : int, pixels
        Along each side of the lattice that tells where a map-projected raster shows something;
        none is read for 0.

    Returns
    -------
    info : RasterInfo
    """
    with _open(path) as file:
        rows, cols = file.shape
        if file.count == 0:
            raise InputError(f"{path} holds no band of its own. Name one of its parts.")
        if rows * cols > PIXEL_LIMIT:
            raise InputError(
                f"{path}: the header claims {rows} x {cols} pixels, more than {PIXEL_LIMIT}. "
                "The file is damaged, or has to be cut first."
            )
        if file.dtypes[0].startswith("complex"):
            raise InputError(f"{path}: band 1 is {file.dtypes[0]}. Give a raster of real numbers.")
        grid = _grid_of(file, path, body)
        return RasterInfo(
            path=Path(path),
            shape=(rows, cols),
            bands=file.count,
            dtype=file.dtypes[0],
            nodata=file.nodata,
            has_mask_band=_has_mask_band(file),
            has_label=bool(file.tags(ns=ISIS_LABEL)),
            grid=grid,
            sketch=_sketch(file, path, sketch) if sketch and grid is not None else None,
        )


def _sketch(file, path, size):
    """Single pixels of a lattice: which of them are known and not black."""
    shape = tuple(min(side, size) for side in file.shape)
    try:
        values = file.read(1, out_shape=shape, resampling=Resampling.nearest)
        known = file.read_masks(1, out_shape=shape) > 0
    except GDAL_ERRORS as error:
        raise UnreadableError(f"{path} cannot be read, it may be truncated: {error}") from error
    return known & (values > 0)


def read_isis_label(path):
    """Label of an ISIS cube, or of another raster that carries one, as nested dicts.

    Parameters
    ----------
    path : path

    Returns
    -------
    label : dict or None
        As in GDAL's metadata domain ``json:ISIS3``; None when the raster has no such label.
    """
    with _open(path) as file:
        items = file.tags(ns=ISIS_LABEL).items()
    # rasterio takes a cube's JSON for a line "key: value" and cuts it at its first colon; a
    # GeoTIFF's has a key of its own
    texts = [text if not key.startswith("{") else f"{key}:{text}" for key, text in items]
    try:
        label = json.loads(texts[0]) if texts else None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: the ISIS label cannot be read: {error}") from error
    return label if isinstance(label, dict) else None


def read_grid(path, body=MOON):
    """The grid of a map-projected raster; an error when it has no CRS."""
    return grid_of(raster_info(path, body))


def grid_of(info):
    """The grid in a header; an error when it has no CRS."""
    if info.grid is None:
        raise InputError(
            f"{info.path} has no CRS or no transform, so its place is unknown. Assign one with "
            "gdal_edit.py -a_srs and -a_ullr, or give a map-projected raster."
        )
    return info.grid


def side_by_side(function, paths):
    """What a function that looks at one raster gives for each of many, in their order.

    Parameters
    ----------
    function : function (path)
        It must not call compiled kernels that use threads of their own.
    paths : sequence of path

    Returns
    -------
    results : list
    """
    paths, results = list(paths), {}

    def some(first):
        # a listing of the folder for each file in it would cost the square of their number
        with rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="TRUE"):
            for k in range(first, len(paths), FILES_AT_ONCE):
                results[k] = function(paths[k])

    with warnings.catch_warnings(), ThreadPoolExecutor(FILES_AT_ONCE) as pool:
        # here, because threads share the filters that each of them would put back
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        list(pool.map(some, range(FILES_AT_ONCE)))
    return [results[k] for k in range(len(paths))]


def read_pixels(path, window=None):
    """First band as float32, missing pixels NaN.

    Parameters
    ----------
    path : path
    window : Window, optional
        Part to read; the whole raster by default.

    Returns
    -------
    values : float32 array (rows, cols), in the file's unit (scale and offset applied)
    """
    with _open(path) as file:
        window = window or Window(0, 0, *file.shape)
        part = FileWindow(window.col, window.row, window.cols, window.rows)
        try:
            values = file.read(1, window=part)
            missing = file.read_masks(1, window=part) == 0
            if _has_mask_band(file):
                missing |= file.read(2, window=part) == 0
        except GDAL_ERRORS as error:
            raise UnreadableError(f"{path} cannot be read, it may be truncated: {error}") from error
        scale, offset = file.scales[0], file.offsets[0]
    values = np.clip(values, -SPECIAL, SPECIAL, dtype=np.float32)
    values[missing | ~(np.abs(values) < SPECIAL)] = np.nan
    return (
        values if (scale, offset) == (1.0, 0.0) else np.float32(scale) * values + np.float32(offset)
    )


def read_image_on_grid(path, grid, body=MOON):
    """Brightness resampled onto a grid: area means from finer input, else bilinear.

    Pixels at either end of an 8-bit image, 0 and 255, were clipped: their brightness is unknown,
    and they count as missing before they can mix with their neighbours.

    Parameters
    ----------
    path : path
    grid : Grid
    body : Body

    Returns
    -------
    values : float32 array (rows, cols), NaN where the brightness is not known
    """
    clips = raster_info(path, body).dtype == "uint8"
    return read_on_grid(path, grid, body, Resampling.bilinear, CLIPPED_8_BIT if clips else ())


def read_on_grid(path, grid, body=MOON, interpolation=Resampling.cubic, unknown=()):
    """First band resampled onto a grid: area means from finer input, else interpolated.

    Missing input never leaks: a post is NaN when the input pixels at its place are missing.

    Parameters
    ----------
    path : path
    grid : Grid
    body : Body
    interpolation : Resampling
        Cubic for terrain; bilinear for images, whose grain cubic interpolation would enlarge.
    unknown : tuple of float
        Values that stand for missing pixels.

    Returns
    -------
    values : float32 array (rows, cols), NaN where the raster has nothing
    """
    source = read_grid(path, body)
    place = grid.place_in(source)
    part = _needed_part(source, grid) if place is None else place
    if part.is_empty:
        return np.full(grid.shape, np.nan, np.float32)
    is_large = part.rows * part.cols > max(PIXELS_AT_ONCE, 4 * grid.shape[0] * grid.shape[1])
    if is_large and grid.shape[0] > 1:  # much is read for few means: by halves
        top = Window(0, 0, grid.shape[0] // 2, grid.shape[1])
        low = Window(top.rows, 0, grid.shape[0] - top.rows, grid.shape[1])
        halves = (grid.cut(half) for half in (top, low))
        return np.concatenate([read_on_grid(path, h, body, interpolation, unknown) for h in halves])
    values, source = read_pixels(path, part), source.cut(part)
    values[np.isin(values, unknown)] = np.nan
    if place is not None or source.is_same(grid):
        return values
    return resample(values, source, grid, interpolation)


def resample(values, source, grid, interpolation=Resampling.cubic):
    """An array on one grid brought onto another; see `read_on_grid` for how.

    Parameters
    ----------
    values : float32 array (rows, cols) on ``source``
    source, grid : Grid
    interpolation : Resampling

    Returns
    -------
    values : float32 array on ``grid``, NaN where the source has nothing
    """
    is_finer = max(grid.spacing) > DOWNSAMPLING * max(source.spacing)
    method = Resampling.average if is_finer else interpolation
    result = np.full(grid.shape, np.nan, np.float32)
    frames = {
        "src_transform": source.affine,
        "src_crs": source.crs.to_wkt(),
        "dst_transform": grid.affine,
        "dst_crs": grid.crs.to_wkt(),
        "src_nodata": np.nan,
        "dst_nodata": np.nan,
        "num_threads": get_num_threads(),
        "tolerance": 0.0,  # exact transform at every post: the default errs by 1/8 pixel
    }
    if not is_finer:  # else GDAL blurs what lies at the seam of a global raster
        frames |= {"XSCALE": 1.0, "YSCALE": 1.0}
    reproject(values, result, resampling=method, **frames)
    if not is_finer and np.isnan(values).any():  # kernels reach 2 pixels: restore the hole's shape
        nearest = np.full(grid.shape, np.nan, np.float32)
        reproject(values, nearest, resampling=Resampling.nearest, **frames)
        result[np.isnan(nearest)] = np.nan
    return result


@dataclass(frozen=True)
class Preview:
    """A raster made small enough to look at.

    Attributes
    ----------
    values : float32 array (rows, cols)
        Area means of ``shrink`` x ``shrink`` pixels; NaN where nothing is known.
    grid : Grid
        Where these means lie.
    unit : str
        Of the first band.
    shrink : float
        Pixels of the raster per pixel of the preview along a row; 1 when it was small already.
    """

    values: np.ndarray
    grid: Grid
    unit: str
    shrink: float


def read_preview(path, size, body=MOON):
    """First band of a map-projected raster, shrunk by area means to a longest side in pixels.

    Parameters
    ----------
    path : path
    size : int, pixels
        A raster whose sides are no longer comes back as it is.
    body : Body

    Returns
    -------
    preview : Preview
    """
    grid = read_grid(path, body)
    shrink = max(1.0, max(grid.shape) / size)
    shape = tuple(max(1, round(side / shrink)) for side in grid.shape)
    with _open(path) as file:
        try:
            values = file.read(
                1,
                out_shape=shape,
                out_dtype="float32",
                resampling=Resampling.average,
                masked=True,
            ).filled(np.nan)
        except GDAL_ERRORS as error:
            raise UnreadableError(f"{path} cannot be read, it may be truncated: {error}") from error
        unit = file.units[0] or ""
    rows, cols = grid.shape
    affine = grid.affine @ Affine.scale(cols / shape[1], rows / shape[0])
    return Preview(values, replace(grid, shape=shape, affine=affine), unit, shrink)


def write_raster(path, values, grid, description, unit="", nodata=np.nan, valid=None):
    """One band as a Cloud-Optimized GeoTIFF; it appears whole or not at all.

    Parameters
    ----------
    path : path
    values : array (rows, cols)
        Floats are stored as float32, integers as they are.
    grid : Grid
    description, unit : str
        Band description and unit, as GIS programs show them.
    nodata : float
    valid : bool array (rows, cols), optional
        For 8-bit values, which have no NaN: stored as a mask in a second band.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with rasterio.MemoryFile() as memory:
            _write_cog(memory.name, np.asarray(values), grid, (description, unit), nodata, valid)
            # not by GDAL, which says nothing when the disk is full
            partial.write_bytes(memory.getbuffer())
        os.replace(partial, path)
    except GDAL_ERRORS as error:
        raise _unwritable(path, error) from error
    finally:
        with suppress(OSError):
            partial.unlink()


@contextmanager
def raster_writer(path, grid, description, unit="", dtype=np.float32, nodata=np.nan):
    """One band written window by window; the Cloud-Optimized GeoTIFF appears whole or not at all.

    Parameters
    ----------
    path : path
    grid : Grid
    description, unit : str
        Band description and unit, as GIS programs show them.
    dtype : numpy type
    nodata : float
        Also the value of windows that are never written.

    Yields
    ------
    write : function (values, window)
        Windows whose edges are multiples of `BLOCK` are written fastest.
    """
    path = Path(path)
    scratch, partial = (
        path.with_name(f".{path.name}.{os.getpid()}.{x}") for x in ("scratch", "partial")
    )
    profile = _profile(grid, dtype, nodata) | {
        "tiled": True,
        "blockxsize": BLOCK,
        "blockysize": SCRATCH_ROWS,
        "sparse_ok": True,
        "bigtiff": "if_safer",
    }
    _refuse_full_disk(path, grid, dtype)
    try:
        with rasterio.open(scratch, "w", **profile) as file:
            file.set_band_description(1, description)
            file.set_band_unit(1, unit)

            def write(values, window):
                part = FileWindow(window.col, window.row, window.cols, window.rows)
                file.write(np.asarray(values, dtype), 1, window=part)

            yield write
        with rasterio.Env(**LAID_ASIDE), rasterio.open(scratch) as file:
            shrink = "average" if np.dtype(dtype).kind == "f" else "mode"
            rasterio.shutil.copy(file, partial, **COG | {"overview_resampling": shrink})
        os.replace(partial, path)
    except GDAL_ERRORS as error:
        raise _unwritable(path, error) from error
    finally:
        for leftover in (scratch, partial):
            with suppress(OSError):
                leftover.unlink()


def _unwritable(path, error):
    """What is to be raised, with the free space that GDAL says nothing of."""
    free = shutil.disk_usage(next(f for f in path.absolute().parents if f.exists())).free
    return InputError(
        f"{path} cannot be written: {error}; {free / 1e6:.1f} MB of its disk are free."
    )


def _refuse_full_disk(path, grid, dtype):
    """GDAL says nothing when the disk is full: ask before."""
    rows, cols = grid.shape
    needed = int(WRITING_SPACE * rows * cols * np.dtype(dtype).itemsize)
    free = shutil.disk_usage(path.parent).free
    if needed > free:
        raise InputError(
            f"{path} needs up to {needed / 1e9:.3g} GB of disk, {free / 1e9:.3g} GB are free. "
            "Free some, name another --output, or give a larger --spacing or narrower --bounds."
        )


def _profile(grid, dtype, nodata):
    return {
        "driver": "GTiff",
        "height": grid.shape[0],
        "width": grid.shape[1],
        "count": 1,
        "dtype": dtype,
        "crs": grid.crs.to_wkt(),
        "transform": grid.affine,
        "nodata": nodata,
    }


def _write_cog(path, values, grid, texts, nodata, valid):
    is_float = values.dtype.kind == "f"
    dtype = np.float32 if is_float else values.dtype
    profile = _profile(grid, dtype, nodata if is_float else None)
    profile["count"] = 1 if valid is None else 2
    with rasterio.MemoryFile() as memory:
        with memory.open(**profile) as file:
            file.write(values.astype(profile["dtype"], copy=False), 1)
            file.set_band_description(1, texts[0])
            file.set_band_unit(1, texts[1])
            if valid is not None:
                file.write(np.where(valid, 255, 0).astype(profile["dtype"]), 2)
                file.set_band_description(2, "mask")
        with memory.open() as file:
            rasterio.shutil.copy(file, path, **COG)


def _open(path):
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            return rasterio.open(_label(path))
    except GDAL_ERRORS as error:
        reason = "there is no such file" if not Path(path).exists() else str(error)
        raise UnreadableError(f"{path} cannot be opened as a raster: {reason}") from error


def _label(path):
    """The file to open for a raster: of PDS images with a detached label, the label."""
    path = Path(path)
    if path.suffix.lower() == ".img":
        labels = (path.with_suffix(suffix) for suffix in (".LBL", ".lbl"))
        return next((label for label in labels if label.exists()), path)
    return path


def _has_mask_band(file):
    if file.count != 2:
        return False
    return file.dtypes[1] == "uint8" or file.colorinterp[1] == ColorInterp.alpha


def _grid_of(file, path, body):
    is_usable = np.isfinite(file.transform).all() and not file.transform.is_degenerate
    if file.crs is None or file.transform.is_identity or not is_usable:
        return None
    grid = Grid(file.shape, file.transform, read_crs(file.crs.to_wkt(), body, str(path)), body)
    if not min(grid.spacing) >= LEAST_SPACING:
        raise InputError(
            f"{path}: pixels of {grid.spacing[0]:g} x {grid.spacing[1]:g} m are not those of a "
            "map. Correct its CRS or transform with gdal_edit.py -a_srs and -a_ullr."
        )
    return grid


def _needed_part(source, grid):
    window = grid.footprint(source)
    if window.is_empty:
        return window
    margin = MARGIN + int(np.ceil(max(grid.spacing) / min(source.spacing)))
    wide = Window(
        window.row - margin,
        window.col - margin,
        window.rows + 2 * margin,
        window.cols + 2 * margin,
    )
    return wide.intersection(source.window)
