"""Arrays that wait on the disk are read as if they were in memory."""

import numpy as np
import pytest

from lommel.errors import LommelError
from lommel.run.stored_rows import Held, StoredRows, stacked

VALUES = np.arange(35, dtype=np.float32).reshape(7, 5)
VALUES[2, 3] = np.nan


@pytest.mark.parametrize(
    "index", [slice(None), slice(2, 5), slice(6, 99), slice(5, 5), 3, np.s_[2:5, 1:3], np.s_[4, 2:]]
)
def test_stored_rows_are_those_of_the_array(index, tmp_path):
    VALUES.tofile(tmp_path / "rows")
    stored = StoredRows(tmp_path / "rows", VALUES.shape)
    assert len(stored) == 7
    np.testing.assert_array_equal(stored[index], VALUES[index])


@pytest.mark.parametrize("index", [np.s_[2:5, 1:3], np.s_[3:3], 4, slice(None)])
def test_stacked_rows_are_those_of_the_array(index, tmp_path):
    bands = []
    for first, last in ((0, 2), (2, 4), (4, 7)):
        VALUES[first:last].tofile(tmp_path / f"rows{first}")
        bands.append(StoredRows(tmp_path / f"rows{first}", (last - first, 5)))
    np.testing.assert_array_equal(stacked(bands)[index], VALUES[index])


@pytest.mark.parametrize("index", [slice(None), np.s_[:, 1:3]])
def test_rows_that_are_cut_off_are_an_error(index, tmp_path):
    VALUES[:6].tofile(tmp_path / "rows")
    with pytest.raises(LommelError, match="is damaged"):
        StoredRows(tmp_path / "rows", VALUES.shape)[index]


def test_parts_are_put_together():
    parts = iter([VALUES[:3], VALUES[3:4], VALUES[4:]])
    np.testing.assert_array_equal(Held.rows("image", VALUES.shape, parts), VALUES)
