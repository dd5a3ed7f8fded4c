"""Draw the README's two pictures from the products of ``lommel demo``.

Usage: python docs/pictures.py DEMO_FOLDER
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from lommel.io.raster import read_preview

IMAGES = Path(__file__).parent / "images"


NO_DATA = "#cfc6e3"


def draw(path, panels, size, columns, one_scale=False):
    """Grey maps with axes in kilometres, on one scale if they show the same quantity."""
    rows = len(panels) // columns
    figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    previews = [read_preview(raster, 1200) for raster, _, _ in panels]
    common = np.nanpercentile(np.concatenate([p.values.ravel() for p in previews]), [0.5, 99.5])
    for axis, preview, (_, title, label) in zip(axes.flat, previews, panels, strict=True):
        values, grid = preview.values, preview.grid
        height, width = (
            count * spacing * preview.shrink / 1e3
            for count, spacing in zip(values.shape, grid.spacing, strict=True)
        )
        low, high = common if one_scale else np.nanpercentile(values, [0.5, 99.5])
        axis.set_facecolor(NO_DATA)
        image = axis.imshow(values, cmap="gray", vmin=low, vmax=high, extent=(0, width, 0, height))
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("km", fontsize=8)
        axis.tick_params(labelsize=8)
        bar = figure.colorbar(image, ax=axis, shrink=0.8, pad=0.01)
        bar.set_label(label, fontsize=8)
        bar.ax.tick_params(labelsize=8)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main(folder):
    """Draw both pictures."""
    IMAGES.mkdir(exist_ok=True)
    albedo, sfs = folder / "albedo", folder / "sfs"
    draw(
        IMAGES / "albedo.png",
        [
            (albedo / "orthomosaic.tif", "Nine images as they are, blended", "image value"),
            (
                albedo / "albedo.tif",
                "Albedo: exposures and relief taken out (lavender: shadow)",
                "albedo",
            ),
        ],
        (9.0, 6.4),
        columns=1,
    )
    draw(
        IMAGES / "terrain.png",
        [
            (sfs / "hillshade-before.tif", "Initial DEM under the image's Sun", "cos incidence"),
            (sfs / "hillshade-after.tif", "Refined by shape from shading", "cos incidence"),
        ],
        (9.0, 4.0),
        columns=2,
        one_scale=True,
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
