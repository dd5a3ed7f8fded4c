"""What `lommel info` says of an image as its camera took it.

Azimuths in the image count clockwise from up, that is from decreasing lines, samples growing to
the right. (ISIS's campt counts its ``NorthAzimuth``, ``SubSolarAzimuth`` and ``SpacecraftAzimuth``
clockwise from the right: 90 degrees less.) They are the directions in which a small step on the
ground shows: to the north, towards the point under the Sun, towards the point under the spacecraft.
Most callers want `camera_facts`.
"""

import numpy as np

from lommel.errors import GeometryError
from lommel.run.ground_point import angle_between, round_degrees
from lommel.scene.body import MOON, local_frame, to_lonlat
from lommel.scene.camera import ReducedCamera
from lommel.scene.geometry import unit
from lommel.scene.intersection import meet_sphere
from lommel.scene.line_scan import LineScanCamera

LATTICE = 33  # pixels along each side of an image whose rays tell footprint and angles
STEP = 0.1  # px on the ground, for directions in the image
DECIMALS_M = 3
DECIMALS_DEG = 6


def camera_facts(name, camera, sun=None, body=MOON):
    """Facts about an image and its camera, by name; names carry the unit.

    Parameters
    ----------
    name : str
        Of the image, for messages.
    camera : Camera
    sun : array (3,), m, body-fixed, optional
        From a table, for a camera that tells nothing of the Sun.
    body : Body

    Returns
    -------
    facts : dict of str to str, int or float
        On the sphere. Angles without ``min`` and ``max`` are those of the central pixel, or of
        the one nearest to it that sees the body.
    """
    lines, samples = camera.shape
    line, sample = np.meshgrid(
        np.linspace(0.0, lines, LATTICE), np.linspace(0.0, samples, LATTICE), indexing="ij"
    )
    origin = camera.origin(line, sample)
    ground = meet_sphere(origin, camera.ray(line, sample), body.radius)
    sees = np.isfinite(ground).all(axis=-1)
    if not sees.any():
        raise GeometryError(
            f"{name}: its camera does not see the {body.name}. Check that camera and image belong "
            "together, and the units of the camera file (metres)."
        )
    off_centre = np.where(sees, np.hypot(line / lines - 0.5, sample / samples - 0.5), np.inf)
    middle = np.unravel_index(np.argmin(off_centre), sees.shape)
    facts = {
        "camera": _kind(camera),
        "seen_percent": round(100.0 * float(sees.mean()), 1),
        **_spacing(camera, line[middle], sample[middle], body),
        **_footprint(camera, ground[sees], ground[middle], body),
        **_point("subspacecraft", body, camera.position),
        "spacecraft_altitude_m": round(float(to_lonlat(body, camera.position)[2]), DECIMALS_M),
        "slant_distance_m": round(
            float(np.linalg.norm(origin[middle] - ground[middle])), DECIMALS_M
        ),
    }
    if camera.sun_position is not None:
        sun = camera.sun(line, sample)
    elif sun is not None:
        sun = np.broadcast_to(sun, ground.shape)
    return facts | _light_and_view(camera, ground, origin, sun, sees, middle, body)


def _kind(camera):
    full = camera.full if isinstance(camera, ReducedCamera) else camera
    model = "line scan" if isinstance(full, LineScanCamera) else "frame"
    return model if full.distortion is None else f"{model}, distortion {full.distortion.model}"


def _spacing(camera, line, sample, body):
    """Ground distances between neighbouring lines and samples."""
    facts = {}
    for axis, steps in {"line": ([-0.5, 0.5], [0, 0]), "sample": ([0, 0], [-0.5, 0.5])}.items():
        pixels = np.add(line, steps[0]), np.add(sample, steps[1])
        ends = meet_sphere(camera.origin(*pixels), camera.ray(*pixels), body.radius)
        distance = float(np.linalg.norm(ends[1] - ends[0]))
        facts[f"gsd_{axis}_m"] = round(distance, DECIMALS_M) if np.isfinite(distance) else None
    known = [value for value in facts.values() if value is not None]
    return {"gsd_m": max(known, default=None), **facts}


def _footprint(camera, seen, centre, body):
    longitude, latitude, _ = to_lonlat(body, centre)
    around, south_north, _ = to_lonlat(body, seen)
    around = longitude + np.angle(np.exp(1j * (around - longitude)))  # across any meridian
    west, east = around.min(), around.max()
    south, north = south_north.min(), south_north.max()
    for sign in (-1.0, 1.0):
        pole = np.array([0.0, 0.0, sign * body.radius])
        if camera.contains(*camera.project(pole)) and camera.position @ pole > body.radius**2:
            west, east = longitude - np.pi, longitude + np.pi
            south, north = (south, np.pi / 2) if sign > 0 else (-np.pi / 2, north)
    return {
        "longitude_deg": round_degrees(longitude, DECIMALS_DEG),
        "latitude_deg": round_degrees(latitude, DECIMALS_DEG),
        "longitude_west_deg": round_degrees(west, DECIMALS_DEG),
        "longitude_east_deg": round_degrees(east, DECIMALS_DEG),
        "latitude_south_deg": round_degrees(south, DECIMALS_DEG),
        "latitude_north_deg": round_degrees(north, DECIMALS_DEG),
    }


def _light_and_view(camera, ground, origin, sun, sees, middle, body):
    """Angles at the centre and their range, and directions in the image."""
    up = unit(ground)
    to_camera = unit(origin - ground)
    angles = {"emission": angle_between(up, to_camera)}
    facts = {}
    if sun is not None:
        to_sun = unit(sun - ground)
        angles |= {
            "incidence": angle_between(up, to_sun),
            "phase": angle_between(to_sun, to_camera),
        }
        facts |= _point("subsolar", body, sun[middle])
        east, north, _ = local_frame(*to_lonlat(body, ground[middle])[:2])
        azimuth = np.arctan2(to_sun[middle] @ east, to_sun[middle] @ north) % (2 * np.pi)
        facts["sun_azimuth_deg"] = round_degrees(azimuth, DECIMALS_DEG)
        facts["sun_elevation_deg"] = round_degrees(
            np.pi / 2 - angles["incidence"][middle], DECIMALS_DEG
        )
    for name, angle in angles.items():
        facts[f"{name}_deg"] = round_degrees(angle[middle], DECIMALS_DEG)
        facts[f"{name}_min_deg"] = round_degrees(angle[sees].min(), DECIMALS_DEG)
        facts[f"{name}_max_deg"] = round_degrees(angle[sees].max(), DECIMALS_DEG)
    targets = {"north": np.array([0.0, 0.0, 1.0]), "spacecraft": camera.position}
    if sun is not None:
        targets["sun"] = sun[middle]
    for name, target in targets.items():
        azimuth = image_azimuth(camera, ground[middle], target)
        if np.isfinite(azimuth):
            facts[f"image_{name}_azimuth_deg"] = round_degrees(azimuth, DECIMALS_DEG)
    return facts


def image_azimuth(camera, ground, target):
    """Direction in the image of a step on the ground towards the point under a target.

    Parameters
    ----------
    camera : Camera
    ground : array (3,), m, body-fixed
    target : array (3,), body-fixed
        Only its direction from the body's centre counts.

    Returns
    -------
    azimuth : float, rad, in [0, 2 pi)
        Clockwise from decreasing lines; NaN when the target is in the zenith.
    """
    up = unit(ground)
    along = target - (target @ up) * up
    if not np.linalg.norm(along) > 1e-12 * np.linalg.norm(target):
        return np.nan
    here, there = np.array(camera.project(ground)), np.array(camera.project(ground + unit(along)))
    reach = STEP / np.linalg.norm(there - here)  # m for a tenth of a pixel, whatever its size
    ends = ground + reach * np.array([[-0.5], [0.5]]) * unit(along)
    line, sample = camera.project(ends)
    return np.arctan2(sample[1] - sample[0], line[0] - line[1]) % (2 * np.pi)


def _point(name, body, position):
    longitude, latitude, _ = to_lonlat(body, position)
    return {
        f"{name}_longitude_deg": round_degrees(longitude, DECIMALS_DEG),
        f"{name}_latitude_deg": round_degrees(latitude, DECIMALS_DEG),
    }
