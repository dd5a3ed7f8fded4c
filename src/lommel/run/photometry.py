"""Albedo and exposures that are known before shape from shading, from files of an earlier run.

Most callers want `read_known`.
"""

import csv

import numpy as np

from lommel.errors import InputError
from lommel.io.raster import read_on_grid

SIZE_LIMIT = 100_000_000  # bytes: a million images


def read_known(albedo, exposures, grid, names):
    """Known albedo on a grid, known exposures and hazes of images; None for what is not given.

    Parameters
    ----------
    albedo : path or None
        Map, as ``albedo.tif`` of a run; posts it does not cover get its median.
    exposures : path or None
        Table, as ``exposures.csv`` of a run: columns image, exposure and, if there, haze.
    grid : Grid
    names : list of str
        File names of the images, in order.

    Returns
    -------
    albedo : float32 array (rows, cols) or None
    photometry : (array (images,), array (images,)) or None, image units
        Exposures and hazes.
    """
    known = None if albedo is None else _read_albedo(albedo, grid)
    return known, None if exposures is None else _read_exposures(exposures, names)


def _read_albedo(path, grid):
    values = read_on_grid(path, grid)
    positive = values[values > 0]
    if not positive.size:
        raise InputError(
            f"{path} holds no positive albedo where the DEM lies. Give a map of the same place."
        )
    return np.where(values > 0, values, np.median(positive)).astype(np.float32)


def _read_exposures(path, names):
    try:
        with open(path, encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file.read(SIZE_LIMIT).splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read as a table of exposures: {error}") from error
    table = {row.get("image"): row for row in rows}
    exposures, hazes = [], []
    for name in names:
        row = table.get(name)
        if row is None:
            raise InputError(
                f"{path} has no line for {name}. Give a table with the columns image, exposure and "
                "haze, and a line for every image."
            )
        exposures.append(_number(row.get("exposure"), name, path, lowest=0.0))
        hazes.append(_number(row.get("haze") or "0", name, path, lowest=-np.inf))
    return np.array(exposures), np.array(hazes)


def _number(text, name, path, lowest):
    try:
        value = float(text)
    except (TypeError, ValueError):
        value = np.nan
    if not lowest < value < np.inf:
        raise InputError(
            f"{path}: {name} has {text!r} where a number above {lowest:g} is needed. "
            "Leave the image out, or correct the line."
        )
    return value
