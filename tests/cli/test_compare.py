"""`lfm-ppl compare`: the list, the options of studies, tables, pages and errors."""

import dataclasses
from types import SimpleNamespace

import pandas as pd
import pytest

from lfm_ppl.studies import catalogue
from lfm_ppl.studies.declaration import Study, StudyResult, StudyTable, option_fields


@pytest.fixture
def requests(monkeypatch):
    """Replace the computation of studies by one that takes no time; return the settings that they got."""
    runs = []

    class Fake(Study):
        """A study with the settings of another, and one table."""

        def run(self, settings, folder, *, overwrite=False, report=None, workers=1):
            runs.append(SimpleNamespace(settings=settings, folder=folder, overwrite=overwrite, report=report))
            if report:
                report("1/1 task")
            rates = pd.DataFrame({"rate": [0.5]}, ["EKF"])
            return StudyResult(settings, {}, {}, {"rates": StudyTable("Rates", rates, rates)}, ("1 of 1 cell agrees.",))

        def save(self, result, folder):
            (folder / "rates.csv").write_text("")
            return [folder / "rates.csv"]

    real = catalogue.CatalogueEntry.study.fget
    monkeypatch.setattr(catalogue.CatalogueEntry, "study", property(
        lambda entry: Fake(**{field.name: getattr(real(entry), field.name) for field in dataclasses.fields(Study)})))
    return runs


def test_without_a_name_it_lists_the_studies(run):
    status, out, err = run("compare")
    assert status == 0 and err == "" and "ginzburg-landau           double well" in out
    assert all(name in out for name in catalogue.names())


@pytest.mark.parametrize("name", catalogue.names())
def test_the_help_of_a_study_has_an_option_for_each_setting(run, name):
    status, out, err = run(f"compare {name} --help")
    assert status == 0 and err == "" and f"options of {name}:" in out
    for field, _ in option_fields(catalogue.entry(name).study.settings):
        assert f"--{field.name.replace('_', '-')}" in out
        assert all(alias in out for alias in field.metadata["declaration"].aliases)


def test_an_option_may_have_the_name_of_a_study_as_its_value(run, requests, tmp_path):
    assert run("compare --out gps ginzburg-landau --quiet")[0] == 0
    assert requests[0].folder.name == "gps" and (tmp_path / "gps" / "index.html").is_file()


def test_it_prints_tables_progress_and_files(run, requests, tmp_path):
    status, out, err = run("compare ginzburg-landau --realisations 3 --conditional 7 --seed 5 --out here")
    assert status == 0 and err == "1/1 task\n"
    assert out.index("EKF  0.500") < out.index("1 of 1 cell agrees.") < out.index("time  ")
    assert "wrote    here/rates.csv" in out and "wrote    here/index.html" in out
    settings = requests[0].settings
    assert (settings.realisations, settings.conditional, settings.seed, settings.particles) == (3, 7, 5, 40_000)
    index = tmp_path / "here" / "index.html"
    page = index.read_text()
    for words in ("<h3>Rates</h3>", "--seed 5 --out here</pre>", '<a href="./rates.csv">rates.csv</a>'):
        assert words in page
    index.write_text("my own notes")
    status, _, err = run("compare ginzburg-landau --out here --quiet")
    assert status == 2 and "index.html already exists" in err and index.read_text() == "my own notes"


def test_a_page_that_fails_does_not_cost_the_tables(run, requests, monkeypatch):
    def fail(*arguments, **keywords):
        raise OSError("no space left")

    monkeypatch.setattr("lfm_ppl.report.html_report.write_page", fail)
    status, out, err = run("compare gps --out here --quiet")
    assert status == 1 and "EKF  0.500" in out and "no space left" in err


def test_the_same_command_has_the_same_folder(run, requests):
    for line in ("", "--quiet", "--quick --overwrite --quiet"):
        assert run(f"compare ginzburg-landau {line}")[0] == 0
    first, second, quick = requests
    assert first.folder == second.folder != quick.folder
    assert second.report is None and quick.overwrite and quick.settings.particles == 500


@pytest.mark.parametrize(("line", "expected"), [
    ("ballistic --runs 20 --particles 500 2000 --nuts 2 30 30 1",
     {"runs": 20, "particles": (500, 2_000), "nuts": (2, 30, 30, 1), "ram": (4, 100, 500, 15)}),
    ("--satellites G05 G20 --train-days 2.5 gps --quick --seed 3",
     {"satellites": ("G05", "G20"), "train_days": 2.5, "seed": 3, "most": 2}),
    ("call_centre --realisations 4 --data calls", {"days": 4, "data": "calls"}),
])
def test_the_options_are_the_settings(run, requests, line, expected):
    status, _, err = run(f"compare {line} --quiet")
    assert status == 0, err
    assert {name: getattr(requests[0].settings, name) for name in expected} == expected


@pytest.mark.parametrize(("line", "words"), [
    ("ginsburg-landau", "'ginzburg-landau'"), ("ginzburg-landau --realisations 0", "realisations"),
    ("ginzburg-landau --conditional -1", "conditional"), ("ginzburg-landau --seed x", "--seed"),
    ("ballistic --conditional 3", "--conditional"), ("gps --train-day 3", "--train-days"),
    ("ballistic --rules cubature cubic", "cubic"), ("ballistic --particles 5 5", "particles"),
    ("ballistic --nuts 2 300 700", "--nuts"), ("ballistic --nuts 2 0 700 1", "nuts"), ("gps --axes XYZ", "XYZ"),
    ("gps --train-days nan", "train_days"), ("counts gps", "gps"),
])
def test_mistakes_are_one_line(run, tmp_path, line, words):
    status, out, err = run(f"compare {line}")
    assert status == 2 and out == "" and err.startswith("lfm-ppl: error: ") and err.count("\n") == 1
    assert words in err, err
    assert not list(tmp_path.iterdir())
