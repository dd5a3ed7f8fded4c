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
from lommel.errors import InputError, LommelError, UnreadableError
from lommel.estimate.holes import fill_holes
from lommel.estimate.measured_posts import measured_posts
from lommel.estimate.priors import Priors
from lommel.estimate.problem import Surroundings
from lommel.estimate.shape_from_shading import Start, correlation, solve_surface
from lommel.estimate.surface import Surface
from lommel.progress import silent, step
from lommel.run.inputs import known_heights
from lommel.run.photometry import read_known
from lommel.run.shape_from_shading import cell_grid, hillshade, seen_posts
from lommel.run.tiles_plan import BLEND, coarse_grid
from lommel.run.views import read_views
from lommel.scene.grid import Window

REACH = 12  # coarse posts beyond which a spline's coefficients feel less than 1e-6 of a value
SAMPLE = 513  # posts along each side of the windows that tell priors and photometry
SAMPLES = 3  # of them along each side of a larger scene
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
    samples = _samples(footprints, settings, scene.thresholds, progress)
    priors = samples[0][1].priors
    initial = fill_holes(scene.heights)
    first = scene.views[0]
    base = float(np.mean(initial, dtype=float))
    surface = Surface(coarse, base, first.position if settings.parametrisation == "ray" else None)
    start = surface.posts_from_heights(initial)
    exposures, hazes, misfits, noise = _photometry(names, samples)
    fallback = np.isnan(noise)
    brightness = np.array([np.nanmean(view.image) for view in scene.views])
    share = np.nanmedian(noise / brightness)
    noise = np.where(fallback, share * brightness, noise)
    albedo, photometry = read_known(settings.albedo, settings.exposures, cell_grid(coarse), names)
    with step(progress, "coarse grid"):
        solution = solve_surface(
            surface,
            start,
            scene.views,
            reflectance_model(settings.reflectance),
            coarse_priors(replace(priors, noise=noise), stride),
            replace(settings.solver, gain_tolerance=START_GAIN, step_tolerance=START_STEP),
            albedo,
            photometry,
            maps=False,
        )
    value = solution.value
    ratio = np.nanmedian(exposures / value.exposures)
    known = Known(
        names,
        np.where(fallback, ratio * value.exposures, exposures),
        np.where(fallback, value.hazes, hazes),
        noise,
        np.array([np.nanmedian(image) for image in value.measured]),
        np.where(fallback, np.nanmedian(misfits), misfits),
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


def named_files(files, names):
    """The same files with only the images of these names."""
    kept = [k for k, path in enumerate(files.images) if path.name in set(names)]
    cameras = tuple(files.cameras[k] for k in kept) if files.cameras else ()
    return replace(files, images=tuple(files.images[k] for k in kept), cameras=cameras)


def _samples(footprints, settings, thresholds, progress):
    """Names and solution of each window at full resolution, the scene's middle first.

    Its priors hold for the next ones, as they will for the tiles; only an image that no window
    before has seen needs the estimate of its noise.
    """
    windows = _sample_windows(footprints.grid.shape)
    found, interpolated, noise = [], 0, {}
    for window in progress(windows, "windows"):
        part = footprints.grid.cut(window)
        files = named_files(footprints.within(window), thresholds)
        try:
            scene = read_views(files, part, settings.masks, thresholds=thresholds)
        except UnreadableError:
            raise
        except LommelError:
            continue  # no image or no terrain here; the others tell
        interpolated += measured_posts(scene.heights) is not None
        names = [view.name for view in scene.views]
        initial = fill_holes(scene.heights)
        camera = scene.views[0].position if settings.parametrisation == "ray" else None
        surface = Surface(part, float(np.mean(initial, dtype=float)), camera)
        albedo, photometry = read_known(settings.albedo, settings.exposures, cell_grid(part), names)
        priors = settings.priors
        if set(names) <= set(noise):
            priors = replace(found[0][1].priors, noise=np.array([noise[name] for name in names]))
        solution = solve_surface(
            surface,
            surface.posts_from_heights(initial),
            scene.views,
            reflectance_model(settings.reflectance),
            priors,
            settings.solver,
            albedo,
            photometry,
        )
        found.append((names, solution.value))
        own = zip(names, solution.value.priors.noise, strict=True)
        noise = dict(own) | noise  # the first window that sees an image tells
    if not found:
        raise InputError(
            "None of the windows at full resolution that tell noise and exposures holds an image "
            "and terrain. Give --bounds where images and DEM lie."
        )
    if interpolated > len(found) / 2:
        raise InputError(
            "The DEM is interpolated between measured posts, which tiles cannot tell from terrain. "
            "Give more --memory, a larger --spacing or narrower --bounds, so that one tile is all."
        )
    return found


def _sample_windows(shape):
    """Windows spread over the scene, the middle one first."""
    rows, cols = (min(size, SAMPLE) for size in shape)
    begins = []
    for size, length in zip(shape, (rows, cols), strict=True):
        count = 1 if size <= SAMPLE else SAMPLES
        begins.append(np.linspace(0, size - length, count).astype(int).tolist())
    windows = [Window(row, col, rows, cols) for row in begins[0] for col in begins[1]]
    middle = windows.pop(len(windows) // 2)
    return [middle, *windows]


def _photometry(names, samples):
    """Exposure, haze, misfit and noise of each image: means over windows that see it, or NaN."""
    out = np.full((4, len(names)), np.nan)
    for k, name in enumerate(names):
        seen = [(value, found.index(name)) for found, value in samples if name in found]
        if not seen:
            continue
        weights = [np.isfinite(value.measured[j]).sum() for value, j in seen]
        out[0, k] = np.average([value.exposures[j] for value, j in seen], weights=weights)
        out[1, k] = np.average([value.hazes[j] for value, j in seen], weights=weights)
        out[2, k] = np.average([value.misfits[j] for value, j in seen], weights=weights)
        out[3, k] = seen[0][0].priors.noise[seen[0][1]]
    return out


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
