"""Code of README and the site: every Python block runs, and every command line has options that exist.

1. The blocks of a page run in order in one namespace, as a reader would paste them, in a folder that holds the files of
   docs/examples.
2. Samplers take few draws here, whatever the page says: `few_draws` replaces the settings of `lfm.fit` and others.
3. A block that pulls in a file (``--8<--``) runs with the text of the file.
"""

import ast
import functools
import inspect
import re
import shlex
import shutil
import sys
import warnings
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpyro.infer
import pytest

import lfm_ppl as lfm
from lfm_ppl.cli import commands

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = {"README": ROOT / "README.md"} | {
    str(path.relative_to(DOCS).with_suffix("")): path for path in sorted(DOCS.rglob("*.md"))}
COSTLY = {"README", "guide", "ode", "doses", "counts", "space", "regimes", "panels", "many", "forecasts", "numpyro",
          "observations"}
"""Pages with fits, whose programs take half a minute or more to compile."""

_FENCE = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_INCLUDED = re.compile(r'^--8<-- "([\w./]+)(?::(\w+))?"$', re.MULTILINE)
_SHELL = re.compile(r"^```bash\n(.*?)^```$|^((?:    lfm-ppl [^\n]*\n)+)", re.MULTILINE | re.DOTALL)


def included(match: re.Match[str]) -> str:
    """Return the text of a file, or of one of its sections, that a block pulls in."""
    text, section = (DOCS / match[1]).read_text("utf-8"), match[2]
    if section is None:
        return text
    return re.search(rf"# --8<-- \[start:{section}\]\n(.*?)# --8<-- \[end:{section}\]", text, re.DOTALL)[1]


def python_blocks(path: Path) -> list[tuple[int, str]]:
    """Return the Python blocks of a page with the number of the line before each."""
    text = path.read_text("utf-8")
    return [(text.count("\n", 0, match.start()) + 1, _INCLUDED.sub(included, match[1]))
            for match in _FENCE.finditer(text)]


def command_lines(path: Path) -> list[str]:
    """Return the command lines of `lfm-ppl` in the shell blocks of a page."""
    text = "\n".join(match[1] or match[2] for match in _SHELL.finditer(path.read_text("utf-8")))
    return [line.strip().split("&& ")[-1] for line in text.replace("\\\n", " ").splitlines() if "lfm-ppl " in line]


WITH_PYTHON = [name for name, path in PAGES.items() if python_blocks(path)]
WITH_COMMANDS = [name for name, path in PAGES.items() if command_lines(path)]


@pytest.fixture
def few_draws(monkeypatch):
    """Replace the numbers of draws, steps and processes of a page by small ones."""
    fit, mcmc, run = lfm.fit, numpyro.infer.MCMC, numpyro.infer.SVI.run
    few = {"samples": 50, "trajectory_draws": 4, "progress": False}  # fewer draws are too few for `az.loo`

    def fit_briefly(*arguments, **keywords):
        chains = {} if keywords.get("sampler") == "map" else {"chains": 2, "warmup": 10}
        return fit(*arguments, **keywords | few | chains)

    monkeypatch.setattr(lfm, "fit", fit_briefly)
    monkeypatch.setattr(lfm, "backtest", functools.partial(lfm.backtest, draws=20, progress=False))
    monkeypatch.setattr(numpyro.infer, "MCMC", lambda kernel, **keywords: mcmc(
        kernel, **keywords | {"num_warmup": 10, "num_samples": 50}))
    monkeypatch.setattr(numpyro.infer.SVI, "run", lambda svi, key, steps, *arguments, **keywords: run(
        svi, key, 10, *arguments, **keywords))


@pytest.fixture
def quick_programs():
    """Compile with little effort: for few draws that is most of the time."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def page_folder(tmp_path, monkeypatch):
    """Work in a folder with the files of docs/examples, from which a page imports."""
    shutil.copytree(DOCS / "examples", tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    modules = set(sys.modules)
    yield
    plt.close("all")
    for name in set(sys.modules) - modules:
        if getattr(sys.modules[name], "__file__", None) and str(tmp_path) in str(sys.modules[name].__file__):
            del sys.modules[name]


def is_public_name(node: ast.AST) -> bool:
    """Return whether a node of the syntax tree is ``lfm.NAME``."""
    return isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "lfm"


@pytest.mark.parametrize("name", WITH_PYTHON)
def test_python_blocks_use_names_and_arguments_of_the_library(name):
    for line, code in python_blocks(PAGES[name]):
        nodes = list(ast.walk(ast.parse(code)))
        unknown = {node.attr for node in nodes if is_public_name(node) and not hasattr(lfm, node.attr)}
        assert not unknown, f"{name}, line {line}"
        for call in (node for node in nodes if isinstance(node, ast.Call) and is_public_name(node.func)):
            parameters = inspect.signature(getattr(lfm, call.func.attr)).parameters
            if all(parameter.kind is not parameter.VAR_KEYWORD for parameter in parameters.values()):
                unknown = {keyword.arg for keyword in call.keywords if keyword.arg} - set(parameters)
                assert not unknown, f"{name}, line {line + call.lineno}: lfm.{call.func.attr}"


@pytest.mark.thorough
@pytest.mark.parametrize("name", [
    pytest.param(name, marks=[pytest.mark.slow] if name in COSTLY else []) for name in WITH_PYTHON])
@pytest.mark.usefixtures("few_draws", "quick_programs", "page_folder", "release_programs_of_test")
def test_python_blocks_of_a_page_run_in_order(name):
    names = {"__name__": f"page_{name}"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lfm.ConvergenceWarning)  # of ten draws
        for line, code in python_blocks(PAGES[name]):
            exec(compile("\n" * line + code, str(PAGES[name]), "exec"), names)


@pytest.mark.parametrize("name", WITH_COMMANDS)
def test_commands_of_a_page_have_options_that_exist(name, page_folder):
    for line in command_lines(PAGES[name]):
        words = shlex.split(line, comments=True)
        commands.parse(words[1:])


def test_pages_with_code_are_found():
    assert {"README", "guide", "doses", "space", "regimes", "numpyro"} <= set(WITH_PYTHON)
    assert {"README", "guide", "doses", "many"} <= set(WITH_COMMANDS)
