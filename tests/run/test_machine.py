"""Cores and memory of a run, within what a batch system grants."""

import os

import pytest

from lommel.run import machine
from lommel.run.machine import cores, free_memory

GIB = 2**30


@pytest.fixture(autouse=True)
def no_job(monkeypatch, tmp_path):
    """No batch system and no control group, whatever these tests run in."""
    for name in ("NUMBA_NUM_THREADS", "SLURM_MEM_PER_NODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(machine, "GROUPS", tmp_path)
    monkeypatch.setattr(machine, "OWN_GROUPS", tmp_path / "own")


def test_cores_are_those_of_the_process_or_as_many_as_numba_may_use(monkeypatch):
    own = len(os.sched_getaffinity(0))
    assert cores() == own
    for text, count in (("1", 1), ("100000", own), ("many", own), ("0", 1)):
        monkeypatch.setenv("NUMBA_NUM_THREADS", text)
        assert cores() == count


def test_memory_of_a_slurm_job_is_kept_to(monkeypatch):
    free = free_memory()
    assert free > 0.2 * GIB
    monkeypatch.setenv("SLURM_MEM_PER_NODE", "100")
    assert free_memory() == 100 * 2**20
    monkeypatch.setenv("SLURM_MEM_PER_NODE", "0")  # --mem=0 asks for all of the node
    assert free_memory() > 0.5 * free


@pytest.mark.parametrize(
    ("line", "limits", "least"),
    [
        ("0::/job_7/step_0", {"job_7/memory.max": 3, "job_7/step_0/memory.max": 2}, 2),
        ("0::/job_7/step_0", {"job_7/memory.max": 2, "job_7/step_0/memory.max": "max"}, 2),
        ("0::/../elsewhere", {"memory.max": 2}, 2),
        ("4:cpu,memory:/slurm/job_7", {"memory/slurm/memory.limit_in_bytes": 2}, 2),
        ("4:cpu:/job_7", {"job_7/memory.max": 2, "cpu/job_7/memory.limit_in_bytes": 2}, None),
    ],
)
def test_memory_of_a_control_group_and_of_those_around_it_is_kept_to(tmp_path, line, limits, least):
    (tmp_path / "own").write_text(f"9:name=systemd:/\n{line}\n", encoding="ascii")
    for path, size in limits.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        text = str(size) if size == "max" else str(size * 2**20)
        (tmp_path / path).write_text(text + "\n", encoding="ascii")
    expected = least and least * 2**20
    assert free_memory() == expected if expected else free_memory() > 2**21
