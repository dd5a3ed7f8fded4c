"""Scenes shared by tests: one cut into tiles, and a strip for the albedo stage."""

import shutil

import pytest
from benchmarks.scenes import Scene, make_scene

from lommel.run.shape_from_shading import SfsSettings, run_shape_from_shading
from lommel.run.shares import Share
from lommel.run.simulate import run_simulate
from lommel.run.tiles_array import prepare_array, solve_share
from lommel.run.tiles_plan import Tiling, work_folder

from .albedo_scene import SMALL
from .tiled_scene import POSTS, SIDE, files_of


@pytest.fixture(scope="session")
def ground(tmp_path_factory):
    path = tmp_path_factory.mktemp("strip") / "small.toml"
    path.write_text(SMALL, encoding="utf-8")
    return run_simulate(path, path.parent / "out")


@pytest.fixture(scope="session")
def tile_scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    make_scene(Scene(POSTS, 2, finest_detail=1.0), folder)
    return folder


@pytest.fixture(scope="session")
def tiled(tile_scene, tmp_path_factory):
    output = tmp_path_factory.mktemp("tiled") / "out"
    run_shape_from_shading(files_of(tile_scene), output, tiling=Tiling(side=SIDE))
    return output


@pytest.fixture
def half_done(prepared, tmp_path):
    """Path of an output whose tiles wait beside it, every other one solved."""
    shutil.copytree(work_folder(prepared), work_folder(tmp_path / "out"))
    return tmp_path / "out"


@pytest.fixture(scope="session")
def prepared(tile_scene, tmp_path_factory):
    """The same, not to be touched."""
    output = tmp_path_factory.mktemp("prepared") / "out"
    request = files_of(tile_scene), output, SfsSettings(), None
    prepare_array(*request, Tiling(side=SIDE))
    solve_share(*request, Tiling(side=SIDE), Share(1, 2))
    return output
