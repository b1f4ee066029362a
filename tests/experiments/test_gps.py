"""The comparison on satellites: what it refuses, its tables, and a small run."""

from __future__ import annotations

import numpy as np
import pytest

from lfm_ppl import orbits
from lfm_ppl.experiments import output
from lfm_ppl.experiments.catalogue import Wanted
from lfm_ppl.experiments.gps import experiment, figures, learning, prediction, problem, report

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
    found = problem.Arcs(None, TIMES, {name: table.positions[:, k] for k, name in enumerate(table.satellites)}, table)
    monkeypatch.setattr(problem, "arcs", lambda folder, seed=0: found)
    return found


def test_one_task_a_satellite_and_the_alternatives_of_the_first(data):
    names = [task.name for task in experiment.plan(experiment.Settings(data="folder", alternatives=2))]
    assert names == ["predict/G01", "predict/G02", "predict/G04", "learn/G01", "learn/G02", "online/G01"]
    few = experiment.plan(experiment.Settings(data="folder", satellites=("G02",), alternatives=0))
    assert [task.name for task in few] == ["predict/G02"]
    assert few[0].settings["train_days"] == 3.0 and len(few[0].settings["candidates"]) == len(problem.CANDIDATES)


def test_what_is_asked_must_be_there(data):
    with pytest.raises(ValueError, match="unknown satellite 'G99'"):
        experiment.plan(experiment.Settings(data="folder", satellites=("G99",)))
    with pytest.raises(ValueError, match=r"training takes 12 days, but the data have 10,.*take fewer \(--train-days\)"):
        experiment.plan(experiment.Settings(data="folder", train_days=12.0))
    with pytest.raises(ValueError, match="half a day is the least"):
        experiment.plan(experiment.Settings(data="folder", train_days=0.2))
    with pytest.raises(ValueError, match="each of them once"):
        experiment.plan(experiment.Settings(data="folder", satellites=("G01", "G01")))
    with pytest.raises(ValueError, match="axes"):
        experiment.Settings(axes="XYZ")
    few = experiment.plan(experiment.quick(data="folder"))
    assert [task.name for task in few] == ["predict/G01", "predict/G02", "learn/G01", "online/G01"]
    with pytest.raises(ValueError, match="train_days"):
        experiment.Settings(train_days=-1.0)
    with pytest.raises(ValueError, match="does not take --realisations"):
        report.run(Wanted("nowhere", realisations=5))


def test_a_satellite_without_positions_in_training_is_refused_with_the_reason(data):
    with pytest.raises(prediction.Unusable, match="G04: 0% of its positions in training.*2019-04-07 00:00:00 to"):
        prediction.arc(data, "G04", 3.0)
    one = prediction.arc(data, "G01", 3.0)
    assert one.train == 288 and np.isnan(one.learnt()[288:]).all() and np.isfinite(one.learnt()[:288]).all()
    task = experiment.plan(experiment.Settings(data="folder", satellites=("G04",)))[0]
    assert "G04" in experiment.compute(task)["refused"]


def test_only_refused_satellites_are_an_error(data, tmp_path):
    with pytest.raises(ValueError, match="no satellite can be predicted. G04: 0%"):
        experiment.run(experiment.Settings(data="folder", satellites=("G04",)), tmp_path)


def test_a_folder_without_files_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match=str(tmp_path)):
        problem.arcs(str(tmp_path))


def result(scale, eclipsed=False, complete=True):
    """A satellite whose deterministic error is `scale` metres in each direction, the other ones smaller."""
    error = np.full((960, 3), 1e-3 * scale)
    return {"times": TIMES, "train": 288, "residual": 1e-3, "solar": 100.0, "eclipsed": eclipsed, "complete": complete,
            "fitted": error, "latest": 0.5 * error, "lfm": 0.1 * error, "sd": error, "coverage": 0.9,
            "forces": np.zeros((960, 3)), "forces_sd": np.ones((960, 3)), "seen": np.zeros((960, 3)),
            "force_names": np.array(["solar", "panel", "remaining"]), "scores": np.zeros(24),
            "held_out": np.full(24, 1e-3), "candidate": 3, "log_likelihood": 0.0, "cpu_s": 1.0}


def test_tables():
    results = {"G01": result(10.0), "G02": result(20.0, eclipsed=True), "G08": result(40.0, complete=False)}
    each = experiment.satellites(results)
    assert each.loc["G02", "deterministic"] == pytest.approx(20.0 * np.sqrt(3))
    assert each.loc["G02", "LFM radial"] == pytest.approx(2.0) and each.loc["G02", "ratio"] == pytest.approx(0.1)
    assert each.loc["G01", "amplitude"] == problem.CANDIDATES[3].amplitude
    together = experiment.pooled(results)
    assert list(together.index) == ["without gaps", "without gaps, never in shadow", "without gaps, in shadow",
                                    "with gaps"]
    row = together.loc["without gaps"]
    assert row["satellites"] == 2 and row["improved"] == 2
    assert row["deterministic"] == pytest.approx(np.sqrt(3 * (10.0**2 + 20.0**2) / 2))
    assert row["ratio"] == pytest.approx(0.1) and row["ratio, latest"] == pytest.approx(0.2)


def test_tables_are_written_with_their_text(tmp_path):
    each = experiment.satellites({"G01": result(10.0), "G02": result(20.0, eclipsed=True)})
    output.save(tmp_path, {"satellites": each}, {}, "")
    assert "| yes " in (tmp_path / "satellites.md").read_text() and ",no," in (tmp_path / "satellites.csv").read_text()


def test_missing_positions_after_training_do_not_count():
    one = result(10.0)
    one["lfm"][500] = np.nan
    assert experiment.satellites({"G01": one}).loc["G01", "LFM"] == pytest.approx(np.sqrt(3))


def test_figures():
    results = {"G01": result(10.0), "G02": result(20.0, eclipsed=True)}
    online = {"times": TIMES, "observed": TIMES < 72, "lfm": np.ones((960, 3)), "sd": np.ones((960, 3)),
              "restarted": np.full((960, 3), 2.0)}
    drawn = figures.draw(results, {"G01": online})
    assert set(drawn) == {"all", "errors-G01", "forces-G01", "online-G01"}
    labels = {axes.get_ylabel() for figure in drawn.values() for axes in figure.axes}
    assert {"error (m)", "error after training (m)", "solar (nm/s²)"} <= labels


def test_table_of_the_ways_to_learn():
    ways = {"error": 1e-3 * np.array([1.0, 4.0, 3.0, 2.0]), "coverage": np.full(4, 0.9)}
    table = learning.table({"G01": ways, "G02": ways})
    assert table.loc["marginal likelihood", "error"] == pytest.approx(4.0) and list(table.index) == list(learning.WAYS)
    assert learning.table({}).empty


@pytest.mark.slow
def test_a_simulated_satellite_is_predicted_better_with_its_forces(tmp_path):
    """One satellite, all kinds of tasks; what is stored is not computed again."""
    pytest.importorskip("erfa", reason="needs the extra gps")
    settings = experiment.Settings(satellites=(problem.SIMULATED[0],), alternatives=1)
    found = experiment.run(settings, tmp_path)
    row = found.satellites.loc[problem.SIMULATED[0]]
    assert row["LFM"] < 0.3 * row["deterministic"] and 0.6 < row["coverage"] <= 1.0
    assert len(found.learning) == 4
    again = experiment.run(settings, tmp_path)
    assert again.satellites.drop(columns="CPU s").equals(found.satellites.drop(columns="CPU s"))
    assert {path.name for path in experiment.save(found, tmp_path)} >= {"satellites.csv", "pooled.md", "all.png"}
