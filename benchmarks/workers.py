"""What a second Dask worker gains: the same parts with one worker of one thread, and with two.

    python -m benchmarks.workers --posts 4000 --folder /tmp/frame --memory 1GB
    python -m benchmarks.workers --strip 2500 --folder /tmp/strip --memory 1GB

Prints the seconds that the parts took (tiles of ``lommel sfs``; reading, passes and maps of
``lommel albedo``) and the whole commands, and whether the products are the same to the byte. The
frame is that of `benchmarks.frame`, the strip one of `benchmarks.strip` with 12 frames; they are
made when the folder does not hold them.
"""

import argparse
import json
import os
import subprocess
import time
from hashlib import sha256
from pathlib import Path

from distributed import LocalCluster

from benchmarks.frame import ensure_frame, sfs_command
from benchmarks.strip import albedo_command, ensure_strip

FRAMES = 12


def run(command, output, memory, workers):
    """Run a command on a cluster; seconds of the whole, of its stages, digests of the products."""
    command = [*command, "--memory", memory]
    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0") as cluster:
        start = time.perf_counter()
        scheduler = ["--engine", "dask", "--dask-scheduler", cluster.scheduler_address]
        subprocess.run([*command, *scheduler], check=True, stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - start
    record = json.loads((output / "run.json").read_text(encoding="utf-8"))
    stages = {stage["name"]: stage["seconds"] for stage in record["stages"]}
    digests = {p.name: sha256(p.read_bytes()).hexdigest() for p in output.glob("*.tif")}
    return seconds, stages, digests


def main():
    """Run with one worker and with two."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--posts", type=int, default=4000, help="of the frame, along a side")
    parser.add_argument("--strip", type=int, help="posts along a frame of a strip, for albedo")
    parser.add_argument("--folder", type=Path, default=Path("benchmarks/output/frame"))
    parser.add_argument("--memory", default="1GB", help="of one worker")
    given = parser.parse_args()
    if given.strip is None:
        ensure_frame(given.folder, given.posts)
        make, shared = sfs_command, ("tiles",)
    else:
        ensure_strip(given.folder, FRAMES, given.strip)
        make, shared = albedo_command, ("read", "solve")
    os.environ["NUMBA_NUM_THREADS"] = "1"  # of a worker; the command itself only prepares
    found = []
    for workers in (1, 2):
        output = given.folder / f"workers-{workers}"
        seconds, stages, digests = run(make(given.folder, output), output, given.memory, workers)
        parts = sum(stages[name] for name in shared)
        print(f"{workers}: {parts:.1f} s for the parts, {seconds:.1f} s in all", flush=True)
        found.append((parts, seconds, digests))
    (one, all_one, bytes_one), (two, all_two, bytes_two) = found
    print(f"gain {one / two:.2f} for the parts, {all_one / all_two:.2f} in all")
    print("the same bytes" if bytes_one == bytes_two else "OTHER BYTES")


if __name__ == "__main__":
    main()
