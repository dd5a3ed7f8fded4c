"""Images on the run's grid that do not fit in memory: their rows wait on the disk.

Most callers want `RowStore`.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lommel.errors import InputError

HELD_BYTES = 2**28  # of images in memory; what comes beyond goes to the disk


@dataclass(frozen=True)
class StoredRows:
    """An array in a file, read some rows at a time; it is indexed by rows as an array is.

    Attributes
    ----------
    path : Path
    shape : tuple of int
        Rows and columns, float32.
    """

    path: Path
    shape: tuple[int, int]

    def __len__(self):
        """Number of rows."""
        return self.shape[0]

    def __getitem__(self, rows):
        """Some rows, read anew."""
        if not isinstance(rows, slice):
            return self[rows : rows + 1][0]
        first, last, _ = rows.indices(len(self))
        size, cols = max(last - first, 0), self.shape[1]
        values = np.fromfile(self.path, np.float32, size * cols, offset=4 * first * cols)
        return values.reshape(size, cols)


class RowStore:
    """Keeps observations, the first ones in memory and the others on the disk.

    Parameters
    ----------
    folder : Path
        Where files are written; removed by `close`.
    """

    def __init__(self, folder):
        self.folder, self.held, self.paths = Path(folder), 0, []

    def __call__(self, observation):
        """The observation, its image where it fits."""
        measured = observation.measured
        if self.held + measured.nbytes <= HELD_BYTES:
            self.held += measured.nbytes
            return observation
        path = self.folder / f".{len(self.paths)}.rows"
        self.paths.append(path)
        try:
            measured.tofile(path)
        except OSError as error:
            raise InputError(
                f"{path} cannot be written: {error}. Images beyond {HELD_BYTES / 1e6:.0f} MB wait "
                "on the disk; free some, name another --output or give a larger --spacing."
            ) from error
        return replace(observation, measured=StoredRows(path, measured.shape))

    def close(self):
        """Remove the files."""
        for path in self.paths:
            path.unlink(missing_ok=True)
