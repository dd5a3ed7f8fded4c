"""Which posts of a DEM were measured: tracks in a triangulation, and terrain measured all over."""

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import binary_dilation, gaussian_filter, map_coordinates

from lommel.estimate.measured_posts import measured_posts


def terrain(size=160, seed=0):
    """Fractal heights, m."""
    rng = np.random.default_rng(seed)
    k = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None])
    field = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(size, size))) / np.maximum(k, 0.01) ** 1.8)
    return 50 * field / field.std()


def triangulated(heights, columns, spots=3, seed=1):
    """What linear interpolation makes of spots along nearly straight tracks; where they lie."""
    rng = np.random.default_rng(seed)
    rows = np.arange(0, heights.shape[0], 2)
    points = [
        np.stack([rows, column + rng.integers(0, 2, rows.size)], axis=1)
        for track in columns
        for column in range(track, track + 2 * spots, 2)
    ]
    points = np.concatenate(points)
    points = points[points[:, 1] < heights.shape[1]]
    values = heights[points[:, 0], points[:, 1]]
    everywhere = LinearNDInterpolator(points, values)(*np.indices(heights.shape))
    at = np.zeros(heights.shape, bool)
    at[points[:, 0], points[:, 1]] = True
    return everywhere.astype(np.float32), at


@pytest.mark.parametrize(("spots", "found"), [(3, 0.98), (1, 0.6)])
def test_tracks_are_found_and_the_planes_between_them_are_not(spots, found):
    """All of a track several spots wide, as of LOLA; of a single line enough to hold a surface."""
    dem, at = triangulated(terrain(), (10, 34, 80, 93, 140), spots)
    measured = measured_posts(dem)
    inside = at.copy()
    inside[:3], inside[-3:] = False, False
    inside[:, :30], inside[:, 100:] = False, False  # beside the edge of the data too little is seen
    assert binary_dilation(measured, np.ones((3, 3)))[inside].mean() > found
    near = binary_dilation(at, iterations=3)
    assert (measured & ~near).sum() < 0.02 * measured.sum()


@pytest.mark.parametrize("blur", [0.0, 2.0, 10.0, 25.0])
def test_terrain_measured_all_over_is_recognised_however_smooth(blur):
    heights = gaussian_filter(terrain(300), blur) if blur else terrain(300)
    assert measured_posts(heights.astype(np.float32)) is None


def test_whole_metres_and_holes_do_not_deceive():
    heights = np.round(terrain(300)).astype(np.float32)
    heights[40:90, 100:180] = np.nan
    assert measured_posts(heights) is None


def test_a_plane_and_an_empty_dem_hold_no_measurement_to_pin():
    assert measured_posts(np.zeros((50, 50), np.float32)) is None
    assert measured_posts(np.full((50, 50), np.nan, np.float32)) is None


def test_tracks_beside_a_steep_kink_and_at_the_border_are_found():
    """The triangles beyond the last track may rise steeply: what they do says nothing about it."""
    heights = terrain()
    dem, at = triangulated(heights, (6, 60, 120))
    dem[:, :5] = dem[:, 5:6] + 40 * np.arange(5, 0, -1, dtype=np.float32)
    measured = measured_posts(dem)
    last = at.copy()
    last[:, :8], last[:, 14:] = False, False
    assert binary_dilation(measured, np.ones((3, 3)))[last].mean() > 0.9


@pytest.mark.parametrize("step", [0.1, 0.5, 1.0])
def test_rounded_heights_are_not_taken_for_planes(step):
    heights = np.round(gaussian_filter(terrain(300), 6.0) / step) * step
    assert measured_posts(heights.astype(np.float32)) is None


def test_a_dem_resampled_linearly_to_smaller_posts_is_measured_all_over():
    coarse = terrain(60)
    rows, cols = np.indices((295, 295)) / 5.0
    heights = map_coordinates(coarse, [rows, cols], order=1).astype(np.float32)
    assert measured_posts(heights) is None
