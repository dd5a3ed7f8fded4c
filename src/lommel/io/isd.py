r"""CSM image support data (ISD), the JSON that ALE writes -> frame and line-scan cameras.

Times, J2000 quaternions and positions are tables as in ISIS cubes; the focal plane is given from
mm to detector pixels, so that with CSM's image coordinates

.. math:: line \cdot summing + start = center + t_0 + t_1 x + t_2 y,

t the row ``focal2pixel_lines``, and likewise for samples. A line of a line-scan image has the
detector's line 0 + start, and its centre was exposed at
:math:`t_c + t_i + \tau_i (line - line_i + 1/2)`, one row (line_i, t_i, tau_i) of
``line_scan_rate`` per rate. These relations are usgscsm's (``Utilities.cpp``,
``UsgsAstroLsSensorModel.cpp``); as there, lines of sight are (x, y, f) in the camera frame.
Most callers want `read_isd` and `write_isd`.
"""

import json
import os
from contextlib import suppress
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lommel.errors import InputError
from lommel.io.inertial import KM, pointing, trajectory
from lommel.io.isd_values import load_isd
from lommel.io.sensors import FLIP, apollo_metric
from lommel.scene.body import MOON
from lommel.scene.camera import FrameCamera
from lommel.scene.distortion import Distortion
from lommel.scene.line_scan import LineScanCamera

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
        return "name_model" in load_isd(path).values
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
    isd = load_isd(path)
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
    isd = load_isd(path)
    return isd.whole("image_lines"), isd.whole("image_samples")


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


ISD_SUFFIXES = (".json", ".isd")
MODELS = {FRAME: _frame, LINE_SCAN: _line_scan}


def write_isd(path, camera, body=MOON):
    """Write the ISD of a camera, as ALE lays it out; the file appears whole or not at all.

    Positions and rotations are written in the body's axes, at the times of the camera's own tables,
    with a body rotation that does nothing; `read_isd` gives the same projections back. usgscsm
    takes tables for evenly spaced, which those of an ISIS cube are not.

    Parameters
    ----------
    path : path
    camera : FrameCamera or LineScanCamera
    body : Body
    """
    path = Path(path)
    if isinstance(camera, FrameCamera):
        parts = _frame_parts(camera)
    elif isinstance(camera, LineScanCamera):
        parts = _line_scan_parts(camera)
    else:
        raise InputError(
            f"{path}: a {type(camera).__name__} has no ISD. Write the camera of the image as it "
            "was taken."
        )
    radius = body.radius / KM
    focal_length, to_pixels, distortion = _written_plane(path, camera)
    isd = {
        "isis_camera_version": 2,
        "image_lines": camera.shape[0],
        "image_samples": camera.shape[1],
        "name_platform": "unknown",
        "name_sensor": "unknown",
        "reference_height": {"maxheight": 1000, "minheight": -1000, "unit": "m"},
        "radii": {"semimajor": radius, "semiminor": radius, "unit": "km"},
        **parts,
        "naif_keywords": {},
        "detector_sample_summing": 1,
        "detector_line_summing": 1,
        "focal_length_model": {"focal_length": focal_length},
        "detector_center": {
            "line": float(camera.principal_point[0]),
            "sample": float(camera.principal_point[1]),
        },
        "focal2pixel_lines": [0.0, *to_pixels[0].tolist()],
        "focal2pixel_samples": [0.0, *to_pixels[1].tolist()],
        "optical_distortion": distortion,
        "starting_detector_line": 0,
        "starting_detector_sample": 0,
    }
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_text(json.dumps(isd, indent=1, allow_nan=False), encoding="utf-8")
        os.replace(partial, path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error}") from error
    finally:
        with suppress(OSError):
            partial.unlink()


def _frame_parts(camera):
    sun = camera.sun_position
    return {
        "name_model": FRAME,
        "center_ephemeris_time": 0.0,
        "body_rotation": _rotation_table([0.0], np.eye(3)[None]),
        "instrument_pointing": _rotation_table([0.0], camera.rotation[None]),
        "instrument_position": _position_table([0.0], camera.position[None], np.zeros((1, 3))),
    } | ({} if sun is None else {"sun_position": _position_table([0.0], sun[None])})


def _line_scan_parts(camera):
    start, end = camera.time([0.0, camera.shape[0]])
    middle = float((start + end) / 2)
    place, sun = camera.trajectory, camera.sun_trajectory
    rates = camera.line_times + [0.5, -middle, 0.0]
    parts = {
        "name_model": LINE_SCAN,
        "interpolation_method": "lagrange",
        "line_scan_rate": rates.tolist(),
        "starting_ephemeris_time": float(start),
        "center_ephemeris_time": middle,
        "body_rotation": _rotation_table([middle], np.eye(3)[None]),
        "instrument_pointing": _rotation_table(camera.pointing.times, camera.pointing.rotations),
        "instrument_position": _position_table(place.times, place.positions, place.velocities),
    }
    if sun is not None:
        parts["sun_position"] = _position_table(sun.times, sun.positions, sun.velocities)
    return parts


def _rotation_table(times, matrices):
    return {
        **_cover("ck", times),
        "quaternions": np.roll(Rotation.from_matrix(matrices).as_quat(), 1, axis=1).tolist(),
        "constant_rotation": np.eye(3).ravel().tolist(),
        "reference_frame": 1,
    }


def _position_table(times, places, velocities=None):
    table = {**_cover("spk", times), "positions": (places / KM).tolist(), "reference_frame": 1}
    return table if velocities is None else table | {"velocities": (velocities / KM).tolist()}


def _cover(kind, times):
    times = np.asarray(times, float).tolist()
    return {
        f"{kind}_table_start_time": times[0],
        f"{kind}_table_end_time": times[-1],
        f"{kind}_table_original_size": len(times),
        "ephemeris_times": times,
    }


def _written_plane(path, camera):
    """Focal length, matrix to pixels and distortion, in the unit of the distortion's model."""
    focal_length, to_pixels = float(camera.focal_length), np.array(camera.to_pixels, float)
    lens = camera.distortion
    if lens is None or lens.model == "none":
        return focal_length, to_pixels, {"radial": {"coefficients": [0.0, 0.0, 0.0]}}
    if lens.model == "radtan":  # counts in focal lengths, whatever the plane's unit
        if not np.isclose(lens.unit, focal_length, rtol=1e-12):
            raise InputError(f"{path}: an ISD has radtan coefficients in focal lengths only.")
    else:
        focal_length, to_pixels = focal_length / lens.unit, to_pixels * lens.unit
    _, names, counts = KEYS[lens.model]
    rest, part = list(lens.coefficients), {}
    for name, count in zip(names, counts, strict=True):
        part[name] = rest[0] if name.startswith("boresight") else rest[:count]
        rest = rest[count:]
    return focal_length, to_pixels, {lens.model: part}
