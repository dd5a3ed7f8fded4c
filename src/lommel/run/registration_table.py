"""What a registration found, as a table: one row per image. Most callers want `write_table`."""

import csv

import numpy as np

from lommel.run.register_to_terrain import MOST_CHANCE

COLUMNS = (
    "image",
    "used",
    "quality",
    "shift_line_px",
    "shift_sample_px",
    "shift_m",
    "error_m",
    "residual_px",
    "patches",
    "patches_agreeing",
    "correlation",
    "likelihood",
    "likelihood_elsewhere",
    "tie_patches",
    "tie_residual_px",
    "camera",
    "reason",
)


def quality(state):
    """How well an image's place is known, in a word.

    Parameters
    ----------
    state : Registration

    Returns
    -------
    quality : str
        ``patches``: parts of the image agree on it; ``whole``: the image as a whole has one
        distinct place; ``ties``: only other images tell.
    """
    if not state.is_on_terrain:
        return "ties"
    return "patches" if state.chance < MOST_CHANCE else "whole"


def why_lost(state, settings):
    """Why an image's place was not found, and what to do."""
    if state.whole is None:
        return (
            f"{state.image.name}: image and DEM share too little, or the DEM's posts are too far "
            "apart for it. Give a DEM that covers the image, with finer posts."
        )
    whole = state.whole
    found = f"{whole.likelihood:.0f} against {max(whole.runner_up, 0.0):.0f}"
    if not whole.is_inside:
        found += ", at the rim of the search"
    return (
        f"{state.image.name}: no place on the terrain stands out (log-likelihood of the best, "
        f"{found} elsewhere). It may lie farther off than --search-radius "
        f"{settings.search_radius:g} m, be lit from too high, or the DEM may be too coarse."
    )


def camera_name(state):
    """File of an image's corrected camera."""
    return f"{state.image.path.stem}.json"


def write_table(path, used, lost, skipped):
    """Write ``register.csv``.

    Parameters
    ----------
    path : Path
    used, lost : list of Registration
        With a place, and without.
    skipped : list of Skipped
        The reasons of those left out, also of images that were never looked at.
    """
    reasons = {skip.name: skip.reason for skip in skipped}
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n", restval="")
        writer.writeheader()
        for state in used:
            writer.writerow(_row(state) | {"used": 1, "camera": camera_name(state)})
        for state in lost:
            reason = reasons.pop(state.image.name)
            writer.writerow(_match_row(state) | {"used": 0, "reason": reason})
        for name, reason in reasons.items():
            writer.writerow({"image": name, "used": 0, "reason": reason})


def _row(state):
    line, sample = state.shift
    gsd = state.site.gsd
    return _match_row(state) | {
        "quality": quality(state),
        "shift_line_px": _number(line),
        "shift_sample_px": _number(sample),
        "shift_m": _number(np.hypot(line, sample) * gsd),
        "error_m": _number(state.error),
        "residual_px": _number(state.residual / gsd),
        "patches": state.patches,
        "patches_agreeing": state.agreeing,
        "tie_patches": state.ties,
        "tie_residual_px": _number(state.tie_residual / gsd),
    }


def _match_row(state):
    row = {"image": state.image.name}
    if state.whole is not None:
        row |= {
            "correlation": _number(state.whole.correlation),
            "likelihood": _number(state.whole.likelihood),
            "likelihood_elsewhere": _number(state.whole.runner_up),
        }
    return row


def _number(value):
    return f"{float(value):.5g}" if np.isfinite(value) else ""
