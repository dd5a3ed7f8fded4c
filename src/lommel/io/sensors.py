r"""Focal planes of single instruments, from the keywords of their SPICE kernels.

``FOCAL_LENGTH``, ``TRANSX``, ``BORESIGHT_SAMPLE`` and the coefficients of the lens come
from the NaifKeywords of a cube, from the ``naif_keywords`` of an ISD, or from the kernels. With an
image's sample s counted from its left edge (CSM), ISIS's detector sample, counted from the
detector's origin, is linear, :math:`d = d_0 + d_1 s`; likewise for lines. The focal plane in mm is

.. math:: x = X_0 + X_1 d_{sample} + X_2 d_{line}, \quad y = Y_0 + Y_1 d_{sample} + Y_2 d_{line}.

The relations are ISIS 9's (``CameraFocalPlaneMap``, ``ApolloMetricCamera``,
``LroNarrowAngleCamera``). Most callers want `apollo_metric` and `lro_nac`.
"""

import numpy as np

from lommel.errors import InputError
from lommel.scene.distortion import Distortion

FLIP = np.diag([1.0, -1.0, -1.0])  # half a turn around x: a focal plane seen from the other side


def apollo_metric(naif, line, sample):
    """Interior of the Metric cameras of Apollo 15, 16 and 17.

    Their film is seen from the other side (lines of sight are (x, y, -f) in ISIS's camera frame),
    so a camera built with this takes `FLIP` times the rotation to that frame.

    Parameters
    ----------
    naif : callable, (key, count) -> array (count,)
        Keywords of the instrument without the part ``INS-915240_``.
    line, sample : tuple of float
        Detector coordinate, from the centre of the scanned film, at image coordinate 0, and
        detector pixels per image pixel.

    Returns
    -------
    interior : dict
        ``focal_length``, ``principal_point``, ``distortion`` and ``to_pixels`` of a `FrameCamera`.
    """
    (x, y), k, (p1, p2, phi) = naif("PP", 2), naif("OD_K", 3), naif("DECENTER", 3)
    lens = Distortion("brown-conrady", (x, -y, *k, p1, p2, np.pi - phi))
    return _interior(naif, naif("TRANSX", 3), -naif("TRANSY", 3), line, sample, lens)


def lro_nac(naif, start_sample, step_sample, summing, first_sample):
    """Interior of LRO's narrow-angle cameras.

    Parameters
    ----------
    naif : callable, (key, count) -> array (count,)
        Keywords of the instrument without the part ``INS-85600_``.
    start_sample, step_sample : float
        Sample of the full image (ISIS's) at the image's left edge, and per pixel of the image.
    summing : float
        Detector pixels per sample of the full image.
    first_sample : float
        Detector pixels before the full image's first, from the label.

    Returns
    -------
    interior : dict
        As of `apollo_metric`, of a `LineScanCamera`.
    """
    boresight_sample, boresight_line = (
        naif(f"BORESIGHT_{axis}", 1)[0] for axis in ("SAMPLE", "LINE")
    )
    first = first_sample + summing / 2 + 0.5
    return _interior(
        naif,
        naif("TRANSX", 3),
        naif("TRANSY", 3),
        (-boresight_line, 1.0),
        ((start_sample - 1) * summing + first - boresight_sample, step_sample * summing),
        Distortion("lrolrocnac", tuple(naif("OD_K", 1))),
    )


def nac_times(naif, preroll, line_seconds):
    """When LRO's narrow-angle cameras began, and how long they took per line.

    Parameters
    ----------
    naif : callable
        As of `lro_nac`.
    preroll : float, s
        Ephemeris time of the clock count at the preroll.
    line_seconds : float
        Exposure of a line as the label has it.

    Returns
    -------
    start, period : float, s
        The centre of line n, counted from 1, was exposed at start + period (n - 1/2).
    """
    factor, term = (naif(f"{kind}_LINE_ERROR", 1)[0] for kind in ("MULTIPLI", "ADDITIVE"))
    period = line_seconds * (1 + factor) + term
    if not period > 0:
        raise InputError(f"a line took {period} s by the image's label; more than 0 is needed.")
    offset, lines = naif("CONSTANT_TIME_OFFSET", 1)[0], naif("ADDITIONAL_PREROLL", 1)[0]
    return preroll + offset + lines * period, period


def _interior(naif, transx, transy, line, sample, distortion):
    to_mm = np.array([transx[1:], transy[1:]])  # columns: sample, line
    with np.errstate(over="ignore"):
        area = abs(np.linalg.det(to_mm))
    if not 0 < area < np.inf or line[1] == 0 or sample[1] == 0:
        raise InputError(
            f"TRANSX = {transx.tolist()} and TRANSY = {transy.tolist()} do not span the focal "
            "plane. Run spiceinit again."
        )
    to_detector = np.linalg.inv(to_mm)
    at_axis = -to_detector @ [transx[0], transy[0]]
    return {
        "focal_length": naif("FOCAL_LENGTH", 1)[0],
        "principal_point": (
            (at_axis[1] - line[0]) / line[1],
            (at_axis[0] - sample[0]) / sample[1],
        ),
        "distortion": distortion,
        "to_pixels": np.array([to_detector[1] / line[1], to_detector[0] / sample[1]]),
    }
