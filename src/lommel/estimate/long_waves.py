r"""Long waves across the parts of a large scene.

Parts that are solved for themselves agree in all that a part can see; what goes over several of
them is left to chance: each may be tilted a little against the others, as its exposure allows. So
each part also tells, on the posts of a coarse grid, by how much it changed the surface, which
gradient :math:`g` of the whole cost is left there, and how stiff its cells are (`Remainder`). From
that follows one Gauss-Newton step for the whole scene, on coarse posts but with what the images
show at full resolution: with the blended change :math:`c` and the changes :math:`c_t` of the parts

.. math:: A s = -\sum_t P_t \left( g_t + A_t (c - c_t) \right)

where :math:`P_t` keeps the posts that belong to part t. Most callers want `remainder` and
`settle`.
"""

from dataclasses import dataclass

import numpy as np

from lommel.core.multigrid import (
    NormalEquations,
    add_long_waves,
    coarse_masses,
    conjugate_gradients,
    threads_for,
)
from lommel.core.normal_operator import apply_operator, coarse_shape, coarsen_cells, restrict
from lommel.estimate.problem import coarse_posts
from lommel.scene.grid import Window

REDUCTION = 1e-3  # of the linear residual: a thousandth of a step that is itself small
MOST_CYCLES = 60


@dataclass(frozen=True)
class Remainder:
    """What a part leaves to the whole scene, on its coarse posts.

    Attributes
    ----------
    tensors : float32 array (3, rows - 1, cols - 1)
        Of the normal operator, means over the fine cells.
    gradient : float32 array (rows, cols)
        Of half the cost at the part's solution: sums over the fine posts that belong to the part,
        by the weights of bilinear interpolation.
    change : float32 array (rows, cols), m
        Of the surface against the initial one, averaged.
    curvature : float32 array (3,)
    masses : array (depth,)
        Weights of the priors on the coarse posts.
    """

    tensors: np.ndarray
    gradient: np.ndarray
    change: np.ndarray
    curvature: np.ndarray
    masses: np.ndarray

    def pull(self, change):
        """``A change`` on the posts of the part."""
        out = np.empty_like(change)
        none = np.zeros((1, change.shape[1]), np.float32)
        with threads_for(change.shape):
            apply_operator(change, *self.tensors, self.curvature, np.float32(0), none, out)
        add_long_waves(change, self.masses, out)
        return out


def remainder(level, here, u, own, halvings):
    """What a part leaves to the whole scene.

    Parameters
    ----------
    level : Problem
        Of the part, on the finest grid.
    here : Quadratic
        Around its solution; what holds its rim does not count.
    u : float32 array (rows, cols), m
        Its solution.
    own : tuple of slice
        Posts that belong to it.
    halvings : int
        From the finest to the coarse posts.

    Returns
    -------
    left : Remainder
    """
    gradient = np.zeros_like(here.gradient)
    gradient[own] = here.gradient[own]
    tensors, change = list(here.tensors), u - level.initial
    for _ in range(halvings):
        shape = coarse_shape(gradient.shape)
        finer, gradient = gradient, np.empty(shape, np.float32)
        with threads_for(finer.shape):
            restrict(finer, gradient)
        cells = [np.empty((shape[0] - 1, shape[1] - 1), np.float32) for _ in tensors]
        for fine, coarse in zip(tensors, cells, strict=True):
            coarsen_cells(fine, coarse)
        tensors, change = cells, coarse_posts(change)
    return Remainder(
        np.stack(tensors),
        gradient,
        change,
        level.curvature / np.float32(4**halvings),
        coarse_masses(level.masses, halvings),
    )


@dataclass(frozen=True)
class Part:
    """A part of the scene, on the coarse posts.

    Attributes
    ----------
    left : Remainder
    place : Window
        Its posts among those of the scene.
    own : Window
        Those that belong to it and to no other part.
    share : float32 array (rows, cols)
        Of it in the blend of all parts.
    """

    left: Remainder
    place: Window
    own: Window
    share: np.ndarray


def settle(parts, shape, keeps_plane):
    """What is to be added to the blended parts.

    Parameters
    ----------
    parts : list of Part
    shape : tuple of int
        Coarse posts of the scene.
    keeps_plane : bool
        The mean plane of the initial surface, which exposures that are free cannot tell.

    Returns
    -------
    correction : float32 array (coarse rows, coarse cols), m
    """
    change, gradient = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for part in parts:
        change[part.place.slices] += part.share * part.left.change
    if not parts:
        return change
    settled = without_tilt(change) if keeps_plane else change
    tensors = np.zeros((3, shape[0] - 1, shape[1] - 1), np.float32)
    for part in parts:
        left, place = part.left, part.place
        gradient[place.slices] += left.gradient
        pull = left.pull(settled[place.slices] - left.change)
        gradient[part.own.slices] += pull[part.own.relative_to(place).slices]
        cells = part.own.intersection(Window(0, 0, shape[0] - 1, shape[1] - 1))
        tensors[:, *cells.slices] = left.tensors[:, *cells.relative_to(place).slices]
    equations = NormalEquations(tuple(tensors), left.curvature, left.masses)
    step = conjugate_gradients(equations, -gradient, REDUCTION, MOST_CYCLES).x
    # images tell no mean height, and where parts meet, coarse posts do not balance quite
    return settled - change + (without_tilt(step) if keeps_plane else step - step.mean())


def without_tilt(change):
    """A change of the surface without its mean and its mean tilt.

    An exposure and the tilt of the whole surface towards the Sun do the same to an image: what
    tells them apart is the initial DEM, whose mean plane is kept.

    Parameters
    ----------
    change : float32 array (rows, cols), m

    Returns
    -------
    change : float32 array (rows, cols), m
    """
    row, col = (np.linspace(-1.0, 1.0, size) for size in change.shape)
    by_row, by_col = change.mean(axis=1, dtype=float), change.mean(axis=0, dtype=float)
    along_rows = by_row.mean() + (row @ by_row) / (row @ row) * row
    along_cols = (col @ by_col) / (col @ col) * col
    return change - along_rows.astype(np.float32)[:, None] - along_cols.astype(np.float32)[None, :]
