"""Lines for logs: how many, and what they say of the time left."""

import pytest

from lommel.progress import Lines, seconds_left, silent, step


class Clock:
    """Counts the seconds that the test lets pass."""

    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def log():
    clock, lines = Clock(), []
    return clock, lines, Lines(lines.append, clock)


def test_line_tells_time_left_from_the_first_tile_on(log):
    clock, lines, progress = log
    for _ in progress(range(49), "tiles"):
        clock.now += 120
        if len(lines) == 1:
            break
    assert lines == ["tiles 1 of 49, 2 min so far, 1 h 36 min left"]


def test_lines_come_once_a_minute_whatever_the_number_of_parts(log):
    clock, lines, progress = log
    for _ in progress(range(1000), "tiles"):
        clock.now += 0.5
    assert lines[0] == "tiles 120 of 1000, 60 s so far, 7 min left"
    assert lines[-1] == "tiles 1000 of 1000, 8 min"
    assert len(lines) == 9


def test_lines_of_one_step_after_the_other_keep_apart(log):
    clock, lines, progress = log
    for number in range(10):
        for _ in progress(range(100), f"pass {number + 1}, block"):
            clock.now += 0.04
    assert lines == []  # ten times 4 s
    with step(progress, "coarse grid"):
        clock.now += 300
    assert lines == ["coarse grid, 5 min"]


def test_step_of_unknown_length_tells_what_is_done(log):
    clock, lines, progress = log
    for _ in progress(iter(range(3)), "passes"):
        clock.now += 40
    assert lines == ["passes 2, 80 s so far", "passes 3, 2 min"]


def test_time_left_counts_the_first_round_of_workers_as_done():
    assert seconds_left(1, 49, 120.0, at_once=8) == 120.0 * 41 / 8
    assert seconds_left(3, 3, 10.0, at_once=8) == 0.0
    assert seconds_left(16, 48, 240.0, at_once=8) == 480.0


def test_what_fails_within_a_step_is_not_swallowed(log):
    for progress in (log[2], silent):
        with pytest.raises(ZeroDivisionError), step(progress, "surface"):
            raise ZeroDivisionError
