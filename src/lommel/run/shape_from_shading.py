"""The stage `lommel sfs`: images, positions and a DEM in, a refined DEM out.

Most callers want `run_shape_from_shading`.
"""

import csv
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from affine import Affine

from lommel.core.reflectance import reflectance_model
from lommel.errors import InputError
from lommel.estimate.holes import fill_holes
from lommel.estimate.measured_posts import measured_posts
from lommel.estimate.priors import PriorSettings
from lommel.estimate.problem import lambert_image
from lommel.estimate.shape_from_shading import SolverSettings, correlation, solve_surface
from lommel.estimate.surface import Surface
from lommel.io.raster import write_raster
from lommel.progress import silent, step
from lommel.run.inputs import GridSettings, SceneFiles
from lommel.run.photometry import read_known
from lommel.run.products import RunRecord, output_folder
from lommel.run.selection import survey_images
from lommel.run.tiles_plan import plan_tiles, work_folder
from lommel.run.views import read_views
from lommel.scene.grid import Grid
from lommel.scene.masks import MaskSettings

PARAMETRISATIONS = ("height", "ray")
DOUBTFUL = 0.3  # correlation with the DEM's image below which an image is checked, for a second
FADING = 10.0  # posts beyond the images' edge over which their say fades
LEAST_POSTS = 33  # rows and columns: three octaves of wavelengths


@dataclass(frozen=True)
class SfsSettings:
    """What `lommel sfs` can be told; the defaults need no telling.

    Attributes
    ----------
    parametrisation : {'height', 'ray'}
        Along the local vertical, or along the view rays of the first image.
    reflectance : str
        Name of a reflectance model.
    priors : PriorSettings
    solver : SolverSettings
    masks : MaskSettings
    albedo, exposures : str or None
        Map and table of an earlier run, held fixed.
    registers : bool
        Register raw images to the DEM first; otherwise they are only checked.
    all_images : bool
        Use all images; otherwise, where there are many, the best few of each place.
    """

    parametrisation: str = "height"
    reflectance: str = "lunar-lambert"
    priors: PriorSettings = field(default_factory=PriorSettings)
    solver: SolverSettings = field(default_factory=SolverSettings)
    masks: MaskSettings = field(default_factory=MaskSettings)
    albedo: str | None = None
    exposures: str | None = None
    registers: bool = False
    all_images: bool = False

    @property
    def knows_albedo(self):
        """True when albedo is nothing that the images have to tell."""
        return self.albedo is not None or not self.solver.estimate_albedo


def run_shape_from_shading(
    files: SceneFiles,
    output,
    settings: SfsSettings | None = None,
    grid_settings: GridSettings | None = None,
    overwrite: bool = False,
    progress=silent,
    tiling=None,
):
    """Refine a DEM by the shading in images and write the products.

    A scene that does not fit in memory is solved in tiles (`lommel.run.tiles`).

    Parameters
    ----------
    files : SceneFiles
    output : path
        Folder that appears when the run is done.
    settings : SfsSettings, optional
    grid_settings : GridSettings, optional
    overwrite : bool
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.
    tiling : Tiling, optional
        Memory, engine and size of tiles.

    Returns
    -------
    results : dict of str to number
        As in ``run.json``.
    """
    settings = settings or SfsSettings()
    if settings.parametrisation not in PARAMETRISATIONS:
        raise InputError(
            f"parametrisation = {settings.parametrisation!r} is not known. Choose height or ray."
        )
    model = reflectance_model(settings.reflectance)
    record = RunRecord("sfs", asdict(settings) | {"grid": asdict(grid_settings or GridSettings())})
    with output_folder(output, overwrite, work_folder(output)) as folder:
        with record.stage("read"):
            settled, lost, remark = _settled(files, folder, settings.registers, progress)
            with step(progress, "footprints"):
                footprints = survey_images(settled, grid_settings, settings, output)
            if plan_tiles(footprints, tiling, output).is_tiled:
                from lommel.run.tiles import run_tiles  # and what it needs to share work

                return run_tiles(
                    files,
                    footprints,
                    lost,
                    folder,
                    output,
                    settings,
                    grid_settings,
                    tiling,
                    progress,
                )
            used, grid = footprints.used, footprints.grid
            scene = read_views(used, grid, settings.masks, progress=progress)
            tables = (files.sun_positions, files.spacecraft_positions)
            inputs = [*files.images, *files.dems, *files.cameras, *filter(None, tables)]
            record.add_inputs(inputs, progress, footprints.unused(files))
            record.add_skipped([*lost, *footprints.skipped, *scene.skipped])
            record.add_not_chosen(footprints.not_chosen)
            _refuse_small(scene.grid)
            names = [view.name for view in scene.views]
            cells = cell_grid(scene.grid)
            albedo, photometry = read_known(settings.albedo, settings.exposures, cells, names)
            record.add_inputs([*filter(None, (settings.albedo, settings.exposures))])
        with record.stage("solve"), step(progress, "surface"):
            known = np.isfinite(scene.heights)
            measured = measured_posts(scene.heights)
            initial = fill_holes(
                scene.heights if measured is None else np.where(measured, scene.heights, np.nan)
            )
            surface = _surface(scene.grid, initial, scene.views[0], settings.parametrisation)
            start = surface.posts_from_heights(initial)
            solution = solve_surface(
                surface,
                start,
                scene.views,
                model,
                settings.priors,
                settings.solver,
                albedo,
                photometry,
                measured,
            )
        if not settings.registers:
            remark = _doubt(files, scene.views, solution.value.correlations, folder)
        with record.stage("write"), step(progress, "products"):
            refined = surface.heights_from_posts(solution.value.u)
            seen = seen_posts(solution.value.measured)
            if measured is not None:
                refined = faded(refined, scene.heights, seen)
            refined[~(known | seen)] = np.nan
            residual = relative_residual(solution.value)
            _write_products(folder, scene, initial, refined, solution.value, residual)
            write_exposures(folder, scene.views, record, solution.value)
        record.results = _results(scene, refined, solution.value, residual) | footprints.results
        record.history = solution.history
        record.outcome = {"name": solution.outcome, "sentence": solution.advice + remark}
        record.write(folder)
    return record.results


def _settled(files, folder, registers, progress):
    """Files with registered cameras, images lost on the way, and a remark."""
    if not registers:
        return files, [], ""
    from lommel.run.register import settle_cameras  # slow to import

    return settle_cameras(files, folder, registers, progress=progress)


def _doubt(files, views, correlations, folder):
    """A remark on raw images that look little like the DEM, when they do not lie on it."""
    pairs = zip(views, correlations, strict=True)
    doubtful = {v.name for v, r in pairs if not v.is_projected and not r > DOUBTFUL}
    if not doubtful:
        return ""
    from lommel.run.register import settle_cameras

    kept = [k for k, path in enumerate(files.images) if path.name in doubtful]
    cameras = tuple(files.cameras[k] for k in kept) if files.cameras else ()
    images = tuple(files.images[k] for k in kept)
    return settle_cameras(replace(files, images=images, cameras=cameras), folder)[2]


def _refuse_small(grid):
    rows, cols = grid.shape
    if min(rows, cols) < LEAST_POSTS:
        raise InputError(
            f"DEM and images share {rows} x {cols} posts, {LEAST_POSTS} along each side are "
            "needed to tell terrain from noise. Give a smaller --spacing or wider --bounds."
        )


def _surface(grid, heights, first, parametrisation):
    camera = first.position if parametrisation == "ray" else None
    return Surface(grid, float(np.mean(heights, dtype=float)), camera)


def seen_posts(images):
    """Posts whose four cells some image sees."""
    seen = np.any([np.isfinite(image) for image in images], axis=0)
    padded = np.pad(seen, 1, mode="edge")
    return padded[1:, 1:] & padded[1:, :-1] & padded[:-1, 1:] & padded[:-1, :-1]


def faded(refined, initial, seen):
    """Refined heights that go over into the initial ones where no image sees the ground.

    Parameters
    ----------
    refined, initial : float32 array (rows, cols), m
        ``initial`` is NaN in holes.
    seen : bool array (rows, cols)

    Returns
    -------
    heights : float32 array (rows, cols), m
    """
    from scipy.ndimage import distance_transform_edt  # slow to import, and rarely needed

    share = np.exp(-distance_transform_edt(~seen) / FADING).astype(np.float32)
    return np.where(np.isfinite(initial), share * refined + (1 - share) * initial, refined)


def _write_products(folder, scene, initial, refined, surface, residual):
    grid, view = scene.grid, scene.views[0]
    cells = cell_grid(grid)
    shade = "cosine of incidence", "1"
    products = {
        "dem": lambda: (refined, grid, "height", "m"),
        "initial-dem": lambda: (scene.heights, grid, "height", "m"),
        "measured": lambda: (surface.measured[0], cells, "measured brightness"),
        "modelled": lambda: (_modelled_where_measured(surface), cells, "modelled brightness"),
        "albedo": lambda: (surface.albedo, cells, "albedo"),
        "separation": lambda: (
            surface.separation,
            cells,
            "slope signal left by a free albedo",
            "1",
        ),
        "residual": lambda: (residual, cells, "rms of modelled - measured", "percent"),
        "hillshade-before": lambda: (hillshade(grid, initial, view), cells, *shade),
        "hillshade-after": lambda: (hillshade(grid, refined, view), cells, *shade),
    }
    for name, product in products.items():  # not in threads, see `tiles_products`
        write_raster(folder / f"{name}.tif", *product())


def _modelled_where_measured(surface):
    measured = surface.measured[0]
    return np.where(np.isfinite(measured), surface.modelled[0], np.float32(np.nan))


def cell_grid(grid):
    """The grid whose posts are the centres of this grid's cells."""
    affine = grid.affine @ Affine.translation(0.5, 0.5)
    return Grid((grid.shape[0] - 1, grid.shape[1] - 1), affine, grid.crs, grid.body)


def hillshade(grid, heights, view):
    """Cosine of incidence under an image's own Sun, 0 where turned away.

    Parameters
    ----------
    grid : Grid
    heights : float32 array (rows, cols), m
    view : OrthoView or CameraView

    Returns
    -------
    shade : float32 array (rows - 1, cols - 1), dimensionless; NaN beside holes
    """
    surface = Surface(grid, float(np.nanmean(heights, dtype=float)))
    known = np.isfinite(heights)
    u = np.where(known, surface.posts_from_heights(heights), np.float32(0))
    all_known = known[1:, 1:] & known[1:, :-1] & known[:-1, 1:] & known[:-1, :-1]
    return np.where(all_known, lambert_image(surface, u, view), np.float32(np.nan))


def relative_residual(surface):
    """Root mean square of modelled - measured over the images, per cent of the median image.

    Parameters
    ----------
    surface : SurfaceSolution

    Returns
    -------
    residual : float32 array (rows - 1, cols - 1), per cent; NaN where no image counts
    """
    total = np.zeros_like(surface.measured[0])
    count = np.zeros(total.shape, np.uint16)
    for measured, modelled in zip(surface.measured, surface.modelled, strict=True):
        difference = (modelled - measured) * np.float32(100 / np.nanmedian(measured[::4, ::4]))
        known = np.isfinite(difference)
        total[known] += difference[known] ** 2
        count += known
    return np.sqrt(total / np.where(count > 0, count, np.nan).astype(np.float32))


def write_exposures(folder, views, record, surface):
    """Write ``exposures.csv``: a line per image, and the reasons of those not used.

    Parameters
    ----------
    folder : Path
    views : list
        Of objects with a ``name``.
    record : RunRecord
    surface : SurfaceSolution
        Or another object with ``exposures``, ``hazes`` and ``misfits``.
    """
    with open(folder / "exposures.csv", "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["image", "exposure", "haze", "residual_sigma", "used", "reason"])
        for k, view in enumerate(views):
            exposure, haze = float(surface.exposures[k]), float(surface.hazes[k])
            writer.writerow([view.name, exposure, haze, float(surface.misfits[k]), 1, ""])
        for skip in [*record.skipped, *record.not_chosen]:
            writer.writerow([skip["image"], "", "", "", 0, skip["reason"]])


def _results(scene, refined, surface, residual):
    change = refined - scene.heights
    shading = (model / surface.albedo for model in surface.modelled)
    priors = surface.priors
    brightness = [np.nanmedian(image) for image in surface.measured]
    return {
        "images": len(surface.measured),
        "image_correlation_before": float(np.mean(surface.correlations)),
        "image_correlation_after": _mean_correlation(surface.measured, surface.modelled),
        "image_correlation_without_albedo": _mean_correlation(surface.measured, shading),
        "image_residual_percent": float(np.sqrt(np.nanmean(residual**2))),
        "height_change_rms_m": float(np.sqrt(np.nanmean(change**2))),
        "noise_percent": float(100 * np.mean(priors.noise / brightness)),
        "terrain_roughness_deg": float(np.degrees(priors.roughness)),
        "albedo_contrast_percent": float(100 * priors.albedo_contrast),
    }


def _mean_correlation(measured, modelled):
    return float(np.mean([correlation(*pair) for pair in zip(measured, modelled, strict=True)]))
