"""How long a run of thousands of images takes until it begins: footprints and choice of images.

    python -m benchmarks.many --images 4000 --folder /tmp/many

Makes orthoimages of 128 x 128 pixels spread over a DEM of 3000 x 3000 posts, each under a Sun of
its own, and plans ``lommel sfs`` with ``--dry-run``: once with all images, once with the best few
of each place. Prints wall and processor seconds of the whole command, user and system.
"""

import argparse
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from lommel.io.raster import raster_writer
from lommel.scene.body import MOON
from lommel.scene.grid import Window, grid_from_bounds, read_crs

CRS = "+proj=eqc +lat_ts=0 +lon_0=0 +R=1737400 +units=m +no_defs"
POSTS, PIXELS, SPACING = 3000, 128, 10.0  # of the DEM, of an image; m
SUN_DISTANCE, ALTITUDE = 1.496e11, 110e3  # m


def make_images(folder, count, seed=3):
    """Write DEM, images and position tables."""
    random = np.random.default_rng(seed)
    half = POSTS * SPACING / 2
    grid = grid_from_bounds((-half, -half, half, half), SPACING, read_crs(CRS))
    heights = random.normal(0, 20, grid.shape).astype("f4")
    with raster_writer(folder / "dem.tif", grid, "height", "m") as write:
        write(heights, grid.window)
    suns, crafts = [], []
    for k in range(count):
        row, col = random.integers(0, np.array(grid.shape) - PIXELS).tolist()
        window = Window(row, col, PIXELS, PIXELS)
        pixels = random.integers(40, 200, window.shape).astype(np.uint8)
        path = folder / f"image{k:05d}.tif"
        with raster_writer(path, grid.cut(window), "brightness", dtype=np.uint8, nodata=0) as write:
            write(pixels, Window(0, 0, PIXELS, PIXELS))
        azimuth, height = random.uniform(0, 2 * np.pi), random.uniform(0.3, 0.9)
        across = np.cos(height) * np.array([np.cos(azimuth), np.sin(azimuth)])
        suns.append((path.stem, SUN_DISTANCE * np.array([np.sin(height), *across])))
        crafts.append((path.stem, np.array([MOON.radius + ALTITUDE, *random.normal(0, 1e4, 2)])))
    for kind, places in (("sun", suns), ("spacecraft", crafts)):
        lines = [" ".join([name, *map(str, place / 1e3)]) for name, place in places]
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def main():
    """Make them unless they are there, plan twice."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=4000)
    parser.add_argument("--folder", type=Path, default=Path("benchmarks/output/many"))
    given = parser.parse_args()
    folder = given.folder
    folder.mkdir(parents=True, exist_ok=True)
    if len(list(folder.glob("image*.tif"))) != given.images:
        make_images(folder, given.images)
    images = sorted(str(path) for path in folder.glob("image*.tif"))
    command = [str(Path(sys.executable).parent / "lommel"), "sfs", *images]
    command += ["--dem", str(folder / "dem.tif"), "--output", str(folder / "refined"), "--dry-run"]
    for kind in ("sun", "spacecraft"):
        command += [f"--{kind}-positions", str(folder / f"{kind}.txt")]
    for what, options in (("all images", ["--all-images"]), ("chosen images", [])):
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run([*command, *options], check=True, stdout=subprocess.DEVNULL)
        seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        print(f"{what}: {seconds:.1f} s, {processor:.1f} processor seconds", flush=True)


if __name__ == "__main__":
    main()
