"""Where camera and Sun are: frames along a circular orbit.

The body does not turn during a revolution (the Moon turns by 0.1 degrees in the ten minutes of a
strip). Most callers want `frame_cameras`.
"""

import numpy as np

from lommel.scene.body import MOON, to_xyz, up_vector
from lommel.scene.camera import FrameCamera, nadir_rotation

SUN_DISTANCE = 149_597_870_700.0  # m, 1 au
FRAME_PIXELS = 4096  # lines and samples of a frame: 27 m on the ground from 110 km


def frame_cameras(orbit, grid):
    """Cameras of one revolution, in the order of flight.

    Parameters
    ----------
    orbit : OrbitSettings
    grid : GridSettings
        Its origin is the turning point of the orbit in longitude.

    Returns
    -------
    cameras : list of FrameCamera
    """
    half_angle = footprint_half_angle(orbit)
    step = 2.0 * half_angle * (1.0 - orbit.overlap)
    node, inclination = _turning_frame(orbit, grid)
    cameras = []
    for number in range(orbit.frames):
        angle = np.pi / 2 + step * (number - 0.5 * (orbit.frames - 1))
        up = np.cos(angle) * node + np.sin(angle) * inclination
        heading = -np.sin(angle) * node + np.cos(angle) * inclination
        position = (MOON.radius + orbit.altitude) * up
        cameras.append(
            FrameCamera(
                position=position,
                rotation=nadir_rotation(position, heading),
                focal_length=FRAME_PIXELS * orbit.focal_length_mm / orbit.frame_mm,
                principal_point=(0.5 * FRAME_PIXELS, 0.5 * FRAME_PIXELS),
                shape=(FRAME_PIXELS, FRAME_PIXELS),
            )
        )
    return cameras


def footprint_half_angle(orbit):
    """Half the arc of the reference sphere that the frame's width covers, rad."""
    half_view = np.arctan(0.5 * orbit.frame_mm / orbit.focal_length_mm)
    ratio = 1.0 + orbit.altitude / MOON.radius
    return np.arcsin(ratio * np.sin(half_view)) - half_view


def _turning_frame(orbit, grid):
    """Unit vectors to the ascending node and to the northernmost point of the orbit."""
    longitude = np.radians(grid.longitude_deg)
    inclination = np.radians(orbit.inclination_deg)
    north = up_vector(longitude, min(inclination, np.pi - inclination))
    flies_east = np.sign(np.cos(inclination))
    node = up_vector(longitude - flies_east * np.pi / 2, 0.0)
    return node, north


def sun_position(sun):
    """Position of the Sun over its sub-solar point.

    Parameters
    ----------
    sun : SunSettings

    Returns
    -------
    position : array (3,), m, body-fixed
    """
    place = np.radians(sun.longitude_deg), np.radians(sun.latitude_deg)
    return to_xyz(MOON, *place, SUN_DISTANCE - MOON.radius)
