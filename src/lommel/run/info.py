"""`lommel info`: what a raster holds, where it lies, how it is lit and seen.

Most callers want `describe`.
"""

from pathlib import Path

import numpy as np

from lommel.errors import InputError
from lommel.io.cameras import find_camera, read_camera
from lommel.io.isd import ISD_SUFFIXES, write_isd
from lommel.io.positions import find_position, read_positions
from lommel.io.raster import raster_info
from lommel.run.camera_facts import camera_facts
from lommel.run.ground_point import image_camera
from lommel.scene.body import MOON, local_frame, to_lonlat, to_xyz
from lommel.scene.camera import Camera
from lommel.scene.geometry import unit, viewing_geometry

DECIMALS_DEG = 6  # 3 cm on the Moon
DECIMALS_M = 3


def named_cameras(files, cameras=None, kernels=None):
    """One entry per image: its camera from SPICE kernels, the file that was named for it, or None.

    Parameters
    ----------
    files : sequence of path
    cameras : sequence of path, optional
    kernels : path, optional
        SPICE meta-kernel.

    Returns
    -------
    cameras : list of Camera, path or None
    """
    if cameras and kernels:
        raise InputError("--cameras and --kernels both give cameras. Use one of them.")
    if kernels:
        return [read_camera(path, raster_info(path).shape, kernels) for path in files]
    if cameras and len(cameras) != len(files):
        raise InputError(
            f"--cameras names {len(cameras)} files for {len(files)} images. Name one per image, "
            "in the same order."
        )
    return list(cameras) if cameras else [None] * len(files)


def write_camera(isd, path, camera=None):
    """Write an image's camera as ISD; arguments as of `describe`."""
    write_isd(isd, camera if isinstance(camera, Camera) else image_camera(path, camera))


def describe(path, sun_positions=None, spacecraft_positions=None, camera=None, body=MOON):
    """Facts about a raster, by name; names carry the unit.

    Parameters
    ----------
    path : path
        An ISD, or any raster GDAL reads. One without a CRS has its place from its camera; without
        that, only its pixels are described.
    sun_positions, spacecraft_positions : path, optional
        Position tables. With the Sun come the subsolar point and the light at the image's centre,
        with the spacecraft the subspacecraft point and the view, with both the phase. A camera
        knows its own place, and mostly the Sun's.
    camera : path or Camera, optional
        The image's camera; the file beside the image, or the image itself, when there is none.
    body : Body

    Returns
    -------
    facts : dict of str to str, int, float or None
        Angles at the centre are those on the sphere; azimuth is clockwise from north.
    """
    if Path(path).suffix.lower() in ISD_SUFFIXES:
        model = image_camera(path)
        rows, cols = model.shape
        facts = {"file": str(path), "rows": rows, "cols": cols}
        return facts | camera_facts(str(path), model, None, body)
    info = raster_info(path, body)
    camera = camera or (None if info.grid else find_camera(path))
    facts = {
        "file": str(path),
        "rows": info.shape[0],
        "cols": info.shape[1],
        "bands": info.bands,
        "dtype": info.dtype,
        "nodata": str(info.nodata) if info.nodata is not None else None,  # may be nan
        "mask": "second band" if info.has_mask_band else None,
        "crs": info.grid.crs.name if info.grid else None,
    }
    if camera is not None:
        model = camera if isinstance(camera, Camera) else read_camera(camera, info.shape)
        sun = None
        if model.sun_position is None and sun_positions is not None:
            table = read_positions(sun_positions, "sun", body)
            sun = find_position(table, info.path.name, sun_positions)
        if model is not camera:
            facts["camera_file"] = str(camera)
        return facts | camera_facts(str(path), model, sun, body)
    if info.grid:
        facts |= _place(info.grid)
    sun, spacecraft = (
        None
        if table is None
        else find_position(read_positions(table, kind, body), info.path.name, table)
        for table, kind in ((sun_positions, "sun"), (spacecraft_positions, "spacecraft"))
    )
    if sun is not None:
        facts |= _point("subsolar", body, sun)
    if spacecraft is not None:
        facts |= _point("subspacecraft", body, spacecraft)
        altitude = to_lonlat(body, spacecraft)[2]
        facts["spacecraft_altitude_m"] = round(float(altitude), DECIMALS_M)
    if info.grid:
        facts |= _angles(info.grid, sun, spacecraft)
    return facts


def _place(grid):
    longitude, latitude = (angle[np.isfinite(angle)] for angle in grid.outline())
    rows, cols = grid.shape
    middle = np.array(grid.lonlat_at((rows - 1) / 2, (cols - 1) / 2))
    longitude = middle[0] + np.angle(np.exp(1j * (longitude - middle[0])))  # across any meridian
    return {
        "gsd_m": round(max(grid.spacing), DECIMALS_M),
        "longitude_deg": _degrees(middle[0]),
        "latitude_deg": _degrees(middle[1]),
        "longitude_west_deg": _degrees(longitude.min()),
        "longitude_east_deg": _degrees(longitude.max()),
        "latitude_south_deg": _degrees(latitude.min()),
        "latitude_north_deg": _degrees(latitude.max()),
    }


def _point(name, body, position):
    longitude, latitude, _ = to_lonlat(body, position)
    return {
        f"{name}_longitude_deg": _degrees(longitude),
        f"{name}_latitude_deg": _degrees(latitude),
    }


def _angles(grid, sun, spacecraft):
    """Light and view at the grid's centre, for a surface that follows the sphere."""
    longitude, latitude = grid.lonlat_at((grid.shape[0] - 1) / 2, (grid.shape[1] - 1) / 2)
    ground = to_xyz(grid.body, longitude, latitude, 0.0)
    east, north, up = local_frame(longitude, latitude)
    facts = {}
    if sun is not None:
        to_sun = unit(sun - ground)
        elevation = np.arcsin(to_sun @ up)
        facts["sun_azimuth_deg"] = _degrees(np.arctan2(to_sun @ east, to_sun @ north) % (2 * np.pi))
        facts["sun_elevation_deg"] = _degrees(elevation)
        facts["incidence_deg"] = _degrees(np.pi / 2 - elevation)
    if spacecraft is not None:
        facts["emission_deg"] = _degrees(np.arccos(unit(spacecraft - ground) @ up))
    if sun is not None and spacecraft is not None:
        facts["phase_deg"] = _degrees(viewing_geometry(ground, up, sun, spacecraft).phase)
    return facts


def _degrees(angle):
    return round(float(np.degrees(angle)), DECIMALS_DEG)
