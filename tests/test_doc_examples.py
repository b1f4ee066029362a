"""The examples of the page of forecasts: short, and as good on real data as the page says."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from lfm_ppl.io import loading

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "docs" / "examples"
DATA = Path(os.environ.get("LFM_DATA", ROOT.parent / "shared" / "data"))
FILES = {"house": DATA / "house" / "house_hourly.csv", "calls": DATA / "calls" / "bank_calls.csv.gz"}


def numbers(text: str) -> dict[str, list[float]]:
    """Return what stands in each row of the printed tables."""
    rows = re.findall(r"^(.*?\S)((?: +-?\d+(?:\.\d+)?)+)$", text, re.MULTILINE)
    return {" ".join(label.split()): [float(cell) for cell in cells.split()] for label, cells in rows}


@pytest.mark.parametrize("name", FILES)
def test_examples_are_short_and_load(name):
    path = EXAMPLES / f"{name}.py"
    assert len(path.read_text("utf-8").splitlines()) < 40
    assert loading.load(str(path)).description


@pytest.mark.slow
@pytest.mark.parametrize(("name", "output"), [("house", "Ti"), ("calls", "log_calls")])
def test_examples_beat_the_reference_as_the_page_says(name, output):
    if not FILES[name].is_file():
        pytest.skip(f"needs {FILES[name]}")
    run = subprocess.run([sys.executable, EXAMPLES / f"{name}.py", FILES[name]], cwd=ROOT, capture_output=True,
                         text=True, check=True)
    result = numbers(run.stdout)
    (shown,) = [block for block in re.findall(r"```text\n(.*?)```", (ROOT / "docs" / "forecasts.md").read_text("utf-8"),
                                              re.DOTALL) if f" {output} " in block]
    expected = numbers(shown)
    assert result.keys() == expected.keys() and len(result) == 4
    for label, row in expected.items():
        assert result[label] == pytest.approx(row, abs=0.02), label
    origins, rmse, _, log_score = result[output]
    assert origins == 10 and rmse >= 8 and log_score >= 8


@pytest.mark.slow
def test_the_code_for_numpyro_and_arviz_users_runs():
    path = EXAMPLES / "numpyro_arviz.py"
    run = subprocess.run([sys.executable, path], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "elpd_loo" in run.stdout and "('decay', 'lengthscale')" in run.stdout
