r"""Lens distortion: between where light would fall on an ideal focal plane and where it falls.

Focal-plane coordinates (x, y) count from the optical axis, in the unit the model was fitted in:
millimetres, or focal lengths. `undistort` takes a place on the detector to the ideal
place, `distort` goes back. One direction is the model's closed form, the other is Newton's
method on it. With :math:`r^2 = x^2 + y^2`:

``radial`` k0 k1 k2, undistorts. ISIS's ``OD_K`` and the ISD's ``radial``:

.. math:: x_u = x (1 - k_0 - k_1 r^2 - k_2 r^4), \quad y_u = y (1 - \ldots)

``brown-conrady`` xp yp k1 k2 k3 p1 p2 phi, undistorts. Apollo's Metric cameras in ISIS (``PP``,
``OD_K``, ``DECENTER``) and ``BROWN_CONRADY`` in ``.tsai`` files; (x, y) from (xp, yp):

.. math:: x_u = x (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) - t \sin\varphi, \quad
          y_u = y (1 + \ldots) + t \cos\varphi, \quad t = p_1 r^2 + p_2 r^4

``radtan`` k1 k2 p1 p2 k3, distorts. OpenCV, the ISD's ``radtan``, and with k3 = 0 ``TSAI`` in
``.tsai`` files; all of them in focal lengths, so `unit` is the focal length:

.. math:: x_d = x (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + 2 p_1 x y + p_2 (r^2 + 2 x^2), \quad
          y_d = y (1 + \ldots) + 2 p_2 x y + p_1 (r^2 + 2 y^2)

``transverse`` x: 10, y: 10 coefficients, distorts: cubic polynomials with the terms 1, x, y, x²,
xy, y², x³, x²y, xy², y³.

``kaguyalism`` boresight_x x0 x1 x2 x3 boresight_y y0 y1 y2 y3, undistorts:

.. math:: x_u = x + b_x + x_0 + x_1 r + x_2 r^2 + x_3 r^3, \quad y_u = y + b_y + y_0 + \ldots

``lrolrocnac`` k, undistorts: along the detector's line only, which is y,

.. math:: x_u = x, \quad y_u = y / (1 + k y^2).

A camera whose focal plane is seen from the other side (Apollo's Metric cameras in ISIS: the look
vector is (x_u, y_u, -f)) is brought to z into the scene by turning it half round x; y changes its
sign, hence in ``brown-conrady`` yp becomes -yp and phi becomes pi - phi.

The closed forms are those of ISIS 9 (``CameraDistortionMap``, ``ApolloMetricDistortionMap``,
``LroNarrowAngleDistortionMap``), usgscsm (``Distortion.cpp``) and the Vision Workbench
(``LensDistortion.cc``). Most callers want `Distortion`.
"""

from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np

from lommel.errors import InputError
from lommel.scene import distortion_kernels as kernels

MODELS = {  # name: number in the kernels, count of coefficients, closed form undistorts
    "none": (kernels.NONE, 0, False),
    "radial": (kernels.RADIAL, 3, True),
    "brown-conrady": (kernels.BROWN_CONRADY, 8, True),
    "radtan": (kernels.RADTAN, 5, False),
    "transverse": (kernels.TRANSVERSE, 20, False),
    "kaguyalism": (kernels.KAGUYA, 10, True),
    "lrolrocnac": (kernels.LRO_NAC, 1, True),
}

# where a model may fold over, in its unit: a focal plane is some 1e2 mm or 1e0 focal lengths wide
RADII = np.concatenate([[0.0], np.geomspace(1e-3, 1e4, 1401)])  # steps of 1.2 %
AZIMUTHS = 32


class Lens(NamedTuple):
    """A distortion as the compiled kernels take it."""

    kind: int
    coefficients: np.ndarray
    unit: float
    reach: float  # model units; the closed form is one to one within this distance of the axis
    removes: bool  # the closed form undistorts


@dataclass(frozen=True)
class Distortion:
    """Lens distortion; the module says what the models and their coefficients mean.

    Attributes
    ----------
    model : str
        One of `MODELS`.
    coefficients : tuple of float
    unit : float
        Length of the model's unit in the unit of the focal plane: 1 when both are millimetres; the
        focal length for ``radtan``; the pixels per millimetre for a model in millimetres on a focal
        plane in pixels.
    """

    model: str
    coefficients: tuple[float, ...] = ()
    unit: float = 1.0
    lens: Lens = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        """Check the coefficients and find the reach of the closed form."""
        if self.model not in MODELS:
            raise InputError(
                f"distortion model {self.model} is not known. Give one of {', '.join(MODELS)}."
            )
        kind, count, removes = MODELS[self.model]
        coefficients = np.array(self.coefficients, dtype=float)
        if coefficients.shape != (count,) or not np.isfinite(coefficients).all():
            raise InputError(
                f"distortion {self.model} has the coefficients {self.coefficients}; it needs "
                f"{count} finite numbers. Check the camera file."
            )
        if not 0 < self.unit < np.inf:
            raise InputError(f"unit = {self.unit} of the distortion is not positive and finite.")
        reach = kernels.reach(kind, coefficients, RADII, AZIMUTHS)
        if not reach > 0:
            raise InputError(
                f"distortion {self.model} with the coefficients {self.coefficients} cannot be "
                "inverted even at the optical axis. Check the camera file."
            )
        object.__setattr__(self, "lens", Lens(kind, coefficients, float(self.unit), reach, removes))

    def distort(self, x, y):
        """Distorted coordinates of undistorted ones.

        Parameters
        ----------
        x, y : array (...), the focal plane's unit

        Returns
        -------
        x, y : array (...)
            NaN where the model folds over and has no inverse.
        """
        return self._apply(kernels.distort_all, x, y)

    def undistort(self, x, y):
        """Undistorted coordinates of distorted ones; the inverse of `distort`."""
        return self._apply(kernels.undistort_all, x, y)

    def _apply(self, kernel, x, y):
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        out = np.empty((2, x.size))
        kernel(self.lens, np.ascontiguousarray(x).ravel(), np.ascontiguousarray(y).ravel(), *out)
        return tuple(out.reshape(2, *x.shape))


@cache
def undistorted():
    """The lens of a pinhole camera."""
    return Distortion("none")
