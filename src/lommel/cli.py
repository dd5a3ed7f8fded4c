"""The commands: options in, stages run, paths of products out.

stdout gets the paths of products (or what was asked to be shown), stderr the log. Exit status 0:
done, 1: a stage failed, 2: the request was wrong. Stages are imported when they run, so that
``lommel --help`` answers at once.
"""

import gc
import json
import math
import signal
import sys
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn
from rich.text import Text

from lommel import __version__
from lommel.errors import InputError, LommelError
from lommel.progress import WORTH_TELLING, Lines, count_of, seconds_left, spoken

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Albedo maps, exposures and refined terrain from orbital images of airless bodies.",
)
log = Console(stderr=True, highlight=False, emoji=False)

Images = Annotated[
    list[Path], typer.Argument(help="Rasters GDAL reads: with a CRS, or (sfs) with a camera.")
]
Dems = Annotated[
    list[Path],
    typer.Option("--dem", help="DEM, metres above the reference sphere; repeat for tiles."),
]
SunTable = Annotated[
    Path | None, typer.Option(help="Table of lines KEY x y z: the Sun, body-fixed, km or m.")
]
CraftTable = Annotated[
    Path | None, typer.Option(help="Table of lines KEY x y z: the camera, body-fixed, km or m.")
]
Cameras = Annotated[
    list[Path] | None,
    typer.Option(
        help="Camera file (ISD, .tsai, ISIS cube) of each image, in the same order; repeat. "
        "Default: the file beside the image, or its own ISIS label; else it is an orthoimage."
    ),
]
Unit = Annotated[str, typer.Option(help="Unit of the tables: auto, m or km.")]
Output = Annotated[Path, typer.Option(help="Folder for the products; made when all is done.")]
Overwrite = Annotated[bool, typer.Option(help="Replace the output folder if it exists.")]
Spacing = Annotated[float | None, typer.Option(help="Post spacing, metres. Default: the inputs'.")]
Crs = Annotated[
    str | None,
    typer.Option(help="CRS of the products: WKT, PROJ text or a code like IAU_2015:30100."),
]
Bounds = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option(
        help="xmin ymin xmax ymax in units of the CRS. Default: where images and DEM meet."
    ),
]
Reflectance = Annotated[
    str,
    typer.Option(
        help="lunar-lambert, lunar-lambert-exponential, lambert, lommel-seeliger, minnaert, hapke, "
        "or module:function."
    ),
]
Registers = Annotated[
    bool, typer.Option("--register", help="Register raw images to the DEM first.")
]
Engine = Annotated[
    str | None,
    typer.Option(
        help="Parts of a large run one after the other (serial), in processes, or by dask. "
        "Default: serial, but tiles in processes where that is quicker."
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Address of a Dask cluster that runs, like tcp://10.0.0.1:8786; --memory is then "
        "what one worker may take. Default: a cluster of this machine."
    ),
]
BY_SOLVER = "Default: as published with --solver alternating, else "
OwnReflectance = Annotated[
    str | None,
    typer.Option(help=f"Reflectance model, as for sfs. {BY_SOLVER}lunar-lambert."),
]
ShadowThreshold = Annotated[
    float | None,
    typer.Option(
        help="Image value up to which a pixel is shadow. Default: found in the histogram."
    ),
]


@app.command()
def albedo(
    images: Images,
    dem: Dems,
    output: Output,
    sun_positions: SunTable = None,
    spacecraft_positions: CraftTable = None,
    cameras: Cameras = None,
    positions_unit: Unit = "auto",
    solver: Annotated[
        str, typer.Option(help="projection, or alternating: the published iteration.")
    ] = "projection",
    loss: Annotated[
        str | None, typer.Option(help=f"cauchy, huber or least-squares. {BY_SOLVER}cauchy.")
    ] = None,
    haze: Annotated[
        bool | None, typer.Option(help=f"Estimate an offset per image. {BY_SOLVER}yes.")
    ] = None,
    phase_factor: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="c1 (per radian) and c2 of the factor exp(-c1 phase) + c2; 0 0 is no factor. "
            f"{BY_SOLVER}the Moon's."
        ),
    ] = None,
    fit_phase_factor: Annotated[
        bool | None, typer.Option(help=f"Refine c1 and c2 from the images. {BY_SOLVER}yes.")
    ] = None,
    fit_falloff: Annotated[
        bool | None, typer.Option(help=f"Estimate the lens's darker corners. {BY_SOLVER}yes.")
    ] = None,
    registers: Registers = False,
    reflectance: OwnReflectance = None,
    shadow_threshold: ShadowThreshold = None,
    spacing: Spacing = None,
    crs: Crs = None,
    bounds: Bounds = None,
    memory: Annotated[
        str | None,
        typer.Option(
            help="What the run may take, like 8GB; the products are the same. "
            "Default: 60 % of what is free."
        ),
    ] = None,
    engine: Engine = None,
    dask_scheduler: Scheduler = None,
    tiles: Annotated[
        str | None,
        typer.Option(
            help="A job of an array: 0/64 looks where images lie, then 1/64 to 64/64 share the "
            "work, and `lommel merge` writes the products."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show passes, memory, disk and time; solve nothing.")
    ] = False,
    overwrite: Overwrite = False,
):
    """Albedo map and exposures from overlapping images, projected or with cameras, and a DEM."""
    from lommel.run.albedo import albedo_settings, run_albedo
    from lommel.run.albedo_plan import plan_albedo
    from lommel.run.mixed_scene import place_scene
    from lommel.run.tiles_plan import Tiling, read_memory

    settings = albedo_settings(
        solver=solver,
        loss=loss,
        haze=haze,
        phase_factor=phase_factor,
        fit_phase_factor=fit_phase_factor,
        fit_falloff=fit_falloff,
        reflectance=reflectance,
        shadow_threshold=shadow_threshold,
    )
    files = _files(images, dem, sun_positions, spacecraft_positions, positions_unit, cameras)
    grid = _grid(spacing, crs, bounds)
    tiling = Tiling(
        None if memory is None else read_memory(memory), engine, scheduler=dask_scheduler
    )
    if dry_run:
        is_shared = tiles is not None
        typer.echo(plan_albedo(place_scene(files, grid), settings, tiling, is_shared))
        return
    if tiles is not None:
        _share_albedo(tiles, registers, files, output, settings, grid, tiling)
        return
    with _progress() as progress:
        run_albedo(files, output, settings, grid, overwrite, progress, registers, tiling)
    _finish(output)


def _share_albedo(text, registers, *request):
    from lommel.run.albedo_array import prepare_albedo, solve_albedo_share
    from lommel.run.shares import read_share, refuse_registration

    share = read_share(text)
    refuse_registration(registers)
    with _progress() as progress:
        if share.number == 0:
            count = prepare_albedo(*request, progress)
            done = f"The run is prepared: {count} images for {share.count} jobs."
        else:
            solve_albedo_share(*request, share, progress)
            done = f"Share {share} is done, and what others had left. `lommel merge` comes next."
    log.print(done, soft_wrap=True)


@app.command()
def sfs(
    images: Images,
    dem: Dems,
    output: Output,
    sun_positions: SunTable = None,
    spacecraft_positions: CraftTable = None,
    cameras: Cameras = None,
    positions_unit: Unit = "auto",
    parametrisation: Annotated[
        str,
        typer.Option(
            help="height: along the local vertical; ray: along the first image's view rays."
        ),
    ] = "height",
    terrain_roughness: Annotated[
        float | None,
        typer.Option(
            help="Change of slope from post to post, degrees rms. Default: from the images."
        ),
    ] = None,
    initial_dem_error: Annotated[
        float | None,
        typer.Option(
            help="Standard error of the DEM over its resolution, metres. Default: from the images."
        ),
    ] = None,
    initial_dem_resolution: Annotated[
        float | None,
        typer.Option(
            help="Length down to which the DEM can be trusted, metres. Default: from the images."
        ),
    ] = None,
    estimate_exposure: Annotated[
        bool, typer.Option(help="Re-estimate the exposures with the surface.")
    ] = True,
    estimate_haze: Annotated[
        bool | None,
        typer.Option(
            help="Also estimate an offset per image. Default: where the DEM is interpolated "
            "between measured posts, as altimetry is."
        ),
    ] = None,
    estimate_albedo: Annotated[
        bool, typer.Option(help="Give albedo what shading cannot explain; otherwise it is 1.")
    ] = True,
    albedo: Annotated[
        Path | None, typer.Option(help="Known albedo, as albedo.tif of a run; held fixed.")
    ] = None,
    exposures: Annotated[
        Path | None, typer.Option(help="Known exposures, as exposures.csv of a run; held fixed.")
    ] = None,
    max_steps: Annotated[int, typer.Option(min=1, help="Gauss-Newton steps on the full grid.")] = 8,
    registers: Registers = False,
    all_images: Annotated[
        bool,
        typer.Option(
            "--all-images", help="Use all images. Default: of more than 8, the best few per place."
        ),
    ] = False,
    reflectance: Reflectance = "lunar-lambert",
    shadow_threshold: ShadowThreshold = None,
    spacing: Spacing = None,
    crs: Crs = None,
    bounds: Bounds = None,
    memory: Annotated[
        str | None,
        typer.Option(
            help="What the run may take, like 8GB; a scene that needs more is solved in tiles. "
            "Default: 60 % of what is free."
        ),
    ] = None,
    engine: Engine = None,
    dask_scheduler: Scheduler = None,
    tiles: Annotated[
        str | None,
        typer.Option(
            help="A job of an array: 0/64 prepares the scene, then 1/64 to 64/64 solve a share of "
            "the tiles each, and `lommel merge` writes the products."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show tiles, memory, disk and time; solve nothing.")
    ] = False,
    report: Annotated[bool, typer.Option(help="Also draw report.html (3 s).")] = False,
    overwrite: Overwrite = False,
):
    """Refine a DEM by shape from shading (photoclinometry) in one or more images."""
    from lommel.estimate.priors import PriorSettings
    from lommel.estimate.shape_from_shading import SolverSettings
    from lommel.run.selection import survey_images
    from lommel.run.shape_from_shading import SfsSettings, run_shape_from_shading
    from lommel.run.tiles_plan import Tiling, plan_tiles, read_memory
    from lommel.scene.masks import MaskSettings

    settings = SfsSettings(
        parametrisation=parametrisation,
        reflectance=reflectance,
        priors=PriorSettings(
            None if terrain_roughness is None else math.radians(terrain_roughness),
            initial_dem_error,
            initial_dem_resolution,
        ),
        solver=SolverSettings(
            max_steps=max_steps,
            estimate_exposure=estimate_exposure,
            estimate_haze=estimate_haze,
            estimate_albedo=estimate_albedo,
        ),
        masks=MaskSettings(shadow_threshold=shadow_threshold),
        albedo=None if albedo is None else str(albedo),
        exposures=None if exposures is None else str(exposures),
        registers=registers,
        all_images=all_images,
    )
    files = _files(images, dem, sun_positions, spacecraft_positions, positions_unit, cameras)
    grid = _grid(spacing, crs, bounds)
    if tiles is not None and engine is None:
        engine = "serial"  # each share has a job's memory for itself
    tiling = Tiling(
        None if memory is None else read_memory(memory), engine, scheduler=dask_scheduler
    )
    if dry_run:
        footprints = survey_images(files, grid, settings, output)
        typer.echo(plan_tiles(footprints, tiling, output))
        return
    if tiles is not None:
        _solve_share(tiles, files, output, settings, grid, tiling)
        return
    with _progress() as progress:
        run_shape_from_shading(files, output, settings, grid, overwrite, progress, tiling)
    _finish(output, report)


def _solve_share(text, *request):
    from lommel.run.shares import read_share
    from lommel.run.tiles_array import prepare_array, solve_share

    share = read_share(text)
    with _progress() as progress:
        if share.number == 0:
            count = prepare_array(*request, progress)
            done = f"The scene is prepared: {count} tiles for {share.count} jobs."
        else:
            count = solve_share(*request, share, progress)
            done = f"Share {share} is done: {count} tile{'' if count == 1 else 's'}."
    log.print(done, soft_wrap=True)


@app.command()
def merge(
    output: Annotated[Path, typer.Argument(help="The --output of the jobs with --tiles.")],
    overwrite: Overwrite = False,
):
    """Write the products of a job array when all of its shares are solved."""
    from lommel.run.albedo_array import is_prepared, merge_albedo
    from lommel.run.tiles_array import merge_tiles

    with _progress() as progress:
        (merge_albedo if is_prepared(output) else merge_tiles)(output, overwrite, progress)
    _finish(output, draws_report=False)


@app.command()
def orthoproject(
    images: Images,
    dem: Dems,
    output: Output,
    cameras: Cameras = None,
    sun_positions: SunTable = None,
    positions_unit: Unit = "auto",
    spacing: Spacing = None,
    crs: Crs = None,
    bounds: Bounds = None,
    overwrite: Overwrite = False,
):
    """Bring raw images onto a DEM, with incidence, emission, phase and shadow at every post."""
    from lommel.run.orthoproject import run_orthoproject

    files = _files(images, dem, sun_positions, None, positions_unit, cameras)
    with _progress() as progress:
        run_orthoproject(files, output, _grid(spacing, crs, bounds), overwrite, progress)
    _finish(output, draws_report=None)


@app.command()
def register(
    images: Images,
    dem: Dems,
    output: Output,
    cameras: Cameras = None,
    sun_positions: SunTable = None,
    positions_unit: Unit = "auto",
    search_radius: Annotated[
        float, typer.Option(help="Largest offset on the ground that is looked for, metres.")
    ] = 3000.0,
    adjust: Annotated[
        str, typer.Option(help="pointing, or position: pointing and position.")
    ] = "pointing",
    reflectance: Reflectance = "lunar-lambert",
    overwrite: Overwrite = False,
):
    """Find how images sit on the terrain, and write corrected cameras (ISD) for other commands."""
    from lommel.run.register import run_register
    from lommel.run.register_to_terrain import RegistrationSettings

    settings = RegistrationSettings(search_radius, adjust, reflectance)
    files = _files(images, dem, sun_positions, None, positions_unit, cameras)
    with _progress() as progress:
        run_register(files, output, settings, overwrite, progress)
    _finish(output, draws_report=None)


@app.command()
def simulate(
    scene: Annotated[str, typer.Argument(help="Preset (apollo-orbit, sfs-patch) or SCENE.toml.")],
    output: Output,
    overwrite: Overwrite = False,
):
    """Make a scene with a known answer: truth, initial DEM, orthoimages, position tables."""
    from lommel.run.simulate import run_simulate

    with _progress() as progress:
        run_simulate(scene, output, overwrite, progress)
    typer.echo(output)


@app.command()
def demo(
    output: Annotated[Path, typer.Option(help="Folder for scene and products.")] = Path("demo"),
    overwrite: Overwrite = False,
):
    """Simulate an orbit strip and run everything on it: the errors are known."""
    from lommel.run.demo import run_demo

    with _progress() as progress:
        run_demo(output, overwrite, progress)
    _finish(output)


@app.command()
def evaluate(
    product: Annotated[Path, typer.Argument(help="DEM or albedo map (GeoTIFF).")],
    reference: Annotated[
        Path,
        typer.Option(help="Raster, or CSV of points longitude_deg,latitude_deg,height_m."),
    ],
    border: Annotated[int, typer.Option(min=0, help="Posts left out along each edge.")] = 0,
    quantity: Annotated[str, typer.Option(help="height or albedo.")] = "height",
    json_path: Annotated[Path | None, typer.Option("--json", help="Also write a file.")] = None,
):
    """Compare a product with a reference."""
    from lommel.run.evaluate import evaluate_product

    errors = evaluate_product(product, reference, border, quantity, json_path)
    for name, value in errors.items():
        typer.echo(f"{name:20} {value:.6g}")


@app.command()
def info(
    files: Annotated[list[Path], typer.Argument(help="Images or other rasters.")],
    sun_positions: SunTable = None,
    spacecraft_positions: CraftTable = None,
    cameras: Cameras = None,
    pixel: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="SAMPLE LINE of one image, 0.5 0.5 being the first pixel's centre: show the "
            "ground point, and incidence, emission and phase there."
        ),
    ] = None,
    dem: Annotated[
        Path | None, typer.Option(help="DEM on which --pixel looks. Default: the sphere.")
    ] = None,
    kernels: Annotated[
        Path | None,
        typer.Option(
            help="SPICE meta-kernel: the cameras come from it and the images' ISIS labels, "
            "without spiceinit."
        ),
    ] = None,
    write_isd: Annotated[
        Path | None, typer.Option(help="Write the camera of one image as ISD (JSON).")
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print JSON: a list of objects, with --pixel one object."),
    ] = False,
):
    """Show what an image holds: size, place, spacing, camera; where Sun and spacecraft stand."""
    from lommel.run.ground_point import describe_pixel
    from lommel.run.info import describe, named_cameras, write_camera

    if len(files) > 1 and not (pixel is None and write_isd is None):
        raise InputError(f"--pixel and --write-isd take one image; {len(files)} are given.")
    if dem is not None and pixel is None:
        raise InputError("--dem tells where --pixel looks; give --pixel SAMPLE LINE too.")
    named = named_cameras(files, cameras, kernels)
    if pixel is not None:
        facts = [describe_pixel(files[0], *pixel, dem, named[0], sun_positions)]
    else:
        facts = [
            describe(path, sun_positions, spacecraft_positions, camera)
            for path, camera in zip(files, named, strict=True)
        ]
    if write_isd is not None:
        write_camera(write_isd, files[0], named[0])
    if as_json:
        typer.echo(json.dumps(facts if pixel is None else facts[0], indent=1))
        return
    for fact in facts:
        for name, value in fact.items():
            typer.echo(f"{name:24} {value}")
        typer.echo("")


@app.command()
def report(folder: Annotated[Path, typer.Argument(help="Folder of a run.")]):
    """Draw the figures and write report.html again."""
    from lommel.report import write_report

    typer.echo(write_report(folder))


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
):
    if version:
        typer.echo(f"lommel {__version__}")
        raise typer.Exit


def main():
    """Run the command line and turn errors into messages and exit status."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that half a run is cleared away
    # looking for cycles among the million objects of imports and compiled code takes a tenth of a
    # short run; arrays are not in cycles and go at once
    gc.disable()
    try:
        app(prog_name="lommel")
    except InputError as error:
        log.print(f"[bold red]error[/] {escape(str(error))}", soft_wrap=True)
        sys.exit(2)
    except LommelError as error:
        log.print(f"[bold red]failed[/] {escape(str(error))}", soft_wrap=True)
        sys.exit(1)


def _files(images, dems, sun_positions, spacecraft_positions, unit, cameras=None):
    from lommel.run.inputs import SceneFiles

    return SceneFiles(
        tuple(images), tuple(dems), sun_positions, spacecraft_positions, unit, tuple(cameras or ())
    )


def _grid(spacing, crs, bounds):
    from lommel.run.inputs import GridSettings

    return GridSettings(spacing, crs, bounds)


@contextmanager
def _progress():
    """A function (items, name) that shows how far a step is: bars on a terminal, lines in a log."""
    if not log.is_terminal:
        yield Lines(lambda line: log.print(line, soft_wrap=True))
        return
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Times()
    with Progress(*columns, console=log) as bars:
        yield partial(_bar, bars)


def _bar(bars, items, name, total=None, at_once=1):
    start = time.monotonic()
    task = bars.add_task(name, total=count_of(items, total), at_once=at_once, last=0.0)
    for item in items:
        yield item
        bars.update(task, advance=1, last=time.monotonic() - start)
    if time.monotonic() - start < WORTH_TELLING:
        bars.remove_task(task)


class _Times(ProgressColumn):
    """Time so far, and time left by the parts that are done."""

    def render(self, task):
        elapsed = task.finished_time if task.finished else task.elapsed
        so_far = spoken(elapsed or 0.0)
        if task.finished or not task.completed or task.total is None:
            return Text(so_far)
        last = task.fields["last"]
        left = (
            last - elapsed + seconds_left(task.completed, task.total, last, task.fields["at_once"])
        )
        return Text(f"{so_far}, {spoken(max(left, 0.0))} left")


def _finish(output, draws_report=True):
    """Print outcome, results and skipped images, and the paths of the products.

    ``draws_report`` is None for products that have no figures.
    """
    record = json.loads((output / "run.json").read_text(encoding="utf-8"))
    for skip in record["skipped"]:
        log.print(f"[yellow]left out[/] {escape(skip['reason'])}", soft_wrap=True)
    if record["not_chosen"]:
        count = len(record["not_chosen"])
        log.print(f"not chosen {count} images: exposures.csv tells why", soft_wrap=True)
    log.print(escape(record["outcome"]["sentence"]), soft_wrap=True)
    for name, value in record["results"].items():
        log.print(
            f"  {name:40} {value:.5g}" if isinstance(value, float) else f"  {name:40} {value}"
        )
    for path in sorted(output.glob("*.tif")):
        typer.echo(path)
    if draws_report:
        from lommel.report import write_report

        typer.echo(write_report(output))
    elif draws_report is False:
        log.print(f"lommel report {escape(str(output))} draws the figures.", soft_wrap=True)
