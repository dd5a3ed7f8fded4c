"""Shares of a job array, on machines that know nothing of each other but a disk.

Most callers want `Share` and `read_share`.
"""

import re
from dataclasses import dataclass

from lommel.errors import InputError
from lommel.run.records import RUN


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


def refuse_changes(run, asked, given, work, share):
    """A share must be of what was prepared; digests of all images would take hours.

    Parameters
    ----------
    run : TiledRun or AlbedoRun
        As prepared.
    asked : dict
        The settings of the share.
    given : list of Path
        Its input files.
    work : Path
        Folder that holds what was prepared.
    share : Share
    """
    advice = prepare_again(share)
    if asked != run.asked:
        names = [name for name in asked if asked[name] != run.asked.get(name)]
        raise InputError(f"{', '.join(names)}: not as when the scene was prepared. {advice}")
    known = {one["path"]: one["bytes"] for one in run.inputs}
    if {str(path) for path in given} != set(known):
        raise InputError(f"The input files are not those the scene was prepared with. {advice}")
    prepared = (work / RUN).stat().st_mtime
    for path in given:
        state = path.stat() if path.exists() else None
        if state is None or state.st_size != known[str(path)] or state.st_mtime > prepared:
            raise InputError(f"{path} has changed since the scene was prepared. {advice}")


def prepare_again(share):
    """Advice where a share is not of what was prepared."""
    return f"Run --tiles 0/{share.count} again with what is to hold for all shares."


def refuse_registration(registers):
    """Raise `InputError` where ``--register`` is asked for."""
    if registers:
        raise InputError(
            "--register goes not with --tiles: every share would register anew. Run `lommel "
            "register` first and give the cameras it writes with --cameras."
        )
