"""The arithmetic of the whole Apollo Zone, and the page that shows it."""

from pathlib import Path

import pytest
from benchmarks import zone

PAGE = Path(__file__).resolve().parents[2] / "docs" / "scaling.md"


def test_page_shows_the_table_that_the_program_prints():
    assert zone.as_page() in PAGE.read_text(encoding="utf-8")


def test_frames_lie_within_the_zone_and_cover_it_evenly():
    placed = zone.zone_scene()
    windows = [place.window for place in placed.places]
    assert len(windows) == zone.FRAMES
    assert min(w.row for w in windows) == min(w.col for w in windows) == 0
    assert max(w.row + w.rows for w in windows) == zone.ROWS == placed.grid.shape[0]
    assert max(w.col + w.cols for w in windows) == zone.COLS == placed.grid.shape[1]


def test_zone_is_18_percent_of_the_moon():
    moon = 4 * 3.14159 * 1737.4e3**2  # m²
    assert zone.ROWS * zone.COLS * zone.SPACING**2 / moon == pytest.approx(0.18, abs=0.002)


def test_images_of_a_tile_are_those_of_a_place_and_of_frames_that_end_in_it():
    tile = 4352 / zone.SIDE
    assert zone.IN_TILE == round(zone.CHOSEN * (1 + tile) ** 2)
