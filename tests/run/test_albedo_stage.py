import csv
import json
import shutil

import numpy as np
import pytest

from lommel.errors import InputError
from lommel.io.raster import read_grid, read_pixels, write_raster
from lommel.run.albedo import albedo_settings, run_albedo
from lommel.run.demo import exposure_errors
from lommel.run.inputs import SceneFiles

from .albedo_scene import files_of, own_photometry


@pytest.fixture(scope="module")
def product(ground, tmp_path_factory):
    output = tmp_path_factory.mktemp("albedo") / "out"
    results = run_albedo(files_of(ground), output, own_photometry())
    return output, results


def read_table(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_folder_holds_the_products_of_the_stage(product):
    output, _ = product
    assert {path.name for path in output.iterdir()} == {
        "albedo.tif",
        "orthomosaic.tif",
        "count.tif",
        "residual.tif",
        "exposures.csv",
        "run.json",
    }
    grids = [read_grid(path) for path in output.glob("*.tif")]
    assert all(grid.is_same(grids[0]) for grid in grids)


def test_exposures_are_those_of_the_scene(product, ground):
    output, results = product
    errors = exposure_errors(output / "exposures.csv", ground.truth_exposures)
    assert errors["rms_percent"] < 2.0  # the DEM is coarse: 8 km posts
    assert results["images"] == len(ground.images)
    assert results["disagreement_after_percent"] < results["disagreement_before_percent"]


def test_table_lists_every_image_with_errors(product, ground):
    table = read_table(product[0] / "exposures.csv")
    assert [row["image"] for row in table] == [path.name for path in ground.images]
    assert list(table[0]) == [
        "image",
        "exposure",
        "exposure_error",
        "haze",
        "haze_error",
        "used",
        "group",
        "reason",
    ]
    assert all(float(row["exposure_error"]) > 0 and row["used"] == "1" for row in table)
    assert {row["group"] for row in table} == {"1"}
    assert np.mean([float(row["exposure"]) for row in table]) == pytest.approx(1.0)


def test_record_tells_settings_stages_and_outcome(product):
    record = json.loads((product[0] / "run.json").read_text(encoding="utf-8"))
    assert record["command"] == "albedo"
    assert record["settings"]["solver"] == "projection"
    assert [stage["name"] for stage in record["stages"]] == [
        "place",
        "read",
        "solve",
        "write",
    ]
    assert record["outcome"]["name"] == "converged"
    assert record["history"][-1]["cost"] <= record["history"][0]["cost"]
    assert "phase_c1_per_rad" not in record["results"]


def test_posts_with_albedo_are_those_with_images(product):
    output, _ = product
    count = read_pixels(output / "count.tif")
    np.testing.assert_array_equal(count > 0, np.isfinite(read_pixels(output / "albedo.tif")))


def test_image_elsewhere_is_listed_with_its_reason(ground, tmp_path):
    source = ground.images[0]
    grid = read_grid(source)
    away = tmp_path / "away.tif"
    moved = grid.affine @ type(grid.affine).translation(20 * grid.shape[1], 0)
    far = type(grid)(grid.shape, moved, grid.crs, grid.body)
    write_raster(away, read_pixels(source), far, "brightness")
    run_albedo(files_of(ground, [*ground.images, away]), tmp_path / "out", own_photometry())
    row = read_table(tmp_path / "out" / "exposures.csv")[-1]
    assert (row["image"], row["used"], row["exposure"]) == ("away.tif", "0", "")
    assert "does not overlap" in row["reason"]
    record = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert record["skipped"] == [{"image": "away.tif", "reason": row["reason"]}]


def test_black_image_is_left_out_and_the_run_goes_on(ground, tmp_path):
    dark = tmp_path / ground.images[2].name
    write_raster(
        dark,
        0.1 * np.ones(read_grid(ground.images[2]).shape, np.float32),
        read_grid(ground.images[2]),
        "brightness",
    )
    images = [*ground.images[:2], dark, *ground.images[3:]]
    results = run_albedo(files_of(ground, images), tmp_path / "out", own_photometry())
    assert results["images"] == len(ground.images) - 1
    row = read_table(tmp_path / "out" / "exposures.csv")[2]
    assert row["used"] == "0"
    assert row["group"] == ""
    assert "every pixel is shadow" in row["reason"]


def test_one_image_is_enough_and_says_what_is_missing(ground, tmp_path):
    run_albedo(files_of(ground, ground.images[:1]), tmp_path / "out", own_photometry())
    record = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert "One image only" in record["outcome"]["sentence"]
    assert record["results"]["disagreement_after_percent"] is None


def test_nothing_is_left_when_the_run_fails(ground, tmp_path):
    with pytest.raises(InputError, match="No sun positions given"):
        run_albedo(
            SceneFiles(ground.images, (ground.initial_dem,)), tmp_path / "out", own_photometry()
        )
    assert list(tmp_path.iterdir()) == []


def test_folder_that_exists_is_not_touched(product, ground):
    with pytest.raises(InputError, match="--overwrite"):
        run_albedo(files_of(ground), product[0], own_photometry())


def test_missing_table_entry_leaves_the_image_out(ground, tmp_path):
    lines = ground.sun_positions.read_text(encoding="utf-8").splitlines()
    table = tmp_path / "sun.txt"
    kept = [line for line in lines if not line.startswith(ground.images[1].stem)]
    table.write_text("\n".join(kept) + "\n", encoding="utf-8")
    files = SceneFiles(ground.images, (ground.initial_dem,), table, ground.spacecraft_positions)
    results = run_albedo(files, tmp_path / "out", own_photometry())
    assert results["images"] == len(ground.images) - 1
    reasons = [row["reason"] for row in read_table(tmp_path / "out" / "exposures.csv")]
    assert any("has no entry for" in reason for reason in reasons)


def test_published_iteration_comes_with_its_own_settings():
    published = albedo_settings("alternating")
    assert (published.loss, published.haze, published.fit_phase_factor) == (
        "least-squares",
        False,
        False,
    )
    assert published.reflectance == "lunar-lambert-exponential"
    assert albedo_settings("alternating", haze=True).haze
    assert albedo_settings(shadow_threshold=0.2).masks.shadow_threshold == 0.2


def test_truncated_image_is_left_out(ground, tmp_path):
    broken = tmp_path / ground.images[3].name
    shutil.copy(ground.images[3], broken)
    broken.write_bytes(broken.read_bytes()[:400])
    images = [*ground.images[:3], broken, *ground.images[4:]]
    results = run_albedo(files_of(ground, images), tmp_path / "out", own_photometry())
    assert results["images"] == len(ground.images) - 1
