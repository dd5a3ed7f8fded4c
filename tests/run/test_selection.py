"""Few images chosen of many: what is used, what is told, and that it is decided once."""

import json
from dataclasses import replace

import numpy as np
import pytest
from benchmarks.scenes import Scene, make_scene

from lommel.errors import LommelError
from lommel.io.raster import read_grid, read_pixels, write_raster
from lommel.run import selection
from lommel.run.inputs import GridSettings
from lommel.run.orthoproject import run_orthoproject
from lommel.run.selection import FEW, survey_images
from lommel.run.shape_from_shading import SfsSettings, run_shape_from_shading
from lommel.run.tiles_array import prepare_array
from lommel.run.tiles_plan import Tiling, make_plan, plan_tiles
from lommel.scene.grid import Window

from .tiled_scene import files_of

SUNS = (*[(80.0 + k, 35.0) for k in range(9)], (200.0, 40.0), (320.0, 30.0), (322.0, 31.0))
CAMERAS = tuple((30.0 * k, 5.0) for k in range(12))
BORDER = 8  # posts


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """Twelve images of the same ground, nine of them under nearly one Sun."""
    folder = tmp_path_factory.mktemp("many")
    make_scene(Scene(160, 12, seed=5, noise=0.0075, suns_deg=SUNS, cameras_deg=CAMERAS), folder)
    return folder


@pytest.fixture(scope="module")
def solved(many, tmp_path_factory):
    output = tmp_path_factory.mktemp("solved")
    for name in ("chosen", "all"):
        run_shape_from_shading(files_of(many), output / name, SfsSettings(all_images=name == "all"))
    return output


def survey(files, output, **settings):
    return survey_images(files, GridSettings(), SfsSettings(**settings), output)


def test_few_images_are_all_used(tile_scene, tmp_path):
    found = survey(files_of(tile_scene), tmp_path / "out")
    assert found.used == found.files
    assert not found.not_chosen and not found.results


def test_of_many_images_each_light_is_used_and_not_each_image(many, tmp_path):
    found = survey(files_of(many), tmp_path / "out")
    names = {path.name for path in found.used.images}
    assert 3 <= len(names) < 12
    assert "img10.tif" in names and names & {"img11.tif", "img12.tif"}
    assert {skip.name for skip in found.not_chosen} == {
        path.name for path in files_of(many).images
    } - names
    assert found.results["images_per_place"] == 12
    assert found.results["images_used_per_place"] == len(names)


def test_few_chosen_images_refine_the_dem_nearly_as_well_as_all(many, solved):
    truth = read_pixels(many / "truth_dem.tif")
    inside = (slice(BORDER, -BORDER),) * 2
    error = {
        name: np.std((read_pixels(solved / name / "dem.tif") - truth)[inside])
        for name in ("chosen", "all")
    }
    assert error["chosen"] < 1.25 * error["all"]


def test_the_record_names_images_that_were_not_chosen(solved):
    record = json.loads((solved / "chosen" / "run.json").read_text())
    assert record["not_chosen"][0]["reason"].endswith("--all-images uses it.")
    assert record["results"]["images"] + len(record["not_chosen"]) == 12
    read = [one for one in record["inputs"] if "img" in one["path"] and one["sha256"]]
    assert len(read) == record["results"]["images"]
    lines = (solved / "chosen" / "exposures.csv").read_text().splitlines()
    assert sum(",0," in line for line in lines) == len(record["not_chosen"])
    everything = json.loads((solved / "all" / "run.json").read_text())
    assert everything["results"]["images"] == 12 and not everything["not_chosen"]


def test_orthoimages_are_chosen_where_they_show_something(many, tmp_path):
    """Half of the second light's only image is missing: it is of no use there."""
    files = files_of(many)
    run_orthoproject(files, tmp_path / "ortho")
    crafts = [
        f"{path.name} " + path.with_suffix(".tsai").read_text().split("C = ")[1].splitlines()[0]
        for path in files.images
    ]
    (tmp_path / "crafts.txt").write_text("\n".join(crafts))
    flat = replace(
        files,
        images=tuple(tmp_path / "ortho" / path.name for path in files.images),
        spacecraft_positions=tmp_path / "crafts.txt",
    )
    lone = tmp_path / "ortho" / "img10.tif"
    values, grid = read_pixels(lone), read_grid(lone)
    values[:, : values.shape[1] // 2] = np.nan
    write_raster(lone, values, grid, "brightness")
    found = survey(flat, tmp_path / "out")
    used = found.is_used[[path.name for path in found.files.images].index("img10.tif")]
    quarter = used.shape[1] // 4
    assert used[:, -quarter:].mean() > 0.9
    assert not used[:, :quarter].any()


def test_an_image_without_a_sun_is_left_out_and_named(many, tmp_path):
    files = files_of(many)
    suns = files.sun_positions.read_text().splitlines()
    short = tmp_path / "suns.txt"
    short.write_text("\n".join(line for line in suns if not line.startswith("img3.")))
    found = survey(replace(files, sun_positions=short), tmp_path / "out")
    assert [skip.name for skip in found.skipped] == ["img3.tif"]


def test_a_run_that_goes_on_does_not_look_at_the_images_again(many, tmp_path, monkeypatch):
    files, settings, output = files_of(many), SfsSettings(), tmp_path / "out"
    assert prepare_array(files, output, settings, None, Tiling(side=128)) > 1
    before = survey(files, tmp_path / "elsewhere")

    def refuse(*_, **__):
        raise LommelError("looked at the images")

    monkeypatch.setattr(selection, "find_footprints", refuse)
    kept = survey(files, output)
    np.testing.assert_array_equal(kept.is_used, before.is_used)
    assert plan_tiles(kept, Tiling(side=128), output).images < 12
    with pytest.raises(LommelError, match="looked"):
        survey(files, output, all_images=True)


def test_tiles_are_cut_for_the_images_that_touch_them():
    def count(window):  # a strip of images along the upper edge
        return 40 if window.row < 1000 else 4

    images, shape, memory = 400, (20_000, 20_000), 2e9
    plan = make_plan(shape, images, memory, count=count)
    assert len(plan.tiles) < len(make_plan(shape, images, memory).tiles) / 3
    assert plan.memory <= memory
    assert all(plan.tiles[0].inner.shape == tile.inner.shape for tile in plan.tiles[:2])
    coarse = shape[0] * shape[1] / plan.stride**2
    assert coarse * (200 + 16 * images) <= memory  # the coarse grid holds all of them


def test_the_limit_of_few_is_not_reached_by_images_that_lie_elsewhere(many, tmp_path):
    files = files_of(many)
    few = replace(files, images=files.images[: FEW - 1] + (tmp_path / "a.tif", tmp_path / "b.tif"))
    found = survey(few, tmp_path / "out")
    assert not found.not_chosen and len(found.skipped) == 2
    assert found.within(Window(0, 0, 10, 10)).images == found.files.images
