"""`lommel evaluate`: read a product and its reference, and compare them.

Most callers want `evaluate_product`.
"""

import csv
import json
import warnings
from pathlib import Path

import numpy as np

from lommel.errors import InputError
from lommel.evaluate import compare_albedo, compare_heights, compare_points
from lommel.io.raster import read_grid, read_on_grid, read_pixels
from lommel.scene.body import MOON

COLUMNS = ("longitude_deg", "latitude_deg", "height_m")
QUANTITIES = ("height", "albedo")


def evaluate_product(product, reference, border=0, quantity="height", json_path=None, body=MOON):
    """Errors of a DEM or an albedo map.

    Parameters
    ----------
    product : path
        GeoTIFF.
    reference : path
        A raster, which is resampled onto the product's grid, or a ``.csv`` of points with the
        columns ``longitude_deg, latitude_deg, height_m`` (others are ignored).
    border : int, posts
        Left out along each edge of the product.
    quantity : {'height', 'albedo'}
        What the product holds; points are heights.
    json_path : path, optional
        Also write the errors there.
    body : Body

    Returns
    -------
    errors : dict of str to number
        Names carry the unit; see `lommel.evaluate`.
    """
    if quantity not in QUANTITIES:
        raise InputError(f"quantity = {quantity!r} is not known. Choose height or albedo.")
    grid = read_grid(product, body)
    values = read_pixels(product)
    if Path(reference).suffix.lower() == ".csv":
        if quantity != "height":
            raise InputError(f"{reference}: points hold heights. Give a raster of the {quantity}.")
        longitude, latitude, heights = read_points(reference)
        errors = compare_points(values, grid, longitude, latitude, heights, border)
    else:
        expected = read_on_grid(reference, grid, body)
        if quantity == "height":
            errors = compare_heights(values, expected, grid, border)
        else:
            errors = compare_albedo(values, expected, border)
    if json_path is not None:
        _write_json(json_path, errors)
    return errors


def read_points(path):
    """Points of known height from a CSV file with a header line.

    Parameters
    ----------
    path : path

    Returns
    -------
    longitude, latitude : array (n,), rad
    height : array (n,), m above the reference sphere
    """
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            header = [name.strip() for name in next(csv.reader(file), [])]
            missing = [name for name in COLUMNS if name not in header]
            if missing:
                raise InputError(
                    f"{path} has no column {', '.join(missing)}; it has "
                    f"{', '.join(header[:8]) or 'no header line'}. Name the columns "
                    f"{', '.join(COLUMNS)} in the first line."
                )
            columns = [header.index(name) for name in COLUMNS]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # no lines: said below
                points = np.loadtxt(file, delimiter=",", usecols=columns, ndmin=2)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read as a table of points: {error}") from error
    except (ValueError, IndexError) as error:
        raise InputError(
            f"{path}: {str(error).rstrip('.')}. Each line must hold numbers under "
            f"{', '.join(COLUMNS)}."
        ) from error
    if points.shape[0] == 0:
        raise InputError(f"{path} holds no point below its header line.")
    if not np.isfinite(points).all():
        line = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0]) + 1
        raise InputError(
            f"{path}: point {line} holds a value that is not finite. Remove it; points without "
            "a height cannot be compared."
        )
    return np.radians(points[:, 0]), np.radians(points[:, 1]), points[:, 2]


def _write_json(path, errors):
    known = {name: value if np.isfinite(value) else None for name, value in errors.items()}
    try:
        Path(path).write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}.") from error
