"""Pinhole cameras in the Ames Stereo Pipeline's ``.tsai`` text files.

Such a file gives the camera's centre, the rotation from the camera frame to the body, focal length,
principal point and pixel pitch in one unit of length. Its pixels count (0, 0) at the centre
of the first pixel; ours put that centre at (0.5, 0.5). The name of the lens follows, and its
coefficients: ``NULL`` has none, those of ``TSAI`` count in focal lengths, those of
``BROWN_CONRADY`` in the file's unit; `lommel.scene.distortion` shows the formulas, which are the
Vision Workbench's (``LensDistortion.cc``). Most callers want `read_tsai`.
"""

import re

import numpy as np

from lommel.errors import InputError
from lommel.scene.camera import FrameCamera
from lommel.scene.distortion import Distortion

SIZE_LIMIT = 100_000  # bytes; such files hold a few hundred
NEEDED = ("fu", "fv", "cu", "cv", "u_direction", "v_direction", "w_direction", "C", "R", "pitch")
LENSES = {  # name in the file: our model, coefficients that must be there, and may be
    "TSAI": ("radtan", ("k1", "k2", "p1", "p2"), ("k3",)),
    "BROWN_CONRADY": ("brown-conrady", ("xp", "yp", "k1", "k2", "k3", "p1", "p2", "phi"), ()),
}


def read_tsai(path, shape):
    """The camera of a ``.tsai`` file.

    Parameters
    ----------
    path : path
    shape : tuple of int
        Lines and samples of the image, which the file does not hold.

    Returns
    -------
    camera : FrameCamera
    """
    values, lens = _parse(path)
    axes = np.concatenate([values[f"{axis}_direction"] for axis in "uvw"])
    if not np.array_equal(axes, np.eye(3).ravel()):
        raise InputError(
            f"{path}: u, v and w_direction must be the unit axes 1 0 0, 0 1 0 and 0 0 1."
        )
    pitch, fu, fv, cu, cv = (float(values[key][0]) for key in ("pitch", "fu", "fv", "cu", "cv"))
    if not (pitch > 0 and fu == fv):
        raise InputError(
            f"{path}: pitch = {pitch} must be positive, and fu = {fu} equal to fv = {fv}."
        )
    return FrameCamera(
        position=values["C"],
        rotation=values["R"].reshape(3, 3).T,
        focal_length=fu / pitch,
        principal_point=(cv / pitch + 0.5, cu / pitch + 0.5),
        shape=shape,
        distortion=_distortion(path, values, lens, fu / pitch, 1 / pitch),
    )


def _distortion(path, values, lens, focal_length, unit):
    """The lens; focal length and the file's unit of length in pixels."""
    if lens in ("NULL", None):
        return None
    if lens not in LENSES:
        raise InputError(
            f"{path}: lens distortion {lens} is not supported. Supported are NULL, "
            f"{', '.join(LENSES)}; else give an ISD."
        )
    model, needed, optional = LENSES[lens]
    coefficients = []
    for name in needed + optional:
        value = values.get(name, np.zeros(1) if name in optional else None)
        if value is None or value.size != 1:
            raise InputError(
                f"{path}: {name} is missing or malformed; the lens {lens} needs "
                f"{', '.join(needed)}."
            )
        coefficients.append(float(value[0]))
    return Distortion(model, tuple(coefficients), focal_length if model == "radtan" else unit)


def _parse(path):
    try:
        with open(path, encoding="utf-8") as file:
            lines = file.read(SIZE_LIMIT).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as a .tsai camera: {error}") from error
    values, lens = {}, None
    for line in lines:
        key, equals, text = (part.strip() for part in line.partition("="))
        if equals:
            try:
                values[key] = np.array([float(word) for word in text.split()])
            except ValueError:
                continue
        elif re.fullmatch(r"[A-Za-z]\w*", key) and key != "PINHOLE" and "VERSION" not in key:
            lens = key
    sizes = {"u_direction": 3, "v_direction": 3, "w_direction": 3, "C": 3, "R": 9}
    for key in NEEDED:
        value = values.get(key)
        if value is None or value.size != sizes.get(key, 1) or not np.isfinite(value).all():
            raise InputError(
                f"{path}: {key} is missing or malformed; a .tsai camera needs {', '.join(NEEDED)}."
            )
    return values, lens
