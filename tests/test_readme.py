"""What the README tells a newcomer holds."""

import functools
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl import loading

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def test_models_and_extras_that_it_names_exist():
    models = set(re.findall(r"lfm-ppl fit ([a-z][a-z-]*)(?=[\s`])", TEXT))
    assert "ginzburg-landau" in models and models <= set(loading.available())
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(re.findall(r'"\.\[(\w+)\]"', TEXT)) <= set(extras)
    for name in re.findall(r"^ {4,6}([\w./]+/?) {2,}", TEXT, re.MULTILINE):
        folder = ROOT if name.startswith((".", "lfm_ppl", "models", "notebooks", "docs", "tests")) else None
        assert ((folder or ROOT / "lfm_ppl") / name).exists(), name


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
