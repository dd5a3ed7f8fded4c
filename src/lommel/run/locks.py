"""One run at a time for an output, and what killed runs have left beside it.

A run holds a lock on the file ``.NAME.lock`` beside its output ``NAME``. The system takes the lock
away when the process ends, however it ends, so that of a killed run only the file stays, which
hinders nobody. Jobs of an array share the lock. A file system that knows no locks goes without:
then nothing is removed that another process might still write. Most callers want `only_run`.
"""

import fcntl
import os
import re
import shutil
import socket
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from lommel.errors import InputError


def me():
    """Name of this process among those of all machines, like ``host.123``."""
    return f"{re.sub('[^0-9A-Za-z_-]', '-', socket.gethostname())}.{os.getpid()}"


@contextmanager
def only_run(output, is_shared=False):
    """Nobody else writes an output while the block lasts; `InputError` where somebody does.

    Parameters
    ----------
    output : path
        Folders that it lies in are made; they go again if nothing is in them at the end.
    is_shared : bool
        Others may, who say so as well.

    Yields
    ------
    is_alone : bool
        False where others may be at work.
    """
    path = Path(os.path.realpath(output))
    file = path.with_name(f".{path.name}.lock")
    with ExitStack() as stack:
        with telling_unwritable(path):
            stack.callback(_remove_empty, [one for one in path.parents if not one.exists()])
            if not path.parent.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
            lock = _take(file, path, is_shared)
        if lock is not None:
            stack.callback(_give_back, file, lock)
        yield lock is not None and not is_shared


@contextmanager
def telling_unwritable(path):
    """`InputError` for what the place of an output refuses."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"--output {path} cannot be written: {error.strerror}. Name a folder on a disk "
            "with space where you may write."
        ) from error


def _remove_empty(folders):
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def _take(file, path, is_shared):
    """Descriptor of the file, locked; None where the file system knows no locks."""
    kind = fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX
    while True:
        lock = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(lock, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(lock, 200).decode(errors="replace") or "another process"
            os.close(lock)
            raise InputError(
                f"--output {path} is being written by {holder}. Wait until that is done, end it, "
                f"or name another folder. If it does not run any more, remove {file}."
            ) from None
        except OSError:
            os.close(lock)
            return None
        if _is_open(file, lock):
            with suppress(OSError):  # of a full disk
                os.ftruncate(lock, 0)
                os.write(lock, (f"jobs of an array, like {me()}" if is_shared else me()).encode())
            return lock
        os.close(lock)  # whoever held it has removed the file meanwhile


def _give_back(file, lock):
    with suppress(OSError):  # the last of those who share it removes it
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if _is_open(file, lock):
            file.unlink()
    os.close(lock)


def _is_open(file, descriptor):
    with suppress(FileNotFoundError):
        return os.path.samestat(os.stat(file), os.fstat(descriptor))
    return False


def remove(path):
    """Remove a file or a folder, which loses its name first: half of it is taken for nothing.

    Parameters
    ----------
    path : Path
    """
    gone = path
    if not path.name.endswith(".partial"):
        gone = path.with_name(f".{path.name}.{me()}.gone.partial")
        shutil.rmtree(gone, ignore_errors=True)
        try:
            path.rename(gone)
        except OSError:  # not there, or not allowed
            gone = path
    if gone.is_dir():
        shutil.rmtree(gone, ignore_errors=True)
    else:
        with suppress(OSError):
            gone.unlink()


def restore_replaced(path):
    """Give an output its name again that a run was about to replace when it was killed.

    Parameters
    ----------
    path : Path
    """
    for folder in _leftovers(path, "replaced"):
        if not path.exists():
            folder.rename(path)


def clear_leftovers(path):
    """Remove what killed runs have left unfinished beside an output, but for finished parts.

    Parameters
    ----------
    path : Path
    """
    for left in _leftovers(path, "replaced|partial"):
        remove(left)


def _leftovers(path, kind):
    name = re.escape(path.name)
    pattern = rf"\.({name}|\.{name}\.(tiles|albedo))\.[\w-]+\.\d+(\.gone)?\.({kind})"
    return [left for left in path.parent.iterdir() if re.fullmatch(pattern, left.name)]
