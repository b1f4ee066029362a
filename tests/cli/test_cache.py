"""Compiled programs that the command line keeps for the next run: where, how much, and how to have none."""

import os
import shlex
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.cli import main, session
from lfm_ppl.results import arviz_data

ROOT = Path(__file__).resolve().parent.parent.parent


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A cache folder of the test's own, switched on, and JAX without one; both as before afterwards."""
    before = {name: getattr(jax.config, name) for name in (
        "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.delenv(session.SWITCH, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield tmp_path / "cache"
    for name, value in before.items():
        jax.config.update(name, value)


def command(line, folder):
    """Run the command line in a fresh process, and return the programs in the cache folder afterwards."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("JAX_") and name != session.SWITCH}
    environment = {**kept, "XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": str(ROOT)}
    result = subprocess.run([sys.executable, "-m", "lfm_ppl", *shlex.split(line)], cwd=folder, env=environment,
                            capture_output=True, text=True, timeout=300)
    assert result.returncode == 0 and "warning" not in result.stderr, result.stderr
    return sorted((folder / "cache").rglob("*-cache"))


def test_a_command_keeps_its_programs_unless_told_not_to(tmp_path):
    assert command("simulate spring --no-cache", tmp_path) == []
    assert not (tmp_path / "cache").exists()
    first = command("simulate spring --overwrite", tmp_path)
    assert first and all(path.parent.parent == tmp_path / "cache" / "lfm_ppl" for path in first)
    times = [path.stat().st_mtime_ns for path in first]
    again = command("simulate spring --overwrite", tmp_path)
    assert again == first and [path.stat().st_mtime_ns for path in again] == times
    assert (tmp_path / "cache" / "lfm_ppl").stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("line", ["fit spring", "compare counts", "simulate spring --out {}/x.csv", "check {}/result"])
def test_every_command_that_computes_keeps_them_and_has_the_flag(line, capsys, tmp_path, monkeypatch):
    lfm.save(arviz_data.build({"posterior": xr.Dataset({"a": (("chain", "draw"), np.ones((1, 4)))})}),
             tmp_path / "result" / "posterior.nc")
    asked = []

    def start(chains, keep_programs=True, **more):
        asked.append(keep_programs)
        raise ValueError("that is far enough")

    monkeypatch.setattr(session, "start", start)
    for flag in ("", " --no-cache"):
        assert main(shlex.split(line.format(tmp_path) + flag)) == 2
        assert "that is far enough" in capsys.readouterr().err
    assert asked == [True, False]


def test_the_folder_is_set_for_the_process_and_short_compilations_are_left_out(home):
    session.start(1)
    folder = Path(jax.config.jax_compilation_cache_dir)
    assert folder == session.cache_folder() and folder.is_dir() and folder.parent == home / "lfm_ppl"
    assert 0.0 < jax.config.jax_persistent_cache_min_compile_time_secs < 0.5


def test_a_folder_that_the_user_gave_to_jax_stays(home, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "own"))
    session.start(1)
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "own") and not home.exists()


@pytest.mark.parametrize("word", ["off", "OFF", "0", "no", "false"])
def test_the_environment_switches_it_off(home, monkeypatch, word):
    monkeypatch.setenv(session.SWITCH, word)
    session.start(1)
    assert jax.config.jax_compilation_cache_dir is None and not home.exists()


def test_the_folder_is_by_default_in_the_home(home, monkeypatch, tmp_path):
    for value in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        monkeypatch.setenv("HOME", str(tmp_path))
        assert session.cache_folder().parent == tmp_path / ".cache" / "lfm_ppl"


def test_machines_that_share_a_home_have_folders_of_their_own(home, monkeypatch):
    here = session.cache_folder()
    monkeypatch.setattr(session, "_cpu", lambda: "another")
    assert session.cache_folder() != here and session.cache_folder().parent == here.parent


@pytest.mark.parametrize("why", ["a file in the way", "no permission"])
def test_a_folder_that_cannot_be_written_is_a_warning(home, monkeypatch, why):
    if why == "a file in the way":
        home.write_text("")
    else:
        monkeypatch.setattr(os, "access", lambda *asked: False)
    with pytest.warns(UserWarning, match="compiled programs are not cached: .*LFM_PPL_CACHE=off"):
        session.start(1)
    assert jax.config.jax_compilation_cache_dir is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        session.start(1, keep_programs=False)


def test_the_programs_that_were_not_used_for_longest_go_first(tmp_path):
    folder = tmp_path / "cpu"
    folder.mkdir()
    for age, name in ((300, "b"), (100, "c"), (400, "a"), (0, "d")):
        path = folder / f"{name}-cache"
        path.write_bytes(bytes(10))
        os.utime(path, (1e9 - age, 1e9 - 1000))
    (tmp_path / "cpu" / "else").write_bytes(bytes(100))
    session.prune(tmp_path, 40)
    assert len(list(folder.glob("*-cache"))) == 4
    session.prune(tmp_path, 25)
    assert sorted(path.name for path in folder.iterdir()) == ["c-cache", "d-cache", "else"]
