"""The commands: exit status, what goes to stdout and what to stderr, and bad requests."""

import json
import signal
import sys
from io import StringIO
from types import SimpleNamespace

import numpy as np
import pytest
from affine import Affine
from pyproj import CRS
from rich.console import Console

from lommel import __version__
from lommel.cli import _progress, _Times, main
from lommel.errors import ConvergenceError
from lommel.io.raster import write_raster
from lommel.scene.body import MOON, to_xyz
from lommel.scene.camera import nadir_rotation
from lommel.scene.geometry import surface_normals, viewing_geometry
from lommel.scene.grid import Grid, grid_from_bounds, read_crs

GRID = grid_from_bounds(
    (0.0, 0.0, 4e3, 3.6e3), 100.0, read_crs("+proj=eqc +R=1737400 +units=m +type=crs")
)
SUNS_DEG = ((-50.0, 5.0), (-48.0, 15.0))


def brightness(heights, sun, craft):
    xyz = GRID.xyz(heights)
    geometry = viewing_geometry(xyz, surface_normals(xyz), sun, craft)
    return np.clip(200.0 * geometry.cos_incidence, 1.0, 254.0)


def write_tables(folder, names):
    for table, height in (("sun", 1.5e11), ("craft", 1.1e5)):
        lines = []
        for name, (longitude, latitude) in zip(names, SUNS_DEG, strict=False):
            place = (longitude, latitude) if table == "sun" else (0.0, 0.0)
            xyz = to_xyz(MOON, *np.radians(place), height)
            lines.append(" ".join([name, *(repr(float(value)) for value in xyz)]))
        (folder / f"{table}.txt").write_text("\n".join(lines) + "\n")


def position(table, name):
    lines = (line.split() for line in table.read_text().splitlines())
    return next(np.array(words[1:], float) for words in lines if words[0] == name)


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """The working folder: a DEM, two images, two tables."""
    monkeypatch.chdir(tmp_path)
    row, col = np.indices(GRID.shape)
    heights = 15 * np.sin(col / 4) * np.cos(row / 5)
    write_tables(tmp_path, ("a", "b"))
    for name in ("a", "b"):
        sun, craft = (position(tmp_path / f"{table}.txt", name) for table in ("sun", "craft"))
        write_raster(f"{name}.tif", brightness(heights, sun, craft), GRID, "brightness")
    write_raster("dem.tif", 0.5 * heights, GRID, "height", "m")
    return tmp_path


@pytest.fixture
def lommel(capsys, monkeypatch):
    """Function that runs a command line: exit status, stdout, stderr."""
    terminate = signal.getsignal(signal.SIGTERM)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["lommel", *map(str, words)])
        with pytest.raises(SystemExit) as ending:
            main()
        printed = capsys.readouterr()
        return SimpleNamespace(status=ending.value.code or 0, out=printed.out, err=printed.err)

    yield run
    signal.signal(signal.SIGTERM, terminate)


TABLES = ("--sun-positions", "sun.txt", "--spacecraft-positions", "craft.txt")
REQUEST = ("a.tif", "b.tif", "--dem", "dem.tif", "--output", "out", *TABLES)
STAGES = ("sfs", "albedo")


def listing(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(params=STAGES)
def refused(request, scene, lommel):
    """Function that runs a bad request and checks that it leaves nothing; returns the message."""

    def run(*words, status=2, stage=request.param):
        before = listing(scene)
        ended = lommel(stage, *words)
        assert ended.status == status
        assert ended.out == ""
        assert listing(scene) == before
        assert not list(scene.glob(".*"))
        return ended.err

    return run


# --- Good requests --------------------------------------------------------------------------------


@pytest.mark.parametrize("stage", STAGES)
def test_stage_prints_products_to_stdout_and_the_log_to_stderr(scene, lommel, stage):
    ended = lommel(stage, *REQUEST, *(["--report"] if stage == "sfs" else []))
    assert ended.status == 0
    products = ended.out.split()
    assert f"out/{'dem' if stage == 'sfs' else 'albedo'}.tif" in products
    assert "out/report.html" in products
    assert all((scene / product).is_file() for product in products)
    assert "images" in ended.err
    assert not list(scene.glob(".*"))
    record = json.loads((scene / "out" / "run.json").read_text())
    assert record["command"] == stage
    names = {path["path"] for path in record["inputs"]}
    assert names == {"a.tif", "b.tif", "dem.tif", "sun.txt", "craft.txt"}


@pytest.fixture(params=STAGES)
def quick(request, scene, lommel, monkeypatch):
    """Function that runs a good request in few steps and without a report; returns the log."""
    monkeypatch.setattr("lommel.report.write_report", lambda folder: folder / "report.html")
    steps = ["--max-steps", "1"] if request.param == "sfs" else []

    def run(*words):
        ended = lommel(request.param, *words, *steps)
        assert ended.status == 0, ended.err
        assert not list(scene.glob(".*"))
        return ended.err

    return run


def test_image_that_is_left_out_is_reported_and_the_run_goes_on(scene, quick):
    far = grid_from_bounds((9e5, 0, 9.04e5, 3.6e3), 100.0, GRID.crs)
    write_raster("far.tif", np.full(far.shape, 90.0), far, "brightness")
    reason = "far.tif does not overlap the DEM."
    assert f"left out {reason}\n" in quick(*REQUEST, "far.tif")
    assert reason in (scene / "out" / "exposures.csv").read_text()
    record = json.loads((scene / "out" / "run.json").read_text())
    assert record["skipped"] == [{"image": "far.tif", "reason": reason}]


def test_single_image_is_enough(quick):
    quick(*REQUEST[1:])


def test_hole_of_the_dem_is_no_obstacle(quick):
    heights = np.zeros(GRID.shape)
    heights[14:20, 16:23] = np.nan
    write_raster("dem.tif", heights, GRID, "height", "m")
    quick(*REQUEST)


def test_overwrite_replaces_the_earlier_run(scene, quick):
    (scene / "out").mkdir()
    for name in ("run.json", "old.tif"):
        (scene / "out" / name).write_text("{}")
    quick(*REQUEST, "--overwrite")
    assert (scene / "out" / "albedo.tif").exists()
    assert not (scene / "out" / "old.tif").exists()


def test_version_and_help_go_to_stdout(lommel):
    assert lommel("--version").out == f"lommel {__version__}\n"
    for words in (["--help"], *([stage, "--help"] for stage in STAGES)):
        ended = lommel(*words)
        assert (ended.status, ended.err) == (0, "")
        assert "Usage: lommel" in ended.out


def test_info_prints_facts_or_json(scene, lommel):
    ended = lommel("info", "a.tif", "dem.tif", "--sun-positions", "sun.txt", "--json")
    assert ended.status == 2  # the table has no entry for the DEM
    assert "sun.txt has no entry for dem.tif" in ended.err
    ended = lommel("info", "a.tif", *TABLES, "--json")
    (facts,) = json.loads(ended.out)
    assert facts["gsd_m"] == 100.0
    assert facts["spacecraft_altitude_m"] == pytest.approx(1.1e5)
    assert "gsd_m                    100.0\n" in lommel("info", "a.tif").out


def test_info_shows_the_ground_point_of_a_pixel(raw, lommel):
    """The camera p stands over 0 E; tables and DEM serve a pixel as they serve an image."""
    pixel = ("info", "p.tif", "--pixel", "20", "18", "--sun-positions", "sun.txt")
    ended = lommel(*pixel, "--json")
    assert ended.status == 0, ended.err
    facts = json.loads(ended.out)
    assert {"longitude_deg", "latitude_deg", "height_m", "emission_deg"} <= set(facts)
    assert {"incidence_deg", "phase_deg"} <= set(facts)
    assert f"longitude_deg            {facts['longitude_deg']}\n" in lommel(*pixel).out
    on_dem = json.loads(lommel(*pixel, "--dem", "dem.tif", "--json").out)
    assert on_dem["height_m"] != 0.0
    assert on_dem["ellipsoid_emission_deg"] == pytest.approx(facts["emission_deg"], abs=0.1)


def test_info_writes_a_camera_that_other_commands_take(raw, lommel):
    ended = lommel("info", "p.tif", "--write-isd", "p.json", "--json")
    assert ended.status == 0, ended.err
    (before,) = json.loads(ended.out)
    (after,) = json.loads(lommel("info", "p.tif", "--json").out)
    assert (before.pop("camera_file"), after.pop("camera_file")) == ("p.tsai", "p.json")
    names = ("longitude_deg", "latitude_deg", "gsd_m", "spacecraft_altitude_m")
    assert [after[name] for name in names] == [before[name] for name in names]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["p.tif", "q.tif", "--pixel", "1", "1"], "--pixel and --write-isd take one image; 2 are"),
        (["p.tif", "--dem", "dem.tif"], "--dem tells where --pixel looks; give --pixel SAMPLE"),
        (["p.tif", "--pixel", "1", "1e9"], "sample 1, line 1e+09 lies outside the image of"),
        (["p.tif", "--cameras", "q.tsai", "--cameras", "p.tsai"], "--cameras names 2 files for 1"),
        (["dem.tif", "--write-isd", "d.json"], "dem.tif: no camera found. Looked for an ISD"),
    ],
)
def test_info_that_cannot_be_given_is_an_error(raw, lommel, words, message):
    ended = lommel("info", *words)
    assert (ended.status, ended.out) == (2, "")
    assert message in ended.err


# --- Progress and plans ---------------------------------------------------------------------------


def test_log_that_is_no_terminal_gets_lines(scene, lommel, monkeypatch):
    monkeypatch.setattr("lommel.progress.WORTH_TELLING", 0.0)
    log = lommel("albedo", *REQUEST).err.splitlines()
    assert [line for line in log if line.startswith("images 2 of 2, ")]
    assert [line for line in log if line.startswith("maps, block ")]
    assert not any("\x1b" in line for line in log)


def test_terminal_gets_bars_with_time_left(monkeypatch):
    screen = StringIO()
    terminal = Console(file=screen, force_terminal=True, width=100)
    monkeypatch.setattr("lommel.cli.log", terminal)
    monkeypatch.setattr("lommel.cli.WORTH_TELLING", 0.0)
    with _progress() as progress:
        for number in progress(range(4), "tiles"):
            assert number < 4
    assert "tiles" in screen.getvalue() and "4/4" in screen.getvalue()
    midway = {"completed": 1, "total": 4, "elapsed": 12.0, "finished": False}
    task = SimpleNamespace(**midway, fields={"last": 10.0, "at_once": 1})
    assert str(_Times().render(task)) == "12 s, 28 s left"


@pytest.mark.parametrize("stage", STAGES)
def test_dry_run_tells_memory_disk_and_time_and_writes_nothing(scene, lommel, stage):
    before = listing(scene)
    ended = lommel(stage, *REQUEST, "--dry-run", "--memory", "2GB")
    assert ended.status == 0, ended.err
    assert {"posts", "memory", "disk", "time"} <= {
        line.split()[0] for line in ended.out.splitlines()
    }
    assert listing(scene) == before


# --- Wrong words ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nosuch"], "No such command 'nosuch'"),
        (["sfs", "a.tif"], "Missing option '--dem'"),
        (["sfs", "a.tif", "--dem", "d.tif", "--output", "o", "--speed", "9"], "No such option"),
        (
            ["sfs", "a.tif", "--dem", "d.tif", "--output", "o", "--spacing", "wide"],
            "'--spacing': Input should be a valid number",
        ),
        (["evaluate", "nowhere.tif", "--reference", "a.csv"], "nowhere.tif cannot be opened as"),
        (["info", "nowhere.tif"], "nowhere.tif cannot be opened as a raster: there is no such"),
        (["simulate", "mars", "--output", "o"], "mars"),
    ],
)
def test_wrong_word_is_an_error_on_stderr(scene, lommel, words, message):
    before = listing(scene)
    ended = lommel(*words)
    assert (ended.status, ended.out) == (2, "")
    assert message in ended.err
    assert listing(scene) == before


@pytest.mark.parametrize(
    ("stage", "option", "word", "message"),
    [
        ("sfs", "--parametrisation", "up", "parametrisation = 'up' is not known. Choose height"),
        ("sfs", "--reflectance", "shiny", "'shiny'"),
        ("albedo", "--reflectance", "shiny", "'shiny'"),
        ("albedo", "--solver", "magic", "'magic'"),
        ("albedo", "--loss", "none", "'none'"),
        ("sfs", "--positions-unit", "miles", "unit = 'miles' is not known. Choose auto, m or km"),
        ("sfs", "--crs", "EPSG:4326", "radius of 6378.1 km, the Moon has 1737.4 km"),
        ("albedo", "--spacing", "0", "spacing = 0.0 is not a post spacing"),
        ("sfs", "--spacing", "200", "share 18 x 20 posts, 33 along each side are needed"),
    ],
)
def test_wrong_value_names_what_is_allowed(scene, lommel, stage, option, word, message):
    ended = lommel(stage, *REQUEST, option, word)
    assert (ended.status, ended.out) == (2, "")
    assert message in ended.err
    assert not (scene / "out").exists()


# --- Bad input ------------------------------------------------------------------------------------


def test_no_overlap_is_an_error(refused):
    far = grid_from_bounds((9e5, 0, 9.04e5, 3.6e3), 100.0, GRID.crs)
    write_raster("dem.tif", np.zeros(far.shape), far, "height", "m")
    message = refused(*REQUEST)
    assert "error No image can be used.\n  a.tif does not overlap the DEM.\n" in message


def test_missing_table_or_entry_is_an_error(refused, scene):
    assert "No sun positions given." in refused(*REQUEST[:-4])
    (scene / "craft.txt").write_text("c 1.8e6 0 0\n")
    message = refused(*REQUEST)
    assert "craft.txt has no entry for a.tif. Add a line KEY x y z" in message
    assert "craft.txt has no entry for b.tif" in message
    (scene / "sun.txt").write_text("a 1 2\n")
    assert "sun.txt, line 1: 'a 1 2' is not a position. Write KEY x y z" in refused(*REQUEST)


def test_dem_of_nodata_only_is_an_error(refused):
    write_raster("dem.tif", np.full(GRID.shape, np.nan), GRID, "height", "m")
    assert "The DEM has no height inside the output grid." in refused(*REQUEST)


def test_images_all_shadow_are_an_error(refused):
    for name in ("a.tif", "b.tif"):
        write_raster(name, np.zeros(GRID.shape, np.uint8), GRID, "brightness")
    message = refused(*REQUEST)
    assert "No image can be used." in message
    assert "a.tif holds no brightness: all is shadow, clipped or no data" in message


def test_images_below_the_shadow_threshold_are_an_error(refused):
    message = refused(*REQUEST, "--shadow-threshold", "1000")
    assert "a.tif" in message
    assert "shadow" in message


@pytest.mark.parametrize(
    ("crs", "message"),
    [
        (CRS.from_user_input("IAU_2015:49900"), "radius of 3396.2 km, the Moon has 1737.4 km"),
        (SimpleNamespace(to_wkt=lambda: None), "has no CRS or no transform"),
    ],
)
def test_raster_of_another_body_or_of_none_is_an_error(refused, crs, message):
    elsewhere = Grid(GRID.shape, GRID.affine, crs)
    write_raster("c.tif", np.full(GRID.shape, 9.0), elsewhere, "brightness")
    assert f"c.tif{'' if 'no CRS' in message else ':'}" in refused("c.tif", *REQUEST[2:])
    assert message in refused("a.tif", "--dem", "c.tif", *REQUEST[4:])


def test_duplicate_names_are_an_error(refused):
    assert "a.tif given more than once." in refused("a.tif", *REQUEST)


def test_unreadable_files_are_errors(refused, scene):
    (scene / "text.tif").write_text("not a raster")
    message = refused("text.tif", "nowhere.tif", *REQUEST[2:])
    assert "text.tif cannot be opened as a raster" in message
    assert "nowhere.tif cannot be opened as a raster: there is no such file" in message
    assert "text.tif cannot be opened" in refused("a.tif", "--dem", "text.tif", *REQUEST[4:])


def test_truncated_files_are_errors(refused, scene):
    noise = np.random.default_rng(0).uniform(1.0, 200.0, GRID.shape)
    for name in ("a.tif", "dem.tif"):
        write_raster(name, noise, GRID, "noise")
        content = (scene / name).read_bytes()
        (scene / f"cut-{name}").write_bytes(content[: 2 * len(content) // 3])
    (scene / "cut-a.tif").rename(scene / "b-cut.tif")
    assert "b-cut.tif cannot be" in refused("b-cut.tif", *REQUEST[2:])
    assert "cut-dem.tif cannot be" in refused("a.tif", "--dem", "cut-dem.tif", *REQUEST[4:])


def test_output_that_exists_is_kept(refused, scene):
    (scene / "out").mkdir()
    (scene / "out" / "notes.txt").write_text("mine")
    assert "exists and is not empty. Name another folder, or" in refused(*REQUEST)
    assert "holds no run.json, so it is not the folder" in refused(*REQUEST, "--overwrite")
    (scene / "out" / "run.json").write_text("{}")
    (scene / "dem.tif").write_text("damaged")
    assert "dem.tif cannot be opened" in refused(*REQUEST, "--overwrite")


def test_output_that_cannot_be_written_is_an_error(refused, scene):
    (scene / "file").write_text("")
    words = [word if word != "out" else "file" for word in REQUEST]
    assert "file is a file. Name a folder." in refused(*words)
    words = [word if word != "out" else "file/out" for word in REQUEST]
    assert "file/out cannot be written: Not a directory. Name a folder" in refused(*words)


def test_brackets_colons_and_length_of_a_path_are_printed_as_they_are(refused, scene):
    path = scene / "[red] :moon: [/]" / ("long " * 30) / "dem[1].tif"
    message = refused("a.tif", "--dem", path, *REQUEST[4:])
    assert f"error {path} cannot be opened as a raster: there is no such file\n" in message


def test_sliver_of_an_image_does_not_spoil_the_others(scene, lommel):
    """One row of posts holds no slope: its undefined noise kept the whole surface in place."""
    affine = GRID.affine @ Affine.translation(0, GRID.shape[0] - 1)
    write_raster("c.tif", np.full(GRID.shape, 90.0), Grid(GRID.shape, affine, GRID.crs), "b")
    for table in ("sun.txt", "craft.txt"):
        lines = (scene / table).read_text()
        (scene / table).write_text(lines + lines.splitlines()[0].replace("a ", "c ", 1))
    ended = lommel("sfs", "c.tif", *REQUEST, "--max-steps", "1")
    assert ended.status == 0
    assert "left out c.tif shares only 1 x 40 posts with the DEM; 8 along each" in ended.err
    record = json.loads((scene / "out" / "run.json").read_text())
    assert record["results"]["image_correlation_after"] > 0.9


# --- Raw images with cameras ----------------------------------------------------------------------


def write_camera(path, longitude_deg=0.066, latitude_deg=0.06, pitch=1.0):
    """A nadir camera 10 km above the DEM with 100 m per pixel."""
    place = to_xyz(MOON, *np.radians([longitude_deg, latitude_deg]), 10e3)
    rotation = nadir_rotation(place, np.array([0.0, 1.0, 0.0]))
    values = {
        "fu": 100.0 * pitch,
        "fv": 100.0 * pitch,
        "cu": 29.5 * pitch,
        "cv": 29.5 * pitch,
        "u_direction": "1 0 0",
        "v_direction": "0 1 0",
        "w_direction": "0 0 1",
        "C": " ".join(repr(float(value)) for value in place),
        "R": " ".join(repr(float(value)) for value in rotation.T.ravel()),
        "pitch": pitch,
    }
    path.write_text("".join(f"{key} = {value}\n" for key, value in values.items()) + "NULL\n")


@pytest.fixture
def raw(scene):
    """The working folder with two raw images more, whose cameras lie beside them."""
    row, col = np.indices((60, 60))
    for name, phase in (("p", 0.0), ("q", 1.0)):
        values = 100 + 20 * np.sin(col / 4 + phase) * np.cos(row / 5)
        nowhere = Grid((60, 60), GRID.affine, SimpleNamespace(to_wkt=lambda: None))
        write_raster(f"{name}.tif", values, nowhere, "brightness")
        write_camera(scene / f"{name}.tsai")
    write_tables(scene, ("p", "q"))
    return scene


RAW = ("p.tif", "q.tif", "--dem", "dem.tif", "--output", "out", "--sun-positions", "sun.txt")


def test_raw_images_find_the_cameras_beside_them(raw, lommel):
    ended = lommel("sfs", *RAW, "--max-steps", "1")
    assert ended.status == 0, ended.err
    assert (raw / "out" / "dem.tif").is_file()


@pytest.mark.parametrize("request_", [("--cameras", "p.tsai"), ("--spacing", "0")])
def test_request_for_raw_images_that_cannot_work_is_an_error(raw, lommel, request_):
    ended = lommel("sfs", *RAW, *request_)
    expected = {
        "--cameras": "--cameras names 1 files for 2 images. Name one per image",
        "--spacing": "spacing = 0.0 is not a post spacing",
    }
    assert (ended.status, ended.out) == (2, "")
    assert expected[request_[0]] in ended.err
    assert not (raw / "out").exists()


def test_raw_images_need_a_sun(raw, lommel):
    ended = lommel("sfs", *RAW[:-2])
    assert ended.status == 2
    assert "the camera file does not tell where the Sun stood. Name a table" in ended.err
    (raw / "sun.txt").write_text("x 1.5e11 0 0\n")
    assert "sun.txt has no entry for p.tif" in lommel("sfs", *RAW).err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fu = 1\n", "q.tsai: fv is missing or malformed"),
        ("\x00\x01", "q.tsai: fu is missing or malformed"),
        (None, "q.tif: its camera does not see the DEM. Check that camera and DEM"),
    ],
)
def test_raw_image_whose_camera_fails_is_left_out(raw, lommel, text, message):
    if text is None:
        write_camera(raw / "q.tsai", longitude_deg=90.0)
    else:
        (raw / "q.tsai").write_text(text)
    ended = lommel("sfs", *RAW, "--max-steps", "1")
    assert ended.status == 0, ended.err
    assert message in ended.err


def test_camera_of_an_unknown_kind_is_an_error(raw, lommel):
    (raw / "q.xyz").write_text("")
    ended = lommel("sfs", "q.tif", *RAW[2:], "--cameras", "q.xyz")
    assert ended.status == 2
    assert "q.xyz: no reader for cameras in .xyz files. Give one of .json, .isd, .tsai" in ended.err


# --- Failures inside ------------------------------------------------------------------------------

SOLVERS = {
    "sfs": "lommel.run.shape_from_shading.solve_surface",
    "albedo": "lommel.run.albedo.find_photometry",
}


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(
    ("failure", "status"),
    [
        (ConvergenceError("The cost grew. Raise max_steps.", None), 1),
        (KeyboardInterrupt(), 130),
        (signal.SIGTERM, 143),
    ],
    ids=["convergence", "interrupt", "termination"],
)
def test_failed_stage_leaves_nothing_and_keeps_the_earlier_run(
    scene, lommel, monkeypatch, stage, overwrite, failure, status
):
    def fail(*_, **__):
        if isinstance(failure, BaseException):
            raise failure
        signal.raise_signal(failure)

    if overwrite:
        (scene / "out").mkdir()
        (scene / "out" / "run.json").write_text("{}")
    before = listing(scene)
    monkeypatch.setattr(SOLVERS[stage], fail)
    ended = lommel(stage, *REQUEST, *(["--overwrite"] if overwrite else []))
    assert (ended.status, ended.out) == (status, "")
    assert listing(scene) == before
    assert not list(scene.glob(".*"))
    if status == 1:
        assert "failed The cost grew. Raise max_steps." in ended.err


@pytest.mark.parametrize("stage", STAGES)
def test_unforeseen_error_leaves_nothing(scene, monkeypatch, stage):
    def fail(*_, **__):
        raise ZeroDivisionError

    before = listing(scene)
    monkeypatch.setattr(SOLVERS[stage], fail)
    monkeypatch.setattr(sys, "argv", ["lommel", stage, *REQUEST])
    with pytest.raises(ZeroDivisionError):
        main()
    assert listing(scene) == before
    assert not list(scene.glob(".*"))
