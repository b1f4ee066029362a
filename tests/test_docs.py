"""Public names, and what README, CONTRIBUTING and the site say of them; `mkdocs build --strict` checks the links."""

import inspect
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl import orbits
from lfm_ppl.cli import main
from lfm_ppl.io import loading

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text("utf-8")
DATA = Path(os.environ.get("LFM_DATA", ROOT.parent / "shared" / "data"))


def public():
    """Yield (name, function) of every public function, and of every public method of a public class."""
    for module in (lfm, lfm.forces, lfm.priors, orbits):
        for name in module.__all__:
            value = getattr(module, name)
            if inspect.isclass(value) and value.__module__.startswith("lfm_ppl"):
                yield name, value.__init__
                yield from ((f"{name}.{method}", function) for method, function
                            in inspect.getmembers(value, inspect.isfunction) if not method.startswith("_"))
            elif inspect.isfunction(value):
                yield name, value


def test_every_public_name_stands_in_the_reference_once():
    reference = [name for page in sorted((DOCS / "api").glob("*.md"))
                 for name in re.findall(r"^::: lfm_ppl\.(\S+)$", page.read_text("utf-8"), re.MULTILINE)]
    of_modules = {f"{module}.{name}" for module in ("forces", "orbits", "priors")
                  for name in getattr(lfm, module).__all__ if name not in lfm.__all__}
    missing = {*lfm.__all__, *of_modules} - {"data", "datasets", "forces", "orbits", "priors"} - set(reference)
    assert not missing, f"add to a page of docs/api: {missing}"
    assert len(reference) == len(set(reference))


def test_a_random_key_is_the_first_argument():
    names = {name: [argument for argument in inspect.signature(function).parameters if argument != "self"]
             for name, function in public()}
    drawing = {name: arguments for name, arguments in names.items() if {"key", "rng_key"} & set(arguments)}
    assert {"simulate", "particle_filter", "calibrate", "MarginalLikelihood.sample", "RAM.init"} <= set(drawing)
    assert [name for name, arguments in drawing.items() if arguments[0] not in ("key", "rng_key")] == []
    for key in ("model", jax.random.split(jax.random.key(0), 3)):
        with pytest.raises(TypeError, match="key"):
            lfm.simulate(key, None, np.zeros(1))


def test_files_and_names_that_readme_and_contributing_name_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    folders = re.findall(r"^ {4,6}([\w./]+/?) {2,}", text, re.MULTILINE)
    paths = set(re.findall(r"`((?:lfm_ppl|studies|tests|docs)/[\w./]*|[A-Z]+\.md)`", text))
    linked = re.findall(r"\]\(([\w./]+)(?:#[\w-]+)?\)", README)
    assert len(paths) > 20
    assert [path for path in {*folders, *paths, *linked}
            if not (ROOT / path).exists() and not (ROOT / "lfm_ppl" / path).exists()] == []
    sources = "\n".join((ROOT / path).read_text("utf-8") for path in paths if path.endswith(".py"))
    assert [name for name in re.findall(r"`([A-Z_]+|_[a-z]+)`", text)
            if not re.search(rf"^(?:def )?{name}\b", sources, re.MULTILINE)] == []
    assert set(re.findall(r"lfm-ppl fit ([a-z][a-z-]*)(?=[\s`])", README)) <= set(loading.available())


@pytest.mark.slow
def test_the_commands_of_the_readme_run_as_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = re.findall(r"^    lfm-ppl (.*)$", README, re.MULTILINE)
    commands = [shlex.split(line, comments=True) for line in lines]
    assert [command[0] for command in commands] == ["new", "fit", "check", "forecast"]
    for command in commands:
        assert main(command) == 0
        if command[0] == "new":
            assert main(["simulate", command[1], "--out", "observations.csv"]) == 0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "file", "output"), [
    ("house", "house/house_hourly.csv", "Ti"), ("calls", "calls/bank_calls.csv.gz", "log_calls")])
def test_examples_of_the_page_on_forecasts_print_its_tables(name, file, output):
    if not (DATA / file).is_file():
        pytest.skip(f"needs {DATA / file}")

    def numbers(text):
        rows = re.findall(r"^(.*?\S)((?: +-?\d+(?:\.\d+)?)+)$", text, re.MULTILINE)
        return {" ".join(label.split()): [float(cell) for cell in cells.split()] for label, cells in rows}

    run = subprocess.run([sys.executable, DOCS / "examples" / f"{name}.py", DATA / file], cwd=ROOT,
                         capture_output=True, text=True, check=True)
    page = (DOCS / "forecasts.md").read_text("utf-8")
    (page_table,) = [block for block in re.findall(r"```text\n(.*?)```", page, re.DOTALL) if f" {output} " in block]
    result, expected = numbers(run.stdout), numbers(page_table)
    assert result.keys() == expected.keys() and len(result) == 4
    for label, row in expected.items():
        assert result[label] == pytest.approx(row, abs=0.02), label
    origins, rmse, _, log_score = result[output]
    assert origins == 10 and rmse >= 8 and log_score >= 8


@pytest.mark.slow
def test_the_code_for_numpyro_and_arviz_users_runs():
    run = subprocess.run([sys.executable, DOCS / "examples" / "numpyro_arviz.py"], cwd=ROOT, capture_output=True,
                         text=True, check=True)
    assert "elpd_loo" in run.stdout and "('decay', 'lengthscale')" in run.stdout
