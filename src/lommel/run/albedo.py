"""The stage `lommel albedo`: images, positions and DEMs in, albedo map and exposures out.

Most callers want `run_albedo`.
"""

import csv
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np

from lommel import __version__
from lommel.estimate.albedo import collect, find_photometry, make_maps
from lommel.estimate.albedo_quality import (
    brightness_ramp,
    shading_in_albedo,
    slope_towards_sun,
)
from lommel.estimate.albedo_settings import AlbedoSettings, published_settings
from lommel.jobs import InThreads
from lommel.progress import silent
from lommel.run.albedo_plan import plan_albedo
from lommel.run.albedo_products import Products
from lommel.run.albedo_records import Kept, work_folder
from lommel.run.inputs import GridSettings, SceneFiles, Skipped
from lommel.run.mixed_scene import PlacedScene, place_scene, raw_cameras, read_placed
from lommel.run.parts import Parts
from lommel.run.products import RunRecord, output_folder
from lommel.run.records import digest_of, refuse_foreign, stamps
from lommel.run.register import settle_cameras
from lommel.run.stored_rows import Held, StoredRows
from lommel.run.tiles_engines import check_engine, open_engine
from lommel.run.tiles_plan import Tiling

SHARED_NAMES = ("phase_c1_per_rad", "phase_c2", "falloff_v2_per_rad2", "falloff_v4_per_rad4")


def albedo_settings(solver="projection", shadow_threshold=None, **changes):
    """Settings from options; what is left out or None follows the solver.

    Parameters
    ----------
    solver : {'projection', 'alternating'}
        The alternating solver brings the settings of the published iteration with it.
    shadow_threshold : float, image units, or None
    **changes
        Fields of `AlbedoSettings`.

    Returns
    -------
    settings : AlbedoSettings

    Examples
    --------
    >>> albedo_settings().loss, albedo_settings("alternating").loss
    ('cauchy', 'least-squares')
    """
    start = published_settings() if solver == "alternating" else AlbedoSettings(solver=solver)
    chosen = {name: value for name, value in changes.items() if value is not None}
    return replace(start, masks=replace(start.masks, shadow_threshold=shadow_threshold), **chosen)


@dataclass(frozen=True)
class AlbedoRun:
    """What decides the products of a run: all that the jobs of an array have to be told.

    Attributes
    ----------
    placed : PlacedScene
    settings : AlbedoSettings
    asked : dict
        The settings as ``run.json`` shows them.
    inputs : list of dict
        Path, bytes and digest of each input file.
    stamps : dict of str to (int, int)
        Size and time of change of each, before its digest was taken.
    lost : list of Skipped
        Images that could not be registered.
    remark : str
        On how raw images lie on the DEM.
    version : str
        Of the program.
    """

    placed: PlacedScene
    settings: AlbedoSettings
    asked: dict
    inputs: list
    stamps: dict
    lost: list
    remark: str
    version: str = __version__

    @property
    def digest(self):
        """Of settings and inputs."""
        return digest_of([self.asked, self.inputs])


def run_albedo(
    files: SceneFiles,
    output,
    settings: AlbedoSettings | None = None,
    grid_settings: GridSettings | None = None,
    overwrite: bool = False,
    progress=silent,
    registers: bool = False,
    tiling: Tiling | None = None,
):
    """Estimate albedo and exposures from orthoimages or raw images and write the products.

    A run whose images do not fit in memory can be broken off: the same request goes on.

    Parameters
    ----------
    files : SceneFiles
    output : path
        Folder that appears when the run is done.
    settings : AlbedoSettings, optional
    grid_settings : GridSettings, optional
    overwrite : bool
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.
    registers : bool
        Register raw images to the DEM first; otherwise they are only checked.
    tiling : Tiling, optional
        Memory and engine; they do not change the products.

    Returns
    -------
    results : dict of str to number
        As in ``run.json``.
    """
    settings, tiling = settings or AlbedoSettings(), tiling or Tiling()
    check_engine(tiling)
    work = work_folder(output)
    with output_folder(output, overwrite, work) as folder:
        record = RunRecord("albedo", asked_for(settings, grid_settings, registers))
        with record.stage("place"):
            run = place_run(files, folder, settings, grid_settings, registers, record, progress)
            plan = plan_albedo(run.placed, settings, tiling)
            kept = Kept(work, run.digest) if plan.waits_on_disk else Held()
            kept.begin(plan)
        if plan.is_shared:
            with open_engine(tiling) as engine:
                jobs = Parts(work, run.digest, tiling, engine, plan.most_threads, progress)
                write_products(run, plan, jobs, kept, folder, record)
        else:
            write_products(run, plan, InThreads(progress), kept, folder, record)
    return record.results


def asked_for(settings, grid_settings=None, registers=False):
    """The settings as ``run.json`` shows them."""
    grid = asdict(grid_settings or GridSettings())
    return asdict(settings) | {"grid": grid, "registers": registers}


def place_run(files, folder, settings, grid_settings, registers, record, progress):
    """Look where images lie, and note what they are.

    Parameters
    ----------
    files : SceneFiles
    folder : Path
        That registered cameras are written to.
    settings : AlbedoSettings
    grid_settings : GridSettings or None
    registers : bool
    record : RunRecord
        That the inputs are noted in.
    progress : callable

    Returns
    -------
    run : AlbedoRun
    """
    tables = (files.sun_positions, files.spacecraft_positions)
    inputs = [*files.images, *files.dems, *files.cameras, *filter(None, tables)]
    before = stamps(inputs)
    record.add_inputs(inputs, progress)
    settled, *lost = settle_cameras(files, folder, registers, raw_cameras(files), progress)
    placed = place_scene(settled, grid_settings, progress=progress)
    return AlbedoRun(placed, settings, dict(record.settings), list(record.inputs), before, *lost)


def photometry_of(run, plan, jobs, kept):
    """Read the images of a run and fit all but the maps.

    Parameters
    ----------
    run : AlbedoRun
    plan : AlbedoPlan
    jobs : InThreads or Parts
    kept : Held or Kept

    Returns
    -------
    scene : Scene
    fit : function ()
        Gives `Problem` and `Photometry`.
    """
    scene = read_placed(run.placed, jobs, kept.rows, run.stamps)
    names = [observation.name for observation in scene.observations]
    remember = None if kept.photometry is None else partial(kept.photometry, names=names)
    given = scene.observations, scene.grid, scene.heights, run.settings
    return scene, partial(find_photometry, *given, jobs, plan.kept_pixels, remember)


def write_products(run, plan, jobs, kept, folder, record):
    """Do what a run asks for, and fill in its record.

    Parameters
    ----------
    run, plan, jobs, kept
        As of `photometry_of`.
    folder : Path
        That the products are written to.
    record : RunRecord
    """
    with record.stage("read"):
        scene, fit = photometry_of(run, plan, jobs, kept)
    with record.stage("solve"), plan.limits(), Products(folder, scene.grid) as products:
        problem, found = fit()
        result = collect(problem, found, make_maps(problem, found), products.take)
    refuse_foreign(stored_in(scene), run.digest)
    with record.stage("write"):
        names = [observation.name for observation in scene.observations]
        reasons = zip(names, result.reasons, strict=True)
        unused = [Skipped(name, f"{name}: {reason}") for name, reason in reasons if reason]
        skipped = [*run.lost, *scene.skipped]
        record.add_skipped([*skipped, *unused])
        _write_exposures(folder / "exposures.csv", names, result, skipped)
        record.results = _results(scene, result, products)
    record.history = result.history
    record.outcome = {"name": result.outcome, "sentence": result.advice + run.remark}
    record.write(folder)


def stored_in(scene):
    """Folders of what waits on the disk of a scene."""
    rows = [*getattr(scene.heights, "bands", ()), *(one.measured for one in scene.observations)]
    return [one.path.parent for one in rows if isinstance(one, StoredRows)]


def _write_exposures(path, names, result, skipped):
    header = ["image", "exposure", "exposure_error", "haze", "haze_error"]
    header += ["used", "group", "reason"]
    groups = {k: number for number, group in enumerate(result.groups, 1) for k in group}
    table = zip(
        names,
        result.exposures,
        result.exposure_errors,
        result.hazes,
        result.haze_errors,
        result.reasons,
        strict=True,
    )
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for k, (name, *numbers, reason) in enumerate(table):
            values = ["" if reason else f"{float(number):.8g}" for number in numbers]
            writer.writerow([name, *values, 0 if reason else 1, groups.get(k, ""), reason])
        for skip in skipped:
            writer.writerow([skip.name, "", "", "", "", 0, "", skip.reason])


def _results(scene, result, products):
    """Numbers of the run; see `lommel.estimate.albedo_quality` for what they mean."""
    used = [not reason for reason in result.reasons]
    suns = [o.sun_position for o, is_used in zip(scene.observations, used, strict=True) if is_used]
    middle = products.middle
    slope = slope_towards_sun(scene.grid.cut(middle), scene.heights[middle.slices], suns)
    correlation, _ = shading_in_albedo(products.detail, slope)
    error = products.thin.albedo_error / products.thin.albedo
    known = np.isfinite(error)
    ramp = brightness_ramp(products.thin.albedo, products.thin.count)
    return {
        "images": int(np.sum(used)),
        "disagreement_before_percent": 100.0 * result.disagreement_before,
        "disagreement_after_percent": 100.0 * result.disagreement,
        "albedo_error_percent": 100.0 * float(np.median(error[known])) if known.any() else np.nan,
        "brightness_ramp_percent": 100.0 * np.expm1(ramp),
        "shading_correlation": correlation,
        "noise_percent": 100.0 * result.noise,
        "pixels_per_independent_residual": result.repetition,
        "passes": result.passes,
        **{
            name: float(value)
            for name, value, error in zip(
                SHARED_NAMES, result.shared, result.shared_errors, strict=True
            )
            if np.isfinite(error)
        },
    }
