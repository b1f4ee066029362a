"""Infusions against superposition, matrix exponentials and finite differences."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy.stats import norm

import lfm_ppl as lfm

RATE = 0.3
TIMES = np.array([0.5, 1.0, 2.0, 3.5, 6.0, 9.0])
STARTS, AMOUNTS, DURATIONS = np.array([0.0, 1.5, 2.0]), np.array([4.0, 3.0, 2.0]), np.array([1.0, 2.5, 0.7])
Y = np.ones((len(TIMES), 1))


def decay(events, dynamics=lambda x, u, t: -RATE * x, forces=None):
    return lfm.LatentForceModel(
        dynamics, forces or {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), state_names=("blood",), initial_time=0.0, events=events)


def blood(t, amounts=AMOUNTS, durations=DURATIONS, lag=0.0):
    """The sum of infusions that overlap, eliminated at `RATE`."""
    since = np.asarray(t)[:, None] - STARTS - lag
    during, elapsed = np.clip(since, 0.0, durations), np.maximum(since - durations, 0.0)
    return (amounts / durations * (1 - np.exp(-RATE * during)) / RATE * np.exp(-RATE * elapsed)).sum(1)


def test_overlapping_infusions_superpose_in_all_methods():
    model = decay([lfm.Infusion(STARTS, AMOUNTS, "blood", duration=DURATIONS, lag=0.25)])
    by_rate = decay([lfm.Infusion(STARTS, AMOUNTS, np.ones(1), rate=AMOUNTS / DURATIONS, lag=0.25)])
    exact, grid = blood(TIMES, lag=0.25), np.linspace(0.0, 11.0, 23)
    for system in (model, by_rate):
        np.testing.assert_allclose(lfm.filter(system, TIMES, Y).predicted_mean[:, 0], exact, atol=1e-9)
    np.testing.assert_allclose(lfm.smooth(model, TIMES, Y, at=grid).mean[:, 0], blood(grid, lag=0.25), atol=1e-9)
    path = lfm.simulate(jax.random.key(0), model, TIMES, steps=20).state[:, 0]
    np.testing.assert_allclose(path, exact, atol=1e-6)
    particles = lfm.particle_filter(jax.random.key(0), model, TIMES, Y, particles=3).mean[:, 0]
    np.testing.assert_allclose(particles, exact, atol=1e-9)


def test_negative_amounts_are_removed_over_a_duration_and_refused_with_a_rate():
    removed = decay([lfm.Infusion(STARTS, -AMOUNTS, "blood", duration=DURATIONS)])
    np.testing.assert_allclose(lfm.filter(removed, TIMES, Y).predicted_mean[:, 0], -blood(TIMES), atol=1e-9)
    for amounts, rate in ((-10.0, 2.0), ([4.0, -3.0, 2.0], [1.0, 2.0, 3.0])):
        with pytest.raises(ValueError, match="amounts of an infusion with rate= must not be negative.*duration="):
            lfm.Infusion(STARTS, amounts, "blood", rate=rate)
    nothing = decay([lfm.Infusion(STARTS, [0.0, -0.0, 0.0], "blood", rate=2.0)])
    np.testing.assert_array_equal(lfm.filter(nothing, TIMES, Y).predicted_mean, 0.0)


def test_a_non_linear_model_integrates_an_infusion_between_its_ends():
    # In the logarithm of the rate of elimination the state of this model has a closed form: x' = r - x^2.
    model = decay([lfm.Infusion([1.0], 4.0, "blood", duration=2.0)], lambda x, u, t: -x**2)
    times = np.array([0.5, 2.0, 3.0, 5.0])
    root = np.sqrt(2.0)
    exact = np.array([0.0, root * np.tanh(root), root * np.tanh(2 * root), 0.0])
    exact[3] = 1.0 / (1.0 / exact[2] + 2.0)
    mean = lfm.filter(model, times, Y[:4], rule=lfm.Taylor(), steps=60).predicted_mean[:, 0]
    np.testing.assert_allclose(mean, exact, atol=1e-7)


@pytest.mark.thorough
@pytest.mark.parametrize("argument", ["rate", pytest.param("duration", marks=pytest.mark.thorough)])
def test_gradients_in_amount_lag_and_rate_or_duration(argument):
    def log_prob(z):
        share, stretch, lag = z
        value = stretch * (DURATIONS if argument == "duration" else AMOUNTS / DURATIONS)
        infusion = lfm.Infusion(STARTS, share * AMOUNTS, "blood", lag=lag, **{argument: value})
        return lfm.MarginalLikelihood(decay([infusion]), TIMES).log_prob(Y)

    def exact(z):
        durations = DURATIONS * (z[1] if argument == "duration" else z[0] / z[1])
        return norm(blood(TIMES, z[0] * AMOUNTS, durations, z[2]), 1.0).logpdf(1.0).sum()

    z = np.array([0.8, 1.1, 0.2])
    run = jax.jit(jax.value_and_grad(log_prob))
    value, gradient = run(z)
    np.testing.assert_allclose(value, exact(z), atol=1e-7)
    np.testing.assert_allclose(log_prob(z), exact(z), atol=1e-7)
    np.testing.assert_allclose(
        gradient, [(exact(z + h) - exact(z - h)) / 2e-5 for h in 1e-5 * np.eye(3)], atol=1e-5)
    for impossible in ([1.0, -1.0, 0.2], [1.0, np.nan, 0.2], [1.0, 1.0, -0.1], [1.0, 1.0, np.nan], [1.0, 0.0, 0.2]):
        value, gradient = run(np.array(impossible))
        assert value == -np.inf
        np.testing.assert_array_equal(gradient, 0.0)


@pytest.mark.thorough
def test_series_of_a_panel_have_infusions_of_their_own():
    durations = np.stack([DURATIONS, 2 * DURATIONS])

    def build(p):
        return decay([lfm.Infusion(p["starts"], p["amounts"], "blood", duration=p["durations"]),
                      lfm.Dose([1.0], 0.5, "blood")])

    starts, amounts = np.stack([STARTS, STARTS + 0.3]), np.stack([AMOUNTS, 0.0 * AMOUNTS])
    panel = lfm.panel(build, {"starts": starts, "amounts": amounts, "durations": durations}, TIMES)
    alone = [lfm.MarginalLikelihood(build({"starts": starts[i], "amounts": amounts[i], "durations": durations[i]}),
                                    TIMES).log_prob(Y) for i in range(2)]
    np.testing.assert_allclose(panel.log_prob(np.stack([Y, Y])), alone, rtol=1e-8)


@pytest.mark.thorough
def test_a_filter_continues_within_an_infusion():
    model = decay([lfm.Infusion([0.0], 4.0, "blood", duration=4.0)], forces={})
    full_result = lfm.filter(model, TIMES, Y)
    first = lfm.filter(model, TIMES[:3], Y[:3])
    second = lfm.filter(model, TIMES[3:], Y[3:], start=first.state)
    np.testing.assert_allclose(second.predicted_mean, full_result.predicted_mean[3:], atol=1e-9)


@pytest.mark.slow
def test_fit_and_forecast_with_an_infusion_whose_rate_is_learnt():
    y = blood(TIMES, 4.0, 2.0)[:, None]

    def model(times, y=None):
        rate = numpyro.sample("rate", dist.LogNormal(0.5, 0.5))
        system = decay([lfm.Infusion(np.append(STARTS, 12.0), 4.0, "blood", rate=rate)])
        numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)

    result = lfm.fit(model, TIMES, y, sampler="map", samples=20, progress=False)
    forecast = lfm.forecast(result, model, [12.0, 14.0], progress=False)["predictions"]["y"].mean(("chain", "draw"))
    assert float(forecast[1, 0] - forecast[0, 0]) == pytest.approx(4.0 * (1 - np.exp(-0.6)) / 0.6, abs=1.5)


@pytest.mark.thorough
def test_constraints_take_infusions():
    model = decay([lfm.Infusion(STARTS, AMOUNTS, "blood", duration=DURATIONS)], lambda x, u, t: -RATE * x + u[0],
                  {"u": lfm.Matern(0.3, 4.0)})
    estimate = lfm.full_information(model, TIMES, Y, lower={"u": -50.0}, grid=TIMES)
    smoothed = lfm.smooth(model, TIMES, Y, at=TIMES)
    np.testing.assert_allclose(estimate.state_mean, smoothed.mean[:, :1], atol=1e-6)


@pytest.mark.parametrize(("arguments", "message"), [
    ({}, "either rate= or duration="), ({"rate": 1.0, "duration": 1.0}, "either rate= or duration="),
    ({"rate": 0.0}, "rate of an infusion"), ({"duration": [1.0, -1.0]}, "duration of an infusion"),
    ({"duration": [1.0, 1.0, 1.0]}, "duration of an infusion"),
    ({"duration": 1.0, "lag": np.nan}, "lag of an infusion"),
])
def test_wrong_arguments_of_infusions_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        lfm.Infusion([0.0, 1.0], 2.0, "blood", **arguments)


def test_an_infusion_before_the_initial_time_is_refused():
    with pytest.raises(ValueError, match="initial time"):
        lfm.filter(decay([lfm.Infusion([-1.0], 2.0, "blood", duration=3.0)]), TIMES, Y)


def test_a_reset_without_a_state_is_one_of_all_states():
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([-x[0], x[0] - 0.2 * x[1]]), {},
        lfm.GaussianObservation(lambda x, u, t: x[1:], jnp.ones(1)), lfm.Gaussian(jnp.ones(2), jnp.eye(2)),
        initial_time=0.0, events=[lfm.Reset([1.0]), lfm.Dose([1.0], 3.0, "x0").delayed(0.5)])
    smoothed = lfm.smooth(model, np.array([0.5, 2.0]), np.ones((2, 1)), at=[1.0, 1.25, 1.5, 2.0])
    np.testing.assert_allclose(smoothed.mean[1:3], 0.0, atol=1e-12)
    np.testing.assert_allclose(smoothed.mean[3, 0], 3.0 * np.exp(-0.5), rtol=1e-9)


@pytest.mark.thorough
def test_regimes_take_the_events_of_one_model():
    events = [lfm.Infusion(STARTS, AMOUNTS, "blood", duration=DURATIONS), lfm.Dose([2.0], 1.5, np.ones(1)),
              lfm.Reset([6.0])]
    models = {name: decay(events) for name in ("a", "b")}
    switching = lfm.Switching(models, [[0.0, 0.2], [0.5, 0.0]], TIMES)
    exact = lfm.MarginalLikelihood(models["a"], TIMES)
    np.testing.assert_allclose(switching.log_prob(Y), exact.log_prob(Y), rtol=1e-8)
    grid = np.array([1.7, 2.5, 6.0, 7.0])
    np.testing.assert_allclose(switching.smooth(Y, at=grid).mean, lfm.smooth(models["a"], TIMES, Y, at=grid).mean,
                               atol=1e-8)
    path = switching.simulate(jax.random.key(0))[0][:, 0]
    np.testing.assert_allclose(path, lfm.filter(models["a"], TIMES, Y).predicted_mean[:, 0], atol=1e-6)
    with pytest.raises(ValueError, match="same events"):
        lfm.Switching({"a": decay(events), "b": decay(events[:2])}, [[0.0, 0.2], [0.5, 0.0]], TIMES)
