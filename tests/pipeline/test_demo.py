"""Recovery: simulate, estimate, compare, with a strip small enough for every test run."""

import csv
import json

import pytest

from lommel.errors import InputError
from lommel.io.raster import read_pixels
from lommel.run.demo import TARGETS, exposure_errors, run_demo

STRIP = """
[grid]
rows = 200
cols = 600
spacing = 840.0
"""


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    strip = folder / "strip.toml"
    strip.write_text(STRIP, encoding="utf-8")
    named = []

    def progress(items, name, total=None, at_once=1):
        named.append(name.split(":")[0])
        return items

    results = run_demo(folder / "out", progress=progress, strip=strip)
    return folder / "out", results, named


def test_exposures_return_within_one_per_cent(demo):
    assert demo[1]["exposure_rms_percent"] < 1.0


def test_albedo_returns_within_five_per_cent(demo):
    """At half the resolution of the full demo, which has to reach 3 %."""
    assert demo[1]["albedo_rms_percent"] < 5.0


def test_refined_heights_err_by_less_than_a_third_of_the_initial_ones(demo):
    results = demo[1]
    assert results["height_rmse_after_m"] < results["height_rmse_before_m"] / 3
    assert results["slope_rmse_after_deg"] < results["slope_rmse_before_deg"] / 3


def test_record_states_results_targets_and_final_paths(demo):
    folder, results, _ = demo
    record = json.loads((folder / "run.json").read_text())
    assert record["command"] == "demo"
    assert record["results"] == pytest.approx(results)
    assert record["targets"] == TARGETS
    assert [stage["name"] for stage in record["stages"]] == ["simulate", "albedo", "sfs"]
    for path in folder.rglob("run.json"):
        assert ".partial" not in path.read_text()


def test_every_stage_reports_its_progress(demo):
    assert {"simulate strip", "simulate close-up", "albedo", "shape from shading"} <= set(demo[2])


def test_products_lie_where_they_are_expected(demo):
    folder = demo[0]
    assert read_pixels(folder / "albedo" / "albedo.tif").size >= 200 * 600
    assert read_pixels(folder / "sfs" / "dem.tif").shape == (300, 300)
    assert (folder / "scene" / "strip" / "truth-exposures.csv").exists()


def test_exposures_are_matched_by_name_up_to_a_factor(tmp_path):
    tables = {
        "truth.csv": [("a.tif", 1.0), ("b.tif", 2.0), ("c.tif", 4.0)],
        "found.csv": [("c.tif", 8.0), ("a.tif", 2.0), ("b.tif", 4.0), ("other.tif", 9.0)],
    }
    for name, rows in tables.items():
        with open(tmp_path / name, "w", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows([("image", "exposure"), *rows])
    errors = exposure_errors(tmp_path / "found.csv", tmp_path / "truth.csv")
    assert errors["count"] == 3
    assert errors["rms_percent"] == 0.0


def test_table_without_exposures_is_an_error(tmp_path):
    (tmp_path / "table.csv").write_text("name,value\na,1\n", encoding="utf-8")
    with pytest.raises(InputError, match="needs the columns image and exposure"):
        exposure_errors(tmp_path / "table.csv", tmp_path / "table.csv")
