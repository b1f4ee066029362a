"""Settings of the likelihood, changed from outside the model."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from numpyro.infer.util import log_density

import lfm_ppl as lfm
from lfm_ppl.inference.handlers.settings import approximate

TIMES = jnp.arange(4.0)
Y = jnp.array([[0.3], [-0.2], [0.9], [0.1]])


def build(rate):
    return lfm.LatentForceModel(
        dynamics=lambda x, u, t: u - rate * x**3,
        forces={"u": lfm.Matern(1.0, 1.0)},
        observation=lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        initial_state=lfm.Gaussian(jnp.zeros(1), jnp.eye(1)),
    )


def model(times, y=None):
    numpyro.sample("y", lfm.MarginalLikelihood(build(1.0), times, steps=3), obs=y)


def two(times, y=None):
    with numpyro.plate("series", 2):
        numpyro.sample("y", lfm.panel(build, jnp.array([0.5, 1.0]), times, steps=3), obs=y)


def trace(fn, *arguments):
    return numpyro.handlers.trace(numpyro.handlers.seed(fn, jax.random.key(0))).get_trace(*arguments)


def test_what_is_given_replaces_what_the_model_says():
    settings = {"rule": lfm.GaussHermite(3), "steps": 5, "max_step": 0.1, "iterations": 1}
    result = trace(approximate(model, **settings, damping=0.5), TIMES, Y)["y"]["fn"]
    assert {name: getattr(result, name) for name in settings} == settings
    assert result.damping == 0.5


def test_what_is_not_given_stays():
    result = trace(approximate(model, rule=None, steps=None, max_step=0.5), TIMES, Y)["y"]["fn"]
    assert (result.steps, result.max_step) == (3, 0.5)
    assert isinstance(result.rule, lfm.Cubature)


def test_the_density_is_that_of_a_model_written_with_the_settings():
    def written(times, y):
        likelihood = lfm.MarginalLikelihood(build(1.0), times, rule=lfm.Taylor(), steps=8)
        numpyro.sample("y", likelihood, obs=y)

    changed = approximate(model, rule=lfm.Taylor(), steps=8)
    expected, _ = log_density(written, (TIMES, Y), {}, {})
    result, _ = log_density(changed, (TIMES, Y), {}, {})
    np.testing.assert_allclose(result, expected, rtol=1e-12)
    plain, _ = log_density(model, (TIMES, Y), {}, {})
    assert abs(float(plain - expected)) > 1e-3


def test_panels_take_settings_too():
    result = trace(approximate(two, steps=9), TIMES, jnp.stack([Y, Y]))["y"]["fn"]
    assert result.first.steps == 9


def test_a_model_without_the_site_and_an_unknown_setting():
    def plain(times, y=None):
        numpyro.sample("y", numpyro.distributions.Normal(0.0, 1.0), obs=y)

    with pytest.raises(ValueError, match="has no likelihood whose steps could be set"):
        trace(approximate(plain, steps=3), TIMES, 0.5)
    with pytest.raises(TypeError, match="unknown setting 'step'; known: rule, steps"):
        approximate(model, step=3)


@pytest.mark.parametrize("given", [{"steps": 5}, {"iterations": 2}, {"steps": 5, "tolerance": 1e-4}, {"max_step": 0.5}])
def test_steps_or_iterations_alone_are_equal_steps(given):
    def tolerant(times, y=None):
        numpyro.sample("y", lfm.MarginalLikelihood(build(1.0), times, steps=3, tolerance=1e-2), obs=y)

    def tolerant_panel(times, y=None):
        with numpyro.plate("series", 2):
            numpyro.sample("y", lfm.panel(build, jnp.array([0.5, 1.0]), times, steps=3, tolerance=1e-2), obs=y)

    kept = {"max_step"} >= set(given)
    expected = given.get("tolerance", 1e-2 if kept else None)
    assert trace(approximate(tolerant, **given), TIMES, Y)["y"]["fn"].tolerance == expected
    panel = trace(approximate(tolerant_panel, **given), TIMES, jnp.stack([Y, Y]))["y"]["fn"]
    assert panel.settings["tolerance"] == expected


@pytest.mark.parametrize(("given", "expected"), [
    ({"tolerance": 1e-3}, 0), pytest.param({"lower": {"u": -9.0}}, 0, marks=pytest.mark.slow),
    ({"constraints": lambda x, u, t: u + 9.0}, 0),
    ({"tolerance": 1e-3, "iterations": 0}, 0), ({"steps": 5}, 2), ({"iterations": 4}, 4), ({"lower": {}}, 2)])
def test_a_tolerance_or_constraints_end_the_iterations_of_the_model(given, expected):
    def iterated(times, y=None):
        numpyro.sample("y", lfm.MarginalLikelihood(build(1.0), times, steps=3, iterations=2), obs=y)

    assert trace(approximate(iterated, **given), TIMES)["y"]["fn"].iterations == expected
    with pytest.raises(ValueError, match=r"leave out tolerance=0.001 or iterations"):
        trace(approximate(iterated, tolerance=1e-3, iterations=3), TIMES)
