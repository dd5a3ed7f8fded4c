r"""ISIS cubes with spiceinit's tables, and GeoTIFFs with such a label -> cameras.

A cube that was cropped or reduced says so in the group ``AlphaCube``: with sample s counted from
the image's left edge (CSM), the sample of the full image, counted as ISIS does from 1 at the first
centre, is

.. math:: \alpha = start + s \, (end - start) / samples.

From there on the instruments differ, see `lommel.io.sensors`. Lines of a NAC image were taken at
:math:`t = start + \tau (\alpha - 1/2)`. Those are ISIS 9's own relations (``AlphaCube``,
``LineScanCameraDetectorMap``). Most callers want `read_isis`.
"""

import struct
from dataclasses import dataclass

import numpy as np

from lommel.errors import InputError
from lommel.io.inertial import pointing, trajectory
from lommel.io.isis_tables import numbers, read_table, table_positions, table_rotations
from lommel.io.raster import raster_info, read_isis_label
from lommel.io.sensors import FLIP, apollo_metric, lro_nac, nac_times
from lommel.scene.camera import FrameCamera
from lommel.scene.line_scan import LineScanCamera

POINTING = "Table_InstrumentPointing"  # spiceinit leaves it


def has_camera(path):
    """True when a raster is an image as it was taken, with an ISIS label and spiceinit's tables."""
    label = read_isis_label(path)
    return label is not None and POINTING in label and not _is_projected(path, label)


def _is_projected(path, label):
    return "Mapping" in label.get("IsisCube", {}) or raster_info(path).grid is not None


def read_isis(path, shape):
    """The camera of an ISIS cube, or of a GeoTIFF that carries an ISIS label.

    Parameters
    ----------
    path : path
    shape : tuple of int
        Lines and samples of the image for which the camera is wanted.

    Returns
    -------
    camera : FrameCamera or LineScanCamera
    """
    label = read_isis_label(path)
    if label is None:
        raise InputError(
            f"{path} carries no ISIS label, so it tells of no camera. Give the camera as ISD "
            "(.json, .isd) or .tsai."
        )
    found = raster_info(path).shape
    if tuple(shape) != found:
        raise InputError(
            f"{path}: the camera belongs to an image of {found[0]} x {found[1]} pixels, but the "
            f"image has {shape[0]} x {shape[1]}. Name the camera of this very image."
        )
    cube = _Cube(path, label, found)
    model = MODELS.get(cube.instrument)
    if model is None:
        raise InputError(
            f"{path}: images of {cube.instrument or 'an unnamed instrument'} "
            f"({cube.text('SpacecraftName')}) are not supported; those of "
            f"{', '.join(MODELS)} are. Give the camera as ISD (isd_generate of ALE)."
        )
    if _is_projected(path, label):
        raise InputError(f"{path} is map-projected: it is an orthoimage and has no camera.")
    _check_size(cube)
    return model(cube)


def _check_size(cube):
    """Refuse a label that was carried over to an image of another size."""
    core = cube.group("Core").get("Dimensions", {})
    said = tuple(numbers(core, key, 1, f"{cube.path}: Core")[0] for key in ("Lines", "Samples"))
    if said != cube.shape:
        raise InputError(
            f"{cube.path}: the ISIS label speaks of {said[0]:g} x {said[1]:g} pixels, the image "
            f"has {cube.shape[0]} x {cube.shape[1]}. It was cut or resampled by a program that "
            "leaves the label as it was; do that with ISIS's crop or reduce."
        )


@dataclass(frozen=True)
class _Cube:
    """A label with what every camera asks of it."""

    path: object
    label: dict
    shape: tuple[int, int]

    @property
    def instrument(self):
        return self.text("InstrumentId").upper()

    def group(self, name):
        """A group of the object IsisCube."""
        cube = self.label.get("IsisCube")
        group = cube.get(name) if isinstance(cube, dict) else None
        return group if isinstance(group, dict) else {}

    def text(self, key):
        value = self.group("Instrument").get(key, "")
        return value if isinstance(value, str) else str(value)

    def naif(self, key, count):
        """Numbers from NaifKeywords for this instrument."""
        keywords = self.label.get("NaifKeywords")
        keywords = keywords if isinstance(keywords, dict) else {}
        name = f"INS{int(self.kernel_code)}_{key}"
        return numbers(keywords, name, count, f"{self.path}: NaifKeywords")

    @property
    def kernel_code(self):
        return numbers(self.group("Kernels"), "NaifFrameCode", 1, f"{self.path}: Kernels")[0]

    def instrument_number(self, key):
        return numbers(self.group("Instrument"), key, 1, f"{self.path}: Instrument")[0]

    @property
    def full_shape(self):
        """Lines and samples of the image before it was cut or reduced."""
        alpha = self.group("AlphaCube")
        if not alpha:
            return self.shape
        return tuple(self._alpha(f"Alpha{axis}s") for axis in ("Line", "Sample"))

    def alpha(self, axis):
        """Start and step: sample or line of the full image, ISIS's, from this image's, CSM's."""
        alpha = self.group("AlphaCube")
        if not alpha:
            return 0.5, 1.0
        start, end = (self._alpha(f"Alpha{edge}{axis}") for edge in ("Starting", "Ending"))
        count = self._alpha(f"Beta{axis}s")
        size = self.shape[0 if axis == "Line" else 1]
        if count != size or not end > start:
            raise InputError(
                f"{self.path}: AlphaCube speaks of {count:g} {axis.lower()}s from {start:g} to "
                f"{end:g}, the image has {size}. The label is damaged, or the image was cut by a "
                "program that does not know it; cut it with ISIS's crop or reduce."
            )
        return start, (end - start) / size

    def _alpha(self, key):
        return numbers(self.group("AlphaCube"), key, 1, f"{self.path}: AlphaCube")[0]

    def rotations(self, name):
        return table_rotations(read_table(self.path, self.label, name))

    def positions(self, name):
        return table_positions(read_table(self.path, self.label, name))

    def sun(self, body):
        """The Sun's trajectory, or None when spiceinit left none."""
        has_sun = "Table_SunPosition" in self.label
        return trajectory(self.positions("SunPosition"), body) if has_sun else None


def _apollo_metric(cube):
    """Frame camera of Apollo 15, 16 and 17; the film is scanned, its centre is the origin."""
    axes = zip(("Line", "Sample"), cube.full_shape, strict=True)
    starts = [(start - size / 2, step) for axis, size in axes for start, step in [cube.alpha(axis)]]
    body = cube.rotations("BodyRotation")
    camera = cube.rotations("InstrumentPointing")
    sun = cube.sun(body)
    time = camera.times.mean()
    return FrameCamera(
        position=trajectory(cube.positions("InstrumentPosition"), body).at(time),
        rotation=FLIP @ pointing(camera, body).at(time),
        shape=cube.shape,
        sun_position=None if sun is None else sun.at(time),
        **apollo_metric(cube.naif, *starts),
    )


def _lro_nac(cube):
    """Line-scan camera of the Lunar Reconnaissance Orbiter, left or right."""
    start, period = nac_times(
        cube.naif, _preroll_time(cube), cube.instrument_number("LineExposureDuration") / 1e3
    )
    first, step = cube.alpha("Line")
    body = cube.rotations("BodyRotation")
    return LineScanCamera(
        trajectory=trajectory(cube.positions("InstrumentPosition"), body),
        pointing=pointing(cube.rotations("InstrumentPointing"), body),
        line_times=np.array([[0.0, start + period * (first - 0.5), period * step]]),
        shape=cube.shape,
        sun_trajectory=cube.sun(body),
        **lro_nac(
            cube.naif,
            *cube.alpha("Sample"),
            cube.instrument_number("SpatialSumming"),
            cube.instrument_number("SampleFirstPixel"),
        ),
    )


def _preroll_time(cube):
    """Ephemeris time of the clock count at the preroll, s; spiceinit computed it.

    The keyword holds the bytes of a little-endian double. Its name contains a slash, at which
    GDAL nests it.
    """
    count = cube.text("SpacecraftClockPrerollCount")
    name = f"CLOCK_ET_{int(cube.kernel_code / 1000)}_{count}_COMPUTED"
    value = cube.label.get("NaifKeywords", {})
    for part in [name] if name in value else name.split("/"):
        value = value.get(part) if isinstance(value, dict) else None
    try:
        return struct.unpack("<d", bytes.fromhex(str(value)))[0]
    except (ValueError, struct.error) as error:
        raise InputError(
            f"{cube.path}: NaifKeywords holds no {name}, the time of the clock count, as 16 "
            f"hexadecimal digits, but {value}. Run spiceinit again, or give an ISD."
        ) from error


MODELS = {"METRIC": _apollo_metric, "NACL": _lro_nac, "NACR": _lro_nac}
