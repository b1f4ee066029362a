"""What a fit under constraints says of itself, and at which times they hold."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd
import pytest
import xarray as xr
from systems import Linear, whole_state

import lfm_ppl as lfm
from lfm_ppl.cli import main
from lfm_ppl.constrained.augmented import COARSE, build_rows
from lfm_ppl.inference.factor_failures import FactorFailures, failures_at, path_ess
from lfm_ppl.results import arviz_data, convergence, tables
from lfm_ppl.results.result_view import ResultView

TIMES = np.linspace(0.0, 3.0, 4)
Y = np.array([[0.0], [0.1], [0.02], [0.1]])


def system(lengthscale=1.0):
    return lfm.LatentForceModel(
        Linear(jnp.array([[-0.6]]), jnp.array([[0.25]])), {"factor": lfm.Matern(1.0, lengthscale)},
        lfm.GaussianObservation(whole_state, jnp.array([0.08**2])), lfm.Gaussian(jnp.zeros(1), 0.01 * jnp.eye(1)),
        initial_time=0.0)


def bounded(times, y=None, draws=32, grid=None):
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.0, 0.4))
    numpyro.sample("y", lfm.ConstrainedLikelihood(system(lengthscale), times, lower={"factor": 0.0}, draws=draws,
                                               grid=grid), obs=y)


def held(times, grid=None, **more):
    rows = build_rows(system(), times, grid, **more)
    return rows.times[rows.grid]


def test_where_constraints_hold():
    """By default at all observations and a little more where an evidence is asked for; as many times as are wanted."""
    few, many = np.array([0.0, 1.0, 3.0]), np.linspace(0.0, 5.0, 501)
    np.testing.assert_allclose(held(few, default=COARSE), [*np.linspace(0, 1, 8)[:-1], *np.linspace(1, 3, 15)])
    assert np.isin(few, held(few, default=COARSE)).all() and len(held(few)) == 202
    np.testing.assert_allclose(held(many, default=COARSE), np.linspace(0.0, 5.0, 100))
    assert len(held(many)) == 501
    np.testing.assert_allclose(held(few, 7), np.linspace(0.0, 3.0, 7))
    # A row at equal distances that rounding puts beside an observation is at its time.
    tenths = np.arange(31) * 0.1
    assert len(build_rows(system(), tenths, 31).times) == 31
    assert len(held(few[:1], 5)) == 1


def result(**attrs):
    chance = np.random.default_rng(0)
    posterior = xr.Dataset({name: (("chain", "draw"), chance.normal(size=(4, 500))) for name in ("a", "b")})
    return arviz_data.build({"posterior": posterior}, {"sampler": "nuts", **attrs})


@pytest.mark.parametrize("sampler", ["nuts", "map"])
def test_what_a_result_under_constraints_says(sampler):
    """In its warnings, and in each row of the summary."""
    base = {"sampler": sampler, "constraints": "factor >= 0 at 6 times"}
    good = result(**base, factor_failures="[100, 0, 1]", constraint_weights="[256, 40.0, 3.0]")
    assert not arviz_data.convergence_warnings(good)
    bad = result(**base, factor_failures="[100, 7, 9]", constraint_weights="[256, 3.0, 1.2]")
    factors, weights = arviz_data.convergence_warnings(bad)
    assert "7 of 100" in factors and "256" in weights and "0.6" in weights
    for warning in tables.annotate(arviz_data.summary(bad), bad)["warnings"]:
        assert factors in warning and weights in warning
    for few in ("[2, 2.0, 2.0]", "[256, 0.0, 0.0]"):
        assert len(arviz_data.convergence_warnings(result(**base, constraint_weights=few))) == 1


def test_the_error_of_an_evidence_is_that_of_its_logarithm_over_many_sets_of_weights():
    """Of 32 log-normal weights, 5,000 times; the standard deviation of 5,000 has an error of 1%."""
    weights = np.exp(0.6 * np.random.default_rng(0).normal(size=(5000, 32)))
    worth = weights.sum(axis=1) ** 2 / (weights**2).sum(axis=1)
    errors = [convergence.log_mean_error(ess, 32) for ess in worth]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.log(weights.mean(axis=1)).std(), rel=0.04)
    assert convergence.log_mean_error(32.0, 32) == 0.0
    # Without the share of all: sqrt(1 / worth) would be more than twice as much.
    assert np.mean(errors) < 0.6 * np.mean(worth**-0.5)


@pytest.mark.slow
def test_unconverged_factors_and_light_weights_are_counted():
    """The weights of 2 trajectories are worth at most 2; factors converge nowhere at a lengthscale of NaN."""
    bound = lfm.bind(bounded, TIMES, Y, model_kwargs={"draws": 2, "grid": TIMES})
    values = {"lengthscale": np.array([0.5, 1.0, np.nan, 2.0])}
    assert failures_at(bound, values) == FactorFailures(4, 1, 1)
    worth = path_ess(bound, {"lengthscale": np.array([0.5, 1.0, 2.0])})
    assert worth.trajectories == 2 and 1.0 <= worth.least <= worth.median <= 2.0
    # Weights by hand, of the data and without them.
    likelihood = lfm.ConstrainedLikelihood(system(), TIMES, lower={"factor": 0.0}, grid=TIMES, draws=64)
    problem = likelihood.truncated_posterior()
    by_hand = []
    for y in (jnp.asarray(Y), jnp.full_like(Y, jnp.nan)):
        weights = np.exp(problem.log_weights(jax.random.key(0), y, 64))
        by_hand.append(weights.sum() ** 2 / (weights**2).sum())
    assert float(problem.effective_sample_size(jnp.asarray(Y), 64)) == pytest.approx(min(by_hand), rel=1e-10)


@pytest.mark.slow
def test_a_fit_stores_and_says_it(tmp_path):
    with pytest.warns(lfm.ConvergenceWarning, match="16 weighted trajectories"):
        result = lfm.fit(lambda times, y=None: bounded(times, y, 16, 31), TIMES, Y, sampler="ram", chains=2, warmup=50,
                         samples=50, trajectory_draws=0, progress=False)
    attrs = ResultView.of(result).attrs
    assert attrs["constraints"] == "factor >= 0 at 31 times" and json.loads(attrs["factor_failures"])[0] == 100
    assert any("weighted trajectories" in warning for warning in json.loads(attrs["warnings"]))


MODEL = '''"""A gene."""
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("x",)


def model(times, y=None):
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.0, 0.4))
    system = lfm.LatentForceModel(
        lambda x, u, t: 0.25 * u - 0.6 * x, {"factor": lfm.Matern(1.0, lengthscale)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.08**2])), lfm.Gaussian(jnp.zeros(1), 0.01 * jnp.eye(1)))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=2), obs=y)
'''


@pytest.mark.slow
def test_the_command_line_chooses_the_times(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "gene.py").write_text(MODEL)
    pd.DataFrame({"time": TIMES, "x": Y[:, 0]}).to_csv("d.csv", index=False)
    assert main(["fit", "gene.py", "--data", "d.csv", "--lower", "factor=0", "--grid", "7", "--sampler", "map",
                 "--samples", "40", "--out", "out", "--quiet", "--no-cache"]) == 0
    assert "factor >= 0 at 7 times" in capsys.readouterr().out
    result = lfm.load("out")
    attrs = ResultView.of(result).attrs
    assert attrs["constraints"] == "factor >= 0 at 7 times" and json.loads(attrs["factor_failures"]) == [40, 0, 0]
    trajectories, median, _ = json.loads(attrs["constraint_weights"])
    assert trajectories == 256 and median > 10 and not arviz_data.convergence_warnings(result)
    # The forecast goes on with the same times.
    assert main(["forecast", "out", "--until", "4", "--no-cache"]) == 0
