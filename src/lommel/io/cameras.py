"""The camera of an image: which file holds it, and which reader it needs.

Most callers want `find_camera` and `read_camera`.
"""

from pathlib import Path

from lommel.errors import InputError, LommelError

SUFFIXES = (".json", ".isd", ".tsai")


def find_camera(image, may_have_label=True):
    """Path of the file that holds an image's camera, or None.

    Parameters
    ----------
    image : Path
        ``frame.tif`` has its camera in ``frame.json`` or ``frame.isd`` (ISD), ``frame.tsai``, or,
        when none of these exists, in its own ISIS label.
    may_have_label : bool
        False when it is known to have none, which spares a look.

    Returns
    -------
    camera : Path or None
    """
    image = Path(image)
    for suffix in SUFFIXES:
        path = image.with_suffix(suffix)
        if path != image and path.exists() and (suffix != ".json" or _is_isd(path)):
            return path
    if not may_have_label:
        return None
    from lommel.io.isis import has_camera

    try:
        return image if has_camera(image) else None
    except LommelError:
        return None  # reported when the image is read


def read_camera(path, shape, kernels=None):
    """The camera in a file.

    Parameters
    ----------
    path : Path
    shape : tuple of int
        Lines and samples of the image.
    kernels : path, optional
        SPICE meta-kernel, which together with the label of an ISIS cube makes the camera.

    Returns
    -------
    camera : Camera
    """
    path = Path(path)
    try:
        return _read(path, shape, kernels)
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from error  # what the models refuse


def _is_isd(path):
    from lommel.io.isd import is_isd

    return is_isd(path)


def _read(path, shape, kernels):
    """Through the one reader it takes: importing all of them would cost half a second."""
    suffix = path.suffix.lower()
    if kernels is None and suffix == ".tsai":
        from lommel.io.tsai import read_tsai

        return read_tsai(path, shape)
    if kernels is None and suffix in SUFFIXES:
        from lommel.io.isd import read_isd

        return read_isd(path, shape)
    from lommel.io.isis import has_camera, read_isis

    if kernels is not None:
        return read_isis(path, shape, kernels)
    try:
        is_cube = has_camera(path)
    except LommelError:
        is_cube = False
    if not is_cube and path.suffix.lower() != ".cub":
        raise InputError(
            f"{path}: no reader for cameras in {path.suffix or 'nameless'} files. "
            f"Give one of {', '.join(SUFFIXES)}, or an ISIS cube after spiceinit."
        )
    return read_isis(path, shape)
