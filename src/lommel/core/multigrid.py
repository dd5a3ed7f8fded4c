r"""Conjugate gradients, preconditioned by one V-cycle, for the normal operator.

The operator of `lommel.core.normal_operator` is completed by a term that pulls long wavelengths
only: with `S` the repeated normalised restriction down to a coarse level,

.. math:: A = D^T G D + K^T W K + S^T m S .

Coarse levels carry the 2x2 mean of the tensors, a quarter of the curvature weight and four times
the mass per level (the same energy for the same smooth surface), and resist the twist that
coarse slopes cannot see by tr(G)/12. The smoother is a Chebyshev polynomial on the upper part of
the spectrum, whose end is known (`LARGEST_EIGENVALUE`). Most callers want `NormalEquations` and
`conjugate_gradients`.
"""

from contextlib import contextmanager
from dataclasses import dataclass

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
    prolong_add,
    restrict,
)

SMOOTHING_STEPS = 3  # degree of the Chebyshev polynomial before and after each coarse visit
SMOOTHED_SHARE = 1 / 12  # of the spectrum, from its upper end, is left to the coarse level below it
HOURGLASS = 1 / 12  # share of tr(G): a bilinear cell's energy beyond its centre slopes
SMALLEST = 5  # posts along the shorter side below which the level is solved directly
SERIAL_POSTS = 64 * 1024  # below it a parallel loop costs more than it saves


@dataclass
class Level:
    """One grid of the hierarchy: the operator's coefficients and the cycle's work arrays."""

    tensors: tuple[np.ndarray, np.ndarray, np.ndarray]
    curvature: np.ndarray
    hourglass: float
    mass: float
    inverse_diagonal: np.ndarray
    x: np.ndarray
    residual: np.ndarray
    step: np.ndarray
    image: np.ndarray

    @property
    def shape(self):
        """Posts of this level."""
        return self.x.shape

    def apply(self, u, out):
        """``out = A u`` without the long-wavelength term of finer levels."""
        apply_operator(u, *self.tensors, self.curvature, self.hourglass, self.mass, out)


class NormalEquations:
    """The normal operator and its V-cycle.

    Parameters
    ----------
    tensors : tuple of three float32 arrays (rows - 1, cols - 1)
        Gpp, Gpq, Gqq per squared difference.
    curvature : float32 array (3,)
        Weights of the second differences along rows, of the twist, and along columns.
    mass : float
        Weight of each post of level ``mass_level`` in the long-wavelength term.
    mass_level : int
        How often the grid is halved before the mass acts; 0 makes it act on every post.
    """

    def __init__(self, tensors, curvature, mass, mass_level):
        rows, cols = tensors[0].shape
        self.mass, self.mass_level = mass, mass_level
        self.levels = [_level((rows + 1, cols + 1), tensors, curvature, 0.0, mass, mass_level)]
        while min(self.levels[-1].shape) > SMALLEST:
            finer = self.levels[-1]
            shape = coarse_shape(finer.shape)
            coarse = tuple(np.empty((shape[0] - 1, shape[1] - 1), np.float32) for _ in range(3))
            with threads_for(finer.shape):
                for fine, half in zip(finer.tensors, coarse, strict=True):
                    coarsen_cells(fine, half)
            depth = mass_level - len(self.levels)
            weights = finer.curvature / np.float32(4)
            self.levels.append(_level(shape, coarse, weights, HOURGLASS, mass, depth))
        self._inverse = _dense_inverse(self.levels[-1])

    @property
    def shape(self):
        """Posts of the finest level."""
        return self.levels[0].shape

    def apply(self, u, out):
        """``out = A u`` with every term."""
        finest = self.levels[0]
        with threads_for(u.shape):
            finest.apply(u, out)
        depth = min(self.mass_level, len(self.levels) - 1)
        if self.mass > 0 and depth > 0:
            low = long_waves(u, depth)
            low *= np.float32(_scaled_mass(self.mass, self.mass_level - depth))
            add_long_waves(low, out, depth)

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
        level = self.levels[depth]
        if depth == len(self.levels) - 1:
            np.copyto(level.x, (self._inverse @ level.residual.ravel()).reshape(level.shape))
            return
        coarse = self.levels[depth + 1]
        with threads_for(level.shape):
            _smooth(level, starts_at_zero=True)
            restrict(level.residual, coarse.residual)
        self._cycle(depth + 1)
        with threads_for(level.shape):
            level.step[:] = 0.0
            prolong_add(coarse.x, level.step)
            level.apply(level.step, level.image)
            _take_step(level.x, level.residual, level.step, level.image, np.float32(1))
            _smooth(level, starts_at_zero=False)


@dataclass(frozen=True)
class LinearSolution:
    """How a linear solve ended.

    Attributes
    ----------
    x : float32 array (rows, cols)
    iterations : int
        V-cycles, one per iteration.
    reduction : float
        Energy norm of the preconditioned residual against its start.
    """

    x: np.ndarray
    iterations: int
    reduction: float


def conjugate_gradients(equations, right_hand_side, tolerance, max_iterations):
    """Solve ``A x = right_hand_side`` from zero.

    Parameters
    ----------
    equations : NormalEquations
    right_hand_side : float32 array (rows, cols)
    tolerance : float
        Reduction of sqrt(residual . preconditioned residual) to stop at.
    max_iterations : int

    Returns
    -------
    solution : LinearSolution
    """
    residual = right_hand_side.copy()
    x = np.zeros_like(residual)
    preconditioned = equations.precondition(residual)
    direction = preconditioned.copy()
    image = np.empty_like(residual)
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
        preconditioned = equations.precondition(residual)
        last, energy = energy, dot(residual, preconditioned)
        if not energy > tolerance**2 * start:
            break
        with threads_for(x.shape):
            _redirect(direction, preconditioned, np.float32(max(energy - overlap, 0.0) / last))
    return LinearSolution(x, iterations, float(np.sqrt(max(energy, 0.0) / start)))


def long_waves(u, depth):
    """The long wavelengths of ``u``: ``depth`` times restricted, weights normalised to one.

    Parameters
    ----------
    u : float32 array (rows, cols)
    depth : int, at least 1

    Returns
    -------
    low : float32 array, the shape of ``u`` halved ``depth`` times
    """
    for _ in range(depth):
        low = np.empty(coarse_shape(u.shape), np.float32)
        with threads_for(u.shape):
            restrict(u, low)
        low *= np.float32(0.25)  # the nine weights of `restrict` sum to four
        u = low
    return u


def add_long_waves(low, out, depth):
    """Add the transpose of `long_waves` applied to ``low``."""
    shapes = [out.shape]
    for _ in range(depth):
        shapes.append(coarse_shape(shapes[-1]))
    for shape in shapes[-2:0:-1]:
        finer = np.zeros(shape, np.float32)
        with threads_for(shape):
            prolong_add(low, finer)
        finer *= np.float32(0.25)
        low = finer
    low = low * np.float32(0.25)
    with threads_for(out.shape):
        prolong_add(low, out)


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


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _row_dot(a, b):
    total = 0.0
    for c in range(a.size):
        total += np.float64(a[c]) * np.float64(b[c])
    return total


def _level(shape, tensors, curvature, hourglass, mass, depth):
    """Coefficients and work arrays of a grid that lies ``depth`` levels above the mass."""
    own_mass = _scaled_mass(mass, depth) if depth <= 0 else 0.0
    level = Level(
        tensors,
        curvature.astype(np.float32),
        np.float32(hourglass),
        np.float32(own_mass),
        *(np.zeros(shape, np.float32) for _ in range(5)),
    )
    with threads_for(shape):
        inverse_diagonal(
            *tensors, level.curvature, level.hourglass, level.mass, level.inverse_diagonal
        )
    return level


def _scaled_mass(mass, depth):
    """The mass of a post of a grid that lies ``-depth`` levels below the one it was given for."""
    return mass * 4.0 ** (-depth)


def _dense_inverse(level):
    count = level.x.size
    matrix = np.empty((count, count))
    probe = np.zeros(level.shape, np.float32)
    with threads_for(level.shape):
        for k in range(count):
            probe.ravel()[k] = 1.0
            level.apply(probe, level.image)
            matrix[k] = level.image.ravel()
            probe.ravel()[k] = 0.0
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    # float32 coefficients know eigenvalues to 1e-6 of the largest: less is the null space
    keep = values > 1e-6 * max(values[-1], 0.0)
    inverse = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T
    return inverse.astype(np.float32)


def _smooth(level, starts_at_zero):
    """Chebyshev iteration on the upper spectrum; updates ``x`` and ``residual`` of the level."""
    upper = LARGEST_EIGENVALUE
    middle, half = upper * (1 + SMOOTHED_SHARE) / 2, upper * (1 - SMOOTHED_SHARE) / 2
    sigma = middle / half
    rho = 1.0 / sigma
    if starts_at_zero:
        level.x[:] = 0.0
    keep, scale = 0.0, 1.0 / middle
    for _ in range(SMOOTHING_STEPS):
        _chebyshev_direction(
            level.step, level.residual, level.inverse_diagonal, np.float32(keep), np.float32(scale)
        )
        level.apply(level.step, level.image)
        _take_step(level.x, level.residual, level.step, level.image, np.float32(1))
        next_rho = 1.0 / (2.0 * sigma - rho)
        keep, scale, rho = next_rho * rho, 2.0 * next_rho / half, next_rho


@njit(cache=True, parallel=True, fastmath={"contract", "nsz"})
def _chebyshev_direction(step, residual, inverse_diagonal, keep, scale):
    for i in prange(step.shape[0]):
        s, r, d = step[i], residual[i], inverse_diagonal[i]
        if keep == np.float32(0.0):
            for c in range(s.size):
                s[c] = scale * d[c] * r[c]
        else:
            for c in range(s.size):
                s[c] = keep * s[c] + scale * d[c] * r[c]


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
