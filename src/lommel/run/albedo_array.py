"""`lommel albedo` as the shares of a job array, on machines that know nothing of each other.

One job looks where images lie. Any number of jobs then do the same run together: each does its
share of a step, and what is left of the others' shares, before it goes on to the next one. A last
job writes the products from the maps. Most callers want `prepare_albedo`, `solve_albedo_share` and
`merge_albedo`.
"""

import pickle
from pathlib import Path
from tempfile import TemporaryDirectory

from lommel.errors import InputError, LommelError
from lommel.estimate.albedo import make_maps
from lommel.progress import silent
from lommel.run.albedo import AlbedoRun, asked_for, photometry_of, place_run, write_products
from lommel.run.albedo_plan import plan_albedo
from lommel.run.albedo_records import Kept, work_folder
from lommel.run.locks import only_run
from lommel.run.parts import Parts
from lommel.run.products import RunRecord, output_folder
from lommel.run.records import RUN, disk_errors, load_pickled, write_whole
from lommel.run.shares import refuse_changes
from lommel.run.tiles_engines import check_engine, open_engine
from lommel.run.tiles_plan import Tiling


def prepare_albedo(files, output, settings, grid_settings, tiling, progress=silent):
    """Look where images lie, and keep what the shares have to know.

    Parameters
    ----------
    files : SceneFiles
    output : path
        Of the run; what is found waits beside it.
    settings : AlbedoSettings
    grid_settings : GridSettings or None
    tiling : Tiling
    progress : callable

    Returns
    -------
    images : int
    """
    if settings.solver == "alternating":
        raise InputError(
            "--solver alternating goes not with --tiles: it has one step per pass, a hundred or "
            "so. Take --engine dask, or the default solver, which has four."
        )
    record = RunRecord("albedo", asked_for(settings, grid_settings))
    with only_run(output), TemporaryDirectory() as unused:  # no camera is registered
        terms = Path(unused), settings, grid_settings, False, record, progress
        run = place_run(files, *terms)
        kept = Kept(work_folder(output), run.digest)
        kept.begin(plan_albedo(run.placed, settings, tiling, is_shared=True))
        with disk_errors(kept.folder):
            write_whole(kept.folder / RUN, pickle.dumps(run))
    return len(run.placed.places)


def solve_albedo_share(files, output, settings, grid_settings, tiling, share, progress=silent):
    """Do a share of a run that is prepared; all of it is done when no other share is at work.

    Parameters
    ----------
    files, output, settings, grid_settings, tiling, progress
        As of `prepare_albedo`.
    share : Share
    """
    work = work_folder(output)
    if not (work / RUN).exists():
        raise LommelError(
            f"{work} holds no prepared run. Run the same command with --tiles 0/{share.count} "
            "first, and the shares when it is done."
        )
    check_engine(tiling)
    run: AlbedoRun = load_pickled(work / RUN)
    tables = (files.sun_positions, files.spacecraft_positions)
    given = [*files.images, *files.dems, *files.cameras, *filter(None, tables)]
    refuse_changes(run, asked_for(settings, grid_settings), given, work, share)
    plan, kept = plan_albedo(run.placed, settings, tiling, is_shared=True), Kept(work, run.digest)
    with only_run(output, is_shared=True), open_engine(tiling) as engine, plan.limits():
        terms = work, run.digest, tiling, engine, plan.most_threads, progress
        _, fit = photometry_of(run, plan, Parts(*terms, share), kept)
        make_maps(*fit())


def is_prepared(output):
    """True where `prepare_albedo` has left something for the shares of a run."""
    return (work_folder(output) / RUN).exists()


def merge_albedo(output, overwrite=False, progress=silent):
    """Write the products when all shares are done.

    Parameters
    ----------
    output : path
        Folder that appears when the products are written; what waits beside it goes.
    overwrite : bool
    progress : callable

    Returns
    -------
    results : dict of str to number
        As in ``run.json``.
    """
    run: AlbedoRun = load_pickled(work_folder(output) / RUN)
    plan = plan_albedo(run.placed, run.settings, Tiling(), is_shared=True)
    kept, record = Kept(work_folder(output), run.digest), RunRecord("albedo", run.asked, run.inputs)
    with (
        output_folder(output, overwrite, kept.folder) as folder,
        open_engine(Tiling()) as engine,
    ):
        terms = kept.folder, run.digest, Tiling(), engine, plan.most_threads, progress
        write_products(run, plan, Parts(*terms, is_complete=True), kept, folder, record)
    return record.results
