r"""Cameras: from ground points to image coordinates and back to view rays.

Image coordinates are CSM's: (line, sample), the upper left corner of the image is (0, 0), the
centre of the first pixel (0.5, 0.5). The camera frame is right-handed: x along growing samples, y
along growing lines, z from the camera into the scene. With the ground point X, the camera's
position C, the rotation M from the body to the camera frame, the focal length f, the distortion D
and the principal point (l0, s0)

.. math:: (X_c, Y_c, Z_c) = M (X - C), \quad (x, y) = D(f X_c / Z_c, f Y_c / Z_c), \quad
          (line, sample) = (l_0, s_0) + A\, (x, y).

The focal plane's unit is the pixel and A sets (line, sample) = (y, x), unless a camera brings its
own A: then the plane may be in millimetres and its axes may run along any direction of the
detector, as ISIS's ``TRANSX``, ``ITRANSL`` and CSM's ``focal2pixel_lines`` have it. A crop that
begins at (l, s) of an image reduced n times has the same camera with the principal point
((l0 - l) / n, (s0 - s) / n) and A / n.

Most callers want `Camera` as the type and `FrameCamera` as the thing.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from lommel.core.multigrid import threads_for
from lommel.errors import InputError
from lommel.scene.camera_kernels import look_frame, project_frame
from lommel.scene.distortion import Distortion, undistorted
from lommel.scene.geometry import unit

ORTHOGONALITY = 1e-6  # largest entry of M M^T - 1; rotations in files carry about 1e-9
UPRIGHT = ((0.0, 1.0), (1.0, 0.0))  # line = y, sample = x


class Camera(ABC):
    """Where one image looks.

    Attributes
    ----------
    position : array (3,), m, body-fixed
        Of the perspective centre; of a moving camera, at the middle of the image.
    shape : tuple of int
        Lines and samples.
    sun_position : array (3,), m, body-fixed, or None
        At the middle of the image; None when nothing is known of the Sun.
    """

    position: np.ndarray
    shape: tuple[int, int]
    sun_position: np.ndarray | None

    @abstractmethod
    def project(self, xyz):
        """Image coordinates of ground points.

        Parameters
        ----------
        xyz : array (..., 3), m, body-fixed

        Returns
        -------
        line, sample : array (...), px
            Also beyond the image's edges; NaN for points behind the camera, and where the
            distortion has no inverse.
        """

    @abstractmethod
    def ray(self, line, sample):
        """Directions in which pixels look; the inverse of `project`.

        Parameters
        ----------
        line, sample : array (...), px

        Returns
        -------
        direction : array (..., 3), dimensionless
            Unit vectors from the camera into the scene, body-fixed.
        """

    @abstractmethod
    def adjusted(self, rotation, shift):
        """The same camera, turned and moved a little.

        Parameters
        ----------
        rotation : array (3,), rad
            Rotation vector in the camera frame: M becomes R(rotation) M.
        shift : array (3,), m, body-fixed
            Added to the perspective centre.

        Returns
        -------
        camera : Camera
        """

    def origin(self, line, sample):
        """Perspective centres from which pixels were taken.

        Parameters
        ----------
        line, sample : array (...), px

        Returns
        -------
        xyz : array (..., 3), m, body-fixed
        """
        return np.broadcast_to(self.position, (*np.broadcast(line, sample).shape, 3))

    def sun(self, line, sample):
        """Position of the Sun when pixels were taken.

        Parameters
        ----------
        line, sample : array (...), px

        Returns
        -------
        xyz : array (..., 3), m, body-fixed
        """
        return np.broadcast_to(self._known_sun(), (*np.broadcast(line, sample).shape, 3))

    def _known_sun(self):
        if self.sun_position is None:
            raise InputError(
                "the camera file does not tell where the Sun stood. Give a table with "
                "--sun-positions."
            )
        return self.sun_position

    def contains(self, line, sample):
        """True where image coordinates lie on the image."""
        lines, samples = self.shape
        return (line >= 0) & (line <= lines) & (sample >= 0) & (sample <= samples)


class FocalPlane(NamedTuple):
    """Focal length and the way between focal plane and image, as the compiled kernels take it."""

    focal_length: float
    principal_line: float
    principal_sample: float
    to_pixels: np.ndarray  # (2, 2): (line, sample) from (x, y)
    from_pixels: np.ndarray


def focal_plane(focal_length, principal_point, to_pixels):
    """The focal plane of a camera, checked.

    Parameters
    ----------
    focal_length : float, the plane's unit
    principal_point : tuple of float, px
        Line and sample of the optical axis.
    to_pixels : array (2, 2), px per unit
        Rows give line and sample, columns take x and y.

    Returns
    -------
    plane : FocalPlane
    """
    to_pixels = np.array(to_pixels, dtype=float)
    if not 0 < focal_length < np.inf:
        raise InputError(
            f"focal_length = {focal_length} is not positive and finite. Check the camera file."
        )
    if not np.isfinite(principal_point).all():
        raise InputError(f"principal_point = {principal_point} is not finite, in pixels.")
    is_matrix = to_pixels.shape == (2, 2) and np.isfinite(to_pixels).all()
    if not (is_matrix and np.linalg.matrix_rank(to_pixels) == 2):
        raise InputError(
            f"to_pixels = {to_pixels.tolist()} does not map the focal plane to lines and samples "
            "one to one. Check the detector's axes in the camera file."
        )
    line, sample = principal_point
    return FocalPlane(
        float(focal_length), float(line), float(sample), to_pixels, np.linalg.inv(to_pixels)
    )


def checked_rotation(rotation):
    """Rotation matrices as float64, when they are rotations.

    Parameters
    ----------
    rotation : array (..., 3, 3)

    Returns
    -------
    rotation : float64 array (..., 3, 3), C-contiguous
    """
    rotation = np.ascontiguousarray(rotation, dtype=float)
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max()
    if not (deviation <= ORTHOGONALITY and (np.linalg.det(rotation) > 0).all()):
        raise InputError(
            "rotation is not a rotation: its rows must be orthogonal unit vectors that form "
            "a right-handed frame. Check the camera file."
        )
    return rotation


@dataclass(frozen=True, eq=False)
class FrameCamera(Camera):
    """A camera that takes the whole image at once.

    Attributes
    ----------
    position : array (3,), m, body-fixed
    rotation : array (3, 3), dimensionless
        From body-fixed axes to the camera frame; its rows are the camera's axes.
    focal_length : float
        In the unit of the focal plane: px, unless `to_pixels` says otherwise.
    principal_point : tuple of float, px
        Line and sample where the optical axis meets the image.
    shape : tuple of int
        Lines and samples.
    distortion : Distortion or None
    sun_position : array (3,), m, body-fixed, or None
    to_pixels : array (2, 2), px per unit of the focal plane
        Takes (x, y) on the focal plane to line and sample from the principal point.
    """

    position: np.ndarray
    rotation: np.ndarray
    focal_length: float
    principal_point: tuple[float, float]
    shape: tuple[int, int]
    distortion: Distortion | None = None
    sun_position: np.ndarray | None = None
    to_pixels: np.ndarray | tuple = UPRIGHT
    plane: FocalPlane = field(init=False, repr=False)

    def __post_init__(self):
        """Check what the projection needs."""
        position = np.array(self.position, dtype=float)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise InputError(
                f"position = {self.position} of the camera is not three finite numbers."
            )
        plane = focal_plane(self.focal_length, self.principal_point, self.to_pixels)
        for name, value in {
            "position": position,
            "rotation": checked_rotation(self.rotation),
            "plane": plane,
        }.items():
            object.__setattr__(self, name, value)

    def project(self, xyz):
        """Image coordinates of ground points; see `Camera.project`."""
        points = np.ascontiguousarray(xyz, dtype=float)
        found = np.empty((2, *points.shape[:-1]))
        flat = found.reshape(2, -1)
        with threads_for(flat.shape):
            project_frame(
                points.reshape(-1, 3), self.position, self.rotation, self.plane, self._lens, *flat
            )
        return found[0], found[1]

    def ray(self, line, sample):
        """Directions in which pixels look; see `Camera.ray`."""
        line, sample = np.broadcast_arrays(np.asarray(line, float), np.asarray(sample, float))
        rays = np.empty((*line.shape, 3))
        with threads_for((line.size, 1)):
            look_frame(
                line.ravel(),
                sample.ravel(),
                self.rotation,
                self.plane,
                self._lens,
                rays.reshape(-1, 3),
            )
        return rays

    @property
    def _lens(self):
        return (self.distortion or undistorted()).lens

    def adjusted(self, rotation, shift):
        """The same camera, turned and moved a little; see `Camera.adjusted`."""
        from scipy.spatial.transform import Rotation  # slow to import

        turn = Rotation.from_rotvec(np.asarray(rotation, float)).as_matrix()
        return replace(
            self, position=self.position + np.asarray(shift, float), rotation=turn @ self.rotation
        )


def nadir_rotation(position, heading):
    """Rotation of a camera that looks straight down, its samples running along the heading.

    Parameters
    ----------
    position : array (3,), m, body-fixed
    heading : array (3,)
        Direction of flight, body-fixed; only its horizontal part counts.

    Returns
    -------
    rotation : array (3, 3), body-fixed axes to camera frame
    """
    down = -unit(np.asarray(position, float))
    along = unit(heading - np.dot(heading, down) * down)
    return np.stack([along, np.cross(down, along), down])


@dataclass(frozen=True, eq=False)
class ReducedCamera(Camera):
    """The camera of an image whose pixels were averaged in squares.

    Attributes
    ----------
    full : Camera
        Of the image as it was.
    factor : int
        Pixels along each side of a square.
    """

    full: Camera
    factor: int

    @property
    def position(self):
        """Perspective centre, body-fixed, m."""
        return self.full.position

    @property
    def shape(self):
        """Lines and samples of the reduced image."""
        return self.full.shape[0] // self.factor, self.full.shape[1] // self.factor

    @property
    def sun_position(self):
        """Of the full image, body-fixed, m."""
        return self.full.sun_position

    def project(self, xyz):
        """Image coordinates of ground points; see `Camera.project`."""
        line, sample = self.full.project(xyz)
        return line / self.factor, sample / self.factor

    def ray(self, line, sample):
        """Directions in which pixels look; see `Camera.ray`."""
        return self.full.ray(*self._in_full(line, sample))

    def origin(self, line, sample):
        """Perspective centres from which pixels were taken; see `Camera.origin`."""
        return self.full.origin(*self._in_full(line, sample))

    def sun(self, line, sample):
        """Position of the Sun when pixels were taken; see `Camera.sun`."""
        return self.full.sun(*self._in_full(line, sample))

    def adjusted(self, rotation, shift):
        """The same camera, turned and moved a little; see `Camera.adjusted`."""
        return replace(self, full=self.full.adjusted(rotation, shift))

    def _in_full(self, line, sample):
        return np.asarray(line) * self.factor, np.asarray(sample) * self.factor
