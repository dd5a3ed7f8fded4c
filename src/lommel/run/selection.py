"""Which of many images are used where: enough of them, and no more.

From cameras, Sun and the initial DEM alone follows what each image tells of the slopes of each
place (`lommel.estimate.image_choice`); pixels are not read, but for where an orthoimage shows
something. Most callers want `survey_images`.
"""

import hashlib
import os
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from lommel.core.reflectance import reflectance_model
from lommel.errors import InputError, LommelError
from lommel.estimate.image_choice import Sights, choose_images, information
from lommel.io.cameras import SUFFIXES
from lommel.io.positions import find_position
from lommel.run.footprints import find_footprints, ground_sample_distance, terrain_grid
from lommel.run.inputs import (
    GridSettings,
    Skipped,
    known_heights,
    listing,
    read_position_tables,
)
from lommel.run.tiles_plan import work_folder
from lommel.run.views import sun_of, sun_table
from lommel.scene.body import local_frame
from lommel.scene.geometry import surface_normals, unit
from lommel.scene.grid import Grid, Window
from lommel.scene.shadows import sunlit

FEW = 8  # images up to which all are used
PLACES_PER_IMAGE = 4  # along the shorter side of most images
PLACES = 64, 256  # along the longer side of the grid: at least, at most
SQUARES = 64  # along the longer side of the grid, in which images are used or not
SKETCH = 64  # pixels along each side of an orthoimage that tell where it shows something


def survey_images(files, grid_settings, settings, output):
    """Where images lie and which are used; that of an earlier run that was broken off holds on.

    Parameters
    ----------
    files : SceneFiles
    grid_settings : GridSettings or None
    settings : SfsSettings
    output : path
        Of the run, beside which a broken run has left its tiles.

    Returns
    -------
    footprints : Footprints
    """
    asked = settings.all_images, settings.reflectance, settings.knows_albedo
    key = _key(files, [repr(grid_settings or GridSettings()), *asked])
    earlier = _earlier(work_folder(output))
    if earlier is not None and earlier.key == key:
        return earlier
    chooses = len(files.images) > FEW and not settings.all_images
    footprints = find_footprints(files, grid_settings, sketch=SKETCH if chooses else 0)
    if chooses:
        footprints = select_images(footprints, settings.reflectance, settings.knows_albedo)
    return replace(footprints, key=key, looks=[])


def _key(files, asked):
    """Digest of the request, and of the names, sizes and dates of all files."""
    beside = [path.with_suffix(suffix) for path in files.images for suffix in SUFFIXES]
    tables = filter(None, (files.sun_positions, files.spacecraft_positions))
    paths = [*files.images, *files.dems, *filter(None, files.cameras), *tables, *beside]
    content = [*asked, files.positions_unit]
    for path in map(os.path.abspath, paths):
        content.append(path)
        with suppress(OSError):  # not there: also told
            state = os.stat(path)
            content.append((state.st_size, state.st_mtime_ns))
    return hashlib.sha256(repr(content).encode()).hexdigest()


def _earlier(work):
    """Footprints of a broken run, or None."""
    from lommel.run.tiles_records import load_run  # which needs what runs need

    try:
        return load_run(work).footprints
    except LommelError:
        return None


def select_images(footprints, reflectance, knows_albedo=False):
    """Footprints of which only the best few images of each place are used.

    Parameters
    ----------
    footprints : Footprints
    reflectance : str
        Name of a model.
    knows_albedo : bool
        The albedo is given, or not estimated.

    Returns
    -------
    footprints : Footprints
        As it was where it has `FEW` images or fewer.
    """
    if len(footprints.files.images) <= FEW:
        return footprints
    footprints, ground, sights = find_sights(footprints, reflectance)
    images, places = footprints.files.images, ground.heights.size
    is_chosen, gains = choose_images(sights, len(images), places, knows_albedo)
    patch, is_used = _squares(ground, footprints, sights, is_chosen)
    nowhere = np.flatnonzero(~is_used.any(axis=(1, 2)))
    return replace(
        footprints,
        patch=patch,
        is_used=is_used,
        not_chosen=[Skipped(images[k].name, _reason(images[k].name, gains[k])) for k in nowhere],
        results=_results(sights, is_chosen, places),
    )


def find_sights(footprints, reflectance):
    """What each image tells of places spread over the grid.

    Parameters
    ----------
    footprints : Footprints
        With looks at the files, sketches of orthoimages among them.
    reflectance : str
        Name of a model.

    Returns
    -------
    footprints : Footprints
        Without the images of which light or view is not known.
    ground : Ground
        The places.
    sights : Sights
    """
    ground, model = _ground(footprints), reflectance_model(reflectance)
    tables = _tables(footprints.files, footprints.grid.body)
    told, skipped = {}, []
    for k, look in enumerate(footprints.looks):
        try:
            told[k] = _tells(ground, footprints, k, look, tables, model)
        except LommelError as error:
            skipped.append(Skipped(look.path.name, str(error)))
    if not told:
        raise InputError("No image can be used.\n" + listing(skipped))
    footprints = footprints.only(list(told), skipped)
    sights = Sights(
        np.repeat(np.arange(len(told)), [len(place) for place, _ in told.values()]),
        np.concatenate([place for place, _ in told.values()]),
        np.concatenate([values for _, values in told.values()]),
    )
    return footprints, ground, sights


@dataclass(frozen=True)
class Ground:
    """Places spread over the grid: every so manieth post.

    Attributes
    ----------
    grid : Grid
        Of the places.
    stride : int
        Posts from place to place.
    heights : float array (rows, cols), m
        Of `is_known` places; elsewhere their mean.
    is_known : bool array (rows, cols)
    longitude, latitude : array (rows, cols), rad
    xyz : array (rows, cols, 3), m
    frame : array (rows, cols, 3, 3)
        Body-fixed vectors to east, north and up.
    slopes : array (rows, cols, 2), dimensionless
        East and north.
    """

    grid: Grid
    stride: int
    heights: np.ndarray
    is_known: np.ndarray
    longitude: np.ndarray
    latitude: np.ndarray
    xyz: np.ndarray
    frame: np.ndarray
    slopes: np.ndarray

    def window(self, window):
        """The places of a window of posts."""
        row, col = window.row // self.stride, window.col // self.stride
        last_row = -(-(window.row + window.rows) // self.stride)
        last_col = -(-(window.col + window.cols) // self.stride)
        return Window(row, col, last_row - row, last_col - col).intersection(self.grid.window)


def _ground(footprints):
    grid, windows = footprints.grid, footprints.windows
    sides = np.minimum(windows[:, 2] - windows[:, 0], windows[:, 3] - windows[:, 1])
    count = PLACES_PER_IMAGE * max(grid.shape) / np.median(sides)
    places, stride = terrain_grid(grid, int(np.clip(count, *PLACES)))
    heights = known_heights(footprints.files.dems, places, grid.body)
    is_known = np.isfinite(heights)
    heights = np.where(is_known, heights, np.mean(heights[is_known]) if is_known.any() else 0.0)
    longitude, latitude = places.lonlat()
    xyz = places.xyz(heights)
    frame = np.stack(local_frame(longitude, latitude), axis=-2)
    normals = np.einsum("...ij,...j", frame, surface_normals(xyz))
    slopes = -normals[..., :2] / normals[..., 2:]
    return Ground(places, stride, heights, is_known, longitude, latitude, xyz, frame, slopes)


def _tells(ground, footprints, k, look, tables, model):
    """The places that an image shows, and what it tells of each."""
    files, grid, path = footprints.files, footprints.grid, look.path
    posts = footprints.window(k)
    window = ground.window(posts)
    part = window.slices
    if look.camera is None:
        own = look.info.grid
        shows = _shows(own, look.info.sketch, ground.longitude[part], ground.latitude[part])
        gsd = (own.spacing[0] * own.spacing[1]) ** 0.5
        sun, position = (find_position(table, path.name, source) for source, table in tables)
    else:
        camera = copy(look.camera)  # which may keep tables of its lines, and they are large
        shows = camera.contains(*camera.project(ground.xyz[part]))
        gsd = ground_sample_distance(camera, grid.cut(posts), float(np.mean(ground.heights[part])))
        sun, position = sun_of(camera, path, tables[0][1], files), camera.position
    shows &= ground.is_known[part]
    xyz, frame = ground.xyz[part][shows], ground.frame[part][shows]
    to_sun, to_camera = (np.einsum("...ij,...j", frame, unit(p - xyz)) for p in (sun, position))
    pixels = (grid.spacing[0] * grid.spacing[1]) / gsd**2 if np.isfinite(gsd) else 1.0
    values = information(model, ground.slopes[part][shows], to_sun, to_camera, pixels)
    values[~sunlit(ground.grid, ground.heights, sun, window)[shows]] = 0.0
    row, col = np.nonzero(shows)
    return (row + window.row) * ground.grid.shape[1] + col + window.col, values


def _shows(own, sketch, longitude, latitude):
    """Where an orthoimage shows something, as far as single pixels tell."""
    size = np.array(sketch.shape)[:, None, None]
    place = (np.stack(own.index_at(longitude, latitude)) + 0.5) * size
    place /= np.array(own.shape)[:, None, None]
    is_inside = ((place >= 0) & (place < size)).all(axis=0)
    row, col = np.where(is_inside, place, 0.0).astype(int)
    return is_inside & sketch[row, col]


def _tables(files, body):
    """Path and content of the tables of Sun and spacecraft; no content where none is needed."""
    if None in files.cameras:
        return read_position_tables(files, body)
    return [(files.sun_positions, sun_table(files, body)), (None, None)]


def _squares(ground, footprints, sights, is_chosen):
    """Side of the squares that images are chosen for, posts, and which they are.

    An image too small to show any of the places is used.
    """
    group = -(-max(ground.grid.shape) // SQUARES)
    row, col = np.divmod(sights.place[is_chosen], ground.grid.shape[1])
    shape = tuple(-(-size // group) for size in ground.grid.shape)
    is_used = np.zeros((len(footprints.files.images), *shape), bool)
    is_used[sights.image[is_chosen], row // group, col // group] = True
    is_used[np.setdiff1d(np.arange(len(is_used)), sights.image)] = True
    return group * ground.stride, is_used


def _reason(name, gain):
    return (
        f"{name} was not chosen: the images that are used tell so much of what it shows that it "
        f"would lower the standard error of the slopes by {100 * gain:.1f} % only. --all-images "
        "uses it."
    )


def _results(sights, is_chosen, places):
    """How many images show a place, and how many are used there, in the median of places."""
    shown = np.bincount(sights.place, minlength=places)
    used = np.bincount(sights.place, is_chosen, places)
    seen = shown > 0
    return {
        "images_per_place": float(np.median(shown[seen])) if seen.any() else 0.0,
        "images_used_per_place": float(np.median(used[seen])) if seen.any() else 0.0,
    }
