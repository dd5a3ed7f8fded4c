"""Parts of a run on the disk, each whole or not at all, so that a run can be broken off.

A part is a folder with arrays or other files and ``record.json``, which takes its name when it is
whole. It counts as done when its record carries the digest of what it was made from, and its files
are those the record lists: a machine that loses its power may keep the name of a file and lose what
was in it. Several processes, also of several machines, may work in the same folder. Most callers
want `save_part` and `is_done`.
"""

import hashlib
import json
import os
import pickle
import shutil
import zlib
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from lommel import __version__
from lommel.errors import LommelError
from lommel.run.locks import me, remove

RUN = "run.pickle"  # pickled, as the folder belongs to the user as compiled code does
AT_ONCE = 2**20  # bytes of a file that are read at a time


def write_whole(path, content):
    """Write a file that appears whole or not at all.

    Parameters
    ----------
    path : Path
    content : bytes
    """
    partial = path.with_name(f".{path.name}.{me()}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def load_pickled(path):
    """An object with the ``version`` of the program that has pickled it.

    Parameters
    ----------
    path : Path

    Returns
    -------
    content : object
        `LommelError` as of `load_run`.
    """
    try:
        content = pickle.loads(path.read_bytes())
        if content.version != __version__:
            raise LommelError(
                f"{path} was prepared by lommel {content.version}, this is {__version__}. Use one "
                "version on all machines, or prepare anew."
            )
    except OSError as error:
        raise LommelError(
            f"{path} cannot be read ({error.strerror}). All workers must see the folder of the "
            "output, on a shared disk, and the run must have been prepared."
        ) from error
    except LommelError:
        raise
    except Exception as error:  # bytes that are none of a pickle raise whatever they like
        raise LommelError(f"{path} is damaged ({error}). Prepare the run anew.") from error
    return content


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
    with new_part(folder, record) as partial:
        for name, values in arrays.items():
            np.save(partial / f"{name}.npy", values, allow_pickle=False)


@contextmanager
def new_part(folder, record):
    """The same for what the block writes into the folder that it is given.

    Parameters
    ----------
    folder : Path
    record : dict
        With ``digest``.

    Yields
    ------
    partial : Path
    """
    partial = folder.with_name(f".{folder.name}.{me()}.partial")
    remove(partial)
    partial.mkdir(parents=True)
    try:
        yield partial
        files = {path.name: _seal(path) for path in sorted(partial.iterdir())}
        text = json.dumps(record | {"files": files}, default=_plain)
        (partial / "record.json").write_text(text, encoding="utf-8")
        if is_done(folder, record["digest"]):  # by another worker, and others may be reading it
            return
        remove(folder)
        try:
            partial.rename(folder)
        except OSError:
            if not is_done(folder, record["digest"]):  # by another worker, who was as quick
                raise
    finally:
        remove(partial)


def read_record(folder):
    """The record of a part; empty when there is none or it cannot be read."""
    try:
        record = json.loads((Path(folder) / "record.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def is_done(folder, digest):
    """True when the part exists, was made from the same settings and inputs, and lacks no byte."""
    record = read_record(folder)
    sizes = {name: size for name, (size, _) in record.get("files", {}).items()}
    return record.get("digest") == digest and all(
        _size(Path(folder) / name) == size for name, size in sizes.items()
    )


def is_sound(folder, digest):
    """The same after every byte was read; a part with other bytes than it had is removed.

    For parts that an earlier run has left: workers, who ask `is_done`, then make them anew.

    Parameters
    ----------
    folder : Path
    digest : str

    Returns
    -------
    is_sound : bool
    """
    if not is_done(folder, digest):
        return False
    seals = read_record(folder).get("files", {})
    with suppress(OSError):
        if all(_seal(Path(folder) / name) == tuple(seal) for name, seal in seals.items()):
            return True
    remove(folder)
    return False


def refuse_foreign(folders, digest):
    """`LommelError` where a part that was used is of another run by now.

    A worker of a cluster goes on with the part it has when its run is killed, and may write it
    after a run with other settings has made its own.

    Parameters
    ----------
    folders : iterable of Path
    digest : str
    """
    for folder in folders:
        if not is_done(folder, digest):
            raise LommelError(
                f"{folder} was replaced meanwhile, by a worker that an earlier run with other "
                "settings or inputs has left at work. Give the same command again."
            )


def _size(path):
    try:
        return path.stat().st_size
    except OSError:
        return None


def _seal(path):
    """Size and checksum of a file: they tell what a crash or a disk has changed."""
    size = checksum = 0
    with open(path, "rb") as file:
        while content := file.read(AT_ONCE):
            size += len(content)
            checksum = zlib.crc32(content, checksum)
    return size, checksum


def read_array(folder, name):
    """An array of a part, read from disk as it is used."""
    return np.load(Path(folder) / f"{name}.npy", mmap_mode="r", allow_pickle=False)


def stamps(paths):
    """Size and time of change of files, by their absolute paths; None for one that is not there.

    Parameters
    ----------
    paths : iterable of path
    """
    return {os.path.abspath(path): _stamp(path) for path in paths}


def _stamp(path):
    try:
        state = os.stat(path)
    except OSError:
        return None
    return state.st_size, state.st_mtime_ns


def refuse_changed(known, paths):
    """`LommelError` for files that are not as they were when the run began.

    What was read of them may be of one state or of the other, and the digests are of the first.

    Parameters
    ----------
    known : dict
        From `stamps`; a file that it does not name may change.
    paths : iterable of path
    """
    for path, stamp in stamps(paths).items():
        if stamp != known.get(path, stamp):
            raise LommelError(
                f"{path} has changed while the run was at work. When it is as it shall stay, give "
                "the same command again."
            )


def clear_partial(folder):
    """Remove what a process that was killed has left unfinished."""
    for partial in list(Path(folder).rglob(".*.partial")):
        remove(partial)


@contextmanager
def disk_errors(folder):
    """Tell what a disk refuses, in words."""
    try:
        yield
    except OSError as error:
        free = shutil.disk_usage(next(f for f in (folder, *folder.parents) if f.exists())).free
        raise LommelError(
            f"{folder} cannot be written: {error.strerror or error}; {free / 1e6:.1f} MB of its "
            "disk are free. Make space; what is done is kept, and the same command goes on."
        ) from error


def refuse_full(folder, size):
    """Refuse to compute what the disk cannot take.

    Parameters
    ----------
    folder : Path
    size : int, bytes
    """
    free = shutil.disk_usage(folder).free
    if free < size:
        raise LommelError(
            f"the disk of {folder} has {free / 1e6:.1f} MB free, {size / 1e6:.1f} MB are needed"
        )


def _plain(value):
    return value.tolist() if hasattr(value, "tolist") else str(value)
