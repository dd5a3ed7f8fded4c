"""What `lommel albedo` keeps beside its output until all is done, so that it can be broken off.

Terrain and images on the run's grid, and the photometry that the passes over them have told; each
is there whole or not at all, with the digest of what it was made from. Most callers want `Kept`.
"""

import os
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from lommel.estimate.albedo import Photometry
from lommel.estimate.albedo_arrays import State
from lommel.run.locks import remove
from lommel.run.records import (
    clear_partial,
    digest_of,
    disk_errors,
    is_done,
    is_sound,
    new_part,
    read_record,
    refuse_full,
    save_part,
)
from lommel.run.stored_rows import StoredRows

# jobs of workers that have left rows are done again: that reads whether the rows are as they were
STEPS_WITH_ROWS = ("terrain", "images")


@dataclass(frozen=True)
class Kept:
    """Keeps what a run has found in a hidden folder, where the same request finds it again.

    Attributes
    ----------
    folder : Path
        From `work_folder`.
    digest : str
        Of settings and inputs: it tells whether what is there belongs to this request.
    """

    folder: Path
    digest: str

    def begin(self, plan):
        """Make the folder, if the disk has room for what it will hold.

        Parameters
        ----------
        plan : AlbedoPlan
        """
        with disk_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        clear_partial(self.folder)
        for step in STEPS_WITH_ROWS:
            remove(self.folder / step)
        present = sum(path.stat().st_size for path in self.folder.rglob("rows"))
        refuse_full(self.folder, plan.disk - present)

    def rows(self, name, shape, parts):
        """An array from its parts, as `Held.rows`; they are not asked for when it is there."""
        folder = self.folder / name
        if not is_sound(folder, self.digest):
            with disk_errors(folder), new_part(folder, {"digest": self.digest}) as partial:
                with open(partial / "rows", "wb") as file:
                    for part in parts:
                        part.tofile(file)
        return StoredRows(folder / "rows", shape)

    def photometry(self, compute, names):
        """What ``compute()`` gives, or has given to a run on the same images.

        Parameters
        ----------
        compute : function ()
        names : list of str
            Of the images.
        """
        folder, digest = self.folder / "photometry", digest_of([self.digest, names])
        if is_done(folder, digest):
            return _photometry(read_record(folder))
        found = compute()
        with disk_errors(folder):
            save_part(folder, {}, {"digest": digest} | _content(found))
        return found


def work_folder(output):
    """Where a run keeps what it has found."""
    output = Path(os.path.realpath(output))
    return output.with_name(f".{output.name}.albedo")


def _content(found):
    content = vars(found) | {"state": found.state._asdict()}
    return {name: _plain(value) for name, value in content.items()}


def _plain(value):
    """Numbers that JSON brings back as they are, to the last bit."""
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    return value.tolist() if hasattr(value, "tolist") else value


def _photometry(record):
    values = {field.name: record[field.name] for field in fields(Photometry)}
    state = State(**{name: np.array(part) for name, part in values["state"].items()})
    arrays = {name: np.array(values[name]) for name in ("errors", "shared_errors")}
    return Photometry(**values | arrays | {"state": state})
