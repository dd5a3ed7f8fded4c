"""The two products from Python: `lommel.albedo` and `lommel.shape_from_shading`.

Both take the same files as the commands and return an `xarray.Dataset` over (y, x), with the CRS
in the coordinate ``spatial_ref`` as rioxarray and QGIS read it, and the run's record (settings,
results, outcome, skipped images) in ``attrs["record"]``.
"""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import xarray as xr

from lommel.io.raster import read_grid, read_pixels
from lommel.run.inputs import GridSettings, SceneFiles


def albedo(
    images,
    dem,
    sun_positions,
    spacecraft_positions,
    *,
    grid: GridSettings | None = None,
    output=None,
    **settings,
):
    """Albedo map and exposures; the Python form of ``lommel albedo``.

    Parameters
    ----------
    images : sequence of path
        Orthoimages.
    dem : path or sequence of path
    sun_positions, spacecraft_positions : path
        Position tables.
    grid : GridSettings, optional
    output : path, optional
        Keep the products in this folder.
    **settings
        As `lommel.run.albedo.albedo_settings` takes them.

    Returns
    -------
    dataset : xarray.Dataset
        ``albedo``, ``orthomosaic``, ``count``, ``residual``.
    """
    from lommel.run.albedo import albedo_settings, run_albedo

    files = SceneFiles(_paths(images), _paths(dem), Path(sun_positions), Path(spacecraft_positions))
    chosen = albedo_settings(**settings)
    return _kept(lambda folder: run_albedo(files, folder, chosen, grid), output)


def shape_from_shading(
    images,
    dem,
    sun_positions,
    spacecraft_positions=None,
    *,
    cameras=(),
    settings=None,
    grid: GridSettings | None = None,
    output=None,
):
    """Terrain refined by shading; the Python form of ``lommel sfs``.

    Parameters
    ----------
    images : sequence of path
        Orthoimages, or raw images with cameras.
    dem : path or sequence of path
    sun_positions : path
    spacecraft_positions : path, optional
        Needed for orthoimages.
    cameras : sequence of path
        One per image; empty to look beside the images.
    settings : SfsSettings, optional
    grid : GridSettings, optional
    output : path, optional
        Keep the products in this folder.

    Returns
    -------
    dataset : xarray.Dataset
        ``dem``, ``initial_dem`` and the pictures; those on cells have their own ``y_cell``,
        ``x_cell``, half a post away.
    """
    from lommel.run.shape_from_shading import run_shape_from_shading

    files = SceneFiles(
        _paths(images),
        _paths(dem),
        Path(sun_positions),
        None if spacecraft_positions is None else Path(spacecraft_positions),
        cameras=_paths(cameras),
    )
    return _kept(lambda folder: run_shape_from_shading(files, folder, settings, grid), output)


def _paths(names):
    return (Path(names),) if isinstance(names, str | Path) else tuple(Path(name) for name in names)


def _kept(run, output):
    """Products of a run as a dataset; the folder is kept only if it was asked for."""
    with TemporaryDirectory() as scratch:
        folder = Path(output or Path(scratch) / "products")
        run(folder)
        return _dataset(folder)


def _dataset(folder):
    variables, coordinates, main = {}, {}, None
    for path in sorted(folder.glob("*.tif"), key=lambda path: (path.stem != "dem", path.stem)):
        grid = read_grid(path)
        main = main or grid
        suffix = "" if grid.shape == main.shape else "_cell"
        rows, cols = grid.shape
        x, _ = grid.affine @ (np.arange(cols) + 0.5, np.full(cols, 0.5))
        _, y = grid.affine @ (np.full(rows, 0.5), np.arange(rows) + 0.5)
        dims = f"y{suffix}", f"x{suffix}"
        coordinates |= {dims[0]: y, dims[1]: x}
        variables[path.stem.replace("-", "_")] = dims, read_pixels(path)
    dataset = xr.Dataset(variables, coordinates)
    dataset = dataset.assign_coords(spatial_ref=((), 0, {"crs_wkt": main.crs.to_wkt()}))
    record = (folder / "run.json").read_text(encoding="utf-8")
    return dataset.assign_attrs(record=json.loads(record))
