"""How many of 24 images of the same ground shape from shading needs, and which.

Images are taken in the order of the choice (`lommel.estimate.image_choice`), and as many at random.
In ``passes`` 12, 6, 4 and 2 images were taken under nearly one Sun each, in ``spread`` Suns stand
anywhere from 12 to 65 degrees high; 384 x 384 posts, albedo of 10 % rms, noise of 0.75 %.
Height error in metres, slope error in degrees:

    images   passes 1     passes 2     spread 1     random, m (three draws each)
    3        0.158 0.262  0.088 0.165  0.148 0.206  0.13 to 0.85, 0.29 to 5.03, 0.33 to 0.59
    4        0.114 0.201  0.084 0.154  0.105 0.147  0.11 to 12.0, 0.08 to 9.57, 0.12 to 0.16
    6        0.109 0.188  0.072 0.133  0.090 0.131  0.11 to 0.41, 0.09 to 8.67, 0.10 to 0.40
    8        0.098 0.163  0.069 0.122  0.089 0.116  0.10 to 0.17, 0.07 to 0.19, 0.10 to 0.16
    12       0.094 0.153  0.065 0.113  0.086 0.105  0.10 to 0.11, 0.07 to 0.07, 0.09 to 0.09
    24       0.092 0.147  0.064 0.110  0.085 0.103

Beyond 8 another image lowers the error of the slopes by some 2 % and makes the run longer by some
10 %: `LEAST_GAIN`, 5 % of the expected error, takes 7 to 9 of these 24. Without `SLOPE_LIMIT` the
lowest Suns came first: two of 13 and 14 degrees left 2.6 m, two at random 0.8 to 1.2 m.

    python design/sfs_image_choice.py FOLDER      # with benchmarks/ on the path
"""

import sys
from pathlib import Path

import numpy as np
from benchmarks.choice import SCENES, make_many
from benchmarks.one import accuracy

from lommel.estimate import image_choice
from lommel.run.footprints import find_footprints
from lommel.run.inputs import SceneFiles
from lommel.run.selection import SKETCH, find_sights
from lommel.run.shape_from_shading import SfsSettings, run_shape_from_shading

COUNTS = (3, 4, 6, 8, 12, 24)
DRAWS = 3


def main(folder):
    """Print the table."""
    for kind, seed in SCENES:
        place = make_many(kind, seed, folder)
        files = SceneFiles(
            tuple(sorted(place.glob("img*.tif"))),
            (place / "init_dem.tif",),
            place / "sun_positions.txt",
        )
        chosen, random = order(files), np.random.default_rng(5)
        for count in COUNTS:
            print(kind, seed, count, "chosen", error(files, chosen[:count]), flush=True)
            for _ in range(DRAWS if count < 24 else 0):
                drawn = random.choice(24, count, replace=False)
                print(kind, seed, count, "random", error(files, drawn), flush=True)


def order(files):
    """Images in the order in which they raise the log determinant most, over all places."""
    footprints, ground, sights = find_sights(find_footprints(files, sketch=SKETCH), "lunar-lambert")
    left = list(range(len(footprints.files.images)))
    known = np.zeros((ground.heights.size, 6))
    known[:, [0, 2]] = image_choice.SLOPE_ERROR**-2.0
    known[:, 5] = image_choice.ALBEDO_ERROR**-2.0
    taken = []

    def raised(image):
        mine = sights.image == image
        with_it = known.copy()
        with_it[sights.place[mine]] += sights.information[mine]
        return with_it

    while left:
        best = max(left, key=lambda image: np.log(image_choice.told(raised(image))[0]).sum())
        known = raised(best)
        left.remove(best)
        taken.append(best)
    return taken


def error(files, images):
    """Errors of height, m, and slope, degrees."""
    some = tuple(files.images[k] for k in sorted(images))
    place = files.dems[0].parent
    files = SceneFiles(some, files.dems, files.sun_positions)
    run_shape_from_shading(files, place / "out", SfsSettings(all_images=True), overwrite=True)
    found = accuracy(place, place / "out")
    return f"{found['height_rmse_m']:.3f} {found['slope_rmse_deg']:.3f}"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
