"""Transcription study with unknown rates: model, short chains, table and figure."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest

from lfm_ppl.experiments.transcription import parameters, parameters_report, problem
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood
from lfm_ppl.parallel.task import Task
from lfm_ppl.results import arviz_data

FEW = dataclasses.replace(parameters_report.TranscriptionParametersSettings.quick(), links=tuple(parameters.LINKS))
SOFTPLUS = parameters.LINKS["softplus"]


def sites(data):
    """True values of all sites of a data set."""
    rates = data.rates
    return {"basal": rates.basal, "decay": rates.decay, "sensitivity": rates.sensitivity,
            "away": rates.start - rates.basal / rates.decay, "noise_sd": problem.NOISE,
            "lengthscale": problem.LENGTHSCALE}


@pytest.mark.slow
def test_the_likelihood_at_the_truth_is_that_of_the_known_system():
    data = problem.data_set(SOFTPLUS, 4)
    with numpyro.handlers.substitute(data=sites(data)), numpyro.handlers.trace() as trace:
        parameters.model(problem.TIMES, data.y)
    system = problem.system("softplus", 1.0, data.rates)
    expected = MarginalLikelihood(system, problem.TIMES, rule=parameters.RULE, steps=parameters.STEPS,
                                  iterations=0).log_prob(data.y)
    assert np.isclose(trace["y"]["fn"].log_prob(data.y), expected, rtol=1e-10)
    assert all(np.isfinite(trace[name]["fn"].log_prob(jnp.asarray(value))) for name, value in sites(data).items())


def test_true_values_stand_in_the_order_of_the_names():
    data = problem.data_set(SOFTPLUS, 4)
    named = dict(zip(parameters.NAMES, parameters.true_parameters(data), strict=True))
    for site, value in sites(data).items():
        for gene in range(problem.GENES):
            name = site if np.ndim(value) == 0 else f"{site}[{gene + 1}]"
            assert named[name] == np.broadcast_to(value, problem.GENES)[gene]


def synthetic_results(settings):
    """Results of every task: the marginal samplers half a standard deviation off, and 10% too wide."""
    results, draws = {}, np.random.default_rng(0).normal(size=(len(parameters.NAMES), 2, 500))
    for task in parameters_report.tasks(settings):
        label = task.settings["sampler"]
        truth = np.linspace(0.1, 1.0, len(parameters.NAMES))
        is_shifted = label != parameters.REFERENCE
        mean, sd = truth + 0.05 * is_shifted, np.full(truth.shape, 0.11 if is_shifted else 0.1)
        results[task.name] = {
            "mean": mean, "sd": sd, "low": mean - 2 * sd, "high": mean + 2 * sd, "truth": truth,
            "ess": np.full(truth.shape, 200.0), "r_hat": np.full(truth.shape, 1.004), "seconds": 100.0,
            "divergences": 1, "rmse": 0.4, "coverage": 0.95, "force_mean": np.zeros(parameters.FORCE_TIMES.shape),
            "force_sd": np.ones(parameters.FORCE_TIMES.shape), "draws": draws,
            **({"k": 0.2} if "iterated" in label else {})}
    return results


def tabulate(results, settings):
    """The comparison of made-up results."""
    return parameters_report.STUDY.tabulate(settings, results)


def test_the_table_measures_in_standard_deviations_of_the_reference():
    table = tabulate(synthetic_results(FEW), FEW).tables["agreement"]
    assert len(table) == len(parameters.LINKS) * len(parameters.SAMPLERS)
    row = table.loc["softplus: RAM, marginal"]
    assert row["shift"] == pytest.approx(0.5) and row["sd ratio"] == pytest.approx(1.1)
    assert row["ESS/CPU s"] == pytest.approx(2.0) and row["coverage"] == 1.0 and row["R-hat"] == pytest.approx(1.004)
    assert np.isnan(row["k"]) and table.loc["softplus: RAM, iterated marginal", "k"] == 0.2
    assert row["shift se"] == pytest.approx(0.1) and row["least ESS"] == 200.0
    assert row["sd ratio se"] == pytest.approx(1.1 * np.sqrt(2 / (2 * 1000)), rel=0.3)  # normal, independent draws
    reference = table.loc[f"softplus: {parameters.REFERENCE}"]
    assert reference["shift"] == 0.0 and reference["sd ratio"] == 1.0
    assert reference[["shift se", "sd ratio se"]].isna().all()


def test_a_chain_that_stands_still_shows():
    two = dataclasses.replace(FEW, datasets=2)
    results = synthetic_results(two)
    constant_task = next(task.name for task in parameters_report.tasks(two) if task.settings["index"] == 1
                         and task.settings["sampler"] == "RAM, marginal" and task.settings["link"] == "softplus")
    for name, value in (("ess", np.nan), ("r_hat", np.nan), ("sd", 0.0)):
        results[constant_task][name][3] = value
    row = tabulate(results, two).tables["agreement"].loc["softplus: RAM, marginal"]
    assert row["least ESS"] == 0 and row["R-hat"] == np.inf and row["sd ratio"] == 0
    assert row["ESS/CPU s"] == pytest.approx(1.0)


def test_the_figures_are_labelled():
    figures = parameters_report.draw(FEW, parameters_report.STUDY.collect(FEW, synthetic_results(FEW)))
    assert set(figures) == {"posteriors-softplus", "posteriors-saturation-0.5"}
    for figure in figures.values():
        upper, lower = figure.axes
        assert upper.get_ylabel() and lower.get_xlabel() and lower.get_ylabel() and figure.legends
        assert [text.get_text() for text in upper.get_xticklabels()] == list(parameters.NAMES)


def settings_of(label, chains, warmup, draws, thin):
    """Settings of one task."""
    return {"sampler": label, "link": "softplus", "gamma": None, "index": 0, "chains": chains, "warmup": warmup,
            "draws": draws, "thin": thin, "tree_depth": 10}


@pytest.mark.slow
@pytest.mark.parametrize("label", parameters.SAMPLERS)
def test_every_sampler_draws_parameters_and_force(label):
    thin = 5 if "RAM" in label else 1
    result = parameters.compute(Task("parameters", 0, settings_of(label, 2, 30, 30, thin) | {"tree_depth": 5}))
    assert result["draws"].shape == (len(parameters.NAMES), 2, 30) and np.isfinite(result["draws"]).all()
    assert result["force_mean"].shape == result["force_sd"].shape == parameters.FORCE_TIMES.shape
    assert (result["force_sd"] > 0).all() and result["rmse"] < 2 and result["seconds"] > 0


@pytest.mark.slow
def test_on_a_linear_link_marginal_and_latent_posteriors_are_the_same():
    """There the filter is exact, so that nothing but Monte Carlo error and the grid stands between them."""
    linear = {"link": "linear"}
    marginal = parameters.compute(Task("marginal", 0, settings_of("RAM, marginal", 4, 500, 1000, 50) | linear))
    latent = parameters.compute(Task("latent", 0, settings_of("NUTS, latent grid", 2, 400, 600, 1) | linear))
    error = np.sqrt(1 / marginal["ess"] + 1 / latent["ess"])
    assert max(marginal["r_hat"].max(), latent["r_hat"].max()) < 1.05
    assert np.all(np.abs(marginal["mean"] - latent["mean"]) / latent["sd"] < 4.5 * error)
    assert np.all(np.abs(np.log(marginal["sd"] / latent["sd"])) < 4.5 * error)
    assert np.abs(marginal["force_mean"] - latent["force_mean"]).max() < 0.3


@pytest.mark.slow
def test_draws_are_taken_as_often_as_the_iterated_likelihood_says():
    data = problem.data_set(SOFTPLUS, 4)
    truth = parameters.true_parameters(data)
    draws = truth[:, None, None] * np.random.default_rng(0).uniform(0.8, 1.2, (len(truth), 2, 20))

    def log_likelihood(theta, iterations):
        basal, decay, sensitivity, excess = theta[:12].reshape(4, 3)
        rates = problem.Rates(basal, sensitivity, decay, excess + basal / decay)
        system = problem.system("softplus", None, rates, theta[12], theta[13])
        return MarginalLikelihood(system, problem.TIMES, rule=parameters.RULE, steps=parameters.STEPS,
                                  iterations=iterations).log_prob(data.y)

    flat = jnp.asarray(draws.reshape(len(truth), -1).T)
    ratio = jax.vmap(lambda theta: log_likelihood(theta, 2) - log_likelihood(theta, 0))(flat)
    smoothed, k = arviz_data.psis(np.asarray(ratio))
    weight = np.exp(smoothed).reshape(2, 20)
    resampled, found_k = parameters._resample_draws({"link": "softplus", "gamma": None}, 2, data, draws)
    assert resampled.shape == draws.shape and found_k == pytest.approx(k)
    for chain, weights in enumerate(weight / weight.sum(axis=1, keepdims=True)):
        counts = [(resampled[0, chain] == value).sum() for value in draws[0, chain]]
        assert np.abs(counts - 20 * weights).max() < 1
        assert (resampled[:, chain, :, None] == draws[:, chain, None, :]).all(axis=0).any(axis=1).all()  # whole draws
