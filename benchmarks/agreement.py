"""How well a scene in tiles agrees with the same scene in one piece, and both with the truth.

    python -m benchmarks.agreement --posts 1000 --images 4 --folder /tmp/agreement

Prints standard deviations of heights, a border of 128 posts left out.
"""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.scenes import Scene, make_scene
from lommel.io.raster import read_pixels
from lommel.run.inputs import SceneFiles
from lommel.run.shape_from_shading import run_shape_from_shading
from lommel.run.tiles_plan import Tiling

BORDER = 128  # posts


def main():
    """Make, refine twice, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--posts", type=int, default=1000)
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--side", type=int, default=512, help="posts of a tile without its halo")
    parser.add_argument("--folder", type=Path, default=Path("benchmarks/output/agreement"))
    given = parser.parse_args()
    folder = given.folder
    make_scene(Scene(given.posts, given.images, given.seed), folder)
    images = tuple(sorted(folder.glob("img*.tif")))
    files = SceneFiles(images, (folder / "init_dem.tif",), folder / "sun_positions.txt")
    run_shape_from_shading(files, folder / "one", overwrite=True)
    run_shape_from_shading(files, folder / "many", overwrite=True, tiling=Tiling(side=given.side))
    inside = (slice(BORDER, -BORDER),) * 2
    truth, one, many = (
        read_pixels(folder / name)[inside].astype(float)
        for name in ("truth_dem.tif", "one/dem.tif", "many/dem.tif")
    )
    error, difference = np.std(one - truth), np.std(many - one)
    print(f"error in one piece {error:.4f} m, in tiles {np.std(many - truth):.4f} m")
    print(f"difference {difference:.4f} m, {difference / error:.3f} of the error")
    print(f"of neighbouring posts {np.std(np.diff(many - one, axis=1)):.4f} m")


if __name__ == "__main__":
    main()
