"""Shape from shading of scenes that do not fit in memory: tile after tile, and one answer.

The scene is prepared as a whole (`lommel.run.tiles_solve`), its tiles are solved by an engine, and
their products blended into rasters window by window. What is done stays in a hidden folder beside
the output until all is done, so that a run that was broken off goes on where it was. Most callers
want `run_tiles`.
"""

import json
import os
import shutil
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from multiprocessing import get_context
from types import SimpleNamespace

import numpy as np

from lommel.errors import LommelError
from lommel.estimate.priors import Priors
from lommel.io.raster import raster_writer
from lommel.run.inputs import GridSettings, Skipped
from lommel.run.products import RunRecord, peak_memory_mb
from lommel.run.shape_from_shading import cell_grid, write_exposures
from lommel.run.tiles_plan import Tiling, blend_weights, plan_tiles, work_folder
from lommel.run.tiles_records import (
    clear_partial,
    digest_of,
    is_done,
    read_array,
    read_record,
    save_part,
)
from lommel.run.tiles_solve import Known, prepare_scene, solve_tile, stored_window
from lommel.run.views import view_grid

ARRAYS = [
    "exposures",
    "hazes",
    "noise",
    "brightness",
    "misfits",
    "thresholds",
    "correction",
    "position",
    "sun_position",
]
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
ON_POSTS = ("dem", "initial-dem")  # the others live on the cells between posts


def run_tiles(
    files, settled, lost, folder, output, settings, grid_settings, tiling=None, progress=iter
):
    """Refine a DEM tile by tile and write the products.

    Parameters
    ----------
    files, settled : SceneFiles
        As given, and with registered cameras.
    lost : list of Skipped
        Images lost on the way.
    folder : Path
        That the products are written to.
    output : path
        Of the run; its tiles wait beside it.
    settings : SfsSettings
    grid_settings : GridSettings or None
    tiling : Tiling, optional
    progress : callable
        Wraps the iterables of images and of tiles.

    Returns
    -------
    results : dict of str to number
    """
    tiling = tiling or Tiling()
    record = RunRecord("sfs", asdict(settings) | {"grid": asdict(grid_settings or GridSettings())})
    tables = (files.sun_positions, files.spacecraft_positions, settings.albedo, settings.exposures)
    record.add_inputs([*files.images, *files.dems, *files.cameras, *filter(None, tables)])
    plan = plan_tiles(settled, grid_settings, tiling, output)
    grid = view_grid(settled, grid_settings)
    digest = digest_of([record.settings, record.inputs, asdict(plan) | {"memory": None}])
    work = work_folder(output)
    work.mkdir(parents=True, exist_ok=True)
    clear_partial(work)
    (work / "plan.json").write_text(json.dumps({"side": plan.side}), encoding="utf-8")
    with record.stage("prepare"):
        if not is_done(work / "scene", digest):
            known, solution, skipped = prepare_scene(settled, grid, plan.stride, settings, progress)
            _save_known(work / "scene", known, solution, [*lost, *skipped], digest)
        scene = read_record(work / "scene")
    with record.stage("tiles"):
        jobs = [(settled, grid, tile, settings, work, digest) for tile in plan.tiles]
        failed = _solve_all(jobs, tiling, progress)
        if failed:
            raise LommelError(
                f"{len(failed)} of {len(jobs)} tiles failed, also when tried again:\n"
                + "\n".join(f"  tile {number}: {reason}" for number, reason in failed.items())
                + f"\nThe others wait in {work}: the same command goes on from there."
            )
    record.add_skipped([Skipped(**skip) for skip in scene["skipped"]])
    with record.stage("write"):
        sums = _write_products(folder, grid, plan, work)
        known = _load_known(work / "scene")
        tiles = [read_record(_part(work, tile)) for tile in plan.tiles]
        fit = SimpleNamespace(
            exposures=known.exposures, hazes=known.hazes, misfits=_misfits(known.names, tiles)
        )
        views = [SimpleNamespace(name=name) for name in known.names]
        write_exposures(folder, views, record.skipped, fit)
    record.results = _results(known, tiles, sums)
    record.history = scene["history"]
    record.outcome = _outcome(scene, tiles)
    record.settings["tiles"] = [
        _summary(tile, r) for tile, r in zip(plan.tiles, tiles, strict=True)
    ]
    record.write(folder)
    shutil.rmtree(work, ignore_errors=True)
    return record.results


def _part(work, tile):
    return work / f"tile-{tile.number:05d}"


def _work(job):
    """Solve one tile and keep it, unless that is done already; its number."""
    files, grid, tile, settings, work, digest = job
    part = _part(work, tile)
    if not is_done(part, digest):
        start = time.perf_counter()
        products, record = solve_tile(files, grid, tile, _load_known(work / "scene"), settings)
        record |= {
            "digest": digest,
            "seconds": round(time.perf_counter() - start, 3),
            "peak_memory_mb": round(peak_memory_mb(), 1),
        }
        save_part(part, products, record)
    return tile.number


def _solve_all(jobs, tiling, progress):
    """Reasons of the tiles that failed twice, by their number.

    Rounds go on while they finish tiles: a worker that dies takes others' tiles along.
    """
    rounds = {"serial": _serial, "processes": _processes}
    pending, finished, attempts = jobs, 0, 0
    while pending and (attempts < 2 or finished):
        with rounds[tiling.engine](tiling) as results:
            failed = {}
            for job, result in progress(_pairs(pending, results(pending))):
                try:
                    result()
                except Exception as error:  # whatever it is: the other tiles go on
                    failed[job[2].number] = f"{type(error).__name__}: {error}"
        finished = len(pending) - len(failed)
        pending = [job for job in pending if job[2].number in failed]
        attempts += 1
    return failed if pending else {}


class _pairs:
    """Jobs and results, with a length for the progress bar."""

    def __init__(self, jobs, results):
        self.jobs, self.results = jobs, results

    def __len__(self):
        return len(self.jobs)

    def __iter__(self):
        return zip(self.jobs, self.results, strict=True)


@contextmanager
def _serial(tiling):
    yield lambda jobs: ((lambda job=job: _work(job)) for job in jobs)


@contextmanager
def _processes(tiling):
    """Workers of their own, who share the cores among them."""
    cores = os.cpu_count() or 1
    before = os.environ.get("NUMBA_NUM_THREADS")
    os.environ["NUMBA_NUM_THREADS"] = str(max(cores // tiling.workers, 1))
    try:
        with ProcessPoolExecutor(tiling.workers, get_context("spawn")) as pool:
            yield lambda jobs: [pool.submit(_work, job).result for job in jobs]
    finally:
        if before is None:
            del os.environ["NUMBA_NUM_THREADS"]
        else:
            os.environ["NUMBA_NUM_THREADS"] = before


def _save_known(folder, known, solution, skipped, digest):
    arrays = {name: getattr(known, name) for name in ARRAYS}
    record = {
        "digest": digest,
        "names": known.names,
        "stride": known.stride,
        "base_height": known.base_height,
        "priors": {k: np.asarray(v).tolist() for k, v in vars(known.priors).items()},
        "outcome": solution.outcome,
        "sentence": solution.advice,
        "history": solution.history,
        "skipped": [{"name": skip.name, "reason": skip.reason} for skip in skipped],
    }
    save_part(folder, arrays, record)


def _load_known(folder):
    record = read_record(folder)
    priors = {k: np.array(v) if isinstance(v, list) else v for k, v in record["priors"].items()}
    arrays = {name: read_array(folder, name) for name in ARRAYS}
    plain = {name: record[name] for name in ("names", "stride", "base_height")}
    return Known(**arrays, **plain, priors=Priors(**priors))


def _write_products(folder, grid, plan, work):
    """Blend the tiles into rasters, window by window; sums for the results."""
    cells, sums = cell_grid(grid), {}
    for name, texts in PRODUCTS.items():
        frame = grid if name in ON_POSTS else cells
        with raster_writer(folder / f"{name}.tif", frame, *texts) as write:
            for tile in plan.tiles:
                window = tile.inner.intersection(frame.window)
                if window.is_empty:
                    continue
                values = _blended(name, window, plan, work)
                write(values, window)
                if name == "dem":
                    values = values - _blended("initial-dem", window, plan, work)
                if name in ("dem", "residual"):
                    count, total = sums.get(name, (0, 0.0))
                    total += float(np.nansum(values.astype(float) ** 2))
                    sums[name] = count + int(np.isfinite(values).sum()), total
    return {name: (total / max(count, 1)) ** 0.5 for name, (count, total) in sums.items()}


def _blended(name, window, plan, work):
    """A product in a window: the tiles that reach it, each with its share."""
    total, share = np.zeros(window.shape, np.float32), np.zeros(window.shape, np.float32)
    for tile in plan.tiles:
        kept = stored_window(tile, plan.shape)
        common = window.intersection(kept)
        if common.is_empty:
            continue
        values = read_array(_part(work, tile), name)[common.relative_to(kept).slices]
        weights = np.where(np.isfinite(values), blend_weights(tile, common, plan.shape), 0)
        inside = common.relative_to(window).slices
        total[inside] += np.where(weights > 0, weights * values, 0)
        share[inside] += weights
    return np.where(share > 0, total / np.where(share > 0, share, 1), np.nan).astype(np.float32)


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
