"""What the report shows: one claim after another, each with the pictures that carry it.

A claim is left out when the folder lacks its products. Most callers want `find_claims`.
"""

from dataclasses import dataclass, replace

import numpy as np

from lommel.report import drawing, plots

UNUSED = "shadow, clipped or no data"
BY_MEDIAN = "brightness, median of the map = 1"


@dataclass(frozen=True)
class Panel:
    """One picture.

    Attributes
    ----------
    name : str
        Of the PNG file beside the products.
    png : bytes
    words : str
        What the picture shows, for those who cannot see it.
    """

    name: str
    png: bytes
    words: str


@dataclass(frozen=True)
class Claim:
    """A heading, a sentence on how to read it, and its pictures.

    Attributes
    ----------
    title, text : str
    panels : tuple of Panel
    is_wide : bool
        The pictures take the page's whole width each.
    """

    title: str
    text: str
    panels: tuple[Panel, ...]
    is_wide: bool = False


def find_claims(contents):
    """Every claim that the products in a folder support, in reading order.

    Parameters
    ----------
    contents : Contents

    Returns
    -------
    claims : list of Claim
    """
    makers = (
        albedo_against_mosaic,
        relief_before_and_after,
        measured_against_modelled,
        height_and_change,
        albedo_of_terrain,
        exposures_of_images,
        coverage_and_residual,
        convergence,
    )
    claims = (make(contents) for make in makers)
    return [claim for claim in claims if claim and claim.panels]


def albedo_against_mosaic(contents):
    """Brightness of the plain mosaic and the albedo, each by its own median, on one scale."""
    before, after = contents.preview("orthomosaic.tif"), contents.preview("albedo.tif")
    if before is None or after is None:
        return None
    before, after = _by_median(before), _by_median(after)
    limits = drawing.percent_clipped(before.values, after.values)
    look = (BY_MEDIAN, "gray", limits, UNUSED)
    return Claim(
        "Albedo without relief and exposure",
        "Each map is divided by its own median; both have the same grey scale. In the albedo, "
        "slopes and borders of images should be gone and the brightness of the ground itself "
        "should stay.",
        (
            _map(before, "orthomosaic", "Before: plain mosaic", *look),
            _map(after, "albedo", "After: albedo", *look),
        ),
        drawing.is_wide(after.grid),
    )


def relief_before_and_after(contents):
    """Hillshades of the initial and the refined terrain, lit from the image's own Sun."""
    before = contents.preview("hillshade-before.tif")
    after = contents.preview("hillshade-after.tif")
    if after is None:
        return None
    pair = [preview for preview in (before, after) if preview]
    limits = drawing.percent_clipped(*[preview.values for preview in pair])
    label = "cosine of incidence"
    titles = ("Before: initial terrain", "After: refined terrain")[-len(pair) :]
    names = ("hillshade-before", "hillshade-after")[-len(pair) :]
    panels = [
        _map(preview, name, title, label, "gray", limits, shadow=preview.values <= 0)
        for preview, name, title in zip(pair, names, titles, strict=True)
    ]
    return Claim(
        "Relief that the images show",
        "Both terrains lit from the Sun of the first image, on the same grey scale. Craters that "
        "the image shows should appear, stripes and noise of the initial terrain should not.",
        tuple(panels),
        drawing.is_wide(after.grid),
    )


def measured_against_modelled(contents):
    """The image, what the model makes of it, the difference and its distribution."""
    measured, modelled = contents.preview("measured.tif"), contents.preview("modelled.tif")
    if measured is None or modelled is None or measured.values.shape != modelled.values.shape:
        return None
    limits = drawing.percent_clipped(measured.values, modelled.values)
    panels = [
        _map(measured, "measured", "Measured image", "image value", "gray", limits, UNUSED),
        _map(modelled, "modelled", "Modelled image", "image value", "gray", limits, UNUSED),
    ]
    typical = _median(measured.values)
    difference = replace(modelled, values=100 * (modelled.values - measured.values) / typical)
    panels += _difference_panels(difference)
    residual = contents.preview("residual.tif")
    if residual is not None and contents.record["results"].get("images", 1) > 1:
        title, label = "All images", "rms residual, % of the median"
        limits = (0.0, drawing.percent_clipped(residual.values)[1])
        panels.append(_map(residual, "residual", title, label, "cividis", limits, UNUSED))
    text = (
        "The first image, on the same grey scale measured and modelled. The difference is modelled "
        "minus measured in per cent of the median image value; relief that shows in it is relief "
        "that the terrain lacks."
    )
    if measured.shrink > 1:
        text += f" The histogram counts means of {measured.shrink:.1f} pixels squared."
    wide = drawing.is_wide(measured.grid)
    return Claim("How well the terrain explains the image", text, tuple(panels), wide)


def height_and_change(contents):
    """The terrain, and what was added to the initial one."""
    dem, initial = contents.preview("dem.tif"), contents.preview("initial-dem.tif")
    if dem is None:
        return None
    limits = drawing.percent_clipped(dem.values, low=0.5, high=99.5)
    panels = [_map(dem, "dem", "Refined terrain", "height, m", "cividis", limits)]
    text = "Heights in metres above the reference sphere."
    if initial is not None and initial.values.shape == dem.values.shape:
        change = replace(dem, values=dem.values - initial.values)
        both = drawing.about_zero(change.values)
        title, label = "Refined minus initial", "height change, m"
        panels.append(_map(change, "height-change", title, label, "RdBu_r", both))
        text += " The change is drawn symmetrically about zero: red is raised, blue is lowered."
    return Claim("Heights and what changed", text, tuple(panels), drawing.is_wide(dem.grid))


def albedo_of_terrain(contents):
    """What shape from shading gave to the ground's brightness instead of to its slopes."""
    albedo = contents.preview("albedo.tif")
    if albedo is None or contents.preview("dem.tif") is None:
        return None
    albedo = _by_median(albedo)
    limits = drawing.percent_clipped(albedo.values)
    return Claim(
        "Brightness that is not relief",
        "The albedo estimated with the terrain, by its median. Craters lit from one side in it "
        "would be relief taken for albedo.",
        (_map(albedo, "albedo", "Albedo", BY_MEDIAN, "gray", limits, UNUSED),),
        drawing.is_wide(albedo.grid),
    )


def exposures_of_images(contents):
    """Exposure and haze of each image along the strip."""
    exposures = contents.exposures
    if exposures is None or (exposures.used & np.isfinite(exposures.exposure)).sum() < 2:
        return None
    words = "Relative exposure of each image with its standard error, and its haze"
    panel = Panel("exposures", plots.draw_exposures(exposures), words)
    text = "Brightness factor of each image; bars are standard errors. Haze adds to the image."
    return Claim("Exposures along the strip", text, (panel,), is_wide=True)


def coverage_and_residual(contents):
    """How many images see each point, and the error of the albedo there."""
    count = contents.preview("count.tif")
    panels = []
    if count is not None:
        seen = replace(count, values=np.where(count.values > 0, count.values, np.nan))
        limits = (0.0, max(float(np.nanmax(seen.values, initial=1.0)), 1.0))
        title, label = "Images per point", "images used at a point"
        panels.append(
            _map(seen, "count", title, label, "cividis", limits, UNUSED, whole_numbers=True)
        )
    residual = contents.preview("residual.tif") if count is not None else None
    if residual is not None:
        limits = (0.0, drawing.percent_clipped(residual.values)[1])
        unit = residual.unit.replace("percent", "%")
        label = "standard error" + (f", {unit}" if unit not in ("", "1") else "")
        panels.append(
            _map(residual, "residual", "Error of the albedo", label, "cividis", limits, UNUSED)
        )
    text = "An albedo is as good as the images that agree on it: many images, small error."
    wide = bool(panels) and drawing.is_wide((count or residual).grid)
    return Claim("Where the albedo is well known", text, tuple(panels), wide)


def convergence(contents):
    """Cost of each step of the solver."""
    png = plots.draw_history(contents.record["history"])
    if png is None:
        return None
    text = "The cost should fall and level off; a run that still falls stopped too early."
    history = contents.record["history"]
    if any("stride" in row for row in history):
        text += " Coarse levels come first: 1/8 is solved on every eighth post, on fewer cells."
    if any(row.get("counted_in") != history[-1].get("counted_in") for row in history):
        text += " Grey: the noise or the haze that the cost counts with was still being estimated."
    words = "Cost after each step of the solver"
    return Claim("Convergence", text, (Panel("convergence", png, words),))


def _difference_panels(difference):
    label = "difference, % of the median"
    limits = drawing.about_zero(difference.values)
    title = "Modelled minus measured"
    panels = [_map(difference, "image-difference", title, label, "RdBu_r", limits, UNUSED)]
    png = plots.draw_histogram(difference.values, label)
    if png:
        panels.append(Panel("image-difference-histogram", png, f"Histogram of the {label}"))
    return panels


def _map(preview, name, title, label, colours, limits, missing="no data", **options):
    png = drawing.draw_map(preview, title, label, colours, limits, missing, **options)
    return Panel(name, png, f"{title}: map of {label}")


def _by_median(preview):
    return replace(preview, values=preview.values / _median(preview.values))


def _median(values):
    """Median of what is known; 1 where that is nothing or zero, for use as a divisor."""
    values = values[np.isfinite(values)]
    return (float(np.median(values)) if values.size else 0.0) or 1.0
