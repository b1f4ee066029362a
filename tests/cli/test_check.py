"""``lfm-ppl check``: from a results folder to the report, and to the corrected result."""

import shlex
import shutil

import numpy as np
import pandas as pd
import pytest

from lfm_ppl.cli import main
from lfm_ppl.results import arviz_data
from lfm_ppl.results.report import AccuracyReport

WELL = '''"""A double well in noise."""
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("x",)
UNITS = {"x": "nm"}
OPTIONS = {"noise": (0.3, float, "standard deviation of the noise")}


def model(times, y=None, noise=0.3, units=None):
    depth = numpyro.sample("depth", dist.LogNormal(0.0, 0.4))
    system = lfm.LatentForceModel(
        lambda x, u, t: depth * (x - x**3), {}, lfm.GaussianObservation(lambda x, u, t: x, noise**2 * jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.array([[0.7]]), output_names=OUTPUTS, units=units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=10), obs=y)


def simulate(seed=0, noise=0.3):
    y = jnp.array([[0.9], [1.1], [jnp.nan], [-0.8], [-1.2], [-0.7]])
    return lfm.Data(jnp.arange(6.0), y, OUTPUTS, truth={"parameters": {"depth": 1.0}})
'''


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A results folder of the double well, and its model file."""
    folder = tmp_path_factory.mktemp("check")
    file = folder / "well.py"
    file.write_text(WELL)
    line = (f"fit {file} --sampler ram --chains 2 --warmup 100 --samples 100 --option noise=0.25 --steps 12 --quiet "
            f"--out {folder / 'result'}")
    assert main(shlex.split(line)) == 0
    return folder


@pytest.fixture
def fitted(original, tmp_path):
    """A copy of it."""
    return shutil.copytree(original / "result", tmp_path / "result")


@pytest.fixture
def run(capsys):
    """Run the command line; return (exit code, output, errors)."""

    def run_line(line):
        try:
            code = main(shlex.split(line))
        except SystemExit as exit_:
            code = exit_.code
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run_line


def test_check_prints_stores_and_draws(run, fitted):
    before = arviz_data.load(fitted / "posterior.nc")
    code, out, err = run(f"check {fitted} --draws 40")
    assert code == 0, err
    for words in ("grid", "Pareto k", "depth", "verdict", "doubled", "sd over the draws"):
        assert words in out
    for name in ("posterior.nc (group accuracy)", "accuracy.csv", "accuracy.png", "report.html"):
        assert f"wrote    {fitted / name}" in out
    following = AccuracyReport.of(arviz_data.load(fitted / "posterior.nc")).verdict.command
    last = f"next     {following.replace('RESULT', str(fitted))}" if following else f"wrote    {fitted / 'report.html'}"
    assert out.splitlines()[-1] == last
    page = (fitted / "report.html").read_text()
    assert "What the exact likelihood would change" in page and f"lfm-ppl check {fitted} --draws 40</pre>" in page
    after = arviz_data.load(fitted / "posterior.nc")
    assert set(arviz_data.groups(after)) == {*arviz_data.groups(before), "accuracy"}
    for name in arviz_data.groups(before):
        assert arviz_data.group(after, name).identical(arviz_data.group(before, name)), "nothing is lost"
    assert arviz_data.attributes(after) == arviz_data.attributes(before)
    report = AccuracyReport.of(after)
    assert report.log_ratio.shape == (2, 20)
    table = pd.read_csv(fitted / "accuracy.csv", index_col="parameter")
    np.testing.assert_allclose(table.loc["depth", "shift"], report.table.loc["depth", "shift"])
    assert (fitted / "accuracy.png").stat().st_size > 10_000
    code, _, err = run(f"check {fitted} --draws 40")
    assert code == 2 and "accuracy.csv already exists" in err and "--overwrite" in err
    code, out, _ = run(f"plot {fitted} --overwrite")
    assert code == 0 and "accuracy.png" in out


def test_new_chains_follow_a_check_that_asked_for_them(run, fitted, monkeypatch):
    assert run(f"check {fitted} --draws 40 --quiet")[0] == 0
    result = arviz_data.load(fitted / "posterior.nc")
    report = arviz_data.group(result, "accuracy").assign_attrs(pareto_k=0.9, command="lfm-ppl check RESULT --correct")
    arviz_data.save(arviz_data.add_group(result, "accuracy", report), fitted / "posterior.nc", overwrite=True)
    table = (fitted / "accuracy.csv").stat().st_mtime_ns
    asked = []
    monkeypatch.setattr("lfm_ppl.cli.check._correct", lambda task, report, *rest: asked.append(report) or 0)
    monkeypatch.setattr("lfm_ppl.cli.check._checked", lambda *rest: pytest.fail("checked again"))
    code, out, err = run(f"check {fitted} --correct")
    assert code == 0, err
    assert "checked  before: k = 0.9 is not below" in out and asked[0].k == 0.9
    assert (fitted / "accuracy.csv").stat().st_mtime_ns == table
    other = fitted.parent / "other.py"
    other.write_text(WELL.replace("depth * (x - x**3)", "depth * (x - 1.1 * x**3)"))
    code, _, err = run(f"check {fitted} --correct --model {other} --overwrite")
    assert code == 2 and "gives other log likelihoods than the result records" in err


@pytest.mark.slow
def test_correct_writes_a_result_of_its_own(run, fitted):
    (fitted / "corrected").mkdir()
    (fitted / "corrected" / "mine.txt").write_text("keep")
    code, _, err = run(f"check {fitted} --correct")
    assert code == 2 and "holds files" in err
    code, out, err = run(f"check {fitted} --correct --out {fitted / 'better'}")
    assert code == 0, err
    report = AccuracyReport.of(arviz_data.load(fitted / "posterior.nc"))
    corrected = arviz_data.load(fitted / "better" / "posterior.nc")
    attributes = arviz_data.attributes(corrected)
    draws = arviz_data.group(corrected, "posterior")["depth"]
    if report.reliable:
        assert "resampling 200 draws" in out and draws.shape == (2, 100)
        assert attributes["sampler"] == "ram + importance resampling"
    else:
        assert attributes["sampler"] == "pmmh"
    assert attributes["model_file"].endswith("well.py")
    assert arviz_data.has_group(corrected, "truth")
    assert (fitted / "better" / "summary.csv").is_file() and (fitted / "better" / "trace.png").is_file()
    page = (fitted / "better" / "report.html").read_text()
    assert "<pre>lfm-ppl fit " in page and "check" in page.partition("<pre>lfm-ppl fit ")[2].partition("</pre>")[0]
    code, _, err = run(f"check {fitted / 'better'}")
    assert code == 2 and "samples the exact posterior already" in err
    assert (fitted / "corrected" / "mine.txt").read_text() == "keep"


@pytest.mark.slow
@pytest.mark.parametrize("flag, name", [("", ""), (" --delayed", ", delayed acceptance")], ids=["plain", "delayed"])
def test_exact_chains_where_the_weights_are_not_reliable(run, fitted, monkeypatch, flag, name):
    monkeypatch.setattr(AccuracyReport, "reliable", False)
    code, out, err = run(f"check {fitted} --draws 20 --correct --particles 100 --reference particles{flag}")
    assert code == 0, err
    assert f"particle-marginal RAM{name}, 2 chains of 100 warm-up and 100 kept draws" in out
    assert out.splitlines()[-1] == ("done     the corrected posterior (particle-marginal RAM) is in "
                                    f"{fitted / 'corrected'}")
    corrected = arviz_data.load(fitted / "corrected" / "posterior.nc")
    attributes = arviz_data.attributes(corrected)
    assert attributes["sampler"] == "pmmh" and attributes["particles"] == 100
    assert attributes["delayed"] == bool(flag)
    assert attributes["steps"] == 12 and attributes["options"] == '{"noise": 0.25}'
    assert arviz_data.group(corrected, "posterior")["depth"].shape == (2, 100)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("check absent", "there is no result absent"),
        ("check RESULT --reference exact", "unknown reference 'exact'"),
        ("check RESULT --draws 0", "expected a whole number of at least 1, got '0'"),
        ("check RESULT --particles 0", "expected a whole number of at least 1, got '0'"),
        ("check RESULT --out there", "--out names the folder of the corrected result; add --correct"),
        ("check RESULT --delayed", "--delayed is a setting of the corrected result; add --correct"),
        ("check RESULT --model nothing.py", "there is no model file nothing.py"),
        ("check RESULT --model ginzburg-landau", "made with the option 'noise', which"),
    ],
)
def test_mistakes_are_one_line_that_says_what_to_do(run, fitted, line, message):
    before = sorted(path.name for path in fitted.iterdir())
    code, _, err = run(line.replace("RESULT", str(fitted)))
    assert code == 2
    assert err.startswith("lfm-ppl: error: ") and err.count("\n") == 1, err
    assert message in err
    assert sorted(path.name for path in fitted.iterdir()) == before


def rewritten(fitted, drop=(), **attributes):
    result = arviz_data.load(fitted / "posterior.nc")
    groups = {name: arviz_data.group(result, name) for name in arviz_data.groups(result) if name not in drop}
    attrs = {key: value for key, value in {**arviz_data.attributes(result), **attributes}.items() if value is not None}
    arviz_data.save(arviz_data.build(groups, attrs), fitted / "posterior.nc", overwrite=True)


@pytest.mark.slow
def test_a_result_without_its_model_or_its_data(run, fitted, original):
    rewritten(fitted, model_file=None)
    code, _, err = run(f"check {fitted}")
    assert code == 2 and "--model FILE" in err and "lfm.check_accuracy" in err
    assert run(f"check {fitted} --model {original / 'well.py'} --draws 10")[0] == 0
    rewritten(fitted, model_file="/gone/well.py")
    code, _, err = run(f"check {fitted} --overwrite")
    assert code == 2 and "there is no model file /gone/well.py" in err and "name it with --model" in err
    rewritten(fitted, drop=("observed_data",), model_file=str(original / "well.py"))
    code, _, err = run(f"check {fitted} --overwrite")
    assert code == 2 and "no group 'observed_data'" in err


def test_a_model_file_that_has_changed(run, fitted, tmp_path):
    changed = tmp_path / "well.py"
    changed.write_text(WELL.replace("depth * (x - x**3)", "depth * (x - 1.1 * x**3)"))
    code, _, err = run(f"check {fitted} --model {changed} --draws 10")
    assert code == 2 and "gives other log likelihoods than the result records" in err
    changed.write_text(WELL.replace('OUTPUTS = ("x",)', 'OUTPUTS = ("z",)'))
    code, _, err = run(f"check {fitted} --model {changed} --draws 10")
    assert code == 2 and "outputs x" in err
