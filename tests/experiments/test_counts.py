"""Sites against exact draws as an experiment: its data, its reference against dense algebra, tables and figures."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references import matern
from scipy import stats

import lfm_ppl as lfm
from lfm_ppl.experiments import catalogue
from lfm_ppl.experiments.counts import experiment, methods, problem, report, tables
from lfm_ppl.experiments.counts.reference import Reference

ROOT = Path(__file__).resolve().parent.parent.parent
DATA = Path(os.environ.get("LFM_DATA", ROOT.parent / "shared" / "data"))
needs_data = pytest.mark.skipif(not (DATA / problem.EVENTS).is_file(),
                                reason=f"{DATA} is not there; LFM_DATA says where")


@needs_data
def test_the_data_are_counted_as_they_are():
    coal = problem.problem(problem.COAL, problem.Size(), 0, str(DATA))
    assert coal.y.sum() == 191 and coal.y.shape == (333, 1)
    assert np.bincount(coal.folds).tolist() == [34, 34, 34, 33, 33, 33, 33, 33, 33, 33]
    calls = [problem.problem(name, problem.Size(), 0, str(DATA)) for name in problem.CALLS]
    assert calls[0].y.shape == (8 * 42, 1) and calls[0].y[0, 0] == 111 + 113 + 76 + 82
    for one in calls:
        np.testing.assert_array_equal(one.folds, calls[0].folds)
    # Whole blocks are held out, and each row once.
    assert all(len(set(block)) == 1 for block in np.split(calls[0].folds, 56))


def test_settings_are_checked_and_it_is_in_the_catalogue():
    with pytest.raises(ValueError, match="Did you mean 'coal'"):
        experiment.Settings(problems=("coals",))
    with pytest.raises(ValueError, match="draws"):
        experiment.Settings(draws=0)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        problem.problem(problem.CALLS[0], problem.Size(), 0, "nowhere")
    assert catalogue.experiment("counts").summary == report.SUMMARY
    assert len(experiment.comparing(experiment.Settings(), dict.fromkeys(problem.NAMES, {}))) == 7 * 4


def test_tables_measure_against_the_reference(monkeypatch):
    """From results that are made up, and errors that are known."""
    settings = experiment.Settings(problems=("student-t",), size=problem.Size(rows=4))
    truth = np.array([0.0, 0.1, 5.0, 0.0])
    one = problem.Problem(np.arange(4.0), truth[:, None], np.zeros(4, int), lambda: None, {}, {}, truth)
    monkeypatch.setattr(problem, "problem", lambda *arguments: one)
    exact = {"log evidence": -10.0, "log evidence error": 0.01, "mean": np.zeros(4), "sd": np.ones(4), "seconds": 3.0,
             "log density": -np.arange(4.0), "low": -np.ones(4), "high": np.ones(4)}
    rough = exact | {"log evidence": -10.5, "mean": np.array([0, 0, 0.2, 0]), "sd": np.full(4, 0.9),
                     "log density": -np.arange(4.0) - 0.5}
    results = {f"student-t/{method}": rough for method in methods.METHODS} | {"student-t/reference": exact}
    row = tables.accuracy(settings, results).loc["student-t, EP"]
    assert row[["less reference", "mean", "sd", "covered"]].tolist() == pytest.approx([-0.5, 0.2, 0.1, 0.75])
    row = tables.prediction(settings, results).loc["student-t, EP"]
    assert row[["NLPD", "less reference", "covered"]].tolist() == pytest.approx([2.0, 0.5, 0.75])
    assert row["less reference se"] == pytest.approx(0.0)


@pytest.mark.slow
def test_the_reference_is_dense_algebra_where_that_is_exact():
    """Gaussian data under a family: log evidence, means and sds in closed form; a missing entry."""
    times, noise = np.linspace(0.0, 6.0, 25), 0.3
    system = problem.process({"u": lfm.Matern(1.2, 1.5, order=1), "v": lfm.Matern(0.5, 0.4, order=1)},
                             lambda h: lfm.Observations(lfm.GaussianObservation(h, noise**2 * jnp.ones(1))), 0.7)
    y = 0.7 + np.random.default_rng(0).normal(size=(25, 1))
    y[4] = np.nan
    k = sum(matern(s, length, 1)(times[:, None], times) for s, length in ((1.2, 1.5), (0.5, 0.4)))
    there = np.isfinite(y[:, 0])
    own = k[np.ix_(there, there)] + noise**2 * np.eye(there.sum())
    gain = np.linalg.solve(own, k[there]).T
    mean, cov = 0.7 + gain @ (y[there, 0] - 0.7), k - gain @ k[there]
    reference = Reference(system, times, lfm.SiteSettings())
    weighed = reference.weigh(jax.random.key(0), y, 500)
    log_z = stats.multivariate_normal.logpdf(y[there, 0], np.full(there.sum(), 0.7), own)
    assert weighed.log_evidence == pytest.approx(log_z, abs=1e-6) and weighed.share == pytest.approx(1.0)
    draws = reference.sample(jax.random.key(1), y, 2000)
    sd = np.sqrt(np.diag(cov))
    # 8,000 independent draws: 4.5 standard errors for 25 entries
    assert np.abs((draws.mean((0, 1)) - mean) / sd).max() < 4.5 / np.sqrt(8000)
    assert np.abs(draws.std((0, 1)) / sd - 1).max() < 4.5 / np.sqrt(16000)


@pytest.mark.slow
def test_a_small_one_runs_and_leaves_files(tmp_path):
    settings = experiment.Settings(problems=("bernoulli", "student-t"), size=problem.Size(rows=30, folds=2), draws=2000)
    found = experiment.run(settings, tmp_path)
    accuracy = found.accuracy
    for name in settings.problems:
        assert abs(accuracy.loc[f"{name}, EP", "less reference"]) < 0.2
        assert accuracy.loc[f"{name}, EP", "mean"] < 0.1
    reference = tables.reference(settings, found.results)
    assert reference["r_hat"].max() < 1.02 and reference["share"].min() > 0.2
    written = {path.name for path in experiment.save(found, tmp_path)}
    assert written == {"accuracy.csv", "accuracy.md", "prediction.csv", "prediction.md", "errors.png"}
    again = experiment.run(settings, tmp_path)
    np.testing.assert_array_equal(again.accuracy, found.accuracy)
