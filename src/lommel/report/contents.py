"""What the folder of a run holds: its record, its exposures, its rasters.

`read_contents` checks the record, so that the drawing code can trust it.
"""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lommel.errors import InputError
from lommel.io.raster import Preview, read_preview

PREVIEW_SIZE = 1200  # pixels of the longest side: more than a page shows, little to hold

RECORD = {  # parts of run.json that the report shows, and what each has to be
    "command": str,
    "created": str,
    "lommel": str,
    "settings": dict,
    "versions": dict,
    "machine": dict,
    "outcome": dict,
    "results": dict,
    "targets": dict,
    "inputs": list,
    "stages": list,
    "skipped": list,
    "history": list,
}


@dataclass(frozen=True)
class Exposures:
    """The rows of ``exposures.csv``, in the file's order.

    Attributes
    ----------
    images : tuple of str
    exposure, exposure_error, haze : array (images,)
        NaN where the table has no number; haze in image values.
    used : bool array (images,)
    reasons : tuple of str
        Why an image was not used; empty where it was.
    """

    images: tuple[str, ...]
    exposure: np.ndarray
    exposure_error: np.ndarray
    haze: np.ndarray
    used: np.ndarray
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Contents:
    """The folder of one run.

    Attributes
    ----------
    folder : Path
    record : dict
        ``run.json``, with every part of `RECORD` present, empty where the file had none.
    exposures : Exposures or None
    """

    folder: Path
    record: dict
    exposures: Exposures | None

    def preview(self, name) -> Preview | None:
        """A raster of the folder, small enough to draw; None when there is no such file."""
        path = self.folder / name
        return read_preview(path, PREVIEW_SIZE) if path.exists() else None


def read_contents(folder):
    """The record and the exposures of a run; rasters are read when they are drawn.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    contents : Contents
    """
    table = folder / "exposures.csv"
    exposures = _read_exposures(table) if table.exists() else None
    return Contents(folder, _read_record(folder / "run.json"), exposures)


def _read_record(path):
    remedy = "Name a folder that a lommel command wrote, or repeat the run with --overwrite."
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{path.parent} holds no run.json. {remedy}") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as the record of a run: {error}. {remedy}") from (
            error
        )
    if not isinstance(record, dict) or "command" not in record:
        raise InputError(f"{path} names no command, so it is not the record of a run. {remedy}")
    for name, kind in RECORD.items():
        value = record.setdefault(name, kind())
        has_rows = not isinstance(value, list) or all(isinstance(row, dict) for row in value)
        if not (isinstance(value, kind) and has_rows):
            raise InputError(
                f"{path}: {name!r} should be a {kind.__name__}{' of dict' * (kind is list)}, "
                f"it is {json.dumps(value)[:60]}. {remedy}"
            )
    return record


def _read_exposures(path):
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(
            f"{path} cannot be read: {error}. Repeat the run that wrote it."
        ) from error
    if rows and not {"image", "exposure"} <= set(rows[0]):
        raise InputError(
            f"{path} has the columns {', '.join(map(str, rows[0]))}; the report needs image and "
            "exposure. Repeat the run that wrote it with --overwrite."
        )
    return Exposures(
        images=tuple(row["image"] for row in rows),
        exposure=_numbers(rows, "exposure"),
        exposure_error=_numbers(rows, "exposure_error"),
        haze=_numbers(rows, "haze"),
        used=np.array(
            [str(row.get("used") or "true").lower() in ("true", "1", "yes") for row in rows]
        ),
        reasons=tuple(row.get("reason") or "" for row in rows),
    )


def _numbers(rows, name):
    return np.array([_number(row.get(name)) for row in rows])


def _number(text):
    try:
        return float(text)
    except (TypeError, ValueError):
        return np.nan
