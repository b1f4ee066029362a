"""``lfm-ppl check``: from a results folder to the report, and to the corrected result."""

import numpy as np
import pandas as pd
import pytest

from lfm_ppl.accuracy.report import AccuracyReport
from lfm_ppl.results import arviz_data
from lfm_ppl.results.result_view import ResultView


def test_check_prints_stores_and_draws(run, fitted):
    unchecked_result = arviz_data.load(fitted)
    status, out, err = run(f"check {fitted} --draws 40")
    assert status == 0, err
    for words in ("grid", "Pareto k", "depth", "verdict"):
        assert words in out
    for name in ("posterior.nc (group accuracy)", "accuracy.csv", "accuracy.png", "report.html"):
        assert f"wrote    {fitted / name}" in out
    assert f"lfm-ppl check {fitted} --draws 40</pre>" in (fitted / "report.html").read_text()
    checked_result = arviz_data.load(fitted)
    assert set(ResultView.of(checked_result).groups) == {*ResultView.of(unchecked_result).groups, "accuracy"}
    for name in ResultView.of(unchecked_result).groups:
        group = ResultView.of(unchecked_result).group(name)
        assert ResultView.of(checked_result).group(name).identical(group), "nothing is lost"
    report = AccuracyReport.of(checked_result)
    assert report.log_ratio.shape == (2, 20)
    table = pd.read_csv(fitted / "accuracy.csv", index_col="parameter")
    np.testing.assert_allclose(table.loc["depth", "shift"], report.table.loc["depth", "shift"])
    status, _, err = run(f"check {fitted} --draws 40")
    assert status == 2 and "accuracy.csv already exists" in err
    status, out, _ = run(f"plot {fitted} --overwrite")
    assert status == 0 and "accuracy.png" in out


@pytest.mark.slow
def test_new_chains_follow_a_check_that_requires_them(run, well, fitted, monkeypatch):
    assert run(f"check {fitted} --draws 40 --quiet")[0] == 0
    result = arviz_data.load(fitted)
    accuracy = ResultView.of(result).group("accuracy")
    report = accuracy.assign_attrs(pareto_k=0.9, command="lfm-ppl check RESULT --correct")
    arviz_data.save(arviz_data.add_group(result, "accuracy", report), fitted / "posterior.nc", overwrite=True)
    reports = []
    monkeypatch.setattr("lfm_ppl.cli.check._correct", lambda *arguments: reports.append(arguments[2]) or 0)
    monkeypatch.setattr("lfm_ppl.cli.check.check_accuracy", lambda *arguments, **keywords: pytest.fail("checked again"))
    status, out, err = run(f"check {fitted} --correct")
    assert status == 0 and reports[0].k == 0.9, err
    changed = fitted.parent / "changed.py"
    with open(well) as file:
        changed.write_text(file.read().replace("depth * (x - x**3)", "depth * (x - 1.1 * x**3)"))
    status, _, err = run(f"check {fitted} --correct --model {changed} --overwrite")
    assert status == 2 and "log likelihoods" in err


@pytest.mark.slow
def test_correct_writes_a_result_of_its_own(run, fitted):
    (fitted / "corrected").mkdir()
    (fitted / "corrected" / "mine.txt").write_text("keep")
    status, _, err = run(f"check {fitted} --correct")
    assert status == 2 and "holds files" in err
    status, out, err = run(f"check {fitted} --correct --out {fitted / 'better'}")
    assert status == 0, err
    report = AccuracyReport.of(arviz_data.load(fitted))
    corrected = arviz_data.load(fitted / "better")
    attributes = ResultView.of(corrected).attrs
    assert attributes["sampler"] == ("ram + importance resampling" if report.reliable else "pmmh")
    assert ResultView.of(corrected).posterior["depth"].shape == (2, 100)
    assert "truth" in ResultView.of(corrected).groups and (fitted / "better" / "report.html").is_file()
    status, _, err = run(f"check {fitted / 'better'}")
    assert status == 2 and "exact posterior already" in err


@pytest.mark.slow
@pytest.mark.parametrize("flag", ["", "--delayed"])
def test_exact_chains_where_the_weights_are_not_reliable(run, fitted, monkeypatch, flag):
    monkeypatch.setattr(AccuracyReport, "reliable", False)
    status, out, err = run(f"check {fitted} --draws 20 --correct --particles 100 --reference particles {flag}")
    assert status == 0, err
    corrected = arviz_data.load(fitted / "corrected")
    attributes = ResultView.of(corrected).attrs
    assert (attributes["sampler"], attributes["particles"], attributes["steps"]) == ("pmmh", 100, 12)
    assert attributes["delayed"] == bool(flag) and attributes["options"] == '{"noise": 0.25}'
    assert ResultView.of(corrected).posterior["depth"].shape == (2, 100)


@pytest.mark.parametrize(("line", "words"), [
    ("check absent", "absent"), ("check RESULT --reference exact", "--reference"),
    ("check RESULT --draws 0", "--draws"), ("check RESULT --out there", "--correct"),
    ("check RESULT --delayed", "--correct"),
    ("check RESULT --model nothing.py", "nothing.py"), ("check RESULT --model ginzburg-landau", "'noise'"),
    ("check RESULT --resume --overwrite", "--overwrite"), ("check RESULT --model other.py", "outputs x"),
])
def test_mistakes_are_one_line(run, well, fitted, tmp_path, line, words):
    with open(well) as file:
        (tmp_path / "other.py").write_text(file.read().replace('OUTPUTS = ("x",)', 'OUTPUTS = ("z",)'))
    initial_files = sorted(path.name for path in fitted.iterdir())
    status, _, err = run(line.replace("RESULT", str(fitted)))
    assert status == 2 and err.startswith("lfm-ppl: error: ") and err.count("\n") == 1 and words in err, err
    assert sorted(path.name for path in fitted.iterdir()) == initial_files


def test_a_result_without_its_model_file(run, fitted):
    result = arviz_data.load(fitted)
    attributes = {name: value for name, value in ResultView.of(result).attrs.items() if name != "model_file"}
    groups = {name: ResultView.of(result).group(name) for name in ResultView.of(result).groups}
    arviz_data.save(arviz_data.build(groups, attributes), fitted / "posterior.nc", overwrite=True)
    status, _, err = run(f"check {fitted}")
    assert status == 2 and "--model FILE" in err
