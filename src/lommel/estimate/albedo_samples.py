r"""From observations to the flat arrays that the albedo pass runs over.

For each image: reflectance, phase and the angle off nadir at every post of its window, its mask and
feathering, and the expected variance of its pixels. Most callers want `SampleBlocks`.
"""

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from lommel.core.reflectance import ReflectanceModel
from lommel.estimate.albedo_arrays import BLOCKS, Pairs, Samples
from lommel.estimate.albedo_light import ImageGeometry, TerrainPart
from lommel.jobs import InThreads
from lommel.scene.geometry import Observation, surface_normals, unit, viewing_geometry
from lommel.scene.grid import Grid, Window
from lommel.scene.masks import (
    MaskSettings,
    falling,
    known_span,
    least_lit,
    lit_brightness,
    pixel_weights,
    shadow_threshold,
)

ROWS_AT_ONCE = 256  # rows of geometry in memory, 200 bytes per post
PIXELS_AT_ONCE = 2**21  # of all images in one block of rows, 24 bytes each
POSTS_AT_ONCE = 2**20  # of the grid in one block of rows, 100 bytes each
KEPT_PIXELS = 2**26  # of all images whose samples are kept, 1.6 GB
THIN = 2**22  # pixels that tell the level and the shadow threshold of an image
STRIP = 32  # rows read together where not all are
TOGETHER = 4  # blocks that another process does at a time
PLANES = Samples._fields[2:]


def image_geometry(grid, heights, observation):
    """Geometry of an observation, computed some rows at a time.

    Parameters
    ----------
    grid : Grid
    heights : array (rows, cols) on the grid, m
    observation : Observation

    Returns
    -------
    geometry : ImageGeometry
    """
    window = observation.window
    planes = np.empty((4, *window.shape), np.float32)
    for first in range(0, window.rows, ROWS_AT_ONCE):
        rows = min(ROWS_AT_ONCE, window.rows - first)
        part = Window(window.row + first, window.col, rows, window.cols)
        planes[:, first : first + rows] = _geometry_of(grid, heights, observation, part)
    return ImageGeometry(*planes)


def _geometry_of(grid, heights, observation, part):
    halo = Window(part.row - 1, part.col - 1, part.rows + 2, part.cols + 2)
    halo = halo.intersection(grid.window)
    inside = part.relative_to(halo).slices
    xyz = grid.cut(halo).xyz(heights[halo.slices])
    normals = surface_normals(xyz)[inside]
    xyz = xyz[inside]
    spacecraft = np.asarray(observation.spacecraft_position, float)
    geometry = viewing_geometry(xyz, normals, observation.sun_position, spacecraft)
    cosine = unit(spacecraft - xyz) @ unit(spacecraft)
    return (
        geometry.cos_incidence,
        geometry.cos_emission,
        geometry.phase,
        np.arccos(np.minimum(cosine, 1.0)) ** 2,
    )


def slope_sensitivity(model, geometry):
    r"""Reflectance and the length of its gradient by the two slopes, per radian.

    .. math:: |\nabla R|^2 = R_i^2 \sin^2 i + R_e^2 \sin^2 e
              + 2 R_i R_e (\cos\alpha - \cos i \cos e)

    with the derivatives :math:`R_i, R_e` by the cosines of incidence and emission.

    Parameters
    ----------
    model : ReflectanceModel
    geometry : ImageGeometry

    Returns
    -------
    reflectance, gradient : float32 array (rows, cols)
    """
    mu0, mu = geometry.cos_incidence, geometry.cos_emission
    reflectance, by_mu0, by_mu = model.with_derivatives(mu0, mu, geometry.phase)
    square = by_mu0**2 * (1 - mu0**2) + by_mu**2 * (1 - mu**2)
    square += 2 * by_mu0 * by_mu * (np.cos(geometry.phase) - mu0 * mu)
    return reflectance, np.sqrt(np.maximum(square, 0.0))


def collect_samples(observations, grid, heights, model, masks, slope_noise):
    """Samples of all images at once; see `SampleBlocks`.

    Returns
    -------
    samples : Samples
    levels : float64 array (used images,), image units
    reasons : list of str
        One per observation, empty where it is used.
    """
    blocks = SampleBlocks(observations, grid, heights, model, masks, slope_noise)
    return blocks.rows(0, grid.shape[0]), blocks.levels, blocks.reasons


class SampleBlocks:
    r"""Samples of the images, some rows of the grid at a time.

    Blocks of rows that fit in memory are computed once and kept, the others computed anew in every
    pass from the images and the heights: the same numbers either way. The expected variance of a
    pixel is that of the terrain's texture and of its slopes,

    .. math:: \sigma^2 \propto \ell^2 (R^2 + \kappa^2 |\nabla R|^2)

    with the image's level :math:`\ell = \sum w I / \sum w R`; images at low Sun, where a small
    error of slope is a large error of brightness, so get the weight they deserve. Images of more
    than `THIN` pixels tell their level, and the threshold of their shadows, by rows spread evenly.

    Parameters
    ----------
    observations : list of Observation
    grid : Grid
    heights : array (rows, cols), m
    model : ReflectanceModel
    masks : MaskSettings
    slope_noise : float, rad, or None
        :math:`\kappa`, slope error per relative error of brightness; None gives every pixel of
        every image the same variance.
    kept_pixels : int, optional
        Pixels of all images whose samples are kept, 24 bytes each; `KEPT_PIXELS`.
    progress : callable

    Attributes
    ----------
    shape : tuple of int
        Of the grid.
    windows : int64 array (used images, 4)
    levels, brightness : float64 array (used images,), image units
        Weighted mean of the used pixels, over that of the reflectance and as it is.
    completeness : float64 array (used images,)
        1: every image tells its haze; see `lommel.estimate.albedo_cells.Cells`.
    reasons : list of str
        One per observation, empty where it is used.
    passes : int
        Over all images so far.
    """

    def __init__(
        self,
        observations,
        grid,
        heights,
        model,
        masks,
        slope_noise,
        kept_pixels=None,
        jobs=None,
    ):
        self.grid, self.heights = grid, heights
        self.shape = grid.shape
        self.slope_noise, self.passes = slope_noise, 0
        self.jobs = jobs or InThreads()
        self.viewing = Viewing(grid, heights, model, masks)
        lit = []
        if masks.shadow_threshold is None:
            lit = list(self.jobs.each(_thin_brightness, observations, "brightness"))
        frames = list(self.jobs.each(Look(self.viewing, least_lit(lit)), observations, "levels"))
        self.reasons = [frame.reason for frame in frames]
        self.frames = [frame for frame in frames if not frame.reason]
        self.levels = np.array([frame.level for frame in self.frames])
        self.brightness = np.array([frame.brightness for frame in self.frames])
        windows = [(w.row, w.col, w.rows, w.cols) for w in (f.window for f in self.frames)]
        self.windows = np.array(windows, np.int64).reshape(-1, 4)
        self.completeness = np.ones(len(self.frames))
        self.pixels = int(np.sum(self.windows[:, 2] * self.windows[:, 3]))
        self.edges, above = block_edges(self.windows, self.shape)
        self.count = len(self.edges) - 1
        self._kept: dict[int, Samples] = {}
        kept_pixels = KEPT_PIXELS if kept_pixels is None else kept_pixels
        self._keeps = int(np.searchsorted(above[self.edges[1:]], kept_pixels, side="right"))

    def __getstate__(self):
        """What another process has to know: neither who runs the jobs nor what is kept here."""
        return vars(self) | {"jobs": None, "_kept": {}, "_keeps": 0}

    def keep(self, is_kept, reasons):
        """Leave out the used images of which ``is_kept`` is False, each for its reason."""
        used = [k for k, reason in enumerate(self.reasons) if not reason]
        for k, kept, reason in zip(used, is_kept, reasons, strict=True):
            self.reasons[k] = "" if kept else reason
        for name in ("levels", "brightness", "windows", "completeness"):
            setattr(self, name, getattr(self, name)[is_kept])
        self.frames = [frame for frame, kept in zip(self.frames, is_kept, strict=True) if kept]
        self.pixels = int(np.sum(self.windows[:, 2] * self.windows[:, 3]))
        self._kept = {}

    def span(self, block):
        """First row of a block, and the row behind its last one."""
        return self.edges[block], self.edges[block + 1]

    def block(self, block):
        """Samples of the rows of a block."""
        if block >= self._keeps:
            return self.rows(*self.span(block))
        if block not in self._kept:
            self._kept[block] = self.rows(*self.span(block))
        return self._kept[block]

    def each(self, visit, name=None, every=1):
        """One pass over the images: what a function of the number of a block gives, in order.

        Parameters
        ----------
        visit : callable (block)
            As `lommel.jobs.InThreads.each` takes it.
        name : str, optional
            Of the pass; by default its number.
        every : int
            Only each so manieth block.

        Returns
        -------
        results : iterator
        """
        self.passes += 1
        name = f"{name or f'pass {self.passes}'}, block"
        return self.jobs.each(visit, range(0, self.count, every), name, TOGETHER)

    def rows(self, first, last):
        """Samples of the rows from first to before last; only these rows may be asked for.

        Parameters
        ----------
        first, last : int

        Returns
        -------
        samples : Samples
        """
        parts = [rows_of(frame.window, first, last) for frame in self.frames]
        sizes = [part.rows * part.cols for part in parts]
        ends = np.cumsum([0, *sizes])
        planes = np.zeros((len(PLANES), ends[-1]), np.float32)
        starts = np.zeros(len(parts), np.int64)
        if ends[-1] > 0:
            terrain = TerrainPart(
                self.grid, self.heights, Window(first, 0, last - first, self.grid.shape[1])
            )
        for k, (frame, part) in enumerate(zip(self.frames, parts, strict=True)):
            starts[k] = ends[k] - (part.row - frame.window.row) * part.cols
            if not part.is_empty:
                here = planes[:, ends[k] : ends[k + 1]].reshape(len(PLANES), *part.shape)
                self._fill(here, frame, part, terrain, self.levels[k])
        return Samples(self.windows, starts, *planes)

    def _fill(self, planes, frame, part, terrain, level):
        measured, geometry, weight, reflectance, gradient = self.viewing.see(frame, part, terrain)
        noise = np.nan if self.slope_noise is None else self.slope_noise
        same = 1.0 / np.median(self.levels) ** 2
        given = (measured, reflectance, geometry.phase, geometry.off_axis, weight, gradient)
        _store(*given, level, noise, same, planes)


def block_edges(windows, shape):
    """Where blocks of rows begin and the last one ends, so that one block fits in memory.

    Parameters
    ----------
    windows : int64 array (images, 4)
    shape : tuple of int
        Of the grid.

    Returns
    -------
    edges : list of int
    above : int64 array (rows + 1,)
        Pixels of all images above each row.
    """
    rows, cols = shape
    starting = np.zeros(rows + 1, np.int64)
    np.add.at(starting, windows[:, 0], windows[:, 3])
    np.add.at(starting, windows[:, 0] + windows[:, 2], -windows[:, 3])
    above = np.concatenate([[0], np.cumsum(np.cumsum(starting[:-1]))])
    most = max(1, min(-(-rows // BLOCKS), POSTS_AT_ONCE // cols))
    edges = [0]
    while edges[-1] < rows:
        first = edges[-1]
        full = int(np.searchsorted(above, above[first] + PIXELS_AT_ONCE, side="right")) - 1
        edges.append(min(max(full, first + 1), first + most, rows))
    return edges, above


@dataclass(frozen=True)
class Viewing:
    """How an image shows the terrain.

    Attributes
    ----------
    grid : Grid
    heights : array (rows, cols), m
    model : ReflectanceModel
    masks : MaskSettings
    """

    grid: Grid
    heights: np.ndarray
    model: ReflectanceModel
    masks: MaskSettings

    def see(self, frame, part, terrain):
        """Some rows of an image: values, light and view, weight, reflectance and its gradient.

        Parameters
        ----------
        frame : Frame
        part : Window
        terrain : TerrainPart
            Holding at least these rows.
        """
        image = frame.image
        geometry = terrain.geometry(part, image.sun_position, image.spacecraft_position)
        measured, weight = frame.weigh(part, geometry, self.masks)
        reflectance, gradient = slope_sensitivity(self.model, geometry)
        weight[~(reflectance > 0)] = 0.0
        return measured, geometry, weight, reflectance, gradient


@dataclass(frozen=True)
class Look:
    """Looks at the whole of an image, an Observation, and makes a `Frame` of it.

    Attributes
    ----------
    viewing : Viewing
    least_lit : float, image units
        Least brightness of lit ground.
    """

    viewing: Viewing
    least_lit: float

    def __call__(self, image):
        """The image, its level and mean brightness, and why it cannot be used, if so."""
        threshold = self.viewing.masks.shadow_threshold
        if threshold is None:
            thin = thinned(image.measured)
            threshold = shadow_threshold(thin, max(lit_brightness(thin), self.least_lit))
        frame = Frame(image, float(threshold), *_known_extent(image))
        return replace(frame, **self._level(frame))

    def _level(self, frame):
        step = max(1, -(-frame.window.rows * frame.window.cols // THIN))
        total, value, answer = 0.0, 0.0, 0.0
        has_ground = has_light = has_value = False
        for every in {step: None, 1: None}:  # all rows before an image is given up
            for part in _strips(frame.window, every):
                terrain = TerrainPart(self.viewing.grid, self.viewing.heights, part)
                measured, geometry, weight, reflectance, _ = self.viewing.see(frame, part, terrain)
                total += float(np.sum(weight, dtype=float))
                value += float(np.sum(weight * np.nan_to_num(measured), dtype=float))
                answer += float(np.sum(weight * np.nan_to_num(reflectance), dtype=float))
                known = np.isfinite(measured) & np.isfinite(geometry.cos_incidence)
                has_ground |= bool(known.any())
                has_light |= bool((known & (geometry.cos_incidence > 0)).any())
                has_value |= bool((known & (measured > frame.threshold)).any())
            if answer > 0:
                return {"level": value / answer, "brightness": value / total}
        return {"reason": _reason(has_ground, has_light, has_value, frame.threshold)}


@dataclass(frozen=True)
class Frame:
    """An image with what its whole decides about each part.

    Attributes
    ----------
    image : Observation
    threshold : float, image units
        Shadow up to here.
    known_rows, known_cols : (first, number) of int
        Rows and columns of its window that hold values: feathering ends with them.
    level, brightness : float, image units
        As of `SampleBlocks`.
    reason : str
        Why it cannot be used; empty where it can.
    """

    image: Observation
    threshold: float
    known_rows: tuple[int, int]
    known_cols: tuple[int, int]
    level: float = np.nan
    brightness: float = np.nan
    reason: str = ""

    @property
    def window(self):
        """Of the image on the grid."""
        return self.image.window

    def weigh(self, part, geometry, masks):
        """Values and weights of some rows of the image.

        Parameters
        ----------
        part : Window
            All columns of the image.
        geometry : ImageGeometry
        masks : MaskSettings

        Returns
        -------
        measured, weight : float32 array (part.rows, part.cols)
        """
        first = part.row - self.window.row
        above, below = max(first - 1, 0), min(first + part.rows + 1, self.window.rows)
        around = ((first - above, below - first - part.rows), (0, 0))
        inside = slice(first - above, first - above + part.rows)
        measured = self.image.measured[above:below]
        usable = pixel_weights(
            measured,
            np.pad(geometry.cos_incidence, around, mode="edge"),
            np.pad(geometry.cos_emission, around, mode="edge"),
            self.threshold,
            self.image.saturation,
            masks,
        )
        along_rows = falling(first + np.arange(part.rows), *self.known_rows)
        along_cols = falling(np.arange(self.window.cols), *self.known_cols)
        weight = np.minimum(along_rows[:, None], along_cols).astype(np.float32)
        weight[usable[inside] == 0] = 0.0
        return measured[inside], weight


def rows_of(window, first, last):
    """The part of a window between two rows of the grid; empty parts start inside the window."""
    top = min(max(window.row, first), window.row + window.rows)
    bottom = max(min(window.row + window.rows, last), top)
    return Window(top, window.col, bottom - top, window.cols)


def clipped(samples, first, last):
    """Samples of some rows as a grid of their own.

    Parameters
    ----------
    samples : Samples
        Holding at least these rows.
    first, last : int

    Returns
    -------
    samples : Samples
        Windows counted from the row ``first``.
    """
    windows, starts = samples.windows.copy(), samples.starts.copy()
    for k, (row, col, rows, cols) in enumerate(samples.windows):
        part = rows_of(Window(row, col, rows, cols), first, last)
        starts[k] = samples.starts[k] + (part.row - row) * cols if part.rows else 0
        windows[k] = part.row - first if part.rows else 0, col, part.rows, cols
    return samples._replace(windows=windows, starts=starts)


def _known_extent(image):
    """First and number of the rows, and of the columns, that hold values."""
    rows, cols = image.window.shape
    in_row, in_col = np.zeros(rows, bool), np.zeros(cols, bool)
    for first in range(0, rows, ROWS_AT_ONCE):
        known = np.isfinite(image.measured[first : first + ROWS_AT_ONCE])
        in_row[first : first + ROWS_AT_ONCE] = known.any(axis=1)
        in_col |= known.any(axis=0)
    return known_span(in_row), known_span(in_col)


def _thin_brightness(image):
    """Brightness of lit ground in an image, from some of its rows."""
    return lit_brightness(thinned(image.measured))


def thinned(measured):
    """At most about `THIN` pixels of an image, rows spread evenly.

    Parameters
    ----------
    measured : array (rows, cols)
        Or what waits on a disk and is indexed by rows as that.

    Returns
    -------
    pixels : array
    """
    step = max(1, -(-measured.shape[0] * measured.shape[1] // THIN))
    if step == 1:
        return measured[:]
    return np.concatenate([measured[row] for row in range(0, len(measured), step)])


def _strips(window, every):
    """Parts of a window that hold every so-many-th group of `STRIP` rows."""
    height = ROWS_AT_ONCE if every == 1 else STRIP
    for first in range(0, window.rows, height * every):
        rows = min(height, window.rows - first)
        yield Window(window.row + first, window.col, rows, window.cols)


@njit(cache=True, nogil=True, error_model="numpy")
def _store(
    measured, reflectance, phase, off_axis, weight, gradient, level, slope_noise, same, planes
):
    """Planes of `Samples`, 0 where a value is unknown; without a noise precision is the same."""
    rows, cols = measured.shape
    for i in range(rows):
        for j in range(cols):
            answer, steepness = np.float64(reflectance[i, j]), slope_noise * gradient[i, j]
            variance = level * level * max(answer * answer + steepness * steepness, 1e-6)
            precision = same if np.isnan(slope_noise) else 1.0 / variance
            planes[0, i, j] = _known(measured[i, j])
            planes[1, i, j] = _known(reflectance[i, j])
            planes[2, i, j] = _known(phase[i, j])
            planes[3, i, j] = _known(off_axis[i, j])
            planes[4, i, j] = _known(weight[i, j])
            planes[5, i, j] = precision if precision > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _known(value):
    return value if value == value else np.float32(0.0)


def _reason(has_ground, has_light, has_value, threshold):
    """Why no pixel of an image is used."""
    if not has_ground:
        return "no pixel lies on known terrain"
    if not has_light:
        return "the Sun is below the horizon everywhere"
    if not has_value:
        return (
            f"every pixel is shadow: no value above shadow_threshold = {threshold:.4g}; "
            "set a lower one if the image is lit"
        )
    return "every pixel is shadow, saturated or seen or lit too obliquely"


def overlapping_pairs(windows):
    """Pairs of images whose windows overlap, each image with itself included.

    Parameters
    ----------
    windows : int64 array (images, 4)

    Returns
    -------
    pairs : Pairs
    """
    low, high = windows[:, :2], windows[:, :2] + windows[:, 2:]
    second, first = [], [0]
    for i in range(len(windows)):
        overlaps = (np.maximum(low[i], low[i:]) < np.minimum(high[i], high[i:])).all(axis=1)
        second.append(i + np.flatnonzero(overlaps))
        first.append(first[-1] + len(second[-1]))
    return Pairs(np.array(first, np.int64), np.concatenate([np.zeros(0, int), *second]))


def orthomosaic(samples, shape):
    """Weighted mean of the images as they are, for comparison with the albedo.

    Parameters
    ----------
    samples : Samples
    shape : tuple of int

    Returns
    -------
    mosaic : float32 array (rows, cols), image units; NaN where no image is
    """
    total, weights = np.zeros(shape), np.zeros(shape)
    for (row, col, rows, cols), start in zip(samples.windows, samples.starts, strict=True):
        here = slice(row, row + rows), slice(col, col + cols)
        part = slice(start, start + rows * cols)
        weight = samples.weight[part].reshape(rows, cols)
        total[here] += weight * samples.measured[part].reshape(rows, cols)
        weights[here] += weight
    mosaic = np.full(shape, np.nan, np.float32)
    np.divide(total, weights, out=mosaic, where=weights > 0, casting="same_kind")
    return mosaic
