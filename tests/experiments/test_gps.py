"""The comparison on satellites: what it refuses, its tables, and a small run."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lfm_ppl import orbits
from lfm_ppl.experiments.gps import experiment, figures, learning_methods, problem
from lfm_ppl.experiments.study import StudyResult
from lfm_ppl.orbits import magnitudes, prediction
from lfm_ppl.orbits.arc import Unusable

TIMES = 0.25 * np.arange(960)


def published(names=("G01", "G02", "G04")):
    """Ten days on a circle; the last satellite has no position on the first four of them."""
    positions = np.ones((960, len(names), 3))
    positions[:384, -1] = np.nan
    return orbits.Ephemerides(orbits.gps_seconds(2019, 4, 7) + 3600 * TIMES, names, positions, 900.0)


@pytest.fixture
def data(monkeypatch):
    """Positions as if they had been read from a folder."""
    table = published()
    arcs = problem.Arcs(None, TIMES, {name: table.positions[:, k] for k, name in enumerate(table.satellites)}, table)
    monkeypatch.setattr(problem, "arcs", lambda folder, seed=0: arcs)
    return arcs


def learning_result(value=0.0, orbit=range(8)):
    """Result of a first task, all logarithms alike."""
    return {"orbit": np.array(orbit, float), "logarithms": np.full(len(magnitudes.names("DYB")), value), "cpu_s": 1.0}


def compute(task):
    return experiment.STUDY.kinds[experiment.STUDY.task_kind(task)].compute(task)


@pytest.fixture
def collect(monkeypatch):
    """From predictions of satellites, and results of other tasks by name, to the settings and the data of the study."""
    def collect(predictions, other_results=None):
        positions, other_results = {name: np.ones((960, 3)) for name in predictions}, other_results or {}
        monkeypatch.setattr(problem, "arcs", lambda folder, seed=0: problem.Arcs(None, TIMES, positions, None))
        settings = experiment.GpsSettings(alternatives=sum(name.startswith("ways/") for name in other_results))
        results = {f"learn/{name}": learning_result() for name in predictions}
        results |= {f"predict/{name}": prediction for name, prediction in predictions.items()}
        return settings, experiment.STUDY.collect(settings, results | other_results)

    return collect


def test_predictions_follow_learning_and_use_the_group_prior(data):
    settings = experiment.GpsSettings(data="folder", alternatives=2)
    first = experiment.learning_tasks(settings)
    assert [task.name for task in first] == ["learn/G01", "learn/G02", "learn/G04"]
    assert first[0].settings["train_days"] == 3.0 and first[0].settings["positions"] == first[1].settings["positions"]
    assert first[2].settings["positions"] is None  # it will be refused
    second = experiment.prediction_tasks(settings, {
        "learn/G01": learning_result(), "learn/G02": learning_result(), "learn/G04": {"refused": "G04: no positions"}})
    assert [task.name for task in second] == ["predict/G01", "predict/G02", "ways/G01", "ways/G02", "online/G01"]
    mean, sd = second[0].settings["prior"]
    assert (mean, sd) == tuple(values.tolist() for values in magnitudes.wide("DYB"))  # two do not say what is common
    assert np.allclose(second[-1].settings["windows"], [[5.0, 5.25], [7.0, 7.25]], atol=0.01)
    few = experiment.learning_tasks(experiment.GpsSettings(data="folder", satellites=("G02",), alternatives=0))
    assert [task.name for task in few] == ["learn/G02"]


def test_positions_determine_the_task(data):
    digest = experiment.learning_tasks(experiment.GpsSettings(data="folder"))[0].settings["positions"]
    data.positions["G01"][7, 1] += 1e-6
    assert experiment.learning_tasks(experiment.GpsSettings(data="folder"))[0].settings["positions"] != digest


def test_invalid_settings_are_refused(data):
    with pytest.raises(ValueError, match="unknown satellite 'G99'"):
        experiment.learning_tasks(experiment.GpsSettings(data="folder", satellites=("G99",)))
    with pytest.raises(ValueError, match=r"has 12 days, but the data have 10,.*use fewer \(--train-days\)"):
        experiment.learning_tasks(experiment.GpsSettings(data="folder", train_days=12.0))
    with pytest.raises(ValueError, match="at least half a day"):
        experiment.learning_tasks(experiment.GpsSettings(data="folder", train_days=0.2))
    with pytest.raises(ValueError, match="each of them once"):
        experiment.learning_tasks(experiment.GpsSettings(data="folder", satellites=("G01", "G01")))
    with pytest.raises(ValueError, match="axes"):
        experiment.GpsSettings(axes="XYZ")
    few = experiment.learning_tasks(experiment.GpsSettings.quick(data="folder"))
    assert [task.name for task in few] == ["learn/G01", "learn/G02"]
    with pytest.raises(ValueError, match="train_days"):
        experiment.GpsSettings(train_days=-1.0)


def test_a_satellite_without_positions_in_training_is_refused_with_the_reason(data):
    with pytest.raises(Unusable, match="G04: 0% of its positions in training.*2019-04-07 00:00:00 to"):
        data.arc("G04", 3.0)
    arc = data.arc("G01", 3.0)
    assert arc.train == 288 and np.isnan(arc.learnt()[288:]).all() and np.isfinite(arc.learnt()[:288]).all()
    task = experiment.learning_tasks(experiment.GpsSettings(data="folder", satellites=("G04",)))[0]
    assert "G04" in compute(task)["refused"]


def test_a_gap_at_the_end_of_training_refuses_one_satellite(data, monkeypatch):
    """Enough positions to be learnt from, too few of the latest ones; the other satellites are not lost."""
    data.positions["G01"][278:288] = np.nan
    data.positions["G01"][264:272] = np.nan
    for module in (orbits, prediction):
        monkeypatch.setattr(module, "fit_orbit", lambda around, times, positions, solar=None: orbits.Orbit(
            0.0, orbits.deterministic.polynomial_state(times, positions)[0], 100.0, 0.0))
    task = experiment.learning_tasks(experiment.GpsSettings(data="folder", satellites=("G01",)))[0]
    assert "G01: the start of an orbit needs 9 positions; there are 6" in str(
        compute(task)["refused"])


def test_only_refused_satellites_are_an_error(data, tmp_path):
    with pytest.raises(ValueError, match="no satellite can be predicted. G04: 0%"):
        experiment.STUDY.run(experiment.GpsSettings(data="folder", satellites=("G04",)), tmp_path)


def test_a_folder_without_files_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match=str(tmp_path)):
        problem.arcs(str(tmp_path))


def result(scale, eclipsed=False, complete=True):
    """A satellite whose deterministic error is `scale` metres in each direction, the other ones smaller."""
    error = np.full((960, 3), 1e-3 * scale)
    return {"times": TIMES, "train": 288, "residual": 1e-3, "solar": 100.0, "eclipsed": eclipsed, "complete": complete,
            "fitted": error, "latest": 0.5 * error, "lfm": 0.1 * error, "sd": error, "coverage": 0.9,
            "forces": np.zeros((960, 3)), "forces_sd": np.ones((960, 3)), "seen": np.zeros((960, 3)),
            "force_names": np.array(["solar", "panel", "remaining"]), "logarithms": np.zeros(21), "cpu_s": 1.0}


def test_tables(collect):
    settings, data = collect(
        {"G01": result(10.0), "G02": result(20.0, eclipsed=True), "G08": result(40.0, complete=False)})
    tables = experiment.tables(settings, data)
    assert list(tables) == ["pooled", "satellites", "magnitudes"]
    satellites = tables["satellites"].frame
    assert satellites.loc["G02", "deterministic"] == pytest.approx(20.0 * np.sqrt(3))
    assert satellites.loc["G02", "LFM radial"] == pytest.approx(2.0)
    assert satellites.loc["G02", "ratio"] == pytest.approx(0.1)
    assert (satellites["CPU s"] == 2.0).all()
    sizes = tables["magnitudes"].frame
    assert sizes.loc["amplitude of panel 2", "common"] == pytest.approx(0.05) and (sizes["G01"] == 1.0).all()
    pooled = tables["pooled"].frame
    assert list(pooled.index) == ["without gaps", "without gaps, never in shadow", "without gaps, in shadow",
                                  "with gaps"]
    row = pooled.loc["without gaps"]
    assert row["satellites"] == 2 and row["improved"] == 2
    assert row["deterministic"] == pytest.approx(np.sqrt(3 * (10.0**2 + 20.0**2) / 2))
    assert row["ratio"] == pytest.approx(0.1) and row["ratio, latest"] == pytest.approx(0.2)


def test_an_orbit_that_is_too_low_is_refused(data, monkeypatch):
    low = orbits.Orbit(0.0, np.array([7_000.0, 0.0, 0.0, 0.0, 27_000.0, 0.0]), 100.0, 1e-3)
    for module in (orbits, prediction):
        monkeypatch.setattr(module, "fit_orbit", lambda environment, times, positions, solar=None: low)
    task = experiment.learning_tasks(experiment.GpsSettings(data="folder", satellites=("G01",)))[0]
    assert "G01: its period is 1.6 h; positions and steps are too far apart" in str(compute(task)["refused"])


def test_each_constellation_has_separate_magnitudes_and_pooled_errors(collect):
    hours = {"G": 12, "E": 14}
    radius = {letter: (orbits.GM * (3600.0 * turn / (2 * np.pi)) ** 2) ** (1 / 3) for letter, turn in hours.items()}
    orbit = {letter: np.array([r, 0.0, 0.0, 0.0, 3600.0 * np.sqrt(orbits.GM / r), 0.0, 100.0, 1e-3])
             for letter, r in radius.items()}
    first = {f"learn/{letter}{number:02d}": learning_result(value, orbit[letter])
             for letter, value in (("G", 1.0), ("E", -1.0)) for number in range(1, 6)}
    settings, data = collect({name[6:]: result(10.0 if "G" in name else 20.0) for name in first}, first)
    prior = data["prior"]
    assert prior["mean"].dims == ("group", "magnitude")
    assert dict(zip(prior.group.values, prior["mean"].values[:, 0], strict=True)) == {
        "GPS 12 h": 1.0, "Galileo 14 h": -1.0}
    tables = experiment.tables(settings, data)
    assert tables["magnitudes"].frame["common, Galileo 14 h"].iloc[0] == pytest.approx(np.exp(-1.0))
    pooled = tables["pooled"].frame
    assert pooled["satellites"].to_dict() == {
        "without gaps": 10, "without gaps, never in shadow": 10,
        "GPS, without gaps": 5, "GPS, without gaps, never in shadow": 5,
        "Galileo, without gaps": 5, "Galileo, without gaps, never in shadow": 5}
    assert pooled.loc["Galileo, without gaps", "deterministic"] == pytest.approx(20.0 * np.sqrt(3))
    assert problem.system("C21") == "BeiDou" and problem.system("X01") == "X"
    assert {"all-GPS", "all-Galileo"} < set(figures.draw(settings, data))


def test_refused_satellites_are_left_out_with_reasons(collect):
    """Two satellites are refused, one of them after it was learnt; the third one's table is as if it were alone."""
    refused = {"learn/G01": {"refused": "G01: a gap"}, "predict/G02": {"refused": "G02: no curvature"}}
    settings, data = collect({name: result(10.0) for name in ("G01", "G02", "G03")}, refused)
    tables = experiment.tables(settings, data)
    assert list(tables["satellites"].frame.index) == ["G03"] and tables["pooled"].frame["satellites"].tolist() == [1, 1]
    assert tables["left out"].frame["reason"].to_dict() == {"G01": "G01: a gap", "G02": "G02: no curvature"}
    assert not tables["left out"].stored
    assert data["predict"].complete.dtype == bool and set(figures.draw(settings, data)) == {
        "all", "errors-G03", "forces-G03"}
    with pytest.raises(ValueError, match="no satellite can be predicted. G01: a gap G02: no curvature"):
        collect({name: result(10.0) for name in ("G01", "G02")}, refused)


def test_tables_are_written_with_their_text(collect, tmp_path):
    settings, data = collect({"G01": result(10.0), "G02": result(20.0, eclipsed=True)})
    plain = dataclasses.replace(experiment.STUDY, figures=lambda settings, data: {})
    plain.save(StudyResult(settings, {}, data, experiment.tables(settings, data)), tmp_path)
    assert "| yes " in (tmp_path / "satellites.md").read_text() and ",no," in (tmp_path / "satellites.csv").read_text()


def test_missing_positions_after_training_do_not_count(collect):
    satellite = result(10.0)
    satellite["lfm"][500] = np.nan
    assert experiment.satellite_table(collect({"G01": satellite})[1]).loc["G01", "LFM"] == pytest.approx(np.sqrt(3))


COMPARISON = {"error": 1e-3 * np.arange(1.0, 6.0), "coverage": np.full(5, 0.9), "logarithms": np.zeros((5, 21)),
              "cpu_s": 1.0}


def test_figures(collect):
    online = {"times": TIMES, "observed": TIMES < 72, "lfm": np.ones((960, 3)), "sd": np.ones((960, 3)),
              "restarted": np.full((960, 3), 2.0), "cpu_s": 1.0}
    all_figures = figures.draw(*collect({"G01": result(10.0), "G02": result(20.0, eclipsed=True)},
                                        {"ways/G01": COMPARISON, "online/G01": online}))
    assert set(all_figures) == {"all", "errors-G01", "forces-G01", "online-G01"}
    labels = {axes.get_ylabel() for figure in all_figures.values() for axes in figure.axes}
    assert {"error (m)", "error after training (m)", "solar (nm/s²)"} <= labels


def test_table_of_learning_methods(collect):
    settings, data = collect({"G01": result(10.0), "G02": result(10.0)}, {
        "ways/G01": COMPARISON, "ways/G02": COMPARISON, "online/G01": {"refused": "G01: a window without positions"}})
    table = experiment.tables(settings, data)["learning"].frame
    assert table.loc["marginal likelihood, mode", "error"] == pytest.approx(3.0)
    assert list(table.index) == list(learning_methods.METHODS) and table["satellites"].tolist() == [2] * 5


@pytest.mark.slow
def test_a_simulated_satellite_is_predicted_better_with_its_forces(tmp_path):
    """One satellite, all kinds of tasks; what is stored is not computed again."""
    pytest.importorskip("erfa", reason="needs the extra gps")
    settings = experiment.GpsSettings(satellites=(problem.SIMULATED[0],), alternatives=1)
    results = experiment.STUDY.run(settings, tmp_path)
    row = results.tables["satellites"].loc[problem.SIMULATED[0]]
    assert row["LFM"] < 0.3 * row["deterministic"] and 0.6 < row["coverage"] <= 1.0
    assert len(results.tables["learning"]) == len(learning_methods.METHODS)
    resumed = experiment.STUDY.run(settings, tmp_path)
    assert resumed.tables["satellites"].drop(columns="CPU s").equals(
        results.tables["satellites"].drop(columns="CPU s"))
    files = {path.name for path in experiment.STUDY.save(results, tmp_path)}
    assert files >= {"satellites.csv", "pooled.md", "all.png"}
