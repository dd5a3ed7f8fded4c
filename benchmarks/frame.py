"""Shape from shading of one whole frame, of any size: made, refined, and compared with the truth.

    python -m benchmarks.frame --posts 20000 --folder /tmp/frame -- --memory 8GB

The scene is that of `benchmarks.scenes` with one image, but its relief is the sum of two periodic
fields, so that ground and image are made some rows at a time. At 20,000 posts of 10 m the camera
sees 42 degrees to each side, as Apollo's Metric camera nearly did. Prints the seconds, the peak
memory of all processes together, the errors, and what the solution shows at borders of tiles.
"""

import argparse
import json
import resource
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import rasterio
from rasterio.windows import Window

from benchmarks.imaging import facet_brightness, pinhole_image
from benchmarks.scenes import (
    CAMERAS_DEG,
    DATUM,
    FINENESS,
    FOCAL_LENGTH,
    RADIUS,
    SUN_DISTANCE,
    SUNS_DEG,
    Scene,
    direction,
    map_profile,
    pinhole,
    relief,
    to_body,
    tsai_text,
)
from benchmarks.terrain import blur

PERIODS = 1976, 1736  # posts, of the two fields, less the margins of a scene
EXPOSURE = 20_000.0  # of 16-bit values
LINES = 1000  # of the image made at once
REACH = 1500.0  # m; height and curvature move ground by less against the lines of its map
BORDER = 128  # posts left out of the comparison
SAMPLING = 0.2  # s between looks at the memory


class Ground:
    """Heights of vertices, and of posts, anywhere."""

    def __init__(self, scene):
        rng = np.random.default_rng(scene.seed)
        kinds = [Scene(posts, 1, slope_deg=scene.slope_deg) for posts in PERIODS]
        fields = [relief(kind, rng) / np.sqrt(2) for kind in kinds]
        self.vertices = [np.float32(field - field.mean(dtype=float)) for field in fields]
        self.posts = [
            np.ascontiguousarray(field[::FINENESS, ::FINENESS]) for field in self.vertices
        ]
        self.known = [blur(field, scene.initial_blur) for field in self.posts]

    def heights(self, fields, rows, cols):
        """Sum of periodic fields on a window, float32 array, m."""
        total = np.full((len(rows), len(cols)), np.float32(DATUM))
        for field in fields:
            along = np.asarray(cols) % field.shape[1]
            for out, row in zip(total, rows, strict=True):
                out += field[row % field.shape[0]][along]
        return total


def make_frame(scene, folder):
    """Write truth, initial DEM, image, camera and the Sun's place.

    Parameters
    ----------
    scene : Scene
    folder : path
    """
    ground, posts = Ground(scene), range(scene.posts)
    rng = np.random.default_rng([scene.seed, 1])
    profile = map_profile((scene.posts, scene.posts), scene.spacing)
    with (
        rasterio.open(folder / "truth_dem.tif", "w", **profile) as truth,
        rasterio.open(folder / "init_dem.tif", "w", **profile) as initial,
    ):
        for first in range(0, scene.posts, LINES):
            rows = posts[first : first + LINES]
            window = Window(0, first, scene.posts, len(rows))
            truth.write(ground.heights(ground.posts, rows, posts), 1, window=window)
            known = ground.heights(ground.known, rows, posts)
            known += np.float32(scene.initial_noise) * rng.standard_normal(known.shape, np.float32)
            initial.write(known, 1, window=window)
    samples = int(1.04 * scene.posts) + 16
    camera, axes = pinhole(*CAMERAS_DEG[0])
    sun = SUN_DISTANCE * direction(*SUNS_DEG[0])
    (folder / "img1.tsai").write_text(tsai_text(to_body(camera), to_body(axes), samples))
    line = "img1.tif " + " ".join(f"{v:.6f}" for v in to_body(sun))
    (folder / "sun_positions.txt").write_text(line + "\n")
    shape = (samples, samples)
    with rasterio.open(folder / "img1.tif", "w", **map_profile(shape, None, "uint16")) as file:
        for first in range(0, samples, LINES):
            lines = min(LINES, samples - first)
            image = _image_lines(scene, ground, camera, axes, sun, (first, lines, samples))
            image *= np.float32(EXPOSURE)
            sigma = np.float32(scene.noise * image.mean(dtype=float))
            image += sigma * rng.standard_normal(image.shape, np.float32)
            window = Window(0, first, samples, lines)
            file.write(np.clip(np.rint(image), 1, 65534).astype(np.uint16), 1, window=window)


def _image_lines(scene, ground, camera, axes, sun, part):
    """Brightness of some lines of the image, from the ground that they see."""
    first, lines, samples = part
    fine = scene.spacing / FINENESS
    x = np.linspace(-0.5, 0.5, 33) * samples
    y = np.array([first, first + lines])[:, None] - 0.5 * samples
    east, north = _meet_sphere(camera, axes, *np.broadcast_arrays(x, y))
    half = 0.5 * scene.spacing * (scene.posts - 1)
    rows = range(int((half - north.max() - REACH) / fine), int((half - north.min() + REACH) / fine))
    cols = range(int((east.min() - REACH + half) / fine), int((east.max() + REACH + half) / fine))
    heights = ground.heights(ground.vertices, rows, cols)
    origin = np.array([cols[0] * fine - half, half - rows[0] * fine])
    brightness, image = np.empty_like(heights), np.empty((lines, samples), np.float32)
    one = np.ones((1, 1), np.float32)
    facet_brightness(heights, one, origin, fine, RADIUS, sun, camera, brightness)
    place = origin, fine, RADIUS, camera, axes, FOCAL_LENGTH
    pinhole_image(heights, brightness, *place, image, first, samples)
    return image


def _meet_sphere(camera, axes, x, y):
    """Map coordinates where rays of pixels meet the sphere of mean height, m."""
    rays = np.stack([x, y, np.full(x.shape, FOCAL_LENGTH)], -1) @ axes
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    radius = RADIUS + DATUM
    along = rays @ camera
    distance = -along - np.sqrt(along**2 - camera @ camera + radius**2)
    scale = 2 * RADIUS / (radius + camera[2] + distance * rays[..., 2])
    return tuple((camera[k] + distance * rays[..., k]) * scale for k in (0, 1))


def peak_of(command):
    """Run a command; seconds, and the most that it and its children held at once, bytes."""
    start, peak = time.perf_counter(), 0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        tree, ended = psutil.Process(process.pid), threading.Event()

        def look():
            nonlocal peak
            while not ended.wait(SAMPLING):
                held = 0
                try:
                    for one in (tree, *tree.children(recursive=True)):
                        held += one.memory_info().rss
                except psutil.Error:
                    continue  # one of them has just ended
                peak = max(peak, held)

        watcher = threading.Thread(target=look)
        watcher.start()
        status = process.wait()
        ended.set()
        watcher.join()
    if status:
        raise SystemExit(f"{command} ended with status {status}")
    return time.perf_counter() - start, peak


def errors(folder, output):
    """Root mean square error of heights before and after, m, some rows at a time."""
    totals = np.zeros(3)
    with (
        rasterio.open(folder / "truth_dem.tif") as truth,
        rasterio.open(folder / "init_dem.tif") as initial,
        rasterio.open(output / "dem.tif") as refined,
    ):
        size = truth.height - 2 * BORDER
        for first in range(BORDER, BORDER + size, LINES):
            window = Window(BORDER, first, size, min(LINES, BORDER + size - first))
            known = truth.read(1, window=window).astype(float)
            before = initial.read(1, window=window) - known
            after = refined.read(1, window=window) - known
            seen = np.isfinite(after)
            totals += np.sum(before[seen] ** 2), np.sum(after[seen] ** 2), seen.sum()
    return np.sqrt(totals[:2] / totals[2])


def ensure_frame(folder, posts):
    """Make the frame unless the folder holds it."""
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / f"{posts}.made").exists():
        return
    start = time.perf_counter()
    make_frame(Scene(posts, 1, seed=2), folder)
    (folder / f"{posts}.made").touch()
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"made in {time.perf_counter() - start:.0f} s, {most:.1f} GB", flush=True)


def sfs_command(folder, output):
    """The command that refines the frame of a folder."""
    command = [str(Path(sys.executable).parent / "lommel"), "sfs", str(folder / "img1.tif")]
    command += ["--dem", str(folder / "init_dem.tif"), "--output", str(output), "--overwrite"]
    return [*command, "--sun-positions", str(folder / "sun_positions.txt")]


def main():
    """Make, refine, compare; the folder stays for a look and is removed by hand."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--posts", type=int, default=4000)
    parser.add_argument("--folder", type=Path, default=Path("benchmarks/output/frame"))
    parser.add_argument("options", nargs="*", help="of lommel sfs, after --")
    given = parser.parse_args()
    folder, output = given.folder, given.folder / "refined"
    ensure_frame(folder, given.posts)
    seconds, peak = peak_of([*sfs_command(folder, output), *given.options])
    per_post = 1e6 * seconds / given.posts**2
    print(f"refined in {seconds:.0f} s, {per_post:.2f} us per post; {peak / 1e9:.2f} GB at most")
    record = json.loads((output / "run.json").read_text(encoding="utf-8"))
    for stage in record["stages"]:
        print(f"  {stage['name']}: {stage['seconds']:.0f} s")
    print(f"  {record['outcome']['sentence']}")
    before, after = errors(folder, output)
    print(f"  heights: {before:.3f} m before, {after:.3f} m after (rms)", flush=True)


if __name__ == "__main__":
    main()
