from contextlib import closing

import numpy as np
import pytest

from lommel.errors import InputError
from lommel.run import stored_rows
from lommel.run.stored_rows import RowStore
from lommel.scene.geometry import Observation
from lommel.scene.grid import Window


def image(rows=7, cols=5):
    values = np.arange(rows * cols, dtype=np.float32).reshape(rows, cols)
    values[2, 3] = np.nan
    return Observation("a.tif", Window(0, 0, rows, cols), values, np.zeros(3), np.zeros(3))


@pytest.mark.parametrize("rows", [slice(None), slice(2, 5), slice(6, 99), slice(5, 5), 3])
def test_stored_rows_are_those_of_the_array(rows, tmp_path, monkeypatch):
    monkeypatch.setattr(stored_rows, "HELD_BYTES", 0)
    with closing(RowStore(tmp_path)) as store:
        stored = store(image()).measured
        assert not isinstance(stored, np.ndarray) and stored.shape == (7, 5) and len(stored) == 7
        np.testing.assert_array_equal(stored[rows], image().measured[rows])
    assert not list(tmp_path.iterdir())


def test_images_stay_in_memory_as_far_as_they_fit(tmp_path, monkeypatch):
    monkeypatch.setattr(stored_rows, "HELD_BYTES", 2 * 7 * 5 * 4)
    with closing(RowStore(tmp_path)) as store:
        kinds = [isinstance(store(image()).measured, np.ndarray) for _ in range(3)]
    assert kinds == [True, True, False]


def test_folder_that_cannot_hold_the_rows_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(stored_rows, "HELD_BYTES", 0)
    with pytest.raises(InputError, match="gone.*--output"):
        RowStore(tmp_path / "gone")(image())
