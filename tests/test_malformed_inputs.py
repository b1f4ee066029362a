"""Malformed input: one line that names what is wrong, exit status 2 or the right exception, and no file changed.

A case is a command line of `lfm-ppl` in a folder with a model, a result and the files of the case, or a call of the
Python API. All of them are refused before anything is sampled.
"""

import shlex

import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd
import pytest
import systems
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.cli import main
from lfm_ppl.results import arviz_data

MODEL = '''"""A double well."""
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("x",)
OPTIONS = {"depth": (1.0, float, "of the wells")}


def model(times, y=None, depth=1.0):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    system = lfm.LatentForceModel(
        lambda x, u, t: depth * (x - x**3), {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        lfm.Gaussian(jnp.array([0.5]), jnp.array([[0.2]])), process_noise=noise * jnp.eye(1))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=1), obs=y)


def simulate(seed=0, **options):
    return lfm.Data(np.arange(4.0), np.array([[0.3], [0.9], [np.nan], [-0.8]]), ("x",))
'''
HEATED = MODEL.replace("OPTIONS", 'INPUTS = {"heater": "previous"}\nOPTIONS').replace(
    "depth=1.0)", "depth=1.0, inputs=None)").replace("depth * (", 'inputs["heater"](t) + depth * (')
GOOD = "time,x\n0,0.3\n1,0.9\n2,\n3,-0.8\n"
DATED = "date,x\n2026-01-05 00:00,0.3\n2026-01-05 01:00,0.9\n"


def edited(old, new):
    """Arguments of a fit of the model file after one replacement."""
    assert old in MODEL
    return "fit bad.py", {"bad.py": MODEL.replace(old, new)}


def table(text, *options):
    """Arguments of a fit to a table."""
    return " ".join(["fit model.py --data d.csv", *options]), {"d.csv": text}


# (command line, files, parts of the message: the offending name, and where it stands)
CASES = [
    # Files.
    ("fit model.py --data missing.csv", {}, "missing.csv"),
    ("fit model.py --data sub", {"sub/d.csv": GOOD}, "sub"),
    (*table(""), "d.csv"),
    (*table("time,x\n"), "d.csv"),
    (*table("time;x\n0;1,5\n"), "d.csv", "time;x"),
    (*table(GOOD.encode("utf-16")), "d.csv", "UTF-8"),
    (*table('time,x\n0,"1\n1,2\n'), "d.csv"),
    (*table("<!DOCTYPE html>\n<html><body>404</body></html>\n"), "d.csv"),
    (*table("time,x,x\n0,1,2\n"), "d.csv", "'x'"),
    (*table("0,1\n1,2\n"), "d.csv", "time"),
    (*table("time,x\n0,1\n1\n"), "d.csv", "3"),
    (*table("time,x\n0,1\n1,high\n"), "3", "'x'", "'high'"),
    (*table("time,x\n0,1e999\n1,2\n"), "2", "'x'", "'1e999'"),
    (*table("time,x\n0,1\n,2\n"), "3", "'time'"),
    (*table("time,x\n0,1\n2,2\n1,3\n"), "4", "2", "1"),
    (*table("time,x\n0,\n1,NA\n"), "x"),
    # Dates.
    (*table("date,x\n2026-02-01,1\n2026-02-30,2\n"), "3", "'date'", "2026-02-30"),
    (*table("date,x\n31.03.2026,1\n01.04.2026,2\n"), "'date'", "31.03.2026"),
    (*table("date,x\n2026-01-01T00:00+01:00,1\n2026-01-02T00:00,2\n"), "3", "UTC"),
    (*table(DATED, "--time-unit fortnight"), "'fortnight'"),
    (*table(DATED, "--until 2025-01-01"), "--until", "2025-01-01"),
    ("fit model.py --until 2026-03-31", {}, "--until", "2026-03-31"),
    ("fit model.py --at 1,later", {}, "--at", "later"),
    # Columns and known inputs.
    (*table(GOOD, "--outputs z"), "'z'"),
    (*table(GOOD, "--time-column hour"), "'hour'"),
    ("fit heated.py --data d.csv --inputs heat", {"d.csv": "time,x,heater\n0,1,1\n1,2,0\n"}, "'heat'", "heater"),
    ("fit heated.py --data d.csv", {"d.csv": "time,x,heater\n0,1,on\n1,2,off\n"}, "2", "'heater'", "'on'"),
    (*table(GOOD, "--truth t.json")[:1], {"d.csv": GOOD, "t.json": "true, or nearly"}, "t.json"),
    # Options.
    ("fit model.py --chains two", {}, "--chains", "two"),
    ("fit model.py --samples 0", {}, "--samples", "0"),
    ("fit model.py --sampler nutz", {}, "nutz", "nuts"),
    ("fit model.py --rule cubatur", {}, "cubatur", "cubature"),
    ("fit model.py --sample 5", {}, "--sample"),
    ("fit", {}, "MODEL"),
    ("fitt model.py", {}, "fitt"),
    ("fit model.py --set nois=1", {}, "'nois'", "noise"),
    ("fit model.py --set noise=-1", {}, "noise", "-1"),
    ("fit model.py --option dept=1", {}, "'dept'", "'depth'"),
    ("fit model.py --lower depth=0", {}, "'depth'", "x0"),
    ("fit model.py --lower x0=1 --upper x0=0", {}, "x0", "1", "0"),
    # Model files.
    ("fit transcripton", {}, "'transcripton'", "'transcription'"),
    ("fit gone.py", {}, "gone.py"),
    ("fit bad.py", {"bad.py": "\ndef model(:\n"}, "bad.py", "line 2", "SyntaxError"),
    ("fit bad.py", {"bad.py": "import sys\nsys.exit(0)\n"}, "bad.py", "line 2", "SystemExit"),
    ("fit bad.py", {"bad.py": "model = 3\n"}, "bad.py", "model"),
    (*edited('OUTPUTS = ("x",)', 'OUTPUTS = "x"'), "bad.py", "OUTPUTS"),
    (*edited("depth * (x - x**3)", "nois"), "bad.py", "line", "NameError", "nois"),
    (*edited("depth * (x - x**3)", "np.asarray(x)"), "dynamics", "jax.numpy"),
    (*edited("depth * (x - x**3)", "jnp.concatenate([x, x])"), "dynamics", "(2,)", "(1,)"),
    (*edited("jnp.array([0.1])", "jnp.array([-0.1])"), "variance"),
    (*edited(", obs=y", ""), "obs=y"),
    (*edited("def simulate", "def simulated"), "bad.py", "simulate"),
    # Folders of results.
    ("fit model.py --out out", {"out": "a file"}, "out"),
    ("fit model.py --out out", {"out/mine.txt": "a file"}, "out", "--overwrite"),
    ("fit model.py --out out --resume", {"out/checkpoint/run.json": '{"sampler": "nuts", "seed": 5}'}, "out", "seed"),
    ("fit model.py --each --data 'sub/*.csv'", {"sub/a.csv": "", "sub/b.csv": "time;x\n0;1\n"}, "a"),
    ("check gone", {}, "gone"),
    ("plot bad.nc", {"bad.nc": b"CDF\x01\x00\x00"}, "bad.nc"),
    ("check result --model other.py", {"other.py": MODEL.replace('"noise"', '"scale"')}, "'scale'"),
    ("forecast result --until 1", {}, "--until", "3"),
    ("new model.py", {}, "model.py"),
    ("compare ballistik", {}, "'ballistik'", "'ballistic'"),
]


def contents(folder):
    """Return name -> bytes and time of change of all files of a folder."""
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.rglob("*") if path.is_file()}


def result():
    """A result as `fit` writes it, of draws that nobody sampled."""
    noise = np.exp(0.3 * np.random.default_rng(0).normal(size=(2, 50)) - 0.5)
    return arviz_data.build({
        "posterior": xr.Dataset({"noise": (("chain", "draw"), noise)}),
        "data": xr.Dataset({"y": (("time", "output"), Y)}, {"time": T, "output": ["x"]})}, {
        "model": "model", "model_file": "model.py", "rule": "Cubature()", "steps": 1, "iterations": 3,
        "sampler": "nuts", "chains": 2, "warmup": 50, "samples": 50, "seed": 0, "fixed": "{}", "options": "{}",
        "settings": '{"rule": null, "steps": null, "max_step": null, "iterations": null, "tolerance": null}'})


@pytest.fixture(scope="module")
def result_file(tmp_path_factory):
    return arviz_data.save(result(), tmp_path_factory.mktemp("result") / "posterior.nc").read_bytes()


@pytest.fixture
def folder(tmp_path, monkeypatch, result_file):
    """The working folder, with models and a result."""
    put(tmp_path, {"model.py": MODEL, "heated.py": HEATED, "result/posterior.nc": result_file})
    monkeypatch.chdir(tmp_path)
    return tmp_path


def put(folder, files):
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


@pytest.mark.parametrize("case", CASES, ids=lambda case: case[0])
def test_command_lines(case, folder, capsys):
    line, files, *parts = case
    put(folder, files)
    initial_contents = contents(folder)
    try:
        status = main(shlex.split(line))
    except SystemExit as error:
        status = error.code
    message = capsys.readouterr().err
    assert status == 2, message
    assert message.count("\n") == 1 and message.endswith("\n") and "Traceback" not in message, message
    assert [part for part in parts if part not in message] == [], message
    assert contents(folder) == initial_contents


T, Y = np.arange(4.0), np.array([[0.3], [0.9], [np.nan], [-0.8]])


def well(times, y=None):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    numpyro.sample("y", lfm.MarginalLikelihood(systems.double_well(dispersion=noise, noise=0.1), times, steps=1), obs=y)


def linear(**changes):
    return lfm.LatentForceModel(**{
        "dynamics": lambda x, u, t: -x, "forces": {}, "initial_state": lfm.Gaussian([0.0], [1.0]),
        "observation": lfm.GaussianObservation(lambda x, u, t: x, np.ones(1)), "process_noise": np.eye(1), **changes})


# (call, exception, parts of the message)
CALLS = [
    (lambda: lfm.Data([1.0, 0.0], [[1.0], [2.0]], ("x",)), ValueError, "1"),
    (lambda: lfm.Data(T, Y, ("x", "z")), ValueError, "(4, 2)", "(4, 1)"),
    (lambda: lfm.read_table([1, 2]), TypeError, "list"),
    (lambda: lfm.read_table(pd.DataFrame([[0, 1, 2]], columns=["time", "x", "x"])), ValueError, "'x'"),
    (lambda: lfm.read_csv("gone.csv"), OSError, "gone.csv"),
    (lambda: lfm.load("model.py"), ValueError, "model.py"),
    (lambda: lfm.save(result(), "result/posterior.nc"), OSError, "posterior.nc", "overwrite=True"),
    (lambda: lfm.fit(well, T), TypeError, "y"),
    (lambda: lfm.fit(well, T, Y[:3]), ValueError, "(3, 1)"),
    (lambda: lfm.fit(well, T, np.where(np.isnan(Y), np.inf, Y)), ValueError, "y[2, 0]"),
    (lambda: lfm.fit(well, T, Y, sampler="nutz"), ValueError, "'nutz'", "'nuts'"),
    (lambda: lfm.fit(well, T, Y, fixed={"nois": 1.0}), ValueError, "'nois'", "'noise'"),
    (lambda: lfm.fit(well, T, Y, checkpoint="result"), OSError, "result"),
    (lambda: lfm.fit(well, T, Y, at=[-5.0]), ValueError, "at[0]", "-5"),
    (lambda: lfm.fit_many(well, {"a": 3.0}), TypeError, "'a'"),
    (lambda: lfm.forecast(result(), well, [[5.0]]), ValueError, "times", "(1, 1)"),
    (lambda: linear(dynamics="-x"), TypeError, "dynamics"),
    (lambda: linear(initial_state=lfm.Gaussian([0.0], [[-1.0]])), ValueError, "initial_state"),
    (lambda: lfm.Matern(1.0, 1.0, order=9), ValueError, "order", "9"),
    (lambda: lfm.Input([0.0, 1.0], [1.0, 2.0], "cubic"), ValueError, "'cubic'"),
    (lambda: lfm.MarginalLikelihood(linear(), T, rule="cubature"), TypeError, "rule"),
    (lambda: lfm.simulate(0, linear(), T), TypeError, "key"),
]


@pytest.mark.parametrize("case", CALLS)
def test_calls(case, folder):
    call, error, *parts = case
    initial_contents = contents(folder)
    with pytest.raises(error) as raised:
        call()
    message = str(raised.value)
    assert "\n" not in message and [part for part in parts if part not in message] == [], message
    assert contents(folder) == initial_contents
