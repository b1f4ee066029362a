"""What the README tells a newcomer holds."""

import functools
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.io import loading

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def test_models_and_extras_that_it_names_exist():
    models = set(re.findall(r"lfm-ppl fit ([a-z][a-z-]*)(?=[\s`])", TEXT))
    assert "ginzburg-landau" in models and models <= set(loading.available())
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(re.findall(r'"\.\[(\w+)\]"', TEXT)) <= set(extras)
    for name in re.findall(r"\]\(([\w./]+)(?:#[\w-]+)?\)", TEXT):
        assert (ROOT / name).exists(), name


def test_files_and_names_in_them_that_the_page_for_contributors_names_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for name in re.findall(r"^ {4,6}([\w./]+/?) {2,}", text, re.MULTILINE):
        top = name.startswith((".", "lfm_ppl", "models", "notebooks", "docs", "tests"))
        assert ((ROOT if top else ROOT / "lfm_ppl") / name).exists(), name
    paths = set(re.findall(r"`((?:lfm_ppl|tests|docs)/[\w./]*|[A-Z]+\.md)`", text))
    assert len(paths) > 20 and [path for path in paths if not (ROOT / path).exists()] == []
    names = re.findall(r"`([A-Z_]+|_[a-z]+)`", text)
    sources = "\n".join((ROOT / path).read_text(encoding="utf-8") for path in paths if path.endswith(".py"))
    assert {"FORCES", "RULES"} <= set(names)
    for name in names:
        assert re.search(rf"^(?:def )?{name}\b", sources, re.MULTILINE), name


@pytest.mark.slow
def test_its_example_runs(monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    assert 15 <= len(code.splitlines()) <= 30
    short = functools.partial(lfm.fit, chains=2, warmup=100, samples=100, progress=False)
    monkeypatch.setattr(lfm, "fit", short)
    names: dict = {}
    exec(code, names)
    assert 0.0 < float(names["result"]["posterior"]["decay"].mean()) < 5.0
    assert np.all(np.isfinite(names["result"]["trajectories"]["forces"]))
