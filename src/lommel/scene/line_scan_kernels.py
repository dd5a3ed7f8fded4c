"""Compiled projection of a line-scan camera: the search for the line that sees a point.

The line is a continuous coordinate L with its own position and rotation, from a table. Where the
point falls on the focal plane at the time of L, counted in detector lines from the line that is
exposed, is the offset; it vanishes at the solution. Most callers want
`lommel.scene.line_scan.LineScanCamera`.
"""

import numpy as np
from numba import njit, prange

from lommel.scene.camera_kernels import BLOCK, PARALLEL, to_image, to_plane
from lommel.scene.distortion_kernels import FAST, SERIAL, distort, undistort

COARSE = 0.5  # px; where the search without the lens ends
FINE = 1e-5  # px; last step of the search with it, the error after it is far smaller
STEPS = 40  # 3 to 8 are needed; more only where no line sees the point


@njit(**SERIAL, fastmath=FAST)
def _pose(scan, line, centre, axes):
    """Position and rotation of a line, linear between the edges of lines."""
    at = line - scan.first
    i = min(max(np.int64(at), 0), scan.poses.shape[0] - 2)
    t = at - i
    here, there = scan.poses[i], scan.poses[i + 1]
    for k in range(3):
        centre[k] = here[k] + t * (there[k] - here[k])
    for j in range(3):
        for k in range(3):
            m = 3 + 3 * j + k
            axes[j, k] = here[m] + t * (there[m] - here[m])


@njit(**SERIAL)
def _in_camera(point, centre, axes):
    dx, dy, dz = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    return (
        axes[0, 0] * dx + axes[0, 1] * dy + axes[0, 2] * dz,
        axes[1, 0] * dx + axes[1, 1] * dy + axes[1, 2] * dz,
        axes[2, 0] * dx + axes[2, 1] * dy + axes[2, 2] * dz,
    )


@njit(**SERIAL)
def _side(point, plane, centre, axes):
    """Signed distance of a point from the exposed plane, lens left out, in line widths times z.

    Unlike an image coordinate it has no pole where the point passes beside or behind the camera.
    """
    x, y, z = _in_camera(point, centre, axes)
    a = plane.to_pixels
    return plane.principal_line * z + plane.focal_length * (a[0, 0] * x + a[0, 1] * y)


@njit(**SERIAL)
def _offset(point, line, scan, plane, lens, centre, axes):
    """Offset from the exposed line, and the sample; NaN for a point behind the camera."""
    _pose(scan, line, centre, axes)
    x, y, z = _in_camera(point, centre, axes)
    if not z > 0.0:
        return np.nan, np.nan
    x, y = distort(lens, plane.focal_length * x / z, plane.focal_length * y / z)
    return to_image(plane, x, y)


@njit(**SERIAL)
def _coarse_line(point, scan, plane, low_side, high_side, centre, axes):
    """Line that sees a point, lens left out, to `COARSE`; regula falsi after Illinois."""
    low, high = scan.first, scan.last
    line = low
    for _ in range(STEPS):
        last = line
        line = high - high_side * (high - low) / (high_side - low_side)
        if abs(line - last) < COARSE:
            break
        _pose(scan, line, centre, axes)
        side = _side(point, plane, centre, axes)
        if (side > 0.0) == (high_side > 0.0):
            low_side *= 0.5
        else:
            low, low_side = high, high_side
        high, high_side = line, side
        if high_side == low_side:
            break
    return line


@njit(**SERIAL)
def _fine_line(point, line, scan, plane, lens, centre, axes):
    """Line and sample that see a point, by the secant method; NaN when there is none."""
    last, last_offset = line + 1.0, _offset(point, line + 1.0, scan, plane, lens, centre, axes)[0]
    for _ in range(STEPS):
        offset, sample = _offset(point, line, scan, plane, lens, centre, axes)
        if np.isnan(offset) or offset == last_offset:
            break
        step = -offset * (line - last) / (offset - last_offset)
        if abs(step) < FINE:
            return line + step, sample
        last, last_offset = line, offset
        line += step
        if not scan.first <= line <= scan.last:
            break
    return np.nan, np.nan


@njit(**SERIAL)
def _project(xyz, scan, plane, lens, line, sample):
    centre, axes = np.empty(3), np.empty((3, 3))
    first_centre, first_axes = np.empty(3), np.empty((3, 3))
    last_centre, last_axes = np.empty(3), np.empty((3, 3))
    _pose(scan, scan.first, first_centre, first_axes)
    _pose(scan, scan.last, last_centre, last_axes)
    for i in range(line.size):
        point = xyz[i]
        low = _side(point, plane, first_centre, first_axes)
        high = _side(point, plane, last_centre, last_axes)
        if low * high <= 0.0 and low != high:
            near = _coarse_line(point, scan, plane, low, high, centre, axes)
            line[i], sample[i] = _fine_line(point, near, scan, plane, lens, centre, axes)
        else:
            line[i], sample[i] = np.nan, np.nan


@njit(**SERIAL)
def _look(line, sample, scan, plane, lens, out):
    centre, axes = np.empty(3), np.empty((3, 3))
    for i in range(line.size):
        if not scan.first <= line[i] <= scan.last:
            out[i] = np.nan
            continue
        _pose(scan, line[i], centre, axes)
        x, y = to_plane(plane, 0.0, sample[i])
        x, y = undistort(lens, x, y)
        scale = 1.0 / np.sqrt(x * x + y * y + plane.focal_length**2)
        x, y, z = scale * x, scale * y, scale * plane.focal_length
        for k in range(3):
            out[i, k] = x * axes[0, k] + y * axes[1, k] + z * axes[2, k]


@njit(**PARALLEL)
def project_line_scan(xyz, scan, plane, lens, line, sample):
    """Image coordinates of ground points.

    Parameters
    ----------
    xyz : float64 array (n, 3), m
    scan : Scan
    plane : FocalPlane
    lens : Lens
    line, sample : float64 array (n,), px
        Filled; NaN where no line sees the point.
    """
    for block in prange((line.size + BLOCK - 1) // BLOCK):
        first = np.int64(block) * BLOCK
        last = min(first + BLOCK, line.size)
        _project(xyz[first:last], scan, plane, lens, line[first:last], sample[first:last])


@njit(**PARALLEL)
def look_line_scan(line, sample, scan, plane, lens, out):
    """Directions in which pixels look; the inverse of `project_line_scan`.

    Parameters
    ----------
    line, sample : float64 array (n,), px
    scan : Scan
    plane : FocalPlane
    lens : Lens
    out : float64 array (n, 3)
        Filled with unit vectors; NaN where the line was not taken.
    """
    for block in prange((line.size + BLOCK - 1) // BLOCK):
        first = np.int64(block) * BLOCK
        last = min(first + BLOCK, line.size)
        _look(line[first:last], sample[first:last], scan, plane, lens, out[first:last])
