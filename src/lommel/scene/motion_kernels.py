"""Compiled interpolation of where a moving camera was and how it looked.

Tables are interpolated beyond their ends with the polynomial or the turn of the last interval.
Most callers want `lommel.scene.motion.Trajectory` and `Pointing`.
"""

import numpy as np
from numba import njit

FAST = {"contract", "nsz"}
STRAIGHT = 1e-3  # rad; a chord followed instead of the arc is off by less than 1e-11 rad


@njit(cache=True, nogil=True)
def interval(times, time):
    """Index of the interval of an ascending table that holds a time, or the nearest one."""
    low, high = 0, times.size - 1
    if high > 0:  # most tables are regular
        guess = np.int64(min(max((time - times[0]) / (times[high] - times[0]), 0.0), 1.0) * high)
        guess = min(guess, high - 1)
        if times[guess] <= time < times[guess + 1]:
            return guess
    while high - low > 1:
        middle = (low + high) // 2
        if times[middle] <= time:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, nogil=True, fastmath=FAST)
def position_at(times, positions, velocities, time, out):
    """Position by cubic Hermite interpolation; of a single entry, along its velocity.

    Parameters
    ----------
    times : array (n,), s
    positions : array (n, 3), m
    velocities : array (n, 3), m/s
    time : float, s
    out : array (3,), m
        Filled.
    """
    i = interval(times, time)
    if times.size == 1:
        for k in range(3):
            out[k] = positions[0, k] + (time - times[0]) * velocities[0, k]
        return
    step = times[i + 1] - times[i]
    t = (time - times[i]) / step
    s = 1.0 - t
    start, end = s * s * (1.0 + 2.0 * t), t * t * (3.0 - 2.0 * t)
    leave, arrive = step * t * s * s, -step * t * t * s
    for k in range(3):
        out[k] = start * positions[i, k] + end * positions[i + 1, k]
        out[k] += leave * velocities[i, k] + arrive * velocities[i + 1, k]


@njit(cache=True, nogil=True, fastmath=FAST)
def rotation_at(times, quaternions, time, out):
    """Rotation matrix by spherical linear interpolation.

    Parameters
    ----------
    times : array (n,), s
    quaternions : array (n, 4)
        Scalar last, neighbours in the same half of the sphere.
    time : float, s
    out : array (3, 3)
        Filled.
    """
    i = interval(times, time)
    q = quaternions[i]
    x, y, z, w = q[0], q[1], q[2], q[3]
    if times.size > 1:
        p = quaternions[i + 1]
        t = (time - times[i]) / (times[i + 1] - times[i])
        dx, dy, dz, dw = p[0] - x, p[1] - y, p[2] - z, p[3] - w
        angle = 2.0 * np.arcsin(min(0.5 * np.sqrt(dx * dx + dy * dy + dz * dz + dw * dw), 1.0))
        start, end = 1.0 - t, t
        if angle > STRAIGHT:
            sine = np.sin(angle)
            start, end = np.sin(start * angle) / sine, np.sin(end * angle) / sine
        x, y, z, w = (
            start * x + end * p[0],
            start * y + end * p[1],
            start * z + end * p[2],
            (start * w + end * p[3]),
        )
    twice = 2.0 / (x * x + y * y + z * z + w * w)
    out[0, 0] = 1.0 - twice * (y * y + z * z)
    out[0, 1] = twice * (x * y - z * w)
    out[0, 2] = twice * (x * z + y * w)
    out[1, 0] = twice * (x * y + z * w)
    out[1, 1] = 1.0 - twice * (x * x + z * z)
    out[1, 2] = twice * (y * z - x * w)
    out[2, 0] = twice * (x * z - y * w)
    out[2, 1] = twice * (y * z + x * w)
    out[2, 2] = 1.0 - twice * (x * x + y * y)


@njit(cache=True, nogil=True)
def positions_at(times, positions, velocities, wanted, out):
    """`position_at` for many times; out (m, 3) is filled."""
    for j in range(wanted.size):
        position_at(times, positions, velocities, wanted[j], out[j])


@njit(cache=True, nogil=True)
def rotations_at(times, quaternions, wanted, out):
    """`rotation_at` for many times; out (m, 3, 3) is filled."""
    for j in range(wanted.size):
        rotation_at(times, quaternions, wanted[j], out[j])
