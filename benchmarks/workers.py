"""What a second Dask worker gains: the same tiles with one worker of one thread, and with two.

    python -m benchmarks.workers --posts 4000 --folder /tmp/frame --memory 1GB

Prints the seconds that all tiles took and the whole commands, and whether the products are the
same to the byte. The frame is that of `benchmarks.frame`, made when the folder does not hold it.
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


def refine(folder, memory, workers):
    """Run ``lommel sfs`` on a cluster; seconds of the whole, record, digests of the products."""
    output = folder / f"workers-{workers}"
    command = [*sfs_command(folder, output), "--memory", memory]
    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster:
        start = time.perf_counter()
        scheduler = ["--engine", "dask", "--dask-scheduler", cluster.scheduler_address]
        subprocess.run([*command, *scheduler], check=True, stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - start
    record = json.loads((output / "run.json").read_text(encoding="utf-8"))
    digests = {p.name: sha256(p.read_bytes()).hexdigest() for p in output.glob("*.tif")}
    return seconds, record, digests


def main():
    """Run with one worker and with two."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--posts", type=int, default=4000)
    parser.add_argument("--folder", type=Path, default=Path("benchmarks/output/frame"))
    parser.add_argument("--memory", default="1GB", help="of one worker")
    given = parser.parse_args()
    ensure_frame(given.folder, given.posts)
    os.environ["NUMBA_NUM_THREADS"] = "1"  # of a worker; the command itself only prepares
    found = [refine(given.folder, given.memory, workers) for workers in (1, 2)]
    stages = [
        {stage["name"]: stage["seconds"] for stage in record["stages"]} for _, record, _ in found
    ]
    for workers, (seconds, record, _), stage in zip((1, 2), found, stages, strict=True):
        tiles = record["results"]["tiles"]
        print(f"{workers}: {stage['tiles']:.1f} s for {tiles} tiles, {seconds:.1f} s in all")
    print(f"gain {stages[0]['tiles'] / stages[1]['tiles']:.2f} for the tiles", end=", ")
    print(f"{found[0][0] / found[1][0]:.2f} in all")
    print("the same bytes" if found[0][2] == found[1][2] else "OTHER BYTES")


if __name__ == "__main__":
    main()
