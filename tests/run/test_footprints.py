"""Where images lie on the grid of a run, and which of them a part of it opens."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from affine import Affine

from lommel.errors import InputError
from lommel.run import footprints
from lommel.run.footprints import Footprints, camera_window, find_footprints
from lommel.run.inputs import SceneFiles
from lommel.run.views import read_views
from lommel.scene.body import to_xyz
from lommel.scene.camera import FrameCamera
from lommel.scene.geometry import unit
from lommel.scene.grid import Grid, Window, grid_from_bounds, read_crs

from .tiled_scene import files_of

CRS = read_crs("+proj=stere +lat_0=-20 +lon_0=30 +R=1737400 +units=m +type=crs")
GRID = grid_from_bounds((-50e3, -40e3, 60e3, 50e3), 250.0, CRS)
LEAST, MOST = -2000.0, 3000.0  # m


def camera_over(grid, row, col, off_nadir=0.0, focal_length=800.0, shape=(300, 400), height=1e5):
    """A frame camera above a post that looks off the vertical by an angle, and is turned."""
    longitude, latitude = grid.lonlat_at(row, col)
    position = to_xyz(grid.body, longitude, latitude, height)
    down, north = -unit(position), np.array([0.0, 0.0, 1.0])
    east = unit(np.cross(down, north))
    ahead = np.cos(off_nadir) * down + np.sin(off_nadir) * east
    right = unit(np.cross(ahead, [0.3, 0.5, 0.8]))
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    return FrameCamera(position, rotation, focal_length, (shape[0] / 2, shape[1] / 2), shape)


@pytest.mark.parametrize("off_nadir", [0.0, 0.4, 0.8])
def test_a_footprint_holds_all_that_a_camera_sees_and_not_much_more(off_nadir):
    camera = camera_over(GRID, 150, 220 - 400 * np.tan(off_nadir), off_nadir)
    window = camera_window(camera, GRID, LEAST, MOST)
    seen = np.zeros(GRID.shape, bool)
    for height in np.linspace(LEAST, MOST, 5):
        seen |= camera.contains(*camera.project(GRID.xyz(height)))
    row, col = np.nonzero(seen)
    assert row.size > 100
    assert window.row <= row.min() and row.max() < window.row + window.rows
    assert window.col <= col.min() and col.max() < window.col + window.cols
    assert window.rows < 1.4 * np.ptp(row) + 10  # a lattice step at each end, of 16
    assert window.cols < 1.4 * np.ptp(col) + 10


def test_an_image_that_falls_between_the_posts_of_any_lattice_has_a_footprint():
    camera = camera_over(GRID, 211.3, 107.6, shape=(3, 3), focal_length=1e3)
    window = camera_window(camera, GRID, LEAST, MOST)
    assert window.row <= 211 and window.row + window.rows > 212
    assert window.rows < 8


def test_a_camera_that_sees_the_limb_may_show_all_of_the_grid():
    camera = camera_over(GRID, 120, 300, off_nadir=1.3)
    assert camera_window(camera, GRID, LEAST, MOST) == GRID.window


def test_a_camera_that_looks_elsewhere_has_no_footprint():
    away = Grid(GRID.shape, Affine.translation(9e5, 0) @ GRID.affine, CRS, GRID.body)
    assert camera_window(camera_over(away, 120, 300), GRID, LEAST, MOST).is_empty
    behind = camera_over(GRID, 120, 300, off_nadir=np.pi)
    assert camera_window(behind, GRID, LEAST, MOST).is_empty


def test_a_window_uses_the_images_that_touch_it_and_were_chosen_there():
    random = np.random.default_rng(0)
    first, size = random.integers(0, 300, (50, 2)), random.integers(1, 90, (50, 2))
    windows = np.concatenate([first, first + size], axis=1)
    names = tuple(f"{k}" for k in range(50))
    files = SceneFiles(names, (), cameras=(None,) * 50)
    is_used = random.random((50, 8, 9)) < 0.3
    found = Footprints(files, GRID, windows, [], 50, is_used)
    for _ in range(20):
        row, col = random.integers(0, 200, 2).tolist()
        window = Window(row, col, 70, 60)
        expected = []
        for name, (top, left, bottom, right), used in zip(names, windows, is_used, strict=True):
            squares = {
                (post_row // 50, post_col // 50)
                for post_row in range(row, row + 70)
                for post_col in range(col, col + 60)
            }
            touches = top < row + 70 and bottom > row and left < col + 60 and right > col
            if touches and any(used[square] for square in squares):
                expected.append(name)
        assert list(found.within(window).images) == expected


def test_broken_files_are_named_and_the_others_are_found(tile_scene, tmp_path):
    files = files_of(tile_scene)
    junk, lost = tmp_path / "junk.tif", tmp_path / "lost.tif"
    junk.write_bytes(b"no raster")
    found = find_footprints(replace(files, images=(junk, *files.images, lost)))
    assert found.files.images == files.images
    reasons = {skip.name: skip.reason for skip in found.skipped}
    assert "cannot be opened as a raster" in reasons["junk.tif"]
    assert "there is no such file" in reasons["lost.tif"]


def test_many_images_are_looked_at_by_several_processes(tile_scene, tmp_path, monkeypatch):
    junk = tmp_path / "junk.tif"
    junk.write_bytes(b"no raster")
    files = files_of(tile_scene)
    files = replace(files, images=(files.images[0], junk, *files.images[1:]))
    alone = find_footprints(files, sketch=8)
    monkeypatch.setattr(footprints, "PER_PROCESS", 1)
    monkeypatch.setattr(footprints, "cores", lambda: 2)
    shared = find_footprints(files, sketch=8)
    assert shared.files == alone.files and shared.skipped == alone.skipped
    np.testing.assert_array_equal(shared.windows, alone.windows)
    assert [look.info.shape for look in shared.looks] == [look.info.shape for look in alone.looks]


def test_no_image_at_all_is_refused_with_every_reason(tile_scene, tmp_path):
    junk = tmp_path / "junk.tif"
    junk.write_bytes(b"no raster")
    with pytest.raises(InputError, match=r"No image can be used.\n.*junk.tif"):
        find_footprints(replace(files_of(tile_scene), images=(junk,)))


def test_footprints_lie_on_the_grid_that_the_images_are_read_on(tile_scene):
    found = find_footprints(files_of(tile_scene))
    assert found.grid.is_same(read_views(files_of(tile_scene)).grid)
    assert [path.name for path in found.files.cameras] == ["img1.tsai", "img2.tsai"]
    assert found.used == found.files
    assert not found.unused(files_of(tile_scene))


def test_unused_images_are_told_by_relative_paths_too(tile_scene, monkeypatch):
    """A run that goes on has kept absolute paths, and is asked with the paths as given."""
    found = find_footprints(files_of(tile_scene)).only([0], [])
    monkeypatch.chdir(tile_scene)
    assert found.unused(files_of(Path())) == {Path("img2.tif")}
