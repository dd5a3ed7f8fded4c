r"""The two parametrisations of the surface, as one.

A point of the surface is :math:`P = B + u d`: a base point, and the unknown ``u`` times a
direction. The photoclinometry paper has two choices (its equations 4 and 5):

``height``
    `d` is the local vertical, so ``u`` is the height above the base.
``ray``
    `d` points along the view ray of a camera, scaled so that its vertical part is one: ``u`` is
    again a height in metres, and every prior keeps its meaning, but the point slides along the
    ray and keeps its place in that camera's image.

The base is the reference sphere raised to a constant height; on a grid with posts (row, col) the
tangents of a cell follow from its slopes :math:`p = \partial_{col} u / s_{col}` and
:math:`q = \partial_{row} u / s_{row}`, and so does the normal, which is affine in them:

.. math:: n \propto t_{row} \times t_{col} = c_0 + p\, c_1 + q\, c_2, \quad
          c_0 = a_{row} \times a_{col},\; c_1 = a_{row} \times d,\; c_2 = d \times a_{col}

with :math:`a = (\partial B + u\, \partial d) / s`. The vectors `c` vary slowly, so they are
computed on a lattice of nodes and interpolated in between. Most callers want `Surface`.
"""

from dataclasses import dataclass

import numpy as np

from lommel.scene.body import to_xyz, up_vector
from lommel.scene.geometry import unit
from lommel.scene.grid import Grid

LATTICE_STEP = 64  # posts between nodes at most: what the compiled passes keep in fast memory
# Directions to a camera at distance r bend by (step / r)^2 / 8 between nodes; 0.006 keeps that
# below 5e-6 rad, far under the 1e-3 that image noise allows.
LATTICE_ANGLE = 0.006
# Fixed-point steps from rays back to posts: each leaves the share tan(slope) tan(e) of the error,
# little where one looks down, most of it where one looks along slopes from aside.
RAY_STEPS, RAY_ERROR = 12, 1e-3  # at most; m, the change that ends them
# Posts that they do not settle see ground that hides other ground: there the ray is walked down,
RAY_STRIDE, HALVINGS = 0.5, 16  # posts at a time, and halved so often


@dataclass(frozen=True)
class Lattice:
    """Nodes on which slowly varying geometry is computed.

    Attributes
    ----------
    step : int
        Cells from node to node, on the level the lattice serves.
    row, col : array (node_rows, 1) and (1, node_cols)
        Places of the nodes in posts of the finest grid.
    stride : int
        Posts of the finest grid per post of this level.
    """

    step: int
    row: np.ndarray
    col: np.ndarray
    stride: int


@dataclass(frozen=True)
class Frame:
    """What the parametrisation supplies at the nodes.

    Attributes
    ----------
    xyz : array (node_rows, node_cols, 3), m
        Points of the surface at the nodes.
    up : array (node_rows, node_cols, 3)
    c : array (3, node_rows, node_cols, 3)
        The vectors c0, c1, c2 of the normal.
    gram : array (6, node_rows, node_cols)
        c0.c0, c0.c1, c0.c2, c1.c1, c1.c2, c2.c2.
    drift : array (2, node_rows, node_cols), posts per m
        How far (row, col) the point moves on the grid per metre of ``u``.
    """

    xyz: np.ndarray
    up: np.ndarray
    c: np.ndarray
    gram: np.ndarray
    drift: np.ndarray


@dataclass(frozen=True)
class Surface:
    """A parametrisation over a grid.

    Attributes
    ----------
    grid : Grid
    base_height : float, m
        Height of the base points; ``u`` counts from it.
    camera_position : array (3,), m, or None
        Perspective centre of the rays; None for heights.
    """

    grid: Grid
    base_height: float
    camera_position: np.ndarray | None = None

    def lattice(self, shape, stride, distance):
        """Nodes that cover a level of ``shape`` posts, dense enough for cameras at a distance.

        Parameters
        ----------
        shape : tuple of int
        stride : int
        distance : float, m
            To the nearest camera.
        """
        spacing = max(self.grid.spacing) * stride
        step = int(np.clip(LATTICE_ANGLE * distance / spacing, 1, LATTICE_STEP))
        row, col = (np.arange(-(-(size - 1) // step) + 1) * float(step * stride) for size in shape)
        return Lattice(step, row[:, None], col[None, :], stride)

    def frame(self, lattice, u):
        """Points, normal vectors and drift at the nodes of a lattice.

        Parameters
        ----------
        lattice : Lattice
        u : array (node_rows, node_cols), m

        Returns
        -------
        frame : Frame
        """
        base, direction, up = self._line(lattice.row, lattice.col)
        a_row, a_col = self._tangents(lattice, u)
        c = np.stack(
            [np.cross(a_row, a_col), np.cross(a_row, direction), np.cross(direction, a_col)]
        )
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        gram = np.stack([_inner(c[i], c[j]) for i, j in pairs])
        drift = self.posts_crossed(lattice, u, direction - up)
        return Frame(base + u[..., None] * direction, up, c, gram, drift)

    def points(self, lattice, u):
        """Points of the surface at the nodes, array (node_rows, node_cols, 3), m."""
        base, direction, _ = self._line(lattice.row, lattice.col)
        return base + u[..., None] * direction

    def posts_crossed(self, lattice, u, lateral):
        """Posts (row, col) of the finest grid that horizontal vectors at the nodes cross.

        Parameters
        ----------
        lattice : Lattice
        u : array (node_rows, node_cols), m
        lateral : array (node_rows, node_cols, 3), m

        Returns
        -------
        posts : array (2, node_rows, node_cols)
        """
        a_row, a_col = self._tangents(lattice, u)
        rr, rc, cc = _inner(a_row, a_row), _inner(a_row, a_col), _inner(a_col, a_col)
        r, c = _inner(a_row, lateral), _inner(a_col, lateral)
        posts = np.stack([cc * r - rc * c, rr * c - rc * r]) / (rr * cc - rc * rc)
        return posts / np.array(self.grid.spacing)[:, None, None]

    def heights_from_posts(self, u):
        """Heights on the grid of a surface whose unknowns are given at the posts.

        With rays the points stand beside their posts; the height above each post is found by
        walking back along the drift.

        Parameters
        ----------
        u : array (rows, cols), m

        Returns
        -------
        heights : float32 array (rows, cols), m above the reference body
        """
        if self.camera_position is None:
            return (u + np.float32(self.base_height)).astype(np.float32)
        return (self._slide(u, -1.0) + self.base_height).astype(np.float32)

    def posts_from_heights(self, heights):
        """Unknowns at the posts of a surface given by heights; inverse of `heights_from_posts`."""
        u = np.asarray(heights, np.float32) - np.float32(self.base_height)
        return u if self.camera_position is None else self._slide(u, 1.0)

    def _slide(self, field, sign):
        """Solve ``v(x) = field(x + sign drift v(x))`` or its inverse by fixed-point steps."""
        from scipy.ndimage import map_coordinates, spline_filter  # slow to import

        rows, cols = field.shape
        lattice = self.lattice(field.shape, 1, np.linalg.norm(self.camera_position) / 20)
        drift = self.frame(lattice, np.zeros((lattice.row.size, lattice.col.size))).drift
        places = np.mgrid[0:rows, 0:cols].astype(np.float32)
        drift = np.stack([map_coordinates(d, places / lattice.step, order=1) for d in drift])
        values = np.asarray(field, np.float32)
        coefficients = spline_filter(field, 3, np.float32, "nearest")
        drift *= np.float32(sign)

        def at(places):
            return map_coordinates(coefficients, places, order=3, mode="nearest", prefilter=False)

        for _ in range(RAY_STEPS):
            last, values = values, at(places + drift * values)
            is_open = np.abs(values - last) > RAY_ERROR
            if not is_open.any():
                return values
        values[is_open] = _highest(at, places[:, is_open], drift[:, is_open], field)
        return values

    def _tangents(self, lattice, u):
        """Tangents along rows' and columns' index at constant u, per nominal metre."""
        half = lattice.stride / 2
        tangents = []
        for axis, spacing in enumerate(self.grid.spacing):
            dr, dc = (half, 0.0) if axis == 0 else (0.0, half)
            ahead, behind = (
                self._line(lattice.row + sign * dr, lattice.col + sign * dc) for sign in (1, -1)
            )
            change = ahead[0] - behind[0] + u[..., None] * (ahead[1] - behind[1])
            tangents.append(change / (spacing * lattice.stride))
        return tangents

    def _line(self, row, col):
        """Base point, direction and vertical at fractional posts."""
        longitude, latitude = self.grid.lonlat_at(row, col)
        up = up_vector(longitude, latitude)
        base = to_xyz(self.grid.body, longitude, latitude, self.base_height)
        if self.camera_position is None:
            return base, up, up
        ray = unit(self.camera_position - base)
        return base, ray / _inner(ray, up)[..., None], up


def _highest(at, places, drift, field):
    """The highest ``v`` with ``v = at(places + drift v)``: of ground that hides other, the seen.

    Parameters
    ----------
    at : function (array (2, points)) -> array (points,), m
    places : array (2, points), posts
    drift : array (2, points), posts per m
    field : float32 array (rows, cols), m
        Whose values ``at`` interpolates.

    Returns
    -------
    values : array (points,), m
    """
    above = np.full(places.shape[1], field.max())
    step = np.float32(RAY_STRIDE) / np.linalg.norm(drift, axis=0)
    waits = np.ones(above.size, bool)
    while waits.any():  # down to the first place that lies under the surface
        below = np.maximum(above[waits] - step[waits], field.min())
        is_under = at(places[:, waits] + drift[:, waits] * below) >= below
        above[waits] = np.where(is_under, above[waits], below)
        waits[waits] = ~is_under & (below > field.min())
    below = np.maximum(above - step, field.min())
    for _ in range(HALVINGS):
        middle = (above + below) / 2
        is_under = at(places + drift * middle) >= middle
        below, above = np.where(is_under, middle, below), np.where(is_under, above, middle)
    return (above + below) / 2


def _inner(a, b):
    return np.einsum("...i,...i", a, b)
