"""A folder of products as the stages write them, with contents that are quick to make."""

import csv
import json

import numpy as np
import pytest

from lommel.io.raster import write_raster
from lommel.report import write_report
from lommel.scene.grid import grid_from_bounds, read_crs

HOSTILE_NAME = '<img src=x onerror="alert(1)"> $a_b$ & co.tif'


def _relief(grid, seed):
    generator = np.random.default_rng(seed)
    row, col = np.indices(grid.shape, sparse=True)
    heights = np.zeros(grid.shape)
    for _ in range(30):
        size = generator.uniform(3, 25)
        r, c = generator.uniform(0, grid.shape[0]), generator.uniform(0, grid.shape[1])
        distance = np.hypot(row - r, col - c) / size
        heights += size * 8 * np.where(distance < 1, distance**2 - 1, 0.3 * np.exp(1 - distance))
    return heights


def _hillshade(heights):
    south, east = np.gradient(heights, 40.0)
    cosine = (0.5 - 0.85 * east * np.sign(1)) / np.sqrt(1 + south**2 + east**2)
    return np.clip(cosine, 0, None)


def _record(folder, **parts):
    content = {
        "lommel": "0.1.0",
        "created": "2026-01-02T03:04:05+00:00",
        "settings": {"reflectance": "lunar-lambert", "shadow_threshold": 3.5, "robust": True},
        "versions": {"numpy": "2.4.6", "numba": "0.61"},
        "machine": {"cpu": "x86_64", "cores": 2, "memory_gb": 7.8, "python": "3.11"},
        "inputs": [{"path": f"images/{HOSTILE_NAME}", "bytes": 12345, "sha256": "ab" * 32}],
        "stages": [
            {"name": "read images", "seconds": 1.25, "peak_memory_mb": 310.5},
            {"name": "solve", "seconds": 12.0, "peak_memory_mb": 620.0},
        ],
        "outcome": {"name": "converged", "sentence": "Converged after 7 steps."},
        "history": [{"step": i, "cost": 10 * 4.0**-i + 1, "change": 4.0**-i} for i in range(8)],
        **parts,
    }
    (folder / "run.json").write_text(json.dumps(content), encoding="utf-8")


def _write_albedo_products(folder):
    folder.mkdir()
    grid = grid_from_bounds((20.0, -12.0, 32.0, -8.0), 2000.0, read_crs("IAU_2015:30100"))
    relief = _relief(grid, 1)
    albedo = 1 + 0.15 * np.tanh(_relief(grid, 2) / 40)
    unseen = np.zeros(grid.shape, bool)
    unseen[:6], unseen[30:40, 60:80] = True, True
    count = np.where(unseen, 0, 1 + np.indices(grid.shape)[1] // 30).astype(np.int16)

    def masked(values):
        return np.where(unseen, np.nan, values)

    write_raster(folder / "albedo.tif", masked(albedo), grid, "albedo", "1")
    mosaic = masked(albedo * (0.3 + _hillshade(relief * 3)) * 200)
    write_raster(folder / "orthomosaic.tif", mosaic, grid, "mosaic", "image values")
    write_raster(folder / "count.tif", count, grid, "count", "1")
    error = masked(0.05 / np.sqrt(np.maximum(count, 1)))
    write_raster(folder / "residual.tif", error, grid, "standard error of the albedo", "1")
    generator = np.random.default_rng(3)
    names = [f"AS16-M-{i:04d}.tif" for i in range(420, 444)] + [HOSTILE_NAME]
    with open(folder / "exposures.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["image", "exposure", "exposure_error", "haze", "used", "reason"])
        for i, name in enumerate(names):
            exposure, haze = 1 + 0.25 * np.sin(i / 3), generator.normal(0, 3)
            writer.writerow(
                [name, f"{exposure:.5f}", 0.01, f"{haze:.3f}", i != 3, "all shadow" * (i == 3)]
            )
    _record(
        folder,
        command="albedo",
        results={"exposure_rms_percent": 0.4321, "albedo_error_percent": 2.7, "images": 24},
        skipped=[{"image": HOSTILE_NAME, "reason": "does not overlap the DEM <b>at all</b>."}],
    )


def _write_terrain_products(folder):
    folder.mkdir()
    crs = read_crs("+proj=stere +lat_0=26 +lon_0=3 +R=1737400 +units=m")
    grid = grid_from_bounds((-2500.0, -2500.0, 2500.0, 2500.0), 40.0, crs)
    generator = np.random.default_rng(4)
    true = _relief(grid, 5)
    initial = 0.6 * true + generator.normal(0, 4, grid.shape)
    shades = _hillshade(initial), _hillshade(true)
    modelled = 150 * shades[1]
    measured = modelled + generator.normal(0, 2, grid.shape)
    measured[50:56, 10:30] = np.nan
    for name, values, unit in (
        ("dem", true, "m"),
        ("initial-dem", initial, "m"),
        ("hillshade-before", shades[0], "1"),
        ("hillshade-after", shades[1], "1"),
        ("measured", measured, "1"),
        ("modelled", modelled, "1"),
        ("residual", np.abs(modelled - measured), "percent"),
    ):
        write_raster(folder / f"{name}.tif", values, grid, name, unit)
    _record(
        folder,
        command="sfs",
        results={
            "images": 2,
            "image_correlation_before": 0.131,
            "image_correlation_after": 0.952,
            "height_change_rms_m": 6.689,
        },
        history=[
            {"stride": stride, "cost": 9e4 + 1e4 / stride - step, "step_m": 3.0 * 4.0**-step}
            for stride in (4, 2, 1)
            for step in range(3)
        ],
    )


@pytest.fixture
def albedo_folder(tmp_path):
    """Products of `lommel albedo` on a strip in degrees, with a border and a hole without data."""
    _write_albedo_products(tmp_path / "albedo")
    return tmp_path / "albedo"


@pytest.fixture
def sfs_folder(tmp_path):
    """Products of `lommel sfs` on a square in metres."""
    _write_terrain_products(tmp_path / "sfs")
    return tmp_path / "sfs"


@pytest.fixture(scope="session")
def demo_report(tmp_path_factory):
    """The page of a run that holds two stages and compares them with the truth."""
    folder = tmp_path_factory.mktemp("demo")
    _write_albedo_products(folder / "albedo")
    _write_terrain_products(folder / "sfs")
    _record(
        folder,
        command="demo",
        results={"exposure_rms_percent": 0.5, "albedo_rms_percent": 4.1, "height_rmse_m": 8.25},
        targets={"exposure_rms_percent": "at most 1", "albedo_rms_percent": "at most 3"},
        history=[],
    )
    return write_report(folder)
