"""Registration of Apollo images to terrain that they were never registered to."""

import numpy as np
import pytest

from lommel.estimate.registration_matching import match
from lommel.run.inputs import SceneFiles
from lommel.run.match_terrain import image_pair
from lommel.run.raw_images import Terrain, read_raw_images
from lommel.run.register import register_images
from lommel.run.register_to_terrain import (
    RegistrationSettings,
    adjust,
    keep_matches,
    place_whole,
)

pytestmark = pytest.mark.real_data

HADLEY = (20.5, 50.5)  # lines, samples; docs/registration.md says how sure that is
PLACE = 3.0  # px, on a map of 79 m posts here; finer maps and patches reach 0.5 px


def read(folder, names, dem):
    images, skipped = read_raw_images(
        SceneFiles(tuple(folder / name for name in names), (folder / dem,))
    )
    assert not skipped
    return images, Terrain((folder / dem,))


def test_the_offset_of_the_hadley_frame_is_found(real_data):
    folder = real_data("apollo15-hadley-lola")
    images, terrain = read(folder, ["AS15-M-1134-hadley.cub"], "initial-dem.tif")
    settings = RegistrationSettings()
    state, matches, _ = place_whole(images[0], terrain, settings, posts=2**16)
    assert state.whole.is_distinct
    keep_matches(state, matches, adjust([state], matches, settings))
    np.testing.assert_allclose(state.shift, HADLEY, atol=PLACE)


def test_the_far_side_frames_fit_each_other_and_say_how_well_the_terrain_knows_them(real_data):
    folder = real_data("apollo15-farside")
    names = ["AS15-M-0297_crop.cub", "AS15-M-0298_crop.cub"]
    images, terrain = read(folder, names, "LDEM_4.IMG")
    states, failed = register_images(images, terrain, RegistrationSettings())
    assert not failed
    assert all(state.is_on_terrain and state.error > 500.0 for state in states)  # m
    site, pair = states[0].site, [state.corrected for state in states]
    grid = site.grid(pair, site.gsd)
    first, second, _ = image_pair(*pair, site, grid)(grid.window, 0)
    known = np.isfinite(first) & np.isfinite(second)
    assert known.mean() > 0.5
    assert np.corrcoef(first[known], second[known])[0, 1] > 0.95
    first, second, _ = image_pair(*pair, site, grid)(grid.window, 8)
    assert np.linalg.norm(match(first, second, 8).shift) < 0.5  # px
