"""Tiles as the shares of a job array, on machines that know nothing of each other but a disk.

One job prepares the scene, any number of jobs solve a share of its tiles each, and a last one
blends them into products. Most callers want `prepare_array`, `solve_share` and `merge_tiles`.
"""

import re
from dataclasses import asdict, dataclass
from pathlib import Path

from lommel.errors import InputError, LommelError
from lommel.progress import silent, step
from lommel.run.inputs import GridSettings
from lommel.run.products import RunRecord, output_folder
from lommel.run.selection import survey_images
from lommel.run.tiles import describe_run, load_known, prepare, solve_tiles
from lommel.run.tiles_engines import check_engine
from lommel.run.tiles_plan import work_folder
from lommel.run.tiles_products import finish_products
from lommel.run.tiles_records import (
    RUN,
    disk_errors,
    is_done,
    load_run,
    part_folder,
    remove_work,
)


@dataclass(frozen=True)
class Share:
    """Which tiles a job has.

    Attributes
    ----------
    number : int
        0 for the job that prepares the scene and solves nothing, else 1 to ``count``.
    count : int
    """

    number: int
    count: int

    def __str__(self):
        """As it is given: ``3/64``."""
        return f"{self.number}/{self.count}"


def read_share(text):
    """A share from a text such as ``3/64``.

    Parameters
    ----------
    text : str

    Returns
    -------
    share : Share

    Examples
    --------
    >>> read_share("3/64")
    Share(number=3, count=64)
    """
    found = re.fullmatch(r"\s*(\d{1,7})\s*/\s*(\d{1,7})\s*", text)
    share = Share(int(found[1]), int(found[2])) if found else Share(1, 0)
    if share.number > share.count or share.count == 0:
        raise InputError(
            f"tiles = {text!r} is no share. Give 1/64 to 64/64 for the shares of 64 jobs, and "
            "before them 0/64 once, which prepares the scene."
        )
    return share


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
    if settings.registers:
        raise InputError(
            "--register goes not with --tiles: every share would register anew. Run `lommel "
            "register` first and give the cameras it writes with --cameras."
        )
    with step(progress, "footprints"):
        footprints = survey_images(files, grid_settings, settings, output)
    run = describe_run(files, footprints, [], output, settings, grid_settings, tiling, progress)
    if not run.plan.is_tiled:
        raise InputError(
            "The scene fits in memory in one piece, so there is nothing to share. Leave --tiles "
            "out, or give less --memory."
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
    run = load_run(work)
    asked = asdict(settings) | {"grid": asdict(grid_settings or GridSettings())}
    given = [*files.images, *files.dems, *files.cameras, files.sun_positions]
    given += [files.spacecraft_positions, settings.albedo, settings.exposures]
    _refuse_changes(run, asked, [Path(path) for path in given if path], work, share)
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
            "`lommel sfs --tiles`."
        )
    run = load_run(work)
    numbers = [tile.number for tile in run.plan.tiles]
    missing = [n for n in numbers if not is_done(part_folder(work, n), run.digest)]
    if missing or not is_done(work / "scene", run.digest):
        shown = ", ".join(map(str, missing[:10])) + (", ..." if len(missing) > 10 else "")
        raise LommelError(
            f"{len(missing)} of {len(numbers)} tiles are not solved: {shown}. Tile n, from 0, is "
            "of share n mod N + 1 of N; run the missing shares again, those done take no time."
        )
    record = RunRecord("sfs", dict(run.asked), list(run.inputs))
    with output_folder(output, overwrite) as folder:
        with record.stage("write"), disk_errors(folder):
            finish_products(run, work, folder, record, load_known(work), progress)
        record.write(folder)
    remove_work(work)
    return record.results


def _refuse_changes(run, asked, given, work, share):
    """A share must be of the scene that was prepared; digests of all images would take hours."""
    advice = f"Run --tiles 0/{share.count} again with what is to hold for all shares."
    if asked != run.asked:
        names = [name for name in asked if asked[name] != run.asked.get(name)]
        raise InputError(f"{', '.join(names)}: not as when the scene was prepared. {advice}")
    if not is_done(work / "scene", run.digest):
        raise LommelError(f"The scene in {work} is not prepared to the end. {advice}")
    known = {one["path"]: one["bytes"] for one in run.inputs}
    if {str(path) for path in given} != set(known):
        raise InputError(f"The input files are not those the scene was prepared with. {advice}")
    prepared = (work / RUN).stat().st_mtime
    for path in given:
        state = path.stat() if path.exists() else None
        if state is None or state.st_size != known[str(path)] or state.st_mtime > prepared:
            raise InputError(f"{path} has changed since the scene was prepared. {advice}")
