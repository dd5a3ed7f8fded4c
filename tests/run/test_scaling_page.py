"""The recipes of docs/scaling.md are commands that parse."""

import ast
import re
import subprocess
from pathlib import Path

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
