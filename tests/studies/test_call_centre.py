"""Call centre study: counts, queues, scores, tables and figures."""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import integrate, stats

from lfm_ppl.studies import importance_at_modes
from lfm_ppl.studies.call_centre import counts, learning, problem, study, tracking

DATA = Path(os.environ.get("LFM_DATA", "../shared/data")) / "calls"
real = pytest.mark.skipif(not DATA.is_dir(), reason="the counts of real calls are not there (LFM_DATA)")


def window(index=0, data=None):
    return problem.build_window(data, "Thursday", index)


def write_counts(path, change=lambda table: table):
    """Write two days of counts as a file."""
    times = [pd.Timestamp(day) + pd.Timedelta(minutes=5 * k + 420)
             for day in ("2003-03-06", "2003-03-13") for k in range(169)]
    table = pd.DataFrame({"DateTime": [t.strftime("%Y-%m-%dT%H:%M:%SZ") for t in times],
                          "Calls": [str(k) for k in range(338)]})
    change(table).to_csv(path)
    return path


def test_counts_are_read_day_by_day(tmp_path):
    days = counts.read(write_counts(tmp_path / counts.FILE))
    assert days.dates.astype(str).tolist() == ["2003-03-06", "2003-03-13"]
    np.testing.assert_array_equal(days.calls, [np.arange(168), 169 + np.arange(168)])
    assert len(counts.read(tmp_path).select_weekday("Thursday").dates) == 2
    for change, name in ((lambda table: table.rename(columns={"Calls": "n"}), "'Calls'"),
                         (lambda table: table.replace({"Calls": {"3": "-2"}}), "row 5, column 'Calls'"),
                         (lambda table: table.drop(index=20), "2003-03-06")):
        with pytest.raises(ValueError, match=name):
            counts.read(write_counts(tmp_path / "calls.csv", change))


def test_the_queue_solves_its_equation():
    """Against an adaptive method of order eight, five minutes at a time, through an overload."""
    arrivals = np.random.default_rng(0).uniform(2.0, 14.0, 60)
    service = np.repeat([15.0, 5.0, 4.0], 20)
    with pytest.warns(counts.OverloadWarning, match="more customers"):
        path = counts.queue(arrivals, service)
    expected = [0.0]
    for zeta, omega in zip(arrivals, service, strict=True):
        solution = integrate.solve_ivp(lambda t, x: zeta - omega * x / (1 + x), (0, 5), expected[-1:],  # noqa: B023
                                       method="DOP853", rtol=1e-11, atol=1e-12)
        expected.append(solution.y[0, -1])
    np.testing.assert_allclose(path, expected, rtol=1e-7, atol=2e-6)


@real
def test_real_days_have_the_stated_utilisation():
    everything = counts.read(DATA)
    thursdays, rate = problem.load_days(str(DATA), "Thursday", 0)
    assert everything.calls.shape == (164, 168) and len(thursdays.dates) == 34
    assert rate * everything.calls.mean() == pytest.approx(7.0)
    assert len(thursdays.dates) - problem.TRAINING_DAYS == 31


def test_a_window_has_its_readings_where_they_belong():
    call_window = window(1)
    assert call_window.arrivals.shape == (672,) and call_window.training.shape == (63, 1)
    test = call_window.y["changed"][problem.TEST_START:, 0]
    np.testing.assert_array_equal(problem.GRID[problem.TEST_START:][np.isfinite(test)], 2520.0 + 180.0 * np.arange(5))
    constant, changed = (call_window.y[test][:problem.TEST_START] for test in ("constant", "changed"))
    np.testing.assert_array_equal(constant, changed)
    read = np.isfinite(call_window.y["constant"][:, 0])
    error = np.expm1(call_window.y["constant"][read, 0]) - call_window.queues["constant"][read]
    assert 0.3 < np.std(error) < 0.7
    np.testing.assert_array_equal(window(0).arrivals[168:], call_window.arrivals[:504])  # windows move by one week


def test_scores_are_those_of_the_log_normal_distribution():
    call_window = window()
    x = np.log1p(call_window.queues["constant"])
    estimate = tracking.QueueEstimate(x + 0.1, np.full(x.shape, 0.1), np.append(0, call_window.arrivals) + 0.2,
                                      np.full(x.shape, 0.05))
    mixture_scores = tracking.score_mixture([estimate], call_window, "constant")
    queue = call_window.queues["constant"][505:]
    assert mixture_scores["rmse"] == pytest.approx(np.sqrt(np.mean(((1 + queue) * (np.exp(0.1) - 1)) ** 2)))
    expected = stats.lognorm(0.1, scale=(1 + queue) * np.exp(0.1)).logpdf(1 + queue).sum()
    assert mixture_scores["ell"] == pytest.approx(expected)
    assert mixture_scores["coverage"] == 1.0 and mixture_scores["rate_coverage"] == 0.0
    assert mixture_scores["rate_rmse"] == pytest.approx(0.2)
    mixed = tracking.score_mixture([estimate, estimate], call_window, "constant")
    assert mixed.keys() == mixture_scores.keys()
    for key, value in mixed.items():
        assert value == pytest.approx(mixture_scores[key], rel=1e-9), key


@pytest.mark.slow
def test_nuts_and_weighted_draws_have_the_same_posterior():
    """Two samplers that share the density and the modes about which they start, on the fourth window, which has one."""
    settings = study.CallCentreSettings(days=4, methods=("SQM",), functions=5, draws=2_000, mixed=5, nuts_days=4,
                                             nuts=(2, 300, 700))
    task = [task for task in study.all_tasks(settings) if task.settings["what"] == "nuts"][3]
    method, (call_window,) = tracking.build_arrival_model(task), tracking.build_windows(task)
    draws, weights, mass = learning.sample_posterior(method, call_window.training, settings.draws, 0)
    assert len(mass) == 1 and weights.reliable
    mean, covariance = importance_at_modes.moments(draws, np.exp(weights.log_weight[0]))
    result = tracking.track_by_nuts(task)
    assert result["divergences"] == 0 and result["r_hat"].max() < 1.02
    error = np.sqrt(1 / result["ess"] + 1 / weights.ess)
    assert error.max() < 0.1
    assert (np.abs(result["mean"] - mean) < 4 * error * result["sd"]).all()
    np.testing.assert_allclose(result["sd"], np.sqrt(np.diag(covariance)), rtol=4 * error.max())
