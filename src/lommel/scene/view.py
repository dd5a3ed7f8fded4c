"""How an image sees a surface: where its points fall in the image array.

Both kinds of image answer in the same way, with planes on a lattice of nodes that are affine in the
surface's unknown: array line and sample at ``u = 0``, and their change per metre. Most callers
want `OrthoView` and `CameraView`.
"""

from dataclasses import dataclass, replace

import numpy as np

from lommel.scene.camera import Camera
from lommel.scene.geometry import Observation, unit

HEIGHT_STEP = (
    50.0  # m, for the change of image coordinates with height; their bend is below 1e-4 px
)


@dataclass(frozen=True, eq=False)
class OrthoView:
    """An orthoimage on the grid of the surface, made with a known terrain.

    Attributes
    ----------
    observation : Observation
    """

    observation: Observation

    @property
    def is_projected(self):
        """True: the image was made with a terrain."""
        return True

    def with_image(self, image):
        """The same view with other pixel values."""
        return OrthoView(replace(self.observation, measured=image))

    @property
    def name(self):
        """File name of the image."""
        return self.observation.name

    @property
    def image(self):
        """Brightness, float32 array of the observation's window."""
        return self.observation.measured

    @property
    def sun_position(self):
        """Body-fixed, m."""
        return self.observation.sun_position

    @property
    def position(self):
        """Of the camera, body-fixed, m."""
        return self.observation.spacecraft_position

    def coordinates(self, surface, lattice, frame, u):
        """Planes of `lommel.estimate.shading_kernels.sample_cells`.

        Parameters
        ----------
        surface : Surface
        lattice : Lattice
        frame : Frame
        u : array (node_rows, node_cols), m

        Returns
        -------
        planes : float32 array (6, node_rows, node_cols)
        """
        shape = frame.up.shape[:2]
        line = np.broadcast_to(lattice.row - self.observation.window.row, shape)
        sample = np.broadcast_to(lattice.col - self.observation.window.col, shape)
        ray = unit(self.position - frame.xyz)
        lateral = ray / np.einsum("...i,...i", ray, frame.up)[..., None] - frame.up
        parallax = -surface.posts_crossed(lattice, u, lateral)
        return np.stack([line, sample, *frame.drift, *parallax]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class CameraView:
    """A raw image with its camera.

    Attributes
    ----------
    name : str
    image : float32 array (lines, samples)
    camera : Camera
    sun_position : array (3,), m, body-fixed
    first : tuple of int
        Line and sample of the array's first pixel, where it holds a part of the image.
    """

    name: str
    image: np.ndarray
    camera: Camera
    sun_position: np.ndarray
    first: tuple[int, int] = (0, 0)

    @property
    def is_projected(self):
        """False: the image is as the camera took it."""
        return False

    def with_image(self, image):
        """The same view with other pixel values."""
        return replace(self, image=image)

    @property
    def position(self):
        """Of the camera, body-fixed, m."""
        return self.camera.position

    def coordinates(self, surface, lattice, frame, u):
        """Planes of `sample_cells`; see `OrthoView.coordinates`."""
        low, high = u - HEIGHT_STEP, u + HEIGHT_STEP
        at_low = np.stack(self.camera.project(surface.points(lattice, low)))
        at_high = np.stack(self.camera.project(surface.points(lattice, high)))
        per_metre = (at_high - at_low) / (2 * HEIGHT_STEP)
        at_zero = (
            (at_low + at_high) / 2 - per_metre * u - 0.5
        )  # array index of the first centre is 0
        at_zero -= np.array(self.first)[:, None, None]
        planes = np.concatenate([at_zero, per_metre, np.zeros_like(at_zero)])
        return planes.astype(np.float32)
