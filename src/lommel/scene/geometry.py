"""Light and view at every post: incidence, emission and phase from positions.

Normals come from the positions of neighbouring posts by central differences. The functions here
are the plain array versions: they define the meaning for whole grids of moderate size.
Most callers want `viewing_geometry`.
"""

from dataclasses import dataclass

import numpy as np

from lommel.scene.grid import Window


@dataclass(frozen=True)
class ViewingGeometry:
    """Photometric angles at every post.

    Attributes
    ----------
    cos_incidence, cos_emission : array (rows, cols), dimensionless
        Cosines of the angles normal-Sun and normal-camera; negative beyond 90 degrees.
    phase : array (rows, cols), rad
        Angle Sun-surface-camera.
    """

    cos_incidence: np.ndarray
    cos_emission: np.ndarray
    phase: np.ndarray


def surface_normals(xyz):
    """Unit normals of a surface given by its posts; they leave the body.

    Parameters
    ----------
    xyz : array (rows, cols, 3), m
        Body-fixed posts; rows run south, columns east. NaN where the surface is unknown.

    Returns
    -------
    normals : array (rows, cols, 3), dimensionless
        NaN where a needed neighbour is unknown.
    """
    south, east = np.gradient(xyz, axis=(0, 1))
    return unit(np.cross(south, east))


def unit(vectors):
    """Vectors of length 1 along the last axis."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def viewing_geometry(xyz, normals, sun_position, spacecraft_position):
    """Cosines of incidence and emission, and phase, for one Sun and one camera position.

    Parameters
    ----------
    xyz : array (rows, cols, 3), m
    normals : array (rows, cols, 3), dimensionless
    sun_position, spacecraft_position : array (3,), m, body-fixed

    Returns
    -------
    geometry : ViewingGeometry
    """
    to_sun = unit(np.asarray(sun_position) - xyz)
    to_camera = unit(np.asarray(spacecraft_position) - xyz)
    cos_phase = np.clip(np.einsum("...i,...i", to_sun, to_camera), -1.0, 1.0)
    return ViewingGeometry(
        np.einsum("...i,...i", normals, to_sun),
        np.einsum("...i,...i", normals, to_camera),
        np.arccos(cos_phase),
    )


@dataclass(frozen=True)
class Observation:
    """One image brought onto the grid of the run.

    Attributes
    ----------
    name : str
        File name, the key in every table.
    window : Window
        The posts the image covers, in the grid of the run.
    measured : float32 array (window.rows, window.cols), image units
        Brightness; NaN where missing.
    sun_position, spacecraft_position : array (3,), m, body-fixed
    saturation : float, image units
        Values from here on are clipped; infinity when the format does not clip.
    """

    name: str
    window: Window
    measured: np.ndarray
    sun_position: np.ndarray
    spacecraft_position: np.ndarray
    saturation: float = np.inf
