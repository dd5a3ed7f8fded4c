"""The recipes of docs/scaling.md, run as printed by a SLURM of this machine's own.

Only names of files, sizes and the number of shares differ from the page. Each run loses a job half
way and must give the bytes of one process all the same.
"""

import re
import shutil
import subprocess
import sys
import tempfile
import time
from hashlib import sha256
from pathlib import Path

import pytest
from benchmarks.scenes import Scene, make_scene
from benchmarks.strip import ensure_strip

from .one_machine_slurm import program, said, slurm, wait_for_jobs

pytestmark = pytest.mark.scale
PAGE = (Path(__file__).resolve().parents[2] / "docs" / "scaling.md").read_text(encoding="utf-8")
PATIENCE = 600  # s for all jobs of a test; they take half a minute
SCENE = "img1.tif img2.tif --dem init_dem.tif --sun-positions sun_positions.txt"
STRIP = "frame*.tif --dem dem.tif --sun-positions sun.txt --spacecraft-positions spacecraft.txt"
SFS = f"lommel sfs {SCENE} --output refined --memory 350MB"
ALBEDO = f"lommel albedo {STRIP} --output refined --memory 1.2GB"
SIZES = {"/64": "/4", "1-64": "1-4", "3,17": "1", "16G": "4G", "16gb": "4gb"}
WORKERS = {
    "cores=8": "cores=1",
    "processes=4": "processes=1",
    '"64GB"': '"1500MB"',
    "jobs=16": "jobs=2",
}


@pytest.fixture(scope="module")
def cluster():
    with tempfile.TemporaryDirectory() as folder, slurm(Path(folder), 4, 16000) as environment:
        here = str(Path(sys.executable).parent)
        yield environment | {"PATH": f"{here}:{environment['PATH']}"}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Folder with a scene and a strip, and what one process makes of either."""
    folder = tmp_path_factory.mktemp("inputs")
    make_scene(Scene(512, 2, finest_detail=1.0), folder)
    ensure_strip(folder, 12, 300)
    here = Path(sys.executable).parent
    for name, command in (("sfs", SFS), ("albedo", ALBEDO)):
        command = command.replace("--output refined", f"--output serial-{name}")
        subprocess.run(f"{here}/{command}", shell=True, check=True, cwd=folder)
    return folder


@pytest.fixture
def folder(inputs, tmp_path):
    """The same inputs in a folder of its own."""
    shutil.copytree(inputs, tmp_path / "work")
    return tmp_path / "work"


def recipe(language, holds, command, more=None):
    """The block of the page that holds a text, about our files."""
    blocks = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    (text,) = (block for block in blocks if holds in block)
    text = re.sub(r"lommel sfs .*? --memory 12GB", command, text)
    for old, new in (SIZES | (more or {})).items():
        text = text.replace(old, new)
    return text


def run_script(text, folder, environment):
    subprocess.run(["bash", "-e"], input=text, text=True, check=True, cwd=folder, env=environment)


def cancel_one(environment, folder, done, name):
    """Cancel a job of this name that runs, when the first part is done that fits the pattern."""
    end = time.monotonic() + PATIENCE
    while not list(folder.glob(done)):
        assert time.monotonic() < end, f"no {done} within {PATIENCE} s"
        time.sleep(0.1)
    running = said(["squeue", "-h", "-r", "-t", "R", "-n", name, "-o", "%i"], environment)
    job = running.split()[0]
    said(["scancel", job], environment)
    return job


def digests(folder):
    return {
        path.name: sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.iterdir())
        if path.suffix in (".tif", ".csv")
    }


def logs(folder):
    paths = [p for kind in ("slurm-*.out", "*.sh.o*", "*.sh.e*") for p in folder.glob(kind)]
    return "\n".join(f"{p.name}: {p.read_text(errors='replace')}" for p in paths)


def test_array_of_tiles_that_loses_a_job_is_finished_by_that_job_alone(cluster, folder):
    (folder / "share.sh").write_text(recipe("bash", "SLURM_ARRAY_TASK_ID", SFS))
    run_script(recipe("bash", "prepare=$(sbatch", SFS), folder, cluster)
    job = cancel_one(cluster, folder, ".refined.tiles/tile-*", "share.sh")
    wait_for_jobs(cluster, PATIENCE)
    assert job.endswith("_1"), logs(folder)
    assert "of 16 tiles are not solved" in logs(folder)
    assert not (folder / "refined").exists()
    run_script(recipe("bash", "again=$(sbatch", SFS), folder, cluster)
    wait_for_jobs(cluster, PATIENCE)
    assert digests(folder / "refined") == digests(folder / "serial-sfs"), logs(folder)


def test_array_of_albedo_does_not_miss_a_job(cluster, folder):
    (folder / "share.sh").write_text(recipe("bash", "SLURM_ARRAY_TASK_ID", ALBEDO))
    run_script(recipe("bash", "prepare=$(sbatch", ALBEDO), folder, cluster)
    cancel_one(cluster, folder, ".refined.albedo/pass-1-block/0*", "share.sh")
    wait_for_jobs(cluster, PATIENCE)
    assert digests(folder / "refined") == digests(folder / "serial-albedo"), logs(folder)


def test_array_whose_preparation_fails_ends_and_says_why(cluster, folder):
    (folder / "init_dem.tif").unlink()
    (folder / "share.sh").write_text(recipe("bash", "SLURM_ARRAY_TASK_ID", SFS))
    run_script(recipe("bash", "prepare=$(sbatch", SFS), folder, cluster)
    wait_for_jobs(cluster, PATIENCE)
    assert "init_dem.tif cannot be opened" in logs(folder)
    assert "refined has no tiles beside it" in logs(folder)


@pytest.mark.parametrize(
    ("stage", "command", "done"),
    [
        ("sfs", SFS, ".refined.tiles/tile-*"),
        ("albedo", ALBEDO, ".refined.albedo/pass-1-block/0*"),
    ],
)
def test_dask_workers_in_jobs_one_of_which_is_lost(cluster, folder, stage, command, done):
    script = recipe("python", "SLURMCluster", command, WORKERS)
    (folder / "on_slurm.py").write_text(script)
    run_script(
        recipe("bash", "on_slurm.py", command, {"cpus-per-task=4": "cpus-per-task=1"}),
        folder,
        cluster,
    )
    cancel_one(cluster, folder, done, "dask-worker")
    wait_for_jobs(cluster, PATIENCE)
    assert digests(folder / "refined") == digests(folder / f"serial-{stage}"), logs(folder)


def test_pbs_scripts_by_the_qsub_that_slurm_has(cluster, folder):
    if program("qsub") is None:
        pytest.skip("needs qsub, of the package slurm-wlm-torque")
    (folder / "share.sh").write_text(recipe("bash", "PBS_ARRAY_INDEX", SFS))
    (folder / "merge.sh").write_text(
        recipe("bash", '"$PBS_O_WORKDIR"\nexport NUMBA_NUM_THREADS=2\nlommel merge', SFS)
    )
    run_script(recipe("bash", "qsub share.sh", SFS), folder, cluster)
    wait_for_jobs(cluster, PATIENCE)
    assert digests(folder / "refined") == digests(folder / "serial-sfs"), logs(folder)


def test_dask_workers_by_the_qsub_that_slurm_has(cluster, folder):
    if program("qsub") is None:
        pytest.skip("needs qsub, of the package slurm-wlm-torque")
    script = recipe("python", "SLURMCluster", SFS, WORKERS)
    script = script.replace("SLURMCluster", "PBSCluster")
    run = subprocess.run([sys.executable, "-c", script], cwd=folder, env=cluster)
    assert run.returncode == 0
    assert digests(folder / "refined") == digests(folder / "serial-sfs"), logs(folder)
