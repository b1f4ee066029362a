"""Settings of the likelihood, changed from outside the model."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from numpyro.infer.util import log_density

import lfm_ppl as lfm
from lfm_ppl.likelihoods.handlers.settings import approximate

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
    result = trace(approximate(model, **settings), TIMES, Y)["y"]["fn"]
    assert {name: getattr(result, name) for name in settings} == settings
    result = trace(approximate(model, rule=None, steps=None, max_step=0.5), TIMES, Y)["y"]["fn"]
    assert (result.steps, result.max_step) == (3, 0.5) and isinstance(result.rule, lfm.Cubature)
    assert trace(approximate(two, steps=9), TIMES, jnp.stack([Y, Y]))["y"]["fn"].first.steps == 9


def test_the_density_is_that_of_a_model_written_with_the_settings():
    def written(times, y):
        likelihood = lfm.MarginalLikelihood(build(1.0), times, rule=lfm.Taylor(), steps=2, iterations=0)
        numpyro.sample("y", likelihood, obs=y)

    changed = approximate(model, rule=lfm.Taylor(), steps=2)
    expected, result = (jax.jit(lambda y, model=model: log_density(model, (TIMES, y), {}, {})[0])(Y)
                        for model in (written, changed))
    np.testing.assert_allclose(result, expected, rtol=1e-12)


def test_a_model_without_the_site_and_an_unknown_setting():
    def plain(times, y=None):
        numpyro.sample("y", numpyro.distributions.Normal(0.0, 1.0), obs=y)

    with pytest.raises(ValueError, match="steps"):
        trace(approximate(plain, steps=3), TIMES, 0.5)
    with pytest.raises(TypeError, match="'step'"):
        approximate(model, step=3)


def test_steps_or_iterations_alone_are_equal_steps():
    def tolerant(times, y=None):
        numpyro.sample("y", lfm.MarginalLikelihood(build(1.0), times, steps=3, tolerance=1e-2), obs=y)

    def tolerant_panel(times, y=None):
        with numpyro.plate("series", 2):
            numpyro.sample("y", lfm.panel(build, jnp.array([0.5, 1.0]), times, steps=3, tolerance=1e-2), obs=y)

    for settings, expected in (({"steps": 5}, None), ({"iterations": 2}, None), ({"max_step": 0.5}, 1e-2),
                               ({"steps": 5, "tolerance": 1e-4}, 1e-4)):
        assert trace(approximate(tolerant, **settings), TIMES, Y)["y"]["fn"].tolerance == expected
        panel = trace(approximate(tolerant_panel, **settings), TIMES, jnp.stack([Y, Y]))["y"]["fn"]
        assert panel.settings["tolerance"] == expected


@pytest.mark.parametrize(("settings", "expected"), [
    ({"tolerance": 1e-3}, 0), ({"constraints": lambda x, u, t: u + 9.0}, 0), ({"tolerance": 1e-3, "iterations": 0}, 0),
    ({"steps": 5}, 2), ({"iterations": 4}, 4), ({"lower": {}}, 2)])
def test_a_tolerance_or_constraints_end_the_iterations_of_the_model(settings, expected):
    def iterated(times, y=None):
        numpyro.sample("y", lfm.MarginalLikelihood(build(1.0), times, steps=3, iterations=2), obs=y)

    assert trace(approximate(iterated, **settings), TIMES, Y)["y"]["fn"].iterations == expected
    with pytest.raises(ValueError, match="tolerance=0.001"):
        trace(approximate(iterated, tolerance=1e-3, iterations=3), TIMES, Y)
