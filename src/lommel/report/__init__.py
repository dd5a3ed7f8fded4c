"""The report of a run: figures and one self-contained HTML page, made from what its folder holds.

The report opens with the result and its error, then shows one figure per claim. It reads the
products only, so it can be written again at any time. matplotlib and jinja2 live in this package
only and are imported when a report is written, not before. Callers want `write_report`.
"""

from pathlib import Path


def write_report(folder):
    """Draw previews and ``report.html`` into the folder of a run.

    Products that are not there are left out. Folders inside that hold a run of their own, as the
    demo's stages do, become parts of the same page.

    Parameters
    ----------
    folder : path
        Holds ``run.json``, GeoTIFFs and ``exposures.csv`` as far as the command made them.

    Returns
    -------
    page : Path
        The page, with every image inside it.
    """
    from lommel.report.page import build_page  # draws: half a second that other commands save

    return build_page(Path(folder))
