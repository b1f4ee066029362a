"""Fits from the posterior mode: as few iterations and steps as suffice, and one density wherever it is evaluated."""

import json
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from systems import double_well

import lfm_ppl as lfm
from lfm_ppl.accuracy.log_likelihoods import gaussian
from lfm_ppl.inference.laplace_start import Laplace, UnusableModeError, laplace_approximation
from lfm_ppl.inference.long_steps import stiff_sites
from lfm_ppl.inference.model_draws import ModelDraws
from lfm_ppl.inference.tuning import ANCHOR, TOLERATED_ERROR, anchor_at_mode
from lfm_ppl.results import rebuilding
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.workflows import fit_starts

TIMES = 0.5 * np.arange(1, 9)
Y = np.array([0.9, 1.1, 0.7, 0.5, 0.1, -0.6, -0.8, -1.1])[:, None]


def crossing(times, y=None):
    strength = numpyro.sample("strength", dist.LogNormal(0.0, 0.3))
    dispersion = numpyro.sample("dispersion", dist.LogNormal(-0.3, 0.3))
    system = double_well(0.9, 0.1, dispersion, 0.03, -strength, strength)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


def forced(times, y=None):
    """A known input of jumps, one of which divides an interval, and a force in a non-linear function."""
    rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.3))
    pulse = lfm.Input([0.0, 1.2, 2.0], [0.0, 1.0, 0.0], outside="hold")
    system = lfm.LatentForceModel(
        lambda x, u, t: jnp.exp(u) + pulse(t) - rate * x, {"u": lfm.Matern(0.5, 1.0, order=1)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.2])), lfm.Gaussian(jnp.ones(1), 0.1 * jnp.eye(1)))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


def fit(model=crossing, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return lfm.fit(model, TIMES, Y, **{"chains": 2, "warmup": 30, "samples": 30, "trajectory_draws": 4,
                                           "progress": False} | options)


@pytest.fixture(scope="module")
def result():
    return fit(at=[0.7, 4.0, 5.0])


def test_a_result_names_its_density_and_gives_it_again(result):
    attrs = ResultView.of(result).attrs
    tuning = json.loads(attrs[ANCHOR])["sites"]["y"]
    assert attrs["iterations"] == tuning["iterations"] in (0, 1, 2, 3, 6)
    assert attrs["steps"] == 10 and tuning["steps"] in (3, 5) and f", {tuning['steps']} steps" in attrs["likelihood"]
    assert tuning["error"] <= TOLERATED_ERROR or tuning["iterations"] == 6
    assert "smoothed moments" in attrs["likelihood"]
    problem = rebuilding.problem(result, crossing)
    recorded = result["one_step_ahead"]["log_density"].transpose("chain", "draw", ...).values.sum(axis=-1).ravel()
    np.testing.assert_allclose(gaussian(problem), recorded, rtol=1e-9)
    converged = gaussian(problem, iterations=40, steps=20)
    from_filter = gaussian(ModelDraws(lfm.bind(crossing, TIMES, Y), problem.draws))
    assert np.std(recorded - converged) < max(2 * TOLERATED_ERROR, 0.3 * np.std(from_filter - converged))


@pytest.mark.thorough
def test_a_forecast_finds_the_density_of_its_result(result):
    mean = lfm.forecast(result, crossing, [4.5], draws=8, progress=False)  # compares log likelihoods
    assert "predictions" in ResultView.of(mean).groups


def test_the_sampler_saw_the_density_that_the_result_names(result):
    bound = rebuilding.problem(result, crossing).bound
    draws = {name: result["posterior"][name].values for name in bound.sites}
    for chain, draw in ((0, 3), (1, 29)):
        z = bound.unconstrain({name: values[chain, draw] for name, values in draws.items()})
        assert np.isclose(bound.log_density(z), result["sample_stats"]["lp"].values[chain, draw], rtol=1e-9)


@pytest.mark.parametrize("model", [crossing, pytest.param(forced, marks=pytest.mark.thorough)])
def test_the_fewest_steps_that_suffice_are_chosen(model):
    bound = lfm.bind(model, TIMES, Y)
    laplace = laplace_approximation(jax.random.key(0), bound)
    tuned, tunings = anchor_at_mode(jax.random.key(1), bound, laplace)
    tuning, settings = tunings["y"], tuned.site.example.settings
    assert settings.integration_steps == tuning.steps and settings.iterations == tuning.iterations
    normals = np.asarray(jax.random.normal(jax.random.key(2), (12, bound.size)))
    draws = laplace.mode + normals @ np.linalg.cholesky(laplace.covariance).T

    def log_likelihoods(**settings):
        with_settings = bound.anchored(laplace.mode).approximate(**settings)
        return np.array([with_settings.log_likelihood(z) for z in draws])

    finest = log_likelihoods(iterations=12, steps=40)
    error = np.std(log_likelihoods(iterations=tuning.iterations, filter_steps=tuning.steps) - finest)
    assert error < 2 * TOLERATED_ERROR and 0.4 < error / tuning.error < 2.5
    fewer = {3: None, 5: 3, 10: 5}[tuning.steps]
    if fewer is not None:
        assert np.std(log_likelihoods(iterations=tuning.iterations, filter_steps=fewer) - finest) > TOLERATED_ERROR / 2


@pytest.mark.slow
@pytest.mark.parametrize(("options", "iterations"), [({"init": "median"}, 3), ({"iterations": 0}, 0)])
def test_without_a_mode_or_iterations_nothing_is_tuned(options, iterations):
    attrs = ResultView.of(fit(**options)).attrs
    assert ANCHOR not in attrs and attrs["iterations"] == iterations


@pytest.mark.slow
def test_a_number_that_the_model_names_stays_and_starts_at_the_mode():
    result = fit(sampler="ram", iterations=2, steps=2, samples=10, warmup=20, trajectory_draws=0)
    attrs = ResultView.of(result).attrs
    assert attrs["iterations"] == 2 and json.loads(attrs[ANCHOR])["sites"] == {"y": {}}
    recorded = result["one_step_ahead"]["log_density"].transpose("chain", "draw", ...).values.sum(axis=-1).ravel()
    np.testing.assert_allclose(gaussian(rebuilding.problem(result, crossing)), recorded, rtol=1e-9)


def panel(times, y=None):
    with numpyro.plate("series", 2):
        dispersion = numpyro.sample("dispersion", dist.LogNormal(-0.3, 0.3))
        numpyro.sample("y", lfm.panel(lambda p: double_well(0.9, 0.1, p, 0.03), dispersion, times, steps=2), obs=y)


def two_sites(times, y=None):
    dispersion = numpyro.sample("dispersion", dist.LogNormal(-0.3, 0.3))
    for name in ("a", "b"):
        numpyro.sample(name, lfm.MarginalLikelihood(double_well(0.9, 0.1, dispersion, 0.03), times[name], steps=2),
                       obs=y[name])


@pytest.mark.thorough
@pytest.mark.parametrize(("model", "times", "y"), [
    (panel, TIMES, np.stack([Y, np.abs(Y)])),
    pytest.param(two_sites, {"a": TIMES, "b": TIMES[:5]}, {"a": Y, "b": Y[:5]}, marks=pytest.mark.slow),
], ids=["panel", "sites"])
def test_series_and_sites_have_moments_of_their_own(model, times, y):
    bound = lfm.bind(model, times, y)
    z = jnp.full(bound.size, -0.4)
    anchored = bound.anchored(z)
    converged = bound
    for name in bound.site_models:
        converged = converged.site_models[name].approximate(iterations=60).with_all_sites()
    assert np.isclose(anchored.log_density(z), converged.log_density(z), rtol=1e-7)
    other = z + 0.3
    errors = [abs(start.log_density(other) - converged.log_density(other)) for start in (anchored, bound)]
    assert errors[0] < errors[1]
    laplace = laplace_approximation(jax.random.key(0), bound)
    tuned, tunings = anchor_at_mode(jax.random.key(1), bound, laplace)
    assert set(tunings) == set(bound.site_models)
    assert {name: model.site.example.settings.iterations for name, model in tuned.site_models.items()} == {
        name: tuning.iterations for name, tuning in tunings.items()}


def settling(times, y=None):
    """A state that settles within half a step of the default."""
    growth = numpyro.sample("growth", dist.LogNormal(0.0, 0.3))
    system = lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([growth * x[0] * (1.0 - x[0]) + u[0], 40.0 * (x[0]**2 - x[1])]),
        {"u": lfm.Matern(0.1, 1.0)}, lfm.GaussianObservation(lambda x, u, t: x[1:], jnp.array([0.1])),
        lfm.Gaussian(jnp.array([0.2, 0.04]), 0.01 * jnp.eye(2)))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


@pytest.mark.slow
def test_a_stiff_model_takes_exponential_steps_unless_it_names_others():
    y = np.array([0.1, 0.15, 0.3, 0.4, 0.55, 0.7, 0.8, 0.85])[:, None]
    options = {"chains": 1, "warmup": 10, "samples": 10, "trajectory_draws": 0, "progress": False}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = lfm.fit(settling, TIMES, y, **options)
    attrs = ResultView.of(result).attrs
    assert attrs["method"] == "exponential" and json.loads(attrs[ANCHOR])["sites"]["y"]["steps"] in (3, 5, 10)
    problem = rebuilding.problem(result, settling)
    recorded = result["one_step_ahead"]["log_density"].transpose("chain", "draw", ...).values.sum(axis=-1).ravel()
    np.testing.assert_allclose(gaussian(problem), recorded, rtol=1e-9)
    assert np.std(gaussian(problem, steps=100, method="runge-kutta", iterations=12) - recorded) < 2 * TOLERATED_ERROR
    assert stiff_sites(lfm.bind(settling, TIMES, y), np.zeros(1)) == ["y"]
    assert not stiff_sites(lfm.bind(lfm.approximate(settling, steps=10), TIMES, y), np.zeros(1))


@pytest.mark.slow
def test_an_unusable_mode_of_exponential_steps_leaves_the_prior_median(monkeypatch):
    searches = []

    def search(*arguments):
        searches.append(arguments)
        if len(searches) > 1:
            raise UnusableModeError("the posterior has several modes of similar height")
        return laplace_approximation(*arguments)

    monkeypatch.setattr(fit_starts, "laplace_approximation", search)
    monkeypatch.setattr(fit_starts, "stiff_sites", lambda bound, z: ["y"])
    attrs = ResultView.of(fit(chains=1, warmup=10, samples=10, trajectory_draws=0)).attrs
    assert attrs["init"] == "median" and "several modes" in attrs[fit_starts.FALLBACK] and ANCHOR not in attrs
    assert attrs["method"] == "exponential"


def test_a_masked_likelihood_keeps_its_steps():
    def masked(times, y=None):
        with numpyro.handlers.mask(mask=jnp.array(True)):
            settling(times, y)

    assert not stiff_sites(lfm.bind(masked, TIMES, Y), np.zeros(1))


@pytest.mark.thorough
def test_steps_are_not_tuned_where_an_input_divides_most_intervals():
    table = np.linspace(0.0, 3.0, 61)

    def driven(times, y=None):
        rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.3))
        pulses = lfm.Input(table, np.sin(table), outside="hold")
        system = lfm.LatentForceModel(
            lambda x, u, t: jnp.exp(u) + pulses(t) - rate * x, {"u": lfm.Matern(0.5, 1.0)},
            lfm.GaussianObservation(lambda x, u, t: x, sd=0.4), lfm.Gaussian(jnp.ones(1), 0.1 * jnp.eye(1)))
        numpyro.sample("y", lfm.MarginalLikelihood(system, times, iterations=1), obs=y)

    bound = lfm.bind(driven, TIMES, Y)
    assert bound.site.example.time_grid.steps < bound.site.example.settings.steps
    tuned, tunings = anchor_at_mode(jax.random.key(1), bound, Laplace(np.zeros(1), np.eye(1)))
    assert not tunings and tuned.site.example.settings.integration_steps == 10


def test_steps_of_the_filter_are_its_own():
    likelihood = lfm.MarginalLikelihood(double_well(0.9, 0.1, 0.7, 0.03), [0.5, 1.0, 4.0], filter_steps=3, iterations=0)
    assert "3 steps" in likelihood.description and likelihood.time_grid.steps == 3
    with pytest.raises(ValueError, match="leave filter_steps or tolerance out"):
        lfm.MarginalLikelihood(likelihood.model, TIMES, filter_steps=3, tolerance=1e-3)
    bounded = lfm.approximate(crossing, filter_steps=3, lower={"x": 0.0})
    with pytest.raises(ValueError, match="filter_steps is not supported under constraints"):
        lfm.bind(bounded, TIMES, Y)


@pytest.mark.thorough
def test_simulations_do_not_depend_on_the_steps_of_the_filter():
    def paths(**settings):
        well = double_well(0.9, 0.1, 0.7, 0.03)
        return lfm.MarginalLikelihood(well, [0.5, 1.0, 4.0], iterations=0, **settings).sample(jax.random.key(0), (2,))

    np.testing.assert_array_equal(paths(filter_steps=3), paths())
