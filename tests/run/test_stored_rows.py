import numpy as np
import pytest

from lommel.run.stored_rows import Held, StoredRows

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


def test_parts_are_put_together():
    parts = iter([VALUES[:3], VALUES[3:4], VALUES[4:]])
    np.testing.assert_array_equal(Held.rows("image", VALUES.shape, parts), VALUES)
