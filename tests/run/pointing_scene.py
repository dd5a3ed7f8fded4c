"""Raw images with known cameras, on simulated terrain, and the cameras as a user has them."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lommel.core.reflectance import reflectance_model
from lommel.io.raster import resample, write_raster
from lommel.run.raw_images import RawImage, Terrain
from lommel.scene.body import MOON, local_frame, to_xyz
from lommel.scene.camera import FrameCamera
from lommel.scene.geometry import unit
from lommel.scene.grid import grid_from_bounds, read_crs
from lommel.simulate.imaging import build_surface, lit_share, reflected
from lommel.simulate.projection import camera_image
from lommel.simulate.settings import STRIP, SceneSettings

ALTITUDE = 110_000.0  # m
PIXELS = 272
GSD = 60.0  # m
MARGIN = 80  # posts of ground around the image, for offsets
SPACING = 80.0  # m, of the posts


@dataclass(eq=False)
class PointingScene:
    """Ground, DEM file and true camera.

    Attributes
    ----------
    surface : Surface
    sun : array (3,), m
    camera : FrameCamera
        The true one.
    dem : Path
    """

    surface: object
    sun: np.ndarray
    camera: FrameCamera
    dem: object

    @property
    def terrain(self):
        return Terrain((self.dem,))

    @cached_property
    def brightness(self):
        light = lit_share(self.surface, self.sun)
        model = reflectance_model("lunar-lambert")
        return reflected(self.surface, light, self.sun, self.camera.position, model)

    def write_image(self, path, camera=None, noise=0.01, seed=0):
        """Take the image with a true camera; returned with it."""
        camera = camera or self.camera
        image = camera_image(self.surface, self.brightness, camera).astype(np.float32)
        random = np.random.default_rng(seed)
        image *= 1 + noise * random.standard_normal(image.shape).astype(np.float32)
        write_pixels(path, image)
        return RawImage(path, camera, None)


def write_pixels(path, image):
    """A raster of an image; the place that a GeoTIFF has to have is nobody's."""
    crs = read_crs(f"+proj=eqc +R={MOON.radius} +units=m +type=crs")
    lines, samples = image.shape
    grid = grid_from_bounds((0, 0, samples, lines), 1.0, crs)
    write_raster(path, image, grid, "brightness")


def make_scene(
    folder, seed=1, sun_elevation=30.0, sun_azimuth=100.0, dem_spacing=SPACING, tilt=5.0
):
    """A scene; angles in degrees, ``dem_spacing`` in m."""
    posts = int(PIXELS * GSD / SPACING) + 2 * MARGIN
    settings = SceneSettings(
        seed=seed,
        grid=replace(STRIP.grid, rows=posts, cols=posts, spacing=SPACING, east=1000.0 * seed),
        craters=(),
    )
    surface = build_surface(settings, 0)
    centre = surface.grid.lonlat_at((posts - 1) / 2, (posts - 1) / 2)
    east, north, up = local_frame(*centre)
    ground = to_xyz(MOON, *centre, float(surface.heights.mean()))
    elevation, azimuth = np.radians(sun_elevation), np.radians(sun_azimuth)
    horizontal = np.sin(azimuth) * east + np.cos(azimuth) * north
    sun = ground + 1.5e11 * (np.cos(elevation) * horizontal + np.sin(elevation) * up)
    position = ground + ALTITUDE * up - ALTITUDE * np.tan(np.radians(tilt)) * east
    camera = FrameCamera(
        position=position,
        rotation=look_at(position, ground, north),
        focal_length=np.linalg.norm(position - ground) / GSD,
        principal_point=(PIXELS / 2, PIXELS / 2),
        shape=(PIXELS, PIXELS),
        sun_position=sun,
    )
    dem = folder / "dem.tif"
    write_dem(dem, surface, dem_spacing)
    return PointingScene(surface, sun, camera, dem)


def look_at(position, ground, heading):
    """Rotation of a camera that looks at a place."""
    down = unit(ground - position)
    along = unit(heading - (heading @ down) * down)
    return np.stack([along, np.cross(down, along), down])


def write_dem(path, surface, spacing):
    grid = grid_from_bounds(surface.grid.bounds, spacing, surface.grid.crs)
    heights = surface.heights.astype(np.float32)
    write_raster(path, resample(heights, surface.grid, grid), grid, "height", "m")


def mispointed(camera, offset, direction, turn=0.0):
    """The camera as a user has it: ground ``offset`` m away, direction and twist in rad."""
    angle = offset / ALTITUDE
    rotation = [angle * np.cos(direction), angle * np.sin(direction), turn]
    return camera.adjusted(rotation, np.zeros(3))


def placement_errors(registered, truth, surface):
    """Distance in the image between where a camera puts ground and where it is, px."""
    xyz = surface.grid.xyz(surface.heights)[::10, ::10]
    line, sample = truth.project(xyz)
    seen = truth.contains(line, sample)
    found = registered.project(xyz[seen])
    return np.hypot(found[0] - line[seen], found[1] - sample[seen])
