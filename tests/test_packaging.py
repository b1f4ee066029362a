"""A wheel holds one package, with models, studies, the licence and types inside, and runs outside the checkout."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MODELS = {path.name for path in (ROOT / "models").glob("*.py")}
STUDIES = {path.relative_to(ROOT / "studies") for path in (ROOT / "studies").rglob("*.py")}


@pytest.mark.thorough
def test_a_wheel_runs_outside_the_checkout(tmp_path):
    pytest.importorskip("hatchling", reason="builds the wheel; comes with the extra `test`")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=300)
    (wheel,) = tmp_path.glob("lfm_ppl-*.whl")
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    (information,) = site.glob("*.dist-info")
    assert {path.name for path in site.iterdir()} == {"lfm_ppl", information.name}
    assert {path.name for path in (site / "lfm_ppl/_models").glob("*.py")} == MODELS
    studies_folder = site / "lfm_ppl/_studies"
    assert {path.relative_to(studies_folder) for path in studies_folder.rglob("*.py")} == STUDIES
    assert (site / "lfm_ppl/py.typed").is_file()
    assert (information / "licenses/LICENSE").read_text() == (ROOT / "LICENSE").read_text()
    assert "lfm-ppl = lfm_ppl.__main__:main" in (information / "entry_points.txt").read_text()
    (version,) = re.findall(r"^Version: (\S+)$", (information / "METADATA").read_text(), re.MULTILINE)
    environment = {"PYTHONPATH": str(site), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    outputs = [subprocess.run([sys.executable, "-m", "lfm_ppl", *arguments], cwd=tmp_path, env=environment, check=True,
                              capture_output=True, text=True, timeout=300).stdout
               for arguments in (["--version"], ["models"], ["compare", "ballistic", "--help"])]
    assert outputs[0] == f"lfm_ppl {version}\n"
    assert all(name.removesuffix(".py").replace("_", "-") in outputs[1] for name in MODELS)
    assert "--particle-runs" in outputs[2]  # a setting of the study
