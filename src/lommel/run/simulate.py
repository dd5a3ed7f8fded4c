"""`lommel simulate`: a scene with a known answer, written as a user would have it.

Most callers want `run_simulate`.
"""

import csv
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError

from lommel.errors import InputError
from lommel.io.raster import write_raster
from lommel.progress import silent
from lommel.run.products import RunRecord, output_folder
from lommel.simulate import PRESETS, SceneSettings, preset, simulate_scene


@dataclass(frozen=True)
class SceneFolder:
    """Where the parts of a simulated scene lie.

    Attributes
    ----------
    folder : Path
    """

    folder: Path

    @property
    def images(self):
        """Orthoimages, in the order of flight."""
        return tuple(sorted(self.folder.glob("orbit*-frame*.tif")))

    @property
    def initial_dem(self):
        """What the stages start from."""
        return self.folder / "initial-dem.tif"

    @property
    def truth_dem(self):
        """The answer: heights."""
        return self.folder / "truth-dem.tif"

    @property
    def truth_albedo(self):
        """The answer: albedo."""
        return self.folder / "truth-albedo.tif"

    @property
    def truth_exposures(self):
        """The answer: exposure and haze of each image."""
        return self.folder / "truth-exposures.csv"

    @property
    def sun_positions(self):
        """Position table of the Sun."""
        return self.folder / "sun-positions.txt"

    @property
    def spacecraft_positions(self):
        """Position table of the spacecraft."""
        return self.folder / "spacecraft-positions.txt"


def run_simulate(scene, output, overwrite=False, progress=silent):
    """Simulate a preset or a scene file into a folder.

    Parameters
    ----------
    scene : str or path
        Name of a preset, or a ``.toml`` file with the fields of `SceneSettings`; what the file
        leaves out has the values of the preset ``apollo-orbit``.
    output : path
    overwrite : bool
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.

    Returns
    -------
    files : SceneFolder
    """
    settings = scene_settings(scene)
    record = RunRecord("simulate", asdict(settings))
    if str(scene) not in PRESETS:
        record.add_inputs([scene])
    with output_folder(output, overwrite) as staging:
        with record.stage("simulate"):
            simulated = simulate_scene(settings, progress)
        with record.stage("write"):
            write_scene(simulated, SceneFolder(staging))
        record.results = {"images": len(simulated.images)}
        record.outcome = {
            "name": "done",
            "sentence": f"Simulated {len(simulated.images)} images of {settings.grid.rows} x "
            f"{settings.grid.cols} posts at {settings.grid.spacing:g} m.",
        }
        record.write(staging)
    return SceneFolder(Path(output))


def scene_settings(scene):
    """Settings of a preset or of a scene file.

    Parameters
    ----------
    scene : str or path

    Returns
    -------
    settings : SceneSettings
    """
    if Path(scene).suffix.lower() != ".toml":
        return preset(str(scene))
    try:
        with open(scene, "rb") as file:
            content = tomllib.load(file)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{scene} cannot be read as TOML: {error}") from error
    try:
        return TypeAdapter(SceneSettings).validate_python(content)
    except ValidationError as error:
        raise InputError(_complaint(scene, error)) from error


def _complaint(path, error):
    lines = []
    for problem in error.errors():
        name = ".".join(str(part) for part in problem["loc"])
        if problem["type"] == "unexpected_keyword_argument":
            lines.append(f"{path}: {name} is not a setting. Check its spelling and its section.")
        else:
            lines.append(f"{path}: {name} = {problem['input']!r}: {problem['msg']}.")
    return "\n".join(lines[:5])


def write_scene(scene, files):
    """Write a scene: truth, initial DEM, orthoimages and position tables.

    Parameters
    ----------
    scene : Scene
    files : SceneFolder
    """
    write_raster(files.truth_dem, scene.heights, scene.grid, "height", "m")
    write_raster(files.initial_dem, scene.initial_heights, scene.grid, "height", "m")
    write_raster(files.truth_albedo, scene.albedo, scene.grid, "albedo")
    for image in scene.images:
        _write_image(files.folder, scene.grid, image.observation)
    rows = [(image.observation.name, image.exposure, image.haze) for image in scene.images]
    with open(files.truth_exposures, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["image", "exposure", "haze"])
        writer.writerows(rows)
    for path, kind in (
        (files.sun_positions, "sun_position"),
        (files.spacecraft_positions, "spacecraft_position"),
    ):
        lines = [_position_line(image.observation, kind) for image in scene.images]
        path.write_text("# body-fixed, km\n" + "\n".join(lines) + "\n", encoding="utf-8")


def _write_image(folder, grid, observation):
    values, valid = observation.measured, np.isfinite(observation.measured)
    description = "brightness"
    window_grid = grid.cut(observation.window)
    if np.isfinite(observation.saturation):
        values = np.where(valid, values, 0).astype(np.uint8)
        write_raster(folder / observation.name, values, window_grid, description, valid=valid)
    else:
        write_raster(folder / observation.name, values, window_grid, description)


def _position_line(observation, kind):
    x, y, z = (float(value) / 1e3 for value in getattr(observation, kind))
    return f"{Path(observation.name).stem} {x!r} {y!r} {z!r}"
