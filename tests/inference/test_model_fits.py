"""The shipped models through lfm.fit, from their simulated data to the posterior."""

import warnings

import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.io import loading
from lfm_ppl.results import arviz_data


def fitted(name, **keywords):
    file = loading.load(name)
    data = file.prepare(file.simulate(seed=0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lfm.ConvergenceWarning)
        return lfm.fit(file.model, data.times, data.y, model_kwargs=file.keywords(data, {}), truth=data.truth,
                       name=file.name, progress=False, chain_method="vectorized", **keywords)


def assert_complete(result, name):
    assert set(arviz_data.groups(result)) >= {"posterior", "sample_stats", "log_likelihood", "one_step_ahead",
                                              "posterior_predictive", "trajectories", "observed_data", "truth"}
    for group in ("posterior", "log_likelihood", "posterior_predictive", "trajectories"):
        dataset = arviz_data.group(result, group)
        assert all(np.isfinite(dataset[variable]).all() for variable in dataset.data_vars), group
    assert arviz_data.attributes(result)["model"] == name


@pytest.mark.slow
def test_double_well_in_a_few_draws():
    result = fitted("ginzburg-landau", sampler="nuts", chains=2, warmup=30, samples=20, trajectory_draws=10)
    assert_complete(result, "ginzburg-landau")
    paths = arviz_data.group(result, "trajectories")
    assert "forces" not in paths
    # Trajectories pass by the observations, to within five times their noise
    at_data = paths["outputs"].sel(at=arviz_data.group(result, "observed_data")["time"].values).values
    y = arviz_data.group(result, "observed_data")["y"].values
    assert np.abs(at_data - y).max() < 5.0 * 0.1


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["nuts", "ram"])
@pytest.mark.parametrize("name", ["ginzburg-landau", "transcription", "spring"])
def test_posteriors_converge_and_hold_the_truth(name, sampler):
    draws = {"nuts": {"warmup": 600, "samples": 600}, "ram": {"warmup": 1000, "samples": 1000}}[sampler]
    result = fitted(name, sampler=sampler, trajectory_draws=200, **draws)
    assert_complete(result, name)
    summary = arviz_data.summary(result)
    assert summary["r_hat"].max() < 1.02
    assert summary["ess_bulk"].min() > 200
    truth, posterior = arviz_data.group(result, "truth"), arviz_data.group(result, "posterior")
    for variable in set(truth.data_vars) & set(posterior.data_vars):
        drawn = np.log(np.abs(posterior[variable]))
        z = (np.log(np.abs(truth[variable])) - drawn.mean(("chain", "draw"))) / drawn.std(("chain", "draw"))
        assert np.abs(z).max() < 4.5, variable
