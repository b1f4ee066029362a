"""The command line: a run of each command, its exit status, and errors in one line."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lfm_ppl import cli
from lfm_ppl.cli import choices, folders, main
from lfm_ppl.filtering.iterated import DEFAULT_ITERATIONS
from lfm_ppl.io import loading
from lfm_ppl.likelihoods.filter_settings import FilterSettings
from lfm_ppl.results import arviz_data
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.studies import catalogue

ROOT = Path(__file__).resolve().parents[2]
FIGURES = {"fit.png", "states.png", "trace.png", "residuals.png"}
COMMANDS = ["models", "new", "simulate", "fit", "forecast", "check", "compare", "plot", "version"]


@pytest.fixture
def without_sampling(monkeypatch, original):
    """Let `fit` return the stored result instead of sampling."""
    monkeypatch.setattr("lfm_ppl.fit", lambda *arguments, **keywords: arviz_data.load(original))


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_examples_and_fits_80_columns(run, command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    status, out, err = run(f"{command} --help")
    assert status == 0 and err == "" and f"Usage: lfm-ppl {command}" in out and "examples:\n  lfm-ppl" in out
    assert max(map(len, out.splitlines())) <= 80


def test_the_help_appears_without_jax():
    code = """
import sys
from lfm_ppl.cli import main
for line in (["--help"], ["fit", "--help"], ["compare", "--help"]):
    assert main(line) == 0
assert not {"jax", "numpy", "pandas", "matplotlib"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, cwd=ROOT)


def test_the_help_shows_the_defaults_of_the_likelihood(run):
    text = " ".join(run("fit --help")[1].split())
    settings = FilterSettings()
    defaults = {"rule": type(settings.rule).__name__.lower(), "steps": settings.steps, "method": settings.method,
                "iterations": DEFAULT_ITERATIONS}
    for name, default in defaults.items():
        _, description = re.split(rf"--{name} [A-Z]", text, maxsplit=1)
        assert f"(default: {default}" in description.partition(" --")[0], name


@pytest.mark.thorough
def test_options_and_commands_that_the_pages_name_exist(run):
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    lines = re.findall(r"lfm-ppl (\w[\w-]*)([^\n`]*)", "\n".join(page.read_text(encoding="utf-8") for page in pages))
    helps = {}
    for command, words in lines:
        study = next((word for word in words.split()[:1] if command == "compare" and word in catalogue.names()), "")
        text = helps.setdefault((command, study), run(f"{command} {study} --help")[1])
        for flag in re.findall(r"(?<!\S)--[a-z][a-z-]*", words):
            assert re.search(rf"{flag}\b(?!-)", text) or flag == "--help", f"lfm-ppl {command} {words}"
    assert len(helps) >= len(COMMANDS) - 1


def test_version_and_list_of_models(run):
    status, out, _ = run("version")
    assert status == 0 and all(f"{name} " in out for name in ("lfm_ppl", "jax", "numpyro", "python"))
    assert run("--version")[:2] == (0, f"{out.splitlines()[0]}\n")
    status, out, _ = run("models")
    assert status == 0 and all(f"{name} " in out for name in loading.available())


def test_a_model_is_described(run, well, tmp_path):
    status, out, _ = run(f"models {well}")
    assert status == 0
    for words in ("outputs: x (nm)", "depth of the wells (1/h)", "LogNormal", "noise", "(default: 0.3)", "cubature"):
        assert words.lower() in out.lower()
    broken = tmp_path / "broken.py"
    broken.write_text('PARAMETERS = {"rate": "how fast"}\ndef model(times, y=None):\n    raise ValueError("not yet")\n')
    status, out, err = run(f"models {broken}")
    assert status == 2 and "how fast" in out and err == f"lfm-ppl: error: {broken}, line 3: not yet\n"


def test_a_new_model_is_described_and_simulated(run):
    assert run("new my_model.py")[0] == 0
    assert run("models my_model.py")[0] == 0
    status, out, err = run("simulate my_model.py --seed 5 --out d.csv")
    assert status == 0 and "lfm-ppl fit my_model.py --data d.csv" in out, err
    expected = loading.load("my_model.py").simulate(seed=5)
    np.testing.assert_array_equal(pd.read_csv("d.csv")[list(expected.outputs)], expected.y)


@pytest.mark.thorough
def test_a_new_model_is_fitted_at_once(run):
    assert run("new my_model.py")[0] == 0
    status, out, err = run("fit my_model.py --sampler map --samples 50 --set noise_sd=0.3 --quiet --out result")
    assert status == 0 and "fixed    noise_sd = 0.3" in out, err
    posterior = ResultView.of(arviz_data.load("result")).posterior
    assert set(posterior.data_vars) == {"loss", "scale", "lengthscale", "half_life"}
    np.testing.assert_allclose(posterior["half_life"], np.log(2) / posterior["loss"])
    # The truth is 0.3; the prior's own width is 0.5 in the logarithm.
    assert abs(np.log(posterior["loss"]).mean() - np.log(0.3)) < 1.0
    for line in ("new my_model.py", "new model.txt", "new 3.py"):
        status, _, err = run(line)
        assert status == 2 and err.count("\n") == 1


def test_fit_writes_posterior_summary_figures_and_page(original):
    assert {path.name for path in original.iterdir()} >= {"posterior.nc", "summary.csv", "report.html", *FIGURES}
    posterior = arviz_data.load(original)
    attributes, draws = ResultView.of(posterior).attrs, ResultView.of(posterior).posterior
    assert draws["depth"].shape == (2, 100) and "truth" in ResultView.of(posterior).groups
    assert [attributes[name] for name in ("model", "sampler", "seed", "steps")] == ["well", "ram", 1, 12]
    assert json.loads(attributes["options"]) == {"noise": 0.25}
    table = pd.read_csv(original / "summary.csv", index_col="parameter")
    np.testing.assert_allclose(table.loc["depth", "mean"], float(draws["depth"].mean()))
    page = (original / "report.html").read_text()
    assert "<pre>lfm-ppl fit " in page and f"--quiet --until 8 --at 6.25 --out {original}</pre>" in page


@pytest.mark.thorough
def test_simulated_files_can_be_fitted(run, well, tmp_path):
    status, out, err = run(f"simulate {well} --seed 5 --option noise=0.2 --out d.csv")
    assert status == 0, err
    np.testing.assert_array_equal(pd.read_csv("d.csv")["x"], loading.load(well).simulate(seed=5).y[:, 0])
    command = out.split("lfm-ppl ", 1)[1].strip()
    status, out, err = run(f"{command} --sampler map --samples 20 --rule unscented --quiet --out r")
    assert status == 0, err
    assert "d.csv: 6 rows of x; 1 values missing" in out and "noise = 0.2" in out
    assert float(ResultView.of(arviz_data.load("r")).group("truth")["depth"]) == 1.0
    assert run(f"simulate {well} --out d.csv")[0] == 2


def test_plot_draws_a_saved_result_again(run, original):
    status, out, err = run(f"plot {original} --out again --format pdf")
    assert status == 0 and "wrote again/fit.pdf" in out, err
    status, _, err = run(f"plot {original}")
    assert status == 2 and "already exists" in err


@pytest.mark.usefixtures("without_sampling")
@pytest.mark.parametrize("name", ["plots.save_figures", "report.html_report.save_report"])
def test_a_figure_or_a_page_that_fails_does_not_cost_the_draws(run, well, tmp_path, monkeypatch, name):
    def fail(*arguments, **keywords):
        raise RuntimeError("no ink")

    monkeypatch.setattr(f"lfm_ppl.{name}", fail)
    status, _, err = run(f"fit {well} --out r")
    assert status == 1 and "no ink" in err and (tmp_path / "r" / "posterior.nc").is_file()


@pytest.mark.usefixtures("without_sampling")
def test_results_are_never_overwritten(run, well, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("keep")
    status, out, err = run(f"fit {well} --out full")
    assert status == 2 and "--overwrite" in err and "time " not in out
    assert run(f"fit {well} --out full --overwrite")[0] == 0
    assert (tmp_path / "full" / "mine.txt").read_text() == "keep"


def test_folders_are_numbered_and_not_left_empty(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        with folders.folder("spring", None, overwrite=False) as folder:
            assert folder == Path(f"lfm-results/spring-00{number}")
            (folder / "posterior.nc").write_text("")
    with pytest.raises(RuntimeError), folders.folder("spring", None, overwrite=False) as folder:
        raise RuntimeError
    assert not folder.exists()


@pytest.mark.thorough
@pytest.mark.parametrize("line", ["fit spring --out taken/r", "simulate spring --out taken/d.csv", "fit spring"])
def test_a_path_that_cannot_be_written_is_an_error_before_the_computation(run, tmp_path, monkeypatch, line):
    monkeypatch.setattr("lfm_ppl.fit", lambda *task, **keywords: pytest.fail("it was computed"))
    for name in ("taken", "lfm-results"):
        (tmp_path / name).write_text("keep")
    status, _, err = run(line)
    assert status == 2 and "--out" in err and (tmp_path / "taken").read_text() == "keep"


@pytest.mark.parametrize(("line", "words"), [
    ("", "command"), ("refit WELL", "fit"), ("fit", "MODEL"), ("fit WELL other", "other"),
    ("fit WELL --sampels 10", "--samples"), ("fit ginsburg-landau", "ginzburg-landau"),
    ("fit WELL --sampler nutz", "nuts"), ("fit WELL --rule cubatur", "cubature"), ("fit WELL --chains 0", "--chains"),
    ("fit WELL --chains 1.5", "--chains"), ("fit WELL --max-step -1", "--max-step"), ("fit WELL --data ''", "--data"),
    ("fit WELL --target-accept 1.5", "--target-accept"), ("fit WELL --data", "--data"),
    ("fit WELL --target-accept 0.9 --sampler map", "target"), ("fit WELL --until 3", "--until"),
    ("fit WELL --until 9 --trajectory-draws 0", "--trajectory-draws"), ("fit WELL --truth t.json", "--truth"),
    ("fit WELL --option nose=1", "'noise'"), ("fit WELL --set dept=1", "'depth'"), ("fit WELL --set depth=-1", "depth"),
    ("fit WELL --resume", "--out"), ("fit WELL --resume --overwrite --out r", "--overwrite"),
    ("fit WELL --each --series a", "--series"), ("fit WELL --time-unit ours", "unit of time"),
    ("plot absent", "absent"), ("simulate nothing.py", "nothing.py"), ("models nothing", "nothing"),
])
def test_mistakes_are_one_line(run, well, tmp_path, line, words):
    status, _, err = run(line.replace("WELL", well))
    assert status == 2
    assert err.startswith("lfm-ppl: error: ") and err.count("\n") == 1 and words in err, err
    assert not list(tmp_path.iterdir())


def test_debug_shows_where(well):
    with pytest.raises(ValueError, match="depth"):
        main(["fit", well, "--set", "dept=1", "--debug"])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_ends_with_its_status(number):
    code = f"""
import os, platform, signal, sys
from lfm_ppl.cli import main
platform.python_version = lambda: os.kill(os.getpid(), {int(number)})
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.exit(main(["version"]))
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert ended.returncode == 130 and "lfm-ppl: interrupted" in ended.stderr, ended.stderr


def test_the_module_runs_as_a_process():
    ended = subprocess.run([sys.executable, "-m", "lfm_ppl", "fit"], capture_output=True, text=True, cwd=ROOT,
                           env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert ended.returncode == 2 and ended.stderr.startswith("lfm-ppl: error: ")


@pytest.mark.parametrize(("texts", "expected"), [
    ([], {"s[C]": 1.0, "d[C]": 0.8}), (["d[C]=0.7"], {"s[C]": 1.0, "d[C]": 0.7}), (["d[C]=free"], {"s[C]": 1.0}),
    (["d=free", "s=free"], {}), (["d=1,2"], {"s[C]": 1.0, "d": [1.0, 2.0]}),
])
def test_values_of_the_user_replace_anchors(texts, expected):
    assert choices.fixed(texts, {"s[C]": 1.0, "d[C]": 0.8}) == expected


def test_a_warning_is_shown_once(capsys):
    show = cli._Warnings()
    for text in ("the input\n ends", "the input ends", "another"):
        show(UserWarning(text), UserWarning, "file", 1)
    assert capsys.readouterr().err == "lfm-ppl: warning: the input ends\nlfm-ppl: warning: another\n"
