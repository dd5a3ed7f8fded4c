"""Reflectance models: closed forms, limits, symmetry, derivatives, twins, messages."""

import pickle
from importlib.metadata import EntryPoint

import numpy as np
import pytest

import lommel.core.user_reflectance as loader
from lommel.core.reflectance import (
    LAWS,
    hapke,
    lambert,
    lommel_seeliger,
    lunar_lambert,
    lunar_lambert_exponential,
    lunar_lambert_weight,
    minnaert,
    phase_factor,
    reflectance_model,
    user_model,
)
from lommel.core.reflectance_kernels import KINDS, blend, multiple_scattering, power
from lommel.errors import InputError

ROUNDING = 1e-12  # relative, a few thousand units of float64 rounding
TAYLOR = 1e-8  # relative to 1 + |derivative|; central differences of step 1e-5 err by 1e-10 R'''
FLOAT32 = 2e-6  # of the largest value, some twenty units of float32 rounding
FACTOR = (1.4, 0.5)  # c1, c2 of the phase factor

every_model = pytest.mark.parametrize("name", LAWS)


def possible_geometries(count=500, largest_deg=80.0):
    """Cosines and phase of facets lit and seen from within ``largest_deg`` of the normal."""
    random = np.random.default_rng(20)
    incidence, emission = np.radians(random.uniform(0, largest_deg, (2, count)))
    azimuth = random.uniform(0, np.pi, count)
    mu0, mu = np.cos(incidence), np.cos(emission)
    return mu0, mu, np.arccos(mu0 * mu + np.sin(incidence) * np.sin(emission) * np.cos(azimuth))


def minnaert_squared(cos_incidence, cos_emission, phase, strength=1.0):
    """A law of a user: strength * mu0^2 * exp(-phase), independent of emission."""
    decay = strength * np.exp(-phase)
    return cos_incidence**2 * decay, 2 * cos_incidence * decay, np.zeros_like(cos_emission)


def wrong_in_emission(cos_incidence, cos_emission, phase):
    """A law whose second derivative has the wrong sign."""
    return cos_incidence * cos_emission, cos_emission, -cos_incidence


def needs_a_value(cos_incidence, cos_emission, phase, strength):
    return minnaert_squared(cos_incidence, cos_emission, phase, strength)


# closed forms


def test_lunar_lambert_has_its_closed_form_for_half_weight():
    # (1 - 1/2) 0.6 + 2 * 1/2 * 0.6 / (0.6 + 0.9)
    assert lunar_lambert(0.6, 0.9, 0.5) == pytest.approx(0.7, rel=ROUNDING)


def test_exponential_lunar_lambert_has_its_closed_form_for_half_weight():
    assert lunar_lambert_exponential(0.6, 0.9, 0.5) == pytest.approx(0.5, rel=ROUNDING)


def test_hapke_without_surge_scattering_evenly_has_its_closed_form():
    # b = 0: P = 1; w = 0.75: gamma = 1/2, H(1) = 3/2, H(1/2) = 4/3
    expected = 0.75 / 4 * 0.5 / 1.5 * (1.5 * 4 / 3)
    modelled = hapke(0.5, 1.0, 1.0, w=0.75, b=0.0, c=0.0, B0=0.0)
    assert modelled == pytest.approx(expected, rel=ROUNDING)


def test_hapke_surge_doubles_single_scattering_at_zero_phase():
    dark = {"w": 1e-6, "b": 0.0, "c": 0.0, "h": 0.05}  # multiple scattering is negligible
    ratio = hapke(0.8, 0.8, 0.0, B0=1.0, **dark) / hapke(0.8, 0.8, 0.0, B0=0.0, **dark)
    assert ratio == pytest.approx(2.0, rel=1e-5)


def test_hapke_scatters_backward_when_c_is_positive():
    lobe = {"b": 0.3, "B0": 0.0}
    assert hapke(0.8, 0.8, 0.2, c=0.9, **lobe) > hapke(0.8, 0.8, 0.2, c=-0.9, **lobe)


def test_polynomial_weight_takes_published_values():
    degrees = np.array([0.0, 10.0, 50.0, 100.0])
    published = [1.0, 0.83274, 0.4725, 0.06]  # 1 + A a + B a^2 + C a^3 by hand
    assert lunar_lambert_weight(np.radians(degrees)) == pytest.approx(published, rel=1e-9)


def test_polynomial_weight_falls_to_zero_near_104_degrees_and_stays_there():
    weight = lunar_lambert_weight(np.radians(np.arange(0.0, 181.0)))
    assert (np.diff(weight) <= 0).all()
    assert weight[103] > 0 and (weight[105:] == 0).all()


def test_exponential_model_decays_by_1_over_e_in_60_degrees():
    share, _ = reflectance_model("lunar-lambert-exponential").phase_terms(np.radians(60.0))
    assert share == pytest.approx(np.exp(-1), rel=ROUNDING)


def test_phase_factor_multiplies_reflectance_and_both_derivatives():
    geometry = possible_geometries()
    plain = reflectance_model().with_derivatives(*geometry)
    dimmed = reflectance_model(phase_factor=FACTOR).with_derivatives(*geometry)
    factor = np.exp(-1.4 * geometry[2]) + 0.5
    assert np.allclose(dimmed, factor * np.array(plain), rtol=ROUNDING, atol=0)


# limits and symmetries


def test_lunar_lambert_equals_lambert_when_weight_is_zero():
    mu0, mu, _ = possible_geometries()
    assert np.allclose(lunar_lambert(mu0, mu, 0.0), mu0, rtol=ROUNDING, atol=0)
    assert np.array_equal(lambert(mu0, mu), lunar_lambert(mu0, mu, 0.0))


def test_lunar_lambert_equals_lommel_seeliger_when_weight_is_one():
    mu0, mu, _ = possible_geometries()
    assert np.allclose(lommel_seeliger(mu0, mu), 2 * mu0 / (mu0 + mu), rtol=ROUNDING, atol=0)
    assert np.array_equal(lommel_seeliger(mu0, mu), lunar_lambert(mu0, mu, 1.0))


def test_minnaert_equals_lambert_when_k_is_one():
    mu0, mu, _ = possible_geometries()
    assert np.allclose(minnaert(mu0, mu, 1.0), mu0, rtol=ROUNDING, atol=0)


@pytest.mark.parametrize("weight", [0.25, 1.0])
def test_printed_lunar_lambert_forms_differ_by_2_in_their_lommel_seeliger_term(weight):
    mu0, mu, _ = possible_geometries()
    lambert_term = (1 - weight) * mu0
    term = lunar_lambert(mu0, mu, weight) - lambert_term
    term_exponential = lunar_lambert_exponential(mu0, mu, weight) - lambert_term
    assert np.allclose(term, 2 * term_exponential, rtol=1e-10, atol=0)


@pytest.mark.parametrize("name", ["lommel-seeliger", "minnaert", "hapke"])
def test_model_is_reciprocal(name):
    """Helmholtz: R / mu0 keeps its value when Sun and camera change places."""
    mu0, mu, phase = possible_geometries()
    model = reflectance_model(name)
    there = model.reflectance(mu0, mu, phase) / mu0
    back = model.reflectance(mu, mu0, phase) / mu
    assert np.allclose(there, back, rtol=ROUNDING, atol=0)


@every_model
def test_facet_unlit_unseen_or_nan_has_zero_reflectance_and_derivatives(name):
    mu0 = np.array([0.0, -0.3, 0.5, 0.5, np.nan, 0.5])
    mu = np.array([0.5, 0.5, 0.0, -0.3, 0.5, np.nan])
    terms = reflectance_model(name, FACTOR).with_derivatives(mu0, mu, np.full(6, 0.7))
    assert np.array_equal(terms, np.zeros((3, 6)))


@every_model
def test_float32_rows_stay_float32(name):
    geometry = [array.astype(np.float32) for array in possible_geometries()]
    terms = reflectance_model(name, FACTOR).with_derivatives(*geometry)
    assert {term.dtype for term in terms} == {np.dtype(np.float32)}


@every_model
def test_one_phase_serves_a_whole_array_of_cosines(name):
    mu0, mu, _ = possible_geometries()
    model = reflectance_model(name, FACTOR)
    whole = model.with_derivatives(mu0, mu, np.full(mu0.shape, 0.6))
    assert np.allclose(model.with_derivatives(mu0, mu, 0.6), whole, rtol=ROUNDING, atol=0)


# derivatives


@pytest.mark.parametrize("factor", [None, FACTOR])
@every_model
def test_derivatives_match_central_differences(name, factor):
    mu0, mu, phase = possible_geometries()
    model = reflectance_model(name, factor)
    _, d_incidence, d_emission = model.with_derivatives(mu0, mu, phase)

    def change(step0, step):
        ahead = model.reflectance(mu0 + step0, mu + step, phase)
        return (ahead - model.reflectance(mu0 - step0, mu - step, phase)) / 2e-5

    assert change(1e-5, 0) == pytest.approx(d_incidence, rel=TAYLOR, abs=TAYLOR)
    assert change(0, 1e-5) == pytest.approx(d_emission, rel=TAYLOR, abs=TAYLOR)


# compiled twin


@every_model
def test_compiled_twin_equals_plain_model(name):
    mu0, mu, phase = possible_geometries()
    mu0[::50], mu[1::50] = -0.2, 0.0  # some facets unlit, some unseen
    model = reflectance_model(name, FACTOR)
    plain = np.array(model.with_derivatives(mu0, mu, phase))
    arguments = np.stack([mu0, mu, *model.phase_terms(phase)]).astype(np.float32)
    compiled = {"blend": blend, "power": power, "multiple-scattering": multiple_scattering}
    twin = {KINDS[name]: function for name, function in compiled.items()}[model.kind]
    constant = np.float32(model.parameter_array()[0])
    values = np.array([twin(constant, *facet) for facet in arguments.T]).T
    largest = np.abs(plain).max(axis=1, keepdims=True)
    assert np.all(np.abs(values - plain) <= FLOAT32 * largest)


# user-defined laws


def test_user_function_becomes_a_model_with_its_parameters_and_masks():
    mu0, mu, phase = possible_geometries()
    model = user_model(minnaert_squared, "mine", strength=2.0)
    assert model.kind == -1 and model.parameters == {"strength": 2.0}
    expected = 2 * mu0**2 * np.exp(-phase)
    assert np.allclose(model.reflectance(mu0, mu, phase), expected, rtol=ROUNDING, atol=0)
    assert np.array_equal(model.with_derivatives(-mu0, mu, phase), np.zeros((3, mu0.size)))


def test_user_function_is_loaded_from_module_and_function(monkeypatch, tmp_path):
    (tmp_path / "my_laws.py").write_text(
        "def flat(mu0, mu, phase):\n    return mu0, 0 * mu0 + 1, 0 * mu\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    model = reflectance_model("my_laws:flat", phase_factor=FACTOR)
    expected = 0.5 * phase_factor(0.3, *FACTOR)
    assert model.reflectance(0.5, 0.9, 0.3) == pytest.approx(expected, rel=ROUNDING)


def test_user_function_is_loaded_from_an_entry_point(monkeypatch, tmp_path):
    (tmp_path / "installed_laws.py").write_text(
        "def flat(mu0, mu, phase, size=3.0):\n    return size * mu0, 0 * mu0 + size, 0 * mu\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    entry = EntryPoint("flat", "installed_laws:flat", "lommel.reflectance")
    installed = {(entry.group, entry.name): [entry]}
    monkeypatch.setattr(loader, "entry_points", lambda group, name: installed[group, name])
    assert reflectance_model("flat").parameters == {"size": 3.0}


@every_model
def test_models_survive_pickling(name):
    model = reflectance_model(name, FACTOR)
    assert pickle.loads(pickle.dumps(model)) == model


# messages


@pytest.mark.parametrize(
    "request_model, message",
    [
        (lambda: reflectance_model("lambertian"), "Choose one of lunar-lambert, .*hapke"),
        (lambda: reflectance_model("minnaert", K=0.5), "no parameter 'K'. It takes k"),
        (lambda: reflectance_model("lambert", k=0.5), "It takes no parameters"),
        (lambda: reflectance_model("hapke", w=1.2), "w = 1.2 .* from 0 to 1"),
        (lambda: reflectance_model("minnaert", k=np.nan), "k = nan"),
        (lambda: reflectance_model(phase_factor=(1.0, -0.1)), "c2 not negative"),
        (lambda: reflectance_model("no_such_module:law"), "no_such_module.*PYTHONPATH"),
        (lambda: reflectance_model("math:no_such_law"), "no_such_law.*PYTHONPATH"),
        (lambda: user_model(minnaert_squared, "mine", weight=1.0), "It takes strength"),
        (lambda: user_model(needs_a_value, "mine"), "needs a value for strength"),
        (lambda: user_model(wrong_in_emission, "mine"), "dR/dcos_emission is -.* Correct"),
        (lambda: user_model(lambda mu0, mu, phase: mu0, "mine"), "return three arrays"),
        (
            lambda: user_model(lambda mu0, mu, phase: (mu0, np.nan * mu0, 0 * mu), "mine"),
            "not finite",
        ),
    ],
)
def test_wrong_request_is_refused_with_what_is_allowed(request_model, message):
    with pytest.raises(InputError, match=message):
        request_model()
