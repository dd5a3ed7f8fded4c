"""Shape from shading of a scene in parts: what all of it tells, then tile after tile.

Before the tiles come windows at full resolution, which tell priors and photometry, and the whole
scene on every n-th post, which tells the long waves. A tile starts from these, holds its rim there,
and takes priors and photometry as they are, so that tiles agree. Most callers want `prepare_scene`
and `solve_tile`.
"""

from dataclasses import asdict, dataclass, replace

import numpy as np

from lommel.core.interpolation import refine_spline
from lommel.core.multigrid import coarse_masses
from lommel.core.reflectance import reflectance_model
from lommel.errors import InputError, UnreadableError
from lommel.estimate.holes import fill_holes
from lommel.estimate.priors import Priors
from lommel.estimate.problem import Surroundings
from lommel.estimate.shape_from_shading import Start, correlation, solve_surface
from lommel.estimate.surface import Surface
from lommel.progress import silent, step
from lommel.run.inputs import known_heights
from lommel.run.photometry import read_known
from lommel.run.shape_from_shading import cell_grid, hillshade, seen_posts
from lommel.run.tiles_plan import BLEND, coarse_grid
from lommel.run.tiles_samples import named_files, photometry, solve_samples
from lommel.run.views import read_views
from lommel.scene.grid import Window

REACH = 12  # coarse posts beyond which a spline's coefficients feel less than 1e-6 of a value
# Where tiles start: closer than this the coarse surface still errs by what its area means leave
START_GAIN, START_STEP = 1e-3, 0.005
# The coarse surface errs by what area means and a coarse grid leave. Held more firmly the rim
# passes that on: with 0.05 tiles differ from one piece twice as much as with 1 or 1000
RIM_ERROR = 1.0  # times the change of height from post to post that the roughness stands for


@dataclass(frozen=True)
class Known:
    """What all tiles share.

    Attributes
    ----------
    names : list of str
        Images, in the order of the files.
    exposures, hazes, noise, brightness : array (images,), image units
    misfits : array (images,), noise standard errors
        Residuals of the windows at full resolution.
    thresholds : array (images,), image units
        Up to which a pixel is shadow.
    priors : Priors
        At the posts of the full grid.
    stride : int
    correction : float32 array (coarse rows, coarse cols), m
        Change of the unknowns that the coarse solution found.
    coarse : float32 array (coarse rows, coarse cols), m
        The unknowns of the coarse solution.
    base_height : float, m
    position, sun_position : array (3,), m
        Of the first image.
    """

    names: list
    exposures: np.ndarray
    hazes: np.ndarray
    noise: np.ndarray
    brightness: np.ndarray
    misfits: np.ndarray
    thresholds: np.ndarray
    priors: Priors
    stride: int
    correction: np.ndarray
    coarse: np.ndarray
    base_height: float
    position: np.ndarray
    sun_position: np.ndarray

    def surface(self, grid, parametrisation):
        """The parametrisation, the same for every part of the scene."""
        return Surface(grid, self.base_height, self.position if parametrisation == "ray" else None)


def prepare_scene(footprints, stride, settings, progress=silent):
    """Photometry, priors and long waves of the whole scene.

    Parameters
    ----------
    footprints : Footprints
        On the grid of full resolution.
    stride : int
        Posts per post of the coarse grid.
    settings : SfsSettings
    progress : callable

    Returns
    -------
    known : Known
    solution : Solution
        Of the coarse grid.
    skipped : list of Skipped
    """
    coarse = coarse_grid(footprints.grid, stride)
    scene = read_views(footprints.used, coarse, settings.masks, progress=progress)
    names = [view.name for view in scene.views]
    samples = solve_samples(footprints, stride, settings, scene.thresholds, progress)
    priors, found = samples[0].value.priors, photometry(names, samples)
    initial = fill_holes(scene.heights)
    first = scene.views[0]
    base = float(np.mean(initial, dtype=float))
    surface = Surface(coarse, base, first.position if settings.parametrisation == "ray" else None)
    start = surface.posts_from_heights(initial)
    brightness = np.array([np.nanmean(view.image) for view in scene.views])
    unseen = np.isnan(found.noise)
    noise, coarse_misfits = (
        _completed(values, brightness) for values in (found.noise, found.coarse_misfits)
    )
    on_coarse = coarse_priors(replace(priors, noise=noise), stride)
    on_coarse = replace(on_coarse, noise=np.fmax(on_coarse.noise, coarse_misfits))
    albedo, given = read_known(settings.albedo, settings.exposures, cell_grid(coarse), names)
    with step(progress, "coarse grid"):
        solution = solve_surface(
            surface,
            start,
            scene.views,
            reflectance_model(settings.reflectance),
            on_coarse,
            replace(settings.solver, gain_tolerance=START_GAIN, step_tolerance=START_STEP),
            albedo,
            given,
            maps=False,
        )
    value = solution.value
    ratio = np.nanmedian(found.exposures / value.exposures)
    known = Known(
        names,
        np.where(unseen, ratio * value.exposures, found.exposures),
        np.where(unseen, value.hazes, found.hazes),
        noise,
        np.array([np.nanmedian(image) for image in value.measured]),
        np.where(unseen, np.nanmedian(found.misfits), found.misfits),
        np.array([scene.thresholds[name] for name in names]),
        replace(priors, noise=noise),
        stride,
        value.u - start,
        value.u,
        base,
        np.asarray(first.position, float),
        np.asarray(first.sun_position, float),
    )
    return known, solution, scene.skipped


def _completed(values, brightness):
    """Of images that have none (NaN), the share of the brightness that is common among the rest."""
    is_known = np.isfinite(values)
    if not is_known.any():
        return values
    share = np.median(values[is_known] / brightness[is_known])
    return np.where(is_known, values, share * brightness)


def coarse_priors(priors, stride):
    """Priors of the same scene on every so manieth post.

    Roughness and contrast are changes from post to post of fields whose power falls as they do on
    every level of the solver; noise and albedo of single cells average out.

    Parameters
    ----------
    priors : Priors
    stride : int
        A power of two.

    Returns
    -------
    priors : Priors
    """
    halvings = stride.bit_length() - 1
    masses = coarse_masses(priors.dem_errors**-2.0, halvings)
    with np.errstate(divide="ignore"):
        errors = masses**-0.5
    return replace(
        priors,
        noise=priors.noise / stride,
        dem_errors=errors,
        smoothing=priors.smoothing / stride,
        albedo_error=priors.albedo_error / stride,
    )


def frees_exposures(settings):
    """Whether exposures are for the images to tell.

    Parameters
    ----------
    settings : SfsSettings
    """
    return settings.solver.estimate_exposure and settings.exposures is None


def stored_window(tile, shape):
    """Posts of a tile that are kept: its own and those that are blended with the next."""
    inner, rim = tile.inner, BLEND // 2
    wide = Window(inner.row - rim, inner.col - rim, inner.rows + 2 * rim, inner.cols + 2 * rim)
    return wide.intersection(Window(0, 0, *shape))


def solve_tile(files, grid, tile, known, settings):
    """Products of one tile.

    Parameters
    ----------
    files : SceneFiles
    grid : Grid
        Of the whole scene.
    tile : Tile
    known : Known
    settings : SfsSettings

    Returns
    -------
    products : dict of str to array
        On the posts or cells of `stored_window`, and the parts of a `Remainder`.
    record : dict
        Outcome, images, what was left out and why.
    """
    part = grid.cut(tile.outer)
    kept = stored_window(tile, grid.shape)
    inside = kept.relative_to(tile.outer).slices
    try:
        scene = read_views(
            named_files(files, known.names),
            part,
            settings.masks,
            thresholds=dict(zip(known.names, known.thresholds.tolist(), strict=True)),
        )
    except UnreadableError:
        raise
    except InputError as error:
        return _unseen(files, part, known, inside), {"outcome": "unseen", "sentence": str(error)}
    names = [view.name for view in scene.views]
    seen_by = [known.names.index(name) for name in names]
    initial = fill_holes(scene.heights)
    surface = known.surface(part, settings.parametrisation)
    u = surface.posts_from_heights(initial)
    start = u + at_posts(known.correction, known.stride, tile.outer)
    albedo, _ = read_known(settings.albedo, None, cell_grid(part), names)
    solution = solve_surface(
        surface,
        u,
        scene.views,
        reflectance_model(settings.reflectance),
        replace(known.priors, noise=known.noise[seen_by]),
        settings.solver,
        albedo,
        (known.exposures[seen_by], known.hazes[seen_by]),
        start=Start(
            start,
            known.stride,
            _hold(tile, grid, known.priors),
            known.misfits[seen_by],
            tile.inner.relative_to(tile.outer).slices,
            Surroundings(known.coarse, np.array([tile.outer.row, tile.outer.col, known.stride])),
            known.brightness[seen_by],
            frees_exposures(settings),
        ),
    )
    value = solution.value
    refined = surface.heights_from_posts(value.u)
    refined[~(np.isfinite(scene.heights) | seen_posts(value.measured))] = np.nan
    products = _products(part, scene.heights, initial, refined, known, inside)
    first = names.index(known.names[0]) if known.names[0] in names else None
    nothing = np.full_like(value.albedo, np.nan)
    measured = nothing if first is None else value.measured[first]
    modelled = nothing if first is None else value.modelled[first]
    cells = {
        "measured": measured,
        "modelled": np.where(np.isfinite(measured), modelled, np.float32(np.nan)),
        "albedo": value.albedo,
        "separation": value.separation,
        "residual": _residual(value, known.brightness[seen_by]),
    }
    products |= {name: values[inside] for name, values in cells.items()}
    products |= {f"left-{name}": values for name, values in vars(value.left).items()}
    pairs = zip(value.measured, value.modelled, strict=True)
    counts = [int(np.isfinite(image[inside]).sum()) for image in value.measured]
    record = {
        "outcome": solution.outcome,
        "sentence": solution.advice,
        "images": names,
        "cells": counts,
        "misfits": value.misfits.tolist(),
        "correlation_before": float(np.mean(value.correlations)),
        "correlation_after": float(np.mean([correlation(*pair) for pair in pairs])),
        "skipped": [asdict(skip) for skip in scene.skipped],
        "history": solution.history,
    }
    return products, record


def _unseen(files, part, known, inside):
    """Products of a tile that no image shows: the DEM as it is."""
    heights = known_heights(files.dems, part, part.body)
    products = _products(part, heights, heights, heights, known, inside)
    nothing = np.full((part.shape[0] - 1, part.shape[1] - 1), np.nan, np.float32)[inside]
    names = ("measured", "modelled", "albedo", "separation", "residual")
    return products | dict.fromkeys(names, nothing)


def _products(part, heights, initial, refined, known, inside):
    products = {"dem": refined[inside], "initial-dem": heights[inside]}
    for name, surface in (("before", initial), ("after", refined)):
        if np.isfinite(surface).any():
            shade = hillshade(part, surface, known)
        else:
            shade = np.full((part.shape[0] - 1, part.shape[1] - 1), np.nan, np.float32)
        products[f"hillshade-{name}"] = shade[inside]
    return products


def _residual(value, brightness):
    """As `relative_residual`, per cent of the images' brightness in the whole scene."""
    total = np.zeros(value.albedo.shape, np.float32)
    count = np.zeros(total.shape, np.uint16)
    for measured, modelled, mean in zip(value.measured, value.modelled, brightness, strict=True):
        difference = (modelled - measured) * np.float32(100 / mean)
        is_known = np.isfinite(difference)
        total[is_known] += difference[is_known] ** 2
        count += is_known
    return np.sqrt(total / np.where(count > 0, count, np.nan).astype(np.float32))


def at_posts(coarse, stride, window):
    """A field on coarse posts at the posts of a window, by a cubic spline.

    Parameters
    ----------
    coarse : float32 array (coarse rows, coarse cols)
    stride : int
    window : Window

    Returns
    -------
    values : float32 array (rows, cols)
    """
    from scipy.ndimage import spline_filter  # slow to import

    # what the spline of a window needs of its surroundings
    low_row, low_col = (max(first // stride - REACH, 0) for first in (window.row, window.col))
    last_row, last_col = (window.row + window.rows) // stride, (window.col + window.cols) // stride
    near = coarse[low_row : last_row + REACH, low_col : last_col + REACH]
    coefficients = spline_filter(near, 3, np.float32, "mirror")
    values = np.empty(window.shape, np.float32)
    first = window.row - stride * low_row, window.col - stride * low_col
    refine_spline(coefficients, stride, *first, values)
    return values


def _hold(tile, grid, priors):
    """Weights of the posts along the sides where the scene goes on, 1/m^2."""
    spacing = (grid.spacing[0] * grid.spacing[1]) ** 0.5
    weight = np.float32((RIM_ERROR * priors.roughness * spacing) ** -2.0)
    hold = np.zeros(tile.outer.shape, np.float32)
    if tile.outer.row > 0:
        hold[0] = weight
    if tile.outer.col > 0:
        hold[:, 0] = weight
    if tile.outer.row + tile.outer.rows < grid.shape[0]:
        hold[-1] = weight
    if tile.outer.col + tile.outer.cols < grid.shape[1]:
        hold[:, -1] = weight
    return hold
