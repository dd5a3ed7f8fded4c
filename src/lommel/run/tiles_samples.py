"""Windows at full resolution, spread over a large scene, that tell what all its tiles share.

Each is solved for itself: exposures, priors, and what is left of the images on coarse posts by a
surface that is right, which is far more than their noise. Most callers want `solve_samples` and
`photometry`.
"""

from dataclasses import dataclass, replace

import numpy as np

from lommel.core.reflectance import reflectance_model
from lommel.errors import InputError, LommelError, UnreadableError
from lommel.estimate.holes import fill_holes
from lommel.estimate.measured_posts import measured_posts
from lommel.estimate.problem import coarse_cells, coarse_posts, fresh_problem
from lommel.estimate.shape_from_shading import SurfaceSolution, solve_surface
from lommel.estimate.surface import Surface
from lommel.progress import silent
from lommel.run.photometry import read_known
from lommel.run.shape_from_shading import cell_grid
from lommel.run.tiles_plan import coarse_grid
from lommel.run.views import read_views
from lommel.scene.grid import Window

SAMPLE = 513  # posts along each side of a window
SAMPLES = 3  # of them along each side of a larger scene


@dataclass(frozen=True)
class Sample:
    """What a window tells.

    Attributes
    ----------
    names : list of str
        Images that see it.
    value : SurfaceSolution
        At full resolution.
    coarse_misfits : array (images,), image units
        Root mean square residual on coarse posts; NaN where none sees it.
    """

    names: list
    value: SurfaceSolution
    coarse_misfits: np.ndarray


@dataclass(frozen=True)
class Photometry:
    """What the windows that see an image tell of it; NaN where none does.

    Exposures, hazes and misfits are means, coarse misfits medians; noise is that of the first one.

    Attributes
    ----------
    exposures, hazes, noise : array (images,), image units
    misfits : array (images,), noise standard errors
        Residuals at full resolution.
    coarse_misfits : array (images,), image units
        Residuals on coarse posts: there a cell's mean brightness is not that of its mean slope.
    """

    exposures: np.ndarray
    hazes: np.ndarray
    noise: np.ndarray
    misfits: np.ndarray
    coarse_misfits: np.ndarray


def solve_samples(footprints, stride, settings, thresholds, progress=silent):
    """Solve each window, the scene's middle first.

    Its priors hold for the next ones, as they will for the tiles; only an image that no window
    before has seen needs the estimate of its noise.

    Parameters
    ----------
    footprints : Footprints
        On the grid of full resolution.
    stride : int
        Posts per post of the coarse grid.
    settings : SfsSettings
    thresholds : dict of str to float, image units
        Up to which a pixel of an image is shadow.
    progress : callable

    Returns
    -------
    samples : list of Sample
    """
    found, interpolated, noise = [], 0, {}
    for window in progress(_windows(footprints.grid.shape, stride), "windows"):
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
        albedo, known = read_known(settings.albedo, settings.exposures, cell_grid(part), names)
        priors = settings.priors
        if set(names) <= set(noise):
            priors = replace(found[0].value.priors, noise=np.array([noise[n] for n in names]))
        solution = solve_surface(
            surface,
            surface.posts_from_heights(initial),
            scene.views,
            reflectance_model(settings.reflectance),
            priors,
            settings.solver,
            albedo,
            known,
        )
        left = _coarse_misfits(files, surface, stride, settings, thresholds, names, solution.value)
        found.append(Sample(names, solution.value, left))
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


def _windows(shape, stride):
    """Windows spread over the scene, the middle one first; they begin at coarse posts."""
    rows, cols = (min(size, SAMPLE) for size in shape)
    begins = []
    for size, length in zip(shape, (rows, cols), strict=True):
        count = 1 if size <= SAMPLE else SAMPLES
        first = np.linspace(0, size - length, count).astype(int) // stride * stride
        begins.append(first.tolist())
    windows = [Window(row, col, rows, cols) for row in begins[0] for col in begins[1]]
    middle = windows.pop(len(windows) // 2)
    return [middle, *windows]


def _coarse_misfits(files, surface, stride, settings, thresholds, names, value):
    """Root mean square residual of each image on coarse posts, given the surface and its albedo."""
    out = np.full(len(names), np.nan)
    coarse = coarse_grid(surface.grid, stride)
    try:
        scene = read_views(files, coarse, settings.masks, thresholds=thresholds)
    except UnreadableError:
        raise
    except LommelError:
        return out
    u, albedo = value.u, value.albedo
    for _ in range(stride.bit_length() - 1):
        u, albedo = coarse_posts(u), coarse_cells(albedo)
    on_coarse = replace(surface, grid=coarse)
    level = fresh_problem(
        on_coarse,
        on_coarse.posts_from_heights(fill_holes(scene.heights)),
        scene.views,
        reflectance_model(settings.reflectance),
        np.nan_to_num(albedo, nan=1.0),
    )
    places = [names.index(view.name) for view in scene.views]
    level.exposures, level.hazes = value.exposures[places], value.hazes[places]
    level.see(u)
    for k, place in enumerate(places):
        residual = level.cells[k] - level.predict(u, k)
        if np.isfinite(residual).any():
            out[place] = np.nanmean(residual.astype(float) ** 2) ** 0.5
    return out


def photometry(names, samples):
    """What windows tell of images.

    Parameters
    ----------
    names : list of str
    samples : list of Sample

    Returns
    -------
    found : Photometry
    """
    out = np.full((5, len(names)), np.nan)
    for k, name in enumerate(names):
        seen = [(sample, sample.names.index(name)) for sample in samples if name in sample.names]
        if not seen:
            continue
        weights = [np.isfinite(sample.value.measured[j]).sum() for sample, j in seen]
        for row, field in enumerate(("exposures", "hazes", "misfits")):
            values = [getattr(sample.value, field)[j] for sample, j in seen]
            out[row, k] = np.average(values, weights=weights)
        first, j = seen[0]
        out[3, k] = first.value.priors.noise[j]
        left = [sample.coarse_misfits[j] for sample, j in seen]
        out[4, k] = np.median([misfit for misfit in left if np.isfinite(misfit)] or [np.nan])
    exposures, hazes, misfits, noise, coarse = out
    return Photometry(exposures, hazes, noise, misfits, coarse)


def named_files(files, names):
    """The same files with only the images of these names."""
    kept = [k for k, path in enumerate(files.images) if path.name in set(names)]
    cameras = tuple(files.cameras[k] for k in kept) if files.cameras else ()
    return replace(files, images=tuple(files.images[k] for k in kept), cameras=cameras)
