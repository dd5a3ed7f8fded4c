"""The page: words, numbers and pictures of a run put into ``page.html.j2``.

Every picture goes into the page as well as beside it, and nothing is loaded from elsewhere, so
the page can be mailed. Most callers want `build_page`.
"""

import base64
import os
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from lommel.errors import InputError
from lommel.report.claims import Claim, find_claims
from lommel.report.contents import Contents, read_contents
from lommel.report.words import Quantity, format_number, in_words, quantities_of

TITLES = {
    "albedo": "Albedo and exposures",
    "sfs": "Terrain refined by shape from shading",
    "demo": "Demonstration: a simulated orbit strip",
}
HEADLINES = 6  # results shown large before the table


@dataclass(frozen=True)
class Part:
    """One run on the page.

    Attributes
    ----------
    title : str
    contents : Contents
    claims : list of Claim
    quantities : list of Quantity
    skipped : list of dict
        Image and reason.
    """

    title: str
    contents: Contents
    claims: list[Claim]
    quantities: list[Quantity]
    skipped: list[dict]


def build_page(folder):
    """Write the previews and ``report.html`` of a folder and of the runs inside it.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    page : Path
    """
    inner = sorted(path.parent for path in folder.glob("*/run.json"))
    parts = [_part(read_contents(place)) for place in (folder, *inner)]
    for part in parts:
        for claim in part.claims:
            for panel in claim.panels:
                _write(part.contents.folder / f"{panel.name}.png", panel.png)
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(inline=_inline, flat=_flat, number=format_number, words=in_words)
    html = environment.get_template("page.html.j2").render(parts=parts, headlines=HEADLINES)
    page = folder / "report.html"
    _write(page, html.encode("utf-8", "replace"))
    return page


def _part(contents):
    record = contents.record
    title = TITLES.get(record["command"], record["command"])
    quantities = quantities_of(record["results"], record["targets"])
    return Part(title, contents, find_claims(contents), quantities, _skipped(contents))


def _skipped(contents):
    rows = {str(row.get("image")): str(row.get("reason", "")) for row in contents.record["skipped"]}
    if contents.exposures is not None:
        table = contents.exposures
        for image, used, reason in zip(table.images, table.used, table.reasons, strict=True):
            if not used:
                rows.setdefault(image, reason)
    return [{"image": image, "reason": reason} for image, reason in rows.items()]


def _flat(values):
    """Settings within settings as one list; the names of the outer ones are left off."""
    flat = {}
    for name, value in values.items():
        flat.update(_flat(value) if isinstance(value, dict) else {name: value})
    return flat


def _inline(png):
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _write(path, content):
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(content)
        os.replace(partial, path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}.") from error
    finally:
        partial.unlink(missing_ok=True)
