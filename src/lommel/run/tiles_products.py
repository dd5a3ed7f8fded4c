"""The products of a scene in tiles: blended window by window, with one record.

Most callers want `finish_products`.
"""

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from lommel.io.raster import raster_writer
from lommel.progress import silent, step
from lommel.run.apart import call_apart
from lommel.run.inputs import Skipped
from lommel.run.machine import cores
from lommel.run.records import read_array, read_record
from lommel.run.shape_from_shading import cell_grid, write_exposures
from lommel.run.tiles_plan import AT_REST, BLEND, Plan, blend_weights
from lommel.run.tiles_records import part_folder
from lommel.run.tiles_settle import settle_tiles
from lommel.run.tiles_solve import at_posts, stored_window
from lommel.scene.grid import Grid, Window

PRODUCTS = {  # description and unit, as of a scene in one piece
    "dem": ("height", "m"),
    "initial-dem": ("height", "m"),
    "measured": ("measured brightness", ""),
    "modelled": ("modelled brightness", ""),
    "albedo": ("albedo", ""),
    "separation": ("slope signal left by a free albedo", "1"),
    "residual": ("rms of modelled - measured", "percent"),
    "hillshade-before": ("cosine of incidence", "1"),
    "hillshade-after": ("cosine of incidence", "1"),
}
MEASURED = ("dem", "residual")  # their root mean squares are results
ON_POSTS = ("dem", "initial-dem")  # the others live on the cells between posts
WORTH_PROCESSES = 3e7  # posts; what a process takes to start is then little against its work
WRITING = 200e6  # bytes that GDAL takes in a process that writes
HELD = 8  # floats of a window that is written, and of its squares


def size_on_disk(tile, shape):
    """Bytes that the arrays of a tile take until all are done.

    Parameters
    ----------
    tile : Tile
    shape : tuple of int
        Of the scene.
    """
    window = stored_window(tile, shape)
    return np.dtype(np.float32).itemsize * len(PRODUCTS) * window.rows * window.cols


def finish_products(run, work, folder, record, known, progress=silent):
    """Write rasters and ``exposures.csv`` from the tiles, and fill in the record of the run.

    Parameters
    ----------
    run : TiledRun
        All of whose tiles are done.
    work : Path
        Folder of the tiles.
    folder : Path
        That the products are written to.
    record : RunRecord
    known : Known
    progress : callable
    """
    scene = read_record(work / "scene")
    tiles = [read_record(part_folder(work, tile.number)) for tile in run.plan.tiles]
    record.add_skipped([Skipped(**skip) for skip in scene["skipped"]])
    record.add_not_chosen(run.footprints.not_chosen)
    with step(progress, "long waves"):
        correction, exposures = settle_tiles(run, work, known)
    sums = _write_products(folder, run.grid, run.plan, work, correction, progress)
    fit = SimpleNamespace(
        exposures=exposures, hazes=known.hazes, misfits=_misfits(known.names, tiles)
    )
    views = [SimpleNamespace(name=name) for name in known.names]
    write_exposures(folder, views, record, fit)
    record.results = _results(known, tiles, sums) | run.footprints.results
    record.history = scene["history"]
    record.outcome = _outcome(scene, tiles)
    record.settings["tiles"] = [
        _summary(tile, r) for tile, r in zip(run.plan.tiles, tiles, strict=True)
    ]


def _write_products(folder, grid, plan, work, correction, progress):
    """Blend the tiles into rasters; root mean squares for the results.

    In processes where that is worth their start, not in threads: of two files that threads write at
    once GDAL 3.10 leaves blocks of one in a hundred without data when the machine is busy.
    """
    jobs = [
        _Writing(name, folder, grid, plan, work, correction if name == "dem" else None)
        for name in PRODUCTS
    ]
    workers = _writers(plan)
    if workers == 1:
        sums = [_write_product(job) for job in progress(jobs, "products")]
    else:
        rasters = call_apart(_write_product, jobs, workers)
        sums = list(progress(rasters, "products", len(jobs), workers))
    return dict(zip(PRODUCTS, sums, strict=True))


def _writers(plan):
    """Processes that write products: as many as cores and the memory of the run have room for."""
    if plan.shape[0] * plan.shape[1] < WORTH_PROCESSES:
        return 1
    rows, cols = plan.tiles[0].inner.shape
    each = AT_REST + WRITING + HELD * np.dtype(np.float32).itemsize * rows * cols
    return int(np.clip((plan.memory - AT_REST) // each, 1, cores()))


@dataclass(frozen=True)
class _Writing:
    """What it takes to write one product."""

    name: str
    folder: Path
    grid: Grid
    plan: Plan
    work: Path
    correction: np.ndarray | None  # of heights, on coarse posts


def _write_product(job):
    """Blend one product window by window; its root mean square where that is asked for."""
    name, grid, plan, work = job.name, job.grid, job.plan, job.work
    frame, count, total = grid if name in ON_POSTS else cell_grid(grid), 0, 0.0
    with raster_writer(job.folder / f"{name}.tif", frame, *PRODUCTS[name]) as write:
        for tile in plan.tiles:
            window = tile.inner.intersection(frame.window)
            if window.is_empty:
                continue
            values = _blended(name, window, plan, work)
            if job.correction is not None:
                values += at_posts(job.correction, plan.stride, window)
            write(values, window)
            if name == "dem":
                values -= _blended("initial-dem", window, plan, work)
            if name not in MEASURED:
                continue
            known = np.isfinite(values)
            total += float(np.sum(values[known].astype(float) ** 2))
            count += int(known.sum())
    return (total / max(count, 1)) ** 0.5


def _blended(name, window, plan, work):
    """A product in a window: the tiles that reach it, each with its share."""
    out = np.empty(window.shape, np.float32)
    for part in _pieces(window):
        out[part.relative_to(window).slices] = _blended_piece(name, part, plan, work)
    return out


def _pieces(window):
    """The middle of a tile, where it is alone, and what is around it."""
    rim = BLEND // 2
    if min(window.shape) <= 2 * rim:
        return [window]
    row, col, rows, cols = window.row, window.col, window.rows, window.cols
    inner = rows - 2 * rim
    return [
        Window(row, col, rim, cols),
        Window(row + rows - rim, col, rim, cols),
        Window(row + rim, col, inner, rim),
        Window(row + rim, col + cols - rim, inner, rim),
        Window(row + rim, col + rim, inner, cols - 2 * rim),
    ]


def _blended_piece(name, window, plan, work):
    reaching = [t for t in plan.tiles if not _common(t, window, plan).is_empty]
    if len(reaching) == 1:
        kept = stored_window(reaching[0], plan.shape)
        part = part_folder(work, reaching[0].number)
        return read_array(part, name)[window.relative_to(kept).slices]
    total, share = np.zeros(window.shape, np.float32), np.zeros(window.shape, np.float32)
    for tile in reaching:
        common = _common(tile, window, plan)
        kept = stored_window(tile, plan.shape)
        values = read_array(part_folder(work, tile.number), name)[common.relative_to(kept).slices]
        weights = np.where(np.isfinite(values), blend_weights(tile, common, plan.shape), 0)
        inside = common.relative_to(window).slices
        total[inside] += np.where(weights > 0, weights * values, 0)
        share[inside] += weights
    return np.where(share > 0, total / np.where(share > 0, share, 1), np.nan).astype(np.float32)


def _common(tile, window, plan):
    """What a tile knows of a window."""
    return window.intersection(stored_window(tile, plan.shape))


def _misfits(names, tiles):
    """Root mean square residual of each image over its tiles, in noise standard errors."""
    totals, counts = np.zeros(len(names)), np.zeros(len(names))
    for record in tiles:
        for name, cells, misfit in zip(
            record.get("images", []),
            record.get("cells", []),
            record.get("misfits", []),
            strict=True,
        ):
            totals[names.index(name)] += cells * misfit**2
            counts[names.index(name)] += cells
    return np.sqrt(totals / np.maximum(counts, 1))


def _results(known, tiles, sums):
    solved = [record for record in tiles if "images" in record]
    cells = [sum(record["cells"]) for record in solved]
    mean = {
        f"image_{name}": float(np.average([record[name] for record in solved], weights=cells))
        for name in ("correlation_before", "correlation_after")
        if sum(cells)
    }
    return {
        "images": len(known.names),
        "tiles": len(tiles),
        **mean,
        "image_residual_percent": sums["residual"],
        "height_change_rms_m": sums["dem"],
        "noise_percent": float(100 * np.mean(known.noise / known.brightness)),
        "terrain_roughness_deg": float(np.degrees(known.priors.roughness)),
        "albedo_contrast_percent": float(100 * known.priors.albedo_contrast),
    }


def _outcome(scene, tiles):
    """The outcome that most tiles share; the worst that the whole scene shows comes first."""
    if scene["outcome"] not in ("converged", "step_limit"):
        return {"name": scene["outcome"], "sentence": scene["sentence"]}
    counts = Counter(record["outcome"] for record in tiles)
    listing = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.most_common())
    solved = counts.copy()
    del solved["unseen"]
    name = "converged" if set(solved) <= {"converged"} else solved.most_common(1)[0][0]
    return {"name": name, "sentence": f"{len(tiles)} tiles: {listing}."}


def _summary(tile, record):
    """What run.json tells of a tile."""
    told = ("outcome", "sentence", "seconds", "peak_memory_mb", "images", "skipped")
    kept = {name: record[name] for name in told if name in record}
    return {"tile": tile.number, "window": asdict(tile.inner)} | kept
