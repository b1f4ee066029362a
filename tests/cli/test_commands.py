"""The command line: what it writes, what it prints, and what it says about a mistake."""

import contextlib
import io
import json
import os
import re
import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lfm_ppl import cli
from lfm_ppl.cli import choices, main, results
from lfm_ppl.io import loading
from lfm_ppl.results import arviz_data

FIGURES = {"fit.png", "forces.png", "deterministics.png", "states.png", "trace.png", "pairs.png", "residuals.png"}

MOTIF = '''"""Two genes, one factor.

dx/dt = u - decay x
"""
import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("a", "b")
UNITS = {"a": "nM"}
OPTIONS = {"order": (0, (0, 1), "smoothness of the force")}
PARAMETERS = {"decay": "rate of decay (1/h)", "noise_sd": "noise (nM)"}


def build(decay, noise_sd, order):
    return lfm.LatentForceModel(
        dynamics=lambda x, u, t: u[0] - decay * x,
        forces={"factor": lfm.Matern(1.0, 1.0, order=order)},
        observation=lfm.GaussianObservation(lambda x, u, t: x, noise_sd**2 * jnp.ones(2)),
        initial_state=lfm.Gaussian(jnp.zeros(2), jnp.eye(2)),
        output_names=OUTPUTS,
        deterministics={"activity": lambda x, u, t: jax.nn.softplus(u[0])},
    )


def model(times, y=None, order=0):
    decay = numpyro.sample("decay", dist.LogNormal(jnp.zeros(2), 0.5).to_event(1))
    noise_sd = numpyro.sample("noise_sd", dist.HalfNormal(0.5))
    system = build(decay, noise_sd, order)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=2), obs=y)


def simulate(seed=3, order=0):
    truth = {"decay": jnp.array([0.5, 1.0]), "noise_sd": 0.1}
    times = jnp.arange(8.0)
    drawn = lfm.simulate(jax.random.key(seed), build(**truth, order=order), times)
    truth = {"times": times, "forces": drawn.forces, "parameters": truth}
    return lfm.Data(times, drawn.y, OUTPUTS, truth=truth)
'''


@pytest.fixture(scope="module")
def motif(tmp_path_factory):
    """The path of a small model file of a user."""
    path = tmp_path_factory.mktemp("models") / "motif.py"
    path.write_text(MOTIF)
    return str(path)


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    """Run the command line in an empty folder; return (exit code, output, errors)."""
    monkeypatch.chdir(tmp_path)

    def run_line(line):
        try:
            code = main(shlex.split(line))
        except SystemExit as exit_:  # what argparse does with a wrong argument, and for --help
            code = exit_.code
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run_line


@pytest.fixture(scope="module", params=["ram", pytest.param("nuts", marks=pytest.mark.slow)])
def sampler(request):
    return request.param


@pytest.fixture(scope="module")
def short_run(motif, sampler, tmp_path_factory):
    """The folder that a short run wrote, and what it printed."""
    folder = tmp_path_factory.mktemp("fit") / "result"
    line = f"fit {motif} --sampler {sampler} --chains 2 --warmup 60 --samples 60 --seed 1 --quiet --out {folder}"
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main(shlex.split(line)) == 0
    return folder, out.getvalue()


@pytest.fixture
def fitted(short_run):
    """The folder that a short run wrote."""
    return short_run[0]


@pytest.fixture
def without_sampling(monkeypatch, fitted):
    """Let `fit` find the result of the short run instead of sampling."""
    monkeypatch.setattr("lfm_ppl.cli.fit.sample", lambda *task: arviz_data.load(fitted / "posterior.nc"))


def test_models_lists_every_model(run):
    code, out, _ = run("models")
    assert code == 0
    for name in loading.available():
        assert f"{name} " in out
    assert "double-well" in out


def test_models_describes_one(run):
    code, out, _ = run("models transcription")
    assert code == 0
    for words in ("decay", "rate of decay (1/time)", "--set NAME=VALUE", "link", "softplus"):
        assert words in out
    assert "default: softplus" in out and "any number, the columns of the data file" in out


@pytest.mark.slow
def test_the_first_command_of_the_readme_does_not_diverge(run):
    code, out, err = run("fit ginzburg-landau --out first")
    assert code == 0 and "diverged" not in out + err
    draws = arviz_data.load("first/posterior.nc")
    assert int(arviz_data.group(draws, "sample_stats")["diverging"].sum()) == 0
    summary = arviz_data.summary(draws)
    assert summary["r_hat"].max() < 1.01 and summary["ess_bulk"].min() > 1000


def test_fit_writes_posterior_summary_and_figures(fitted, sampler):
    assert {path.name for path in fitted.iterdir()} == {"posterior.nc", "summary.csv", "report.html", *FIGURES}
    posterior = arviz_data.load(fitted / "posterior.nc")
    draws = arviz_data.group(posterior, "posterior")
    assert draws["decay"].shape == (2, 60, 2)
    attributes = arviz_data.attributes(posterior)
    assert (attributes["model"], attributes["sampler"], attributes["seed"]) == ("motif", sampler, 1)
    assert arviz_data.has_group(posterior, "truth"), "simulated data carries its truth along"
    table = pd.read_csv(fitted / "summary.csv", index_col="parameter")
    assert list(table.index) == ["decay[a]", "decay[b]", "noise_sd"]
    assert {"mean", "sd", "r_hat", "ess_bulk"} <= set(table.columns)
    np.testing.assert_allclose(table.loc["noise_sd", "mean"], float(draws["noise_sd"].mean()))


def test_fit_writes_a_page_that_says_how_to_repeat_it(fitted, sampler):
    page = (fitted / "report.html").read_text()
    said = f"--sampler {sampler} --chains 2 --warmup 60 --samples 60 --seed 1 --quiet --out {fitted}</pre>"
    assert "Two genes, one factor." in page and "<pre>lfm-ppl fit " in page and said in page
    assert page.count("data:image/png;base64,") == len(FIGURES)
    for name in ("posterior.nc", "summary.csv", *FIGURES):
        assert f'<a href="./{name}">' in page


@pytest.mark.usefixtures("without_sampling")
def test_a_page_that_fails_does_not_cost_the_result(run, motif, tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise RuntimeError("no paper")

    monkeypatch.setattr("lfm_ppl.results.html_report.save_report", fail)
    code, out, err = run(f"fit {motif} --out r")
    assert code == 1 and "lfm-ppl: the page could not be written: no paper" in err
    assert {path.name for path in (tmp_path / "r").iterdir()} == {"posterior.nc", "summary.csv", *FIGURES}


def test_fit_prints_summary_time_and_paths(short_run):
    folder, out = short_run
    for words in ("motif: Two genes, one factor.", "8 rows of a, b", "r_hat", "ess", "decay[a]"):
        assert words in out
    for name in ("posterior.nc", "summary.csv", "report.html", *FIGURES):
        assert f"wrote    {folder / name}\n" in out
    assert "\ntime " in out


@pytest.mark.slow
def test_fit_with_everything_said(run, motif, tmp_path):
    """A file with missing cells and other columns, fixed values, an option, settings, a sampler."""
    (tmp_path / "d.csv").write_text(
        "time_h,replicate,B,A,note\n0,1,,0.1,x\n0,2,0.3,0.2,y\n1,1,0.5,0.4,z\n3.5,1,0.1,,\n"
    )
    code, out, err = run(
        f"fit {motif} --data d.csv --outputs A,B --set 'decay[b]=0.8' --set noise_sd=0.2 "
        "--option order=1 --rule unscented --steps 3 --max-step 0.5 "
        "--sampler ram --chains 2 --warmup 50 --samples 50 --target-accept 0.3 --thin 2 --until 5 --quiet"
    )
    assert code == 0, err
    assert "d.csv: 4 rows of a, b; 2 values missing" in out
    assert "fixed    decay[b] = 0.8" in out and "fixed    noise_sd = 0.2" in out
    assert "order = 1" in out
    posterior = arviz_data.load(tmp_path / "lfm-results" / "motif-001" / "posterior.nc")
    draws = arviz_data.group(posterior, "posterior")
    assert "noise_sd" not in draws
    assert np.all(draws["decay"].sel(output="b") == 0.8)
    assert float(draws["decay"].sel(output="a").std()) > 0
    attributes = arviz_data.attributes(posterior)
    assert attributes["rule"].startswith("Unscented") and attributes["steps"] == 3
    assert (attributes["max_step"], attributes["sampler"], attributes["thin"]) == (0.5, "ram", 2)
    assert json.loads(attributes["options"]) == {"order": 1}
    at = arviz_data.group(posterior, "trajectories")["at"].values
    assert at[0] == 0.0 and at[-1] == 5.0 and {1.0, 3.5} <= set(at)
    observed = arviz_data.group(posterior, "observed_data")["y"]
    np.testing.assert_array_equal(observed.sel(output="a"), [0.1, 0.2, 0.4, np.nan])
    np.testing.assert_array_equal(observed.sel(output="b"), [np.nan, 0.3, 0.5, 0.1])


@pytest.mark.slow
def test_simulated_files_can_be_fitted(run, motif, tmp_path):
    code, out, err = run(f"simulate {motif} --seed 5 --option order=1 --out d.csv")
    assert code == 0, err
    assert "wrote d.csv" in out and "wrote d.truth.json" in out
    command = out.split("lfm-ppl ", 1)[1].strip()
    expected = loading.load(motif).simulate(seed=5, order=1)
    written = pd.read_csv(tmp_path / "d.csv")
    np.testing.assert_array_equal(written["a"], expected.y[:, 0])
    code, out, err = run(f"{command} --sampler map --samples 20 --quiet --out r")
    assert code == 0, err
    truth = arviz_data.group(arviz_data.load(tmp_path / "r" / "posterior.nc"), "truth")
    np.testing.assert_allclose(truth["decay"], [0.5, 1.0])
    code, _, err = run(f"simulate {motif} --out d.csv")
    assert code == 2 and "d.csv exists" in err


def test_plot_draws_a_saved_result_again(run, fitted, tmp_path):
    code, out, err = run(f"plot {fitted} --out again --format pdf")
    assert code == 0, err
    expected = {str(Path(name).with_suffix(".pdf")) for name in FIGURES}
    assert {path.name for path in (tmp_path / "again").iterdir()} == expected
    assert "wrote again/fit.pdf" in out
    code, _, err = run(f"plot {fitted / 'posterior.nc'}")
    assert code == 2 and "already exists" in err
    assert run(f"plot {fitted} --overwrite")[0] == 0


@pytest.mark.usefixtures("without_sampling")
def test_a_figure_that_fails_does_not_cost_the_draws(run, motif, tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise RuntimeError("no ink")

    monkeypatch.setattr("lfm_ppl.results.plots.save_figures", fail)
    code, out, err = run(f"fit {motif} --out r")
    assert code == 1
    assert "no ink" in err and "lfm-ppl plot r --overwrite" in err
    assert {path.name for path in (tmp_path / "r").iterdir()} == {"posterior.nc", "summary.csv", "report.html"}
    assert "No figures were drawn" in (tmp_path / "r" / "report.html").read_text()


@pytest.mark.usefixtures("without_sampling")
def test_results_are_never_overwritten(run, motif, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("keep")
    code, out, err = run(f"fit {motif} --out full")
    assert code == 2 and "the folder full exists and holds files" in err and "--overwrite" in err
    assert "time " not in out, "it is said before the work, not after it"
    assert run(f"fit {motif} --out full --overwrite")[0] == 0
    assert run(f"fit {motif} --out full --overwrite")[0] == 0
    assert (tmp_path / "full" / "mine.txt").read_text() == "keep"


def test_folders_are_numbered_and_not_left_empty(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        with results.folder("spring", None, overwrite=False) as folder:
            assert folder == Path(f"lfm-results/spring-00{number}")
            (folder / "posterior.nc").write_text("")
    with pytest.raises(RuntimeError), results.folder("spring", None, overwrite=False) as folder:
        raise RuntimeError
    assert not folder.exists()
    with pytest.raises(FileExistsError, match="is a file"):
        with results.folder("spring", str(tmp_path / "lfm-results/spring-001/posterior.nc"), False):
            pass


@pytest.mark.parametrize("line", [
    "fit spring --out taken/result", "simulate spring --out taken/data.csv", "compare gps --out taken/result",
])
def test_a_path_that_cannot_be_written_is_told_first(run, tmp_path, monkeypatch, line):
    monkeypatch.setattr("lfm_ppl.cli.session.start", lambda *asked, **more: None)
    monkeypatch.setattr("lfm_ppl.cli.fit.sample", lambda *task: pytest.fail("it was computed"))
    (tmp_path / "taken").write_text("keep")
    code, out, err = run(line)
    assert code == 2 and "wrote" not in out
    assert re.search(r"cannot write results into taken\S*: taken is a file. Nothing was computed; name .* --out", err)
    assert (tmp_path / "taken").read_text() == "keep"


def test_a_folder_that_cannot_be_written_is_told_first(run, tmp_path, monkeypatch):
    monkeypatch.setattr("lfm_ppl.cli.fit.sample", lambda *task: pytest.fail("it was computed"))
    (tmp_path / "locked").mkdir(mode=0o500)
    if os.access(tmp_path / "locked", os.W_OK):  # the administrator may write anywhere
        pytest.skip("this user may write into any folder")
    for out in ("locked", "locked/result"):
        code, _, err = run(f"fit spring --out {out}")
        assert code == 2 and f"cannot write results into {out}: Permission denied. Nothing was computed" in err


def test_the_default_folder_must_be_one(run, tmp_path, monkeypatch):
    monkeypatch.setattr("lfm_ppl.cli.fit.sample", lambda *task: pytest.fail("it was computed"))
    (tmp_path / "lfm-results").write_text("")
    code, _, err = run("fit spring")
    assert code == 2 and "cannot make the folder lfm-results/spring-001" in err and "--out" in err


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("fit ginsburg-landau", "unknown model 'ginsburg-landau'. Did you mean 'ginzburg-landau'"),
        ("fit MOTIF --sampler mcmc", "unknown sampler 'mcmc'. Known: nuts, ram, pmmh, map"),
        ("fit MOTIF --sampler nutz", "unknown sampler 'nutz'. Did you mean 'nuts'"),
        ("fit MOTIF --rule cubatur", "unknown rule 'cubatur'. Did you mean 'cubature'"),
        ("fit MOTIF --chains 0", "expected a whole number of at least 1, got '0'"),
        ("fit MOTIF --max-step -1", "expected a number above zero, got '-1'"),
        ("fit MOTIF --target-accept 1.5", "expected a number between 0 and 1, got '1.5'"),
        ("fit MOTIF --target-accept 0.9 --sampler map", "--target-accept is for the samplers nuts, ram and pmmh"),
        ("fit MOTIF --until 3", "--until takes a time after the last observation, at 7, got 3"),
        ("fit MOTIF --until 9 --trajectory-draws 0", "--until and --at need trajectories"),
        ("fit MOTIF --until nan", "--until takes a time after the last observation, at 7, got nan"),
        ("fit MOTIF --data absent.csv", "there is no file absent.csv"),
        ("fit MOTIF --data empty.csv", "empty.csv is empty"),
        ("fit MOTIF --data other.csv", "unknown output column 'a'"),
        ("fit MOTIF --data other.csv --outputs q", "has 2 outputs (a, b); --outputs names 1"),
        ("fit MOTIF --truth t.json", "--truth is about a data file; give one with --data"),
        ("fit MOTIF --option ordr=1", "unknown option of motif 'ordr'. Did you mean 'order'"),
        ("fit MOTIF --option order=2", "unknown value of option order '2'"),
        ("fit MOTIF --option order", "--option takes NAME=VALUE, got 'order'"),
        ("fit MOTIF --set decay=fast", "expected a number, numbers separated by commas, or 'free'"),
        ("fit MOTIF --set decay=nan", "--set decay must be finite"),
        ("fit MOTIF --set decay=free", "the model does not fix decay; it fixes: none"),
        ("fit MOTIF --set dacay=1", "unknown parameter to fix 'dacay'. Did you mean 'decay'"),
        ("fit MOTIF --set decay[c]=1", "unknown element of decay 'c'"),
        ("fit MOTIF --set decay=-1", "decay cannot be fixed at"),
        ("plot absent", "there is no result absent"),
        ("plot .", ". holds no posterior.nc"),
        ("plot empty.csv", "empty.csv"),
        ("simulate nothing.py", "there is no model file nothing.py"),
        ("refit MOTIF", "invalid choice: 'refit'"),
        ("fit", "required: MODEL"),
        ("fit MOTIF --sampels 10", "unrecognized arguments: --sampels 10"),
        ("", "required: COMMAND"),
    ],
)
def test_mistakes_are_one_line_that_says_what_to_do(run, motif, tmp_path, line, message):
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "other.csv").write_text("time,q\n0,1\n")
    code, out, err = run(line.replace("MOTIF", motif))
    assert code == 2
    assert err.startswith("lfm-ppl: error: ") and err.count("\n") == 1, err
    assert "fixed    dacay" not in out, "what is refused is not announced as done"
    assert message in err
    assert not list(tmp_path.glob("lfm-results/*")), "no empty folder is left behind"


def test_debug_shows_where(motif):
    with pytest.raises(ValueError, match="unknown parameter to fix"):
        main(["fit", motif, "--set", "dacay=1", "--debug"])


@pytest.mark.parametrize("command", ["", "models", "new", "simulate", "fit", "forecast", "check", "compare", "plot",
                                     "version"])
def test_help_has_examples(run, command):
    code, out, _ = run(f"{command} --help")
    assert code == 0
    assert f"lfm-ppl {command}".strip() in out
    if command:
        assert "examples:" in out


def test_version(run):
    code, out, _ = run("version")
    assert code == 0
    for name in ("lfm_ppl 0.", "jax ", "numpyro ", "python 3."):
        assert name in out


ANCHORS = {"sensitivity[C]": 1.0, "decay[C]": 0.8}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([], ANCHORS),
        (["decay[C]=0.7"], {"sensitivity[C]": 1.0, "decay[C]": 0.7}),
        (["decay[C]=free"], {"sensitivity[C]": 1.0}),
        (["decay=free", "sensitivity=free"], {}),
        (["decay=1,2"], {"sensitivity[C]": 1.0, "decay": [1.0, 2.0]}),
        (["scale=1e-1"], {**ANCHORS, "scale": 0.1}),
    ],
)
def test_what_the_user_fixes_wins_over_the_anchors(given, expected):
    assert choices.fixed(given, ANCHORS) == expected


def test_an_option_is_no_parameter():
    with pytest.raises(ValueError, match="--set df=4: df is an option of the model, not a parameter: --option df=4"):
        choices.fixed(["df=4"], {}, {"df", "link"})
    with pytest.raises(ValueError, match=r"--set link\[a\]=free: link is an option of the model.*--option link=VALUE"):
        choices.fixed(["link[a]=free"], {}, {"df", "link"})


def test_a_warning_is_shown_once(capsys):
    show = cli._Warnings()
    for text in ("the input\n ends", "the input ends", "another"):
        show(UserWarning(text), UserWarning, "file", 1)
    assert capsys.readouterr().err == "lfm-ppl: warning: the input ends\nlfm-ppl: warning: another\n"
