"""Products are the same however often they are written: two threads at once once lost parts."""

import shutil
from hashlib import sha256

import pytest
from benchmarks.scenes import Scene, make_scene

from lommel.run.inputs import SceneFiles
from lommel.run.shape_from_shading import SfsSettings
from lommel.run.shares import Share
from lommel.run.tiles_array import merge_tiles, prepare_array, solve_share
from lommel.run.tiles_plan import Tiling, work_folder

TIMES = 60  # on a busy machine 1 of 10 was damaged while two threads wrote at once


@pytest.mark.scale
def test_products_are_the_same_however_often_they_are_written(tmp_path):
    make_scene(Scene(320, 2, finest_detail=1.0), tmp_path)
    images = tuple(sorted(tmp_path.glob("img*.tif")))
    files = SceneFiles(images, (tmp_path / "init_dem.tif",), tmp_path / "sun_positions.txt")
    request = files, tmp_path / "kept", SfsSettings(), None, Tiling(side=128)
    prepare_array(*request)
    solve_share(*request, Share(1, 1))
    found = set()
    for _ in range(TIMES):
        shutil.copytree(work_folder(tmp_path / "kept"), work_folder(tmp_path / "out"))
        merge_tiles(tmp_path / "out")
        found.add(
            tuple(sha256(p.read_bytes()).digest() for p in sorted(tmp_path.glob("out/*.tif")))
        )
        shutil.rmtree(tmp_path / "out")
    assert len(found) == 1
