import numpy as np
import pytest

from lommel.errors import InputError
from lommel.scene.distortion import MODELS, Distortion
from lommel.scene.distortion_kernels import closed_form

MICROMETRE = 1e-3  # mm
CLOSE = 5e-7  # mm; 1e-4 of a pixel of 5 um

APOLLO_METRIC = (-0.006, -0.002, -1.34e-6, 5.23e-10, -5.07e-14, -5.50e-7, -4.61e-11, 2.966)
KAGUYA_TC = (-0.0725, -9.65e-4, 9.84e-4, 8.58e-6, -3.74e-6)
KAGUYA_TC += (0.0214, -1.38e-3, 1.35e-5, 2.73e-6, -6.19e-6)
CUBIC = (0.01, 0.99, 2e-3, 1e-5, -2e-5, 3e-5, 1e-6, -2e-6, 3e-6, 4e-6)
CUBIC += (-0.02, 1e-3, 1.01, 3e-5, 2e-5, 1e-5, 2e-6, 3e-6, -1e-6, 2e-6)
LENSES = {  # with the half width of the detector, mm
    "radial": (Distortion("radial", (1e-3, -8e-7, 2e-11)), 40.0),
    "brown-conrady": (Distortion("brown-conrady", APOLLO_METRIC), 57.0),
    "radtan": (Distortion("radtan", (-0.12, 0.05, 1e-3, -2e-3, 0.01), unit=76.0), 40.0),
    "transverse": (Distortion("transverse", CUBIC), 20.0),
    "kaguyalism": (Distortion("kaguyalism", KAGUYA_TC), 15.0),
    "lrolrocnac": (Distortion("lrolrocnac", (1.81e-5,)), 18.0),
}


@pytest.fixture(params=LENSES, ids=str)
def lens(request):
    return LENSES[request.param]


def on_detector(half_width):
    side = np.linspace(-half_width, half_width, 41)
    return np.meshgrid(side, side)


def test_every_model_but_none_is_tested():
    assert set(LENSES) | {"none"} == set(MODELS)


def test_distortion_is_undone_over_the_detector(lens):
    distortion, half_width = lens
    place = on_detector(half_width)
    there_and_back = distortion.undistort(*distortion.distort(*place))
    back_and_there = distortion.distort(*distortion.undistort(*place))
    np.testing.assert_allclose(there_and_back, place, rtol=0, atol=CLOSE)
    np.testing.assert_allclose(back_and_there, place, rtol=0, atol=CLOSE)


def test_distortion_moves_places_by_more_than_the_test_above_allows(lens):
    distortion, half_width = lens
    moved = np.subtract(
        distortion.distort(half_width, half_width / 2), (half_width, half_width / 2)
    )
    assert np.abs(moved).max() > MICROMETRE


def test_derivatives_agree_with_finite_differences(lens):
    distortion, half_width = lens
    kind, coefficients = distortion.lens.kind, distortion.lens.coefficients
    step = 1e-5
    for x, y in np.random.default_rng(2).uniform(-1, 1, (20, 2)) * half_width / distortion.unit:
        analytic = closed_form(kind, coefficients, x, y)[2:]
        right, left = (closed_form(kind, coefficients, x + s, y)[:2] for s in (step, -step))
        below, above = (closed_form(kind, coefficients, x, y + s)[:2] for s in (step, -step))
        along_x, along_y = np.subtract(right, left), np.subtract(below, above)
        expected = np.ravel([along_x, along_y], order="F") / (2 * step)
        # 1e-8: rounding of 1e-14 over a step of 1e-5, and the third derivative times its square
        np.testing.assert_allclose(analytic, expected, rtol=0, atol=1e-8)


def test_radial_removes_what_its_polynomial_says():
    """ISIS subtracts the fraction: dr/r = 0.01 + 1e-4 * 25 at (3, 4)."""
    x, y = Distortion("radial", (0.01, 1e-4, 0.0)).undistort(3.0, 4.0)
    assert (float(x), float(y)) == pytest.approx((3 * 0.9875, 4 * 0.9875), abs=1e-14)


def test_brown_conrady_is_apollos_formula_in_polar_form():
    xp, yp, k1, k2, k3, p1, p2, phi = APOLLO_METRIC
    x, y = on_detector(57.0)
    radius, azimuth = np.hypot(x - xp, y - yp), np.arctan2(y - yp, x - xp)
    radial = radius + k1 * radius**3 + k2 * radius**5 + k3 * radius**7
    shift = p1 * radius**2 + p2 * radius**4
    expected = (
        radial * np.cos(azimuth) + shift * np.cos(phi + np.pi / 2),
        radial * np.sin(azimuth) + shift * np.sin(phi + np.pi / 2),
    )
    found = Distortion("brown-conrady", APOLLO_METRIC).undistort(x, y)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_brown_conrady_seen_from_behind_mirrors_its_angle():
    xp, yp, *middle, phi = APOLLO_METRIC
    behind = Distortion("brown-conrady", (xp, -yp, *middle, np.pi - phi))
    x, y = on_detector(57.0)
    x_front, y_front = Distortion("brown-conrady", APOLLO_METRIC).undistort(x, y)
    x_behind, y_behind = behind.undistort(x, -y)
    np.testing.assert_allclose((x_behind, -y_behind), (x_front, y_front), rtol=0, atol=1e-12)


def test_radtan_is_opencvs_formula():
    """Terms of OpenCV's calib3d documentation, written out at (0.3, -0.2): r^2 = 0.13."""
    x, y = Distortion("radtan", (0.1, 0.2, 0.01, 0.02, 0.3)).distort(0.3, -0.2)
    factor = 1 + 0.1 * 0.13 + 0.2 * 0.13**2 + 0.3 * 0.13**3
    assert float(x) == pytest.approx(
        0.3 * factor + 2 * 0.01 * 0.3 * -0.2 + 0.02 * (0.13 + 2 * 0.09), abs=1e-15
    )
    assert float(y) == pytest.approx(
        -0.2 * factor + 0.01 * (0.13 + 2 * 0.04) + 2 * 0.02 * 0.3 * -0.2, abs=1e-15
    )


def test_transverse_orders_its_terms_as_isds_do():
    x, y = 2.0, 3.0
    terms = [1, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
    found = Distortion("transverse", CUBIC).distort(x, y)
    expected = (np.dot(CUBIC[:10], terms), np.dot(CUBIC[10:], terms))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def test_kaguya_adds_boresight_and_a_polynomial_of_the_distance():
    x, y = Distortion("kaguyalism", KAGUYA_TC).undistort(3.0, -4.0)
    powers = 5.0 ** np.arange(4)
    assert float(x) == pytest.approx(3 + KAGUYA_TC[0] + np.dot(KAGUYA_TC[1:5], powers), abs=1e-14)
    assert float(y) == pytest.approx(-4 + KAGUYA_TC[5] + np.dot(KAGUYA_TC[6:], powers), abs=1e-14)


def test_lro_nac_distorts_along_the_detector_only():
    x, y = Distortion("lrolrocnac", (1.81e-5,)).undistort(1.0, 15.0)
    assert float(x) == 1.0
    assert float(y) == pytest.approx(15.0 / (1 + 1.81e-5 * 225), abs=1e-14)


def test_no_place_is_given_where_the_image_folds_over():
    """Undistorted r (1 - k r^2) has its maximum at r = 1 / sqrt(3 k), here 10 mm: 6.67 mm."""
    distortion = Distortion("radial", (0.0, 1 / 300.0, 0.0))
    assert np.isfinite(distortion.undistort(9.8, 0.0)).all()
    assert np.isnan(distortion.undistort(10.2, 0.0)).all()
    inside, _ = distortion.distort(np.array([0.0, 3.0, 6.6]), 0.0)
    assert (inside < 10.0).all()  # the branch that begins at the axis
    assert np.isnan(distortion.distort(np.array([6.7, 8.0, 1e3, np.nan, np.inf]), 0.0)).all()


def test_folding_of_a_distorting_model_is_found_too():
    distortion = Distortion("radtan", (-1 / 3.0, 0.0, 0.0, 0.0, 0.0))
    assert np.isfinite(distortion.distort(0.98, 0.0)).all()
    assert np.isnan(distortion.distort(1.02, 0.0)).all()
    assert np.isnan(distortion.undistort(0.7, 0.0)).all()


def test_pole_of_a_negative_nac_coefficient_ends_its_reach():
    """1 / (1 + k y^2) has its pole at y = 1 / sqrt(-k), here 10 mm."""
    distortion = Distortion("lrolrocnac", (-0.01,))
    assert np.isfinite(distortion.undistort(0.0, 9.8)).all()
    assert np.isnan(distortion.undistort(0.0, np.array([10.0, 10.2]))).all()
    x, y = distortion.distort(0.0, np.array([5.0, 40.0]))
    np.testing.assert_allclose(distortion.undistort(x, y)[1], [5.0, 40.0], rtol=0, atol=CLOSE)


def test_unit_carries_a_model_to_a_plane_in_pixels():
    in_mm = Distortion("brown-conrady", APOLLO_METRIC).distort(20.0, -30.0)
    in_pixels = Distortion("brown-conrady", APOLLO_METRIC, unit=200.0).distort(4000.0, -6000.0)
    np.testing.assert_allclose(in_pixels, 200.0 * np.array(in_mm), rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("fisheye", (), "fisheye is not known. Give one of none, radial"),
        ("radial", (1.0, 2.0), "it needs 3 finite numbers"),
        ("lrolrocnac", (np.nan,), "it needs 1 finite numbers"),
        ("radial", (1.0, 0.0, 0.0), "cannot be inverted even at the optical axis"),
    ],
)
def test_wrong_distortion_is_refused_with_the_remedy(model, coefficients, message):
    with pytest.raises(InputError, match=message):
        Distortion(model, coefficients)
