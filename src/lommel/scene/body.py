"""The reference body: longitude, latitude, height to body-fixed coordinates and back.

The body is a sphere, as in every lunar product in use. Its frame is the one of the ephemerides
(Moon: mean Earth / polar axis): x towards longitude 0, z towards the north pole, right-handed.
Longitudes count east, latitudes are planetocentric. Most callers want `MOON`.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Body:
    """A spherical reference body.

    Attributes
    ----------
    name : str
        As people write it, used in messages.
    radius : float, m
        Heights count from this sphere.
    """

    name: str
    radius: float


MOON = Body("Moon", 1_737_400.0)  # the reference sphere of LOLA and of every IAU lunar CRS


def up_vector(longitude, latitude):
    """Unit vector of the local vertical, body-fixed.

    Parameters
    ----------
    longitude, latitude : array (...), rad

    Returns
    -------
    up : array (..., 3), dimensionless

    Examples
    --------
    >>> up_vector(0.0, 0.0).tolist()
    [1.0, 0.0, 0.0]
    """
    cos_latitude = np.cos(latitude)
    return np.stack(
        [cos_latitude * np.cos(longitude), cos_latitude * np.sin(longitude), np.sin(latitude)],
        axis=-1,
    )


def local_frame(longitude, latitude):
    """East, north and up unit vectors at a point, body-fixed.

    Parameters
    ----------
    longitude, latitude : array (...), rad

    Returns
    -------
    east, north, up : array (..., 3), dimensionless
    """
    longitude, latitude = np.broadcast_arrays(longitude, latitude)
    zero = np.zeros(longitude.shape)
    east = np.stack([-np.sin(longitude), np.cos(longitude), zero], axis=-1)
    up = up_vector(longitude, latitude)
    return east, np.cross(up, east), up


def to_xyz(body, longitude, latitude, height):
    """Body-fixed position of points given by longitude, latitude and height.

    Parameters
    ----------
    body : Body
    longitude, latitude : array (...), rad
    height : array (...), m above the reference sphere

    Returns
    -------
    xyz : array (..., 3), m
    """
    radius = body.radius + np.asarray(height, dtype=float)
    return radius[..., None] * up_vector(longitude, latitude)


def to_lonlat(body, xyz):
    """Longitude, latitude and height of body-fixed positions; the inverse of `to_xyz`.

    Parameters
    ----------
    body : Body
    xyz : array (..., 3), m

    Returns
    -------
    longitude : array (...), rad, in (-pi, pi]
    latitude : array (...), rad
    height : array (...), m above the reference sphere

    Examples
    --------
    >>> lon, lat, height = to_lonlat(MOON, to_xyz(MOON, 0.1, -0.2, 300.0))
    >>> round(float(lon), 12), round(float(lat), 12), round(float(height), 6)
    (0.1, -0.2, 300.0)
    """
    x, y, z = np.moveaxis(np.asarray(xyz, dtype=float), -1, 0)
    horizontal = np.hypot(x, y)
    return np.arctan2(y, x), np.arctan2(z, horizontal), np.hypot(horizontal, z) - body.radius
