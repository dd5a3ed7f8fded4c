"""Names and numbers as people read them.

The end of a result's name is its unit; `MEANINGS` says what the less obvious ones are.
Most callers want `quantities_of`.
"""

import re
from dataclasses import dataclass

UNITS = {
    "m": "m",
    "deg": "°",
    "percent": "%",
    "px": "px",
    "km": "km",
    "s": "s",
    "mb": "MB",
}
CAPITALS = {"rmse": "RMSE", "mae": "MAE", "nmad": "NMAD", "dem": "DEM", "gsd": "GSD"}
MEANINGS = {  # by name without its unit
    "exposure_rms": "error of the exposures against the truth, common scale removed",
    "albedo_rms": "error of the albedo against the truth, common scale removed",
    "height_rmse": "error of the heights against the truth",
    "slope_rmse": "error of the slope angle against the truth",
    "height_rmse_share": "height error after refinement, by that of the initial terrain",
    "disagreement": "spread (NMAD) of images that see the same point",
    "albedo_error": "median standard error of a pixel of the albedo",
    "brightness_ramp": "trend of the albedo from one end of the strip to the other",
    "shading_correlation": "likeness of albedo detail and slope towards the Sun; 0 is none",
    "noise": "spread of the image values about the model",
    "pixels_per_independent_residual": "how many neighbouring pixels err together",
    "image_correlation": "likeness of measured and modelled image; 1 is perfect",
    "image_correlation_without_albedo": "the same, with relief alone to explain the image",
    "image_residual": "rms of modelled minus measured, by the median image value",
    "height_change_rms": "refined minus initial terrain",
    "terrain_roughness": "expected change of slope from post to post, from the data",
    "albedo_contrast": "expected contrast of the albedo, from the data",
}
RESULT_DIGITS, SETTING_DIGITS = 3, 6


@dataclass(frozen=True)
class Quantity:
    """A result as people read it.

    Attributes
    ----------
    words, value, unit, meaning : str
        The meaning is empty where the words say it all.
    target : str
        What the value should reach, such as ``at most 3``; empty where nothing was asked.
    is_missed : bool
        True when the target was not reached.
    """

    words: str
    value: str
    unit: str
    meaning: str = ""
    target: str = ""
    is_missed: bool = False


def quantities_of(results, targets):
    """Results in words: what changed first, then what has a unit, then the rest.

    A pair ``..._before`` and ``..._after`` becomes one line.

    Parameters
    ----------
    results : dict of str to number
    targets : dict of str to str
        For some of the results, ``at most X`` or ``at least X``.

    Returns
    -------
    quantities : list of Quantity

    Examples
    --------
    >>> after, = quantities_of({"height_rmse_before_m": 2.74, "height_rmse_after_m": 0.13712}, {})
    >>> after.words, after.value, after.unit
    ('height RMSE', '2.74 → 0.137', 'm')
    """
    quantities = []
    for name, value in results.items():
        before, after = name.replace("_after", "_before"), name.replace("_before", "_after")
        shown = format_number(value, RESULT_DIGITS)
        if before != after and {before, after} <= set(results):
            if name == before:
                continue  # said together with the value after
            shown = f"{format_number(results[before], RESULT_DIGITS)} → {shown}"
            stem, unit = _split(name.replace("_after", ""))
        else:
            stem, unit = _split(name)
        target = str(targets.get(name, ""))
        meaning = MEANINGS.get(stem, "")
        missed = is_missed(value, target)
        quantities.append(Quantity(in_words(stem), shown, unit, meaning, target, missed))
    return sorted(quantities, key=lambda quantity: ("→" not in quantity.value, not quantity.unit))


def is_missed(value, target):
    """True when a number does not reach a target; False where either cannot be read.

    Examples
    --------
    >>> is_missed(40.7, "at most 33"), is_missed(0.95, "at least 0.9"), is_missed(1.0, "")
    (True, False, False)
    """
    found = re.fullmatch(r"at (most|least) ([-+.\de]+)", target)
    if not found or not isinstance(value, int | float):
        return False
    limit = float(found[2])
    return value > limit if found[1] == "most" else value < limit


def format_number(value, digits=SETTING_DIGITS):
    """A number with the digits that matter; everything else as text.

    Examples
    --------
    >>> format_number(0.000123456, 3), format_number(12345678), format_number(None)
    ('0.000123', '12 345 678', '–')
    """
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", " ")
    if isinstance(value, float):
        return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"
    return str(value)


def in_words(name):
    """A name of the code as words.

    Examples
    --------
    >>> in_words("height_nmad")
    'height NMAD'
    """
    return " ".join(CAPITALS.get(word, word) for word in str(name).split("_"))


def _split(name):
    """A result's name without its unit, and the unit."""
    stem, _, end = name.rpartition("_")
    return (stem, UNITS[end]) if stem and end in UNITS else (name, "")
