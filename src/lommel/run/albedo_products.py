"""The rasters of `lommel albedo`, written while the last pass over the images runs.

Most callers want `Products`.
"""

from contextlib import ExitStack

import numpy as np

from lommel.estimate.albedo_maps import MapRows
from lommel.io.raster import raster_writer
from lommel.scene.grid import Window

THIN_POSTS = 2**20  # of the map kept to judge its brightness as a whole
DETAIL_POSTS = 2**20  # of the part in the middle kept to look for shading


class Products:
    """Writes maps row by row and keeps what it takes to judge them; open only inside ``with``.

    Parameters
    ----------
    folder : Path
    grid : Grid

    Attributes
    ----------
    thin : MapRows
        Every so-manieth row and column, at most about `THIN_POSTS`.
    middle : Window
        At most about `DETAIL_POSTS`.
    detail : float32 array (middle.rows, middle.cols)
        The albedo there.
    """

    def __init__(self, folder, grid):
        self.folder, self.grid = folder, grid
        rows, cols = grid.shape
        self.step = max(1, int(np.ceil(np.sqrt(rows * cols / THIN_POSTS))))
        shape = -(-rows // self.step), -(-cols // self.step)
        self.thin = MapRows(
            *(np.empty(shape, np.float32) for _ in range(3)), np.empty(shape, np.int32)
        )
        share = min(1.0, np.sqrt(DETAIL_POSTS / (rows * cols)))
        size = max(2, int(share * rows)), max(2, int(share * cols))
        self.middle = Window((rows - size[0]) // 2, (cols - size[1]) // 2, *size)
        self.detail = np.empty(size, np.float32)

    def __enter__(self):
        """Open the four rasters."""
        with ExitStack() as stack:
            planes = (
                ("albedo", "albedo, mean exposure 1", "1", np.float32, np.nan),
                ("orthomosaic", "mean image value", "", np.float32, np.nan),
                ("count", "images used", "", np.uint16, None),
                ("residual", "standard error of the albedo", "percent", np.float32, np.nan),
            )
            self.writers = {
                name: stack.enter_context(
                    raster_writer(self.folder / f"{name}.tif", self.grid, *plane)
                )
                for name, *plane in planes
            }
            self.stack = stack.pop_all()
        return self

    def __exit__(self, *error):
        """Finish the rasters, or remove them after an error."""
        return self.stack.__exit__(*error)

    def take(self, first, rows):
        """Write and keep some rows."""
        size = len(rows.albedo)
        window = Window(first, 0, size, self.grid.shape[1])
        planes = {
            "albedo": rows.albedo,
            "orthomosaic": rows.orthomosaic,
            "count": rows.count,
            "residual": 100.0 * rows.albedo_error / rows.albedo,
        }
        for name, values in planes.items():
            self.writers[name](values, window)
        every = -first % self.step
        start = (first + every) // self.step
        for name, part in vars(rows).items():
            kept = part[every :: self.step, :: self.step]
            getattr(self.thin, name)[start : start + len(kept)] = kept
        here = window.intersection(self.middle)
        if not here.is_empty:
            inside = here.relative_to(self.middle).slices
            self.detail[inside] = rows.albedo[here.relative_to(window).slices]
