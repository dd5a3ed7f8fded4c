"""The camera of an image: which file holds it, and which reader it needs.

Most callers want `find_camera` and `read_camera`.
"""

from pathlib import Path

from lommel.errors import InputError
from lommel.io.tsai import read_tsai

READERS = {".tsai": read_tsai}


def find_camera(image):
    """Path of the camera file beside an image, or None.

    Parameters
    ----------
    image : Path
        ``frame.tif`` has its camera in ``frame.tsai``.

    Returns
    -------
    camera : Path or None
    """
    beside = (Path(image).with_suffix(suffix) for suffix in READERS)
    return next((path for path in beside if path.exists()), None)


def read_camera(path, shape):
    """The camera in a file.

    Parameters
    ----------
    path : Path
    shape : tuple of int
        Lines and samples of the image.

    Returns
    -------
    camera : Camera
    """
    reader = READERS.get(Path(path).suffix.lower())
    if reader is None:
        raise InputError(
            f"{path}: no reader for cameras in {Path(path).suffix or 'nameless'} files. "
            f"Give one of {', '.join(READERS)}."
        )
    return reader(path, shape)
