"""What every study owes: named tasks of its kinds, tables and figures of a small run, and a published number."""

import warnings

import pytest

from lfm_ppl.studies import catalogue
from lfm_ppl.studies.declaration import option_fields

SMALL = {
    "ginzburg-landau": {"realisations": 1, "conditional": 2}, "home-heating": {"methods": ("SQM", "none"), "homes": 1},
    "transcription": {"datasets": 2}, "transcription-parameters": {}, "ballistic": {"runs": 2},
    "periodic-kernels": {}, "call-centre": {"days": 1}, "constrained": {}, "counts": {"problems": ("student-t",)},
}
"""Settings of the small run, besides the settings of the quick version. The study on satellites is in test_gps.py."""


def test_every_study_is_listed():
    assert {*SMALL, "gps"} == set(catalogue.names())


@pytest.mark.parametrize("name", SMALL)
def test_tasks_have_separate_names_and_known_kinds(name):
    study = catalogue.entry(name).study
    settings = study.settings.quick(**SMALL[name])
    tasks = study.tasks(settings)
    assert tasks and len({task.stem for task in tasks}) == len(tasks)
    assert {study.task_kind(task) for task in tasks} <= set(study.kinds)
    assert {field.name for field, _ in option_fields(study.settings)} >= set(SMALL[name])


def check_number(name, tables):
    """Assert what the source of the study, or its page, says."""
    if name == "ginzburg-landau":
        assert tables["comparison"].loc["grid, true parameters", "RMSE smoother"] < 1.5
    if name == "constrained":
        assert tables["transcription"].loc[["full information", "EP"], "least"].min() >= 0.0
        assert tables["transcription"].loc["full information", "largest MSE"] < 0.0103
        assert tables["transcription"]["failed"].sum() == 0
    if name == "call-centre":
        assert tables["constant"].loc["Matern", "published RMSE"] == 10.6
    if name == "ballistic":
        assert tables["parameters"].loc["log alpha", "truth"] == pytest.approx(-7.7, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_a_small_run_leaves_tables_and_figures(name, tmp_path):
    study = catalogue.entry(name).study
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        results = study.run(study.settings.quick(**SMALL[name]), tmp_path)
    written = study.save(results, tmp_path)
    assert all(path.stat().st_size > 0 for path in written) and {path.suffix for path in written} >= {".csv", ".png"}
    check_number(name, results.tables)
