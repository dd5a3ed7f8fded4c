r"""Which pixels of an image count, and how much: shadow, saturation, oblique views, feathering.

The mask is the S of the albedo paper, the feathering its w. Most callers want `pixel_weights`.
"""

from dataclasses import dataclass

import numpy as np

MARGIN = 1  # pixels beside unusable ones that are left out
CLIPPED = 0.98  # of the saturation value; interpolation lowers clipped pixels by this much
HISTOGRAM_BINS = 40  # from black to the brightness of lit ground
VALLEY_LIMIT = 0.35  # of the lit brightness: shadow ends below it, even on ground facing away
LEAST_SHADOW = 3e-4  # share of the pixels that the peak of a shadow's histogram must hold
DARK_IMAGE = 0.25  # of the median image: an image darker than that is judged by the others' level


@dataclass(frozen=True)
class MaskSettings:
    """What counts as usable.

    Attributes
    ----------
    shadow_threshold : float, image units, or None
        Image value up to which a pixel counts as shadow; None finds it for each image.
    max_incidence, max_emission : float, rad
        Angles between the local normal and Sun or camera, from which pixels are left out.
    """

    shadow_threshold: float | None = None
    max_incidence: float = np.radians(86.0)
    max_emission: float = np.radians(70.0)


def widened(mask, steps=1):
    """A mask grown by its four neighbours, so many times.

    Parameters
    ----------
    mask : bool array (rows, cols)
    steps : int

    Returns
    -------
    mask : bool array (rows, cols)

    Examples
    --------
    >>> widened(np.eye(3, dtype=bool))[0].tolist()
    [True, True, False]
    """
    for _ in range(steps):
        mask, last = mask.copy(), mask
        mask[1:] |= last[:-1]
        mask[:-1] |= last[1:]
        mask[:, 1:] |= last[:, :-1]
        mask[:, :-1] |= last[:, 1:]
    return mask


def lit_brightness(measured):
    """Upper quartile of an image's positive values: lit ground, even in an image half in shadow.

    Parameters
    ----------
    measured : array, image units; NaN where missing

    Returns
    -------
    brightness : float, image units; 0 when nothing is positive
    """
    positive = measured[measured > 0]
    return float(np.percentile(positive, 75)) if positive.size else 0.0


def shadow_threshold(measured, lit=None):
    """Image value that parts shadow from lit ground: the valley in the histogram's dark end.

    The valley is searched between black and 0.35 of the lit brightness, in a histogram smoothed
    over three of its forty bins. An image without a dark peak, half as low behind it, has no
    shadow and loses nothing.

    Parameters
    ----------
    measured : array, image units; NaN where missing
    lit : float, image units, optional
        Brightness of lit ground; `lit_brightness` by default.

    Returns
    -------
    threshold : float, image units; 0 without shadow

    Examples
    --------
    >>> image = np.concatenate([np.full(300, 3.0), np.linspace(60.0, 140.0, 700)])
    >>> 3.0 < shadow_threshold(image) < 60.0
    True
    """
    lit = lit_brightness(measured) if lit is None else lit
    if lit <= 0:
        return 0.0
    edges = np.linspace(0.0, VALLEY_LIMIT * lit, HISTOGRAM_BINS + 1)
    counts = np.histogram(measured[measured <= edges[-1]], edges)[0].astype(float)
    smooth = np.convolve(np.pad(counts, 1, mode="edge"), np.ones(3) / 3, mode="valid")
    highest_so_far = np.maximum.accumulate(smooth)
    drop = np.where(highest_so_far > LEAST_SHADOW * measured.size, highest_so_far - smooth, 0.0)
    if not (drop > 0.5 * highest_so_far).any():
        return 0.0
    lowest = np.flatnonzero(drop == drop.max())
    middle = int(lowest[len(lowest) // 2])
    return float((edges[middle] + edges[middle + 1]) / 2)


def shadow_thresholds(images, settings):
    """Shadow threshold of every image: as set, or found by `shadow_threshold`.

    An image much darker than the others holds no lit ground to compare with: its lit brightness
    is taken from the others, so that an image all in shadow is recognised.

    Parameters
    ----------
    images : list of array, image units
    settings : MaskSettings

    Returns
    -------
    thresholds : float64 array (images,), image units
    """
    if settings.shadow_threshold is not None:
        return np.full(len(images), float(settings.shadow_threshold))
    lit = np.array([lit_brightness(image) for image in images])
    least = least_lit(lit)
    return np.array(
        [shadow_threshold(image, max(own, least)) for image, own in zip(images, lit, strict=True)]
    )


def least_lit(lit):
    """Least brightness of lit ground in any of many images, from that of each; 0 without images.

    Parameters
    ----------
    lit : sequence of float, image units

    Returns
    -------
    least : float, image units
    """
    return DARK_IMAGE * float(np.median(lit)) if len(lit) else 0.0


def feathering(shape, valid=None):
    r"""Weights that fall linearly from 1 at the image's centre to 0 at its border.

    .. math:: w = \min(1 - |x|, 1 - |y|), \quad x, y \in (-1, 1)

    Parameters
    ----------
    shape : tuple of int
        Rows and columns.
    valid : bool array (rows, cols), optional
        The image is taken to end with the rows and columns that hold a valid pixel.

    Returns
    -------
    weights : float32 array (rows, cols)

    Examples
    --------
    >>> [round(float(weight), 1) for weight in feathering((1, 5))[0]]
    [0.2, 0.6, 1.0, 0.6, 0.2]
    """
    along = []
    for axis in (0, 1):
        is_known = np.ones(shape[axis], bool) if valid is None else valid.any(axis=1 - axis)
        along.append(falling(np.arange(shape[axis]), *known_span(is_known)))
    return np.minimum(along[0][:, None], along[1][None, :]).astype(np.float32)


def known_span(is_known):
    """First known place along one side of an image, and how far it is to behind the last one.

    Parameters
    ----------
    is_known : bool array (n,)

    Returns
    -------
    first, size : int
        All of the side where nothing is known.
    """
    known = np.flatnonzero(is_known)
    return (int(known[0]), int(known[-1] - known[0] + 1)) if known.size else (0, len(is_known))


def falling(places, first, size):
    """Weights along one side that fall from 1 in the middle to 0 at both ends.

    Parameters
    ----------
    places : int array (n,), pixels
    first, size : int, pixels
        Where the side begins, and its length.

    Returns
    -------
    weights : float64 array (n,)
    """
    centred = (2.0 * (places - first) + 1.0) / size - 1.0
    return np.clip(1.0 - np.abs(centred), 0.0, 1.0)


def pixel_weights(measured, cos_incidence, cos_emission, threshold, saturation, settings):
    """Mask times feathering: S w of the albedo paper.

    Parameters
    ----------
    measured : float32 array (rows, cols), image units; NaN where missing
    cos_incidence, cos_emission : array (rows, cols), dimensionless; NaN where unknown
    threshold : float, image units
        Shadow up to here.
    saturation : float, image units
        Clipped from here on; infinity when the format does not clip.
    settings : MaskSettings

    Returns
    -------
    weights : float32 array (rows, cols), 0 where the pixel is not used
    """
    has_value = np.isfinite(measured)
    usable = has_value & (measured > threshold) & (measured < CLIPPED * saturation)
    # pixels beside shadow, clipping or no data hold part of it
    usable = ~widened(~usable, MARGIN)
    usable &= cos_incidence > np.cos(settings.max_incidence)
    usable &= cos_emission > np.cos(settings.max_emission)
    return np.where(usable, feathering(measured.shape, has_value), np.float32(0.0))
