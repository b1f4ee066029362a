"""Many data sets, each fitted alone: the numbers of single fits, whatever fails and however often it is stopped."""

import functools
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import lfm_ppl as lfm
from lfm_ppl.cli import main
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.workflows import fit_tasks
from tests.inference import linear_motif as motif

ROOT = Path(__file__).resolve().parents[2]
TIMES = motif.TIMES
OPTIONS = {"sampler": "map", "samples": 20, "trajectory_draws": 4}


def data_sets(count=3):
    return {f"plant {k}": (TIMES, motif.data(k)) for k in range(count)}


def poisoned(count=3):
    result = data_sets(count)
    result["plant 1"] = (TIMES, np.full_like(result["plant 1"][1], np.inf))
    return result


def draws(result):
    return {name: np.asarray(value) for name, value in ResultView.of(result).posterior.items()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three fits, of which one failed, in a folder; and what was yielded."""
    out = tmp_path_factory.mktemp("many")
    fits = lfm.fit_many(motif.model, poisoned(), checkpoint=out, **OPTIONS)
    return out, fits, list(fits)


def test_each_result_is_that_of_a_fit(folder):
    _, fits, yielded = folder
    assert [outcome.name for outcome in yielded] == ["plant 0", "plant 1", "plant 2"] and len(fits) == 3
    single_fit = lfm.fit(motif.model, *data_sets()["plant 2"], seed=fit_tasks.seed_of("plant 2"), progress=False,
                         **OPTIONS)
    result = yielded[2].result
    assert tuple(ResultView.of(result).groups) == tuple(ResultView.of(single_fit).groups)
    for name in ResultView.of(single_fit).groups:
        expected_group, group = ResultView.of(single_fit).group(name), ResultView.of(result).group(name)
        assert expected_group.equals(group) and {k: v.attrs for k, v in expected_group.variables.items()} == {
            k: v.attrs for k, v in group.variables.items()}, name
    attrs, expected = ResultView.of(result).attrs, ResultView.of(single_fit).attrs
    assert json.loads(attrs.pop("warnings")) == json.loads(expected.pop("warnings")) == []
    for measured in ("wall_time_s", "created_at"):
        attrs.pop(measured), expected.pop(measured)
    assert attrs == expected


def test_a_data_set_that_fails_stops_no_other_and_is_named(folder):
    out, fits, yielded = folder
    assert yielded[1].result is None and isinstance(yielded[1].error, ValueError)
    assert list(fits.failed) == ["plant 1"] and "ValueError" in fits.failed["plant 1"]
    assert list(pd.read_csv(out / "failed.csv")["data set"]) == ["plant 1"]


def test_one_table_and_one_file_over_all(folder):
    out, fits, yielded = folder
    assert list(fits.summary.index.unique("data set")) == ["plant 0", "plant 2"]
    assert list(fits.summary.loc["plant 0"].index) == ["decay[a]", "decay[b]", "lengthscale", "noise_sd"]
    assert fits.overview.loc["noise_sd", "data sets"] == 2
    means = fits.summary["mean"].groupby(level="parameter", sort=False)
    np.testing.assert_allclose(fits.overview["mean"], means.mean())
    assert len(pd.read_csv(out / "summary.csv")) == 8
    posterior = ResultView.of(lfm.load(out / "posteriors.nc")).posterior
    assert posterior["decay"].dims == ("chain", "draw", "data_set", "output")
    for outcome in (yielded[0], yielded[2]):
        for name, values in draws(outcome.result).items():
            np.testing.assert_array_equal(posterior[name].sel(data_set=outcome.name), values)


@pytest.mark.thorough
def test_what_is_stored_is_not_fitted_again(folder, monkeypatch):
    out, _, yielded = folder
    fitted, call = [], fit_tasks.FitDataSet.__call__
    monkeypatch.setattr(fit_tasks.FitDataSet, "__call__", lambda fit, task: fitted.append(task.name) or call(fit, task))
    outcomes = list(lfm.fit_many(motif.model, data_sets(), checkpoint=out, **OPTIONS))
    assert [outcome.stored for outcome in outcomes] == [True, True, False]
    assert outcomes[2].name == "plant 1" and len(fitted) == 1
    for name, values in draws(yielded[2].result).items():
        np.testing.assert_array_equal(draws(outcomes[1].result)[name], values)
    assert not (out / "failed.csv").exists()


@pytest.mark.thorough
def test_progress_is_shown_unless_it_is_switched_off(folder, monkeypatch, capfd):
    monkeypatch.setattr(fit_tasks, "fit", functools.wraps(lfm.fit)(lambda *arguments, **options: folder[2][0].result))
    lines = []
    for options in ({}, {"report": lines.append}, {"progress": False}, {"report": lines.append, "progress": False}):
        lfm.fit_many(motif.model, data_sets(1), **options, **OPTIONS).run()
        captured = capfd.readouterr()
        assert captured.out == "" and ("1 of 1 tasks, plant_0" in captured.err) is (not options)
    assert len(lines) == 1


def wider_model(times, y=None):
    motif.model(times, y, spread=0.5)


@pytest.mark.thorough
@pytest.mark.parametrize("change, message", [
    ({"samples": 30}, "options is"), ({"seed": 1}, "seed is 0 there and 1 now"), ({"model": wider_model}, "model is"),
    ({"data": 1}, "data is")])
def test_results_of_something_else_are_refused(folder, change, message):
    model, sets = change.pop("model", motif.model), poisoned()
    if change.pop("data", 0):
        sets["plant 0"] = sets["plant 2"]
    with pytest.raises(ValueError, match=f"other settings: {message}"):
        lfm.fit_many(model, sets, checkpoint=folder[0], **{**OPTIONS, **change}).run()


@pytest.mark.thorough
def test_data_and_arguments_of_one_data_set():
    pairs = [("a", lfm.Data(TIMES, motif.data(0), ("a", "b"), truth={"parameters": {"noise_sd": 0.2}})),
             ("b", data_sets()["plant 1"])]
    fits = lfm.fit_many(motif.model, pairs, each={"b": {"samples": 10}}, **OPTIONS).run()
    noise = ResultView.of(fits.combined()).posterior["noise_sd"].sel(chain=0)
    assert np.isfinite(noise.sel(data_set="a")).all()
    np.testing.assert_array_equal(np.isfinite(noise.sel(data_set="b")), np.arange(20) < 10)
    assert ResultView.of(fits.combined()).group("truth").sizes["data_set"] == 1


@pytest.mark.parametrize("sets, options, message", [
    ({}, {}, "data_sets is empty"),
    ([("a", (TIMES, None)), ("a", (TIMES, None))], {}, "two data sets are called 'a'"),
    ([(3, (TIMES, None))], {}, "must be texts, got 3"),
    ({"a": 3.0}, {}, "must be \\(times, y\\) or lfm.Data, got float"),
    ({"a": (TIMES, None)}, {"smaples": 3}, "unknown argument of fit 'smaples'. Did you mean 'samples'"),
    ({"a": (TIMES, None)}, {"each": {"b": {}}}, "unknown data set in each 'b'"),
    ({"a": (TIMES, None)}, {"workers": "here"}, "tcp://host"),
])
def test_bad_arguments(sets, options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        lfm.fit_many(motif.model, sets, **options)


def test_names_become_files_that_differ():
    names = ["a/b", "a b", "a_b", "ä", "..", "x" * 200, "x" * 201]
    files = [fit_tasks.file_name(name) for name in names]
    assert len(set(files)) == len(files) and files[2] == "a_b" and max(map(len, files)) < 100


@pytest.mark.slow
def test_several_processes_find_the_same_numbers(tmp_path):
    alone = {outcome.name: draws(outcome.result) for outcome in lfm.fit_many(motif.model, data_sets(4), **OPTIONS)}
    for outcome in lfm.fit_many(motif.model, data_sets(4), workers=2, checkpoint=tmp_path, **OPTIONS):
        for name, values in draws(outcome.result).items():
            np.testing.assert_allclose(values, alone[outcome.name][name], rtol=1e-12)


# On the command line

MODEL = '''"""The motif of the tests."""
from tests.inference.linear_motif import model as motif
def model(times, y=None):
    motif(times, y)
'''


@pytest.fixture
def line(tmp_path, monkeypatch, capsys, folder):
    """Run the command in an empty folder, where a fit takes no time; return (exit code, output, errors)."""
    _, _, (outcome, *_) = folder
    monkeypatch.setattr(fit_tasks, "fit", functools.wraps(lfm.fit)(lambda *arguments, **named: outcome.result))
    return command(tmp_path, monkeypatch, capsys)


def command(tmp_path, monkeypatch, capsys, jobs=1):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "motif.py").write_text(MODEL)

    def run(text):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            code = main(["fit", "motif.py", "--sampler", "map", "--samples", "20", "--jobs", str(jobs), *text.split()])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def csv(path, rows, header="time,a,b"):
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join([header, *(",".join("" if value != value else str(value) for value in row)
                                         for row in rows)]) + "\n")


def rows(seed):
    return np.column_stack([TIMES, motif.data(seed)])


@pytest.mark.thorough
def test_each_of_many_files_and_one_that_cannot_be_read(line, tmp_path):
    for k in range(2):
        csv(tmp_path / "patients" / f"{k}.csv", rows(k))
    csv(tmp_path / "patients" / "bad.csv", [(0, 1, 2), (1, "oops", 2)])
    code, out, err = line("--data patients/*.csv --each --out many")
    assert code == 1 and "3 data sets" in out and "noise_sd" in out and "1 of 2 tasks, 0" in err
    assert "failed: bad: patients/bad.csv, row 3" in err and "'oops'" in err and "1 of 3 data sets" in err
    assert list(pd.read_csv(tmp_path / "many" / "failed.csv")["data set"]) == ["bad"]
    written = tmp_path / "many" / "results"
    assert sorted(path.relative_to(written).as_posix() for path in written.rglob("*.*")) == sorted(
        f"{k}/{name}" for k in range(2) for name in ("posterior.nc", "report.html", "summary.csv"))
    attrs = lfm.load(written / "1").attrs
    assert attrs["model_file"] == str(tmp_path / "motif.py") and attrs["data"] == "patients/*.csv"
    modification_time = (written / "0" / "posterior.nc").stat().st_mtime_ns
    csv(tmp_path / "patients" / "bad.csv", rows(5))
    code, out, err = line("--data patients/*.csv --each --out many")
    assert code == 0 and "2 of 3 tasks are stored already" in err
    assert (written / "0" / "posterior.nc").stat().st_mtime_ns == modification_time
    assert (written / "bad" / "report.html").is_file()


@pytest.mark.slow
def test_a_result_of_many_is_checked_forecast_and_drawn(tmp_path, monkeypatch, capsys):
    csv(tmp_path / "patients" / "0.csv", rows(0))
    code, out, _ = command(tmp_path, monkeypatch, capsys)("--data patients/*.csv --each --out many")
    assert code == 0 and "lfm-ppl plot RESULT" in out
    for words in ("check many/results/0 --draws 10", f"forecast many/results/0 --until {TIMES[-1] + 2}",
                  "plot many/results/0 --overwrite"):
        assert main(words.split()) == 0, capsys.readouterr().err
    assert {"accuracy.csv", "forecast.csv", "forecast.png", "fit.png"} <= {
        path.name for path in (tmp_path / "many" / "results" / "0").iterdir()}


@pytest.mark.slow
def test_several_processes_get_a_model_file(tmp_path, monkeypatch, capsys):
    """The same numbers as one process, and a run in another process goes on from it."""
    monkeypatch.syspath_prepend(ROOT)
    for k in range(3):
        csv(tmp_path / "patients" / f"{k}.csv", rows(k))
    for jobs in (1, 2):
        code, _, _ = command(tmp_path, monkeypatch, capsys, jobs)(f"--data patients/*.csv --each --out jobs-{jobs}")
        assert code == 0
    serial, parallel = (pd.read_csv(tmp_path / f"jobs-{jobs}" / "summary.csv") for jobs in (1, 2))
    pd.testing.assert_frame_equal(serial, parallel, rtol=1e-12)
    result = subprocess.run(
        [
            sys.executable,
            "-m",
            "lfm_ppl",
            *"fit motif.py --sampler map --samples 20 --jobs 1 --data patients/*.csv --each --out jobs-2".split(),
        ],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}"},
    )
    assert result.returncode == 0 and "3 of 3 tasks are stored already" in result.stderr, result.stderr


def test_series_in_one_file(line, tmp_path):
    table_rows = [(*row, name) for name, seed in (("P7", 0), ("P2", 1)) for row in rows(seed)]
    csv(tmp_path / "all" / "all.csv", table_rows, "time,a,b,who")
    code, _, _ = line("--data all/all.csv --series who --out many")
    assert code == 0 and list(pd.read_csv(tmp_path / "many" / "summary.csv")["data set"].unique()) == ["P7", "P2"]


@pytest.mark.parametrize("text, message", [
    ("--data none/*.csv --each", "no file matches --data 'none/*.csv'"),
    ("--data some --each", "some is a folder; its files are 'some/*.csv'"),
    ("--data some/*.csv --each", "has the columns a, c, but 1 has a, b. Name those to use with --outputs"),
    ("--data some/1.csv --series who", "unknown column of series 'who'"),
    ("--each", "a pattern of files"),
    ("--data some/1.csv", "--jobs and --scheduler are for many data sets"),
    ("--data some/1.csv --each --scheduler tcp://a:1", "Give one of --jobs and --scheduler"),
    ("--data some/1.csv --each --truth x", "--truth is for one data set"),
])
def test_bad_command_lines_are_one_line(line, tmp_path, text, message):
    csv(tmp_path / "some" / "1.csv", rows(0))
    csv(tmp_path / "some" / "2.csv", rows(0), "time,a,c")
    code, _, err = line(text)
    assert code == 2 and message in err and len(err.splitlines()) == 1
