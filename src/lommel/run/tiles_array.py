"""Tiles as the shares of a job array, on machines that know nothing of each other but a disk.

One job prepares the scene, any number of jobs solve a share of its tiles each, and a last one
blends them into products. Most callers want `prepare_array`, `solve_share` and `merge_tiles`.
"""

from dataclasses import asdict, replace
from pathlib import Path

from lommel.errors import InputError, LommelError
from lommel.progress import silent, step
from lommel.run.inputs import GridSettings
from lommel.run.locks import only_run
from lommel.run.products import RunRecord, output_folder
from lommel.run.records import RUN, is_done, is_sound
from lommel.run.selection import survey_images
from lommel.run.shares import prepare_again, refuse_changes, refuse_registration
from lommel.run.tiles import describe_run, prepare, solve_tiles, write_products
from lommel.run.tiles_engines import check_engine
from lommel.run.tiles_plan import work_folder
from lommel.run.tiles_records import load_run, part_folder


def prepare_array(files, output, settings, grid_settings, tiling, progress=silent):
    """Solve the whole scene coarsely, and keep what the shares have to know.

    Parameters
    ----------
    files : SceneFiles
    output : path
        Of the run; the tiles wait beside it.
    settings : SfsSettings
    grid_settings : GridSettings or None
    tiling : Tiling
    progress : callable

    Returns
    -------
    tiles : int
    """
    refuse_registration(settings.registers)
    tiling = replace(tiling, engine=tiling.engine or "serial")  # each share plans for itself alone
    with only_run(output):
        with step(progress, "footprints"):
            footprints = survey_images(files, grid_settings, settings, output)
        run = describe_run(files, footprints, [], output, settings, grid_settings, tiling, progress)
        if not run.plan.is_tiled:
            raise InputError(
                "The scene fits in memory in one piece, so there is nothing to share. Leave "
                "--tiles out, or give less --memory."
            )
        prepare(run, work_folder(output), progress)
    return len(run.plan.tiles)


def solve_share(files, output, settings, grid_settings, tiling, share, progress=silent):
    """Solve every so manieth tile of a scene that is prepared.

    Parameters
    ----------
    files, output, settings, grid_settings, tiling, progress
        As of `prepare_array`.
    share : Share

    Returns
    -------
    tiles : int
        Of this share.
    """
    work = work_folder(output)
    if not (work / RUN).exists():
        raise LommelError(
            f"{work} holds no prepared scene. Run the same command with --tiles 0/{share.count} "
            "first, and the shares when it is done."
        )
    check_engine(tiling)
    with only_run(output, is_shared=True):
        run = load_run(work)
        asked = asdict(settings) | {"grid": asdict(grid_settings or GridSettings())}
        given = [*files.images, *files.dems, *files.cameras, files.sun_positions]
        given += [files.spacecraft_positions, settings.albedo, settings.exposures]
        refuse_changes(run, asked, [Path(path) for path in given if path], work, share)
        if not is_done(work / "scene", run.digest):
            raise LommelError(
                f"The scene in {work} is not prepared to the end. {prepare_again(share)}"
            )
        tiles = run.plan.tiles[share.number - 1 :: share.count]
        solve_tiles(work, tiles, tiling, progress)
    return len(tiles)


def merge_tiles(output, overwrite=False, progress=silent):
    """Blend the tiles of all shares into products.

    Parameters
    ----------
    output : path
        Folder that appears when the products are written; the tiles beside it go.
    overwrite : bool
    progress : callable

    Returns
    -------
    results : dict of str to number
        As in ``run.json``.
    """
    work = work_folder(output)
    if not (work / RUN).exists():
        raise InputError(
            f"{output} has no tiles beside it ({work} is not there). Name the --output of "
            "jobs with --tiles."
        )
    run = load_run(work)
    numbers = [tile.number for tile in run.plan.tiles]
    if not is_sound(work / "scene", run.digest):
        raise LommelError(
            f"The scene in {work} is not prepared. Run --tiles 0/N again, then all shares."
        )
    missing = [n for n in numbers if not is_sound(part_folder(work, n), run.digest)]
    if missing:
        shown = ", ".join(map(str, missing[:10])) + (", ..." if len(missing) > 10 else "")
        raise LommelError(
            f"{len(missing)} of {len(numbers)} tiles are not solved: {shown}. Run the shares "
            "again, what is done takes no time; or the same command with --tiles 1/1, which "
            "solves all that are missing."
        )
    record = RunRecord("sfs", dict(run.asked), list(run.inputs))
    with output_folder(output, overwrite, work) as folder:
        write_products(run, work, folder, record, progress)
    return record.results
