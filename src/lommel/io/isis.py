r"""ISIS cubes, and GeoTIFFs with such a label -> cameras.

Position and pointing come from the tables that spiceinit left in the cube, or, where SPICE kernels
are given, from these (`lommel.io.spice`). Lines of an LRO NAC image were taken at
:math:`t = start + \tau (\alpha - 1/2)`, alpha the line of the full image (`lommel.io.isis_label`),
as in ISIS 9 (``LineScanCameraDetectorMap``); the focal planes are those of `lommel.io.sensors`.
Most callers want `read_isis`.
"""

import struct

import numpy as np

from lommel.errors import InputError
from lommel.io.inertial import pointing, trajectory
from lommel.io.isis_label import read_label
from lommel.io.isis_tables import read_table, table_positions, table_rotations
from lommel.io.sensors import FLIP, apollo_metric, lro_nac, nac_times
from lommel.io.spice import Kernels
from lommel.scene.camera import FrameCamera
from lommel.scene.line_scan import LineScanCamera

POINTING = "Table_InstrumentPointing"  # spiceinit leaves it


def has_camera(path):
    """True when a raster is an image as it was taken, with an ISIS label and spiceinit's tables."""
    label = read_label(path)
    return label is not None and POINTING in label.values and not label.is_projected


def read_isis(path, shape, kernels=None):
    """The camera of an ISIS cube, or of a GeoTIFF that carries an ISIS label.

    Parameters
    ----------
    path : path
    shape : tuple of int
        Lines and samples of the image for which the camera is wanted.
    kernels : path, optional
        SPICE meta-kernel; takes the place of the tables, which may then be absent.

    Returns
    -------
    camera : FrameCamera or LineScanCamera
    """
    label = read_label(path)
    if label is None:
        raise InputError(
            f"{path} carries no ISIS label, so it tells of no camera. Give the camera as ISD "
            "(.json, .isd) or .tsai."
        )
    if tuple(shape) != label.shape:
        raise InputError(
            f"{path}: the camera belongs to an image of {label.shape[0]} x {label.shape[1]} "
            f"pixels, but the image has {shape[0]} x {shape[1]}. Name the camera of this very "
            "image."
        )
    model = MODELS.get(label.instrument)
    if model is None:
        raise InputError(
            f"{path}: images of {label.instrument or 'an unnamed instrument'} "
            f"({label.text('SpacecraftName')}) are not supported; those of "
            f"{', '.join(MODELS)} are. Give the camera as ISD (isd_generate of ALE)."
        )
    if label.is_projected:
        raise InputError(f"{path} is map-projected: it is an orthoimage and has no camera.")
    label.check_size()
    if kernels is None:
        return model(label, _Tables(label))
    with Kernels(kernels, label) as source:
        return model(label, source)


class _Tables:
    """What spiceinit left in a cube; `lommel.io.spice.Kernels` answers the same from kernels."""

    def __init__(self, label):
        self.label = label
        self.naif = label.naif

    def rotations(self, name, times):
        """Rotations from J2000 of InstrumentPointing or BodyRotation, at the table's own times."""
        return table_rotations(read_table(self.label.path, self.label.values, name))

    def positions(self, name, times):
        """Positions of InstrumentPosition or SunPosition; None when a cube has no Sun."""
        if name == "SunPosition" and f"Table_{name}" not in self.label.values:
            return None
        return table_positions(read_table(self.label.path, self.label.values, name))

    def shutter_time(self):
        """Ephemeris time of a frame, s; None: the time of the table."""
        return None

    def clock_time(self, count):
        """Ephemeris time of a count of the spacecraft's clock, s; spiceinit computed it.

        The keyword holds the bytes of a little-endian double.
        """
        name = f"CLOCK_ET_{int(self.label.kernel_code / 1000)}_{count}_COMPUTED"
        text = self.label.naif_text(name)
        try:
            return struct.unpack("<d", bytes.fromhex(text))[0]
        except (ValueError, struct.error) as error:
            raise InputError(
                f"{self.label.path}: NaifKeywords holds no {name}, the time of the clock count, "
                f"as 16 hexadecimal digits, but {text}. Run spiceinit again, or give an ISD."
            ) from error


def _apollo_metric(label, source):
    """Frame camera of Apollo 15, 16 and 17; the film is scanned, its centre is the origin."""
    (line, line_step), (sample, sample_step) = label.alpha("Line"), label.alpha("Sample")
    lines, samples = label.full_shape
    time = source.shutter_time()
    camera = source.rotations("InstrumentPointing", [time])
    time = camera.times.mean() if time is None else time
    body, place, sun = _surroundings(source, [time])
    return FrameCamera(
        position=place.at(time),
        rotation=FLIP @ pointing(camera, body).at(time),
        shape=label.shape,
        sun_position=None if sun is None else sun.at(time),
        **apollo_metric(
            source.naif, (line - lines / 2, line_step), (sample - samples / 2, sample_step)
        ),
    )


def _lro_nac(label, source):
    """Line-scan camera of the Lunar Reconnaissance Orbiter, left or right."""
    preroll = source.clock_time(label.text("SpacecraftClockPrerollCount"))
    start, period = nac_times(source.naif, preroll, label.number("LineExposureDuration") / 1e3)
    first, step = label.alpha("Line")
    start, period = start + period * (first - 0.5), period * step
    times = start + period * np.linspace(0, label.shape[0], _knots(label.shape[0]))
    body, place, sun = _surroundings(source, times)
    return LineScanCamera(
        trajectory=place,
        pointing=pointing(source.rotations("InstrumentPointing", times), body),
        line_times=np.array([[0.0, start, period]]),
        shape=label.shape,
        sun_trajectory=sun,
        **lro_nac(
            source.naif,
            *label.alpha("Sample"),
            label.number("SpatialSumming"),
            label.number("SampleFirstPixel"),
        ),
    )


def _knots(lines):
    """Times of an image at which kernels are asked: every fourth line, 2 to 16 385."""
    return int(np.clip(lines // 4 + 1, 2, 2**14 + 1))


def _surroundings(source, times):
    """The body's rotation, and the trajectories of camera and Sun."""
    body = source.rotations("BodyRotation", times)
    sun = source.positions("SunPosition", times)
    return (
        body,
        trajectory(source.positions("InstrumentPosition", times), body),
        None if sun is None else trajectory(sun, body),
    )


MODELS = {"METRIC": _apollo_metric, "NACL": _lro_nac, "NACR": _lro_nac}
