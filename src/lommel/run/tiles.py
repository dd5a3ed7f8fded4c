"""Shape from shading of scenes that do not fit in memory: tile after tile, and one answer.

The scene is prepared as a whole (`lommel.run.tiles_solve`), its tiles are solved by an engine
(`lommel.run.tiles_engines`), and their products blended into rasters (`lommel.run.tiles_products`).
What is done stays in a hidden folder beside the output until all is done, so that a run that was
broken off goes on where it was. Most callers want `run_tiles`.
"""

import os
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from lommel.errors import LommelError
from lommel.estimate.priors import Priors
from lommel.progress import silent
from lommel.run.inputs import GridSettings
from lommel.run.products import RunRecord, peak_memory_mb
from lommel.run.records import (
    clear_partial,
    digest_of,
    disk_errors,
    is_done,
    is_sound,
    read_array,
    read_record,
    refuse_changed,
    refuse_foreign,
    refuse_full,
    save_part,
    stamps,
)
from lommel.run.tiles_engines import check_engine, solve_all
from lommel.run.tiles_plan import Tiling, plan_tiles, work_folder
from lommel.run.tiles_products import finish_products, size_on_disk
from lommel.run.tiles_records import TiledRun, load_run, part_folder, save_run
from lommel.run.tiles_solve import Known, prepare_scene, solve_tile

ARRAYS = [
    "exposures",
    "hazes",
    "noise",
    "brightness",
    "misfits",
    "thresholds",
    "correction",
    "coarse",
    "position",
    "sun_position",
]


def run_tiles(
    files, footprints, lost, folder, output, settings, grid_settings, tiling=None, progress=silent
):
    """Refine a DEM tile by tile and write the products.

    Parameters
    ----------
    files : SceneFiles
        As given.
    footprints : Footprints
        With registered cameras.
    lost : list of Skipped
        Images lost on the way.
    folder : Path
        That the products are written to.
    output : path
        Of the run; its tiles wait beside it.
    settings : SfsSettings
    grid_settings : GridSettings or None
    tiling : Tiling, optional
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.

    Returns
    -------
    results : dict of str to number
    """
    tiling = tiling or Tiling()
    check_engine(tiling)
    work = work_folder(output)
    run = describe_run(files, footprints, lost, output, settings, grid_settings, tiling, progress)
    record = RunRecord("sfs", dict(run.asked), list(run.inputs))
    with record.stage("prepare"):
        clear_partial(work)
        prepare(run, work, progress)
    with record.stage("tiles"):
        solve_tiles(work, run.plan.tiles, tiling.settled(run.plan), progress)
    write_products(run, work, folder, record, progress)
    return record.results


def write_products(run, work, folder, record, progress=silent):
    """Blend the tiles into products, and write the record of the run.

    Parameters
    ----------
    run : TiledRun
        All of whose tiles are done.
    work : Path
    folder : Path
        That the products are written to.
    record : RunRecord
    progress : callable
    """
    with record.stage("write"), disk_errors(folder):
        finish_products(run, work, folder, record, load_known(work), progress)
    parts = [part_folder(work, tile.number) for tile in run.plan.tiles]
    refuse_foreign([work / "scene", *parts], run.digest)
    record.write(folder)


def describe_run(files, footprints, lost, output, settings, grid_settings, tiling, progress=silent):
    """All that decides what the tiles of a run hold.

    Parameters
    ----------
    files, footprints, lost, output, settings, grid_settings, tiling, progress
        As of `run_tiles`.

    Returns
    -------
    run : TiledRun
    """
    record = RunRecord("sfs", asdict(settings) | {"grid": asdict(grid_settings or GridSettings())})
    tables = (files.sun_positions, files.spacecraft_positions, settings.albedo, settings.exposures)
    inputs = [*files.images, *files.dems, *files.cameras, *filter(None, tables)]
    before = stamps(inputs)
    record.add_inputs(inputs, progress, footprints.unused(files))
    plan = plan_tiles(footprints, tiling, output)
    return TiledRun(
        replace(footprints, files=_absolute(footprints.files)),
        plan,
        replace(
            settings,
            albedo=settings.albedo and os.path.abspath(settings.albedo),
            exposures=settings.exposures and os.path.abspath(settings.exposures),
        ),
        record.settings,
        record.inputs,
        before,
        [*lost, *footprints.skipped],
        digest_of([record.settings, record.inputs, plan.cut, footprints.choice]),
    )


def prepare(run, work, progress=silent):
    """Keep what the run is, and solve the whole scene coarsely unless that is done already.

    Parameters
    ----------
    run : TiledRun
    work : Path
        Folder of the tiles.
    progress : callable
    """
    with disk_errors(work):
        work.mkdir(parents=True, exist_ok=True)
        save_run(work, run)
    if is_sound(work / "scene", run.digest):
        return
    known, solution, skipped = prepare_scene(
        run.footprints, run.plan.stride, run.settings, progress
    )
    _refuse_changed(run, run.footprints.used)
    with disk_errors(work):
        _save_known(work / "scene", known, solution, [*run.lost, *skipped], run.digest)


def solve_tiles(work, tiles, tiling, progress=silent):
    """Solve tiles of a prepared run; those that are done stay as they are.

    Parameters
    ----------
    work : Path
    tiles : sequence of Tile
    tiling : Tiling
    progress : callable
    """
    run, numbers = load_run(work), [tile.number for tile in tiles]
    left = [n for n in numbers if not is_sound(part_folder(work, n), run.digest)]
    failed = solve_all(solve_part, work, left, tiling, progress)
    if failed:
        raise LommelError(
            f"{len(failed)} of {len(tiles)} tiles failed, also when tried again:\n"
            + "\n".join(f"  tile {number}: {reason}" for number, reason in failed.items())
            + f"\nThe others wait in {work}: the same command goes on from there."
        )


def solve_part(work, number):
    """Solve one tile and keep it, unless that is done already; text of what went wrong, or None.

    Parameters
    ----------
    work : Path
    number : int

    Returns
    -------
    reason : str or None
    """
    try:
        run, part = load_run(work), part_folder(work, number)
        if is_done(part, run.digest):
            return None
        start, tile = time.perf_counter(), run.plan.tiles[number]
        refuse_full(work, size_on_disk(tile, run.grid.shape))
        files = run.footprints.within(tile.outer)
        products, record = solve_tile(files, run.grid, tile, load_known(work), run.settings)
        _refuse_changed(run, files)
        record |= {
            "digest": run.digest,
            "seconds": round(time.perf_counter() - start, 3),
            "peak_memory_mb": round(peak_memory_mb(), 1),
        }
        with disk_errors(part):
            save_part(part, products, record)
    except Exception as error:  # whatever it is: the other tiles go on
        return str(error) if isinstance(error, LommelError) else f"{type(error).__name__}: {error}"
    return None


def _refuse_changed(run, files):
    refuse_changed(run.stamps, [*files.images, *files.dems, *filter(None, files.cameras)])


def load_known(work):
    """What all tiles share, of a prepared run.

    Parameters
    ----------
    work : Path

    Returns
    -------
    known : Known
    """
    folder = work / "scene"
    record = read_record(folder)
    priors = {k: np.array(v) if isinstance(v, list) else v for k, v in record["priors"].items()}
    arrays = {name: read_array(folder, name) for name in ARRAYS}
    plain = {name: record[name] for name in ("names", "stride", "base_height")}
    return Known(**arrays, **plain, priors=Priors(**priors))


def _save_known(folder, known, solution, skipped, digest):
    arrays = {name: getattr(known, name) for name in ARRAYS}
    record = {
        "digest": digest,
        "names": known.names,
        "stride": known.stride,
        "base_height": known.base_height,
        "priors": {k: np.asarray(v).tolist() for k, v in vars(known.priors).items()},
        "outcome": solution.outcome,
        "sentence": solution.advice,
        "history": solution.history,
        "skipped": [{"name": skip.name, "reason": skip.reason} for skip in skipped],
    }
    save_part(folder, arrays, record)


def _absolute(files):
    """The same files for workers that stand in another folder."""

    def absolute(paths):
        return tuple(path and Path(os.path.abspath(path)) for path in paths)

    tables = (files.sun_positions, files.spacecraft_positions)
    suns, crafts = (path and Path(os.path.abspath(path)) for path in tables)
    return replace(
        files,
        images=absolute(files.images),
        dems=absolute(files.dems),
        cameras=absolute(files.cameras),
        sun_positions=suns,
        spacecraft_positions=crafts,
    )
