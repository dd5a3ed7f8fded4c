r"""Cameras: from ground points to image coordinates and back to view rays.

Image coordinates are CSM's: (line, sample), the upper left corner of the image is (0, 0), the
centre of the first pixel (0.5, 0.5). The camera frame is right-handed: x along growing samples, y
along growing lines, z from the camera into the scene. With the ground point X, the camera's
position C, the rotation M from the body to the camera frame, the focal length f and the principal
point (l0, s0)

.. math:: (x, y, z) = M (X - C), \quad line = l_0 + f y / z, \quad sample = s_0 + f x / z.

Most callers want `Camera` as the type and `FrameCamera` as the thing.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from lommel.errors import InputError
from lommel.scene.geometry import unit

ORTHOGONALITY = 1e-6  # largest entry of M M^T - 1; rotations in files carry about 1e-9


class Camera(ABC):
    """Where one image looks.

    Attributes
    ----------
    position : array (3,), m, body-fixed
        Of the perspective centre; of a moving camera, at the middle of the image.
    shape : tuple of int
        Lines and samples.
    """

    position: np.ndarray
    shape: tuple[int, int]

    @abstractmethod
    def project(self, xyz):
        """Image coordinates of ground points.

        Parameters
        ----------
        xyz : array (..., 3), m, body-fixed

        Returns
        -------
        line, sample : array (...), px
            Also beyond the image's edges; NaN for points behind the camera.
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

    def contains(self, line, sample):
        """True where image coordinates lie on the image."""
        lines, samples = self.shape
        return (line >= 0) & (line <= lines) & (sample >= 0) & (sample <= samples)


@dataclass(frozen=True, eq=False)
class FrameCamera(Camera):
    """A camera that takes the whole image at once, without distortion.

    Attributes
    ----------
    position : array (3,), m, body-fixed
    rotation : array (3, 3), dimensionless
        From body-fixed axes to the camera frame; its rows are the camera's axes.
    focal_length : float, px
    principal_point : tuple of float
        Line and sample where the optical axis meets the image.
    shape : tuple of int
        Lines and samples.
    """

    position: np.ndarray
    rotation: np.ndarray
    focal_length: float
    principal_point: tuple[float, float]
    shape: tuple[int, int]

    def __post_init__(self):
        """Check that the rotation is one."""
        with np.errstate(over="ignore", invalid="ignore"):
            deviation = np.abs(self.rotation @ self.rotation.T - np.eye(3)).max()
        if not (deviation <= ORTHOGONALITY and np.linalg.det(self.rotation) > 0):
            raise InputError(
                "rotation is not a rotation: its rows must be orthogonal unit vectors that form "
                "a right-handed frame. Check the camera file."
            )
        if not 0 < self.focal_length < np.inf:
            raise InputError(
                f"focal_length = {self.focal_length} is not positive and finite. Give it in pixels."
            )

    def project(self, xyz):
        """Image coordinates of ground points; see `Camera.project`."""
        x, y, z = np.moveaxis((np.asarray(xyz, float) - self.position) @ self.rotation.T, -1, 0)
        scale = self.focal_length / np.where(z > 0, z, np.nan)
        return self.principal_point[0] + scale * y, self.principal_point[1] + scale * x

    def ray(self, line, sample):
        """Directions in which pixels look; see `Camera.ray`."""
        y = np.asarray(line, float) - self.principal_point[0]
        x = np.asarray(sample, float) - self.principal_point[1]
        x, y = np.broadcast_arrays(x, y)
        return unit(np.stack([x, y, np.full(x.shape, self.focal_length)], axis=-1) @ self.rotation)


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

    def project(self, xyz):
        """Image coordinates of ground points; see `Camera.project`."""
        line, sample = self.full.project(xyz)
        return line / self.factor, sample / self.factor

    def ray(self, line, sample):
        """Directions in which pixels look; see `Camera.ray`."""
        return self.full.ray(line * self.factor, sample * self.factor)
