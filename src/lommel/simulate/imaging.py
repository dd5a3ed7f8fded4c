"""Images of the ground: light on facets finer than the posts, averaged over each post's area.

Each post stands for a square of ground. The square is cut into facets between vertices of a finer
lattice; every facet reflects light by its own normal, albedo and shadow, and image values are
means over facets. The estimators see posts only, so simulated data do not share their
discretisation. `lommel.simulate.projection` says which facets an image shows where.
Most callers want `build_surface` and `reflected`.
"""

from dataclasses import dataclass, replace

import numpy as np
from affine import Affine

from lommel.scene.body import MOON
from lommel.scene.geometry import unit, viewing_geometry
from lommel.scene.grid import Grid, Window, read_crs
from lommel.scene.shadows import sunlit
from lommel.simulate.terrain import ground


@dataclass(frozen=True)
class Surface:
    """Terrain as facets.

    Attributes
    ----------
    grid : Grid
        The posts.
    oversampling : int
        Facets per post along each axis.
    vertex_grid : Grid
        The facets' corners, ``oversampling * posts + 1`` along each axis.
    vertices : array (vertex rows, vertex cols), m
        Heights of the corners.
    facets : array (facet rows, facet cols, 3), m
        Body-fixed centres.
    normals : array (facet rows, facet cols, 3), dimensionless
    albedo : array (facet rows, facet cols), dimensionless
    """

    grid: Grid
    oversampling: int
    vertex_grid: Grid
    vertices: np.ndarray
    facets: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray

    @property
    def heights(self):
        """Heights of the posts, m."""
        half = self.oversampling // 2
        return self.vertices[half :: self.oversampling, half :: self.oversampling].copy()

    def facets_of(self, window):
        """Index of the facets that belong to a window of posts."""
        numbers = (self.oversampling * n for n in (window.row, window.col, *window.shape))
        return Window(*numbers).slices

    def cut(self, window):
        """The part of this surface that belongs to a window of posts."""
        part, grid = self.facets_of(window), self.grid.cut(window)
        corners = tuple(slice(side.start, side.stop + 1) for side in part)
        return Surface(
            grid,
            self.oversampling,
            vertex_lattice(grid, self.oversampling),
            self.vertices[corners],
            self.facets[part],
            self.normals[part],
            self.albedo[part],
        )

    def mean(self, values):
        """Means over the facets of each post, array (rows, cols)."""
        factor = self.oversampling
        rows, cols = values.shape[0] // factor, values.shape[1] // factor
        return values.reshape(rows, factor, cols, factor).mean(axis=(1, 3))


def map_grid(settings, margin=0):
    """The grid of a scene, widened by some posts on each side.

    Parameters
    ----------
    settings : GridSettings
    margin : int, posts

    Returns
    -------
    grid : Grid
    """
    crs = read_crs(
        f"+proj=eqc +lat_ts={settings.latitude_deg} +lon_0={settings.longitude_deg} "
        f"+R={MOON.radius} +units=m +type=crs"
    )
    rows, cols = settings.rows + 2 * margin, settings.cols + 2 * margin
    left = np.round(settings.east / settings.spacing - 0.5 * cols)
    top = np.round((map_north(settings) + settings.north) / settings.spacing + 0.5 * rows)
    affine = Affine.scale(settings.spacing, -settings.spacing) @ Affine.translation(left, -top)
    return Grid((rows, cols), affine, crs, MOON)


def map_north(settings):
    """Northing of the map's origin, m."""
    return np.radians(settings.latitude_deg) * MOON.radius


def place_on_map(grid, settings):
    """Distances of a grid's columns and rows from the map's origin.

    Parameters
    ----------
    grid : Grid
    settings : GridSettings

    Returns
    -------
    x : array (cols,), m, east
    y : array (rows,), m, north
    """
    x, _ = grid.affine @ (np.arange(grid.shape[1]) + 0.5, 0.5)
    _, y = grid.affine @ (0.5, np.arange(grid.shape[0]) + 0.5)
    return x, y - map_north(settings)


def build_surface(settings, margin):
    """The facets of a scene's ground.

    Parameters
    ----------
    settings : SceneSettings
    margin : int, posts
        Ground around the scene's grid, which casts shadow into it.

    Returns
    -------
    surface : Surface
    """
    grid, factor = map_grid(settings.grid, margin), settings.oversampling
    vertex_grid = vertex_lattice(grid, factor)
    vertices, albedo = ground(settings, *place_on_map(vertex_grid, settings.grid))
    return facet_surface(grid, factor, vertices, albedo)


def facet_surface(grid, oversampling, vertices, albedo):
    """Facets between given vertices.

    Parameters
    ----------
    grid : Grid
        The posts.
    oversampling : int
    vertices : array (vertex rows, vertex cols), m
        Heights on ``vertex_lattice(grid, oversampling)``.
    albedo : array (vertex rows, vertex cols), dimensionless

    Returns
    -------
    surface : Surface
    """
    vertex_grid = vertex_lattice(grid, oversampling)
    xyz = vertex_grid.xyz(vertices)
    falling = xyz[1:, 1:] - xyz[:-1, :-1]
    rising = xyz[:-1, 1:] - xyz[1:, :-1]
    normals = unit(np.cross(falling, rising))
    centres = _corner_mean(xyz)
    return Surface(
        grid, oversampling, vertex_grid, vertices, centres, normals, _corner_mean(albedo)
    )


def vertex_lattice(grid, oversampling):
    """The grid of facet corners: the first lies on the outer corner of the first post's square."""
    shape = tuple(oversampling * posts + 1 for posts in grid.shape)
    finer = Affine.scale(1.0 / oversampling) @ Affine.translation(-0.5, -0.5)
    return replace(grid, shape=shape, affine=grid.affine @ finer)


def _corner_mean(values):
    return 0.25 * (values[:-1, :-1] + values[:-1, 1:] + values[1:, :-1] + values[1:, 1:])


def lit_share(surface, sun_position):
    """Share of each facet's corners that the Sun reaches over the terrain around.

    Parameters
    ----------
    surface : Surface
    sun_position : array (3,), m, body-fixed

    Returns
    -------
    share : array (facet rows, facet cols), 0 to 1
    """
    is_lit = sunlit(surface.vertex_grid, surface.vertices, sun_position)
    return _corner_mean(is_lit.astype(np.float64))


def reflected(surface, lit, sun_position, spacecraft_position, model):
    """Albedo times reflectance of each facet.

    Parameters
    ----------
    surface : Surface
    lit : array (facet rows, facet cols), 0 to 1
        From `lit_share`.
    sun_position, spacecraft_position : array (3,), m, body-fixed
    model : ReflectanceModel

    Returns
    -------
    brightness : array (facet rows, facet cols), dimensionless
    """
    geometry = viewing_geometry(surface.facets, surface.normals, sun_position, spacecraft_position)
    reflectance = model.reflectance(geometry.cos_incidence, geometry.cos_emission, geometry.phase)
    return surface.albedo * lit * reflectance


def seen_window(camera, xyz):
    """Posts that a camera sees: the window around them, and which of its posts they are.

    Parameters
    ----------
    camera : Camera
    xyz : array (rows, cols, 3), m, body-fixed

    Returns
    -------
    window : Window
        Empty when the camera sees none.
    is_seen : bool array (window.rows, window.cols)
    """
    is_seen = camera.contains(*camera.project(xyz))
    rows, cols = np.flatnonzero(is_seen.any(axis=1)), np.flatnonzero(is_seen.any(axis=0))
    if rows.size == 0:
        return Window(0, 0, 0, 0), np.zeros((0, 0), bool)
    window = Window(
        int(rows[0]), int(cols[0]), int(rows[-1] - rows[0] + 1), int(cols[-1] - cols[0] + 1)
    )
    return window, is_seen[window.slices]


def record(brightness, exposure, haze, film, random):
    """Image values: exposed, noisy, clipped and rounded as the film's bits say.

    Parameters
    ----------
    brightness : array (...), dimensionless
        Albedo times reflectance.
    exposure, haze : float, image units
    film : FilmSettings
    random : numpy.random.Generator

    Returns
    -------
    measured : float32 array (...), image units
    """
    clean = exposure * brightness + haze
    noise = film.noise * np.sqrt(np.maximum(clean, 0.0) * film.exposure)
    measured = clean + noise * random.standard_normal(brightness.shape)
    if film.bits == 8:
        measured = np.clip(np.rint(measured), 0, 255)
    return measured.astype(np.float32)
