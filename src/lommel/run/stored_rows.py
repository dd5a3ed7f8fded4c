"""Images and terrain on the run's grid: held in memory, or waiting on the disk row by row.

Most callers want `Held` and `StoredRows`.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np


class Held:
    """Keeps what a run has found in memory, so that a run that is broken off begins anew.

    See `lommel.run.albedo_records.Kept` for runs that are worth more.
    """

    photometry = None

    @staticmethod
    def rows(name, shape, parts):
        """Parts of an array, one below the other.

        Parameters
        ----------
        name : str
            Of the array; only one that is kept needs it.
        shape : tuple of int
        parts : iterable of float32 array (some rows, cols)

        Returns
        -------
        values : float32 array (rows, cols)
        """
        values, row = np.empty(shape, np.float32), 0
        for part in parts:
            values[row : row + len(part)] = part
            row += len(part)
        return values

    def remove(self):
        """Nothing is left."""


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

    def __getitem__(self, index):
        """Some rows, or some columns of them, read anew."""
        rows, *cols = index if isinstance(index, tuple) else (index,)
        if not isinstance(rows, slice):
            return self[(slice(rows, rows + 1), *cols)][0]
        first, last, _ = rows.indices(len(self))
        size, width = max(last - first, 0), self.shape[1]
        values = np.fromfile(self.path, np.float32, size * width, offset=4 * first * width)
        return values.reshape(size, width)[(slice(None), *cols)]
