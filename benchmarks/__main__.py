"""Print what the solver costs: ``make bench``, or ``python -m benchmarks --quick``."""

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

from benchmarks.cameras import rates
from benchmarks.convergence import REDUCTIONS, STRENGTHS, SingleImage, excess_cost, iterations
from benchmarks.convergence import scaled as scaled_priors
from benchmarks.scenes import Scene, make_scene
from benchmarks.triad import kernels, triad

OUTPUT = Path(__file__).parent / "output"
SIZES = (256, 512, 1024, 2048, 4096)
QUICK_SIZES = (256, 1024)
OTHERS = {
    "albedo 10 %": Scene(500, 4, seed=3, albedo_contrast=0.1),
    "initial DEM blurred by 25 posts": Scene(500, 4, seed=4, initial_blur=25.0),
}
STAGES = (
    "import",
    "read",
    "geometry, sampling",
    "priors",
    "coarse levels",
    "finest steps",
    "albedo",
    "other",
    "write, report",
)


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small scenes only")
    parser.add_argument("--repeats", type=int, default=3, help="runs per scene; the fastest counts")
    parser.add_argument(
        "--only", choices=("kernels", "scenes", "convergence", "cameras"), help="one part of it"
    )
    options = parser.parse_args()
    sizes = QUICK_SIZES if options.quick else SIZES
    _print_machine()
    if options.only in (None, "kernels"):
        _print_kernels(sizes)
    if options.only in (None, "scenes"):
        scenes = {
            f"{size} x {size}, {count} image{'s' * (count > 1)}": Scene(size, count, seed=2)
            for size in sizes
            for count in (1, 4)
        }
        _print_scenes(scenes | OTHERS, options.repeats)
    if options.only in (None, "convergence"):
        _print_convergence([size for size in sizes if size in (256, 1024, 4096)])
    if options.only in (None, "cameras"):
        _print_cameras()


def _print_machine():
    info = Path("/proc/cpuinfo")
    models = re.findall(r"model name\s*:\s*(.*)", info.read_text()) if info.exists() else []
    names = ("lommel", "numpy", "numba", "scipy", "rasterio")
    versions = ", ".join(f"{name} {version(name)}" for name in names)
    print(f"{(models or [platform.machine()])[0]}, {os.cpu_count()} cores, ", end="")
    print(f"load {os.getloadavg()[0]:.1f}; python {platform.python_version()}, {versions}")


def _print_kernels(sizes):
    limit = triad()
    print(f"\ntriad {limit.bandwidth / 1e9:.1f} GB/s\n")
    print("| kernel | posts | ns per post | GB/s | of the triad |\n|---|---|---|---|---|")
    for size in sizes:
        for speed in kernels(size):
            share = speed.bandwidth / limit.bandwidth
            print(
                f"| {speed.name} | {size}² | {1e9 * speed.seconds / speed.posts:.2f} "
                f"| {speed.bandwidth / 1e9:.1f} | {100 * share:.0f} % |",
                flush=True,
            )


def _print_cameras():
    print("\n| what | million per second and core | on all cores | there and back px |")
    print("|---" * 4 + "|")
    for rate in rates():
        print(
            f"| {rate.name} | {rate.one_core / 1e6:.2f} | {rate.all_cores / 1e6:.2f} "
            f"| {rate.worst:.1e} |",
            flush=True,
        )


def _print_scenes(scenes, repeats):
    print("\n| scene | wall s | " + " | ".join(STAGES), end=" | ")
    print("peak MB | bytes per pixel | cycles of finest steps | height RMSE m | slope RMSE deg |")
    print("|---" * (len(STAGES) + 7) + "|")
    solve_apart(scene_folder(Scene(256, 1)))  # compiles what is not cached yet
    for name, scene in scenes.items():
        folder = scene_folder(scene)
        _print_scene(name, scene, [solve_apart(folder) for _ in range(repeats)])


def _print_scene(name, scene, runs):
    best = min(runs, key=lambda run: run["wall"])
    pixels = scene.posts**2
    cells = [f"{best['wall']:.2f}"]
    cells += [f"{best['stages'].get(stage, 0.0):.2f}" for stage in STAGES]
    cells += [f"{best['peak_bytes'] / 1e6:.0f}"]
    cells += [f"{(best['peak_bytes'] - best['import_bytes']) / pixels:.0f}"]
    cells += ["+".join(str(cycles) for cycles in best["cycles"])]
    cells += [f"{best['height_rmse_m']:.3f}", f"{best['slope_rmse_deg']:.3f}"]
    note = "" if best["outcome"] == "converged" else f" ({best['outcome']})"
    if "albedo_correlation" in best:
        note += f" (albedo correlation {best['albedo_correlation']:.4f})"
    print(f"| {name}{note} | " + " | ".join(cells) + " |", flush=True)


def scene_folder(scene):
    """Folder of a scene's files, made when it is not there yet."""
    key = "-".join(f"{value:g}" for value in vars(scene).values())
    folder = OUTPUT / f"scene-{key}"
    if not (folder / "sun_positions.txt").exists():
        make_scene(scene, folder)
    return folder


def solve_apart(folder):
    """Solve a scene in a fresh process; its report and the wall seconds of the process."""
    with tempfile.TemporaryDirectory(dir=OUTPUT) as place:
        command = [sys.executable, "-m", "benchmarks.one", str(folder), f"{place}/product"]
        start = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        wall = time.perf_counter() - start
        shutil.rmtree(f"{place}/product", ignore_errors=True)
    if done.returncode != 0:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1]) | {"wall": wall}


def _print_convergence(sizes):
    print("\nOne image: V-cycles to reduce the residual, and how far above the minimum of the cost")
    print("(taken from a long solve) the default stops.\n")
    heads = " | ".join(f"to {reduction:g}" for reduction in REDUCTIONS)
    print(f"| posts | priors | {heads} | default's finest cycles | long solve | cost above it |")
    print("|---" * (len(REDUCTIONS) + 5) + "|")
    for size in sizes:
        scene = SingleImage(scene_folder(Scene(size, 1, seed=2)))
        estimated = scene.solve().value.priors
        for name, strength in STRENGTHS.items():
            priors = scaled_priors(estimated, strength)
            counts = iterations(scene, priors)
            excess, default, long = excess_cost(scene, priors)
            cells = [f"{size}²", name, *map(str, counts), "+".join(map(str, default))]
            cells += [f"{len(long)} steps, {sum(long)} cycles", f"{100 * excess:.3f} %"]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
