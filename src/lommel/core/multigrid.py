r"""Conjugate gradients, preconditioned by one V-cycle, for the normal operator.

The operator of `lommel.core.normal_operator` is completed by terms that pull long wavelengths
only: with :math:`S_l` the normalised restriction repeated `l` times,

.. math:: A = D^T G D + K^T W K + \sum_l m_l S_l^T S_l .

Coarse levels carry the 2x2 mean of the tensors, a quarter of the curvature weight and four times
the mass per level (the same energy for the same smooth surface), and resist the twist that
coarse slopes cannot see by tr(G)/64. The smoother is a Chebyshev polynomial on the upper part of
the spectrum, whose end is known (`LARGEST_EIGENVALUE`); its degree doubles from level to level.
Most callers want `NormalEquations` and `conjugate_gradients`.
"""

from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import numba
import numpy as np
from numba import njit, prange

from lommel.core.normal_operator import (
    BLOCK,
    LARGEST_EIGENVALUE,
    apply_operator,
    coarse_shape,
    coarsen_cells,
    inverse_diagonal,
    prolong,
    prolong_add,
    restrict,
    subtract_operator,
)
from lommel.core.plane import remove_plane

# Degree of the Chebyshev polynomial before and after each coarse visit, doubled from level to
# level, and the share of the spectrum it leaves to the next one, times the degree squared. With one
# image stripes along the Sun are nearly free: coarse levels, which cost little, must smooth them.
DEGREE, LARGEST_DEGREE = 2, 16
LEFT_SHARE = 0.75
HOURGLASS = 1 / 64  # share of tr(G): enough against a checkerboard, soft to oblique stripes
SMALLEST = 9  # posts along the shorter side below which the level is solved directly
# Levels of the V-cycle that feel the terms of longer waves: those on which these terms weigh
# against the slopes. Above, they would cost as much as they save.
LONG_WAVES_FROM = 2
NORMALISED = np.float32(0.25)  # the nine weights of `restrict` sum to four
SERIAL_POSTS = 64 * 1024  # below it a parallel loop costs more than it saves


@dataclass
class Level:
    """One grid of the hierarchy: the operator's coefficients and the cycle's work arrays."""

    tensors: tuple[np.ndarray, np.ndarray, np.ndarray]
    curvature: np.ndarray
    hourglass: float
    mass: np.ndarray
    degree: int
    inverse_diagonal: np.ndarray
    long_masses: np.ndarray
    x: np.ndarray
    residual: np.ndarray
    step: np.ndarray

    @property
    def shape(self):
        """Posts of this level."""
        return self.x.shape

    def apply(self, u, out):
        """``out = A u``, on the largest levels without the terms of long waves."""
        apply_operator(u, *self.tensors, self.curvature, self.hourglass, self.mass, out)
        if self.long_masses.any():
            add_long_waves(u, self.long_masses, out)

    def subtract(self, u, out):
        """``out -= A u``, as in `apply`."""
        subtract_operator(u, *self.tensors, self.curvature, self.hourglass, self.mass, out)
        if self.long_masses.any():
            add_long_waves(u, -self.long_masses, out)


class NormalEquations:
    """The normal operator and its V-cycle.

    Parameters
    ----------
    tensors : tuple of three float32 arrays (rows - 1, cols - 1)
        Gpp, Gpq, Gqq per squared difference.
    curvature : float32 array (3,)
        Weights of the second differences along rows, of the twist, and along columns.
    masses : array (depth,)
        Weight of each post of the grid halved 0, 1, 2, ... times.
    posts : float32 array (rows, cols), optional
        Weight of each single post, beside ``masses[0]``.
    """

    def __init__(self, tensors, curvature, masses, posts=None):
        shape = tensors[0].shape[0] + 1, tensors[0].shape[1] + 1
        self.masses = np.asarray(masses, float)
        posts = np.zeros((1, shape[1]), np.float32) if posts is None else posts
        mass = posts + np.float32(self.masses[0])
        curvature = np.asarray(curvature, np.float32)
        self.levels = [_level(shape, tuple(tensors), curvature, 0.0, mass, DEGREE)]
        while min(shape) > SMALLEST:
            finer_shape, shape = shape, coarse_shape(shape)
            coarse = tuple(np.empty((shape[0] - 1, shape[1] - 1), np.float32) for _ in range(3))
            curvature = curvature / np.float32(4)
            if posts.shape[0] > 1:
                posts, finer_posts = np.empty(shape, np.float32), posts
                with threads_for(finer_shape):
                    restrict(finer_posts, posts)
            else:
                posts = np.zeros((1, shape[1]), np.float32)
            own, *longer = coarse_masses(self.masses, len(self.levels))
            mass = posts + np.float32(own)
            degree = min(2 * self.levels[-1].degree, LARGEST_DEGREE)
            felt = longer if len(self.levels) >= LONG_WAVES_FROM else ()
            self.levels.append(_level(shape, coarse, curvature, HOURGLASS, mass, degree, felt))
        self._vectors: list[np.ndarray] = []
        self.renew(tensors)

    def renew(self, tensors):
        """Take other tensors of the same shape; all else stays, also the memory in use."""
        self.levels[0].tensors = tuple(tensors)
        for finer, coarse in pairwise(self.levels):
            with threads_for(finer.shape):
                for fine, half in zip(finer.tensors, coarse.tensors, strict=True):
                    coarsen_cells(fine, half)
        for level in self.levels:
            # each element m w w^T has weights w that sum to 1: a diagonal of m w keeps its
            # eigenvalues below 1; a post holds the share 1 / 4^l of an average over 2^l x 2^l
            lumped = (level.long_masses / 4.0 ** np.arange(level.long_masses.size)).sum()
            with threads_for(level.shape):
                inverse_diagonal(
                    *level.tensors,
                    level.curvature,
                    level.hourglass,
                    level.mass + np.float32(lumped),
                    level.inverse_diagonal,
                )
        self._inverse = _dense_inverse(self.levels[-1])

    @property
    def vectors(self):
        """Four arrays (rows, cols) for the use of a solver."""
        if not self._vectors:
            self._vectors = [np.empty(self.shape, np.float32) for _ in range(4)]
        return self._vectors

    @property
    def shape(self):
        """Posts of the finest level."""
        return self.levels[0].shape

    def apply(self, u, out):
        """``out = A u`` with every term."""
        finest = self.levels[0]
        with threads_for(u.shape):
            finest.apply(u, out)
        if self.masses[1:].any():
            add_long_waves(u, np.concatenate([[0.0], self.masses[1:]]), out)

    def precondition(self, right_hand_side):
        """One V-cycle from zero.

        Parameters
        ----------
        right_hand_side : float32 array (rows, cols)

        Returns
        -------
        x : float32 array (rows, cols)
            A work array: it is overwritten by the next call.
        """
        np.copyto(self.levels[0].residual, right_hand_side)
        self._cycle(0)
        return self.levels[0].x

    def _cycle(self, depth):
        """From the residual of a level to its ``x``."""
        level = self.levels[depth]
        if depth == len(self.levels) - 1:
            np.copyto(level.x, (self._inverse @ level.residual.ravel()).reshape(level.shape))
            return
        coarse = self.levels[depth + 1]
        with threads_for(level.shape):
            _smooth_from_zero(level)
            restrict(level.residual, coarse.residual)
        self._cycle(depth + 1)
        with threads_for(level.shape):
            prolong(coarse.x, level.step)
            prolong_add(coarse.x, level.x)
            level.subtract(level.step, level.residual)
            _smooth_last(level)


@dataclass(frozen=True)
class LinearSolution:
    """How a linear solve ended.

    Attributes
    ----------
    x : float32 array (rows, cols)
        Memory of the equations: it is overwritten by the next solve.
    iterations : int
        V-cycles, one per iteration.
    reduction : float
        Energy norm of the preconditioned residual against its start.
    """

    x: np.ndarray
    iterations: int
    reduction: float


def conjugate_gradients(equations, right_hand_side, tolerance, max_iterations, keeps_plane=False):
    """Solve ``A x = right_hand_side`` from zero.

    Parameters
    ----------
    equations : NormalEquations
    right_hand_side : float32 array (rows, cols)
    tolerance : float
        Reduction of sqrt(residual . preconditioned residual) to stop at.
    max_iterations : int
    keeps_plane : bool
        Solve among all ``x`` without mean and mean tilt.

    Returns
    -------
    solution : LinearSolution
    """

    def precondition(residual):
        """One V-cycle, from and to the fields that are allowed."""
        if not keeps_plane:
            return equations.precondition(residual)
        with threads_for(residual.shape):
            remove_plane(residual)
        preconditioned = equations.precondition(residual)
        with threads_for(residual.shape):
            remove_plane(preconditioned)
        return preconditioned

    residual, x, direction, image = equations.vectors
    np.copyto(residual, right_hand_side)
    x[:] = 0.0
    preconditioned = precondition(residual)
    np.copyto(direction, preconditioned)
    energy = start = dot(residual, preconditioned)
    if not start > 0:
        return LinearSolution(x, 0, 0.0)
    iterations = 0
    while iterations < max_iterations:
        equations.apply(direction, image)
        bending = dot(direction, image)
        if not bending > 0:
            break
        iterations += 1
        with threads_for(x.shape):
            _take_step(x, residual, direction, image, np.float32(energy / bending))
        # zero in exact arithmetic; subtracting it keeps directions conjugate in float32
        overlap = dot(residual, preconditioned)
        preconditioned = precondition(residual)
        last, energy = energy, dot(residual, preconditioned)
        if not energy > tolerance**2 * start:
            break
        with threads_for(x.shape):
            _redirect(direction, preconditioned, np.float32(max(energy - overlap, 0.0) / last))
    return LinearSolution(x, iterations, float(np.sqrt(max(energy, 0.0) / start)))


def add_long_waves(u, masses, out):
    """Add the long-wavelength terms to a gradient.

    Parameters
    ----------
    u : float32 array (rows, cols)
    masses : array (depth,)
        Weight of each post of the grid halved 0, 1, 2, ... times.
    out : float32 array (rows, cols)
        Gets the sum of m_l S_l^T S_l u added.

    Returns
    -------
    energy : float
        The sum of m_l |S_l u|^2.
    """
    masses = np.asarray(masses, float)
    if u.size < SERIAL_POSTS:
        with threads_for(u.shape):
            return _add_long_waves(u, masses, out)
    energy = 0.0
    if masses[0]:
        energy = masses[0] * dot(u, u)
        out += np.float32(masses[0]) * u
    if masses[1:].any():
        low = np.empty(coarse_shape(u.shape), np.float32)
        restrict(u, low)
        low *= NORMALISED
        pull = np.zeros_like(low)
        energy += add_long_waves(low, masses[1:], pull)
        pull *= NORMALISED
        prolong_add(pull, out)
    return energy


@njit(cache=True)
def _add_long_waves(u, masses, out):
    """The same for a small array, without the way back to Python between levels."""
    lows = [u]
    for _ in range(masses.size - 1):
        fine = lows[-1]
        low = np.empty(((fine.shape[0] + 2) // 2, (fine.shape[1] + 2) // 2), np.float32)
        restrict(fine, low)
        low *= NORMALISED
        lows.append(low)
    energy, total = 0.0, np.zeros_like(lows[-1])
    for level in range(masses.size - 1, -1, -1):
        low, mass = lows[level], masses[level]
        pull = out if level == 0 else np.zeros_like(low)
        if level < masses.size - 1:
            total *= NORMALISED
            prolong_add(total, pull)
        if mass != 0:
            energy += mass * _block_dots(low, low).sum()
            pull += np.float32(mass) * low
        total = pull
    return energy


@contextmanager
def threads_for(shape):
    """One thread for small arrays, all of them for large ones."""
    threads = numba.get_num_threads()
    if shape[0] * shape[1] < SERIAL_POSTS:
        numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(threads)


def dot(a, b):
    """Inner product in float64, summed in fixed blocks of rows."""
    with threads_for(a.shape):
        return float(_block_dots(a, b).sum())


def distance(a, b):
    """Root mean square of ``a - b``, summed as in `dot`."""
    with threads_for(a.shape):
        return float(np.sqrt(_block_squares(a, b).sum() / a.size))


@njit(cache=True, parallel=True, fastmath={"contract", "reassoc", "nsz"})
def _block_squares(a, b):
    rows = a.shape[0]
    sums = np.zeros((rows + BLOCK - 1) // BLOCK)
    for i in prange(sums.size):
        first = np.int64(i) * BLOCK
        total = 0.0
        for r in range(first, min(first + BLOCK, rows)):
            x, y = a[r], b[r]
            for c in range(x.size):
                off = np.float64(x[c] - y[c])
                total += off * off
        sums[i] = total
    return sums


@njit(cache=True, parallel=True, fastmath={"contract", "reassoc", "nsz"})
def _block_dots(a, b):
    rows = a.shape[0]
    sums = np.zeros((rows + BLOCK - 1) // BLOCK)
    for i in prange(sums.size):
        first = np.int64(i) * BLOCK
        total = 0.0
        for r in range(first, min(first + BLOCK, rows)):
            total += _row_dot(a[r], b[r])
        sums[i] = total
    return sums


@njit(cache=True, nogil=True, forceinline=True, fastmath={"contract", "reassoc", "nsz"})
def _row_dot(a, b):
    total = 0.0
    for c in range(a.size):
        total += np.float64(a[c]) * np.float64(b[c])
    return total


def _level(shape, tensors, curvature, hourglass, mass, degree, longer=()):
    """Coefficients of a grid, and its work arrays."""
    long_masses = np.array([0.0, *longer])
    inverse, *work = (np.zeros(shape, np.float32) for _ in range(4))
    hourglass = np.float32(hourglass)
    return Level(tensors, curvature, hourglass, mass, degree, inverse, long_masses, *work)


def coarse_masses(masses, halvings):
    """Masses of the grid halved so often; those of finer grids act on its posts, times 4 each."""
    masses = np.asarray(masses, float)
    factors = 4.0 ** (halvings - np.arange(min(halvings + 1, masses.size)))
    own = (masses[: factors.size] * factors).sum()
    return np.concatenate([[own], masses[halvings + 1 :]])


def _dense_inverse(level):
    count = level.x.size
    matrix = np.empty((count, count))
    probe, image = np.zeros((2, *level.shape), np.float32)
    with threads_for(level.shape):
        for k in range(count):
            probe.ravel()[k] = 1.0
            level.apply(probe, image)
            matrix[k] = image.ravel()
            probe.ravel()[k] = 0.0
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    # float32 coefficients know eigenvalues to 1e-6 of the largest: less is the null space
    keep = values > 1e-6 * max(values[-1], 0.0)
    inverse = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T
    return inverse.astype(np.float32)


def _smooth_from_zero(level):
    """Chebyshev iteration on the upper spectrum; ``residual`` becomes what ``x`` leaves of it."""
    (_, scale), *later = _chebyshev(level.degree)
    _first_step(level.x, level.step, level.residual, level.inverse_diagonal, scale)
    level.subtract(level.step, level.residual)
    for keep, scale in later:
        _next_step(level.x, level.step, level.residual, level.inverse_diagonal, keep, scale)
        level.subtract(level.step, level.residual)


def _smooth_last(level):
    """The same from where ``x`` is; the last step leaves ``residual``, which nobody asks for."""
    *earlier, (keep, scale) = _chebyshev(level.degree)
    for keep_more, scale_more in earlier:
        _next_step(
            level.x, level.step, level.residual, level.inverse_diagonal, keep_more, scale_more
        )
        level.subtract(level.step, level.residual)
    _last_step(level.x, level.step, level.residual, level.inverse_diagonal, keep, scale)


def _chebyshev(degree):
    """What each step keeps of the last one, and the factor of the scaled residual in it."""
    upper, left = LARGEST_EIGENVALUE, LEFT_SHARE / degree**2
    middle, half = upper * (1 + left) / 2, upper * (1 - left) / 2
    sigma = middle / half
    rho = 1.0 / sigma
    steps = [(np.float32(0), np.float32(1.0 / middle))]
    while len(steps) < degree:
        next_rho = 1.0 / (2.0 * sigma - rho)
        steps.append((np.float32(next_rho * rho), np.float32(2.0 * next_rho / half)))
        rho = next_rho
    return steps


@njit(cache=True, parallel=True, fastmath={"contract", "nsz"})
def _first_step(x, step, residual, inverse_diagonal, scale):
    for i in prange(x.shape[0]):
        a, s, r, d = x[i], step[i], residual[i], inverse_diagonal[i]
        for c in range(a.size):
            s[c] = scale * d[c] * r[c]
        for c in range(a.size):
            a[c] = s[c]


@njit(cache=True, parallel=True, fastmath={"contract", "nsz"})
def _next_step(x, step, residual, inverse_diagonal, keep, scale):
    for i in prange(x.shape[0]):
        a, s, r, d = x[i], step[i], residual[i], inverse_diagonal[i]
        for c in range(a.size):
            s[c] = keep * s[c] + scale * d[c] * r[c]
        for c in range(a.size):
            a[c] += s[c]


@njit(cache=True, parallel=True, fastmath={"contract", "nsz"})
def _last_step(x, step, residual, inverse_diagonal, keep, scale):
    for i in prange(x.shape[0]):
        a, s, r, d = x[i], step[i], residual[i], inverse_diagonal[i]
        for c in range(a.size):
            a[c] += keep * s[c] + scale * d[c] * r[c]


@njit(cache=True, parallel=True, fastmath={"contract", "nsz"})
def _take_step(x, residual, step, image, length):
    """``x += length step`` and ``residual -= length A step``."""
    for i in prange(x.shape[0]):
        a, b, s, t = x[i], residual[i], step[i], image[i]
        for c in range(a.size):
            a[c] += length * s[c]
        for c in range(a.size):
            b[c] -= length * t[c]


@njit(cache=True, parallel=True, fastmath={"contract", "nsz"})
def _redirect(direction, preconditioned, keep):
    for i in prange(direction.shape[0]):
        d, z = direction[i], preconditioned[i]
        for c in range(d.size):
            d[c] = z[c] + keep * d[c]
