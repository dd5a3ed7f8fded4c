"""The list of files in docs/architecture.md is the list of files."""

import re
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]


def listed_modules(text):
    """Module paths, relative to the package, of the indented listing under ``src/lommel/``."""
    block = text.split("src/lommel/\n", 1)[1].split("\ntests/", 1)[0]
    folder, modules = "", set()
    for line in block.splitlines():
        if found := re.match(r"  (\w+)/ ", line):
            folder = found[1] + "/"
        elif found := re.match(r"    (\w+\.py) ", line):
            modules.add(folder + found[1])
        elif found := re.match(r"  (\w+\.py) ", line):
            modules.add(found[1])
    return modules


def test_every_module_stands_in_the_architecture_page():
    page = (REPOSITORY / "docs" / "architecture.md").read_text(encoding="utf-8")
    package = REPOSITORY / "src" / "lommel"
    modules = {path.relative_to(package).as_posix() for path in package.rglob("*.py")}
    modules = {path for path in modules if not path.endswith("__init__.py")}
    assert listed_modules(page) == modules
