"""A step that is too long for a fast decay is a warning with state, row and remedy, and the remedy is right."""

from __future__ import annotations

import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import lfm_ppl as lfm
from lfm_ppl.filtering.stiffness import decay_rates
from lfm_ppl.inference.long_steps import long_step_messages

INFUSION = lfm.Input([0.0, 24.0], [10.0, 0.0], "previous", "hold")
ROWS = np.array([6.0, 12.0, 24.0])
Y = np.ones((3, 1))
NOISE = lfm.GaussianObservation(lambda x, u, t: x[:1], jnp.array([0.01]))


def system(dynamics, start, names, forces=None):
    return lfm.LatentForceModel(dynamics, forces or {}, NOISE,
                                lfm.Gaussian(jnp.array(start), jnp.zeros((len(start),) * 2)), state_names=names,
                                initial_time=0.0)


def elimination(rate):
    return system(lambda x, u, t: jnp.stack([INFUSION(t) - rate * x[0] / (1 + 0.01 * x[0])]), [0.0], ("drug",))


def messages(function):
    with warnings.catch_warnings(record=True) as caught_warnings:
        warnings.simplefilter("always")
        result = function()
    return result, [str(warning.message) for warning in caught_warnings if "steps are too long" in str(warning.message)]


def proposed_steps(message):
    return int(re.search(r"steps=(\d+)", message)[1])


@pytest.mark.thorough
def test_an_unstable_step_names_state_row_and_remedy():
    result, texts = messages(lambda: lfm.filter(elimination(10.0), ROWS, Y))
    assert len(texts) == 1 and "'drug'" in texts[0] and "row 0" in texts[0] and 'method="exponential"' in texts[0]
    assert abs(result.predicted_mean[-1, 0]) > 1000
    for remedy in ({"steps": proposed_steps(texts[0])}, {"method": "exponential"}):
        result, said_again = messages(lambda remedy=remedy: lfm.filter(elimination(10.0), ROWS, Y, **remedy))
        np.testing.assert_allclose(result.predicted_mean[-1, 0], 10 / 9.9, rtol=1e-3)
        assert not said_again


@pytest.mark.thorough
def test_likelihood_filter_smoother_and_panel_say_it_and_compiled_code_does_not():
    likelihood = lfm.MarginalLikelihood(elimination(10.0), ROWS, iterations=0)
    panel = lfm.panel(elimination, jnp.array([1.0, 10.0]), ROWS, iterations=0)
    for call in (lambda: likelihood.log_prob(Y), lambda: likelihood.filter(Y), lambda: likelihood.smooth(Y),
                 lambda: lfm.smooth(elimination(10.0), ROWS, Y, at=[3.0])):
        assert len(messages(call)[1]) == 1
    texts = messages(lambda: panel.log_prob(np.stack([Y, Y])))[1]
    assert len(texts) == 1 and "series 1, row 0" in texts[0]
    bound = lfm.bind(stiff_model, ROWS, Y)
    for call in (bound.filter, bound.smooth, lambda z: bound.smooth({"rate": 10.0}, at=[3.0])):
        texts = messages(lambda call=call: call(np.log([10.0])))[1]
        assert len(texts) == 1 and "'drug'" in texts[0] and "row 0" in texts[0]
    assert not messages(lambda: bound.filter(np.log([0.1])))[1]
    assert not messages(lambda: jax.jit(lambda z: bound.filter(z).log_likelihood)(np.log([10.0])))[1]
    assert not messages(lambda: jax.jit(lambda rate: lfm.filter(elimination(rate), ROWS, Y).log_likelihood)(10.0))[1]


@pytest.mark.thorough
def test_a_fast_linear_decay_to_a_function_of_a_force_needs_no_remedy():
    rate = 30.0
    model = lfm.LatentForceModel(
        lambda x, u, t: rate * (jax.nn.softplus(u) - x), {"u": lfm.Matern(1e-4, 5.0, mean=3.0)}, NOISE,
        lfm.Gaussian(jnp.array([3.0486]), 1e-6 * jnp.eye(1)), state_names=("sensor",), initial_time=0.0)
    times, y = np.arange(1.0, 6.0), np.full((5, 1), 3.0486)
    for settings in ({}, {"tolerance": 1e-3}, {"method": "exponential"}):
        result, texts = messages(lambda settings=settings: lfm.filter(model, times, y, **settings))
        np.testing.assert_allclose(result.predicted_mean[:, 0], 3.0486, rtol=1e-3)
        assert not texts


def test_a_tolerance_resolves_a_fast_linear_part():
    """The fixed point of a fast decay to a constant, beside a state that is not linear."""
    model = system(lambda x, u, t: jnp.stack([-30 * (x[0] - 5.0), -x[1] ** 2]), [5.0, 1.0], ("sensor", "slow"))
    times, y = np.arange(1.0, 4.0), np.full((3, 1), 5.0)
    texts = messages(lambda: lfm.filter(model, times, y))[1]
    assert len(texts) == 1 and "'sensor'" in texts[0]
    result = lfm.filter(model, times, y, tolerance=1e-3, steps=100)
    np.testing.assert_allclose(result.predicted_mean[:, 0], 5.0, rtol=1e-5)


def test_a_decay_that_is_fast_only_between_the_rows():
    """Saturated at the start, exhausted within the first row, and nothing is observed before the last one."""
    model = system(lambda x, u, t: jnp.stack([-50 * x[0] / (2.0 + x[0])]), [40.0], ("alcohol",))
    y = np.array([[np.nan], [np.nan], [0.0]])
    assert len(messages(lambda: lfm.filter(model, ROWS, y))[1]) == 1
    assert not messages(lambda: lfm.filter(model, ROWS, y, steps=300))[1]


def test_growth_and_slow_oscillation_do_not_warn():
    growth = system(lambda x, u, t: jnp.stack([30 * x[0] / (1 + 1e-40 * x[0] ** 2)]), [1e-6], ("population",))
    assert not messages(lambda: lfm.filter(growth, np.array([1.0, 2.0]), np.array([[np.nan], [1e20]])))[1]
    np.testing.assert_allclose(decay_rates(np.array([[[3.0, 0.0], [0.0, 2.0]], [[0.0, 2.0], [-2.0, 0.0]],
                                                     [[-4.0, 1.0], [0.0, 9.0]]])), [[0, 0], [2, 2], [4, 0]])


def test_a_dose_that_makes_a_decay_fast():
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([-0.01 * x[0], 1.0 - x[0] * x[1]]), {}, NOISE,
        lfm.Gaussian(jnp.array([1.0, 1.0]), jnp.zeros((2, 2))), state_names=("catalyst", "substrate"), initial_time=0.0,
        events=[lfm.Dose([1.5], 80.0, "catalyst")])
    texts = messages(lambda: lfm.filter(model, np.array([1.0, 2.0, 3.0]), np.array([[1.0], [np.nan], [np.nan]])))[1]
    assert len(texts) == 1 and "'substrate'" in texts[0] and "row 1" in texts[0]


def stiff_model(times, y=None):
    rate = numpyro.sample("rate", dist.LogNormal(np.log(10.0), 1e-3))
    numpyro.sample("y", lfm.MarginalLikelihood(elimination(rate), times, iterations=0), obs=y)


@pytest.mark.thorough
def test_a_panel_proposes_steps_for_its_fastest_series():
    panel = lfm.panel(elimination, jnp.array([1.0, 10.0, 40.0]), ROWS, iterations=0)
    y = np.stack([Y] * 3)
    texts = messages(lambda: panel.log_prob(y))[1]
    assert len(texts) == 1 and "series 1, row 0" in texts[0]
    enough = lfm.panel(elimination, jnp.array([1.0, 10.0, 40.0]), ROWS, iterations=0, steps=proposed_steps(texts[0]))
    assert not messages(lambda: enough.log_prob(y))[1]


def switching(rate, times=ROWS):
    """A linear regime, which is exact at any rate, and one that is integrated."""
    models = {"exact": system(lambda x, u, t: INFUSION(t) - 300.0 * x, [0.0], ("drug",)), "fast": elimination(rate)}
    return lfm.Switching(models, 0.1 * (1.0 - np.eye(2)), times)


@pytest.mark.thorough
def test_regimes_are_named():
    likelihood = switching(10.0)
    texts = messages(lambda: likelihood.log_prob(Y))[1]
    assert len(texts) == 1 and "'drug'" in texts[0] and "at regime 'fast', row 0" in texts[0]
    enough = likelihood.with_settings(steps=proposed_steps(texts[0]))
    assert not messages(lambda: enough.log_prob(Y))[1]


@pytest.mark.slow
def test_regimes_are_named_by_the_smoother_and_before_a_fit():
    likelihood = switching(10.0)
    for call in (likelihood.smooth, lambda y: likelihood.smooth(y, at=[3.0])):
        texts = messages(lambda call=call: call(Y))[1]
        assert len(texts) == 1 and "at regime 'fast', row 0" in texts[0]
    assert not messages(lambda: likelihood.with_settings(method="exponential").log_prob(Y))[1]
    assert not messages(lambda: jax.jit(likelihood.log_prob)(Y))[1]

    def model(times, y=None):
        rate = numpyro.sample("rate", dist.LogNormal(np.log(10.0), 1e-3))
        numpyro.sample("y", switching(rate, times), obs=y)

    texts = long_step_messages(lfm.bind(model, ROWS, Y), np.log([10.0]))
    assert len(texts) == 1 and "at regime 'fast', row 0" in texts[0]


@pytest.mark.thorough
def test_a_fit_says_it_before_it_samples():
    texts = messages(lambda: lfm.fit(stiff_model, ROWS, Y, sampler="map", samples=2, trajectory_draws=0,
                                     progress=False))[1]
    assert len(texts) == 1 and "'drug'" in texts[0] and "row 0" in texts[0]
