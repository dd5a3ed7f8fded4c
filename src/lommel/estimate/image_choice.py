r"""Which few of many images tell the slopes of a place: a greedy D-optimal design.

Brightness depends on the two slopes of the ground and on its albedo. An image with the gradient
:math:`g = \partial \ln I / \partial (p, q, \ln A)` and the relative noise `s` tells

.. math:: F = \frac{a}{s^2}\, g g^T

of them per post, `a` being the pixels per post. What a set of images tells of the slopes alone is
the Schur complement of the albedo in the sum of their `F` and of what is expected beforehand,

.. math:: L = \begin{pmatrix} L_{ss} & l \\ l^T & L_{aa} \end{pmatrix}, \qquad
          S = L_{ss} - l\, l^T / L_{aa},

and the expected standard error of a slope is :math:`\sqrt{\mathrm{tr}\, S^{-1} / 2}`. Images are
taken in turn, the one first that raises :math:`\ln \det S` most, summed over the places where it
still lowers the standard error noticeably (Fedorov 1972, Theory of Optimal Experiments). Most
callers want `information` and `choose_images`.
"""

from dataclasses import dataclass

import numpy as np

# Noise of an image relative to its brightness, the same for all, since pixels are not looked at:
# what film and detectors have (0.5 to 1 %), and what no averaging of pixels undercuts
PIXEL_NOISE, LEAST_NOISE = 0.0075, 1e-3
# rms, of slope: what one image tells at best. Relief within a post and errors of reflectance and
# place grow as brightness does with slope; else the lowest Suns would seem best by far
SLOPE_LIMIT = 0.005
SLOPE_ERROR = 0.1  # rms, of slopes that the initial DEM does not show
ALBEDO_ERROR = 0.3  # of a place's albedo about 1, rms: mare against highland
LEAST_GAIN = 0.05  # of the standard error, mean of what an image shows: an image costs as much time
LARGE_GAIN = 0.25  # of the standard error of one place, which alone is worth an image
NODES = np.array([-(3.0**0.5), 0.0, 3.0**0.5])  # of Gauss and Hermite's rule, in standard errors
SHARES = np.array([1.0, 4.0, 1.0]) / 6.0
ALBEDO_KNOWN = 1e12  # information that leaves nothing open
PAIRS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))  # of slope east, slope north, ln albedo


@dataclass(frozen=True)
class Sights:
    """Which image tells what of which place.

    Attributes
    ----------
    image, place : int array (sights,)
    information : float array (sights, 6), per post
        Of slope east, slope north and ln albedo, as `PAIRS` orders them.
    """

    image: np.ndarray
    place: np.ndarray
    information: np.ndarray


def information(model, slopes, to_sun, to_camera, pixels_per_post):
    """What one image tells of slopes and albedo at some posts.

    Slopes that the DEM does not show are averaged over, so that a low Sun, which leaves slopes
    in shadow, tells less.

    Parameters
    ----------
    model : ReflectanceModel
    slopes : array (posts, 2), dimensionless
        Of the DEM, east and north.
    to_sun, to_camera : array (posts, 3)
        Unit vectors east, north, up.
    pixels_per_post : float

    Returns
    -------
    information : array (posts, 6), per post
        0 where the ground is turned away from Sun or camera.
    """
    tilt = SLOPE_ERROR * np.stack(np.meshgrid(NODES, NODES, indexing="ij"), axis=-1).reshape(-1, 2)
    share = np.outer(SHARES, SHARES).ravel()[:, None]
    p, q = np.moveaxis(slopes + tilt[:, None], -1, 0)
    length = np.sqrt(1 + p * p + q * q)
    cosines = [(up - p * east - q * north) / length for east, north, up in (to_sun.T, to_camera.T)]
    phase = np.arccos(np.clip((to_sun * to_camera).sum(axis=-1), -1, 1))
    value, *by_cosine = model.with_derivatives(*cosines, np.broadcast_to(phase, p.shape))
    along = [
        sum(
            -by * (direction[:, axis] + cosine * slope / length) / length
            for by, direction, cosine in zip(by_cosine, (to_sun, to_camera), cosines, strict=True)
        )
        for axis, slope in enumerate((p, q))
    ]
    gradient = [*along, value]
    mean = (share * value).sum(axis=0)
    steepness = (share * (gradient[0] ** 2 + gradient[1] ** 2)).sum(axis=0)
    pixel = np.hypot(PIXEL_NOISE / pixels_per_post**0.5, LEAST_NOISE) * mean
    variance = pixel**2 + SLOPE_LIMIT**2 * steepness
    weight = np.where(mean > 0, 1 / np.where(mean > 0, variance, 1.0), 0.0)
    products = [(share * gradient[i] * gradient[j]).sum(axis=0) for i, j in PAIRS]
    return weight[:, None] * np.stack(products, axis=-1)


def choose_images(sights, images, places, knows_albedo=False):
    """The best few images of each place.

    An image is taken while it lowers the standard error by `LEAST_GAIN` in the mean of what it
    shows, or by `LARGE_GAIN` somewhere.

    Parameters
    ----------
    sights : Sights
    images, places : int
    knows_albedo : bool
        The albedo is given.

    Returns
    -------
    is_chosen : bool array (sights,)
    gains : float array (images,), dimensionless
        Share of the standard error of slopes by which an image that was not chosen would still
        lower it, mean of the places it shows.
    """
    known = np.zeros((places, 6))
    known[:, [0, 2]] = SLOPE_ERROR**-2.0
    known[:, 5] = ALBEDO_KNOWN if knows_albedo else ALBEDO_ERROR**-2.0
    by_place = np.argsort(sights.place, kind="stable")
    ends = np.searchsorted(sights.place[by_place], np.arange(places + 1))
    shown = np.maximum(np.bincount(sights.image, minlength=images), 1)
    is_chosen, is_taken = np.zeros(len(sights.image), bool), np.zeros(images, bool)
    gains, worth = np.zeros((2, len(sights.image)))
    stale = np.arange(len(sights.image))
    while True:
        before = known[sights.place[stale]]
        determinant, error = told(before)
        determinant_with, error_with = told(before + sights.information[stale])
        gains[stale] = 1 - error_with / error
        worth[stale] = np.log(determinant_with / determinant)
        mean = np.bincount(sights.image, gains, images) / shown
        is_large = np.bincount(sights.image[gains >= LARGE_GAIN], minlength=images) > 0
        is_worth = ((mean >= LEAST_GAIN) | is_large) & ~is_taken
        if not is_worth.any():
            return is_chosen, np.where(is_taken, 0.0, mean)
        total = np.bincount(sights.image, np.where(gains >= LEAST_GAIN, worth, 0.0), images)
        best = int(np.argmax(np.where(is_worth, total, -1.0)))
        taken = np.flatnonzero((sights.image == best) & (gains >= LEAST_GAIN))
        is_taken[best] = is_chosen[taken] = True
        changed = sights.place[taken]
        known[changed] += sights.information[taken]
        stale = np.concatenate([by_place[ends[k] : ends[k + 1]] for k in changed])


def told(known):
    """Determinant of the slopes' information without albedo, and the standard error of a slope."""
    pp, pq, qq, pa, qa, aa = known.T
    east, north, both = pp - pa * pa / aa, qq - qa * qa / aa, pq - pa * qa / aa
    determinant = east * north - both**2
    return determinant, np.sqrt((east + north) / determinant / 2)
