"""Projections and rays per second, for each lens and kind of camera.

The points lie in random order over the whole image, which is the worst case for the search of a
line. Most callers want `rates`.
"""

from dataclasses import dataclass

import numba
import numpy as np

from benchmarks.triad import fastest
from lommel.scene.body import MOON, to_xyz
from lommel.scene.camera import FrameCamera, nadir_rotation
from lommel.scene.distortion import Distortion
from lommel.scene.grid import grid_from_bounds, read_crs
from lommel.scene.intersection import meet_sphere, meet_terrain
from lommel.scene.line_scan import LineScanCamera
from lommel.scene.motion import Pointing, Trajectory

POINTS = 1_000_000
LENSES = {  # as in the instrument kernels of Apollo 15, LRO and Kaguya; the radtan lens is made up
    "none": None,
    "radial": Distortion("radial", (0.0, -1.34e-6, 5.2e-10)),
    "brown-conrady": Distortion(
        "brown-conrady", (-0.006, -0.002, -1.34e-6, 5.23e-10, -5.07e-14, -5.5e-7, -4.6e-11, 2.97)
    ),
    "radtan": Distortion("radtan", (-0.12, 0.05, 1e-3, -2e-3, 0.01), unit=76.054),
    "lrolrocnac": Distortion("lrolrocnac", (1.81e-5,)),
    "kaguyalism": Distortion(
        "kaguyalism",
        (
            -0.0725,
            -9.65e-4,
            9.84e-4,
            8.58e-6,
            -3.74e-6,
            0.0214,
            -1.38e-3,
            1.35e-5,
            2.73e-6,
            -6.2e-6,
        ),
    ),
}
FRAME_LENSES = ("none", "radial", "brown-conrady", "radtan")
LINE_SCAN_LENSES = ("none", "lrolrocnac", "kaguyalism")
LINE_PERIOD = 1e-3  # s


@dataclass(frozen=True)
class Rate:
    """How often something is done in a second, on one core and on all.

    Attributes
    ----------
    name : str
    one_core, all_cores : float, 1/s
    worst : float
        Largest difference after going there and back, px for cameras.
    """

    name: str
    one_core: float
    all_cores: float
    worst: float


def rates():
    """Rates of projection, rays and intersections, one after the other."""
    cameras = {f"frame, {name}": _frame(LENSES[name]) for name in FRAME_LENSES}
    cameras |= {f"line scan, {name}": _line_scan(LENSES[name]) for name in LINE_SCAN_LENSES}
    for name, camera in cameras.items():
        yield from _there_and_back(name, camera)
    yield from _intersections(cameras["frame, none"])


def _there_and_back(name, camera):
    pixels = np.random.default_rng(0).uniform(0, 1, (2, POINTS)) * np.c_[camera.shape].T
    ground = meet_sphere(camera.origin(*pixels), camera.ray(*pixels), MOON.radius)
    worst = np.abs(np.subtract(camera.project(ground), pixels)).max()
    yield _rate(f"{name}: project", lambda: camera.project(ground), POINTS, worst)
    yield _rate(f"{name}: ray", lambda: camera.ray(*pixels), POINTS, worst)


def _rate(name, function, count, worst):
    threads = numba.get_num_threads()
    seconds = {}
    for used in (1, threads):
        numba.set_num_threads(used)
        seconds[used] = fastest(function)
    return Rate(name, count / seconds[1], count / seconds[threads], worst)


def _intersections(camera):
    count = POINTS // 10
    pixels = np.random.default_rng(1).uniform(10e3, 13e3, (2, count))
    rays, origin = camera.ray(*pixels), camera.origin(*pixels)
    crs = read_crs("+proj=stere +lat_0=-11.5 +lon_0=17.2 +R=1737400 +units=m")
    grid = grid_from_bounds((-40e3, -40e3, 40e3, 40e3), 60.0, crs)
    row, col = np.indices(grid.shape)
    heights = 500.0 * np.sin(row / 30.0) * np.cos(col / 20.0)
    for name, meet in {
        "ray meets sphere": lambda: meet_sphere(origin, rays, MOON.radius),
        "ray meets terrain": lambda: meet_terrain(origin, rays, grid, heights),
    }.items():
        worst = np.abs(np.subtract(camera.project(meet()), pixels)).max()
        yield _rate(name, meet, count, worst)


def _frame(distortion):
    """Apollo's Metric camera, looking down."""
    position = to_xyz(MOON, 0.3, -0.2, 110e3)
    rotation = nadir_rotation(position, np.array([0.1, 0.9, 0.2]))
    shape, axes = (22900, 22900), ((0.0, 200.0), (200.0, 0.0))
    centre = (11450.0, 11450.0)
    return FrameCamera(position, rotation, 76.054, centre, shape, distortion, to_pixels=axes)


def _line_scan(distortion):
    """LRO's narrow-angle camera, whole length, with a jittering pointing table."""
    shape = (52224, 5064)
    times = np.linspace(-1.0, shape[0] * LINE_PERIOD + 1.0, 801)
    angle, radius, rate = 0.3 + 9.2e-4 * times, MOON.radius + 50e3, 9.2e-4
    level = np.zeros_like(angle)
    positions = radius * np.stack([np.cos(angle), level, np.sin(angle)], axis=-1)
    velocities = radius * rate * np.stack([-np.sin(angle), level, np.cos(angle)], axis=-1)
    heading = velocities + radius * rate * 2e-5 * np.sin(5 * times)[:, None] * [0.0, 1.0, 0.0]
    poses = zip(positions, heading, strict=True)
    return LineScanCamera(
        Trajectory(times, positions, velocities),
        Pointing(times, np.stack([nadir_rotation(*pose) for pose in poses])),
        np.array([[0.0, 0.0, LINE_PERIOD]]),
        699.62,
        (0.0, 2548.0),
        shape,
        distortion,
        to_pixels=((142.857, 0.0), (0.0, 142.857)),
    )
