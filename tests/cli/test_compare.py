"""`lfm-ppl compare`: what it lists, prints and writes, and what it says about a mistake."""

import dataclasses
import shlex
from types import SimpleNamespace

import pandas as pd
import pytest

from lfm_ppl.cli import main
from lfm_ppl.experiments import catalogue
from lfm_ppl.experiments.study import Study, StudyResult, StudyTable, options


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    """Run the command line in an empty folder; return (exit code, output, errors)."""
    monkeypatch.chdir(tmp_path)

    def run_line(line):
        try:
            code = main(shlex.split(line))
        except SystemExit as exit_:
            code = exit_.code
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run_line


@pytest.fixture
def wanted(monkeypatch):
    """Replace the experiment by one that takes no time; return what it was asked."""
    asked = []

    class Fake(Study):
        """The study with the settings of another, and one table."""

        def run(self, settings, folder, *, overwrite=False, report=None, workers=1):
            asked.append(SimpleNamespace(settings=settings, folder=folder, overwrite=overwrite, report=report))
            folder.mkdir(parents=True, exist_ok=True)
            if report:
                report("1/1 task")
            rates = pd.DataFrame({"rate": [0.5]}, ["EKF"])
            table = StudyTable("Rates", rates, rates)
            return StudyResult(settings, {}, {}, {"rates": table}, ("1 of 1 cell is consistent.",))

        def save(self, result, folder):
            return [folder / "rates.csv"]

    real = catalogue.CatalogueEntry.study.fget
    monkeypatch.setattr(catalogue.CatalogueEntry, "study", property(
        lambda entry: Fake(**{field.name: getattr(real(entry), field.name) for field in dataclasses.fields(Study)})))
    return asked


def test_without_a_name_it_lists_the_experiments(run):
    code, out, err = run("compare")
    assert code == 0 and err == ""
    assert "ginzburg-landau           double well" in out and "transcription-parameters  " in out


def test_an_unknown_name_gets_the_nearest(run):
    code, out, err = run("compare ginsburg-landau")
    assert code == 2 and out == ""
    assert "Did you mean 'ginzburg-landau'" in err and len(err.splitlines()) == 1


@pytest.mark.parametrize("line", ["--realisations 0", "--conditional -1", "--seed x", "--particels 5"])
def test_bad_arguments_are_one_line(run, line):
    code, _, err = run(f"compare ginzburg-landau {line}")
    assert code == 2 and err.startswith("lfm-ppl: error:") and len(err.splitlines()) == 1


def test_a_file_is_no_folder(run, tmp_path):
    (tmp_path / "taken").write_text("")
    code, _, err = run("compare ginzburg-landau --out taken")
    assert code == 2 and "taken is a file" in err


def test_it_prints_tables_progress_and_files(run, wanted, tmp_path):
    code, out, err = run("compare ginzburg-landau --realisations 3 --conditional 7 --seed 5 --out here")
    assert code == 0
    assert "Rates" in out and "EKF  0.500" in out and "wrote    here/rates.csv" in out
    assert out.index("EKF  0.500") < out.index("1 of 1 cell is consistent.") < out.index("time  ")
    assert err == "1/1 task\n"
    (one,) = wanted
    assert (one.settings.realisations, one.settings.conditional, one.settings.seed) == (3, 7, 5)
    assert one.settings.particles == 40_000 and one.overwrite is False  # not those of --quick


def test_it_writes_an_index_of_tables_and_figures(run, wanted, tmp_path):
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "rates.csv").write_text("")
    index = tmp_path / "here" / "index.html"
    for _ in range(2):  # our own page is brought up to date
        code, out, _ = run("compare gps --seed 5 --out here --overwrite --quiet")
        assert code == 0 and "wrote    here/index.html" in out
    page = index.read_text()
    for words in ("<h1>gps</h1>", "<h3>Rates</h3>", '<th scope="row">EKF</th><td class="n">0.500</td>',
                  "<p>1 of 1 cell is consistent.</p>", "<pre>lfm-ppl compare gps --seed 5 --out here --quiet</pre>",
                  '<a href="./rates.csv">rates.csv</a>'):
        assert words in page
    index.write_text("my own notes")
    code, _, err = run("compare gps --out here --quiet")
    assert code == 2 and "index.html already exists" in err and len(wanted) == 2
    assert index.read_text() == "my own notes"


def test_an_index_that_fails_does_not_cost_the_tables(run, wanted, monkeypatch):
    def fail(*args, **kwargs):
        raise OSError("no space left")

    monkeypatch.setattr("lfm_ppl.results.html_report.write_page", fail)
    code, out, err = run("compare gps --out here --quiet")
    assert code == 1 and "EKF  0.500" in out and "the page could not be written: no space left" in err


def test_the_same_command_has_the_same_folder(run, wanted):
    for line in ("", "--quiet", "--quick --overwrite --quiet"):
        assert run(f"compare ginzburg-landau {line}")[0] == 0
    first, second, quick = wanted
    assert first.folder == second.folder != quick.folder
    assert second.report is None and quick.overwrite and quick.settings.particles == 500


@pytest.mark.parametrize("name", catalogue.names())
def test_the_help_of_a_study_has_its_options_and_no_others(run, name):
    code, out, err = run(f"compare {name} --help")
    assert code == 0 and err == "" and f"options of {name}" in out
    own = {flag for option in options(catalogue.experiment(name).study.settings) for flag in option.flags}
    every = {flag for name in catalogue.names() for option in options(catalogue.experiment(name).study.settings)
             for flag in option.flags}
    assert "--seed" in own
    for flag in every:
        assert (f"{flag} " in out) == (flag in own), flag


def test_the_help_lists_the_studies(run):
    code, out, _ = run("compare --help")
    assert code == 0 and all(f"  {name}  " in out for name in catalogue.names()) and "--satellites" in out
    assert "--train-days D" not in out  # it is in an example alone


@pytest.mark.parametrize("line, said", [
    ("ballistic --conditional 3", "ballistic does not take --conditional; leave it out"),
    ("call-centre --conditional 3", "does not take --conditional"),
    ("transcription-parameters --conditional=3", "does not take --conditional"),
    ("gps --realisations 5", "gps does not take --realisations"),
    ("gps --train-day 3", "Did you mean --train-days?"),
    ("--sateliltes G05 gps", "Did you mean --satellites?"),
    ("ballistic --rules cubature cubic", "unknown value 'cubic'"),
    ("ballistic --rules Taylor", "rules must hold 'cubature'"),
    ("ballistic --particles 5 5", "particles must be a tuple of different numbers"),
    ("ballistic --nuts 2 300 700", "--nuts: expected 4 arguments"),
    ("ballistic --nuts 2 0 700 1", "--nuts: expected a whole number of at least 1, got '0'"),
    ("ballistic --runs 20000", "use several seeds for more"),
    ("gps --train-days nan", "--train-days: expected a number above zero, got 'nan'"),
    ("ballistic --runs 1_000", "--runs/--realisations/--datasets: expected a whole number of at least 1, got '1_000'"),
    ("gps --axes XYZ", "unknown value 'XYZ'"),
    ("transcription --burn-in 100000", "burn_in must lie in"),
    ("transcription --burn-in -1", "--burn-in"),
    ("counts gps", "unrecognized arguments: gps"),
    ("--data '' gps", "expected FOLDER, got ''"),
])
def test_a_mistake_is_one_clear_line(run, tmp_path, line, said):
    code, out, err = run(f"compare {line}")
    assert code == 2 and out == "" and len(err.splitlines()) == 1 and said in err, err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("line, asked", [
    ("ballistic --runs 20 --particles 500 2000 --nuts 2 30 30 1",
     {"runs": 20, "particles": (500, 2_000), "nuts": (2, 30, 30, 1), "ram": (4, 100, 500, 15)}),
    ("--satellites G05 G20 --train-days 2.5 gps --quick --seed 3",
     {"satellites": ("G05", "G20"), "train_days": 2.5, "seed": 3, "most": 2}),
    ("call_centre --realisations 4 --data calls", {"days": 4, "data": "calls"}),
    ("--seed 2 --out counts transcription --datasets 7", {"datasets": 7, "seed": 2}),
])
def test_what_is_given_are_the_settings(run, wanted, line, asked):
    assert run(f"compare {line} --quiet")[0] == 0
    assert {name: getattr(wanted[0].settings, name) for name in asked} == asked
