"""What a run in tiles keeps on disk until all tiles are done, so that it can be broken off.

Each part is a folder with arrays and ``record.json``, which takes its name when it is whole. A part
counts as done when its record carries the digest of what it was made from. Most callers want
`save_part` and `is_done`.
"""

import hashlib
import json
import os
import shutil
from pathlib import Path

import numpy as np

from lommel import __version__


def digest_of(content):
    """Digest of settings, inputs and whatever else decides what a part holds.

    Parameters
    ----------
    content : object
        That JSON can hold; other values count by their text.

    Returns
    -------
    digest : str
    """
    text = json.dumps([__version__, content], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def save_part(folder, arrays, record):
    """Write a part; it appears whole or not at all.

    Parameters
    ----------
    folder : Path
    arrays : dict of str to array
    record : dict
        With ``digest``.
    """
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        for name, values in arrays.items():
            np.save(partial / f"{name}.npy", values, allow_pickle=False)
        (partial / "record.json").write_text(json.dumps(record, default=_plain), encoding="utf-8")
        shutil.rmtree(folder, ignore_errors=True)
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def read_record(folder):
    """The record of a part; empty when there is none or it cannot be read."""
    try:
        record = json.loads((Path(folder) / "record.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def is_done(folder, digest):
    """True when the part exists and was made from the same settings and inputs."""
    return read_record(folder).get("digest") == digest


def read_array(folder, name):
    """An array of a part, read from disk as it is used."""
    return np.load(Path(folder) / f"{name}.npy", mmap_mode="r", allow_pickle=False)


def clear_partial(folder):
    """Remove what a process that was killed has left unfinished."""
    for partial in Path(folder).glob(".*.partial"):
        shutil.rmtree(partial, ignore_errors=True)


def _plain(value):
    return value.tolist() if hasattr(value, "tolist") else str(value)
