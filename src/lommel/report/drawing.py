"""How every figure looks: one font, one accent, units on the axes, missing data hatched.

Figures are drawn without pyplot, so that nothing global changes. Most callers want `draw_map`
and `new_figure`.
"""

import io

import matplotlib
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from lommel.scene.grid import metres_per_unit

ACCENT = "#2f5d8a"
WARNING = "#b3541e"
SHADOW = "#1d2c4f"  # dark blue: not to be taken for the black of a dark, lit ground
MISSING = {"facecolor": "#ece8f5", "edgecolor": "#cfc5e3", "hatch": "////", "linewidth": 0.5}
STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.edgecolor": "#8a8f98",
    "axes.linewidth": 0.8,
    "axes.labelcolor": "#333840",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": "#e3e5e9",
    "grid.linewidth": 0.6,
    "text.color": "#1f2328",
    "text.parse_math": False,  # a $ in a file name is a $
    "xtick.color": "#555b65",
    "ytick.color": "#555b65",
    "hatch.linewidth": 0.8,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
}
STEPS = [1, 2, 2.5, 5, 10]  # of the ticks
DPI = 190  # a panel is then about twice as many pixels wide as it is shown
PANEL_WIDTH = 4.8  # inches; two panels stand side by side
FULL_WIDTH = 8.6  # inches; across the page
TALLEST = 6.0  # inches, of a map
WIDE = 0.55  # height by width below which a map takes the whole width


def new_figure(width, height):
    """An empty figure of a size in inches; open it inside `styled`."""
    return Figure(figsize=(width, height), layout="constrained")


def styled():
    """A context in which figures take the look of the report."""
    return matplotlib.rc_context(STYLE)


def to_png(figure):
    """A figure as the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, facecolor="white")
    return buffer.getvalue()


def is_wide(grid):
    """True when a map of this grid takes the whole width of the page."""
    return _height_by_width(grid) < WIDE


def draw_map(
    preview, title, label, colours, limits, missing="no data", shadow=None, whole_numbers=False
):
    """A map with axes, colour bar and a legend of what is missing.

    Parameters
    ----------
    preview : Preview
    title : str
    label : str
        Quantity and unit, on the colour bar.
    colours : str
        Name of a matplotlib colour map.
    limits : tuple of float
        Values at the ends of the colour bar; values beyond take the end's colour.
    missing : str
        What NaN means, for the legend.
    shadow : bool array (rows, cols), optional
        Drawn in a colour of its own.
    whole_numbers : bool
        The quantity is a count: the colour bar has no fractions.

    Returns
    -------
    png : bytes
    """
    values, grid = preview.values, preview.grid
    left, bottom, right, top, *names = _frame(grid)
    place = {"extent": (left, right, bottom, top), "aspect": _aspect(grid)}
    handles = []
    if shadow is not None and shadow.any():
        handles.append(Patch(facecolor=SHADOW, label="shadow: no direct sunlight"))
    if np.isnan(values).any():
        handles.append(Patch(**MISSING, label=missing))
    with styled():
        figure, axes, bar_axes, legend_place = _map_frame(grid, bool(handles))
        image = axes.imshow(values, cmap=colours, vmin=limits[0], vmax=limits[1], **place)
        if shadow is not None:
            paint = np.where(shadow, 1.0, np.nan)
            axes.imshow(paint, cmap=ListedColormap([SHADOW]), interpolation="nearest", **place)
        axes.set_title(title)
        axes.set(xlabel=names[0], ylabel=names[1])
        axes.locator_params(axis="x", nbins=8 if is_wide(grid) else 5, steps=STEPS)
        axes.locator_params(axis="y", nbins=5, steps=STEPS)
        bar = figure.colorbar(
            image,
            cax=bar_axes,
            label=label,
            extend=_ends_beyond(values, limits),
            orientation="horizontal" if is_wide(grid) else "vertical",
            ticks=MaxNLocator(6, steps=STEPS, integer=whole_numbers),
        )
        bar.outline.set_visible(False)
        if handles:
            figure.legend(handles=handles, **legend_place)
        return to_png(figure)


def percent_clipped(*arrays, low=0.5, high=99.5):
    """Limits that leave the darkest and brightest per cent out, common to all arrays.

    Parameters
    ----------
    arrays : arrays of any shape
        NaN is ignored.
    low, high : float, per cent

    Returns
    -------
    limits : tuple of float
    """
    values = np.concatenate([array[np.isfinite(array)] for array in arrays])
    if not values.size:
        return 0.0, 1.0
    first, last = np.percentile(values, [low, high]).tolist()
    return (first, last) if last > first else (first - 0.5, first + 0.5)


def about_zero(*arrays, share=99.0):
    """Limits of equal size on both sides of zero that hold a share of the values, in per cent."""
    reach = percent_clipped(*[np.abs(array) for array in arrays], low=0.0, high=share)[1]
    return -reach, reach


def _map_frame(grid, has_legend):
    """A figure with axes for map and colour bar at fixed margins, so that pairs line up, inches.

    The colour bar stands beside the map, or below it where the map takes the whole width; the
    legend beside that bar, or below the map.
    """
    wide = is_wide(grid)
    width = FULL_WIDTH if wide else PANEL_WIDTH
    left, right, above, below = (0.66, 0.2, 0.32, 1.12) if wide else (0.66, 0.98, 0.32, 0.54)
    below += 0.26 if has_legend and not wide else 0.0
    map_width = width - left - right
    map_height = float(np.clip(map_width * _height_by_width(grid), 0.6, TALLEST))
    height = above + map_height + below
    figure = Figure(figsize=(width, height))

    def axes_at(x, y, dx, dy):
        return figure.add_axes((x / width, y / height, dx / width, dy / height))

    axes = axes_at(left, below, map_width, map_height)
    axes.grid(False)
    axes.patch.set(**MISSING)
    if wide:
        bar = axes_at(left + 0.45 * map_width, 0.44, 0.55 * map_width, 0.12)
        legend = {"loc": "lower left", "bbox_to_anchor": (left / width, 0.36 / height)}
    else:
        bar = axes_at(left + map_width + 0.12, below, 0.13, map_height)
        legend = {"loc": "lower left", "bbox_to_anchor": (left / width, 0.0), "ncols": 2}
    return figure, axes, bar, {**legend, "borderaxespad": 0.2}


def _ends_beyond(values, limits):
    """Which ends of the colour bar stand for values beyond it too, in matplotlib's word."""
    below, above = bool(np.any(values < limits[0])), bool(np.any(values > limits[1]))
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]


def _frame(grid):
    """Edges left, bottom, right, top and axis labels: degrees, or km about the centre."""
    xmin, ymin, xmax, ymax = grid.bounds
    if grid.crs.is_geographic:
        return xmin, ymin, xmax, ymax, "longitude, °E", "latitude, °N"
    factor = metres_per_unit(grid.crs, grid.body) / 1e3
    x, y = (xmax - xmin) / 2 * factor, (ymax - ymin) / 2 * factor
    return -x, -y, x, y, "x from the centre, km", "y from the centre, km"


def _aspect(grid):
    """Length of a unit of y by a unit of x, for a map that keeps shapes at its centre."""
    if not grid.crs.is_geographic:
        return 1.0
    _, ymin, _, ymax = grid.bounds
    return 1.0 / max(np.cos(np.radians((ymin + ymax) / 2)), 0.1)


def _height_by_width(grid):
    xmin, ymin, xmax, ymax = grid.bounds
    return (ymax - ymin) / (xmax - xmin) * _aspect(grid)
