"""Albedo of a whole orbit: a strip of overlapping frames of any size, made and solved.

    python -m benchmarks.strip --frames 40 --size 2500 --folder /tmp/strip

The cameras are those of `lommel simulate` (Apollo's Metric camera at 110 km, 75 % overlap); the
ground is fractal relief and albedo made of two periodic fields, so that it needs no memory; images
have 8 bits, noise, and exposures that differ by 30 %. The DEM lacks the finest relief. Prints the
seconds, the peak memory, the passes and the errors of the exposures. Where the Sun stands high,
images of long exposure clip on most of their ground, where it stands low, they lie in shadow.
"""

import argparse
import csv
import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.frame import peak_of
from lommel.core.reflectance import reflectance_model
from lommel.estimate.albedo_light import TerrainPart
from lommel.io.raster import raster_writer
from lommel.scene.body import MOON, to_lonlat
from lommel.scene.grid import Window, grid_from_bounds, read_crs
from lommel.scene.intersection import meet_sphere
from lommel.simulate.orbit import footprint_half_angle, frame_cameras, sun_position
from lommel.simulate.settings import GridSettings, OrbitSettings, SunSettings

CRS = "+proj=eqc +lat_ts=8.9 +lon_0=26 +R=1737400 +units=m +no_defs"
PERIODS = 2048, 1792  # posts, of the two fields
RELIEF, CONTRAST, SWELL = 12.0, 0.08, 0.15  # posts rms; rms of log albedo, fine and along the strip
NOISE, EXPOSURE, SPREAD = 0.0075, 220.0, 0.3
METERED, LEAST_COSINE = 110.0, 0.05  # mean brightness that an exposure control aims at; of the Sun
ROWS = 256  # of images made at once


class Ground:
    """Relief and albedo at any posts; ``blur`` in posts takes the finest relief away."""

    def __init__(self, spacing, seed):
        rng = np.random.default_rng(seed)
        self.fields = [_fractal(period, 1.9, 0.0, rng) for period in PERIODS]
        self.known = [_blurred(field, 1.5) for field in self.fields]
        self.albedos = [_fractal(period, 1.3, 3.0, rng) for period in PERIODS]
        self.unit = RELIEF * spacing / np.sqrt(2)

    def heights(self, rows, cols, known=False):
        """The truth, or what the DEM knows of it, float32, m."""
        return (self.unit * _tiled(self.known if known else self.fields, rows, cols)).astype("f4")

    def albedo(self, rows, cols, length):
        """Albedo; three long waves run along a strip of so many posts."""
        swell = SWELL * np.sin(6 * np.pi * np.arange(cols.start, cols.stop) / length)
        return np.exp(CONTRAST / np.sqrt(2) * _tiled(self.albedos, rows, cols) + swell)


def _fractal(period, slope, blur, rng):
    frequency = np.hypot(np.fft.fftfreq(period)[:, None], np.fft.rfftfreq(period))
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.normal(size=(period, period))) * frequency**-slope
    field = np.fft.irfft2(spectrum, (period, period))
    return _blurred(field / field.std(), blur)


def _blurred(field, blur):
    frequency = np.hypot(np.fft.fftfreq(len(field))[:, None], np.fft.rfftfreq(len(field)))
    return np.fft.irfft2(np.fft.rfft2(field) * np.exp(-2 * (np.pi * frequency * blur) ** 2))


def _tiled(fields, rows, cols):
    return sum(
        field[np.ix_(np.arange(rows.start, rows.stop) % n, np.arange(cols.start, cols.stop) % n)]
        for field, n in zip(fields, PERIODS, strict=True)
    )


def make_strip(folder, frames, size, seed, sun_longitude, metered=False):
    """Write images, DEM and position tables of a strip; returns the grid and the exposures."""
    orbit = OrbitSettings(frames=frames)
    cameras = frame_cameras(orbit, GridSettings())
    spacing = 2 * footprint_half_angle(orbit) * MOON.radius / size
    outlines = np.array([_bounds(camera) for camera in cameras])
    bounds = *outlines[:, :2].min(axis=0), *outlines[:, 2:].max(axis=0)
    grid = grid_from_bounds(bounds, spacing, read_crs(CRS))
    ground = Ground(spacing, seed)
    with raster_writer(folder / "dem.tif", grid, "height", "m") as write:
        for first in range(0, grid.shape[0], ROWS):
            rows = range(first, min(first + ROWS, grid.shape[0]))
            cols = range(grid.shape[1])
            write(ground.heights(rows, cols, True), Window(first, 0, len(rows), len(cols)))
    exposures = EXPOSURE * (1 + SPREAD * np.random.default_rng(9).uniform(-1, 1, frames))
    sun = sun_position(SunSettings(longitude_deg=sun_longitude))
    if metered:
        exposures *= [METERED / (EXPOSURE * _reflectance(camera, sun)) for camera in cameras]

    def take(k):
        window = grid_from_bounds(outlines[k], spacing, grid.crs).footprint(grid)
        _write_image(folder, k, cameras[k], sun, exposures[k], ground, grid, window)

    with ThreadPoolExecutor(2) as threads:
        list(threads.map(take, range(frames)))
    names = [f"frame{k:03d}" for k in range(frames)]
    for kind, places in (("sun", [sun] * frames), ("spacecraft", [c.position for c in cameras])):
        lines = [
            " ".join([n, *map(str, p / 1e3)]) for n, p in zip(names, np.array(places), strict=True)
        ]
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return grid, dict(zip(names, exposures, strict=True))


def _reflectance(camera, sun):
    """Of level ground below a camera."""
    up = camera.position / np.linalg.norm(camera.position)
    to_sun = sun / np.linalg.norm(sun)
    cosine = max(float(up @ to_sun), LEAST_COSINE)
    return float(reflectance_model("lunar-lambert").reflectance(cosine, 1.0, np.arccos(cosine)))


def _bounds(camera):
    share = np.linspace(0, 1, 17)
    line, sample = np.meshgrid(*(share * n for n in camera.shape), indexing="ij")
    xyz = meet_sphere(camera.origin(line, sample), camera.ray(line, sample), MOON.radius)
    own = grid_from_bounds((0, 0, 1e3, 1e3), 1e3, read_crs(CRS))
    row, col = own.index_at(*to_lonlat(MOON, xyz)[:2])
    x, y = own.affine @ (col + 0.5, row + 0.5)
    return x.min(), y.min(), x.max(), y.max()


def _write_image(folder, k, camera, sun, exposure, ground, grid, window):
    model = reflectance_model("lunar-lambert")
    random = np.random.default_rng(k)
    cut = grid.cut(window)
    cols = range(window.col, window.col + window.cols)
    path = folder / f"frame{k:03d}.tif"
    with raster_writer(path, cut, "brightness", dtype=np.uint8, nodata=0) as write:
        for first in range(0, window.rows, ROWS):
            part = Window(first, 0, min(ROWS, window.rows - first), window.cols)
            above, below = max(first - 1, 0), min(first + part.rows + 1, window.rows)
            band = cut.cut(Window(above, 0, below - above, window.cols))
            rows = range(window.row + above, window.row + below)
            here = Window(first - above, 0, part.rows, window.cols)
            terrain = TerrainPart(band, ground.heights(rows, cols), here)
            geometry = terrain.geometry(here, sun, camera.position)
            reflectance = model.reflectance(
                geometry.cos_incidence, geometry.cos_emission, geometry.phase
            )
            rows = range(window.row + first, window.row + first + part.rows)
            value = exposure * ground.albedo(rows, cols, grid.shape[1]) * reflectance
            noise = random.standard_normal(value.shape, np.float32)
            value += NOISE * np.sqrt(np.maximum(value, 0) * EXPOSURE) * noise
            line, sample = camera.project(terrain.xyz[first - above :][: part.rows])
            seen = (line > 0) & (line < camera.shape[0]) & (sample > 0) & (sample < camera.shape[1])
            value = np.clip(np.rint(np.nan_to_num(value)), 1, 255)
            write(np.where(seen, value, 0).astype(np.uint8), part)


def ensure_strip(folder, frames, size):
    """Make a metered strip unless the folder holds it."""
    if (folder / f"{frames}-{size}.made").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    make_strip(folder, frames, size, seed=5, sun_longitude=70.0, metered=True)
    (folder / f"{frames}-{size}.made").touch()


def albedo_command(folder, output):
    """``lommel albedo`` on a strip."""
    images = sorted(str(path) for path in folder.glob("frame*.tif"))
    command = [str(Path(sys.executable).parent / "lommel"), "albedo", *images, "--overwrite"]
    command += ["--dem", str(folder / "dem.tif"), "--output", str(output)]
    for kind in ("sun", "spacecraft"):
        command += [f"--{kind}-positions", str(folder / f"{kind}.txt")]
    return command


def main():
    """Make, solve, report; the folder stays for a look and is removed by hand."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--size", type=int, default=1000, help="posts along a frame")
    parser.add_argument("--seed", type=int, default=5, help="of the ground")
    parser.add_argument("--sun-longitude", type=float, default=70.0, help="deg; the strip is at 26")
    parser.add_argument(
        "--metered", action="store_true", help="exposures follow the Sun's height, so nothing clips"
    )
    parser.add_argument("--folder", type=Path, default=Path("benchmarks/output/strip"))
    parser.add_argument("options", nargs="*", help="of lommel albedo, after --")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    strip = given.frames, given.size, given.seed, given.sun_longitude, given.metered
    grid, truth = make_strip(given.folder, *strip)
    print(f"made {grid.shape} posts in {time.perf_counter() - start:.0f} s", flush=True)
    output = given.folder / "albedo"
    command = [*albedo_command(given.folder, output), *given.options]
    seconds, peak = peak_of(command)
    print(f"solved in {seconds:.0f} s, {peak / 1e9:.2f} GB of all processes")
    record = json.loads((output / "run.json").read_text(encoding="utf-8"))
    for stage in record["stages"]:
        print(f"  {stage['name']}: {stage['seconds']:.0f} s, {stage['peak_memory_mb']:.0f} MB")
    print(f"  {record['results']['passes']} passes; {record['outcome']['sentence']}")
    report_exposures(output / "exposures.csv", truth)


def exposure_errors(path, truth):
    """How far the exposures of a table are off, in their common unit.

    Parameters
    ----------
    path : Path
        The ``exposures.csv`` of a run.
    truth : dict of str to float
        Exposures of the frames by name, along the strip.

    Returns
    -------
    error : array (images), of the logarithm
        Of the images that are used, less its mean.
    drift : float
        How much it grows from one end of the strip to the other.
    groups : array (images) of int
        Images of a group share ground.
    """
    with open(path, encoding="utf-8") as file:
        table = [row for row in csv.DictReader(file) if row["used"] == "1"]
    frame = {name: k for k, name in enumerate(truth)}
    place = np.array([frame[Path(row["image"]).stem] for row in table]) / max(len(truth) - 1, 1)
    ratio = [float(row["exposure"]) / truth[Path(row["image"]).stem] for row in table]
    error = np.log(ratio) - np.mean(np.log(ratio))
    drift = float(np.polyfit(place, error, 1)[0]) if len(error) > 1 else 0.0
    return error, drift, np.array([int(row["group"]) for row in table])


def report_exposures(path, truth):
    """Print how far the exposures are off, along the strip and in groups that share ground."""
    error, drift, groups = exposure_errors(path, truth)
    print(f"  exposures: {100 * error.std():.2f} % rms, drift {100 * drift:.2f} % along the strip")
    apart = np.concatenate([error[groups == g] - error[groups == g].mean() for g in set(groups)])
    print(
        f"  {len(truth) - len(error)} of {len(truth)} images left out; {len(set(groups))} groups, "
        f"{100 * apart.std():.2f} % rms about the mean of each"
    )


if __name__ == "__main__":
    main()
