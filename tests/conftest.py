"""Order of the test run, and the way to the real images."""

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]

LAYERS = [
    "errors",
    "core",
    "scene",
    "io",
    "simulate",
    "evaluate",
    "estimate",
    "run",
    "report",
    "cli",
    "pipeline",
]


def layer_of(path: Path) -> int:
    """Rank of the layer that a test file or a source file belongs to; the deepest is 0."""
    names = [part.removeprefix("test_").removesuffix(".py") for part in path.parts]
    return next((rank for rank, layer in enumerate(LAYERS) if layer in names), len(LAYERS))


def pytest_collection_modifyitems(items):
    """Run the folders in layer order, so that the first failure is the deepest."""
    items.sort(key=lambda item: layer_of(item.path.relative_to(REPOSITORY)))


@pytest.fixture(scope="session")
def real_data():
    """Function from the name of a real data set to its folder; skips the test where it is absent.

    Examples
    --------
    ``folder = real_data("apollo15-hadley-stereo")`` in a test marked ``real_data``.
    """
    root = Path(os.environ.get("LOMMEL_DATA", REPOSITORY.parent / "shared" / "data"))

    def folder_of(name: str) -> Path:
        folder = root / name
        if not folder.is_dir():
            pytest.skip(f"real data set {name} is not at {folder}; set LOMMEL_DATA to its parent")
        return folder

    return folder_of
