r"""From ground to image: where posts fall in an image, how they are lit, which the camera sees.

Most callers want `ground_tile` and `resample_image`.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from lommel.core.interpolation import sample_cubic, sample_linear
from lommel.core.multigrid import threads_for
from lommel.scene.geometry import ViewingGeometry, surface_normals, viewing_geometry
from lommel.scene.grid import Window
from lommel.scene.shadows import sunlit

AREA_MEAN_FROM = 1.5  # pixels per post from which means over the post's area replace interpolation
FINEST_MEAN = 64  # samples along each side of a post's area at most
RIM = 1  # posts around a tile that its normals need


@dataclass(frozen=True, eq=False)
class GroundTile:
    """Posts of a tile as one camera sees them.

    Attributes
    ----------
    line, sample : array (rows, cols), px
        Image coordinates; NaN where the camera does not look.
    per_post : array (4, rows, cols), px
        Change of line and sample from row to row, then from column to column.
    geometry : ViewingGeometry
        NaN where the terrain is unknown; incidence and phase also without a Sun. Posts off the
        image take Sun and camera from its nearest pixel.
    is_on_image : bool array (rows, cols)
        Known terrain that falls on the image, whether hidden or not.
    is_lit : bool array (rows, cols)
        Neither turned away from the Sun nor in the shadow of other terrain.
    is_seen : bool array (rows, cols)
        On the image, turned to the camera and not hidden by other terrain.
    """

    line: np.ndarray
    sample: np.ndarray
    per_post: np.ndarray
    geometry: ViewingGeometry
    is_on_image: np.ndarray
    is_lit: np.ndarray
    is_seen: np.ndarray


def ground_tile(grid, heights, window, camera, sun_position=None):
    """Posts of a window as a camera sees them.

    Parameters
    ----------
    grid : Grid
        Of the window and the terrain around it that may hide or shade it.
    heights : float array (rows, cols), m
    window : Window
        Posts asked for, counted on ``grid``, at least one post from its edge where normals matter.
    camera : Camera
    sun_position : array (3,), m, body-fixed, optional
        Replaces the one of the camera.

    Returns
    -------
    tile : GroundTile
    """
    rim = Window(
        window.row - RIM, window.col - RIM, window.rows + 2 * RIM, window.cols + 2 * RIM
    ).intersection(grid.window)
    inside = window.relative_to(rim).slices
    xyz = grid.cut(rim).xyz(heights[rim.slices])
    normals = surface_normals(xyz)[inside]
    places = camera.project(xyz)
    per_post = np.stack([np.gradient(x, axis=axis)[inside] for axis in (0, 1) for x in places])
    line, sample = (place[inside] for place in places)
    xyz = xyz[inside]
    pixel = [
        np.clip(np.where(np.isfinite(place), place, size / 2), 0.0, size)
        for place, size in zip((line, sample), camera.shape, strict=True)
    ]
    origin = camera.origin(*pixel)
    sun = _sun(camera, sun_position, pixel)
    geometry = viewing_geometry(xyz, normals, origin if sun is None else sun, origin)
    is_on_image = camera.contains(line, sample) & np.isfinite(geometry.cos_emission)
    is_seen = is_on_image & (geometry.cos_emission > 0)
    if is_seen.any():
        is_seen &= sunlit(grid, heights, origin, window)
    is_lit = np.ones(window.shape, bool)
    if sun is None:
        geometry.cos_incidence[:] = geometry.phase[:] = np.nan
    else:
        is_lit = (geometry.cos_incidence > 0) & sunlit(grid, heights, sun, window)
    return GroundTile(line, sample, per_post, geometry, is_on_image, is_lit, is_seen)


def _sun(camera, sun_position, pixel):
    if sun_position is not None:
        return np.asarray(sun_position, float)
    return camera.sun(*pixel) if camera.sun_position is not None else None


def needed_pixels(line, sample, shape, margin=2):
    """The part of an image that posts show.

    Parameters
    ----------
    line, sample : array (rows, cols), px
        NaN where the camera does not look.
    shape : tuple of int
        Lines and samples of the image.
    margin : int, px
        For the neighbours that interpolation looks at.

    Returns
    -------
    window : Window
        In pixels; empty when the posts show none.
    """
    lines, samples = shape
    seen = (line >= 0) & (line <= lines) & (sample >= 0) & (sample <= samples)
    if not seen.any():
        return Window(0, 0, 0, 0)
    ends = [(int(x[seen].min()) - margin, int(x[seen].max()) + margin + 1) for x in (line, sample)]
    (line, last_line), (sample, last_sample) = ends
    window = Window(line, sample, last_line - line, last_sample - sample)
    return window.intersection(Window(0, 0, *shape))


def resample_image(image, line, sample, per_post):
    """Image values at the posts of a tile: means over each post's area, or interpolated.

    A post that spans more than `AREA_MEAN_FROM` pixels gets the mean over the parallelogram that
    stands for it in the image, others a cubic interpolation. Missing pixels do not leak: a mean
    needs half of its samples.

    Parameters
    ----------
    image : float32 array (lines, samples)
        NaN where missing.
    line, sample : array (rows, cols), px
        CSM coordinates within the array.
    per_post : array (4, rows, cols), px
        See `GroundTile`.

    Returns
    -------
    values : float32 array (rows, cols), NaN outside the image and where it is missing
    """
    values = np.empty(line.shape, np.float32)
    with threads_for(values.shape):
        _resample(image, line - 0.5, sample - 0.5, *per_post, values)
    return values


@njit(cache=True, parallel=True)
def _resample(image, line, sample, line_row, sample_row, line_col, sample_col, values):
    for i in prange(values.shape[0]):
        r = np.int64(i)
        for c in range(values.shape[1]):
            along_row = np.hypot(line_row[r, c], sample_row[r, c])
            along_col = np.hypot(line_col[r, c], sample_col[r, c])
            if not max(along_row, along_col) > AREA_MEAN_FROM:
                values[r, c] = sample_cubic(image, np.float32(line[r, c]), np.float32(sample[r, c]))
                continue
            rows = min(max(np.int64(np.ceil(along_row)), 1), FINEST_MEAN)
            cols = min(max(np.int64(np.ceil(along_col)), 1), FINEST_MEAN)
            total, count = 0.0, 0
            for m in range(rows):
                v = (m + 0.5) / rows - 0.5
                for n in range(cols):
                    h = (n + 0.5) / cols - 0.5
                    value = sample_linear(
                        image,
                        np.float32(line[r, c] + v * line_row[r, c] + h * line_col[r, c]),
                        np.float32(sample[r, c] + v * sample_row[r, c] + h * sample_col[r, c]),
                    )
                    if not np.isnan(value):
                        total += value
                        count += 1
            is_known = 2 * count >= rows * cols
            values[r, c] = np.float32(total / count) if is_known else np.float32(np.nan)
