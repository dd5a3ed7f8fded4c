"""`lommel info --pixel`: the ground point of one pixel, and the light and view there.

Most callers want `describe_pixel`.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from lommel.errors import GeometryError, InputError
from lommel.io.cameras import find_camera, read_camera
from lommel.io.isd import ISD_SUFFIXES, isd_shape
from lommel.io.positions import find_position, read_positions
from lommel.io.raster import raster_info, read_grid
from lommel.run.inputs import known_heights
from lommel.scene.body import MOON, local_frame, to_lonlat, to_xyz
from lommel.scene.camera import Camera
from lommel.scene.geometry import unit
from lommel.scene.intersection import meet_sphere, meet_terrain

DECIMALS_DEG = 10  # 3 micrometres on the Moon
DECIMALS_M = 4
RELIEF = (-20e3, 20e3)  # m; the Moon's terrain lies between -9.1 and 10.8 km
POSTS = 2**26  # of a DEM read for one ray; only a ray along the horizon needs that many


def describe_pixel(path, sample, line, dem=None, camera=None, sun_positions=None, body=MOON):
    """Ground point of a pixel, and incidence, emission and phase there, by name.

    Parameters
    ----------
    path : path
        Image with a camera.
    sample, line : float, px
        CSM coordinates: (0.5, 0.5) is the centre of the first pixel.
    dem : path, optional
        The sphere when there is none.
    camera : path or Camera, optional
        The file beside the image, or the image itself, when there is none.
    sun_positions : path, optional
        Table for a camera that tells nothing of the Sun.
    body : Body

    Returns
    -------
    facts : dict of str to str or float
        Incidence and emission are those of the terrain; with a DEM the ones of a horizontal
        surface are named ``ellipsoid_...``. Without any Sun there is neither incidence nor phase.
    """
    model = camera if isinstance(camera, Camera) else image_camera(path, camera)
    lines, samples = model.shape
    if not model.contains(line, sample):
        raise InputError(
            f"{path}: pixel sample {sample:g}, line {line:g} lies outside the image of {samples} "
            f"samples and {lines} lines."
        )
    origin, direction = model.origin(line, sample), model.ray(line, sample)
    sun = _sun(path, model, line, sample, sun_positions, body)
    horizontal = None
    if dem is None:
        ground = meet_sphere(origin, direction, body.radius)
    else:
        ground, normal = _meet_dem(dem, origin, direction, body)
    if not np.isfinite(ground).all():
        raise GeometryError(
            f"{path}: pixel sample {sample:g}, line {line:g} looks past the {body.name}"
            + ("." if dem is None else f", or beyond {dem}, or at a hole in it.")
        )
    longitude, latitude, height = to_lonlat(body, ground)
    horizontal = local_frame(longitude, latitude)[2]
    facts = {
        "file": str(path),
        "sample": sample,
        "line": line,
        "longitude_deg": round_degrees(longitude),
        "latitude_deg": round_degrees(latitude),
        "height_m": round(float(height), DECIMALS_M),
    }
    to_camera, to_sun = unit(origin - ground), None if sun is None else unit(sun - ground)
    facts |= _angles("", horizontal if dem is None else normal, to_camera, to_sun)
    if to_sun is not None:
        facts["phase_deg"] = round_degrees(angle_between(to_sun, to_camera))
    if dem is not None:
        facts |= _angles("ellipsoid_", horizontal, to_camera, to_sun)
    return facts


def image_camera(path, camera=None):
    """The camera of an image: in the file that is named, beside it, or in it; or an ISD itself."""
    if Path(path).suffix.lower() in ISD_SUFFIXES:
        return read_camera(path, isd_shape(path))
    shape = raster_info(path).shape
    camera = camera or find_camera(path)
    if camera is None:
        raise InputError(
            f"{path}: no camera found. Looked for an ISD (.json, .isd) and a .tsai beside it, and "
            "for an ISIS label with spiceinit's tables in it; name one with --cameras."
        )
    return read_camera(camera, shape)


def _sun(path, model, line, sample, table, body):
    if model.sun_position is not None:
        return model.sun(line, sample)
    if table is None:
        return None
    return find_position(read_positions(table, "sun", body), raster_info(path).path.name, table)


def _meet_dem(dem, origin, direction, body):
    """Where a ray meets a DEM, and the terrain's normal there."""
    grid = read_grid(dem, body)
    part = _crossed_part(grid, origin, direction, body)
    if part is None:
        return np.full(3, np.nan), np.full(3, np.nan)
    grid = grid.cut(part)
    heights = known_heights([dem], grid, body)
    ground = meet_terrain(origin, direction, grid, heights)
    longitude, latitude, _ = to_lonlat(body, ground)
    row, col = grid.index_at(longitude, latitude)
    south, east = (
        _terrain(grid, heights, row + down, col + right)
        - _terrain(grid, heights, row - down, col - right)
        for down, right in ((0.5, 0.0), (0.0, 0.5))
    )
    return ground, unit(np.cross(south, east))


def _terrain(grid, heights, row, col):
    height = map_coordinates(heights, [[row], [col]], order=1, mode="nearest")[0]
    return to_xyz(grid.body, *grid.lonlat_at(row, col), height)


def _crossed_part(grid, origin, direction, body):
    """The posts between which a ray can meet the terrain, or None."""
    ends = np.stack([meet_sphere(origin, direction, body.radius + rise) for rise in RELIEF])
    if np.linalg.norm(origin) < body.radius + RELIEF[1]:
        ends[1] = origin
    if np.isfinite(ends).all():
        row, col = grid.index_at(*to_lonlat(body, ends)[:2])
        if not np.isfinite([row, col]).all():
            return None
        first = int(np.floor(row.min())) - 2, int(np.floor(col.min())) - 2
        last = int(np.ceil(row.max())) + 3, int(np.ceil(col.max())) + 3
        window = replace(
            grid.window,
            row=first[0],
            col=first[1],
            rows=last[0] - first[0],
            cols=last[1] - first[1],
        ).intersection(grid.window)
    else:
        window = grid.window
    if window.is_empty or min(window.shape) < 2:
        return None
    if window.rows * window.cols > POSTS:
        raise GeometryError(
            f"The ray crosses {window.rows} x {window.cols} posts of the DEM, more than {POSTS}: "
            "it grazes the horizon. Give a coarser DEM, or one cut to the place."
        )
    return window


def _angles(prefix, normal, to_camera, to_sun):
    facts = (
        {}
        if to_sun is None
        else {f"{prefix}incidence_deg": round_degrees(angle_between(normal, to_sun))}
    )
    return facts | {f"{prefix}emission_deg": round_degrees(angle_between(normal, to_camera))}


def angle_between(first, second):
    """Angles of unit vectors (..., 3) in rad, precise also where they are parallel."""
    apart, together = (np.linalg.norm(first + sign * second, axis=-1) for sign in (-1, 1))
    return 2 * np.arctan2(apart, together)


def round_degrees(angle, decimals=DECIMALS_DEG):
    """An angle in degrees, rounded; from rad."""
    return round(float(np.degrees(angle)), decimals)
