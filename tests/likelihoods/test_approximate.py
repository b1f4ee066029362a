"""Settings of the likelihood, changed from outside the model."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from numpyro.infer.util import log_density

import lfm_ppl as lfm
from lfm_ppl.likelihoods.handlers.approximate import complete

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
    numpyro.sample("y", lfm.MarginalLikelihood(build(1.0), times, steps=3, iterations=0), obs=y)


def two(times, y=None):
    with numpyro.plate("series", 2):
        numpyro.sample("y", lfm.panel(build, jnp.array([0.5, 1.0]), times, steps=3), obs=y)


def trace(fn, *arguments):
    return numpyro.handlers.trace(numpyro.handlers.seed(fn, jax.random.key(0))).get_trace(*arguments)


def test_settings_replace_those_of_the_model_and_others_stay():
    settings = {"rule": lfm.GaussHermite(3), "steps": 5, "max_step": 0.1, "iterations": 1, "damping": 0.5}
    result = trace(lfm.approximate(model, **settings), TIMES, Y)["y"]["fn"]
    assert {name: getattr(result.settings, name) for name in settings} == settings
    result = trace(lfm.approximate(model, rule=None, steps=None, max_step=0.5), TIMES, Y)["y"]["fn"]
    assert (result.settings.steps, result.settings.max_step) == (3, 0.5)
    assert isinstance(result.settings.rule, lfm.Cubature)
    assert trace(lfm.approximate(two, steps=9), TIMES, jnp.stack([Y, Y]))["y"]["fn"].first.settings.steps == 9


def test_the_density_is_that_of_a_model_written_with_the_settings():
    def written(times, y):
        likelihood = lfm.MarginalLikelihood(build(1.0), times, rule=lfm.Taylor(), steps=2, iterations=0)
        numpyro.sample("y", likelihood, obs=y)

    changed = lfm.approximate(model, rule=lfm.Taylor(), steps=2)
    expected, result = (jax.jit(lambda y, model=model: log_density(model, (TIMES, y), {}, {})[0])(Y)
                        for model in (written, changed))
    np.testing.assert_allclose(result, expected, rtol=1e-12)


def test_a_model_without_the_site_and_an_unknown_setting():
    def plain(times, y=None):
        numpyro.sample("y", numpyro.distributions.Normal(0.0, 1.0), obs=y)

    with pytest.raises(ValueError, match="steps"):
        trace(lfm.approximate(plain, steps=3), TIMES, 0.5)
    with pytest.raises(TypeError, match="'step'"):
        lfm.approximate(model, step=3)


def test_steps_or_iterations_alone_are_equal_steps():
    def tolerant(times, y=None):
        numpyro.sample("y", lfm.MarginalLikelihood(build(1.0), times, steps=3, tolerance=1e-2), obs=y)

    def tolerant_panel(times, y=None):
        with numpyro.plate("series", 2):
            numpyro.sample("y", lfm.panel(build, jnp.array([0.5, 1.0]), times, steps=3, tolerance=1e-2), obs=y)

    for settings, expected in (({"steps": 5}, None), ({"iterations": 2}, None), ({"max_step": 0.5}, 1e-2),
                               ({"steps": 5, "tolerance": 1e-4}, 1e-4)):
        assert trace(lfm.approximate(tolerant, **settings), TIMES, Y)["y"]["fn"].settings.tolerance == expected
        panel = trace(lfm.approximate(tolerant_panel, **settings), TIMES, jnp.stack([Y, Y]))["y"]["fn"]
        assert panel.first.settings.tolerance == expected


@pytest.mark.parametrize(("settings", "expected"), [
    ({"tolerance": 1e-3}, 0), ({"constraints": lambda x, u, t: u + 9.0}, 0), ({"tolerance": 1e-3, "iterations": 0}, 0),
    ({"steps": 5}, 2), ({"iterations": 4}, 4), ({"lower": {}}, 2)])
def test_a_tolerance_or_constraints_end_the_iterations_of_the_model(settings, expected):
    def iterated(times, y=None):
        numpyro.sample("y", lfm.MarginalLikelihood(build(1.0), times, steps=3, iterations=2), obs=y)

    assert trace(lfm.approximate(iterated, **settings), TIMES, Y)["y"]["fn"].settings.iterations == expected
    with pytest.raises(ValueError, match="tolerance=0.001"):
        trace(lfm.approximate(iterated, tolerance=1e-3, iterations=3), TIMES, Y)


def test_settings_of_a_likelihood_are_its_defaults_and_what_was_given():
    likelihood = lfm.MarginalLikelihood(build(1.0), TIMES, steps=4)
    assert likelihood.arguments == {"steps": 4}
    assert likelihood.settings == lfm.MarginalLikelihood(build(1.0), TIMES, rule=lfm.Cubature(), steps=4, iterations=3,
                                                         damping=0.7, method="runge-kutta").settings
    updated = likelihood.with_settings(steps=None, tolerance=1e-2)
    assert updated.arguments == {"tolerance": 1e-2}
    assert (updated.settings.steps, updated.settings.iterations, likelihood.settings.steps) == (10, 0, 4)


@pytest.mark.thorough
@pytest.mark.parametrize("likelihood", [
    lfm.MarginalLikelihood(build(1.0), TIMES, steps=3),
    pytest.param(lfm.ConstrainedLikelihood(build(1.0), TIMES, steps=3, lower={"u": -9.0}, draws=0, grid=5),
                 marks=pytest.mark.thorough),
    lfm.panel(build, jnp.array([0.5, 1.0]), TIMES, steps=3),
    pytest.param(lfm.Switching({"a": build(1.0), "b": build(2.0)}, [[0.0, 0.1], [0.2, 0.0]], TIMES, steps=3),
                 marks=pytest.mark.thorough),
], ids=["series", "constrained", "panel", "regimes"])
def test_open_settings_are_completed_and_named_ones_stay(likelihood):
    def open_model(times, y=None):
        numpyro.sample("y", likelihood)

    result = trace(complete(open_model, rule=lfm.Taylor(), steps=7), TIMES)["y"]["fn"]
    assert type(result) is type(likelihood)
    assert result.first.settings.rule == lfm.Taylor() and result.first.settings.steps == 3
    replaced = trace(lfm.approximate(open_model, rule=lfm.Taylor(), steps=7), TIMES)["y"]["fn"]
    assert type(replaced) is type(likelihood)
    assert replaced.first.settings.rule == lfm.Taylor() and replaced.first.settings.steps == 7
    assert complete(open_model).missing() == ""
