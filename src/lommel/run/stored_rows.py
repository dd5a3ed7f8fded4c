"""Images and terrain on the run's grid: held in memory, or waiting on the disk row by row.

Most callers want `Held`, `StoredRows` and `stacked`.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lommel.errors import LommelError


class Held:
    """Keeps what a run has found in memory, so that a run that is broken off begins anew.

    See `lommel.run.albedo_records.Kept` for runs that are worth more.
    """

    photometry = None

    def begin(self, plan):
        """Nothing is needed."""

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


class Rows:
    """Indexed by rows, and by a slice of columns, as an array is, and read anew each time.

    Attributes
    ----------
    shape : tuple of int
        Rows and columns, float32.
    """

    shape: tuple[int, int]

    def __len__(self):
        """Number of rows."""
        return self.shape[0]

    def __getitem__(self, index):
        """Some rows, or some columns of them, read anew."""
        rows, cols = index if isinstance(index, tuple) else (index, slice(None))
        if not isinstance(rows, slice):
            return self[slice(rows, rows + 1), cols][0]
        first, last, _ = rows.indices(len(self))
        return self._read(first, max(first, last), cols)

    def _read(self, first, last, cols):
        """Rows from first to before last, and of them the columns of a slice."""
        raise NotImplementedError


@dataclass(frozen=True)
class StoredRows(Rows):
    """An array in a file.

    Attributes
    ----------
    path : Path
    shape : tuple of int
    """

    path: Path
    shape: tuple[int, int]

    def _read(self, first, last, cols):
        width = self.shape[1]
        low, high, _ = cols.indices(width)
        values = np.empty((last - first, max(high - low, 0)), np.float32)
        try:
            with open(self.path, "rb") as file:
                if values.shape[1] == width:
                    self._fill(file, first * width, values)
                else:
                    for row, part in enumerate(values, first):
                        self._fill(file, row * width + low, part)
            return values
        except (OSError, ValueError) as error:  # missing, or shorter
            raise LommelError(
                f"{self.path} is damaged ({error}). The same command makes it anew; of a job "
                "array that with --tiles 0/N, before the shares."
            ) from error

    @staticmethod
    def _fill(file, place, values):
        file.seek(4 * place)
        if values.size and file.readinto(values.view(np.uint8).data) != values.nbytes:
            raise ValueError("it is too short")


@dataclass(frozen=True)
class StackedRows(Rows):
    """Arrays of the same width, one below the other.

    Attributes
    ----------
    bands : tuple of StoredRows
    """

    bands: tuple[StoredRows, ...]

    @property
    def shape(self):
        """Rows of all bands, and columns."""
        return sum(len(band) for band in self.bands), self.bands[0].shape[1]

    def _read(self, first, last, cols):
        parts, top = [], 0
        for band in self.bands:
            low, high = max(first - top, 0), min(last - top, len(band))
            if low < high or not parts:
                parts.append(band[low : max(low, high), cols])
            top += len(band)
        return parts[0] if len(parts) == 1 else np.concatenate(parts)


def stacked(bands):
    """Arrays, or what waits on the disk, one below the other as one.

    Parameters
    ----------
    bands : sequence of array or StoredRows

    Returns
    -------
    values : array or StackedRows
    """
    if all(isinstance(band, StoredRows) for band in bands):
        return StackedRows(tuple(bands))
    return np.concatenate(bands)
