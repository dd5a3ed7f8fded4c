"""Cameras of real images against what ISIS itself answers."""

import json

import numpy as np
import pytest

from lommel.io.cameras import find_camera, read_camera
from lommel.io.isis import read_isis
from lommel.io.raster import raster_info
from lommel.run.ground_point import describe_pixel
from lommel.scene.body import MOON, to_xyz
from lommel.scene.intersection import meet_sphere

pytestmark = pytest.mark.real_data

GROUND = 1e-3  # m; found: 1.5e-6. The readers promise 5 cm
ANGLE = 1e-7  # degrees; found: 1e-9
PIXEL = 1e-3  # px; found: 1e-4 (line scan)
CUBES = {
    "AS15-M-0297_crop.cub": "apollo15-farside",
    "AS15-M-1134-hadley.cub": "apollo15-hadley-lola",
    "M143947267L.cal.echo.crop.cub": "lro-nac",
}


def isis_points(real_data, name):
    """ISIS 9's answers: sample and line in CSM's count, ground points, angles in degrees."""
    reference = real_data(".") / "isis-campt.json"
    points = json.loads(reference.read_text(encoding="utf-8"))["points"][name]
    column = {key: np.array([point[key] for point in points]) for key in points[0]}
    xyz = to_xyz(MOON, np.radians(column["longitude_deg"]), np.radians(column["latitude_deg"]), 0.0)
    return column["line"] - 0.5, column["sample"] - 0.5, xyz, column


@pytest.mark.parametrize("name", CUBES)
def test_rays_meet_the_sphere_where_isis_sees_it(real_data, name):
    path = real_data(CUBES[name]) / name
    camera = read_camera(find_camera(path), raster_info(path).shape)
    line, sample, xyz, _ = isis_points(real_data, name)
    found = meet_sphere(camera.origin(line, sample), camera.ray(line, sample), MOON.radius)
    assert np.linalg.norm(found - xyz, axis=-1).max() < GROUND


@pytest.mark.parametrize("name", CUBES)
def test_ground_points_project_to_the_pixels_of_isis(real_data, name):
    path = real_data(CUBES[name]) / name
    line, sample, xyz, _ = isis_points(real_data, name)
    found = read_isis(path, raster_info(path).shape).project(xyz)
    np.testing.assert_allclose(found, (line, sample), rtol=0, atol=PIXEL)


@pytest.mark.parametrize("name", CUBES)
def test_angles_are_those_of_isis(real_data, name):
    path = real_data(CUBES[name]) / name
    line, sample, _, column = isis_points(real_data, name)
    for i in range(line.size):
        facts = describe_pixel(path, sample[i], line[i])
        for angle in ("incidence_deg", "emission_deg", "phase_deg"):
            assert facts[angle] == pytest.approx(column[angle][i], abs=ANGLE)


# campt of ISIS on LOLA's terrain, at two pixels of AS15-M-1134: the cube's own (375, 375), and
# (2862.5, 2862.5) of the whole frame reduced to 5725 pixels, before it was cropped. Pixels count
# from 1: 2862.5 lies half a pixel before the frame's centre, 2863
@pytest.mark.parametrize(
    ("longitude_deg", "latitude_deg", "radius", "pixel"),
    [
        (3.0122642527153, 25.429658072044, 1735684.7557107, 375.0 - 0.5),
        (4.3715181349105, 24.804600982201, 1737716.1266175, 2862.5 - 0.5),
    ],
)
def test_ground_point_of_campt_lies_on_its_pixel(
    real_data, longitude_deg, latitude_deg, radius, pixel
):
    path = real_data("apollo15-hadley-lola") / "AS15-M-1134-hadley.cub"
    xyz = to_xyz(MOON, np.radians(longitude_deg), np.radians(latitude_deg), radius - MOON.radius)
    line, sample = read_isis(path, raster_info(path).shape).project(xyz)
    if pixel > 750:  # from the crop to the whole reduced frame, whose pixels are 4 of the full one
        line, sample = line + (7996.5 - 0.5) / 4, sample + (4396.5 - 0.5) / 4
    assert (line, sample) == pytest.approx((pixel, pixel), abs=1e-6)  # 0.03 mm on the ground
