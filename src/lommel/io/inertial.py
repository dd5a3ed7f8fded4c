r"""Motion in inertial axes, as image files tell it, brought into the axes of the body.

ISIS tables, CSM's image support data and SPICE give the camera's rotation and place, the body's
rotation and the Sun's place over time in J2000 axes. With the rotations C from J2000 to the camera,
B from J2000 to the body and the position p from the body's centre,

.. math:: M = C B^T, \qquad X = B p, \qquad \dot X = B \dot p + \dot B p.

Each rotation is interpolated along the shortest arc, as ISIS does, and brought to the times of
both tables before they are multiplied. Most callers want `Rotations`, `Positions`, `pointing` and
`trajectory`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from lommel.errors import InputError
from lommel.scene.camera import checked_rotation
from lommel.scene.motion import Pointing, Trajectory, checked_times

KM = 1e3
QUATERNION_NORM = 1e-3  # from 1; tables carry 1e-9, a wrong column is off by its own size


@dataclass(frozen=True)
class Rotations:
    """Rotations from J2000 to a frame over time.

    Attributes
    ----------
    times : array (n,), s
        Ascending ephemeris times.
    matrices : array (n, 3, 3)
        From J2000 to the frame that depends on time.
    constant : array (3, 3)
        From there to the frame that is wanted.
    """

    times: np.ndarray
    matrices: np.ndarray
    constant: np.ndarray

    def at(self, times):
        """Rotations from J2000 to the frame (m, 3, 3) at times (m,); the last turns go on."""
        return self.constant @ self._moving(times)

    def rates(self, times):
        """What turns a vector (m, 3) of the frame before ``constant``: angular velocities, rad/s.

        The rotation S(t) to that frame obeys dS/dt v = rate x (S v).
        """
        if self.times.size == 1:
            return np.zeros((np.size(times), 3))
        row = self._rows(times)
        return self._turns()[row] / np.diff(self.times)[row][:, None]

    def carried(self, positions, velocities, times):
        """Positions and velocities (m, 3) in J2000 as the turning frame sees them."""
        moving = self._moving(times)
        place = np.einsum("nij,nj->ni", moving, positions)
        speed = np.einsum("nij,nj->ni", moving, velocities)
        speed += np.cross(self.rates(times), place)
        return place @ self.constant.T, speed @ self.constant.T

    def _moving(self, times):
        if self.times.size == 1:
            return np.broadcast_to(self.matrices[0], (np.size(times), 3, 3))
        row = self._rows(times)
        share = (times - self.times[row]) / np.diff(self.times)[row]
        return (
            Rotation.from_rotvec(share[:, None] * self._turns()[row]).as_matrix()
            @ (self.matrices[row])
        )

    def _rows(self, times):
        return np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)

    def _turns(self):
        steps = self.matrices[1:] @ np.swapaxes(self.matrices[:-1], -1, -2)
        return Rotation.from_matrix(steps).as_rotvec()


def rotations(times, matrices, constant, name):
    """`Rotations` from a table, checked.

    Parameters
    ----------
    times : array (n,), s
    matrices : array (n, 3, 3)
    constant : array (3, 3)
    name : str
        Of the table, for messages.
    """
    times = checked_times(times, name)
    return Rotations(times, checked_rotation(matrices), checked_rotation(constant))


def from_quaternions(quaternions, name):
    """Rotation matrices of quaternions, scalar first, as SPICE and ISIS have them.

    Parameters
    ----------
    quaternions : array (n, 4)
    name : str
        Of the table, for messages.

    Returns
    -------
    matrices : array (n, 3, 3)
        They turn vectors by the angle whose half has the scalar part as its cosine.
    """
    quaternions = np.asarray(quaternions, float)
    if quaternions.ndim != 2 or quaternions.shape[1] != 4:
        raise InputError(f"the quaternions of {name} have shape {quaternions.shape}, not (n, 4).")
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(quaternions, axis=1)
    if not (np.abs(norms - 1) < QUATERNION_NORM).all():
        worst = norms[np.argmax(~(np.abs(norms - 1) < QUATERNION_NORM))]
        raise InputError(
            f"{name} holds a quaternion of length {worst:g}; rotations have 1. The table is "
            "damaged, or of another layout."
        )
    return Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()


@dataclass(frozen=True)
class Positions:
    """Positions from the body's centre over time, in J2000 axes.

    Attributes
    ----------
    times : array (n,), s
        Ascending ephemeris times.
    spline : callable, times (m,) -> (m, 3), m
    velocity : callable, times (m,) -> (m, 3), m/s
    """

    times: np.ndarray
    spline: object
    velocity: object


def positions(times, places, velocities=None, is_linear=False, name="positions"):
    """`Positions` from a table, checked.

    Parameters
    ----------
    times : array (n,), s
    places : array (n, 3), m
    velocities : array (n, 3), m/s, or None
        Those of polynomials through neighbouring entries when there are none.
    is_linear : bool
        A straight line through the two entries of a table of two.
    name : str
        Of the table, for messages.
    """
    table = Trajectory(checked_times(times, name), places, velocities)
    if table.times.size == 1:
        place, speed = table.positions[0], table.velocities[0]
        return Positions(
            table.times,
            lambda wanted: np.broadcast_to(place, (np.size(wanted), 3)),
            lambda wanted: np.broadcast_to(speed, (np.size(wanted), 3)),
        )
    speeds = table.velocities
    if is_linear and table.times.size == 2:
        speeds = np.repeat(np.diff(table.positions, axis=0) / np.diff(table.times), 2, axis=0)
    spline = CubicHermiteSpline(table.times, table.positions, speeds)
    return Positions(table.times, spline, spline.derivative())


def pointing(camera, body):
    """Rotations from the body to the camera.

    Parameters
    ----------
    camera, body : Rotations

    Returns
    -------
    pointing : Pointing
    """
    times = _times_of_both(camera, body)
    return Pointing(times, camera.at(times) @ np.swapaxes(body.at(times), -1, -2))


def trajectory(place, body):
    """Positions in the body's axes.

    Parameters
    ----------
    place : Positions
    body : Rotations

    Returns
    -------
    trajectory : Trajectory
    """
    times = _times_of_both(place, body)
    return Trajectory(times, *body.carried(place.spline(times), place.velocity(times), times))


def _times_of_both(table, body):
    """Times of a table, and between them those of the body's rotation."""
    inner = (body.times > table.times[0]) & (body.times < table.times[-1])
    return np.union1d(table.times, body.times[inner]) if body.times.size > 1 else table.times
