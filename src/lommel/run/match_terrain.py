"""A raw image against the terrain as its Sun and camera should show it.

The DEM is rendered on a local map (reflectance, cast shadow) and the image brought onto the same
map with its camera. Most callers want `find_site` and `terrain_pair`.
"""

from dataclasses import dataclass

import numpy as np

from lommel.core.reflectance import ReflectanceModel
from lommel.errors import InputError
from lommel.run.raw_images import RawImage, Terrain, seen_bounds, show_pixels, view_window
from lommel.scene.body import to_lonlat
from lommel.scene.grid import Window, grid_from_bounds, read_crs

DEM_OVERSAMPLING = 4.0  # posts of the map per post of a DEM coarser than the image
DEM_WAVELENGTH = 2.0  # DEM posts; shorter waves it does not hold


@dataclass(frozen=True, eq=False)
class Site:
    """Where an image is registered.

    Attributes
    ----------
    terrain : Terrain
    model : ReflectanceModel
    centre : tuple of float, rad
        Longitude and latitude of the map's origin.
    extremes : tuple of float, m
        Lowest and highest terrain.
    gsd : float, m
        Of the image.
    """

    terrain: Terrain
    model: ReflectanceModel
    centre: tuple[float, float]
    extremes: tuple[float, float]
    gsd: float

    @property
    def relief(self):
        """Highest minus lowest terrain, m."""
        return self.extremes[1] - self.extremes[0]

    @property
    def finest_spacing(self):
        """Post spacing of the finest map worth matching on, m."""
        return max(self.gsd, self.terrain.spacing / DEM_OVERSAMPLING)

    def shortest(self, spacing):
        """Shortest wavelength that the DEM holds, in posts of a map of that spacing."""
        return DEM_WAVELENGTH * self.terrain.spacing / spacing

    def grid(self, images, spacing):
        """The local map of what all of some images see of the DEM."""
        longitude, latitude = np.degrees(self.centre)
        body = self.terrain.body
        crs = read_crs(
            f"+proj=stere +lat_0={latitude:.6f} +lon_0={longitude:.6f} +R={body.radius} "
            "+units=m +type=crs",
            body,
        )
        seen = np.array([seen_bounds(image, crs, self.terrain, self.extremes) for image in images])
        bounds = *seen[:, :2].max(axis=0).tolist(), *seen[:, 2:].min(axis=0).tolist()
        return grid_from_bounds(bounds, spacing, crs, body)


def find_site(image: RawImage, terrain: Terrain, model: ReflectanceModel):
    """Where an image is registered, from its camera as it is.

    Parameters
    ----------
    image : RawImage
    terrain : Terrain
    model : ReflectanceModel

    Returns
    -------
    site : Site
    """
    if image.sun is None:
        raise InputError(
            f"{image.name}: nothing tells where the Sun stood. Name a table of lines KEY x y z "
            "with --sun-positions."
        )
    ground = image.ground(0.0, terrain.body)
    longitude, latitude, _ = to_lonlat(terrain.body, ground.mean(axis=0))
    centre = float(longitude), float(latitude)
    flat = Site(terrain, model, centre, (0.0, 0.0), image.gsd(0.0, terrain.body))
    extremes = terrain.extremes(flat.grid([image], terrain.spacing))
    gsd = image.gsd(float(np.mean(extremes)), terrain.body)
    if not np.isfinite(gsd):  # the middle of the image looks past the body
        raise InputError(
            f"{image.name}: the middle of the image looks past the {terrain.body.name}. Crop it "
            "to the ground."
        )
    return Site(terrain, model, centre, extremes, gsd)


def terrain_pair(image, site, grid):
    """Image and rendered terrain as a picture pair of `lommel.run.map_matching`.

    Parameters
    ----------
    image : RawImage
    site : Site
    grid : Grid

    Returns
    -------
    pair : function (Window, reach) -> (measured, rendered, heights)
    """

    def pair(window, reach):
        wide = widen(window, reach)
        tile, heights = view_window(image, grid, wide, site.terrain, site.relief)
        angles = tile.geometry
        rendered = site.model.reflectance(angles.cos_incidence, angles.cos_emission, angles.phase)
        rendered = np.where(np.isfinite(angles.cos_incidence), rendered * tile.is_lit, np.nan)
        inside = window.relative_to(wide).slices
        return show_pixels(image, tile)[inside], rendered, heights[inside]

    return pair


def image_pair(first, second, site, grid):
    """Two images of the same ground as a picture pair.

    Parameters
    ----------
    first, second : RawImage
    site : Site
    grid : Grid

    Returns
    -------
    pair : function (Window, reach) -> (first, second, heights)
    """

    def pair(window, reach):
        tile, heights = view_window(first, grid, window, site.terrain, site.relief)
        other, _ = view_window(second, grid, widen(window, reach), site.terrain, site.relief)
        return show_pixels(first, tile), show_pixels(second, other), heights

    return pair


def widen(window, reach):
    """A window with a rim."""
    return Window(
        window.row - reach, window.col - reach, window.rows + 2 * reach, window.cols + 2 * reach
    )
