"""Scenes with a known answer, in the files that `lommel sfs` reads.

A folder holds ``truth_dem.tif``, ``init_dem.tif``, the images ``img1.tif`` ... with their cameras
``img1.tsai`` ... (Ames Stereo Pipeline's pinhole format), ``sun_positions.txt`` and, where it
varies, ``truth_albedo.tif``. Terrain and image formation share no code with the package. Most
callers want `Scene` and `make_scene`.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from rasterio.errors import NotGeoreferencedWarning
from scipy import fft

from benchmarks.imaging import facet_brightness, pinhole_image
from benchmarks.terrain import add_craters, blur, fractal

RADIUS = 1_737_400.0  # m
LONGITUDE, LATITUDE = np.radians(12.4), np.radians(-18.7)  # of the map's origin
DATUM = -1400.0  # m; mean height of the ground
FINENESS = 2  # vertices per post
MARGIN = 24  # posts of terrain around the DEM, at least
FOCAL_LENGTH = 11_000.0  # px: 10 m pixels from 110 km
ALTITUDE = 110_000.0  # m above the ground
SUN_DISTANCE = 1.496e11  # m
# azimuth and elevation of the Suns; azimuth and off-nadir angle of the camera seen from the ground
SUNS_DEG = ((62.0, 34.0), (298.0, 40.0), (171.0, 37.0), (17.0, 46.0))
CAMERAS_DEG = ((140.0, 6.0), (310.0, 9.0), (35.0, 3.0), (230.0, 11.0))


@dataclass(frozen=True)
class Scene:
    """What a scene is made from.

    Attributes
    ----------
    posts : int
        Along each side of the DEM.
    images : int
        As many as there are Suns and cameras, at most.
    seed : int
    spacing : float, m
    hurst : float
        Of the fractal part of the relief.
    slope_deg : float
        Root mean square slope of the fractal part from post to post.
    outer_scale : float, m
        Longer waves grow no further.
    finest_detail : float, posts
        Standard deviation of a Gaussian that smooths the ground. Below one half the ground is so
        rough within a post that no DEM of that spacing explains the image to its noise.
    crater_coverage : float
        Share of the area that craters of each octave of diameter cover.
    albedo_contrast : float
        Standard deviation of the albedo, whose mean is 1.
    exposure : float
    noise : float
        Standard error of a pixel, as a share of the mean brightness.
    initial_blur : float, posts
        Of the initial DEM against the true one.
    initial_noise : float, m
    suns_deg, cameras_deg : tuple of (float, float)
        Azimuth and elevation of the Suns; azimuth and off-nadir angle of the cameras.
    """

    posts: int = 500
    images: int = 1
    seed: int = 1
    spacing: float = 10.0
    hurst: float = 0.85
    slope_deg: float = 8.0
    outer_scale: float = 8000.0
    finest_detail: float = 0.7
    crater_coverage: float = 0.03
    albedo_contrast: float = 0.0
    exposure: float = 100.0
    noise: float = 0.005
    initial_blur: float = 6.0
    initial_noise: float = 1.0
    suns_deg: tuple = SUNS_DEG
    cameras_deg: tuple = CAMERAS_DEG


def make_scene(scene, folder):
    """Write the files of a scene.

    Parameters
    ----------
    scene : Scene
    folder : path
        Made when it does not exist.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(scene.seed)
    heights = relief(scene, rng)
    first = (heights.shape[0] - FINENESS * scene.posts) // (2 * FINENESS)  # post of the DEM's edge
    inside = slice(first, first + scene.posts)
    posts = heights[::FINENESS, ::FINENESS]
    _write(folder / "truth_dem.tif", posts[inside, inside], scene.spacing)
    initial = blur(posts, scene.initial_blur)[inside, inside]
    initial += np.float32(scene.initial_noise) * rng.standard_normal(initial.shape, np.float32)
    _write(folder / "init_dem.tif", initial, scene.spacing)
    albedo = np.ones((1, 1), np.float32)
    if scene.albedo_contrast > 0:
        albedo = _albedo(scene, rng, heights.shape)
        cells = sum(
            albedo[row::FINENESS, col::FINENESS]
            for row in range(FINENESS)
            for col in range(FINENESS)
        )
        within = slice(first, first + scene.posts - 1)
        _write(folder / "truth_albedo.tif", cells[within, within] / FINENESS**2, scene.spacing)
    # the DEM's posts are the centres of its pixels, and its middle is the map's origin
    half = 0.5 * scene.spacing * (scene.posts - 1) + first * scene.spacing
    ground = (np.array([-half, half]), scene.spacing / FINENESS, RADIUS)
    _take_images(scene, rng, heights, albedo, ground, folder)


def relief(scene, rng):
    """Heights of a periodic lattice of vertices, float32 array, m above the sphere."""
    size = FINENESS * fft.next_fast_len(scene.posts + 2 * MARGIN, real=True)
    heights = fractal(rng, (size, size), scene.hurst, FINENESS * scene.outer_scale / scene.spacing)
    rise = np.diff(heights[:: FINENESS * 7, ::FINENESS], axis=1).std(dtype=float)
    # two components make a slope
    slope = np.tan(np.radians(scene.slope_deg)) / np.sqrt(2)
    heights *= np.float32(slope * scene.spacing / rise)
    largest = min(150, scene.posts / 4) * scene.spacing
    fine = scene.spacing / FINENESS
    add_craters(rng, heights, fine, largest, 4 * scene.spacing, scene.crater_coverage)
    heights = blur(heights, FINENESS * scene.finest_detail)
    heights += np.float32(DATUM - heights.mean(dtype=float))
    return heights


def _albedo(scene, rng, shape):
    """Smooth swells and sharp-edged blotches, in equal parts; float32 array, mean 1."""
    smooth = fractal(rng, shape, 1.5, 400.0)
    blotches = np.tanh(4 * fractal(rng, shape, 1.0, 120.0))
    albedo = smooth / smooth.std(dtype=float) + blotches / blotches.std(dtype=float)
    albedo *= np.float32(scene.albedo_contrast / albedo.std(dtype=float))
    return albedo + np.float32(1 - albedo.mean(dtype=float))


def _take_images(scene, rng, heights, albedo, ground, folder):
    origin, spacing, radius = ground
    samples = int(1.04 * scene.posts) + 16
    brightness = np.empty_like(heights)
    image = np.empty((samples, samples), np.float32)
    suns = []
    for number in range(1, scene.images + 1):
        sun = SUN_DISTANCE * direction(*scene.suns_deg[number - 1])
        camera, axes = pinhole(*scene.cameras_deg[number - 1])
        facet_brightness(heights, albedo, origin, spacing, radius, sun, camera, brightness)
        place = origin, spacing, radius, camera, axes, FOCAL_LENGTH
        pinhole_image(heights, brightness, *place, image, 0, samples)
        image *= np.float32(scene.exposure)
        sigma = np.float32(scene.noise * image.mean(dtype=float))
        image += sigma * rng.standard_normal(image.shape, np.float32)
        _write(folder / f"img{number}.tif", image)
        text = tsai_text(to_body(camera), to_body(axes), samples)
        (folder / f"img{number}.tsai").write_text(text)
        suns.append(f"img{number}.tif " + " ".join(f"{v:.6f}" for v in to_body(sun)))
    (folder / "sun_positions.txt").write_text("\n".join(suns) + "\n")


def direction(azimuth_deg, elevation_deg):
    """Unit vector east, north, up."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    flat = np.cos(elevation)
    return np.array([flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation)])


def pinhole(azimuth_deg, off_nadir_deg):
    """Place of a camera and its axes when it looks at the map's origin, samples to the east."""
    target = np.array([0.0, 0.0, RADIUS + DATUM])
    back = direction(azimuth_deg, 90.0 - off_nadir_deg)
    camera = target + ALTITUDE / back[2] * back
    along_lines = np.cross(-back, [1.0, 0.0, 0.0])
    along_lines /= np.linalg.norm(along_lines)
    return camera, np.stack([np.cross(along_lines, -back), along_lines, -back])


def to_body(vectors):
    """From the axes of the map's origin to body-fixed ones; vectors on the last axis."""
    sin_lon, cos_lon = np.sin(LONGITUDE), np.cos(LONGITUDE)
    sin_lat, cos_lat = np.sin(LATITUDE), np.cos(LATITUDE)
    east = [-sin_lon, cos_lon, 0.0]
    north = [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    up = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
    return vectors @ np.array([east, north, up])


def tsai_text(centre, axes, samples):
    """Text of a camera file; its pixels count from 0 at the centre of the first one."""
    pitch = 76.0 / FOCAL_LENGTH
    middle = pitch * (samples / 2 - 0.5)
    numbers = {"C": centre, "R": axes.T.ravel()}
    rows = [
        "VERSION_4",
        "PINHOLE",
        "fu = 76.0",
        "fv = 76.0",
        f"cu = {middle!r}",
        f"cv = {middle!r}",
        "u_direction = 1 0 0",
        "v_direction = 0 1 0",
        "w_direction = 0 0 1",
        *(f"{key} = " + " ".join(repr(float(v)) for v in value) for key, value in numbers.items()),
        f"pitch = {pitch!r}",
        "NULL",
    ]
    return "\n".join(rows) + "\n"


def map_profile(shape, spacing, dtype="float32"):
    """What rasterio needs to write a raster on the stereographic map whose middle is the origin.

    Parameters
    ----------
    shape : tuple of int
    spacing : float, m, or None
        None for an image as it was taken.
    dtype : str
    """
    rows, cols = shape
    profile = {"driver": "GTiff", "height": rows, "width": cols, "count": 1, "dtype": dtype}
    if spacing is None:
        return profile
    crs = (
        f"+proj=stere +lat_0={np.degrees(LATITUDE):.12g} +lon_0={np.degrees(LONGITUDE):.12g} "
        f"+k=1 +R={RADIUS:.12g} +units=m +no_defs"
    )
    top, left = 0.5 * spacing * rows, -0.5 * spacing * cols
    return profile | {"crs": crs, "transform": Affine(spacing, 0, left, 0, -spacing, top)}


def _write(path, values, spacing=None):
    with warnings.catch_warnings():  # raw images have no place on a map
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", **map_profile(values.shape, spacing)) as file:
            file.write(values, 1)
