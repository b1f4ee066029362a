"""The comparison on satellites: what it refuses, its tables, and a small run."""

from __future__ import annotations

import numpy as np
import pytest

from lfm_ppl import orbits
from lfm_ppl.orbits import magnitudes
from lfm_ppl.orbits.arc import Unusable
from lfm_ppl.studies.gps import figures, learning_methods, problem, study

TIMES = 0.25 * np.arange(960)


@pytest.fixture
def data(monkeypatch):
    """Positions as if they had been read from a folder."""
    names, positions = ("G01", "G02", "G04"), np.ones((960, 3, 3))
    positions[:384, -1] = np.nan  # the last satellite has no position on the first four days
    table = orbits.Ephemerides(orbits.gps_seconds(2019, 4, 7) + 3600 * TIMES, names, positions, 900.0)
    arcs = problem.Arcs(None, TIMES, {name: positions[:, k] for k, name in enumerate(names)}, table)
    monkeypatch.setattr(problem, "arcs", lambda folder, seed=0, include=(): arcs)
    return arcs


def learning_result(value=0.0, orbit=range(8)):
    """Result of a first task, all logarithms alike."""
    return {"orbit": np.array(orbit, float), "logarithms": np.full(len(magnitudes.names("DYB")), value), "cpu_s": 1.0}


@pytest.mark.thorough
def test_predictions_follow_learning_and_use_the_group_prior(data):
    settings = study.GpsSettings(data="folder", alternatives=2)
    first = study.learning_tasks(settings)
    assert [task.name for task in first] == ["learn/G01", "learn/G02", "learn/G04"]
    assert first[0].settings["train_days"] == 3.0 and first[0].settings["positions"] == first[1].settings["positions"]
    assert first[2].settings["positions"] is None  # it will be refused
    second = study.prediction_tasks(settings, {
        "learn/G01": learning_result(), "learn/G02": learning_result(), "learn/G04": {"refused": "G04: no positions"}})
    assert [task.name for task in second] == ["predict/G01", "predict/G02", "ways/G01", "ways/G02", "online/G01"]
    mean, sd = second[0].settings["prior"]
    assert (mean, sd) == tuple(values.tolist() for values in magnitudes.wide("DYB"))  # two do not say what is common
    assert np.allclose(second[-1].settings["windows"], [[5.0, 5.25], [7.0, 7.25]], atol=0.01)
    few = study.learning_tasks(study.GpsSettings(data="folder", satellites=("G02",), alternatives=0))
    assert [task.name for task in few] == ["learn/G02"]


def test_what_is_refused(data):
    for settings, name in (({"satellites": ("G99",)}, "'G99'"), ({"train_days": 12.0}, "12 days"),
                           ({"train_days": 0.2}, "half a day"), ({"satellites": ("G01", "G01")}, "once"),
                           ({"axes": "XYZ"}, "axes")):
        with pytest.raises(ValueError, match=name):
            study.learning_tasks(study.GpsSettings(data="folder", **settings))
    with pytest.raises(Unusable, match="G04"):
        data.arc("G04", 3.0)
    arc = data.arc("G01", 3.0)
    assert arc.train == 288 and np.isnan(arc.learnt()[288:]).all() and np.isfinite(arc.learnt()[:288]).all()
    task = study.learning_tasks(study.GpsSettings(data="folder", satellites=("G04",)))[0]
    assert "G04" in study.STUDY.kinds[study.STUDY.task_kind(task)].compute(task)["refused"]


def result(scale, eclipsed=False, complete=True):
    """A satellite whose deterministic error is `scale` metres in each direction, the other ones smaller."""
    error = np.full((960, 3), 1e-3 * scale)
    return {"times": TIMES, "train": 288, "residual": 1e-3, "solar": 100.0, "eclipsed": eclipsed, "complete": complete,
            "fitted": error, "latest": 0.5 * error, "lfm": 0.1 * error, "sd": error, "coverage": 0.9,
            "forces": np.zeros((960, 3)), "forces_sd": np.ones((960, 3)), "seen": np.zeros((960, 3)),
            "force_names": np.array(["solar", "panel", "remaining"]), "logarithms": np.zeros(21), "cpu_s": 1.0}


def test_tables(monkeypatch):
    predictions = {"G01": result(10.0), "G02": result(20.0, eclipsed=True), "G08": result(40.0, complete=False)}
    arcs = problem.Arcs(None, TIMES, {name: np.ones((960, 3)) for name in predictions}, None)
    monkeypatch.setattr(problem, "arcs", lambda folder, seed=0, include=(): arcs)
    settings = study.GpsSettings(alternatives=0)
    data = study.STUDY.collect(settings, {f"learn/{name}": learning_result() for name in predictions} | {
        f"predict/{name}": prediction for name, prediction in predictions.items()})
    assert "all" in figures.draw(settings, data)
    tables = study.tables(settings, data)
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


@pytest.mark.slow
def test_a_simulated_satellite_is_predicted_better_with_its_forces(tmp_path):
    """One satellite, all kinds of tasks; what is stored is not computed again."""
    pytest.importorskip("erfa", reason="needs the extra gps")
    settings = study.GpsSettings(satellites=(problem.SIMULATED[0],), alternatives=1)
    results = study.STUDY.run(settings, tmp_path)
    row = results.tables["satellites"].loc[problem.SIMULATED[0]]
    assert row["LFM"] < 0.3 * row["deterministic"] and 0.6 < row["coverage"] <= 1.0
    assert len(results.tables["learning"]) == len(learning_methods.METHODS)
    resumed = study.STUDY.run(settings, tmp_path)
    assert resumed.tables["satellites"].drop(columns="CPU s").equals(
        results.tables["satellites"].drop(columns="CPU s"))
    files = {path.name for path in study.STUDY.save(results, tmp_path)}
    assert files >= {"satellites.csv", "pooled.md", "all.png"}
