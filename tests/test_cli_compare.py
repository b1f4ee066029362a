"""`lfm-ppl compare`: what it lists, prints and writes, and what it says about a mistake."""

import shlex

import pandas as pd
import pytest

from lfm_ppl.cli import main
from lfm_ppl.experiments import catalogue


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

    def fake(one):
        asked.append(one)
        one.folder.mkdir(parents=True, exist_ok=True)
        if one.report:
            one.report("1/1 task")
        return catalogue.Report({"Rates": pd.DataFrame({"rate": [0.5]}, ["EKF"])}, [one.folder / "rates.csv"],
                                ("1 of 1 cell is consistent.",))

    monkeypatch.setattr(catalogue, "experiment", lambda name: catalogue.Experiment(name, "summary", fake))
    return asked


def test_without_a_name_it_lists_the_experiments(run):
    code, out, err = run("compare")
    assert code == 0 and err == ""
    assert "ginzburg-landau           double well" in out and "transcription-parameters  " in out


def test_an_unknown_name_gets_the_nearest(run):
    code, out, err = run("compare ginsburg-landau")
    assert code == 2 and out == ""
    assert "Did you mean 'ginzburg-landau'" in err and len(err.splitlines()) == 1


@pytest.mark.parametrize("line", ["--realisations 0", "--conditional -1", "--seed x", "--particles 5"])
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
    assert (one.realisations, one.conditional, one.seed, one.quick, one.overwrite) == (3, 7, 5, False, False)


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
    assert code == 2 and "index.html exists already and is kept" in err and len(wanted) == 2
    assert index.read_text() == "my own notes"


def test_an_index_that_fails_does_not_cost_the_tables(run, wanted, monkeypatch):
    def fail(*args, **kwargs):
        raise OSError("no space left")

    monkeypatch.setattr("lfm_ppl.results.web_page.write", fail)
    code, out, err = run("compare gps --out here --quiet")
    assert code == 1 and "EKF  0.500" in out and "the page could not be written: no space left" in err


def test_the_same_command_has_the_same_folder(run, wanted):
    for line in ("", "--quiet", "--quick --overwrite --quiet"):
        assert run(f"compare ginzburg-landau {line}")[0] == 0
    first, second, quick = wanted
    assert first.folder == second.folder != quick.folder
    assert second.report is None and quick.overwrite and quick.quick
