"""Curves and histograms of the report: exposures, convergence, residuals."""

from pathlib import Path

import numpy as np
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from lommel.report.drawing import (
    ACCENT,
    FULL_WIDTH,
    PANEL_WIDTH,
    WARNING,
    new_figure,
    styled,
    to_png,
)

UNSETTLED = "#b8bec7"
STEP_SIZES = {"step_m": "step, m", "change": "relative change"}
NAMED_IMAGES = 60  # images up to which each one is named on the axis
NAME_LENGTH = 24  # characters of an image's name on the axis
PLAIN = FuncFormatter(lambda value, _: f"{value:.6g}")  # powers of ten would need math text
HISTOGRAM_SHARE = 99.5  # per cent of the residuals that the histogram spans


def draw_exposures(exposures):
    """Exposure of each image by their mean, with its error; the haze below where there is any.

    Parameters
    ----------
    exposures : Exposures

    Returns
    -------
    png : bytes
    """
    used = exposures.used & np.isfinite(exposures.exposure)
    names = [_short(name) for name, keep in zip(exposures.images, used, strict=True) if keep]
    place = np.arange(len(names))
    mean = exposures.exposure[used].mean()
    exposure, error = exposures.exposure[used] / mean, exposures.exposure_error[used] / mean
    haze = exposures.haze[used]
    has_haze = bool(np.any(np.nan_to_num(haze) != 0))
    with styled():
        figure = new_figure(FULL_WIDTH, 4.8 if has_haze else 3.4)
        rows = figure.subplots(2 if has_haze else 1, squeeze=False, sharex=True)[:, 0]
        rows[0].axhline(1.0, color="#9aa0a8", linewidth=0.8, linestyle="--")
        rows[0].errorbar(
            place, exposure, np.nan_to_num(error), color=ACCENT, ecolor="#9db4cc", marker="o",
            markersize=4, linewidth=0.9, elinewidth=1.4, capsize=2,
        )  # fmt: skip
        rows[0].set(title="Relative exposure of each image", ylabel="exposure, mean = 1")
        if has_haze:
            rows[1].bar(place, haze, color="#b9a36b", width=0.7)
            rows[1].axhline(0.0, color="#8a8f98", linewidth=0.8)
            rows[1].set(title="Haze of each image", ylabel="haze, image values")
        _name_images(rows[-1], names)
        return to_png(figure)


def draw_history(history):
    """Cost and size of each step.

    Costs on different levels of a coarse-to-fine solve, or counted in another noise, are not
    comparable: they are drawn apart, and in grey while the noise is not yet the final one.

    Parameters
    ----------
    history : list of dict
        Each with a ``cost``; where known, with ``change`` (relative) or ``step_m``, with the
        ``stride`` of the level in posts, and with what the cost is ``counted_in``, a dict.

    Returns
    -------
    png : bytes, or None when fewer than two steps have a cost
    """
    rows = [row for row in history if _is_number(row.get("cost"))]
    if len(rows) < 2:
        return None
    steps, cost = np.arange(1, len(rows) + 1), np.array([row["cost"] for row in rows], float)
    kinds = [(row.get("stride"), *(row.get("counted_in") or {}).items()) for row in rows]
    with styled():
        figure = new_figure(PANEL_WIDTH, 3.4)
        axes = figure.add_subplot()
        for stride, *counted in dict.fromkeys(kinds):
            kind = np.array([other == (stride, *counted) for other in kinds])
            colour = ACCENT if counted == list(kinds[-1][1:]) else UNSETTLED
            axes.plot(steps[kind], cost[kind], color=colour, marker="o", markersize=4)
            if stride is not None:
                note = {"xytext": (0, 7), "textcoords": "offset points", "fontsize": 7}
                axes.annotate(f"1/{stride}", (steps[kind][0], cost[kind][0]), **note)
        axes.set(title="Cost after each step", xlabel="step", ylabel="cost")
        axes.set_yscale("log" if cost.min() > 0 and cost.max() > 3 * cost.min() else "linear")
        axes.yaxis.set_major_formatter(PLAIN)
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        axes.margins(y=0.12)
        for key, label in STEP_SIZES.items():
            size = np.array([_positive(row.get(key)) for row in rows])
            if np.isfinite(size).any():
                _draw_sizes(axes, steps, size, label)
                break
        return to_png(figure)


def _draw_sizes(axes, steps, size, label):
    twin = axes.twinx()
    twin.grid(False)
    twin.spines["right"].set_visible(True)
    twin.plot(steps, size, color=WARNING, marker="s", markersize=3, linestyle=":")
    twin.set(ylabel=label, yscale="log")
    twin.yaxis.set_major_formatter(PLAIN)
    twin.yaxis.set_minor_formatter(NullFormatter())
    twin.yaxis.label.set_color(WARNING)
    axes.yaxis.label.set_color(ACCENT)


def draw_histogram(values, label):
    """How often each residual occurs, with the spread named.

    Parameters
    ----------
    values : array
        NaN is ignored.
    label : str
        Quantity and unit.

    Returns
    -------
    png : bytes, or None when there is nothing to count
    """
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    reach = max(float(np.percentile(np.abs(values), HISTOGRAM_SHARE)), 1e-12)
    nmad = 1.4826 * float(np.median(np.abs(values - np.median(values))))
    rms = float(np.sqrt(np.mean(np.square(values, dtype=float))))
    with styled():
        figure = new_figure(PANEL_WIDTH, 3.4)
        axes = figure.add_subplot()
        share = np.full(values.size, 100.0 / values.size)
        axes.hist(values, bins=61, range=(-reach, reach), weights=share, color=ACCENT)
        axes.axvline(0.0, color="#1f2328", linewidth=0.8)
        axes.set(
            title=f"rms {rms:.3g} %, NMAD {nmad:.3g} %",
            xlabel=label,
            ylabel="share of pixels, %",
        )
        return to_png(figure)


def _name_images(axes, names):
    every = max(1, -(-len(names) // NAMED_IMAGES))
    shown = range(0, len(names), every)
    axes.set_xticks(shown, [names[i] for i in shown], rotation=90, fontsize=7)
    axes.set_xlim(-0.8, max(len(names), 2) - 0.2)
    axes.set_xlabel("image, in the order of exposures.csv")


def _short(name):
    stem = Path(name).name.split(".")[0].encode("ascii", "replace").decode()
    return stem if len(stem) <= NAME_LENGTH else stem[: NAME_LENGTH - 1] + "~"


def _is_number(value):
    return isinstance(value, int | float) and np.isfinite(value)


def _positive(value):
    return abs(float(value)) or np.nan if _is_number(value) else np.nan
