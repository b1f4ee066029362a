"""What is installed: the model files travel inside the package, and the checkout's serve itself."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MODELS = {path.name for path in (ROOT / "models").glob("*.py")}


def run(command, folder, path):
    """Run a command in `folder` with modules found at `path` first; return what it printed."""
    environment = {"PYTHONPATH": str(path), "PATH": "/usr/bin:/bin", "HOME": str(folder)}
    result = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory):
    """The folder that a wheel of this checkout unpacks to."""
    pytest.importorskip("hatchling", reason="builds the wheel; comes with the extra `test`")
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=300)
    (wheel,) = folder.glob("lfm_ppl-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def test_a_wheel_installs_one_package_with_the_models_inside(unpacked):
    packages = {path.name for path in unpacked.iterdir() if not path.name.endswith(".dist-info")}
    assert packages == {"lfm_ppl"}
    assert {path.name for path in (unpacked / "lfm_ppl/_models").glob("*.py")} == MODELS
    entry_points = next(unpacked.glob("*.dist-info")) / "entry_points.txt"
    assert "lfm-ppl = lfm_ppl.__main__:main" in entry_points.read_text()


@pytest.mark.parametrize("installed", ["wheel", "checkout"])
def test_models_are_found_wherever_the_package_is(installed, request, tmp_path):
    site = request.getfixturevalue("unpacked") if installed == "wheel" else ROOT
    folder = "lfm_ppl/_models" if installed == "wheel" else "models"
    code = "from lfm_ppl.io import loading; print(loading.load('spring').path)"
    result = run([sys.executable, "-c", code], tmp_path, site)
    assert Path(result.strip()) == (site / folder / "spring.py").resolve()
    listed = run([sys.executable, "-m", "lfm_ppl", "models"], tmp_path, site)
    assert all(name.removesuffix(".py").replace("_", "-") in listed for name in MODELS)


def test_a_wheel_says_its_version_and_its_licence_and_that_it_is_typed(unpacked, tmp_path):
    assert (unpacked / "lfm_ppl/py.typed").is_file()
    (information,) = unpacked.glob("*.dist-info")
    assert (information / "licenses/LICENSE").read_text() == (ROOT / "LICENSE").read_text()
    metadata = (information / "METADATA").read_text()
    assert "\nLicense-Expression: Apache-2.0\n" in metadata
    (version,) = re.findall(r"^Version: (\S+)$", metadata, re.MULTILINE)
    said = run([sys.executable, "-m", "lfm_ppl", "--version"], tmp_path, unpacked)
    assert said == f"lfm_ppl {version}\n"
