r"""A product against a reference: heights, slopes, albedo, exposures.

With the difference :math:`d = product - reference` over the posts where both are known:

.. math::
    RMSE = \sqrt{mean(d^2)}, \quad MAE = mean |d|, \quad
    NMAD = 1.4826\, median |d - median(d)|.

Nothing here knows how a product was made. Most callers want `compare_heights`.
"""

import numpy as np

from lommel.errors import InputError
from lommel.scene.body import up_vector
from lommel.scene.geometry import surface_normals

NORMAL_SCALE = 1.4826  # makes the median absolute deviation a standard deviation, if Gaussian


def compare_heights(heights, reference, grid, border=0):
    """Errors of a DEM against another on the same grid.

    Parameters
    ----------
    heights, reference : array (rows, cols), m
        NaN where unknown; such posts do not count.
    grid : Grid
    border : int, posts
        Left out along each edge.

    Returns
    -------
    errors : dict
        ``count``, ``height_rmse_m``, ``height_mae_m``, ``height_nmad_m``, ``height_median_m`` and
        ``slope_rmse_deg``, the RMSE of the slope angle.
    """
    inside = _inside(heights, reference, border)
    difference = (np.asarray(heights, float) - reference)[inside]
    slopes = (slope_angle(heights, grid) - slope_angle(reference, grid))[inside]
    slopes = slopes[np.isfinite(slopes)]
    slope_rmse = float(np.degrees(_rms(slopes))) if slopes.size else np.nan
    return {**height_errors(difference), "slope_rmse_deg": slope_rmse}


def compare_points(heights, grid, longitude, latitude, reference, border=0):
    """Errors of a DEM at points of known height, by bilinear interpolation.

    Parameters
    ----------
    heights : array (rows, cols), m
    grid : Grid
    longitude, latitude : array (n,), rad
    reference : array (n,), m
        Heights of the points.
    border : int, posts
        Points this near to an edge are left out.

    Returns
    -------
    errors : dict
        As `compare_heights` gives, without the slope.
    """
    row, col = grid.index_at(longitude, latitude)
    difference = sample_bilinear(heights, row, col, border) - reference
    return height_errors(difference[np.isfinite(difference)])


def height_errors(difference):
    """Statistics of height differences.

    Parameters
    ----------
    difference : array (n,), m
        Finite; product minus reference.

    Returns
    -------
    errors : dict of float
    """
    if difference.size == 0:
        raise InputError(
            "Product and reference share no known height. Check that they show the same region "
            "and that --border leaves something over."
        )
    median = np.median(difference)
    return {
        "count": int(difference.size),
        "height_rmse_m": float(_rms(difference)),
        "height_mae_m": float(np.mean(np.abs(difference))),
        "height_nmad_m": float(NORMAL_SCALE * np.median(np.abs(difference - median))),
        "height_median_m": float(median),
    }


def relative_errors(values, reference):
    """Errors of factors known up to a common scale: albedo, exposures.

    The scale is fixed by the median of ``values / reference``.

    Parameters
    ----------
    values, reference : array (...), dimensionless
        Only places where both are finite and the reference is positive count.

    Returns
    -------
    errors : dict
        ``count``, ``scale`` (the median ratio), ``rms_percent`` and ``nmad_percent`` of
        ``values / (scale * reference) - 1``.
    """
    values, reference = np.asarray(values, float), np.asarray(reference, float)
    known = np.isfinite(values) & np.isfinite(reference) & (reference > 0)
    ratio = values[known] / reference[known]
    if ratio.size == 0 or not np.median(ratio) > 0:
        raise InputError(
            "Product and reference share no known positive value. Check that they show the same "
            "region and the same quantity."
        )
    scale = np.median(ratio)
    error = ratio / scale - 1.0
    return {
        "count": int(ratio.size),
        "scale": float(scale),
        "rms_percent": float(100.0 * _rms(error)),
        "nmad_percent": float(100.0 * NORMAL_SCALE * np.median(np.abs(error))),
    }


def compare_albedo(albedo, reference, border=0):
    """Errors of an albedo map against another on the same grid, in per cent.

    Parameters
    ----------
    albedo, reference : array (rows, cols), dimensionless
    border : int, posts

    Returns
    -------
    errors : dict
        ``count``, ``albedo_scale``, ``albedo_rms_percent``, ``albedo_nmad_percent``;
        see `relative_errors`.
    """
    inside = _inside(albedo, reference, border)
    errors = relative_errors(np.asarray(albedo)[inside], np.asarray(reference)[inside])
    return {name if name == "count" else f"albedo_{name}": value for name, value in errors.items()}


def slope_angle(heights, grid):
    """Angle between the surface and the horizontal, from central differences.

    Parameters
    ----------
    heights : array (rows, cols), m
    grid : Grid

    Returns
    -------
    slope : array (rows, cols), rad
        NaN where a needed neighbour is unknown.
    """
    longitude, latitude = grid.lonlat()
    up = up_vector(longitude, latitude)
    normals = surface_normals(grid.xyz(np.asarray(heights, float)))
    return np.arccos(np.clip(np.einsum("...i,...i", normals, up), -1.0, 1.0))


def sample_bilinear(values, row, col, border=0):
    """Values between posts; NaN outside, within ``border`` of an edge, and beside unknown posts.

    Parameters
    ----------
    values : array (rows, cols)
    row, col : array (n,), posts
    border : int, posts

    Returns
    -------
    samples : array (n,)
    """
    rows, cols = values.shape
    is_inside = (row >= border) & (row <= rows - 1 - border)
    is_inside &= (col >= border) & (col <= cols - 1 - border)
    row, col = np.where(is_inside, row, 0.0), np.where(is_inside, col, 0.0)
    r0 = np.clip(row.astype(int), 0, max(rows - 2, 0))
    c0 = np.clip(col.astype(int), 0, max(cols - 2, 0))
    r1, c1 = np.minimum(r0 + 1, rows - 1), np.minimum(c0 + 1, cols - 1)
    r, c = row - r0, col - c0
    upper = (1.0 - c) * values[r0, c0] + c * values[r0, c1]
    lower = (1.0 - c) * values[r1, c0] + c * values[r1, c1]
    return np.where(is_inside, (1.0 - r) * upper + r * lower, np.nan)


def _inside(values, reference, border):
    """Posts away from the edges at which both rasters are known."""
    if np.shape(values) != np.shape(reference):
        raise InputError(
            f"product has shape {np.shape(values)}, the reference {np.shape(reference)}. "
            "Bring both onto one grid first."
        )
    rows, cols = np.shape(values)
    if border < 0 or 2 * border >= min(rows, cols):
        raise InputError(
            f"--border = {border} leaves nothing of {rows} x {cols} posts. "
            f"Give 0 to {(min(rows, cols) - 1) // 2}."
        )
    inside = np.zeros((rows, cols), bool)
    inside[border : rows - border, border : cols - border] = True
    return inside & np.isfinite(values) & np.isfinite(reference)


def _rms(values):
    return np.sqrt(np.mean(np.square(values)))
