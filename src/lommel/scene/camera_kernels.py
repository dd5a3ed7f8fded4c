"""Compiled projection of a frame camera, one point after the other.

Most callers want `lommel.scene.camera.FrameCamera`.
"""

from typing import Any

import numpy as np
from numba import njit, prange

from lommel.scene.distortion_kernels import SERIAL, distort, undistort

BLOCK = 4096  # points per parallel work item
PARALLEL: dict[str, Any] = {"cache": True, "parallel": True, "error_model": "numpy"}


@njit(**SERIAL)
def _project(xyz, position, rotation, plane, lens, line, sample):
    px, py, pz = position[0], position[1], position[2]
    axes, focal = rotation, plane.focal_length
    for i in range(line.size):
        dx, dy, dz = xyz[i, 0] - px, xyz[i, 1] - py, xyz[i, 2] - pz
        z = axes[2, 0] * dx + axes[2, 1] * dy + axes[2, 2] * dz
        scale = focal / z if z > 0.0 else np.nan
        x = scale * (axes[0, 0] * dx + axes[0, 1] * dy + axes[0, 2] * dz)
        y = scale * (axes[1, 0] * dx + axes[1, 1] * dy + axes[1, 2] * dz)
        x, y = distort(lens, x, y)
        line[i], sample[i] = to_image(plane, x, y)


@njit(**SERIAL)
def _look(line, sample, rotation, plane, lens, out):
    axes, focal = rotation, plane.focal_length
    for i in range(line.size):
        x, y = to_plane(plane, line[i], sample[i])
        x, y = undistort(lens, x, y)
        scale = 1.0 / np.sqrt(x * x + y * y + focal * focal)
        x, y, z = scale * x, scale * y, scale * focal
        for k in range(3):
            out[i, k] = x * axes[0, k] + y * axes[1, k] + z * axes[2, k]


@njit(**SERIAL)
def to_image(plane, x, y):
    """Line and sample of a place on the focal plane."""
    a = plane.to_pixels
    line = plane.principal_line + a[0, 0] * x + a[0, 1] * y
    sample = plane.principal_sample + a[1, 0] * x + a[1, 1] * y
    return line, sample


@njit(**SERIAL)
def to_plane(plane, line, sample):
    """Place on the focal plane of a line and sample; the inverse of `to_image`."""
    line, sample = line - plane.principal_line, sample - plane.principal_sample
    a = plane.from_pixels
    return a[0, 0] * line + a[0, 1] * sample, a[1, 0] * line + a[1, 1] * sample


@njit(**PARALLEL)
def project_frame(xyz, position, rotation, plane, lens, line, sample):
    """Image coordinates of ground points.

    Parameters
    ----------
    xyz : float64 array (n, 3), m
    position : float64 array (3,), m
    rotation : float64 array (3, 3)
        From the body to the camera frame.
    plane : FocalPlane
    lens : Lens
    line, sample : float64 array (n,), px
        Filled.
    """
    for block in prange((line.size + BLOCK - 1) // BLOCK):
        first = np.int64(block) * BLOCK
        last = min(first + BLOCK, line.size)
        _project(
            xyz[first:last], position, rotation, plane, lens, line[first:last], sample[first:last]
        )


@njit(**PARALLEL)
def look_frame(line, sample, rotation, plane, lens, out):
    """Directions in which pixels look; the inverse of `project_frame`.

    Parameters
    ----------
    line, sample : float64 array (n,), px
    rotation : float64 array (3, 3)
    plane : FocalPlane
    lens : Lens
    out : float64 array (n, 3)
        Filled with unit vectors.
    """
    for block in prange((line.size + BLOCK - 1) // BLOCK):
        first = np.int64(block) * BLOCK
        last = min(first + BLOCK, line.size)
        _look(line[first:last], sample[first:last], rotation, plane, lens, out[first:last])
