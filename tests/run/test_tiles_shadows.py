"""A ridge casts its shadow over tiles that do not hold it."""

import numpy as np

from lommel.io.raster import read_pixels, write_raster
from lommel.run.inputs import SceneFiles
from lommel.run.shape_from_shading import SfsSettings, run_shape_from_shading
from lommel.run.tiles_plan import Tiling, halo
from lommel.scene.body import MOON, local_frame, to_xyz
from lommel.scene.grid import grid_from_bounds, read_crs
from lommel.scene.masks import MaskSettings

SPACING, SIDE, RIDGE, HEIGHT = 20.0, 128, 60, 400.0  # m, posts, post, m
SUN_ELEVATION = np.radians(2.5)


def test_shadow_from_outside_a_tile_is_masked(tmp_path):
    rows, cols = 160, 1100
    size = cols * SPACING / 2, rows * SPACING / 2
    crs = read_crs("+proj=eqc +lon_0=0 +R=1737400 +units=m +no_defs")
    grid = grid_from_bounds((-size[0], -size[1], size[0], size[1]), SPACING, crs)
    rows, cols = grid.shape
    rng = np.random.default_rng(3)
    col = np.arange(cols)
    profile = HEIGHT * np.exp(-(((col - RIDGE) / 16) ** 2))
    heights = np.broadcast_to(profile, grid.shape) + rng.normal(0, 0.3, grid.shape)
    slope = np.arctan(np.gradient(profile, SPACING))
    lit = 1000 * np.sin(np.maximum(SUN_ELEVATION + slope, 0))  # the Sun stands in the west
    reach = RIDGE + int(HEIGHT / np.tan(SUN_ELEVATION) / SPACING)
    is_shadow = (col > RIDGE) & (col < reach)
    image = np.where(is_shadow, 15.0, lit) * rng.normal(1, 0.01, grid.shape)
    write_raster(tmp_path / "dem.tif", heights.astype(np.float32), grid, "height", "m")
    write_raster(tmp_path / "image.tif", image.astype(np.float32), grid, "brightness")
    east, _, up = local_frame(0.0, 0.0)
    sun = 1.5e11 * (np.sin(SUN_ELEVATION) * up - np.cos(SUN_ELEVATION) * east)
    for name, place in (("sun", sun), ("craft", to_xyz(MOON, 0.0, 0.0, 1e5))):
        line = "image " + " ".join(f"{v / 1e3:.6f}" for v in place)
        (tmp_path / f"{name}.txt").write_text(line + "\n")
    files = SceneFiles(
        (tmp_path / "image.tif",),
        (tmp_path / "dem.tif",),
        tmp_path / "sun.txt",
        tmp_path / "craft.txt",
    )
    settings = SfsSettings(reflectance="lambert", masks=MaskSettings(shadow_threshold=0.0))
    run_shape_from_shading(files, tmp_path / "out", settings, tiling=Tiling(side=SIDE))
    known = np.isfinite(read_pixels(tmp_path / "out" / "measured.tif"))
    # of a tile that begins beyond the ridge, halo and all; the refined ridge is a little lower
    far = slice(3 * SIDE, 3 * SIDE + 24)
    assert far.start - halo(SIDE) > RIDGE + 48 and far.stop < reach - 48  # posts
    assert known[:, far].mean() < 0.05
    assert known[:, reach + 16 :].mean() > 0.95
