"""A posterior mode that is a spike of the density is reported wherever a result is read."""

import json
import warnings

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import lfm_ppl as lfm
from lfm_ppl.results import arviz_data, tables
from lfm_ppl.results.result_view import ResultView

TIMES = np.linspace(0.0, 4.0, 6)
PRIORS = {"half normal": dist.HalfNormal(1.0), "log normal": dist.LogNormal(0.0, 2.0)}


def series(level, unit):
    return lfm.LatentForceModel(
        lambda x, u, t: u - x, {"u": lfm.Matern(0.3 * unit, 1.0, 0)},
        lfm.GaussianObservation(lambda x, u, t: x + level, jnp.array([0.25]) * unit**2),
        lfm.Gaussian(jnp.zeros(1), 0.1 * unit**2 * jnp.eye(1)))


def hierarchy(times, y=None, prior="half normal", centred=True, unit=1.0):
    """Levels of six series about a common one."""
    mean = numpyro.sample("mean", dist.Normal(0.0, 5.0))
    spread = numpyro.sample("spread", PRIORS[prior])
    with numpyro.plate("series", 6):
        if centred:
            level = numpyro.sample("level", dist.Normal(mean, spread))
        else:
            level = mean + spread * numpyro.sample("standard", dist.Normal(0.0, 1.0))
        panel = lfm.panel(lambda p: series(p["level"], unit), {"level": unit * level}, times, steps=1)
        numpyro.sample("y", panel, obs=y)


@pytest.fixture(scope="module")
def y():
    rng = np.random.default_rng(0)
    return 2.0 + 0.5 * rng.normal(size=(6, 1, 1)) + 0.5 * rng.normal(size=(6, TIMES.size, 1))


def fitted(y, **keywords):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the search itself warns as well
        return lfm.fit(hierarchy, TIMES, y, sampler="map", samples=100, trajectory_draws=0, progress=False,
                       model_kwargs=keywords)


@pytest.mark.thorough
@pytest.mark.parametrize("keywords", [{"prior": "half normal"}, {"prior": "log normal", "unit": 1e3}],
                         ids=["no mode", "a mode far out"])
def test_a_group_that_collapses_is_named_everywhere(y, keywords, tmp_path):
    result = fitted(y * keywords.get("unit", 1.0), **keywords)
    table = arviz_data.summary(result)
    assert table.loc["spread", "mode"] < 1e-4
    message, *conflicts = json.loads(ResultView.of(result).attrs["warnings"])
    assert all("spread" in conflict and "prior" in conflict for conflict in conflicts)
    assert message == arviz_data.convergence_warnings(result)[0]
    assert "spread" in message
    assert table["warnings"].to_dict() == {name: "degenerate mode" * (name == "spread") for name in table.index}
    written = tables.annotate(table, result)["warnings"]
    assert written["spread"] == message and written["mean"] == ""
    loaded = lfm.load(lfm.save(result, tmp_path / "posterior.nc"))
    page = lfm.save_report(loaded, tmp_path, figures=()).read_text()
    assert page.index("degenerate in spread") < page.index('id="model"')


@pytest.mark.thorough
def test_a_proper_mode_gives_no_warning(y):
    """The same model in non-centred form."""
    result = fitted(y, centred=False)
    assert json.loads(ResultView.of(result).attrs["warnings"]) == []
    assert "warnings" not in arviz_data.summary(result)


@pytest.mark.thorough
@pytest.mark.parametrize("floor", [0.0, 1e-6], ids=["known well", "only bounded"])
def test_a_small_parameter_that_the_data_ask_for_gives_no_warning(floor):
    """A standard deviation at 1e-6 of its prior; with as much noise besides, it is only known to be no larger."""
    times = np.linspace(0.0, 4.0, 40)

    def precise(times, y=None, floor=0.0):
        noise_sd = numpyro.sample("noise_sd", dist.HalfNormal(1.0))
        model = lfm.LatentForceModel(
            lambda x, u, t: -x, {},
            lfm.GaussianObservation(lambda x, u, t: x, jnp.reshape(noise_sd**2 + floor**2, (1,))),
            lfm.Gaussian(jnp.ones(1), jnp.zeros((1, 1))))
        numpyro.sample("y", lfm.MarginalLikelihood(model, times, steps=10), obs=y)

    error = np.random.default_rng(0).normal(size=(40, 1))
    y = np.exp(-times)[:, None] + 1e-6 * error / error.std()
    with warnings.catch_warnings():
        warnings.simplefilter("error", lfm.ConvergenceWarning)
        result = lfm.fit(precise, times, y, sampler="map", samples=100, trajectory_draws=0, progress=False,
                         model_kwargs={"floor": floor})
    assert 1e-8 < arviz_data.summary(result).loc["noise_sd", "mode"] < 1e-5
