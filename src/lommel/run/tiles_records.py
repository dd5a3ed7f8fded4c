"""What decides the tiles of a run, kept for its workers and for those who join later.

Most callers want `TiledRun`.
"""

import json
import pickle
from dataclasses import dataclass
from pathlib import Path

from lommel import __version__
from lommel.run.footprints import Footprints
from lommel.run.records import RUN, load_pickled, write_whole
from lommel.run.shape_from_shading import SfsSettings
from lommel.run.tiles_plan import Plan


@dataclass(frozen=True)
class TiledRun:
    """What decides the tiles of a run: all that a worker has to be told, but for the folder.

    Attributes
    ----------
    footprints : Footprints
        Of files with absolute paths and registered cameras.
    plan : Plan
    settings : SfsSettings
    asked : dict
        The settings as ``run.json`` shows them.
    inputs : list of dict
        Path, bytes and digest of each input file.
    stamps : dict of str to (int, int)
        Size and time of change of each, before its digest was taken.
    lost : list of Skipped
        Images that could not be registered, that touch nothing or cannot be read.
    digest : str
    version : str
        Of the program.
    """

    footprints: Footprints
    plan: Plan
    settings: SfsSettings
    asked: dict
    inputs: list
    stamps: dict
    lost: list
    digest: str
    version: str = __version__

    @property
    def grid(self):
        """Of the whole scene."""
        return self.footprints.grid


def save_run(work, run):
    """Keep what a run is, for its workers and for those who join later.

    Also ``plan.json``, which tells how it is cut.

    Parameters
    ----------
    work : Path
    run : TiledRun
    """
    plan = {"shape": run.plan.shape, "side": run.plan.side, "stride": run.plan.stride}
    write_whole(work / RUN, pickle.dumps(run))
    write_whole(work / "plan.json", json.dumps(plan).encode())


def load_run(work):
    """What `save_run` has kept.

    Parameters
    ----------
    work : Path

    Returns
    -------
    run : TiledRun
        `LommelError` when there is none, or it was made by another version.
    """
    return load_pickled(Path(work) / RUN)


def part_folder(work, number):
    """Where a tile is kept."""
    return Path(work) / f"tile-{number:05d}"
