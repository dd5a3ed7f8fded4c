r"""Long waves across the parts of a large scene.

Parts that are solved for themselves agree in all that a part can see; what goes over several of
them is left to chance: each may be tilted a little against the others, as its exposure allows. So
each part also tells, on the posts of a coarse grid, by how much it changed the surface, which
gradient :math:`g` of the whole cost is left there, how stiff its cells are, and how all that hangs
together with the exposures :math:`T`, which no part can tell as well as the whole (`Remainder`).
From that follows one Gauss-Newton step for the whole scene, on coarse posts but with what the
images show at full resolution: with the blended change :math:`c` and the changes :math:`c_t` of
the parts

.. math:: A s + B\, \delta T &= -\sum_t P_t \left( g_t + A_t (c - c_t) \right) \\
          B^T s + F\, \delta T &= -\sum_t \left( g_{T,t} + B_t^T (c - c_t) \right)

where :math:`P_t` keeps the posts that belong to part t, :math:`B` and :math:`F` are the second
derivatives by exposure and height, and by exposures; the exposures, which are few, are eliminated.
Most callers want `remainder` and `settle`.
"""

from dataclasses import dataclass, replace

import numpy as np

from lommel.core.multigrid import (
    NormalEquations,
    add_long_waves,
    coarse_masses,
    conjugate_gradients,
    dot,
    threads_for,
)
from lommel.core.normal_operator import (
    apply_operator,
    coarse_shape,
    coarsen_cells,
    restrict,
    slope_adjoint,
)
from lommel.core.plane import plane_between, remove_plane
from lommel.estimate.problem import coarse_posts
from lommel.scene.grid import Window

REDUCTION = 1e-2  # of the linear residual: a hundredth of a step of some centimetres
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
    coupling : float32 array (images, rows, cols)
        Second derivatives of half the cost by exposure and coarse post, on what belongs to the
        part; of no images where exposures are known.
    exposure_gradient : array (images,)
    exposure_stiffness : array (images, images)
        First and second derivatives by the exposures, on what belongs to the part.
    """

    tensors: np.ndarray
    gradient: np.ndarray
    change: np.ndarray
    curvature: np.ndarray
    masses: np.ndarray
    coupling: np.ndarray
    exposure_gradient: np.ndarray
    exposure_stiffness: np.ndarray

    def pull(self, change):
        """``A change`` on the posts of the part."""
        out = np.empty_like(change)
        none = np.zeros((1, change.shape[1]), np.float32)
        with threads_for(change.shape):
            apply_operator(change, *self.tensors, self.curvature, np.float32(0), none, out)
        add_long_waves(change, self.masses, out)
        return out


def remainder(level, here, u, own, stride, free=True):
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
    stride : int
        Posts per coarse post, a power of two.
    free : bool
        Whether exposures may still change.

    Returns
    -------
    left : Remainder
    """
    halvings = stride.bit_length() - 1
    tensors, change = list(here.tensors), u - level.initial
    gradient = _restricted(here.gradient, own, halvings)
    for _ in range(halvings):
        rows, cols = coarse_shape(change.shape)
        cells = [np.empty((rows - 1, cols - 1), np.float32) for _ in tensors]
        with threads_for(change.shape):
            for fine, coarse in zip(tensors, cells, strict=True):
                coarsen_cells(fine, coarse)
        tensors, change = cells, coarse_posts(change)
    return Remainder(
        np.stack(tensors),
        gradient,
        change,
        level.curvature / np.float32(4**halvings),
        coarse_masses(level.masses, halvings),
        *(_exposures(level, u, own, halvings) if free else _no_exposures(change.shape)),
    )


def _restricted(posts, own, halvings):
    """Sums over the posts that belong to a part, by the weights of bilinear interpolation."""
    kept = np.zeros_like(posts)
    kept[own] = posts[own]
    for _ in range(halvings):
        finer, kept = kept, np.empty(coarse_shape(kept.shape), np.float32)
        with threads_for(finer.shape):
            restrict(finer, kept)
    return kept


def _no_exposures(shape):
    return np.empty((0, *shape), np.float32), np.empty(0), np.empty((0, 0))


def _exposures(level, u, own, halvings):
    """Derivatives of half the cost by the exposures; see `Remainder`.

    Where each cell's albedo is eliminated, it is so from these as well.
    """
    count = len(level.views)
    cells = tuple(
        slice(s.start, min(s.stop, n)) for s, n in zip(own, level.albedo.shape, strict=True)
    )
    singles = [_by_albedo(level.single_image(k), u) for k in range(count)]
    signals = [level.albedo / np.float32(exposure) for exposure in level.exposures]
    inverse = slope = total = None
    if level.frees_albedo:
        precision = np.float32(level.stride**2 / level.albedo_error**2)
        total = sum(single[:2] for single in singles)
        inverse = 1 / (sum(single[2] for single in singles) + precision)
        slope = sum(single[3] for single in singles) + precision * (level.albedo - 1)
    coupling, gradient, stiffness = [], np.empty(count), np.empty((count, count))
    for k, (by_col, by_row, stiff, pull) in enumerate(singles):
        across = stiff * signals[k]  # by this exposure and the albedo
        fluxes = [by_col * signals[k], by_row * signals[k]]
        if inverse is None:
            stiffness[k] = 0.0
            stiffness[k, k] = _sum(across * signals[k], cells)
            gradient[k] = _sum(pull * signals[k], cells)
        else:
            share = across * inverse
            fluxes = [flux - own_flux * share for flux, own_flux in zip(fluxes, total, strict=True)]
            gradient[k] = _sum(pull * signals[k] - share * slope, cells)
            for j, single in enumerate(singles):
                stiffness[k, j] = -_sum(share * single[2] * signals[j], cells)
            stiffness[k, k] += _sum(across * signals[k], cells)
        at_posts = np.empty_like(u)
        with threads_for(u.shape):
            slope_adjoint(*fluxes, at_posts)
        coupling.append(_restricted(at_posts, own, halvings))
    return np.stack(coupling), gradient, stiffness


def _by_albedo(single, u):
    """What ties a cell's albedo to its slopes and to itself, and its gradient, for one image."""
    single = replace(single, albedo_error=0.0, couples_albedo=True)
    single.assemble(u)
    return single.coupling


def _sum(values, cells):
    return float(values[cells].sum(dtype=float))


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
    images : list of int
        Its images among those of the scene.
    """

    left: Remainder
    place: Window
    own: Window
    share: np.ndarray
    images: list


class _Settling(NormalEquations):
    """The normal operator of the whole scene with the exposures eliminated."""

    def __init__(self, parts, tensors, images):
        left = parts[0].left
        super().__init__(tensors, left.curvature, left.masses)
        self.parts = [part for part in parts if len(part.left.coupling)]
        stiffness = np.zeros((images, images))
        for part in self.parts:
            stiffness[np.ix_(part.images, part.images)] += part.left.exposure_stiffness
        # exposures without data, and a scale that an albedo takes up entirely, stay as they are
        self.exposures_for = np.linalg.pinv(stiffness, rcond=1e-9, hermitian=True)

    def pull_on_exposures(self, change):
        """``B^T change``, array (images,)."""
        pulls = np.zeros(len(self.exposures_for))
        for part in self.parts:
            here = change[part.place.slices]
            pulls[part.images] += [dot(coupling, here) for coupling in part.left.coupling]
        return pulls

    def add_exposures(self, exposures, out):
        """``out += B exposures``."""
        for part in self.parts:
            for coupling, k in zip(part.left.coupling, part.images, strict=True):
                out[part.place.slices] += coupling * np.float32(exposures[k])

    def apply(self, u, out):
        """``out = A u``, less what exposures take over."""
        super().apply(u, out)
        self.add_exposures(-self.exposures_for @ self.pull_on_exposures(u), out)


def _limited(step, curvature):
    """The step less its mean, nowhere larger than heights change from post to post by roughness.

    On steep ground that is nearly dark parts may disagree by more than a linear step can tell: it
    went tens of metres astray there, where all others are of decimetres.
    """
    most, step = np.float32(curvature**-0.5), step - step.mean(dtype=float).astype(np.float32)
    return step / np.sqrt(1 + (step / most) ** 2)


def settle(parts, shape, images, keeps_plane, stride, posts):
    """What is to be added to the blended parts.

    Parameters
    ----------
    parts : list of Part
    shape : tuple of int
        Coarse posts of the scene.
    images : int
        Of the scene.
    keeps_plane : bool
        The mean plane of the initial surface, which exposures that are free cannot tell.
    stride : int
        Posts of the scene per coarse post.
    posts : tuple of int
        Of the scene.

    Returns
    -------
    correction : float32 array (coarse rows, coarse cols), m
    exposures : array (images,)
        To be added to those that all parts had in common.
    """
    change, gradient = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for part in parts:
        change[part.place.slices] += part.share * part.left.change
    if not parts:
        return change, np.zeros(images)
    settled = change.copy()
    if keeps_plane:
        with threads_for(shape):
            remove_plane(settled)
    tensors = np.zeros((3, shape[0] - 1, shape[1] - 1), np.float32)
    on_exposures = np.zeros(images)
    for part in parts:
        left, place = part.left, part.place
        off = settled[place.slices] - left.change
        gradient[place.slices] += left.gradient
        gradient[part.own.slices] += left.pull(off)[part.own.relative_to(place).slices]
        cells = part.own.intersection(Window(0, 0, shape[0] - 1, shape[1] - 1))
        tensors[:, *cells.slices] = left.tensors[:, *cells.relative_to(place).slices]
        if len(left.coupling):
            on_exposures[part.images] += left.exposure_gradient
            on_exposures[part.images] += [dot(coupling, off) for coupling in left.coupling]
    equations = _Settling(parts, tuple(tensors), images)
    equations.add_exposures(-equations.exposures_for @ on_exposures, gradient)
    step = conjugate_gradients(equations, -gradient, REDUCTION, MOST_CYCLES, keeps_plane).x
    step = _limited(step, parts[0].left.curvature[0] * stride**2)
    exposures = -equations.exposures_for @ (on_exposures + equations.pull_on_exposures(step))
    # images tell no mean height, and where parts meet, coarse posts do not balance quite
    if not keeps_plane:
        return settled - change + step - step.mean(), exposures
    settled += step
    settled -= plane_between(settled, stride, posts).astype(np.float32)
    return settled - change, exposures
