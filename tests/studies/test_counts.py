"""Factors against exact draws as a study: its data, settings and tables."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.studies import catalogue
from lfm_ppl.studies.counts import figures, methods, problem, reference, study

ROOT = Path(__file__).resolve().parent.parent.parent
DATA = Path(os.environ.get("LFM_DATA", ROOT.parent / "shared" / "data"))
needs_data = pytest.mark.skipif(not (DATA / problem.DISASTERS).is_file(),
                                reason=f"{DATA} is not there; LFM_DATA says where")


@needs_data
def test_the_data_are_counted_as_they_are():
    coal = problem.build_problem(problem.COAL, problem.ProblemSize(), 0, str(DATA))
    assert coal.y.sum() == 191 and coal.y.shape == (333, 1)
    assert np.bincount(coal.folds).tolist() == [34, 34, 34, 33, 33, 33, 33, 33, 33, 33]
    calls = [problem.build_problem(name, problem.ProblemSize(), 0, str(DATA)) for name in problem.CALLS]
    assert calls[0].y.shape == (8 * 42, 1) and calls[0].y[0, 0] == 111 + 113 + 76 + 82
    for call_problem in calls:
        np.testing.assert_array_equal(call_problem.folds, calls[0].folds)
    # Whole blocks are held out, and each row once.
    assert all(len(set(block)) == 1 for block in np.split(calls[0].folds, 56))


def test_settings_are_checked_and_it_is_in_the_catalogue():
    with pytest.raises(FileNotFoundError, match="nowhere"):
        problem.build_problem(problem.CALLS[0], problem.ProblemSize(), 0, "nowhere")
    assert catalogue.entry("counts").study is study.STUDY
    learnt = {f"{name}/parameters": {} for name in problem.NAMES}
    assert len(study.comparison_tasks(study.CountsSettings(), learnt)) == 7 * 4


def synthetic_results(monkeypatch):
    """Settings of one problem, and results whose errors are known."""
    settings = study.CountsSettings(problems=("student-t",), size=problem.ProblemSize(rows=4))
    truth = np.array([0.0, 0.1, 5.0, 0.0])
    count_problem = problem.CountsProblem(np.arange(4.0), truth[:, None], np.zeros(4, int), lambda: None, {}, {}, truth)
    monkeypatch.setattr(methods, "build_problem", lambda *arguments: count_problem)
    exact = {"log evidence": -10.0, "log evidence error": 0.01, "mean": np.zeros(4), "sd": np.ones(4), "seconds": 3.0,
             "log density": -np.arange(4.0), "low": -np.ones(4), "high": np.ones(4)}
    rough = exact | {"log evidence": -10.5, "mean": np.array([0, 0, 0.2, 0]), "sd": np.full(4, 0.9),
                     "log density": -np.arange(4.0) - 0.5}
    del rough["log evidence error"]
    results = {f"student-t/{method}": rough.copy() for method in methods.METHODS} | {
        "student-t/reference": exact, "student-t/parameters": {"level": 0.5}}
    return settings, results


def test_tables_measure_against_the_reference(monkeypatch):
    """From results that are made up, and errors that are known."""
    settings, results = synthetic_results(monkeypatch)
    tables = study.tables(settings, study.STUDY.collect(settings, results))
    row = tables["accuracy"].frame.loc["student-t, EP"]
    assert row[["less reference", "mean", "sd", "covered"]].tolist() == pytest.approx([-0.5, 0.2, 0.1, 0.75])
    assert row["less reference se"] == 0.01 and np.isnan(row["log Z se"])
    row = tables["prediction"].frame.loc["student-t, EP"]
    assert row[["NLPD", "less reference", "covered"]].tolist() == pytest.approx([2.0, 0.5, 0.75])
    assert row["less reference se"] == pytest.approx(0.0)
    exact = tables["accuracy"].frame.loc["student-t, reference"]
    assert exact["log Z se"] == 0.01 and exact["seconds"] == 3.0
    assert exact[["less reference", "less reference se", "mean", "sd"]].isna().all()
    assert len(figures.plot_errors(settings, study.STUDY.collect(settings, results)).axes) == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", problem.SIMULATED)
def test_moments_of_the_simulated_data_are_exact_but_for_the_mark(name):
    """200 rows, of which 20 are off by 20 scales for Student-t: means within 0.05 sd, sds within 3% of exact draws."""
    data = problem.build_problem(name, problem.ProblemSize(), 0, None)
    model = data.build_model(**data.true_parameters)
    posterior = reference.MonteCarloReference(model, data.times, data.sites)
    draws = posterior.sample(jax.random.key(0), data.y, posterior.proposal(data.y), 20_000)
    mean, sd = lfm.smooth(model, data.times, data.y, factors=data.factors).force("u")
    exact, spread = draws.mean((0, 1)), draws.std((0, 1))
    mean_error, sd_error = np.abs(mean - exact) / spread, np.abs(sd / spread - 1)
    print(f"{name}: means {mean_error.max():.4f} sd at most, sds {sd_error.max():.4f}")
    assert mean_error.max() < 0.05 and sd_error.max() < 0.03
