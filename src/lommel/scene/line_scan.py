r"""Line-scan cameras: one detector line, swept over the ground by the flight.

Each line L has its time; with the position C and rotation M of that time the camera frame, the lens
and the focal plane are those of `lommel.scene.camera`. The detector's image coordinate along the
flight is an offset from the line that is exposed, so a ground point X lies on the line where

.. math:: l_0 + A_0 \, D\!\left(f \frac{X_c}{Z_c}, f \frac{Y_c}{Z_c}\right) = 0, \quad
          (X_c, Y_c, Z_c) = M(t(L)) \, (X - C(t(L))),

A0 the first row of A. Which sign A0 has is of no account. Positions and rotations are those of the
tables at the edge of every line and linear within it, which is off by an eighth of the square of a
line's turn: 1e-13 rad for an orbiter that looks down. Most callers want `LineScanCamera`.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from lommel.core.multigrid import threads_for
from lommel.errors import InputError
from lommel.scene.camera import UPRIGHT, Camera, FocalPlane, focal_plane
from lommel.scene.distortion import Distortion, undistorted
from lommel.scene.line_scan_kernels import look_line_scan, project_line_scan
from lommel.scene.motion import Pointing, Trajectory

MARGIN = 64.0  # lines before the first and behind the last that are still projected
MOST_LINES = 2_000_000  # 96 bytes each in the table of poses; the longest real strips have 1e5


class Scan(NamedTuple):
    """Positions and rotations of all lines as the compiled kernels take them."""

    first: float  # line of the first entry
    last: float
    poses: np.ndarray  # (n, 12): at the upper edge of every line, position and rotation


@dataclass(frozen=True, eq=False)
class LineScanCamera(Camera):
    """A camera that takes one line after the other.

    Attributes
    ----------
    trajectory : Trajectory
    pointing : Pointing
        Both cover the image up to `MARGIN` lines.
    line_times : array (n, 3)
        First line (its upper edge, 0 for the image's first), time when that edge was passed (s),
        and seconds per line, negative for an image stored backwards; one row per rate.
    focal_length : float, in the unit of the focal plane
    principal_point : tuple of float, px
        Line, from the one that is exposed, and sample of the optical axis.
    shape : tuple of int
        Lines and samples.
    distortion : Distortion or None
    sun_trajectory : Trajectory or None
    to_pixels : array (2, 2), px per unit of the focal plane
        As in `lommel.scene.camera.FrameCamera`.
    """

    trajectory: Trajectory
    pointing: Pointing
    line_times: np.ndarray
    focal_length: float
    principal_point: tuple[float, float]
    shape: tuple[int, int]
    distortion: Distortion | None = None
    sun_trajectory: Trajectory | None = None
    to_pixels: np.ndarray | tuple = UPRIGHT
    plane: FocalPlane = field(init=False, repr=False)

    def __post_init__(self):
        """Check the table of lines, and that the other tables cover them."""
        if self.shape[0] > MOST_LINES:
            raise InputError(
                f"the image has {self.shape[0]} lines; a line-scan camera may have {MOST_LINES}. "
                "Cut the image."
            )
        table = np.array(self.line_times, dtype=float)
        if table.ndim != 2 or table.shape[1:] != (3,) or not np.isfinite(table).all():
            raise InputError(
                f"line_times has shape {table.shape}; give rows of first line, time and seconds "
                "per line."
            )
        if not (len(table) and (table[:, 2] != 0).all() and (np.diff(table[:, 0]) > 0).all()):
            raise InputError(
                "line_times must have ascending first lines and no line of zero seconds. Check "
                "the camera file."
            )
        plane = focal_plane(self.focal_length, self.principal_point, self.to_pixels)
        object.__setattr__(self, "line_times", table)
        object.__setattr__(self, "plane", plane)
        self._check_cover("position", self.trajectory.times)
        self._check_cover("pointing", self.pointing.times)

    def _check_cover(self, name, times):
        ends = np.sort(self.time([0.0, self.shape[0]]))
        slack = MARGIN * np.abs(self.line_times[:, 2]).max()
        if times.size > 1 and not (times[0] - slack <= ends[0] and ends[1] <= times[-1] + slack):
            raise InputError(
                f"the camera's {name} is known from {times[0]:.3f} to {times[-1]:.3f} s, but the "
                f"image was taken from {ends[0]:.3f} to {ends[1]:.3f} s. Check that camera and "
                "image belong together."
            )

    @cached_property
    def _scan(self):
        lines = np.arange(-MARGIN, self.shape[0] + MARGIN + 1)
        times = self._since_epoch(lines)
        positions = self.trajectory.since(self._epoch).at(times)
        rotations = self.pointing.since(self._epoch).at(times)
        poses = np.concatenate([positions, rotations.reshape(-1, 9)], axis=1)
        return Scan(float(lines[0]), float(lines[-1]), poses)

    def time(self, line):
        """When lines were taken.

        Parameters
        ----------
        line : array (...), px

        Returns
        -------
        time : array (...), s
        """
        return self._epoch + self._since_epoch(line)

    @property
    def _epoch(self):
        """Time of the first rate: ephemeris times are only good to 6e-8 s, or 0.1 mm of flight."""
        return self.line_times[0, 1]

    def _since_epoch(self, line):
        line = np.asarray(line, float)
        firsts, times, periods = self.line_times.T
        row = np.maximum(np.searchsorted(firsts, line, side="right") - 1, 0)
        return times[row] - self._epoch + (line - firsts[row]) * periods[row]

    @cached_property
    def position(self):
        """Perspective centre at the middle line, body-fixed, m."""
        return self.origin(self._middle, 0.0)

    @cached_property
    def rotation(self):
        """From body-fixed axes to the camera frame at the middle line."""
        return self.pointing.at(self.time(self._middle))

    @cached_property
    def sun_position(self):
        """Of the Sun at the middle line, body-fixed, m; None when nothing is known of it."""
        return (
            None
            if self.sun_trajectory is None
            else self._along(self.sun_trajectory, self._middle, 0.0)
        )

    @property
    def _middle(self):
        return self.shape[0] / 2

    @property
    def _lens(self):
        return (self.distortion or undistorted()).lens

    def project(self, xyz):
        """Image coordinates of ground points; see `Camera.project`.

        NaN also where no line from `MARGIN` before the first to `MARGIN` behind the last sees them.
        """
        points = np.ascontiguousarray(xyz, dtype=float)
        found = np.empty((2, *points.shape[:-1]))
        flat = found.reshape(2, -1)
        with threads_for(flat.shape):
            project_line_scan(points.reshape(-1, 3), self._scan, self.plane, self._lens, *flat)
        return found[0], found[1]

    def ray(self, line, sample):
        """Directions in which pixels look; see `Camera.ray`."""
        line, sample = np.broadcast_arrays(np.asarray(line, float), np.asarray(sample, float))
        rays = np.empty((*line.shape, 3))
        flat = rays.reshape(-1, 3)
        with threads_for((line.size, 1)):
            look_line_scan(line.ravel(), sample.ravel(), self._scan, self.plane, self._lens, flat)
        return rays

    def origin(self, line, sample):
        """Perspective centres from which pixels were taken; see `Camera.origin`."""
        return self._along(self.trajectory, line, sample)

    def sun(self, line, sample):
        """Position of the Sun when pixels were taken; see `Camera.sun`."""
        self._known_sun()  # or an error
        return self._along(self.sun_trajectory, line, sample)

    def _along(self, trajectory, line, sample):
        shape = np.broadcast(line, sample).shape
        times = self._since_epoch(np.broadcast_to(line, shape))
        return trajectory.since(self._epoch).at(times)

    def adjusted(self, rotation, shift):
        """The same camera, turned and moved alike at all lines; see `Camera.adjusted`."""
        from scipy.spatial.transform import Rotation  # slow to import

        turn = Rotation.from_rotvec(np.asarray(rotation, float)).as_matrix()
        return replace(
            self, trajectory=self.trajectory.shifted(shift), pointing=self.pointing.turned(turn)
        )
