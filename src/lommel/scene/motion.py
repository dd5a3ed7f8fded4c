"""Where a moving camera was and how it looked, as tables over time.

Positions are interpolated by cubic Hermite polynomials and rotations along the shortest arc, which
is what ISIS does with the tables of a cube. Most callers want `Trajectory` and `Pointing`.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from lommel.errors import InputError
from lommel.scene.camera import checked_rotation

NEIGHBOURS = 2  # on each side, from which a velocity is taken: a polynomial of degree 4


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Positions over time, body-fixed.

    Attributes
    ----------
    times : array (n,), s
        Ascending.
    positions : array (n, 3), m
    velocities : array (n, 3), m/s, or None
        Of the body-fixed position, hence with the body's rotation in them. None: the slopes of
        the polynomials through each entry and its two neighbours on either side, as good as the
        table is dense.
    """

    times: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray | None = None

    def __post_init__(self):
        """Check the table; supply velocities that it does not have."""
        times = checked_times(self.times, "positions")
        positions = _checked_vectors(self.positions, times, "positions")
        if self.velocities is None:
            velocities = _slopes(times, positions)
        else:
            velocities = _checked_vectors(self.velocities, times, "velocities")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "velocities", velocities)

    def at(self, times):
        """Positions at other times.

        Parameters
        ----------
        times : array (...), s
            Also beyond the ends of the table, where the last polynomial goes on.

        Returns
        -------
        xyz : array (..., 3), m
        """
        times = np.asarray(times, float)
        if self.times.size == 1:
            return self.positions[0] + (times - self.times[0])[..., None] * self.velocities[0]
        return CubicHermiteSpline(self.times, self.positions, self.velocities)(times)

    def since(self, epoch):
        """The same trajectory with times counted from an epoch."""
        return replace(self, times=self.times - epoch)

    def shifted(self, shift):
        """The same trajectory elsewhere; shift (3,) in m."""
        return replace(self, positions=self.positions + np.asarray(shift, float))


@dataclass(frozen=True, eq=False)
class Pointing:
    """Rotations from body-fixed axes to the camera frame over time.

    Attributes
    ----------
    times : array (n,), s
        Ascending.
    rotations : array (n, 3, 3)
        Rows are the camera's axes, body-fixed. Neighbours differ by less than half a turn.
    """

    times: np.ndarray
    rotations: np.ndarray

    def __post_init__(self):
        """Check the table."""
        times = checked_times(self.times, "rotations")
        rotations = checked_rotation(self.rotations)
        if rotations.shape != (times.size, 3, 3):
            raise InputError(
                f"rotations have shape {rotations.shape} at {times.size} times; give one 3 x 3 "
                "matrix per time."
            )
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "rotations", rotations)

    def at(self, times):
        """Rotations at other times.

        Parameters
        ----------
        times : array (...), s
            Also beyond the ends of the table, where the last turn goes on.

        Returns
        -------
        rotations : array (..., 3, 3)
        """
        times = np.asarray(times, float)
        if self.times.size == 1:
            return np.broadcast_to(self.rotations[0], (*times.shape, 3, 3))
        wanted = times.ravel()
        i = np.clip(np.searchsorted(self.times, wanted, side="right") - 1, 0, self.times.size - 2)
        share = (wanted - self.times[i]) / (self.times[i + 1] - self.times[i])
        nodes = Rotation.from_matrix(self.rotations)
        turns = (nodes[1:] * nodes[:-1].inv()).as_rotvec()
        turned = Rotation.from_rotvec(share[:, None] * turns[i]) * nodes[i]
        return turned.as_matrix().reshape(*times.shape, 3, 3)

    def since(self, epoch):
        """The same pointing with times counted from an epoch."""
        return replace(self, times=self.times - epoch)

    def turned(self, rotation):
        """The same pointing after a constant rotation (3, 3) in the camera frame."""
        return Pointing(self.times, rotation @ self.rotations)


def checked_times(times, name):
    """Times of a table as float64, when they ascend.

    Parameters
    ----------
    times : array (n,), s
    name : str
        Of what the table holds.

    Returns
    -------
    times : float64 array (n,)
    """
    times = np.array(times, dtype=float)
    if times.ndim != 1 or times.size == 0 or not np.isfinite(times).all():
        raise InputError(f"the times of the camera's {name} are not a list of finite numbers.")
    if not (np.diff(times) > 0).all():
        raise InputError(
            f"the times of the camera's {name} do not ascend, at entry "
            f"{int(np.argmax(np.diff(times) <= 0)) + 1} of {times.size}. Check the camera file."
        )
    return times


def _checked_vectors(vectors, times, name):
    vectors = np.array(vectors, dtype=float)
    if vectors.shape != (times.size, 3) or not np.isfinite(vectors).all():
        raise InputError(
            f"the camera's {name} have shape {vectors.shape} at {times.size} times; give three "
            "finite numbers per time."
        )
    return np.ascontiguousarray(vectors)


def _slopes(times, positions):
    """Derivatives at the entries, of the polynomials through them and their neighbours."""
    out = np.zeros_like(positions)
    for i, time in enumerate(times):
        first = max(min(i - NEIGHBOURS, times.size - 2 * NEIGHBOURS - 1), 0)
        near = slice(first, first + 2 * NEIGHBOURS + 1)
        scale = np.ptp(times[near]) or 1.0
        powers = np.vander((times[near] - time) / scale, increasing=True)
        if len(powers) > 1:
            out[i] = np.linalg.solve(powers, positions[near] - positions[i])[1] / scale
    return out
