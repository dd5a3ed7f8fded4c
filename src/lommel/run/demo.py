"""`lommel demo`: simulate an orbit strip, estimate everything, and compare with the known answer.

The strip gives albedo and exposures; a close-up of it, seen by the strip's own frames and by a
second revolution under the evening Sun, gives the refined terrain. Most callers want `run_demo`.
"""

import csv
from pathlib import Path

import numpy as np

from lommel.errors import InputError
from lommel.evaluate import relative_errors
from lommel.progress import silent
from lommel.run.albedo import run_albedo
from lommel.run.evaluate import evaluate_product
from lommel.run.inputs import SceneFiles
from lommel.run.products import RunRecord, output_folder
from lommel.run.shape_from_shading import run_shape_from_shading
from lommel.run.simulate import run_simulate

BORDER = 10  # posts left out of the terrain's errors: there the surface has one neighbour less
TARGETS = {
    "exposure_rms_percent": "at most 1",
    "albedo_rms_percent": "at most 3",
    "height_rmse_share_percent": "at most 33",
}


def run_demo(output, overwrite=False, progress=silent, strip="apollo-orbit", close_up="sfs-patch"):
    """Simulate, estimate, compare.

    Parameters
    ----------
    output : path
        Folder that appears when all is done: ``scene``, ``albedo``, ``sfs`` and ``run.json``.
    overwrite : bool
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.
    strip, close_up : str or path
        Scenes, as `run_simulate` takes them.

    Returns
    -------
    results : dict of str to number
        Errors against the truth.
    """
    record = RunRecord("demo", {"strip": str(strip), "close_up": str(close_up), "border": BORDER})
    with output_folder(output, overwrite) as folder:
        with record.stage("simulate"):
            ground = run_simulate(
                strip, folder / "scene" / "strip", progress=_named(progress, "simulate strip")
            )
            detail = run_simulate(
                close_up,
                folder / "scene" / "close-up",
                progress=_named(progress, "simulate close-up"),
            )
        with record.stage("albedo"):
            run_albedo(
                _files(ground),
                folder / "albedo",
                progress=_named(progress, "albedo"),
            )
        with record.stage("sfs"):
            run_shape_from_shading(
                _files(detail), folder / "sfs", progress=_named(progress, "shape from shading")
            )
        record.results = compare_with_truth(ground, detail, folder)
        record.outcome = {"name": "done", "sentence": _sentence(record.results)}
        record.targets = TARGETS
        record.write(folder)
        _settle_paths(folder, Path(output).absolute())
    return record.results


def compare_with_truth(ground, detail, folder):
    """Errors of a demo's products.

    Parameters
    ----------
    ground, detail : SceneFolder
        The strip and its close-up.
    folder : Path
        Holds ``albedo`` and ``sfs``.

    Returns
    -------
    results : dict of str to number
    """
    exposures = exposure_errors(folder / "albedo" / "exposures.csv", ground.truth_exposures)
    albedo = evaluate_product(
        folder / "albedo" / "albedo.tif", ground.truth_albedo, quantity="albedo"
    )
    before = evaluate_product(detail.initial_dem, detail.truth_dem, BORDER)
    after = evaluate_product(folder / "sfs" / "dem.tif", detail.truth_dem, BORDER)
    share = after["height_rmse_m"] / before["height_rmse_m"]
    return {
        "exposure_rms_percent": exposures["rms_percent"],
        "albedo_rms_percent": albedo["albedo_rms_percent"],
        "height_rmse_before_m": before["height_rmse_m"],
        "height_rmse_after_m": after["height_rmse_m"],
        "height_rmse_share_percent": 100.0 * share,
        "slope_rmse_before_deg": before["slope_rmse_deg"],
        "slope_rmse_after_deg": after["slope_rmse_deg"],
    }


def exposure_errors(estimated, truth):
    """Errors of a table of exposures, up to the common scale.

    Parameters
    ----------
    estimated, truth : path
        CSV with the columns ``image`` and ``exposure``.

    Returns
    -------
    errors : dict
        See `lommel.evaluate.relative_errors`.
    """
    found, expected = _read_exposures(estimated), _read_exposures(truth)
    names = [name for name in expected if name in found]
    return relative_errors(
        np.array([found[name] for name in names]), np.array([expected[name] for name in names])
    )


def _read_exposures(path):
    with open(path, encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    if rows and not {"image", "exposure"} <= set(rows[0]):
        raise InputError(f"{path} needs the columns image and exposure.")
    return {row["image"]: float(row["exposure"] or "nan") for row in rows}


def _named(progress, stage):
    def named(items, name, total=None, at_once=1):
        return progress(items, f"{stage}: {name}", total, at_once)

    return named


def _files(scene):
    return SceneFiles(
        scene.images, (scene.initial_dem,), scene.sun_positions, scene.spacecraft_positions
    )


def _sentence(results):
    return (
        f"Exposures within {results['exposure_rms_percent']:.2f} % rms, albedo within "
        f"{results['albedo_rms_percent']:.2f} % rms, heights from "
        f"{results['height_rmse_before_m']:.2f} to {results['height_rmse_after_m']:.2f} m RMSE."
    )


def _settle_paths(staging, folder):
    """Write the final folder's name where the stages' records name the hidden one."""
    for path in staging.rglob("run.json"):
        text = path.read_text(encoding="utf-8").replace(str(staging), str(folder))
        path.write_text(text, encoding="utf-8")
