"""On the double well the exact posterior is known: the corrected one must agree with it where the filter's does not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.fokker_planck_grid.finite_volume import Grid
from lfm_ppl.fokker_planck_grid.grid_filter import log_likelihood
from lfm_ppl.io import loading
from lfm_ppl.likelihoods.likelihood_site import likelihood_site
from lfm_ppl.model.state_space import state_space
from lfm_ppl.results.arviz_data import summary
from lfm_ppl.results.result_view import ResultView

pytestmark = pytest.mark.slow

NAMES = ("sigma", "linear", "cubic")


WIDER, ELSEWHERE = 0, 2
"""Seeds of data whose filter posterior is wider than the exact one, and (the default data) away from it."""


@pytest.fixture(scope="module")
def wells():
    file = loading.load("ginzburg-landau")
    return file.model, {seed: file.simulate(seed=seed) for seed in (WIDER, ELSEWHERE)}


@pytest.fixture(scope="module")
def exact(wells):
    """Seed -> means and standard deviations by quadrature, the likelihood from the Fokker-Planck equation."""
    model, data = wells
    times, y = data[WIDER].times, jnp.stack([jnp.asarray(data_set.y) for data_set in data.values()])
    axes = (np.linspace(np.log(0.85), np.log(6.5), 22), np.linspace(-0.9, 0.25, 22),
            np.linspace(np.log(0.0015), np.log(0.1), 26))
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def log_densities(node):
        values = {"sigma": jnp.exp(node[0]), "linear": node[1], "cubic": jnp.exp(node[2])}
        site = likelihood_site(model, (times,), {}, jax.random.key(0), values)
        ssm = state_space(site.distribution.model)
        return log_likelihood(ssm, build_time_grid(ssm, times, 1), y, Grid(-9.0, 9.0, 220))

    result = np.asarray(jax.jit(lambda n: jax.lax.map(log_densities, n))(jnp.asarray(nodes)))
    # The model's priors, in the coordinates of the nodes: normal for all three.
    prior = -0.5 * (((nodes - [0.5, 0.0, -3.0]) / [0.5, 0.5, 1.0]) ** 2).sum(axis=1)
    values = {"sigma": np.exp(nodes[:, 0]), "linear": nodes[:, 1], "cubic": np.exp(nodes[:, 2])}
    moments = {}
    for index, seed in enumerate(data):
        log_weight = result[:, index] + prior
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        cube = weight.reshape(22, 22, 26)
        faces = [cube.take(end, axis=axis).sum() for axis in range(3) for end in (0, -1)]
        assert max(faces) < 2e-3, "the nodes hold the posterior"
        mean = {name: (weight * value).sum() for name, value in values.items()}
        moments[seed] = {name: (mean[name], np.sqrt((weight * (value - mean[name]) ** 2).sum()))
                         for name, value in values.items()}
    return moments


def off(table, exact):
    """The largest distance of a mean from the exact one, in exact standard deviations."""
    return max(abs(table.loc[name, "mean"] - mean) / sd for name, (mean, sd) in exact.items())


def test_importance_weights_correct_the_filter(wells, exact):
    """Every corrected mean within four of its standard errors of the exact one, every sd within as many of its own."""
    model, data = wells
    filtered = lfm.fit(model, data[WIDER].times, data[WIDER].y, sampler="ram", chains=4, samples=1000,
                       trajectory_draws=0, progress=False)
    assert off(summary(filtered), exact[WIDER]) > 0.3
    report = lfm.check_accuracy(filtered, model, reference="grid", draws=2000, progress=False)
    assert report.reliable and report.ess > 200
    for name, (mean, sd) in exact[WIDER].items():
        row = report.table.loc[name]
        assert abs(row["corrected_mean"] - mean) < 4.0 * sd / np.sqrt(report.ess), name
        assert abs(row["corrected_sd"] / sd - 1.0) < 4.0 / np.sqrt(report.ess), name


def test_weights_that_cannot_correct_it_say_so(wells, exact):
    """Where the filter's posterior is far off, its draws miss the exact one: k is too large, and nothing is said."""
    model, data = wells
    filtered = lfm.fit(model, data[ELSEWHERE].times, data[ELSEWHERE].y, sampler="ram", chains=4, samples=500,
                       trajectory_draws=0, progress=False)
    assert off(summary(filtered), exact[ELSEWHERE]) > 0.3
    report = lfm.check_accuracy(filtered, model, reference="grid", draws=400, progress=False)
    assert report.verdict.word == "re-run" and not report.reliable


@pytest.mark.parametrize("samples, options", [(600, {}), (2000, {"delayed": True})], ids=["plain", "delayed"])
def test_particle_marginal_chains_find_it(wells, exact, samples, options):
    """Where the weights fail: the chains that `lfm-ppl check --correct` and `fit --sampler pmmh` run.

    The filter's likelihood is too small by more than e^10 in a seventh of this posterior, so that delayed acceptance
    needs more draws.
    """
    model, data = wells
    result = lfm.fit(model, data[ELSEWHERE].times, data[ELSEWHERE].y, sampler="pmmh", chains=4, warmup=500,
                    samples=samples, thin=5, trajectory_draws=0, progress=False,
                    sampler_options={"particle_steps": 20, **options})
    table = summary(result)
    assert table.loc[list(NAMES), "ess_bulk"].min() > 100
    draws = ResultView.of(result).posterior
    for name, (mean, sd) in exact[ELSEWHERE].items():
        row = table.loc[name]
        assert abs(row["mean"] - mean) < 4.0 * row["mcse_mean"], name
        assert abs(float(draws[name].std()) / sd - 1.0) < 4.0 / np.sqrt(row["ess_bulk"]), name
