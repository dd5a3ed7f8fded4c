"""What this machine lets a run take: cores and memory, also within a job of a batch system.

Most callers want `cores` and `free_memory`.
"""

import os
from pathlib import Path

GROUPS = Path("/sys/fs/cgroup")
OWN_GROUPS = Path("/proc/self/cgroup")


def cores():
    """Processor cores that this process may use, NUMBA_NUM_THREADS at most where that is set.

    Batch systems that do not pin a job to its cores are told by that variable.
    """
    try:
        count = len(os.sched_getaffinity(0))
    except AttributeError:  # not every system tells
        count = os.cpu_count() or 1
    try:
        return max(min(count, int(os.environ["NUMBA_NUM_THREADS"])), 1)
    except (KeyError, ValueError):
        return count


def free_memory():
    """Bytes that programs may take now; limits of control groups and of a SLURM job are kept to."""
    sizes = [float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))]
    try:
        text = Path("/proc/meminfo").read_text(encoding="ascii")
        sizes.append(float(text.split("MemAvailable:")[1].split()[0]) * 1024)
    except (OSError, IndexError, ValueError):
        pass
    return min([*sizes, *_group_limits(), *_slurm_limits()])


def _group_limits():
    """Of the groups this process is in and of those around them, of both versions."""
    try:
        lines = OWN_GROUPS.read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    for line in ["0::/", *lines]:
        kinds, path = line.split(":", 2)[1:]
        if kinds == "":
            top, name = GROUPS, "memory.max"
        elif "memory" in kinds.split(","):
            top, name = GROUPS / "memory", "memory.limit_in_bytes"
        else:
            continue
        own = top / path.lstrip("/")
        for folder in (own, *own.parents):
            try:
                yield float((folder / name).read_text(encoding="ascii"))
            except (OSError, ValueError):  # "max" is no number: no limit
                pass
            if folder == top:
                break


def _slurm_limits():
    """Clusters without control groups look at a job's memory now and then, and end it."""
    try:
        size = float(os.environ["SLURM_MEM_PER_NODE"]) * 2**20  # given in MiB
    except (KeyError, ValueError):
        return []
    return [size] if size > 0 else []  # 0 is all of the node
