"""Grid: the raster frame every array of a run lives on.

A grid knows its shape, its affine map from pixel to map coordinates, its CRS and the body. Posts
stand at pixel centres; row 0 is north. Pixel coordinates (row, col) here are those of posts: the
first post is (0, 0). pyproj lives in this module only. Most callers want `Grid` and `common_grid`.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from affine import Affine
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from lommel.errors import GeometryError, InputError
from lommel.scene.body import MOON, Body, to_xyz

RADIUS_TOLERANCE = 0.005  # share; the Moon's own radii (1735-1738 km) pass, no other body does
SAME_POST = 1e-3  # post spacings; grids closer than this count as one
LATTICE = 33  # points along each side that stand for a grid's area
LEAST_SPACING = 1e-3  # m, far below any image of a planet


@dataclass(frozen=True)
class Window:
    """A rectangle of posts.

    Attributes
    ----------
    row, col : int
        First post.
    rows, cols : int
        Size, at least 0.
    """

    row: int
    col: int
    rows: int
    cols: int

    @property
    def shape(self):
        """Rows and columns."""
        return self.rows, self.cols

    @property
    def slices(self):
        """Index for an array of the whole grid."""
        return slice(self.row, self.row + self.rows), slice(self.col, self.col + self.cols)

    @property
    def is_empty(self):
        """True when no post is inside."""
        return self.rows <= 0 or self.cols <= 0

    def intersection(self, other):
        """The posts inside both windows."""
        row, col = max(self.row, other.row), max(self.col, other.col)
        rows = min(self.row + self.rows, other.row + other.rows) - row
        cols = min(self.col + self.cols, other.col + other.cols) - col
        return Window(row, col, max(rows, 0), max(cols, 0))

    def parts(self, rows, cols=None):
        """Windows of so many rows and columns at most, from north to south, all columns if None."""
        cols = cols or self.cols
        for row in range(0, self.rows, rows):
            for col in range(0, self.cols, cols):
                size = min(rows, self.rows - row), min(cols, self.cols - col)
                yield Window(self.row + row, self.col + col, *size)

    def relative_to(self, other):
        """The same posts, counted from the first post of ``other``."""
        return replace(self, row=self.row - other.row, col=self.col - other.col)


@dataclass(frozen=True)
class Grid:
    """Shape, map coordinates and body of a raster.

    Attributes
    ----------
    shape : tuple of int
        Rows and columns.
    affine : Affine
        Pixel corner (col, row) to map coordinates (x, y), in CRS units.
    crs : pyproj.CRS
    body : Body
    """

    shape: tuple[int, int]
    affine: Affine
    crs: CRS
    body: Body = MOON

    @property
    def window(self):
        """The window that holds the whole grid."""
        return Window(0, 0, *self.shape)

    @property
    def is_north_up(self):
        """Whether rows run along x and columns down y."""
        a, b, _, d, e, _ = self.affine[:6]
        return a > 0 > e and b == d == 0

    @property
    def bounds(self):
        """Outer pixel edges xmin, ymin, xmax, ymax, in CRS units."""
        rows, cols = self.shape
        corners = [self.affine @ corner for corner in ((0, 0), (cols, 0), (0, rows), (cols, rows))]
        x, y = zip(*corners, strict=True)
        return min(x), min(y), max(x), max(y)

    @cached_property
    def spacing(self):
        """Distance between posts on the sphere at the grid's centre: along row and column, m."""
        middle = (np.array(self.shape) - 1) / 2
        rows = middle[0] + np.array([[-0.5, 0.0], [0.5, 0.0]])
        cols = middle[1] + np.array([[0.0, -0.5], [0.0, 0.5]])
        xyz = to_xyz(self.body, *self.lonlat_at(rows, cols), 0.0)
        chords = np.linalg.norm(xyz[1] - xyz[0], axis=-1)
        return tuple((2 * self.body.radius * np.arcsin(chords / (2 * self.body.radius))).tolist())

    def cut(self, window):
        """The part of this grid inside a window, as a grid of its own."""
        affine = self.affine @ Affine.translation(window.col, window.row)
        return replace(self, shape=window.shape, affine=affine)

    def lonlat_at(self, row, col):
        """Longitude and latitude of fractional post indices.

        Parameters
        ----------
        row, col : array (...), posts

        Returns
        -------
        longitude, latitude : array (...), rad
        """
        row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
        x, y = self.affine @ (col + 0.5, row + 0.5)
        longitude, latitude = _to_geodetic(self._wkt).transform(x, y)
        return np.radians(longitude), np.radians(latitude)

    def index_at(self, longitude, latitude):
        """Fractional post indices of points; the inverse of `lonlat_at`.

        Parameters
        ----------
        longitude, latitude : array (...), rad

        Returns
        -------
        row, col : array (...), posts. NaN where the projection does not reach.
        """
        longitude = np.degrees(np.asarray(longitude, float))
        latitude = np.degrees(np.asarray(latitude, float))
        transformer = _to_geodetic(self._wkt)
        x, y = transformer.transform(longitude, latitude, direction="INVERSE")
        reached = np.isfinite(x) & np.isfinite(y)
        col, row = ~self.affine @ (np.where(reached, x, np.nan), np.where(reached, y, np.nan))
        if self.crs.is_geographic:  # the same meridian may be written 360 degrees away
            turn = 360.0 / self.affine.a
            col = col - turn * np.round((col - self.shape[1] / 2) / turn)
        return row - 0.5, col - 0.5

    def lonlat(self):
        """Longitude and latitude of every post, two arrays (rows, cols), rad."""
        return self.lonlat_at(*np.indices(self.shape, sparse=True))

    def xyz(self, heights):
        """Body-fixed positions of the posts at the given heights.

        Parameters
        ----------
        heights : array (rows, cols) or float, m

        Returns
        -------
        xyz : array (rows, cols, 3), m
        """
        return to_xyz(self.body, *self.lonlat(), heights)

    def outline(self):
        """Points that span the grid's area: a lattice out to its edges, and the poles inside it.

        Returns
        -------
        longitude, latitude : array (n,), rad; not finite where the projection does not reach
        """
        return self._outline

    @cached_property
    def _wkt(self):
        return self.crs.to_wkt()  # which pyproj puts together anew each time

    @cached_property
    def _outline(self):
        rows, cols = self.shape
        share = np.linspace(0.0, 1.0, LATTICE)
        lattice = np.stack(self.lonlat_at(share[:, None] * rows - 0.5, share * cols - 0.5))
        points = [lattice.reshape(2, -1)]
        poles = np.array([-np.pi / 2, np.pi / 2])
        for pole, row, col in zip(poles, *self.index_at(np.zeros(2), poles), strict=True):
            if abs(row - (rows - 1) / 2) <= rows / 2 and abs(col - (cols - 1) / 2) <= cols / 2:
                longitude = np.linspace(-np.pi, np.pi, LATTICE)
                points.append(np.stack([longitude, np.full(LATTICE, pole)]))
        return tuple(np.concatenate(points, axis=1))

    def footprint(self, other):
        """The window of ``other`` that this grid's area touches; empty when apart."""
        place = self.place_in(other)
        if place is not None:
            return place
        there = np.stack(other.index_at(*self.outline()))
        there = there[:, np.isfinite(there).all(axis=0)]
        if there.size == 0:
            return Window(0, 0, 0, 0)
        there = np.clip(there, -1, np.array(other.shape)[:, None] + 1)  # far away may overflow
        first = np.floor(there.min(axis=1) + 0.5 + SAME_POST).astype(int)
        size = np.ceil(there.max(axis=1) - 0.5 - SAME_POST).astype(int) - first + 1
        return Window(*first.tolist(), *size.tolist()).intersection(other.window)

    def offset_in(self, other):
        """Row and column of ``other`` at which the first post stands, when all stand at its posts.

        Told by the CRS as it is written and by the affine maps, without a projection.

        Returns
        -------
        offset : (row, col) of int, or None
            Also beside ``other``; None where posts of both do not coincide.
        """
        if self._wkt != other._wkt:
            return None
        rows, cols = self.shape
        ends = np.array([0.5, cols - 0.5, 0.5]), np.array([0.5, 0.5, rows - 0.5])  # three corners
        col, row = ~other.affine @ (self.affine @ ends)
        first = round(row[0] - 0.5), round(col[0] - 0.5)
        away = row - 0.5 - first[0] - [0, 0, rows - 1], col - 0.5 - first[1] - [0, cols - 1, 0]
        return first if np.abs(away).max() < SAME_POST else None

    def place_in(self, other):
        """The window of ``other`` that has the same posts as this grid; None where none has."""
        offset = self.offset_in(other)
        window = None if offset is None else Window(*offset, *self.shape)
        return window if window and window.intersection(other.window) == window else None

    def is_same(self, other):
        """True when both grids have their posts at the same places."""
        if self.shape != other.shape:
            return False
        corners = np.array([0.0, self.shape[0] - 1]), np.array([0.0, self.shape[1] - 1])
        there = other.index_at(*self.lonlat_at(*corners))
        return all(
            np.allclose(a, b, rtol=0, atol=SAME_POST) for a, b in zip(corners, there, strict=True)
        )


@lru_cache(maxsize=64)  # parsing takes milliseconds, and thousands of images share one CRS
def _parse_crs(text):
    crs = CRS.from_user_input(text)
    has_body = crs.ellipsoid is not None and crs.geodetic_crs is not None
    return crs, crs.ellipsoid.semi_major_metre if has_body else None


@lru_cache(maxsize=64)
def _to_geodetic(wkt):
    crs = CRS.from_wkt(wkt)
    return Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)


def read_crs(text, body=MOON, source="CRS"):
    """A CRS from WKT, PROJ text or an authority code, checked to be one of the body.

    Parameters
    ----------
    text : str
        For example ``IAU_2015:30100`` or a WKT.
    body : Body
    source : str
        Whose CRS this is, for the message.

    Returns
    -------
    crs : pyproj.CRS
    """
    try:
        crs, radius = _parse_crs(text)
    except CRSError as error:
        raise InputError(
            f"{source}: {str(text)[:80]!r} is not a CRS. Give WKT, PROJ text or an authority code "
            "such as IAU_2015:30100."
        ) from error
    if radius is None:
        raise InputError(
            f"{source}: the CRS {crs.name!r} has no reference body. Assign a {body.name} CRS, "
            "for example with gdal_edit.py -a_srs IAU_2015:30100."
        )
    if abs(radius / body.radius - 1) > RADIUS_TOLERANCE:
        raise InputError(
            f"{source}: the CRS {crs.name!r} has a radius of {radius / 1e3:.1f} km, "
            f"the {body.name} has {body.radius / 1e3:.1f} km. Use rasters of one body."
        )
    return crs


def grid_from_bounds(bounds, spacing, crs, body=MOON):
    """A north-up grid that covers bounds at a spacing in metres.

    Parameters
    ----------
    bounds : tuple of float
        xmin, ymin, xmax, ymax in CRS units; widened to whole posts.
    spacing : float, m
    crs : pyproj.CRS
    body : Body

    Returns
    -------
    grid : Grid
    """
    xmin, ymin, xmax, ymax = bounds
    if not (np.isfinite(bounds).all() and xmax > xmin and ymax > ymin):
        raise InputError(
            f"bounds = {xmin:g} {ymin:g} {xmax:g} {ymax:g} are empty or not finite. "
            "Give xmin ymin xmax ymax with xmin < xmax and ymin < ymax, in units of the CRS."
        )
    if not LEAST_SPACING <= spacing < np.inf:
        raise InputError(
            f"spacing = {spacing} is not a post spacing. Give metres, {LEAST_SPACING:g} or more."
        )
    step = spacing / metres_per_unit(crs, body)
    first_col, last_row = np.floor(xmin / step + 1e-6), np.floor(ymin / step + 1e-6)
    cols = int(np.ceil(xmax / step - 1e-6) - first_col)
    rows = int(np.ceil(ymax / step - 1e-6) - last_row)
    affine = Affine(step, 0.0, first_col * step, 0.0, -step, (last_row + rows) * step)
    return Grid((max(rows, 1), max(cols, 1)), affine, crs, body)


def metres_per_unit(crs, body=MOON):
    """Metres per CRS unit along a meridian: 1 for metres, about 30323 for lunar degrees."""
    factor = crs.axis_info[0].unit_conversion_factor
    return factor * body.radius if crs.is_geographic else factor


def bounds_in(grid, crs):
    """Bounds of a grid in another CRS: xmin, ymin, xmax, ymax, in that CRS's units."""
    points = _to_geodetic(crs.to_wkt()).transform(*np.degrees(grid.outline()), direction="INVERSE")
    there = np.stack(points)
    there = there[:, np.isfinite(there).all(axis=0)]
    if there.size == 0:
        raise GeometryError(f"The CRS {crs.name!r} does not reach the raster's area.")
    return *there.min(axis=1).tolist(), *there.max(axis=1).tolist()
