"""The recipes of docs/scaling.md are commands that parse; `tests/scale` runs them."""

import ast
import re
import subprocess
from pathlib import Path

import dask_jobqueue
import pytest
from typer.main import get_command

from lommel.cli import app
from lommel.run.shares import read_share

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "scaling.md").read_text(encoding="utf-8")
COMMANDS = sorted(set(re.findall(r"\blommel (?:albedo|sfs|merge) [^`|#\n]*", PAGE)))


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("line", COMMANDS)
def test_command_parses(line):
    words = re.sub(r"\$\{\w+:-(\d+)\}", r"\1", re.sub("[\"']", "", line)).split()
    command = get_command(app).commands[words[1]]
    context = command.make_context(words[1], words[2:])
    if context.params.get("tiles"):
        read_share(context.params["tiles"])


@pytest.mark.parametrize("script", blocks("bash"))
def test_shell_script_parses(script):
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)


@pytest.mark.parametrize("script", blocks("python"))
def test_python_recipe_parses(script):
    ast.parse(script)


@pytest.mark.parametrize(
    ("kind", "asked"),
    [
        ("SLURMCluster", ["#SBATCH -p normal", "#SBATCH --cpus-per-task=8", "#SBATCH --mem=60G"]),
        ("PBSCluster", ["#PBS -q normal", "#PBS -l select=1:ncpus=8:mem=60GB"]),
    ],
)
def test_jobs_of_dask_workers_ask_for_what_the_page_says(kind, asked):
    (script,) = blocks("python")
    (block,) = (node for node in ast.parse(script).body if isinstance(node, ast.With))
    arguments = block.items[0].context_expr.keywords
    terms = {word.arg: ast.literal_eval(word.value) for word in arguments}
    with getattr(dask_jobqueue, kind)(
        **terms, scheduler_options={"dashboard_address": ":0"}
    ) as cluster:
        job = cluster.job_script()
    subprocess.run(["bash", "-n"], input=job, text=True, check=True)
    for line in [*asked, "walltime=08:00:00" if kind == "PBSCluster" else "-t 08:00:00"]:
        assert line in job
    for option in ("--nworkers 4", "--nthreads 2", "--memory-limit 14.90GiB"):  # of each worker
        assert option in job
