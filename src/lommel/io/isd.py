r"""CSM image support data (ISD), the JSON that ALE writes -> frame and line-scan cameras.

Times, J2000 quaternions and positions are tables as in ISIS cubes; the focal plane is given from
mm to detector pixels, so that with CSM's image coordinates

.. math:: line \cdot summing + start = center + t_0 + t_1 x + t_2 y,

t the row ``focal2pixel_lines``, and likewise for samples. A line of a line-scan image has the
detector's line 0 + start, and its centre was exposed at
:math:`t_c + t_i + \tau_i (line - line_i + 1/2)`, one row (line_i, t_i, tau_i) of
``line_scan_rate`` per rate. These relations are usgscsm's (``Utilities.cpp``,
``UsgsAstroLsSensorModel.cpp``); as there, lines of sight are (x, y, f) in the camera frame.
Most callers want `read_isd`; `lommel.io.isd_writer` writes such files.
"""

import json
import re

import numpy as np

from lommel.errors import InputError
from lommel.io.inertial import KM, from_quaternions, pointing, positions, rotations, trajectory
from lommel.io.sensors import FLIP, apollo_metric
from lommel.scene.camera import FrameCamera
from lommel.scene.distortion import Distortion
from lommel.scene.line_scan import LineScanCamera

SIZE_LIMIT = 128 * 2**20  # bytes; a NAC image of 52 224 lines with entries per line has 27 MB
FRAME, LINE_SCAN = "USGS_ASTRO_FRAME_SENSOR_MODEL", "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"
KEYS = {  # of `optical_distortion`: lommel's model, where its coefficients stand, how many at most
    "radial": ("radial", ("coefficients",), (3,)),
    "radtan": ("radtan", ("coefficients",), (5,)),
    "transverse": ("transverse", ("x", "y"), (10, 10)),
    "kaguyalism": ("kaguyalism", ("boresight_x", "x", "boresight_y", "y"), (1, 4, 1, 4)),
    "lrolrocnac": ("lrolrocnac", ("coefficients",), (1,)),
    "brown-conrady": ("brown-conrady", ("coefficients",), (8,)),  # lommel's own: CSM has none
}


def is_isd(path):
    """True when a file is JSON with the name of a CSM sensor model."""
    try:
        return "name_model" in _load(path)
    except InputError:
        return False


def read_isd(path, shape):
    """The camera of an ISD.

    Parameters
    ----------
    path : path
    shape : tuple of int
        Lines and samples of the image.

    Returns
    -------
    camera : FrameCamera or LineScanCamera
    """
    isd = _Isd(path, _load(path))
    model = isd.text("name_model")
    if model not in MODELS:
        raise InputError(
            f"{path} needs the CSM model {model or '(name_model is missing)'}, which is not "
            f"supported. Supported are {' and '.join(MODELS)}."
        )
    found = isd.whole("image_lines"), isd.whole("image_samples")
    if tuple(shape) != found:
        raise InputError(
            f"{path}: the camera belongs to an image of {found[0]} x {found[1]} pixels, but the "
            f"image has {shape[0]} x {shape[1]}. Name the camera of this very image."
        )
    return MODELS[model](isd, found)


def isd_shape(path):
    """Lines and samples of the image that an ISD belongs to."""
    isd = _Isd(path, _load(path))
    return isd.whole("image_lines"), isd.whole("image_samples")


def _load(path):
    try:
        with open(path, "rb") as file:
            data = file.read(SIZE_LIMIT + 1)
        if len(data) > SIZE_LIMIT:
            raise InputError(f"{path} has more than {SIZE_LIMIT} bytes; no ISD has.")
        isd = json.loads(data)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as an ISD (JSON): {error}") from error
    if not isinstance(isd, dict):
        raise InputError(f"{path} is JSON, but not an ISD: it holds no keys.")
    return isd


class _Isd:
    """The JSON of an ISD, asked for values of a kind."""

    def __init__(self, path, values):
        self.path, self.values = path, values

    def part(self, key):
        """A nested object."""
        part = self.values.get(key)
        if not isinstance(part, dict):
            raise InputError(
                f"{self.path}: {key} is missing or no object. Write the ISD again with "
                "isd_generate of ALE 0.8.6 or newer."
            )
        return _Isd(f"{self.path}: {key}", part)

    def array(self, key, *shape):
        """Finite numbers of a shape; None stands for any length."""
        try:
            array = np.array(self.values.get(key), dtype=float)
        except (TypeError, ValueError, OverflowError):
            array = np.full((), np.nan)
        fits = array.ndim == len(shape) and all(
            want is None or size == want for size, want in zip(array.shape, shape, strict=True)
        )
        if not fits or not np.isfinite(array).all():
            sizes = " x ".join("n" if size is None else str(size) for size in shape) or "one"
            raise InputError(
                f"{self.path}: {key} = {str(self.values.get(key))[:60]} is not {sizes} finite "
                f"number{'s' if shape else ''}."
            )
        return array

    def number(self, key):
        return float(self.array(key))

    def whole(self, key):
        number = self.number(key)
        if number != int(number) or number < 1:
            raise InputError(f"{self.path}: {key} = {number} is not a count.")
        return int(number)

    def text(self, key):
        value = self.values.get(key, "")
        return value if isinstance(value, str) else str(value)

    def naif(self, key, count):
        """Numbers of the one instrument in ``naif_keywords``."""
        name = next((name for name in self.values if re.fullmatch(rf"INS-\d+_{key}", name)), key)
        return np.atleast_1d(self.array(name, count) if count > 1 else self.array(name))

    def rotations(self):
        times = self.array("ephemeris_times", None)
        matrices = from_quaternions(self.array("quaternions", times.size, 4), self.path)
        constant = np.eye(3)
        if "constant_rotation" in self.values:
            constant = self.array("constant_rotation", 9).reshape(3, 3)
        return rotations(times, matrices, constant, self.path)

    def positions(self):
        times = self.array("ephemeris_times", None)
        velocities = None
        if self.values.get("velocities") is not None:
            velocities = KM * self.array("velocities", times.size, 3)
        places = KM * self.array("positions", times.size, 3)
        return positions(times, places, velocities, name=self.path)

    def sun(self, body):
        if "sun_position" not in self.values:
            return None
        return trajectory(self.part("sun_position").positions(), body)


def _interior(isd):
    """What both models share: focal length, principal point, distortion, mm to pixels."""
    summing = np.array([isd.number(f"detector_{axis}_summing") for axis in ("line", "sample")])
    start = np.array([isd.number(f"starting_detector_{axis}") for axis in ("line", "sample")])
    centre = np.array([isd.part("detector_center").number(axis) for axis in ("line", "sample")])
    rows = np.array([isd.array(f"focal2pixel_{axis}s", 3) for axis in ("line", "sample")])
    if not (summing > 0).all():
        raise InputError(f"{isd.path}: detector summing = {summing.tolist()} is not positive.")
    focal_length = isd.part("focal_length_model").number("focal_length")
    return {
        "focal_length": focal_length,
        "principal_point": tuple((centre + rows[:, 0] - start) / summing),
        "distortion": _distortion(isd.part("optical_distortion"), focal_length),
        "to_pixels": rows[:, 1:] / summing[:, None],
    }


def _distortion(isd, focal_length):
    key = next(iter(isd.values), None)
    if key not in KEYS:
        raise InputError(
            f"{isd.path}: the distortion model {key} is not supported. Supported are "
            f"{', '.join(KEYS)}."
        )
    model, names, counts = KEYS[key]
    part = isd.part(key)
    coefficients = []
    for name, count in zip(names, counts, strict=True):
        if name.startswith("boresight"):
            coefficients.append(part.number(name))
            continue
        given = part.array(name, None)
        if given.size > count:
            raise InputError(
                f"{part.path}: {name} has {given.size} coefficients; {count} are known."
            )
        coefficients += [*given, *np.zeros(count - given.size)]
    unit = focal_length if model == "radtan" and focal_length > 0 else 1.0
    return Distortion(model, tuple(coefficients), unit)


def _frame(isd, shape):
    body = isd.part("body_rotation").rotations()
    time = isd.number("center_ephemeris_time")
    sun = isd.sun(body)
    rotation = pointing(isd.part("instrument_pointing").rotations(), body).at(time)
    if _is_bare_metric(isd):
        rotation = FLIP @ rotation
        starts = [(0.5 - size / 2, 1.0) for size in shape]
        interior = apollo_metric(isd.part("naif_keywords").naif, *starts)
    else:
        interior = _interior(isd)
    return FrameCamera(
        position=trajectory(isd.part("instrument_position").positions(), body).at(time),
        rotation=rotation,
        shape=shape,
        sun_position=None if sun is None else sun.at(time),
        **interior,
    )


def _is_bare_metric(isd):
    """True for an Apollo Metric ISD of ALE's driver.

    It puts the optical axis on the image's corner, leaves out the distortion and looks away from
    the Moon; its ``naif_keywords`` hold what ISIS goes by.
    """
    radial = isd.part("optical_distortion").values.get("radial")
    return isd.text("name_sensor") == "APOLLO_METRIC" and radial == {"coefficients": [0.0] * 3}


def _line_scan(isd, shape):
    body = isd.part("body_rotation").rotations()
    rates = isd.array("line_scan_rate", None, 3)
    edges = rates - [0.5, 0.0, 0.0]  # from the centre of a line to its edge, as its time is
    edges[:, 1] += isd.number("center_ephemeris_time")
    return LineScanCamera(
        trajectory=trajectory(isd.part("instrument_position").positions(), body),
        pointing=pointing(isd.part("instrument_pointing").rotations(), body),
        line_times=edges,
        shape=shape,
        sun_trajectory=isd.sun(body),
        **_interior(isd),
    )


MODELS = {FRAME: _frame, LINE_SCAN: _line_scan}
