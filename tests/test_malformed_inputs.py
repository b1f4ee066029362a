"""What a user gets wrong: one line that says what, where and what to do; status 2; nothing written, nothing lost.

Each case is a command line of `lfm-ppl` in a folder with a model, a result and the files of the case, or a call of the
Python API. No case gets as far as sampling: what is wrong is said before that.
"""

import os
import shlex
from pathlib import Path
from typing import NamedTuple

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

HEAD = '''"""A double well."""
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm
'''

BODY = '''
OUTPUTS = ("x",)
OPTIONS = {"depth": (1.0, float, "of the wells"), "kind": ("even", ("even", "odd"), "of well")}


def system(noise, depth=1.0, dynamics=None, observation=None, variance=0.1 * jnp.ones(1), start=None, forces=None):
    return lfm.LatentForceModel(
        dynamics or (lambda x, u, t: depth * (x - x**3)), {} if forces is None else forces,
        lfm.GaussianObservation(observation or (lambda x, u, t: x), variance),
        start or lfm.Gaussian(jnp.array([0.5]), jnp.array([[0.2]])), process_noise=noise * jnp.eye(1))


def model(times, y=None, depth=1.0, kind="even"):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    numpyro.sample("y", lfm.MarginalLikelihood(system(noise, depth), times, steps=1), obs=y)
'''

SIMULATE = '''

def simulate(seed=0, **options):
    return lfm.Data(np.arange(4.0), np.array([[0.3], [0.9], [np.nan], [-0.8]]), ("x",))
'''

MODEL = HEAD + BODY + SIMULATE

HEATED = HEAD + '''
OUTPUTS = ("x",)
INPUTS = {"heater": "previous"}


def model(times, y=None, inputs=None):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    system = lfm.LatentForceModel(
        lambda x, u, t: inputs["heater"](t) - x, {}, lfm.GaussianObservation(lambda x, u, t: x, 0.1 * jnp.ones(1)),
        lfm.Gaussian(jnp.array([0.5]), jnp.array([[0.2]])), process_noise=noise * jnp.eye(1))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=1), obs=y)
'''


def with_model(text, simulate=SIMULATE):
    """A model file whose `model` is another one."""
    return HEAD + BODY + "\n\n" + text + simulate


def sampled(arguments):
    """A model file of which one argument of `system` is wrong."""
    return with_model(f'''def model(times, y=None, **options):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    numpyro.sample("y", lfm.MarginalLikelihood(system(noise, {arguments}), times, steps=1), obs=y)
''')


class Case(NamedTuple):
    """A command line that is wrong, and the words that must be said of it."""

    line: str
    words: tuple[str, ...]
    files: dict[str, str | bytes] = {}
    status: int = 2


def csv(text, *words, line="fit model.py --data d.csv"):
    return Case(line, words, {"d.csv": text})


GOOD = "time,x\n0,0.3\n1,0.9\n2,\n3,-0.8\n"
DATED = "date,x\n2026-01-05 00:00,0.3\n2026-01-05 01:00,0.9\n2026-01-05 02:00,0.1\n"
WARM = "time,x,heater,other\n0,0.3,1,2\n1,0.9,0,2\n2,0.1,1,2\n"

FILES = {
    "there is no file": csv("", "there is no file missing.csv", line="fit model.py --data missing.csv"),
    "a folder": Case("fit model.py --data sub", ("sub: Is a directory",), {"sub/d.csv": GOOD}),
    "no name": Case("fit model.py --data ''", ("--data: expected FILE, got ''",)),
    "a link to itself": Case("fit model.py --data loop.csv", ("loop.csv: Too many levels of symbolic links",),
                             {"loop.csv": "-> loop.csv"}),
    "a link to nothing": Case("fit model.py --data link.csv", ("there is no file link.csv",), {"link.csv": "-> gone"}),
    "a name too long": Case(f"fit model.py --data {'d' * 300}.csv", ("name too long",)),
    "empty": csv("", "d.csv is empty; expected a header row"),
    "blank lines": csv("\n\n \n", "d.csv is empty"),
    "comments": csv("# time,x\n# 0,1\n", "d.csv is empty"),
    "a header": csv("time,x\n", "d.csv has a header and no rows"),
    "semicolons": csv("time;x\n0;1\n", "'time;x'", "Export it as comma-separated"),
    "semicolons and decimal commas": csv("time;x\n0;1,5\n1;2,5\n", "'time;x'"),
    "tabs": csv("time\tx\n0\t1\n", "commas"),
    "spaces": csv("time x\n0 1\n", "'time x'"),
    "bars": csv("time|x\n0|1\n", "'time|x'"),
    "UTF-16": csv(GOOD.encode("utf-16"), "d.csv is not a comma-separated text file (UTF-8)"),
    "Latin-1": csv("time,x\n0,1\n# caf\xe9\n".encode("latin-1"), "(UTF-8)"),
    "zero bytes": csv(b"time,x\n0,\x00\x00\n", "d.csv", "x"),
    "gzip": csv(b"\x1f\x8b\x08\x00abc\xff\xfe", "not a comma-separated text file"),
    "a spreadsheet": csv(b"PK\x03\x04\x14\x00\x06\x00\xff\xfe", "not a comma-separated text file"),
    "an open quote": csv('time,x\n0,"1\n1,2\n', "not a comma-separated text file"),
    "a cell of a book": csv("time,x\n0," + "9" * 200_000 + "\n", "not a comma-separated text file"),
    "JSON": csv('[{"time": 0, "x": 1},\n {"time": 1, "x": 2}]\n', "d.csv"),
    "HTML": csv("<!DOCTYPE html>\n<html><body>404</body></html>\n", "d.csv", "comma-separated"),
    "a name twice": csv("time,x,x\n0,1,2\n", "the column name 'x' stands 2 times (columns 2, 3)"),
    "two times": csv("time,x,time\n0,1,2\n", "the column name 'time' stands 2 times"),
    "columns without a name": csv("time,x,,\n0,1,,\n", "columns 3, 4", "name"),
    "no header": csv("0,1\n1,2\n", "d.csv has no time column", "0, 1"),
    "a short row": csv("time,x\n0,1\n1\n", "row 3: 1 cells, but the header has 2 columns",
                       "Leave a missing value empty"),
    "a long row": csv("time,x\n0,1\n1,2,3\n", "row 3: 3 cells"),
    "decimal commas": csv("time,x\n0,1,5\n1,2,5\n", "row 2: 3 cells", "decimals with a point"),
    "text": csv("time,x\n0,1\n1,high\n", "row 3, column 'x'", "got 'high'"),
    "a unit in a cell": csv("time,x\n0,1\n1,3.2 mg\n", "row 3, column 'x'", "got '3.2 mg'"),
    "per cent": csv("time,x\n0,5%\n1,1\n", "row 2, column 'x'", "got '5%'"),
    "a quoted decimal comma": csv('time,x\n0,"1,5"\n1,2\n', "row 2, column 'x'", "got '1,5'"),
    "a question mark": csv("time,x\n0,1\n1,?\n", "row 3, column 'x'", "an empty cell"),
    "hexadecimal": csv("time,x\n0,0x10\n1,2\n", "got '0x10'"),
    "complex": csv("time,x\n0,1+2j\n1,2\n", "got '1+2j'"),
    "true": csv("time,x\n0,TRUE\n1,2\n", "got 'TRUE'"),
    "infinite": csv("time,x\n0,inf\n1,2\n", "row 2, column 'x': expected a finite number, got 'inf'"),
    "minus infinite": csv("time,x\n0,1\n1,-inf\n", "row 3, column 'x'", "finite"),
    "too large": csv("time,x\n0,1e999\n1,2\n", "finite number, got '1e999'"),
    "units below the header": csv("time,x\ns,nm\n0,1\n", "row 2, column 'time'", "got 's'"),
    "two files in one": csv("time,x\n0,1\ntime,x\n1,2\n", "row 3, column 'time'", "got 'time'"),
    "a time left out": csv("time,x\n0,1\n,2\n", "row 3, column 'time': the time is missing"),
    "a time NaN": csv("time,x\nnan,1\n1,2\n", "row 2, column 'time': the time is missing"),
    "a time in words": csv("time,x\nnoon,1\n1,2\n", "row 2, column 'time'", "got 'noon'"),
    "a time infinite": csv("time,x\n0,1\ninf,2\n", "row 3, column 'time'", "finite"),
    "a time goes back": csv("time,x\n0,1\n2,2\n1,3\n", "row 4: the time goes back from 2 to 1", "Sort the rows"),
    "dates go back": csv("date,x\n2026-01-02,1\n2026-01-01,2\n", "row 3: the time goes back from 2026-01-02"),
    "dates and numbers": csv("time,x\n2026-01-01,1\n3,2\n", "row 3, column 'time': expected a date"),
    "numbers and dates": csv("time,x\n3,1\n2026-01-01,2\n", "row 3, column 'time'", "2026-01-01"),
    "no such day": csv("date,x\n2026-02-01,1\n2026-02-30,2\n", "row 3, column 'date': expected a date"),
    "no such first day": csv("date,x\n2026-02-30,1\n2026-03-01,2\n", "row 2, column 'date'", "date"),
    "a year of zero": csv("date,x\n2026-02-01,1\n0000-00-00,2\n", "row 3, column 'date'"),
    "an hour of 25": csv("date,x\n2026-02-01 10:00,1\n2026-02-01 25:00,2\n", "row 3, column 'date'"),
    "a German date": csv("date,x\n31.03.2026,1\n01.04.2026,2\n", "row 2, column 'date'", "2026-03-31"),
    "an American date": csv("date,x\n03/31/2026,1\n04/01/2026,2\n", "row 2, column 'date'", "2026-03-31"),
    "some offsets": csv("date,x\n2026-01-01T00:00+01:00,1\n2026-01-02T00:00,2\n", "row 3", "with an offset from UTC"),
    "several times": csv("time,t,x\n0,0,1\n1,1,2\n", "several time columns: time, t", "--time-column"),
    "several dates": csv("start,end,x\n2026-01-01,2026-01-02,1\n", "several time columns: start, end"),
    "no time": csv("clock,x\n0,1\n1,2\n", "has no time column", "clock, x", "--time-column"),
    "no such output": csv("time,X1\n0,1\n1,2\n", "unknown output column 'x'", "Known: X1"),
    "nothing seen": csv("time,x\n0,\n1,NA\n", "every value of x is missing"),
    "the time alone": Case("fit free.py --data d.csv", ("d.csv, row 1", "'time'"),
                           {"d.csv": "time\n0\n1\n", "free.py": MODEL.replace('OUTPUTS = ("x",)', "OUTPUTS = None")}),
    "nothing between": csv("time,x\n\n\n", "a header and no rows"),
}

COLUMNS = {
    "no such output": csv(GOOD, "unknown output column 'z'", line="fit model.py --data d.csv --outputs z"),
    "no output": csv(GOOD, "output", line="fit model.py --data d.csv --outputs ''"),
    "too many outputs": csv(GOOD, "model has 1 output (x)", "--outputs names 2 columns",
                            line="fit model.py --data d.csv --outputs x,z"),
    "an output twice": Case("fit free.py --data d.csv --outputs x,x", ("each column once",),
                            {"d.csv": GOOD, "free.py": MODEL.replace('OUTPUTS = ("x",)', "OUTPUTS = None")}),
    "the time as an output": csv(GOOD, "unknown output column 'time'", line="fit model.py --data d.csv --outputs time"),
    "no such time": csv(GOOD, "unknown time column 'hour'", line="fit model.py --data d.csv --time-column hour"),
    "an output as the time": csv("time,x\n0,2\n1,1\n", "unknown output column 'x'", "Known: time",
                                 line="fit model.py --data d.csv "
                                 "--time-column x"),
    "no such unit": csv(DATED, "unknown unit of time 'fortnight'", "h",
                        line="fit model.py --data d.csv --time-unit fortnight"),
    "no such unit of the model": Case(
        "fit weekly.py --data d.csv", ("weekly.py says that time is in 'fortnight'", "--time-unit", "d.csv"),
        {"d.csv": DATED, "weekly.py": MODEL + '\nUNITS = {"time": "fortnight"}\n'}),
    "no such unit of the model, in series": Case(
        "fit weekly.py --data d.csv --series who", ("weekly.py says that time is in 'fortnight'", "--time-unit"),
        {"d.csv": DATED.replace("x\n", "x,who\n", 1).replace("0.3", "0.3,a").replace("0.9", "0.9,a").replace(
            "0.1", "0.1,a"), "weekly.py": MODEL + '\nUNITS = {"time": "fortnight"}\n'}),
    "a decimal comma": csv('time,x\n0,"7,77"\n1,2\n', "row 2", "a point, 7.77"),
    "a limit": csv("time,x\n0,<5\n1,2\n", "row 2", "lfm.CensoredObservation"),
    "another unit": csv("time_h,x\n0,1\n1,2\n", "its unit is h", "--time-unit",
                        line="fit model.py --data d.csv --time-unit s"),
    "no such input": csv(WARM, "unknown input column 'heat'", "heater",
                         line="fit heated.py --data d.csv --inputs heat"),
    "an input of another name": Case(
        "fit heated3.py --data d.csv", ("heated3.py, line", "reads the known input 'heatr', and has heater"),
        {"d.csv": WARM, "heated3.py": HEATED.replace('inputs["heater"]', 'inputs["heatr"]')}),
    "no such way": csv(WARM, "interpolation of heater", "cubic",
                       line="fit heated.py --data d.csv --inputs heater:cubic"),
    "too many inputs": csv(WARM, "takes 1 known input (heater)", "--inputs names 2",
                           line="fit heated.py --data d.csv --inputs heater,other"),
    "no input named": csv(WARM, "--inputs", line="fit heated.py --data d.csv --inputs ''"),
    "no input of this model": csv(WARM, "no argument `inputs`", line="fit model.py --data d.csv --inputs heater"),
    "an input and an output": csv(WARM, "as an output or an input", "['x']",
                                  line="fit heated.py --data d.csv --inputs x"),
    "an input left out": csv(GOOD, "unknown input column 'heater'", "Known: x", line="fit heated.py --data d.csv"),
    "an input in words": csv("time,x,heater\n0,1,on\n1,2,off\n", "row 2, column 'heater'", "got 'on'",
                             line="fit heated.py --data d.csv"),
    "an input begins late": csv("time,x,heater\n0,1,\n1,2,1\n", "no value at the first time; fill the cell",
                                line="fit heated.py --data d.csv"),
    "an input has two values": csv("time,x,heater\n0,1,0\n0,2,1\n", "column 'heater'", "another value at the same time",
                                   line="fit heated.py --data d.csv"),
    "a model without its input": Case("fit heated2.py", ("needs the known input 'heater'",),
                                      {"heated2.py": HEATED + SIMULATE}),
    "a truth left out": csv(GOOD, "there is no file gone.json", line="fit model.py --data d.csv --truth gone.json"),
    "a truth of words": Case("fit model.py --data d.csv --truth t.json", ("t.json is not a truth file",),
                             {"d.csv": GOOD, "t.json": "true, or nearly"}),
    "a truth of bytes": Case("fit model.py --data d.csv --truth t.json", ("t.json is not a truth file",),
                             {"d.csv": GOOD, "t.json": b"\xff\xfe\x00"}),
    "a list of truths": Case("fit model.py --data d.csv --truth t.json", ("t.json is not a truth file",),
                             {"d.csv": GOOD, "t.json": "[1, 2]"}),
    "a ragged truth": Case("fit model.py --data d.csv --truth t.json", ("t.json is not a truth file",),
                           {"d.csv": GOOD, "t.json": '{"state": [[1], [2, 3]]}'}),
    **{f"a truth: {text}": Case("fit model.py --data d.csv --truth t.json", ("t.json is not a truth file", *said),
                                {"d.csv": GOOD, "t.json": text}) for text, said in {
        '{"times": [0, 1], "force": {"u": [1, 2]}}': ("unknown entry 'force'", "'forces'"),
        '{"times": [0, 1, 2], "forces": {"u": [1, 2]}}': ('"u" of "forces" must hold 3 values', "(2,)"),
        '{"times": [0, 1, 2], "forces": [1, 2, 3]}': ('"forces" must be a mapping', "list"),
        '{"times": [0, 1, 2], "state": [[1], [2]]}': ('"state" must hold 3 rows', "(2, 1)"),
        '{"times": 1, "forces": {"u": [1]}}': ('"times" must be finite numbers, one after the other',),
        '{"forces": [], "parameters": {}}': ('"forces" must be a mapping', "list"),
        '{"times": [0, 1], "state": [1, 2]}': ('"state" must hold 2 rows of states', "(2,)"),
        '{"deterministics": {"rate": [1, 2]}}': ('"rate" of "deterministics" must hold 0 values',),
        '{"times": ["2020-01-01"], "forces": {}}': ('"times" must be numbers',),
        '{"parameters": {"noise": "little"}}': ('"noise" of "parameters" must be numbers',)}.items()},
    **{f"--{flag} without a file": Case(f"fit model.py --{flag} {value}", (f"--{flag} is about a data file",
                                                                        "--data"))
       for flag, value in (("outputs", "x"), ("inputs", "x"), ("time-column", "t"), ("time-unit", "h"),
                           ("truth", "t.json"))},
}

TIMES = {
    "a word": Case("fit model.py --until later", ("--until: expected a number or a date", "'later'")),
    "before the last": Case("fit model.py --until 2", ("--until takes a time after the last observation, at 3",)),
    "the last": Case("fit model.py --until 3", ("after the last observation",)),
    "NaN": Case("fit model.py --until nan", ("--until takes a time after",)),
    "infinite": Case("fit model.py --until inf", ("--until takes a time after",)),
    "a date for numbers": Case("fit model.py --until 2026-03-31", ("plain numbers", "'2026-03-31'")),
    "a number like a date": csv(DATED, "--until", "2026-03-31", line="fit model.py --data d.csv --until 20260331"),
    "an offset for none": csv(DATED, "has an offset from UTC",
                              line="fit model.py --data d.csv --until 2026-02-01T00+01:00"),
    "a date long gone": csv(DATED, "--until takes a time after", line="fit model.py --data d.csv --until 2025-01-01"),
    "no such date": csv(DATED, "--until: expected", "2026-02-30", line="fit model.py --data d.csv --until 2026-02-30"),
    "words": Case("fit model.py --at now", ("--at: expected a number or a date", "Separate times by commas")),
    "a comma too many": Case("fit model.py --at 1,,2", ("--at",)),
    "semicolons": Case("fit model.py --at '1;2'", ("--at: expected", "Separate times by commas")),
    "infinite times": Case("fit model.py --at 1,inf", ("--at takes finite times",)),
    "no times": Case("fit model.py --at ''", ("--at",)),
    "no time": Case("fit model.py --until ''", ("--until",)),
    "before the start": Case("fit model.py --at -5", ("-5",)),
}

OPTIONS = {
    **{f"{flag} {value}": Case(f"fit model.py {flag} {value}", (flag, repr(value)))
       for flag, value in (("--chains", "0"), ("--chains", "two"), ("--chains", "2.5"), ("--samples", "0"),
                           ("--samples", "1e3"), ("--thin", "0"), ("--seed", "1.5"), ("--target-accept", "1.5"),
                           ("--target-accept", "0"), ("--particles", "0"), ("--steps", "0"), ("--steps", "many"),
                           ("--max-step", "0"), ("--max-step", "nan"), ("--iterations", "0.5"), ("--jobs", "0"))},
    **{f"{flag}={value}": Case(f"fit model.py {flag}={value}", (flag, repr(value)))
       for flag, value in (("--chains", "-1"), ("--warmup", "-5"), ("--seed", "-1"), ("--tolerance", "-1"))},
    "no such sampler": Case("fit model.py --sampler nutz", ("unknown sampler 'nutz'", "nuts")),
    "no such rule": Case("fit model.py --rule cubatur", ("unknown rule 'cubatur'", "cubature")),
    "the start of map": Case("fit model.py --sampler map --init map", ("--init sets the starting points",)),
    "acceptance of map": Case("fit model.py --sampler map --target-accept 0.9",
                              ("--target-accept is for the samplers",)),
    "particles of nuts": Case("fit model.py --particles 50", ("--particles is for the sampler pmmh",)),
    "a flag without a value": Case("fit model.py --samples", ("--samples", "expected one argument")),
    "no such flag": Case("fit model.py --sample 5", ("--sample 5", "Did you mean --samples", "fit --help")),
    "a flag cut short": Case("fit model.py --samp 5", ("unrecognized arguments", "--samp")),
    "no model": Case("fit", ("required", "MODEL")),
    "two models": Case("fit model.py heated.py", ("unrecognized arguments", "heated.py")),
    "no command": Case("", ("required", "COMMAND")),
    "no such command": Case("fitt model.py", ("'fitt'", "fit")),
    "nothing set": Case("fit model.py --set noise", ("--set takes NAME=VALUE, got 'noise'",)),
    "set to nothing": Case("fit model.py --set noise=", ("--set takes NAME=VALUE",)),
    "no such parameter": Case("fit model.py --set nois=1", ("'nois'", "noise")),
    "no such element": Case("fit model.py --set noise[3]=1", ("error: noise has shape ()", "Fix it as a whole")),
    "a parameter in words": Case("fit model.py --set noise=low", ("--set noise: expected a number", "'low'")),
    "a parameter NaN": Case("fit model.py --set noise=nan", ("--set noise must be finite",)),
    "a parameter below zero": Case("fit model.py --set noise=-1",
                                   ("error: noise cannot be fixed at -1.0", "its prior allows > 0")),
    "a parameter too long": Case("fit model.py --set noise=1,2", ("error: noise has shape ()", "(2,)")),
    "free already": Case("fit model.py --set noise=free", ("the model does not fix noise", "none")),
    "nothing left": Case("fit model.py --set noise=1", ("no latent site", "Give at least one parameter a prior")),
    "a file without its ending": Case("fit model", ("unknown model 'model'", "Did you mean the file model.py?")),
    "no such option": Case("fit model.py --option dept=1", ("unknown option of model 'dept'", "'depth'")),
    "an option without a value": Case("fit model.py --option depth", ("--option takes NAME=VALUE, got 'depth'",)),
    "an option in words": Case("fit model.py --option depth=deep", ("option depth of model", "float", "'deep'")),
    "no such choice": Case("fit model.py --option kind=strange",
                           ("unknown value of option kind 'strange'", "even, odd")),
}

BOUNDS = {
    "no bound": Case("fit model.py --lower x0", ("--lower takes NAME=VALUE, got 'x0'",)),
    "no value": Case("fit model.py --upper x0=", ("--upper takes NAME=",)),
    "words": Case("fit model.py --lower x0=none", ("--lower takes NAME=NUMBER, got 'x0=none'",)),
    "NaN": Case("fit model.py --lower x0=nan", ("lower['x0'] must be finite",)),
    "infinite": Case("fit model.py --upper x0=inf", ("upper['x0'] must be finite", "Leave a quantity")),
    "twice": Case("fit model.py --lower x0=0 --lower x0=1", ("--lower gives x0 two bounds, 0 and 1",)),
    "no such name": Case("fit model.py --lower depth=0", ("unknown name in lower 'depth'", "x0")),
    "nothing between": Case("fit model.py --lower x0=1 --upper x0=0",
                            ("leave nothing between them: lower=1, upper=0",)),
    "iterations": Case("fit model.py --lower x0=-3 --iterations 2", ("Leave iterations out",)),
    "a tolerance": Case("fit model.py --lower x0=-3 --tolerance 0.1", ("tolerance is not supported", "raise steps")),
    "particles": Case("fit model.py --lower x0=-3 --sampler pmmh", ("--lower and --upper are for the samplers",)),
    "rows of nothing": Case("fit model.py --grid 20", ("--grid is the number of times",)),
    **{f"rows: {value}": Case(f"fit model.py --lower x0=-3 --grid {value}", (
        "--grid: expected a whole number of at least 2", repr(value))) for value in ("1", "0", "2.5", "many", "1e3")},
    "many fits": Case("fit model.py --each --data d.csv --grid 20", ("--grid is the number of times",),
                      {"d.csv": GOOD}),
}

RUN = '{"sampler": "nuts", "seed": 5}'
RESULTS_OF_FIT = {
    "a file": Case("fit model.py --out out", ("out is a file; expected the name of a folder",), {"out": "keep"}),
    "below a file": Case("fit model.py --out out/run", ("out is a file", "--out"), {"out": "keep"}),
    "files": Case("fit model.py --out out", ("holds files.", "--overwrite"), {"out/mine.txt": "keep"}),
    "a result": Case("fit model.py --out result", ("result holds a result.", "--overwrite")),
    "a run": Case("fit model.py --out out", ("out holds an unfinished run.", "--resume"),
                  {"out/checkpoint/run.json": RUN}),
    "nowhere to write": Case("fit model.py --out /proc/out", ("cannot write results into /proc/out", "--out")),
    "a bad default": Case("fit model.py", ("cannot make the folder lfm-results/model-001", "--out"),
                          {"lfm-results": "keep"}),
    "resume without a folder": Case("fit model.py --resume", ("name the folder with --out",)),
    "resume and overwrite": Case("fit model.py --out out --resume --overwrite", ("give one of them",)),
    "resume other files": Case("fit model.py --out out --resume", ("holds files, but no run to resume",),
                               {"out/mine.txt": "keep"}),
    "resume a file": Case("fit model.py --out out --resume", ("out is a file",), {"out": "keep"}),
    "resume another run": Case("fit model.py --out out --resume",
                               ("cannot resume the run in out", "seed was 5 and is 0"),
                               {"out/checkpoint/run.json": RUN}),
    "resume a broken record": Case("fit model.py --out out --resume", ("out/checkpoint/run.json",),
                                   {"out/checkpoint/run.json": '{"sampler": "nu'}),
    "resume a record of words": Case("fit model.py --out out --resume", ("out/checkpoint/run.json",),
                                     {"out/checkpoint/run.json": "7"}),
    "resume another's result": Case("fit model.py --out result --resume", ("has no record of its run",)),
    "resume a broken result": Case("fit model.py --out out --resume", ("posterior.nc could not be read",),
                                   {"out/posterior.nc": b"\x89HDF\r\n\x1a\n cut"}),
}

MANY = {
    "jobs for one": Case("fit model.py --jobs 2", ("--jobs and --scheduler are for many data sets",)),
    "a scheduler for one": Case("fit model.py --scheduler tcp://a:1", ("are for many data sets",)),
    "each of none": Case("fit model.py --each", ("a pattern of files",)),
    "each of a folder": Case("fit model.py --each --data sub", ("sub is a folder; its files are 'sub/*.csv'",),
                             {"sub/d.csv": GOOD}),
    "no match": Case("fit model.py --each --data 'sub/*.txt'", ("no file matches --data 'sub/*.txt'",)),
    "each and series": Case("fit model.py --each --series name --data d.csv", ("not allowed with",)),
    "no such series": csv("time,x,id\n0,1,a\n", "unknown column of series 'patient'",
                          line="fit model.py --data d.csv --series patient"),
    "a series without a name": csv("time,x,id\n0,1,a\n1,2,\n",
                                   "row 3, column 'id': the identifier of the series is missing",
                                   line="fit model.py --data d.csv --series id"),
    "a series of nothing": csv("time,x,id\n0,1,a\n1,,b\n", "every value of x of series 'b' is missing",
                               line="fit model.py --data d.csv --series id"),
    "a series goes back": csv("time,x,id\n1,1,a\n0,2,b\n0,3,a\n", "row 4: the time goes back",
                              line="fit model.py --data d.csv --series id"),
    "jobs and a scheduler": csv(GOOD, "Give one of --jobs and --scheduler",
                                line="fit model.py --each --data d.csv --jobs 2 --scheduler tcp://a:1"),
    "an address": csv(GOOD, "scheduler", line="fit model.py --each --data d.csv --scheduler nowhere"),
    "truths": csv(GOOD, "--truth is for one data set", line="fit model.py --each --data d.csv --truth t.json"),
    "resume and overwrite": csv(GOOD, "give one of them", line="fit model.py --each --data d.csv --resume --overwrite"),
    "other columns": Case("fit free.py --each --data 'sub/*.csv'",
                          ("sub/b.csv has the columns z, but a has x", "--outputs"),
                          {"sub/a.csv": GOOD, "sub/b.csv": GOOD.replace("x", "z"),
                           "free.py": MODEL.replace('OUTPUTS = ("x",)', "OUTPUTS = None")}),
    "none is good": Case("fit model.py --each --data 'sub/*.csv'", ("no data set can be used (2 failed)", "a: "),
                         {"sub/a.csv": "", "sub/b.csv": "time;x\n0;1\n"}),
    "other units": Case("fit model.py --each --data 'sub/*.csv'", ("the times of b are in d, the times of a in h",
                                                                   "--time-unit"),
                        {"sub/a.csv": DATED, "sub/b.csv": "date,x\n2026-01-01,1\n2026-01-02,2\n"}),
    "a file for the results": csv(GOOD, "out is a file", line="fit model.py --each --data d.csv --out d.csv")._replace(
        words=("d.csv is a file",)),
}

MODELS = {
    "no such model": Case("fit transcripton", ("unknown model 'transcripton'", "'transcription'", "./transcripton.py")),
    "no such file": Case("fit gone.py", ("there is no model file gone.py",)),
    "a folder": Case("fit sub.py", ("sub.py",), {"sub.py/keep.txt": "keep"}),
    "a notebook": Case("fit ./model.ipynb", ("model.ipynb", "Python file"), {"model.ipynb": "{}"}),
    "a CSV file": Case("fit ./d.csv", ("d.csv", "Python file"), {"d.csv": GOOD}),
    "no name": Case("fit ''", ("expected MODEL, got ''",)),
    "syntax": Case("fit bad.py", ("bad.py does not run: line 2: SyntaxError",), {"bad.py": "\ndef model(:\n"}),
    "indentation": Case("fit bad.py", ("line 2: IndentationError",), {"bad.py": "def model(times, y=None):\npass\n"}),
    "bytes": Case("fit bad.py", ("bad.py does not run",), {"bad.py": b"\xff\xfe\x00\x00"}),
    "zero bytes": Case("fit bad.py", ("bad.py does not run",), {"bad.py": b"x = 1\x00\n"}),
    "no such module": Case("fit bad.py", ("line 1: ModuleNotFoundError", "nonesuch"), {"bad.py": "import nonesuch\n"}),
    "no such name": Case("fit bad.py", ("line 1: ImportError", "Nonesuch"),
                         {"bad.py": "from lfm_ppl import Nonesuch\n"}),
    "it raises": Case("fit bad.py", ("line 1: ZeroDivisionError",), {"bad.py": "1 / 0\n"}),
    "it exits": Case("fit bad.py", ("bad.py does not run: line 2: SystemExit",),
                     {"bad.py": "import sys\nsys.exit(0)\n"}),
    "empty": Case("fit bad.py", ("defines no function model(times, y=None, **options)", "none"), {"bad.py": ""}),
    "another name": Case("fit bad.py", ("defines no function model", "well", "Rename"),
                         {"bad.py": MODEL.replace("def model", "def well")}),
    "no function": Case("fit bad.py", ("defines no function model",), {"bad.py": "model = 3\n"}),
    "imported": Case("fit bad.py", ("defines no function model",), {"bad.py": "from json import loads as model\n"}),
    "no y": Case("fit bad.py", ("bad.py: model must take (times, y=None)",),
                 {"bad.py": with_model("def model(times, **options):\n    pass\n")}),
    "no arguments": Case("fit bad.py", ("bad.py: model must take (times, y=None)",),
                         {"bad.py": with_model("def model(**options):\n    pass\n")}),
    "an argument too many": Case("fit bad.py", ("bad.py", "size"),
                                 {"bad.py": with_model("def model(times, y, size, **options):\n    pass\n")}),
    "a negative scale": Case("fit bad.py", ("bad.py, line", "scale outside of its range", "dist.LogNormal(-0.5, -0.3)"),
                             {"bad.py": MODEL.replace("dist.LogNormal(-0.5, 0.3)", "dist.LogNormal(-0.5, -0.3)")}),
    "an argument of a force": Case("fit bad.py", ("bad.py, line", "'nu'", "It takes scale, lengthscale, order"),
                                   {"bad.py": with_model(
        "def model(times, y=None, **options):\n    lfm.Matern(1.0, 1.0, nu=1.5)\n")}),
    "options it does not take": Case("fit bad.py", ("bad.py", "depth", "OPTIONS"),
                                     {"bad.py": with_model("def model(times, y=None):\n    pass\n")}),
    "OUTPUTS of text": Case("fit bad.py", ('OUTPUTS must be a tuple of names, as in ("x",)',),
                            {"bad.py": MODEL.replace('("x",)', '"x"')}),
    "OUTPUTS of a number": Case("fit bad.py", ("OUTPUTS must be a tuple of names",),
                                {"bad.py": MODEL.replace('OUTPUTS = ("x",)', "OUTPUTS = 1")}),
    "OUTPUTS of numbers": Case("fit bad.py", ("OUTPUTS must be a tuple of names",),
                               {"bad.py": MODEL.replace('OUTPUTS = ("x",)', "OUTPUTS = (1, 2)")}),
    "OUTPUTS of nothing": Case("fit bad.py", ("OUTPUTS must be a tuple of names",),
                               {"bad.py": MODEL.replace('OUTPUTS = ("x",)', "OUTPUTS = ()")}),
    "UNITS": Case("fit bad.py", ("UNITS must be a mapping",), {"bad.py": MODEL + '\nUNITS = ["nm"]\n'}),
    "PARAMETERS": Case("fit bad.py", ("PARAMETERS must be a mapping",),
                       {"bad.py": MODEL + '\nPARAMETERS = ["noise"]\n'}),
    "OPTIONS": Case("fit bad.py", ("OPTIONS must be a mapping",), {"bad.py": MODEL + '\nOPTIONS = ["depth"]\n'}),
    "an option": Case("fit bad.py", ("OPTIONS['depth'] must be (default, tuple of choices or a type, help)",),
                      {"bad.py": MODEL + '\nOPTIONS = {"depth": 1.0}\n'}),
    "a default": Case("fit bad.py", ("OPTIONS['kind']", "default"),
                      {"bad.py": MODEL + '\nOPTIONS = {"kind": ("flat", ("even", "odd"), "of well")}\n'}),
    "INPUTS": Case("fit bad.py", ("INPUTS must be a mapping",), {"bad.py": MODEL + '\nINPUTS = ["heater"]\n'}),
    "an interpolation": Case("fit bad.py", ("INPUTS must be a mapping", "cubic"),
                             {"bad.py": MODEL + '\nINPUTS = {"heater": "cubic"}\n'}),
    "TARGET_ACCEPT": Case("fit bad.py", ("TARGET_ACCEPT must be between 0 and 1, got 2",),
                          {"bad.py": MODEL + "\nTARGET_ACCEPT = 2\n"}),
    "no data": Case("fit bad.py", ("defines no simulate(seed=0, **options)", "--data FILE"), {"bad.py": HEAD + BODY}),
    "data of an array": Case("fit bad.py", ("simulate in", "must return lfm.Data, got ndarray"),
                             {"bad.py": HEAD + BODY + "\ndef simulate(seed=0, **options):\n    return np.ones(3)\n"}),
    "data that fail": Case("fit bad.py", ("bad.py, line 25", "ZeroDivisionError"),
                           {"bad.py": HEAD + BODY + "\ndef simulate(seed=0, **options):\n    return 1 / 0\n"}),
    "data without options": Case("fit bad.py --option depth=2", ("bad.py", "simulate", "depth"),
                                 {"bad.py": HEAD + BODY + "\ndef simulate(seed=0):\n    return 1\n"}),
    "data of other outputs": Case("fit bad.py", ("simulate in", "OUTPUTS"),
                                  {"bad.py": MODEL.replace('-0.8]]), ("x",)', '-0.8]]), ("z",)')}),
    "preparing nothing": Case("fit bad.py --data d.csv", ("prepare in", "must return lfm.Data, got NoneType"),
                              {"bad.py": MODEL + "\ndef prepare(data):\n    pass\n", "d.csv": GOOD}),
    "no way to prepare": Case("fit bad.py", ("prepare must be a function",), {"bad.py": MODEL + "\nprepare = 3\n"}),
    "failing to prepare": Case("fit bad.py --data d.csv", ("bad.py, line 29", "KeyError"),
                               {"bad.py": MODEL + "\ndef prepare(data):\n    return {}['x']\n", "d.csv": GOOD}),
    "anchors of a list": Case("fit bad.py", ("anchors in", "mapping"),
                              {"bad.py": MODEL + "\ndef anchors(data):\n    return ['noise']\n"}),
    "anchors of another": Case("fit bad.py", ("'nois'",),
                               {"bad.py": MODEL + "\ndef anchors(data):\n    return {'nois': 1.0}\n"}),
    "it samples nothing": Case("fit bad.py", ("no latent site",), {"bad.py": with_model(
        '''def model(times, y=None, **options):
    numpyro.sample("y", lfm.MarginalLikelihood(system(1.0), times, steps=1), obs=y)\n''')}),
    "it sees nothing": Case("fit bad.py", ("lfm.MarginalLikelihood", "obs=y"), {"bad.py": with_model(
        '''def model(times, y=None, **options):
    numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))\n''')}),
    "it does nothing": Case("fit bad.py", ("no latent site", "numpyro.sample"), {"bad.py": with_model(
        "def model(times, y=None, **options):\n    pass\n")}),
    "y is not observed": Case("fit bad.py", ("does not use the data", "obs=y"), {"bad.py": with_model(
        '''def model(times, y=None, **options):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    numpyro.sample("y", lfm.MarginalLikelihood(system(noise), times, steps=1))\n''')}),
    "it sees twice": Case("fit bad.py", ("exactly one site", "found y, z"), {"bad.py": with_model(
        '''def model(times, y=None, **options):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    numpyro.sample("y", lfm.MarginalLikelihood(system(noise), times, steps=1), obs=y)
    numpyro.sample("z", lfm.MarginalLikelihood(system(noise), times, steps=1), obs=y)\n''')}),
    "one name twice": Case("fit bad.py", ("bad.py, line 27", "two sites", "the name 'noise'"), {"bad.py": with_model(
        '''def model(times, y=None, **options):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    numpyro.sample("y", lfm.MarginalLikelihood(system(noise), times, steps=1), obs=y)\n''')}),
    "it fails": Case("fit bad.py", ("bad.py, line 27", "NameError", "nois"), {"bad.py": with_model(
        '''def model(times, y=None, **options):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    numpyro.sample("y", lfm.MarginalLikelihood(system(nois), times, steps=1), obs=y)\n''')}),
    "NumPy in the dynamics": Case("fit bad.py", ("dynamics", "jax.numpy"), {"bad.py": sampled(
        "dynamics=lambda x, u, t: np.asarray(x) * 2")}),
    "math in the dynamics": Case("fit bad.py", ("dynamics", "jax.numpy"), {"bad.py": sampled(
        "dynamics=lambda x, u, t: jnp.array([float(x[0])])")}),
    "a choice in the dynamics": Case("fit bad.py", ("dynamics", "jnp.where"), {"bad.py": sampled(
        "dynamics=lambda x, u, t: x if x[0] > 0 else -x")}),
    "dynamics of two states": Case("fit bad.py", ("dynamics", "(2,)", "(1,)"), {"bad.py": sampled(
        "dynamics=lambda x, u, t: jnp.concatenate([x, x])")}),
    "dynamics of nothing": Case("fit bad.py", ("dynamics", "None"),
                                {"bad.py": sampled("dynamics=lambda x, u, t: None")}),
    "dynamics of two arguments": Case("fit bad.py", ("dynamics", "(x, u, t)"),
                                      {"bad.py": sampled("dynamics=lambda x, u: x")}),
    "dynamics that fail": Case("fit bad.py", ("bad.py, line 27", "KeyError"),
                               {"bad.py": sampled("dynamics=lambda x, u, t: {}['x']")}),
    "no dynamics": Case("fit bad.py", ("dynamics",), {"bad.py": sampled("dynamics=3")}),
    "two outputs of one": Case("fit bad.py", ("one column for each of the 2 outputs", "got (4, 1)"), {"bad.py": sampled(
        "observation=lambda x, u, t: jnp.concatenate([x, x]), variance=jnp.ones(2)")}),
    "two variances of one": Case("fit bad.py", ("bad.py, line 14", "covariance must be (1,)"),
                                 {"bad.py": sampled("variance=jnp.ones(2)")}),
    "a variance below zero": Case("fit bad.py", ("negative variance",), {"bad.py": sampled("variance=-jnp.ones(1)")}),
    "a start of two states": Case("fit bad.py", ("process_noise", "2"), {"bad.py": sampled(
        "start=lfm.Gaussian(jnp.ones(2), jnp.eye(2))")}),
    "a start that does not fit": Case("fit bad.py", ("(2, 2)",), {"bad.py": sampled(
        "start=lfm.Gaussian(jnp.ones(1), jnp.eye(2))")}),
    "forces in a list": Case("fit bad.py", ("bad.py, line 14", "forces must map names to forces"),
                             {"bad.py": sampled("forces=[lfm.Matern(1.0, 1.0)]")}),
    "a force of a number": Case("fit bad.py", ("force", "'u'"), {"bad.py": sampled("forces={'u': 1.0}")}),
    "a lengthscale below zero": Case("fit bad.py", ("lengthscale must be finite and greater than zero",),
                                     {"bad.py": sampled("forces={'u': lfm.Matern(1.0, -1.0)}")}),
}

RESULTS = {
    **{f"{command}: no such result": Case(f"{command} gone{more}", ("there is no result gone", "a results folder"))
       for command, more in (("check", ""), ("plot", ""), ("forecast", " --until 9"))},
    **{f"{command}: an empty folder": Case(f"{command} sub{more}", ("sub holds no posterior.nc", "lfm-ppl fit"),
                                           {"sub/keep.txt": "keep"})
       for command, more in (("check", ""), ("plot", ""), ("forecast", " --until 9"))},
    **{f"{command}: {name}": Case(f"{command} bad.nc{more}", ("bad.nc could not be read as a netCDF file", "lfm_ppl"),
                                  {"bad.nc": content})
       for command, more in (("check", ""), ("plot", ""), ("forecast", " --until 9"))
       for name, content in (("empty", b""), ("a CSV file", GOOD), ("cut short", "half"),
                             ("netCDF 3", b"CDF\x01\x00\x00\x00\x00"))},
    **{f"{command}: {group} is left out": Case(f"{command} cut.nc{more}", ("cut.nc", said),
                                               {"cut.nc": f"without {group}"})
       for command, more in (("check", ""), ("forecast", " --until 9"))
       for group, said in (("posterior", "holds no posterior"), ("observed_data", "no group 'observed_data'"))},
    "check: an unfinished run": Case("check begun", ("begun holds an unfinished run", "--resume"),
                                     {"begun/checkpoint/run.json": "{}"}),
    "plot: nothing to draw": Case("plot cut.nc", ("cut.nc holds no posterior",), {"cut.nc": "without posterior"}),
    **{f"{command}: its model has moved": Case(f"{command} moved.nc{more}", ("no model file", "name it with --model"),
                                               {"moved.nc": "with model_file=/gone/model.py"})
       for command, more in (("check", ""), ("forecast", " --until 9"))},
    **{f"{command}: it knows no model": Case(f"{command} python.nc{more}", ("which file its model", "--model FILE"),
                                             {"python.nc": "with model_file="})
       for command, more in (("check", ""), ("forecast", " --until 9"))},
    "check: a model of other outputs": Case("check result --model other.py", ("is of the outputs x", "other.py has z"),
                                            {"other.py": MODEL.replace('("x",)', '("z",)')}),
    "check: another model": Case("check result --model other.py", ("'scale'", "not the model"),
                                 {"other.py": MODEL.replace('"noise"', '"scale"')}),
    "check: other settings": Case("check result --model other.py", ("steps = 1", "steps = 7"),
                                  {"other.py": MODEL.replace("steps=1", "steps=7")}),
    "check: an option is gone": Case("check option.nc", ("option 'width'", "no longer has"),
                                     {"option.nc": 'with options={"width": 1}'}),
    "check: broken options": Case("check option.nc", ("option.nc", "options"), {"option.nc": "with options={width"}),
    "check: broken settings": Case("check option.nc", ("option.nc", "settings"), {"option.nc": "with settings=[1]"}),
    "check: no such rule": Case("check option.nc", ("option.nc", "rule"),
                                {"option.nc": 'with settings={"rule": "old"}'}),
    "check: a panel": Case("check panel.nc", ("a panel of series", "lfm.check_accuracy"), {"panel.nc": "panel"}),
    "check: a folder for nothing": Case("check result --out out", ("add --correct",)),
    "check: delayed for nothing": Case("check result --delayed", ("add --correct",)),
    "check: resume and overwrite": Case("check result --resume --overwrite", ("give one of them",)),
    "check: a report is there": Case("check result", ("accuracy.csv already exists", "--overwrite"),
                                     {"result/accuracy.csv": "keep"}),
    "check: a page of another": Case("check result", ("report.html",), {"result/report.html": "<html>mine</html>"}),
    "check: no such reference": Case("check result --reference exact", ("unknown reference 'exact'", "grid")),
    "check: no draws": Case("check result --draws 0", ("--draws", "'0'")),
    "check: no particles": Case("check result --particles 0", ("--particles", "'0'")),
    "check: no model": Case("check result --model gone.py", ("no model file gone.py",)),
    "check: corrected into files": Case("check result --correct --out sub", ("sub exists and holds files",),
                                        {"sub/mine": "keep"}),
    "check: corrected into a file": Case("check result --correct --out mine", ("mine is a file",), {"mine": "keep"}),
    "plot: figures are there": Case("plot result", ("already exists", "--overwrite"),
                                    {"result/trace.png": "keep"}),
    "plot: no such format": Case("plot result --format gif", ("'gif'", "png")),
    "plot: into a file": Case("plot result --out mine", ("mine is a file", "--out"), {"mine": "keep"}),
    "forecast: of what": Case("forecast result", ("--until TIME, --at T1,T2,... or --held-out FILE",)),
    "forecast: the past": Case("forecast result --until 1", ("after the last observation, at 3",)),
    "forecast: a word": Case("forecast result --until soon", ("--until: expected a number", "'soon'")),
    "forecast: words": Case("forecast result --at 4;5", ("--at: expected", "Separate times by commas")),
    "forecast: no file": Case("forecast result --held-out gone.csv", ("there is no file gone.csv",)),
    "forecast: other columns": Case("forecast result --held-out d.csv", ("unknown output column 'x'", "z"),
                                    {"d.csv": "time,z\n4,1\n"}),
    "forecast: dates": Case("forecast result --held-out d.csv",
                            ("d.csv: its times are dates", "the result plain numbers"), {"d.csv": DATED}),
    "forecast: two outputs": Case("forecast result --held-out d.csv --outputs x,z", ("has 1 output (x)", "names 2"),
                                  {"d.csv": "time,x,z\n4,1,1\n"}),
    "forecast: outputs of none": Case("forecast result --until 9 --outputs x", ("--outputs is about", "--held-out")),
    "forecast: nothing seen": Case("forecast result --held-out d.csv", ("every value of x is missing",),
                                   {"d.csv": "time,x\n4,\n"}),
    "forecast: inputs of none": Case("forecast result --held-out d.csv --inputs heater",
                                     ("--inputs", "no known inputs; leave it out"),
                                     {"d.csv": "time,x,heater\n4,1,1\n"}),
    "forecast: a table is there": Case("forecast result --until 9", ("forecast.csv already exists",),
                                       {"result/forecast.csv": "keep"}),
    "forecast: into files": Case("forecast result --until 9 --out sub", ("sub exists and holds files",),
                                 {"sub/mine": "keep"}),
    "forecast: no draws": Case("forecast result --until 9 --draws 0", ("--draws", "'0'")),
    "forecast: the start": Case("forecast result --at -5", ("-5",)),
}

OTHERS = {
    "models: no such model": Case("models sprin", ("unknown model 'sprin'", "'spring'")),
    "models: no such file": Case("models gone.py", ("no model file gone.py",)),
    "models: it does not run": Case("models bad.py", ("bad.py does not run: line 1",), {"bad.py": "1 / 0\n"}),
    "models: two": Case("models spring gps", ("unrecognized arguments", "gps")),
    "new: it is there": Case("new model.py", ("model.py already exists", "another name")),
    "new: no Python file": Case("new mine.txt", ("my_model.py", "'mine.txt'")),
    "new: no name of Python": Case("new my-model.py", ("can be imported", "'my-model.py'")),
    "new: a folder": Case("new sub.py", ("sub.py already exists",), {"sub.py/keep": "keep"}),
    "new: nowhere to write": Case("new /proc/mine.py", ("cannot write", "/proc")),
    "new: below a file": Case("new model.py/mine.py", ("model.py is a file",)),
    "new: no name": Case("new", ("required", "FILE")),
    "simulate: no data of its own": Case("simulate bare.py", ("defines no simulate",), {"bare.py": HEAD + BODY}),
    "simulate: no such option": Case("simulate model.py --option dept=1", ("unknown option", "'depth'")),
    "simulate: a file is there": Case("simulate model.py --out d.csv", ("d.csv already exists",),
                                      {"d.csv": "keep"}),
    "simulate: a truth is there": Case("simulate model.py --out d.csv", ("d.truth.json already exists",),
                                       {"d.truth.json": "keep"}),
    "simulate: a folder": Case("simulate model.py --out sub", ("sub is a folder",), {"sub/keep": "keep"}),
    "simulate: nowhere to write": Case("simulate model.py --out /proc/d.csv", ("cannot write", "/proc")),
    "simulate: a seed in words": Case("simulate model.py --seed now", ("--seed", "'now'")),
    "compare: no such experiment": Case("compare ballistik", ("unknown experiment 'ballistik'", "'ballistic'")),
    "compare: no runs": Case("compare ballistic --runs 0", ("'0'", "--runs")),
    "compare: a file": Case("compare ballistic --quick --out mine", ("mine is a file",), {"mine": "keep"}),
    "compare: what it does not take": Case("compare ballistic --satellites G05 --out out",
                                           ("does not take --satellites; leave it out",)),
    "compare: no such folder": Case("compare gps --data gone --out out", ("gone",)),
    "compare: both": Case("compare ballistic --jobs 1 --scheduler tcp://a:1 --out out", ("Give one of",)),
    "version: of what": Case("version jax", ("unrecognized arguments", "jax")),
}

GROUPS = {"files": FILES, "columns": COLUMNS, "times": TIMES, "options": OPTIONS, "bounds": BOUNDS,
          "folders": RESULTS_OF_FIT, "many": MANY, "models": MODELS, "results": RESULTS, "other commands": OTHERS}
CASES = {f"{group}: {name}": case for group, cases in GROUPS.items() for name, case in cases.items()}


def result_of(attrs=None, without=(), panel=False):
    """A result as `fit` writes it, of draws that nobody sampled."""
    chance = np.random.default_rng(0)
    series = ("series",) if panel else ()
    y = np.array([[0.3], [0.9], [np.nan], [-0.8]])
    groups = {
        "posterior": xr.Dataset({"noise": (("chain", "draw"), np.exp(0.3 * chance.normal(size=(2, 50)) - 0.5))}),
        "observed_data": xr.Dataset({"y": ((*series, "time", "output"), np.stack([y, y]) if panel else y)},
                                    {"time": np.arange(4.0), "output": ["x"]}),
    }
    return arviz_data.build({name: group for name, group in groups.items() if name not in without}, {
        "model": "model", "model_file": "model.py", "rule": "Cubature()", "steps": 1, "iterations": 3,
                "sampler": "nuts",
        "chains": 2, "warmup": 50, "samples": 50, "seed": 0, "fixed": "{}", "options": "{}",
        "settings": '{"rule": null, "steps": null, "max_step": null, "iterations": null, "tolerance": null}',
        **(attrs or {})})


def put(path, content):
    """Write a file of a case: text, bytes, a link, or a result."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, str) and content.startswith("-> "):
        path.symlink_to(content[3:])
    elif path.suffix == ".nc" and isinstance(content, str) and content != GOOD:
        word, _, more = content.partition(" ")
        name, _, value = more.partition("=")
        result = result_of({name: value} if word == "with" else {}, [more] if word == "without" else [],
                           word == "panel")
        arviz_data.save(result, path)
        if word == "half":
            path.write_bytes(path.read_bytes()[:4000])
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())


def contents(folder):
    """Return all that a folder holds: name -> bytes and time of change."""
    return {path.relative_to(folder).as_posix(): None if path.is_dir() or path.is_symlink() else
            (path.read_bytes(), path.stat().st_mtime_ns) for path in sorted(folder.rglob("*"))}


@pytest.fixture(scope="module")
def result_file(tmp_path_factory):
    """The result of a fit."""
    return arviz_data.save(result_of(), tmp_path_factory.mktemp("result") / "posterior.nc").read_bytes()


@pytest.fixture
def there(tmp_path, monkeypatch, result_file):
    """A folder with models and a result, which a command runs in."""
    for name, content in (("model.py", MODEL), ("heated.py", HEATED), ("result/posterior.nc", result_file)):
        put(tmp_path / name, content)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LFM_PPL_CACHE", "off")

    def compute(*arguments, **keywords):
        raise AssertionError("it has begun to compute")

    monkeypatch.setattr("lfm_ppl.inference.sampling.run_chains", compute)
    monkeypatch.setattr("lfm_ppl.workflows.fit.mode_of", compute)
    monkeypatch.setattr("lfm_ppl.workflows.fit_starts.mode_of", compute)
    monkeypatch.setattr("lfm_ppl.workflows.fit_results.draw_paths", compute)
    return tmp_path


@pytest.mark.parametrize("name", CASES)
def test_what_is_wrong_is_one_line(name, there, capsys):
    line, words, files, status = CASES[name]
    for path, content in files.items():
        put(there / path, content)
    before = contents(there)
    try:
        result = main(shlex.split(line))
    except SystemExit as exit_:
        result = exit_.code
    said = capsys.readouterr().err
    assert result == status, said
    if os.environ.get("SAY"):
        Path(os.environ["SAY"]).open("a").write(f"{name:45} {said}")
    assert said.startswith("lfm-ppl: ") and said.count("\n") == 1 and said.endswith("\n"), said
    assert "Traceback" not in said and "--debug shows where" not in said, said
    for word in words:
        assert word in said, said
    assert len(said) < 600, said
    assert contents(there) == before


# The Python API

T, Y = np.arange(4.0), np.array([[0.3], [0.9], [np.nan], [-0.8]])


def well(times, y=None):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    numpyro.sample("y", lfm.MarginalLikelihood(systems.double_well(dispersion=noise, noise=0.1), times, steps=1), obs=y)


def heated(times, y=None, inputs=None):
    system = linear(dynamics=lambda x, u, t: inputs["heater"](t) - x)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


def without_data(times, y=None):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    numpyro.sample("y", lfm.MarginalLikelihood(systems.double_well(dispersion=noise, noise=0.1), times, steps=1))


def with_times(times, y=None):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    system = systems.double_well(dispersion=noise, noise=0.1)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=1), obs=times)


def twice(times, y=None):
    noise = numpyro.sample("noise", dist.LogNormal(-0.5, 0.3))
    numpyro.deterministic("noise", 2 * noise)
    numpyro.sample("y", lfm.MarginalLikelihood(systems.double_well(dispersion=noise, noise=0.1), times, steps=1), obs=y)


def counted(times, y=None):
    level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    system = linear(observation=lfm.PoissonObservation(lambda x, u, t: x + level))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=1), obs=y)


def gaussian(mean=(0.0,), covariance=((1.0,),)):
    return lfm.Gaussian(np.array(mean), np.array(covariance))


def linear(**changes):
    arguments = {"dynamics": lambda x, u, t: -x, "forces": {}, "initial_state": gaussian(),
                 "observation": lfm.GaussianObservation(lambda x, u, t: x, np.ones(1)), "process_noise": np.eye(1),
                 **changes}
    return lfm.LatentForceModel(**arguments)


CALLS = {
    "data: times of words": (lambda: lfm.Data(["noon"], [[1.0]], ("x",)), ("noon",)),
    "data: times go back": (lambda: lfm.Data([1.0, 0.0], [[1.0], [2.0]], ("x",)), ("go back", "index 1", "Sort")),
    "data: times NaN": (lambda: lfm.Data([0.0, np.nan], [[1.0], [2.0]], ("x",)),
                        ("times must be finite at index [1]",)),
    "data: rows": (lambda: lfm.Data(T, Y[:3], ("x",)), ("(4, 1)", "(3, 1)")),
    "data: outputs": (lambda: lfm.Data(T, Y, ("x", "z")), ("(4, 2)", "(4, 1)")),
    "data: an input": (lambda: lfm.Data(T, Y, ("x",), inputs={"heater": 1.0}), ("known input 'heater'", "got float")),
    "table: a list": (lambda: lfm.read_table([1, 2]), ("expected a pandas or polars DataFrame", "got list")),
    "table: no rows": (lambda: lfm.read_table({"time": [], "x": []}), ("no rows",)),
    "table: ragged": (lambda: lfm.read_table({"time": [0, 1], "x": [1.0]}), ("columns of 1 and 2 rows",)),
    "table: a name twice": (lambda: lfm.read_table(pd.DataFrame([[0, 1, 2]], columns=["time", "x", "x"])),
                            ("'x' stands 2 times",)),
    "table: words": (lambda: lfm.read_table({"time": [0, 1], "x": [1.0, "high"]}), ("row 1, column 'x'", "'high'")),
    "table: outputs of text": (lambda: lfm.read_table({"time": [0], "x": [1.0]}, outputs="x"),
                               ("sequence of column names", "['x']")),
    "table: inputs of text": (lambda: lfm.read_table({"time": [0], "x": [1.0]}, inputs="x"),
                              ("sequence of column names", "['x']")),
    "table: two dimensions": (lambda: lfm.read_table(xr.DataArray(np.ones((2, 2)), dims=("time", "gene"))),
                              ("time alone", "to_dataset")),
    "file: none": (lambda: lfm.read_csv("gone.csv"), ("gone.csv",)),
    **{f"bounds: {grid!r} rows": (lambda grid=grid: lfm.MarginalLikelihood(linear(), T, lower={"x0": 0.0}, grid=grid),
                                  words) for grid, words in (
        (1, ("grid must be at least 2 rows", "got 1")), (-3, ("grid must be at least 1", "-3")),
        (True, ("grid must be a whole number", "True")), ((0.0, 9.0, 2.0), ("grid must increase",)))},
    "bounds: one row of an estimate": (lambda: lfm.full_information(linear(), T, Y, lower={"x0": 0.0}, grid=1),
                                       ("grid must be at least 2 rows",)),
    "file: no name": (lambda: lfm.read_csv(""), ("No such file",)),
    "load: none": (lambda: lfm.load("gone"), ("there is no result gone",)),
    "load: no result": (lambda: lfm.load("model.py"), ("could not be read as a netCDF file",)),
    "save: it is there": (lambda: lfm.save(result_of(), "result/posterior.nc"),
                          ("already exists", "overwrite=True")),
    "save: a folder": (lambda: lfm.save(result_of(), "result"), ("result is a folder",)),
    "save: no result": (lambda: lfm.save({"noise": 1.0}, "new.nc"),
                        ("must be what lfm.fit or lfm.load returned, got dict",)),
    "fit: no model": (lambda: lfm.fit(3, T, Y), ("must be a NumPyro model", "got int")),
    "fit: no y": (lambda: lfm.fit(well, T), ("without y the data must be lfm.Data", "got ndarray")),
    "fit: rows": (lambda: lfm.fit(well, T, Y[:3]), ("one row for each of the 4 times", "got (3, 1)")),
    "fit: columns": (lambda: lfm.fit(well, T, np.ones((4, 2))), ("(4, 1)", "(4, 2)")),
    "fit: times go back": (lambda: lfm.fit(well, T[::-1], Y), ("times",)),
    "fit: infinite data": (lambda: lfm.fit(well, T, np.where(np.isnan(Y), np.inf, Y)), ("y", "NaN")),
    "fit: the data unused": (lambda: lfm.fit(without_data, T, Y), ("does not use the data", "obs=y")),
    "fit: the times as data": (lambda: lfm.fit(with_times, T, Y), ("'y' observes the times", "obs=y")),
    "fit: two sites of one name": (lambda: lfm.fit(twice, T, Y), ("two sites", "'noise'")),
    "fit: a count with a fraction": (
        lambda: lfm.fit(counted, T, np.array([[1.0], [2.5], [0.0], [3.0]])),
        ("y[1, 0] (y0, row 2 of the data) is 2.5", "PoissonObservation needs", "NaN for a missing entry")),
    "fit: no such sampler": (lambda: lfm.fit(well, T, Y, sampler="nutz"), ("unknown sampler 'nutz'", "'nuts'")),
    "fit: no chains": (lambda: lfm.fit(well, T, Y, chains=0), ("chains must be at least 1, got 0",)),
    "fit: half a chain": (lambda: lfm.fit(well, T, Y, chains=2.5), ("chains must be a whole number, got 2.5",)),
    "fit: a negative warm-up": (lambda: lfm.fit(well, T, Y, warmup=-1), ("warmup must be at least",)),
    "fit: no such option": (lambda: lfm.fit(well, T, Y, sampler_options={"target": 0.9}),
                            ("'target'", "target_accept_prob")),
    "fit: no such parameter": (lambda: lfm.fit(well, T, Y, fixed={"nois": 1.0}), ("'nois'", "'noise'")),
    "fit: beyond its support": (lambda: lfm.fit(well, T, Y, fixed={"noise": -1.0}), ("noise cannot be fixed at -1.0",)),
    "fit: a start": (lambda: lfm.fit(well, T, Y, init="mode"), ("unknown init 'mode'", "map")),
    "fit: no such method": (lambda: lfm.fit(well, T, Y, chain_method="threads"), ("'threads'", "vectorized")),
    "fit: no inputs": (lambda: lfm.fit(heated, T, Y), ("argument `inputs`", "lfm.read_table(frame, inputs=[...])")),
    "fit: resume nothing": (lambda: lfm.fit(well, T, Y, resume=True), ("checkpoint=",)),
    "fit: a folder with a result": (lambda: lfm.fit(well, T, Y, checkpoint="result"),
                                    ("holds a result.",)),
    "fit: a file for a folder": (lambda: lfm.fit(well, T, Y, checkpoint="model.py"), ("model.py is a file",)),
    "fit: times before the start": (lambda: lfm.fit(well, T, Y, at=[-5.0]), ("at[0] = -5", "initial_time")),
    "fit: times NaN": (lambda: lfm.fit(well, T, Y, at=[np.nan]), ("at", "finite")),
    "fit: dimensions of none": (lambda: lfm.fit(well, T, Y, dims={"nois": ["gene"]}), ("'nois'",)),
    "fit_many: nothing": (lambda: lfm.fit_many(well, {}), ("data_sets is empty",)),
    "fit_many: no data": (lambda: lfm.fit_many(well, {"a": 3.0}), ("data set 'a'", "got float")),
    "fit_many: no such option": (lambda: lfm.fit_many(well, {"a": (T, Y)}, sample=3), ("'sample'", "'samples'")),
    "forecast: no result": (lambda: lfm.forecast(3, well, [5.0]), ("got int",)),
    "forecast: times NaN": (lambda: lfm.forecast(result_of(), well, [np.nan]), ("times", "finite")),
    "forecast: no times": (lambda: lfm.forecast(result_of(), well, []), ("times",)),
    "forecast: a table of times": (lambda: lfm.forecast(result_of(), well, [[5.0]]), ("times", "(1, 1)")),
    "score: no forecast": (lambda: lfm.score(result_of(), lfm.Data(T, Y, ("x",))),
                           ("no group 'predictions'", "lfm.forecast")),
    "model: no forces": (lambda: linear(forces=None), ("forces must map names to forces",)),
    "model: dynamics of text": (lambda: linear(dynamics="-x"), ("dynamics must be callable",)),
    "model: a start of a number": (lambda: linear(initial_state=0.0), ("initial_state", "lfm.Gaussian")),
    "model: a covariance below zero": (lambda: linear(initial_state=gaussian(covariance=((-1.0,),))),
                                       ("initial_state", "not positive semi-definite")),
    "model: names": (lambda: linear(state_names=("a", "b")), ("state_names", "1")),
    "force: a scale below zero": (lambda: lfm.Matern(-1.0, 1.0), ("scale must be finite and greater than zero",)),
    "force: an order of 9": (lambda: lfm.Matern(1.0, 1.0, order=9), ("order", "9")),
    "input: times go back": (lambda: lfm.Input([1.0, 0.0], [1.0, 2.0]), ("times",)),
    "input: values": (lambda: lfm.Input([0.0, 1.0], [1.0]), ("values",)),
    "input: no such way": (lambda: lfm.Input([0.0, 1.0], [1.0, 2.0], "cubic"), ("'cubic'", "previous, linear")),
    "likelihood: no steps": (lambda: lfm.MarginalLikelihood(linear(), T, steps=0), ("steps must be at least 1",)),
    "likelihood: a rule of text": (lambda: lfm.MarginalLikelihood(linear(), T, rule="cubature"),
                                   ("rule", "lfm.Cubature")),
    "likelihood: times NaN": (lambda: lfm.MarginalLikelihood(linear(), [0.0, np.nan]), ("times must be finite",)),
    "filter: columns": (lambda: lfm.filter(linear(), T, np.ones((4, 2))), ("(4, 1)", "(4, 2)")),
    "smooth: before the start": (lambda: lfm.smooth(linear(), T, Y, at=[-3.0]), ("at[0] = -3", "initial_time")),
    "simulate: a key of a number": (lambda: lfm.simulate(0, linear(), T), ("jax.random.key(0), got 0",)),
}


@pytest.mark.parametrize("name", CALLS)
def test_what_is_wrong_in_a_call_is_one_line(name, there):
    call, words = CALLS[name]
    before = contents(there)
    with pytest.raises((ValueError, TypeError, OSError)) as raised:
        call()
    said = str(raised.value)
    if os.environ.get("SAY"):
        Path(os.environ["SAY"]).open("a").write(f"{name:45} {said}\n")
    assert "\n" not in said and len(said) < 600
    for word in words:
        assert word in said, said
    assert contents(there) == before


def test_there_are_two_hundred_of_them():
    lines = {(case.line, *case.files.items()) for case in CASES.values()}
    assert len(lines) >= 200 and len(lines) == len(CASES)
