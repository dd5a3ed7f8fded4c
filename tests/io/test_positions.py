"""Position tables: units told apart, keys found, mistakes named."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lommel.errors import InputError, LommelError
from lommel.io import positions
from lommel.io.positions import find_position, read_positions
from lommel.scene.body import MOON

SUN_KM = (1.4e8, 5.0e7, -2.0e6)
CRAFT_KM = (1500.0, 1000.0, -300.0)


def table(folder, text, encoding="utf-8"):
    path = folder / "table.txt"
    path.write_text(text, encoding=encoding, newline="")
    return path


def line(key, vector, scale=1.0, separator=" "):
    return separator.join([key, *(repr(scale * value) for value in vector)])


@pytest.mark.parametrize(("kind", "vector"), [("sun", SUN_KM), ("spacecraft", CRAFT_KM)])
@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_kilometres_and_metres_are_told_apart(tmp_path, kind, vector, scale):
    path = table(tmp_path, line("A", vector, scale) + "\n" + line("B", vector[::-1], scale))
    found = read_positions(path, kind, MOON)
    np.testing.assert_allclose(found["A"], 1e3 * np.array(vector), rtol=1e-15)
    np.testing.assert_allclose(found["B"], 1e3 * np.array(vector[::-1]), rtol=1e-15)


@pytest.mark.parametrize(
    "text",
    [
        "# made by hand\n\nA 1500 1000 -300\n",
        "A,1500,1000,-300",
        "A\t1.5e3\t 1e3\t-3e2\r\n",
        "\ufeffA 1500 1000 -300\n",
        "A 1500 1000 -300\nA 1500.0 1e3 -300\n",
    ],
    ids=["comments", "commas", "tabs", "byte order mark", "the same twice"],
)
def test_every_way_to_write_a_line_is_read(tmp_path, text):
    found = read_positions(table(tmp_path, text), "spacecraft", MOON)
    assert list(found) == ["A"]
    np.testing.assert_array_equal(found["A"], 1e3 * np.array(CRAFT_KM))


def test_unit_that_is_named_is_obeyed(tmp_path):
    """A telescope on the Earth stands 221 radii away, where no spacecraft is expected."""
    path = table(tmp_path, "A 384400 0 0")
    assert read_positions(path, "spacecraft", MOON, "km")["A"][0] == 384_400_000.0
    with pytest.raises(InputError, match="neither in km nor in m. Check the table, or name"):
        read_positions(path, "spacecraft", MOON)


def test_position_inside_the_body_is_an_error_in_any_unit(tmp_path):
    path = table(tmp_path, "A 1500 1000 -300")
    with pytest.raises(InputError, match="distances from 1828 to 1828 .* not in m"):
        read_positions(path, "spacecraft", MOON, "m")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("A 1 2\n", r"line 1: 'A 1 2' is not a position\. Write KEY x y z, three finite"),
        ("A 1500 1000 -300\nB 1 2 3 4\n", "line 2: 'B 1 2 3 4' is not a position"),
        ("A 1 2 east\n", "is not a position"),
        ("A 1 nan 2\n", "is not a position"),
        ("A 1 1e999 2\n", "is not a position"),
        ("", "holds no position"),
        ("# nothing\n\n", "holds no position"),
        ("A 1500 1000 -300\nA 1500 1000 -301\n", "key 'A' stands twice with different positions"),
        ("A 0 0 0\n", "neither in km nor in m"),
        ("A 1e300 1e300 1e300\n", "distances from inf to inf"),
        ("A 1500 1000 -300\nB 1500e3 1000e3 -300e3\n", "neither in km nor in m"),
    ],
)
def test_unusable_table_is_an_error(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read_positions(table(tmp_path, text), "spacecraft", MOON)


def test_a_position_beyond_the_solar_system_is_an_error_even_with_its_unit_named(tmp_path):
    with pytest.raises(InputError, match="distances from 2e.151"):
        read_positions(table(tmp_path, "A 0 0 2e151"), "sun", MOON, "km")


def test_unit_that_does_not_exist_is_an_error(tmp_path):
    with pytest.raises(InputError, match=r"unit = 'miles' is not known\. Choose auto, m or km"):
        read_positions(table(tmp_path, "A 1500 1000 -300"), "spacecraft", MOON, "miles")


def test_file_that_is_no_text_is_an_error(tmp_path):
    for path in (tmp_path / "nowhere.txt", tmp_path, table(tmp_path, "é 1 2 3", "latin-1")):
        with pytest.raises(InputError, match="cannot be read as a position table"):
            read_positions(path, "sun", MOON)


def test_file_of_any_size_is_read_up_to_the_limit_only(tmp_path, monkeypatch):
    monkeypatch.setattr(positions, "SIZE_LIMIT", 1000)
    with pytest.raises(InputError, match="is larger than 1000 characters"):
        read_positions(table(tmp_path, "A" * 2000), "sun", MOON)


def test_longest_beginning_of_the_file_name_wins():
    known = {"AS16-M-01": np.zeros(3), "AS16-M-0164": np.ones(3), "AS16-M-0164.tif": np.full(3, 2)}
    assert find_position(known, "AS16-M-0164.tif", "t")[0] == 2
    assert find_position(known, "AS16-M-0164.cub", "t")[0] == 1
    assert find_position(known, "AS16-M-0101.tif", "t")[0] == 0


def test_image_without_an_entry_is_named_with_the_table():
    with pytest.raises(InputError, match=r"sun\.txt has no entry for B\.tif\. Add a line KEY"):
        find_position({"A": np.zeros(3)}, "B.tif", "sun.txt")


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.one_of(
        st.binary(max_size=200),
        st.text(alphabet="A #,.+-eE0123456789nainf\t\n_", max_size=120).map(str.encode),
        st.lists(st.tuples(*[st.floats()] * 3), max_size=4).map(
            lambda rows: "\n".join(line(f"K{n}", row) for n, row in enumerate(rows)).encode()
        ),
    ),
    st.sampled_from(["sun", "spacecraft"]),
    st.sampled_from(["auto", "m", "km"]),
)
def test_any_bytes_give_positions_outside_the_body_or_an_error(tmp_path, content, kind, unit):
    path = tmp_path / "table.txt"
    path.write_bytes(content)
    try:
        found = read_positions(path, kind, MOON, unit)
    except LommelError:
        return
    assert all(np.linalg.norm(vector) > MOON.radius for vector in found.values())
