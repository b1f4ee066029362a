"""Plain NumPyro runs as results, and the names of their dimensions."""

import json
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd
import pytest
from numpyro.infer import MCMC, NUTS

import lfm_ppl as lfm
from lfm_ppl.results import arviz_data, tables
from lfm_ppl.results.result_view import ResultView
from tests.inference import linear_motif as motif

AT = [0.0, 6.0]
QUIET = {"progress_bar": False, "chain_method": "vectorized"}


def model(times, y=None, spread=0.4):
    """The linear motif, with what follows from its parameters."""
    decay = numpyro.sample("decay", dist.LogNormal(jnp.log(motif.THETA["decay"]), spread).to_event(1),
                           infer={"event_dims": ["gene"]})
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(1.5), spread))
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(jnp.log(0.2), spread))
    numpyro.deterministic("half_life", jnp.log(2.0) / decay)
    numpyro.sample("y", lfm.MarginalLikelihood(motif.build(decay, lengthscale, noise_sd), times), obs=y)


def group(result, name):
    return ResultView.of(result).group(name)


@pytest.fixture(scope="module")
def mcmc():
    # A walk compiles in less than NUTS, which the docstring's example runs.
    run = MCMC(lfm.RAM(model), num_warmup=100, num_samples=60, num_chains=2, **QUIET)
    run.run(jax.random.key(0), motif.TIMES, jnp.asarray(motif.data()), extra_fields=("accept_prob", "potential_energy"))
    return run


@pytest.fixture(scope="module")
def converted(mcmc):
    y = pd.DataFrame(motif.data(), columns=["CDKN1A", "SESN1"])
    with pytest.warns(lfm.ConvergenceWarning):
        return lfm.to_arviz(mcmc, model, motif.TIMES, y, trajectory_draws=8, at=AT,
                            dims={"half_life": ["gene"]}, coords={"gene": ["p21", "sestrin"]})


def test_a_plain_run_has_the_groups_of_a_fit(mcmc, converted):
    assert set(ResultView.of(converted).groups) == {
        "posterior", "sample_stats", "log_likelihood", "log_prior", "one_step_ahead", "trajectories",
        "posterior_predictive", "predictions", "data", "observed_data"}
    draws = mcmc.get_samples(group_by_chain=True)
    for name in ("decay", "lengthscale", "noise_sd", "half_life"):
        np.testing.assert_array_equal(group(converted, "posterior")[name], draws[name])
    stats = group(converted, "sample_stats")
    assert {"acceptance_rate", "lp"} <= set(stats.data_vars)
    np.testing.assert_allclose(stats["lp"], -mcmc.get_extra_fields(group_by_chain=True)["potential_energy"])
    assert ResultView.of(converted).attrs["sampler"] == "ram"


def test_one_step_ahead_densities_are_those_of_the_exact_likelihood(converted):
    posterior = group(converted, "posterior").isel(chain=1, draw=7)
    theta = {"decay": posterior["decay"].values, "lengthscale": float(posterior["lengthscale"]),
             "noise_sd": float(posterior["noise_sd"])}
    result = group(converted, "one_step_ahead")["log_density"].isel(chain=1, draw=7).sum()
    np.testing.assert_allclose(result, motif.log_density(motif.data(), **theta), rtol=1e-7)


def test_loo_sees_every_entry_of_the_data(converted):
    import arviz

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of few draws
        loo = arviz.loo(converted)
    assert loo.n_data_points == np.isfinite(motif.data()).sum()


def test_dimensions_and_columns_have_names(converted):
    posterior = group(converted, "posterior")
    assert list(arviz_data.summary(converted).index) == [
        "decay[p21]", "decay[sestrin]", "lengthscale", "noise_sd", "half_life[p21]", "half_life[sestrin]"]
    assert posterior["decay"].dims == posterior["half_life"].dims == ("chain", "draw", "gene")
    for name in ("data", "predictions", "trajectories"):
        assert group(converted, name)["output"].values.tolist() == ["CDKN1A", "SESN1"]
    assert group(converted, "data")["y"].attrs["units"] == "nM"  # of the model's outputs a and b


def test_derived_parameters_and_warnings_are_marked_in_a_file_too(converted, tmp_path):
    posterior = group(converted, "posterior")
    assert posterior["half_life"].attrs["derived"] == 1
    assert "derived" not in posterior["decay"].attrs
    stored_warnings = json.loads(ResultView.of(converted).attrs["warnings"])
    assert stored_warnings
    table = tables.annotate(arviz_data.summary(converted), converted)
    assert table.loc["half_life[p21]", "kind"] == "derived"
    assert table.loc["noise_sd", "kind"] == "sampled"
    assert table.loc["noise_sd", "warnings"]
    loaded = lfm.load(lfm.save(converted, tmp_path / "posterior.nc"))
    assert ResultView.of(loaded).attrs["warnings"] == ResultView.of(converted).attrs["warnings"]
    assert group(loaded, "posterior")["half_life"].attrs["derived"] == 1
    assert group(loaded, "posterior")["gene"].values.tolist() == ["p21", "sestrin"]


@pytest.mark.thorough
def test_draws_without_an_mcmc_and_without_derived_ones(mcmc, converted):
    draws = {name: value for name, value in mcmc.get_samples(group_by_chain=True).items() if name != "half_life"}
    with pytest.warns(lfm.ConvergenceWarning):
        result = lfm.to_arviz(draws, model, motif.TIMES, motif.data(), trajectory_draws=0)
    np.testing.assert_allclose(group(result, "posterior")["half_life"], group(converted, "posterior")["half_life"])
    assert "sample_stats" not in ResultView.of(result).groups
    assert group(result, "posterior")["decay"].dims == ("chain", "draw", "gene")  # of `event_dims`


def panel_model(times, y=None):
    with numpyro.plate("patient", 3):
        decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))

        def build(p):
            return motif.build(p["decay"][None], 1.5, 0.2)

        numpyro.sample("y", lfm.panel(build, {"decay": decay}, times), obs=y)


@pytest.mark.slow
def test_the_plate_of_a_panel_is_a_dimension_of_every_group():
    draws, labels = {"decay": np.full((1, 4, 3), 0.5)}, ["Ann", "Bo", "Cy"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = lfm.to_arviz(draws, panel_model, np.arange(3.0), np.zeros((3, 3, 1)), coords={"patient": labels},
                              trajectory_draws=2)
    assert list(arviz_data.summary(result).index) == ["decay[Ann]", "decay[Bo]", "decay[Cy]"]
    for name in ("data", "trajectories"):
        assert group(result, name)["patient"].values.tolist() == labels
    assert group(result, "log_likelihood")["patient"].values.tolist() == sorted(3 * labels)


@pytest.mark.thorough
def test_wrong_names_and_runs_are_refused(mcmc):
    for keywords, name in (({"dims": {"deca": ["gene"]}}, "'deca'"), ({"coords": {"gen": ["a", "b"]}}, "'gen'"),
                           ({"dims": {"decay": ["gene", "tissue"]}}, "'decay'"),
                           ({"coords": {"gene": ["a"]}}, "2 labels"),
                           ({"coords": {"output": ["a", "a"]}}, "2 labels")):
        with pytest.raises(ValueError, match=name):
            lfm.to_arviz(mcmc, model, motif.TIMES, motif.data(), **keywords)
    for run, error, name in ((MCMC(NUTS(model), num_warmup=1, num_samples=1), ValueError, "mcmc.run"),
                             ("mcmc", TypeError, "MCMC"), ({"rate": np.ones((1, 3))}, ValueError, "'decay'"),
                             ({"decay": np.ones((1, 3))}, ValueError, "'decay'")):
        with pytest.raises(error, match=name):
            lfm.to_arviz(run, model, motif.TIMES, motif.data())
