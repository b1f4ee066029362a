"""Call centre study: counts, queues, scores, tables and figures."""

import dataclasses
import os
import sys
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import integrate, stats

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.call_centre import counts, experiment, figures, problem, tracking
from lfm_ppl.experiments.study import TASKS
from lfm_ppl.utils.run_store import RunStore

DATA = Path(os.environ.get("LFM_DATA", "../shared/data")) / "calls"
real = pytest.mark.skipif(not DATA.is_dir(), reason="the counts of real calls are not there (LFM_DATA)")


def window(index=0, data=None):
    return problem.build_window(data, "Thursday", index)


def tasks_of(kind, settings):
    return [task for task in experiment.all_tasks(settings) if task.settings["what"] == kind]


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
    assert len(days.select_weekday("Friday").dates) == 0


def set_cell(row, column, value):
    def change(table):
        table.loc[row, column] = value
        return table

    return change


@pytest.mark.parametrize(("change", "message"), [
    (lambda table: table.rename(columns={"Calls": "n"}), "no column 'Calls'; its columns are"),
    (set_cell(3, "Calls", "-2"), "row 5, column 'Calls': expected a number of calls, zero or more, got '-2'"),
    (set_cell(3, "Calls", "many"), "row 5, column 'Calls'.*'many'"),
    (set_cell(7, "DateTime", "noon"), "row 9, column 'DateTime': expected a time.*'noon'"),
    (set_cell(7, "DateTime", "2003-03-05T07:00:00Z"), "row 9.*a later time than before"),
    (lambda table: table.drop(index=20), "2003-03-06 has 167"),
])
def test_invalid_counts(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        counts.read(write_counts(tmp_path / "calls.csv", change))
    with pytest.raises(FileNotFoundError, match="there is no file"):
        counts.read(tmp_path / "none")


def test_the_queue_solves_its_equation():
    """Against an adaptive method of order eight, five minutes at a time, through an overload."""
    arrivals = np.random.default_rng(0).uniform(2.0, 14.0, 60)
    service = np.repeat([15.0, 5.0, 4.0], 20)
    with pytest.warns(counts.OverloadWarning, match="more customers come than are served for"):
        path = counts.queue(arrivals, service)
    expected = [0.0]
    for zeta, omega in zip(arrivals, service, strict=True):
        solution = integrate.solve_ivp(lambda t, x: zeta - omega * x / (1 + x), (0, 5), expected[-1:],  # noqa: B023
                                       method="DOP853", rtol=1e-11, atol=1e-12)
        expected.append(solution.y[0, -1])
    np.testing.assert_allclose(path, expected, rtol=1e-7, atol=2e-6)


def test_rates_must_not_be_negative():
    with pytest.raises(ValueError, match="the service rate must not be negative, got -1"):
        counts.queue(np.ones(3), -1.0)
    with pytest.raises(ValueError, match="arrivals must not be negative"):
        counts.queue(-np.ones(3), 1.0)


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


@real
def test_the_bound_on_settling_matters_little():
    """Real queues with the bounded rate of the model, against the equation itself: below the error of readings."""
    fastest = sys.modules[problem.model_file().model.__module__].FASTEST
    for index in (0, 10):
        call_window = window(index, str(DATA))
        for name, tested in problem.TEST_RATES.items():
            x, path, h = 0.0, [0.0], 0.25
            for zeta, omega in zip(call_window.arrivals, problem.service_rates(tested), strict=True):
                for _ in range(20):
                    def slope(x, zeta=zeta, omega=omega):
                        free = np.exp(-x)
                        return (zeta - omega * (1 - free)) * free / (1 + fastest * omega * free**2)

                    k1 = slope(x)
                    k2 = slope(x + 0.5 * h * k1)
                    k3 = slope(x + 0.5 * h * k2)
                    x += h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3))
                path.append(x)
            off = np.abs(np.expm1(path) - call_window.queues[name])[2:]
            # Most of all where arrivals jump from one count to the next.
            share = off / (1.0 + call_window.queues[name][2:])
            assert np.median(share) < 0.007 and np.max(share) < 0.14
            assert name == "changed" or np.sqrt(np.mean(off**2)) < 0.4 * problem.NOISE


def synthetic_results(settings):
    """Results of every task: bands that hold all, and errors that follow from the method."""
    call_window, results = window(), {}
    test = slice(problem.TEST_START + 1, None)
    for task in experiment.all_tasks(settings):
        method = task.settings["method"]
        names = tracking.build_arrival_model(task).names
        worse = {"SQM": 1.0, "Matern": 3.0}.get(method, 2.0) * (0.9 if task.settings["what"] == "posterior" else 1.0)
        result = {}
        if task.settings["what"] == "nuts":
            results[task.name] = {f"{name}_ell": -70.0 for name in problem.TEST_RATES} | {
                "mean": np.full(len(names), 0.1), "sd": np.full(len(names), 0.8), "ess": np.full(len(names), 150.0),
                "r_hat": np.full(len(names), 1.004), "divergences": 0, "seconds": 60.0}
            continue
        for name in problem.TEST_RATES:
            rmse = worse * (1.0 + 0.1 * np.arange(settings.days))
            result |= {f"{name}_rmse": rmse, f"{name}_ell": -100.0 * rmse, f"{name}_rate_rmse": 0.1 * rmse,
                       f"{name}_coverage": np.full(settings.days, 0.94),
                       f"{name}_rate_coverage": np.full(settings.days, 0.9)}
            if task.settings["what"] == "track":
                x = np.log1p(call_window.queues[name])
                result |= {f"{name}_log_queue": x, f"{name}_log_queue_sd": np.full(x.shape, 0.2),
                           f"{name}_arrivals": np.append(0, call_window.arrivals),
                           f"{name}_arrivals_sd": np.ones(x.shape)}
        if task.settings["what"] == "track":
            result |= {"z": np.zeros((settings.days, len(names))), "log_likelihood": np.full(settings.days, -50.0),
                       "evaluations": np.full(settings.days, 40), "seconds": np.full(settings.days, 2.0)}
        else:
            result |= {"k": np.full(settings.days, 0.3), "ess": np.full(settings.days, 90.0),
                       "modes": np.arange(1, settings.days + 1), "beyond": 0.2 * np.arange(settings.days),
                       "posterior_mean": np.zeros((settings.days, len(names))),
                       "posterior_sd": np.ones((settings.days, len(names))),
                       "shapes": np.append(0, call_window.arrivals),
                       "shapes_sd": np.ones(call_window.queues["constant"].shape)}
        results[task.name] = result
    assert test.start == 505
    return results


SYNTHETIC = experiment.CallCentreSettings(days=3, methods=("SQM", "periodic", "Matern"), integrated=("SQM",),
                                          nuts_days=2)


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


def synthetic_data(settings):
    return experiment.STUDY.collect(settings, synthetic_results(settings))


def test_tables_summarize_results():
    tables = {name: table.frame for name, table in experiment.tables(SYNTHETIC, synthetic_data(SYNTHETIC)).items()}
    table = tables["constant"]
    assert list(table.index) == ["SQM", "periodic", "Matern", "SQM, parameters integrated out"]
    assert table.loc["SQM", "RMSE"] == pytest.approx(1.1) and table.loc["SQM", "of Matern"] == pytest.approx(1 / 3)
    assert table.loc["Matern", "published RMSE"] == 10.6 and table.loc["SQM", "published ELL"] == -146
    assert tables["changed"].loc["periodic", "published RMSE"] == 5.7
    gain = tables["gain"]
    assert gain.loc["SQM, changed", "gain"] == pytest.approx(11.0) and gain.loc["SQM, constant", "days"] == 1.0
    assert gain.loc["SQM, constant", "RMSE ratio"] == pytest.approx(0.9)
    assert gain.loc["SQM, changed", ["several modes", "beyond"]].tolist() == pytest.approx([2 / 3, 0.4])
    agreement = tables["agreement"].loc["SQM"]
    assert agreement["windows"] == 2 and agreement["means apart (sd)"] == pytest.approx(0.125)
    assert agreement["ratio of sds"] == pytest.approx(1.25)
    assert agreement["gain constant, NUTS"] == pytest.approx(35.0)  # of -100 and -110
    assert agreement["gain constant, weighted"] == pytest.approx(10.5)
    learnt = tables["learnt"]
    assert learnt.loc["SQM", "memory"] == 1.0 and np.isnan(learnt.loc["Matern", "memory"])


def test_figures():
    all_figures = figures.draw(SYNTHETIC, synthetic_data(SYNTHETIC))
    assert list(all_figures) == ["queue-constant", "queue-changed", "arrivals", "cycles", "errors"]


@pytest.mark.slow
def test_stored_results_are_tabulated_without_computing(tmp_path):
    results = synthetic_results(SYNTHETIC)
    for task in experiment.all_tasks(SYNTHETIC):
        RunStore(tmp_path / TASKS).put(task.stem, results[task.name], task.record())
    lines = []
    with pytest.warns(counts.OverloadWarning, match="changed service rate: on 3 of 3 test days"):
        study_result = experiment.STUDY.run(SYNTHETIC, tmp_path, report=lines.append)
    assert lines[0].startswith("the counts are simulated") and lines[1] == "6 of 6 tasks are stored already"
    files = experiment.STUDY.save(study_result, tmp_path)
    assert {path.name for path in files} == {
        f"{stem}.{end}" for stem in ("constant", "changed", "gain", "agreement", "learnt") for end in ("csv", "md")} | {
        "queue-constant.png", "queue-changed.png", "arrivals.png", "cycles.png", "errors.png"}
    assert scores.readable(study_result.tables["constant"]).loc["SQM", "published RMSE"] == "4.6 (2.2)"
    with pytest.raises(ValueError, match="seed is 0 there and 1 now"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        experiment.STUDY.run(dataclasses.replace(SYNTHETIC, seed=1), tmp_path)


def test_invalid_settings(tmp_path):
    with pytest.raises(ValueError, match="integrated"):
        experiment.CallCentreSettings(integrated=("CQM",), methods=("SQM",))
    with pytest.raises(ValueError, match="there are 31 test days on a Thursday, but 40 are requested"):
        experiment.STUDY.run(experiment.CallCentreSettings(days=40), tmp_path)
    with pytest.raises(FileNotFoundError, match="there is no file"):
        experiment.STUDY.run(experiment.CallCentreSettings(data=str(tmp_path)), tmp_path)


@pytest.mark.slow
def test_quick_version(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", counts.OverloadWarning)
        study_result = experiment.STUDY.run(experiment.CallCentreSettings.quick(days=1), tmp_path)
    written = experiment.STUDY.save(study_result, tmp_path)
    assert len(written) == 15 and all(path.stat().st_size > 0 for path in written)
    assert len(study_result.printed) == 5
