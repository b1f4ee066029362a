"""A model that is built anew computes what its functions compute now, wherever it is used."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from tests.compiled_programs import compilations

TIMES, Y = np.arange(4.0), np.array([[0.9], [0.5], [0.2], [0.3]])
RATE = 1.0


def rate():
    return RATE


def decay(x, u, t):
    return -rate() * x


def observed(x, u, t):
    return rate() * x


def reading(x, u, t):
    return x


def unit_rate(x, u, t):
    return -x


class Decay:
    """Dynamics without a hash."""

    rate = 1.0
    __hash__ = None

    def __eq__(self, other):
        return True

    def __call__(self, x, u, t):
        return -self.rate * x


def build(dynamics, observation):
    return lfm.LatentForceModel(dynamics, {}, observation, lfm.Gaussian(jnp.ones(1), jnp.eye(1)),
                                process_noise=jnp.eye(1))


def gaussian(function):
    return lfm.GaussianObservation(function, jnp.array([0.1]))


FUNCTIONS = {
    "filter": lambda model: lfm.filter(model, TIMES, Y).log_likelihood.sum(),
    "smooth": lambda model: lfm.smooth(model, TIMES, Y).mean.sum(),
    "likelihood": lambda model: lfm.MarginalLikelihood(model, TIMES).log_prob(Y),
    "jit": lambda model: jax.jit(lambda y: lfm.filter(model, TIMES, y).log_likelihood.sum())(Y),
    "particle filter": lambda model: lfm.particle_filter(
        jax.random.key(0), model, TIMES, Y, particles=10).log_likelihood.sum(),
    "full information": lambda model: lfm.full_information(model, TIMES, Y, lower={"x0": 0.0}).state_mean.sum(),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_helper_that_changes_between_two_models(name, monkeypatch):
    observation, function = gaussian(observed), FUNCTIONS[name]
    initial_value = float(function(build(decay, observation)))
    with compilations() as compiled:
        assert float(function(build(decay, observation))) == initial_value
    assert compiled == [] or name in ("jit", "likelihood")  # which users compile
    monkeypatch.setitem(decay.__globals__, "RATE", 2.0)
    expected = build(lambda x, u, t: -2.0 * x, gaussian(lambda x, u, t: 2.0 * x))
    changed_value = float(function(build(decay, observation)))
    assert changed_value == pytest.approx(float(function(expected)), rel=1e-12)
    assert abs(changed_value - initial_value) > 1e-3


@pytest.mark.thorough
def test_an_object_without_a_hash():
    dynamics = Decay()
    values = []
    for dynamics.rate in (1.0, 2.0):
        values.append(float(lfm.filter(build(dynamics, gaussian(reading)), TIMES, Y).log_likelihood.sum()))
    assert values[0] == pytest.approx(
        float(lfm.filter(build(unit_rate, gaussian(reading)), TIMES, Y).log_likelihood.sum()), rel=1e-12)
    assert values[0] != values[1]
