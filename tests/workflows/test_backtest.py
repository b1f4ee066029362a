"""Rolling origins: what each fit knew, what it predicted, what was compiled, and the reference beside it."""

import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import systems
from scipy import stats

import lfm_ppl as lfm
from lfm_ppl.results import scoring
from tests.compiled_programs import compilations
from tests.inference import linear_motif as motif

NEAR = 1e-7
TIMES = np.array([0.0, 0.4, 1.0, 1.7, 2.5, 3.2, 4.0, 4.6])


def data():
    covariance = motif.observation_covariance(TIMES, **motif.THETA)
    y = np.random.default_rng(2).multivariate_normal(np.zeros(16), covariance).reshape(-1, 2)
    y[3, 0] = y[6, 1] = np.nan
    return y


@pytest.fixture(scope="module")
def linear():
    return lfm.backtest(motif.model, TIMES, data(), horizon=2, every=1, first=4, model_kwargs={"spread": NEAR})


def test_forecasts_are_those_of_the_data_up_to_the_origin(linear):
    scores, y = linear.scores, data()
    assert dict(scores["crps"].sizes) == {"forecaster": 2, "origin": 3, "horizon": 2, "output": 2}
    np.testing.assert_array_equal(scores["origin"], TIMES[3:6])
    np.testing.assert_array_equal(scores["time"], [TIMES[4:6], TIMES[5:7], TIMES[6:8]])
    model_scores = scores.sel(forecaster="model")
    for row, origin in enumerate((3, 4, 5)):
        horizon = slice(origin + 1, origin + 3)
        mean, covariance = motif.posterior(y[:origin + 1], TIMES[horizon], **motif.THETA, times=TIMES[:origin + 1])
        mean, sd = mean[-4:].reshape(2, 2), np.sqrt(np.diag(covariance)[-4:] + 0.04).reshape(2, 2)
        np.testing.assert_allclose(model_scores["mean"][row], mean, atol=1e-5)
        np.testing.assert_allclose(model_scores["log_score"][row], stats.norm.logpdf(y[horizon], mean, sd), atol=1e-4)
        np.testing.assert_allclose(model_scores["error"][row], y[horizon] - mean, atol=1e-5)
    assert np.isnan(model_scores["crps"].values[2, 0, 1])  # missing at row 6
    table = linear.table
    assert table.index.tolist() == [(who, name) for who in ("model", "persistence") for name in ("a", "b", "all")]
    assert table["n"].tolist() == [6, 4, 10] * 2
    np.testing.assert_allclose(table.loc[("model", "all"), "log_score"], np.nanmean(model_scores["log_score"]))
    wins = linear.wins()
    assert wins["origins"].tolist() == [3, 3, 3]
    assert (wins[["rmse", "crps", "log_score"]] <= 3).all(axis=None)


@pytest.mark.thorough
def test_further_origins_compile_nothing_and_outputs_have_the_names_of_the_data(linear):
    """Every fit has the shape of the whole data."""
    data_set = lfm.Data(TIMES, data() + 0.1, ("left", "right"))
    with compilations() as compiled:
        result = lfm.backtest(motif.model, data_set, horizon=1, every=2, first=3, model_kwargs={"spread": NEAR})
    assert compiled == []
    assert result.scores["output"].values.tolist() == ["left", "right"]


def well(times, y=None):
    a = numpyro.sample("a", dist.LogNormal(0.0, NEAR))
    numpyro.sample("y", lfm.MarginalLikelihood(systems.double_well(a=-a), times), obs=y)


@pytest.mark.slow
def test_a_nonlinear_model_is_simulated_from_each_origin():
    times, y = np.arange(5.0), np.array([[-0.9], [0.0], [0.1], [0.9], [1.1]])
    first = lfm.backtest(well, times, y, horizon=2, first=3, draws=1000)
    result = lfm.fit(well, times[:3], y[:3], sampler="map", samples=1000, trajectory_draws=0, progress=False)
    alone = lfm.forecast(result, well, times[3:], draws=1000, seed=1)
    single = first.scores.sel(forecaster="model").isel(origin=0)
    states = alone["predictions"]["outputs"].values[0, :, :, 0]
    np.testing.assert_array_less(np.abs(single["mean"][:, 0] - states.mean(0)), 4.5 * states.std(0) * np.sqrt(2e-3))
    with compilations() as compiled:
        lfm.backtest(well, times, y + 0.01, horizon=1, first=3, draws=1000)
    assert compiled == []


@pytest.mark.thorough
def test_the_reference_is_the_last_season_with_the_spread_of_its_changes():
    y = data()
    y = np.where(np.isnan(y), 0.0, y)
    y[2, 1] = np.nan
    result = lfm.backtest(motif.model, TIMES, y, horizon=3, first=5, season=2, model_kwargs={"spread": NEAR})
    naive = result.scores.sel(forecaster="seasonal-naive").isel(origin=0)
    for output, rows in ((0, (3, 4, 3)), (1, (3, 4, 3))):
        np.testing.assert_array_equal(naive["mean"][:, output], y[list(rows), output])
    for lead, lag in ((1, 2), (2, 2), (3, 4)):
        change = y[lag:5, 0] - y[:5 - lag, 0]
        if change.size > 1:
            sd = np.sqrt(np.mean(change**2))
            expected = scoring.gaussian_scores(naive["mean"].values[lead - 1, 0], sd, y[4 + lead, 0])
            np.testing.assert_allclose(naive["crps"][lead - 1, 0], expected.crps)
        else:
            assert np.isnan(naive["crps"][lead - 1, 0])  # a single change tells no spread


@pytest.mark.parametrize(("change", "name"), [
    ({"horizon": 8}, "origin"), ({"horizon": 0}, "horizon"), ({"first": 2}, "at least 3"), ({"season": 0}, "season"),
    ({"every": 0}, "every"), ({"times": np.array([0.0, 1.0, 1.0, *TIMES[3:]])}, "rows 1 and 2"),
    ({"y": np.zeros((2, 8, 2))}, "one series")])
def test_wrong_arguments_are_named(change, name):
    with pytest.raises(ValueError, match=name):
        lfm.backtest(motif.model, **{"times": TIMES, "y": data(), "horizon": 1, **change})


@pytest.mark.thorough
def test_an_error_of_a_fit_keeps_its_type_and_names_the_origin(monkeypatch):
    def fail(*arguments, **keywords):
        raise UnicodeDecodeError("ascii", b"\xff", 0, 1, "not a text")  # a type that takes five arguments

    monkeypatch.setattr("lfm_ppl.workflows.backtest.fit", fail)
    with pytest.raises(UnicodeDecodeError) as raised:
        lfm.backtest(motif.model, TIMES, data(), horizon=1, first=4)
    assert raised.value.__notes__ == ["at the origin 1.7 (row 3)"]
