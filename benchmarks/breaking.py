"""Runs that are broken on purpose: killed, starved of disk, fed with damaged files, run twice.

    python -m benchmarks.breaking --folder /tmp/breaking
    python -m benchmarks.breaking --folder /tmp/breaking --only killed --engine dask --kills 40

Breaks ``lommel sfs`` in nine tiles and ``lommel albedo`` on a strip, again and again, and compares
the products with those of a run that nothing disturbed, byte by byte. Prints a table of what was
done and what followed; ends with status 1 where a product differs, a process stays behind, or a
traceback is shown. Takes half an hour on two cores; the small disks need root.
"""

import argparse
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from benchmarks.scenes import Scene, make_scene
from benchmarks.strip import albedo_command, ensure_strip

POSTS, FRAMES, SIZE = 320, 12, 500
# with tiles of 128 posts a scene of seconds has nine
SMALL = """
from lommel.cli import main
from lommel.run.tiles_plan import Tiling

Tiling.__init__.__defaults__ = (None, "serial", 128, None)
main()
"""
ENGINES = ("serial", "processes", "dask", "cluster")
PATIENCE = 600.0  # s that a command may take
GRACE = 20.0  # s in which workers must have noticed that their command is gone
BIN = Path(sys.executable).parent


@dataclass
class Command:
    """A command whose products are known.

    Attributes
    ----------
    name : {'sfs', 'albedo'}
    folder : Path
        Of its inputs.
    memory : dict of str to float, GB
        The least that is enough for ``lommel albedo``, by engine, as it has told.
    products : dict of str to str
        Digests.
    seconds : float
        That it takes.
    """

    name: str
    folder: Path
    memory: dict
    products: dict
    seconds: float = 0.0

    def words(self, output, engine="serial", address=None, *options):
        """The command line, which writes to an output."""
        if self.name == "sfs":
            images = sorted(map(str, self.folder.glob("img*.tif")))
            words = [sys.executable, "-c", SMALL, "sfs", *images, "--overwrite"]
            words += ["--output", str(output)]
            words += ["--dem", str(self.folder / "init_dem.tif")]
            words += ["--sun-positions", str(self.folder / "sun_positions.txt")]
        else:
            words = albedo_command(self.folder, output)
        words += ["--engine", "dask" if engine == "cluster" else engine, *options]
        words += ["--dask-scheduler", address] if address else []
        if self.name == "sfs":
            return words
        kind = "array" if options else engine
        if kind not in self.memory:
            probe = [*words, "--memory", "1MB", "--dry-run"]
            said = subprocess.run(probe, capture_output=True, text=True)
            self.memory[kind] = float(re.split(" needs? ", said.stderr)[1].split()[0])
        return [*words, "--memory", f"{self.memory[kind]:.3f}GB"]


class Running:
    """A command at work, in a session of its own so that what it leaves behind can be found."""

    def __init__(self, words, log):
        self.log = log
        with open(log, "w") as file:
            self.process = subprocess.Popen(
                words, stdout=subprocess.DEVNULL, stderr=file, start_new_session=True
            )

    def wait(self, seconds=PATIENCE):
        """Exit status, or None when it is still at work."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None

    def end(self, number=signal.SIGKILL):
        """Send the command itself a signal, not its workers."""
        self.process.send_signal(number)
        return self.wait(60)

    @property
    def said(self):
        """What it wrote to stderr."""
        return self.log.read_text()

    def others(self):
        """Processes of its session that live, but for itself."""
        return [pid for pid in session(self.process.pid) if pid != self.process.pid]

    def left_behind(self):
        """The same, when they had time to notice; they are ended."""
        end = time.monotonic() + GRACE
        while self.others() and time.monotonic() < end:
            time.sleep(0.2)
        left = self.others()
        for pid in left:
            os.kill(pid, signal.SIGKILL)
        return left


def session(leader):
    """Processes of a session that are no zombies."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, sid = path.read_text().rsplit(")", 1)[1].split()[:4]
        except OSError:
            continue
        if int(sid) == leader and state != "Z":
            found.append(int(path.parent.name))
    return found


class Table:
    """What was done and what followed."""

    def __init__(self):
        self.is_bad = False

    def add(self, what, followed, is_good):
        """Print a line."""
        self.is_bad |= not is_good
        print(f"| {what} | {followed} | {'as it should' if is_good else '**BAD**'} |", flush=True)


def digests(output):
    """Of the products that must be the same."""
    paths = [*output.glob("*.tif"), *output.glob("exposures.csv")]
    return {path.name: sha256(path.read_bytes()).hexdigest() for path in paths}


def beside(output):
    """Names of what lies beside an output and belongs to it."""
    return sorted(path.name for path in output.parent.glob(f".{output.name}*"))


@contextmanager
def cluster(folder, workers=2):
    """A scheduler and workers of their own; gives the address and the processes."""
    ready = folder / "scheduler.json"
    ready.unlink(missing_ok=True)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    command = [str(BIN / "dask"), "scheduler", "--scheduler-file", str(ready), "--port", "0"]
    command += ["--no-dashboard"]
    parts = [subprocess.Popen(command, **quiet)]
    while not ready.exists():
        time.sleep(0.1)
    address = json.loads(ready.read_text())["address"]
    command = [str(BIN / "dask"), "worker", address, "--nthreads", "1", "--no-dashboard"]
    command += ["--local-directory", str(folder / "dask")]
    parts += [subprocess.Popen(command, **quiet) for _ in range(workers)]
    try:
        yield address, parts
    finally:
        for process in parts:
            for pid in session(process.pid):
                os.kill(pid, signal.SIGKILL)
            process.wait()


@contextmanager
def who_works(engine, folder):
    """Address of a cluster where the engine is one, else None."""
    if engine != "cluster":
        yield None
        return
    with cluster(folder) as (address, _):
        yield address


def verdict(command, output, status, said):
    """What followed in words, and whether it is what should."""
    if status is None:
        return "hangs", False
    if "Traceback" in said:
        return f"traceback: {said.strip().splitlines()[-1][:150]}", False
    if status:
        return f"status {status}: {' '.join(said.split())[:300]}", False
    same = digests(output) == command.products
    left = beside(output)
    return ("same bytes" if same else "OTHER BYTES") + (f", left {left}" if left else ""), (
        same and not left
    )


def settle(command, output, words, log):
    """Run a command to its end, undisturbed; what followed."""
    running = Running(words, log)
    return verdict(command, output, running.wait(), running.said)


def clear(output):
    """Remove an output and what lies beside it."""
    for name in (output.name, *beside(output)):
        path = output.with_name(name)
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def killed(command, engine, folder, kills, table, number=signal.SIGKILL):
    """Kill the command at random moments, and start it again each time."""
    output, log = folder / "out", folder / "log"
    clear(output)
    followed, orphans, done = Counter(), 0, 0
    with who_works(engine, folder) as address:
        words = command.words(output, engine, address)
        while done < kills:
            running = Running(words, log)
            status = running.wait(random.uniform(0.3, 1.1 * command.seconds))
            if status is None:
                running.end(number)
                done += 1
                orphans += len(running.left_behind()) if done % 4 == 0 else 0
                if "Traceback" in running.said:
                    followed[f"traceback: {running.said.splitlines()[-1][:150]}"] += 1
                continue
            what, is_good = verdict(command, output, status, running.said)
            followed[what] += 1
            clear(output)
        what, is_good = settle(command, output, words, log)
        followed[what] += 1
    table.add(
        f"`{command.name}`, {engine}: {kills} x {signal.Signals(number).name}",
        "; ".join(f"{count} x {what}" for what, count in followed.items())
        + f"; {orphans} processes stayed",
        is_good and set(followed) == {"same bytes"} and not orphans,
    )
    clear(output)


def worker_killed(command, engine, folder, table, number=signal.SIGKILL):
    """End workers at random moments, three in a run; the command must not need to be repeated."""
    output, log = folder / "out", folder / "log"
    clear(output)
    ended = 0
    with cluster(folder) if engine == "cluster" else who_works(engine, folder) as given:
        address, parts = given if engine == "cluster" else (given, [])
        running = Running(command.words(output, engine, address), log)
        for _ in range(3):
            if running.wait(command.seconds / 3) is not None:
                break
            pids = [pid for part in parts[1:] for pid in session(part.pid) if pid != part.pid]
            pids = [p for p in pids or running.others() if b"spawn_main" in arguments(p)]
            if pids:
                ended += 1
                chosen = random.choice(pids)
                os.kill(chosen, number)
                if number == signal.SIGSTOP:
                    time.sleep(10)
                    os.kill(chosen, signal.SIGCONT)
        what, is_good = verdict(command, output, running.wait(), running.said)
        left = running.left_behind()
    done = f"{ended} workers got {signal.Signals(number).name}"
    table.add(f"`{command.name}`, {engine}: {done}", what, is_good and not left)
    clear(output)


def arguments(pid):
    """Command line of a process."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def scheduler_killed(command, folder, table):
    """Lose the scheduler, then go on with a new one."""
    output, log = folder / "out", folder / "log"
    clear(output)
    with cluster(folder) as (address, processes):
        running = Running(command.words(output, "cluster", address), log)
        parts = f".{output.name}.*/[ti]*-0000*"  # tiles or images: workers are at work
        while not any(folder.glob(parts)) and running.wait(0.05) is None:
            pass
        for pid in session(processes[0].pid):
            os.kill(pid, signal.SIGKILL)
        status, said = running.wait(120), " ".join(running.said.split())
        told = status in (1, 2) and "scheduler" in said and "Traceback" not in said
    with cluster(folder) as (address, _):
        what, is_good = settle(command, output, command.words(output, "cluster", address), log)
    table.add(f"`{command.name}`: scheduler killed", f"{said[:200]}; then {what}", told and is_good)
    clear(output)


def full_disk(command, engine, folder, table):
    """Let somebody fill the disk before the run, on its way, or while it writes its products."""
    output, log, disk = folder / "disk" / "out", folder / "log", folder / "disk"
    disk.mkdir(exist_ok=True)
    words = command.words(output, engine)
    for moment in (0.0, 0.25, 0.5, *("products",) * 4):
        mount = ["mount", "-t", "tmpfs", "-o", "size=200m", "tmpfs", str(disk)]
        subprocess.run(mount, check=True)
        try:
            running = Running(words, log)
            if moment == "products":
                while not any(disk.glob(".out.*.partial/*")) and running.wait(0.005) is None:
                    pass
                room = random.choice((0, 50_000, 400_000, 1_000_000))
            else:
                running.wait(moment * command.seconds)
                room = 0
            room = fill(disk, room)
            status = running.wait()
            said = " ".join(running.said.split())
            told = status in (1, 2) and "Traceback" not in said and "free" in said
            (disk / "ballast").unlink()
            if status == 0:
                told = digests(output) == command.products
                said = "had room enough" if told else "OTHER BYTES"
            what, is_good = settle(command, output, words, log)
        finally:
            subprocess.run(["umount", str(disk)], check=True)
        when = f"with its {moment}" if moment == "products" else f"after {moment:.0%}"
        table.add(
            f"`{command.name}`, {engine}: disk full {when}, {room / 1e6:.2f} MB left",
            f"{said[:240]}; emptied: {what}",
            told and is_good,
        )


def fill(disk, room):
    """Leave only so many bytes on a disk."""
    with suppress(OSError), open(disk / "ballast", "wb", buffering=0) as file:
        while shutil.disk_usage(disk).free > room:
            file.write(bytes(min(2**16, max(shutil.disk_usage(disk).free - room, 4096))))
    return shutil.disk_usage(disk).free


def damaged(command, engine, folder, table, changes=12):
    """Kill late, damage a file that waits, go on."""
    output, log = folder / "out", folder / "log"
    clear(output)
    followed, did, is_good = Counter(), Counter(), True
    words = command.words(output, engine)
    for k in range(changes):
        running = Running(words, log)
        while not any(waiting(output)) and running.wait(0.1) is None:
            pass
        running.wait(random.uniform(0.2, 0.6) * command.seconds)
        running.end()
        running.left_behind()
        files = waiting(output)
        if files:
            did[damage(random.choice(files), k % 4)] += 1
        what, is_same = settle(command, output, words, log)
        followed[what] += 1
        is_good &= is_same
        clear(output)
    table.add(
        f"`{command.name}`, {engine}: killed, then "
        + ", ".join(f"{n} {d}" for d, n in did.items()),
        "; ".join(f"{n} x {what}" for what, n in followed.items()),
        is_good,
    )


def waiting(output):
    """Files that wait beside an output."""
    folders = [path for path in output.parent.glob(f".{output.name}.*") if path.is_dir()]
    return sorted(p for f in folders for p in f.rglob("*") if p.is_file() and p.suffix != ".tif")


def damage(path, kind):
    """Do what a crash or a bad disk does to a file."""
    content = path.read_bytes()
    if kind == 0:
        path.unlink()
        return "deleted"
    if kind == 1:
        path.write_bytes(content[: len(content) // 2])
        return "cut off"
    if kind == 2:
        path.write_bytes(b"")
        return "emptied"
    path.write_bytes(bytes(len(content)))
    return "zeroed"


def twice(command, engine, folder, table):
    """Start the same command while it is at work."""
    output, log = folder / "out", folder / "log"
    clear(output)
    words = command.words(output, engine)
    first = Running(words, log)
    while ".out.lock" not in beside(output) and first.wait(0.1) is None:
        pass
    second = Running(words, folder / "log2")
    status = second.wait()
    what, is_good = verdict(command, output, first.wait(), first.said)
    said = " ".join(second.said.split())[:240]
    is_told = status == 2 and "Traceback" not in said
    table.add(
        f"`{command.name}`, {engine}: the same command twice at a time",
        f"the second: {said or status}; the first: {what}",
        is_told and is_good,
    )
    clear(output)


def shares_killed(command, folder, table, count=3):
    """Kill shares of a job array, run two at a time, merge in between and at the end."""
    output, log = folder / "out", folder / "log"
    clear(output)

    def share(k, name="log"):
        words = command.words(output, "serial", None, "--tiles", f"{k}/{count}")
        return Running([w for w in words if w != "--overwrite"], folder / name)

    merge = [str(BIN / "lommel"), "merge", str(output)]
    said = []
    early = Running(merge, log)
    said.append(("merge without shares", early.wait(), early.said))
    for k in (1, 0):
        one = share(k)
        said.append((f"share {k}", one.wait(), one.said))
    for _ in range(4):
        pair = share(1, "log1"), share(2, "log2")
        time.sleep(random.uniform(0.3, 0.9) * command.seconds)
        pair[0].end(), pair[1].end()
    one = share(2)
    said.append(("share 2", one.wait(), one.said))
    missing = Running(merge, log)
    said.append(("merge of some", missing.wait(), missing.said))
    if missing.process.returncode:
        three = [share(k, f"log{k}") for k in range(1, count + 1)]
        said += [("share", one.wait(), one.said) for one in three]
        what, is_good = settle(command, output, merge, log)
    else:
        what, is_good = verdict(command, output, 0, missing.said)
    for name, status, text in said:
        print(f"    {name}: {status} {' '.join(text.split())[:200]}")
    is_good &= not any("Traceback" in text or status is None for _, status, text in said)
    table.add(f"`{command.name}`, array of {count}: 8 x SIGKILL, early merges", what, is_good)
    clear(output)


def prepare(name, folder):
    """Make a scene and the products of a run that nothing disturbs."""
    inputs, output = folder / name, folder / f"{name}-undisturbed"
    if name == "sfs" and not (inputs / "sun_positions.txt").exists():
        make_scene(Scene(POSTS, 2, finest_detail=1.0), inputs)
    if name == "albedo":
        ensure_strip(inputs, FRAMES, SIZE)
    command = Command(name, inputs, {}, {})
    words = command.words(output)
    for _ in range(2):  # the first one may have to compile
        start = time.perf_counter()
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        command.seconds = time.perf_counter() - start
    command.products = digests(output)
    return command


COMMANDS = ("sfs", "albedo")
CASES = ("killed", "ended", "workers", "stopped", "scheduler", "disk", "damaged", "twice", "shares")


def main():
    """Break runs of both commands in every way that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path("benchmarks/output/breaking"))
    parser.add_argument("--only", nargs="+", choices=CASES, default=CASES)
    parser.add_argument("--command", nargs="+", choices=COMMANDS, default=COMMANDS)
    parser.add_argument("--engine", nargs="+", choices=ENGINES, default=ENGINES)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    random.seed(given.seed)
    table = Table()
    for name in given.command:
        given.folder.mkdir(parents=True, exist_ok=True)
        folder = given.folder.resolve()
        command = prepare(name, folder)
        print(f"{name}: {command.seconds:.1f} s undisturbed", flush=True)
        for engine in given.engine:
            terms = command, engine, folder
            if "killed" in given.only:
                killed(*terms, given.kills, table)
            if "ended" in given.only and engine != "cluster":
                killed(*terms, given.kills // 4, table, signal.SIGTERM)
                killed(*terms, given.kills // 4, table, signal.SIGINT)
            if "workers" in given.only and engine != "serial":
                worker_killed(*terms, table)
            if "stopped" in given.only and engine != "serial":
                worker_killed(*terms, table, signal.SIGSTOP)
            if "damaged" in given.only and engine in ("serial", "processes"):
                damaged(*terms, table)
            if "twice" in given.only and engine != "cluster":
                twice(*terms, table)
        if "scheduler" in given.only:
            scheduler_killed(command, folder, table)
        if "disk" in given.only and os.geteuid() == 0:
            full_disk(command, "serial", folder, table)
            full_disk(command, "processes", folder, table)
        if "shares" in given.only:
            shares_killed(command, folder, table)
    sys.exit(table.is_bad)


if __name__ == "__main__":
    main()
