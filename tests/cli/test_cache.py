"""The cache of compiled programs: where it lies, and how to have none."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from lfm_ppl.cli import session

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def home(tmp_path, monkeypatch):
    """An empty cache folder; the configuration of JAX is restored afterwards."""
    names = ("jax_compilation_cache_dir", "jax_compilation_cache_max_size",
             "jax_persistent_cache_min_compile_time_secs")
    saved_settings = {name: getattr(jax.config, name) for name in names}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.delenv(session.SWITCH, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield tmp_path / "cache"
    for name, value in saved_settings.items():
        jax.config.update(name, value)


def programs(line, folder):
    """Run the command line in a new process, and return the programs in the cache folder afterwards."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", session.SWITCH))}
    environment = {**inherited, "XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": str(ROOT)}
    result = subprocess.run([sys.executable, "-m", "lfm_ppl", *shlex.split(line)], cwd=folder, env=environment,
                            capture_output=True, text=True)
    assert result.returncode == 0 and "warning" not in result.stderr, result.stderr
    return sorted((folder / "cache").rglob("*-cache"))


@pytest.mark.thorough
def test_a_command_stores_its_programs_and_uses_them_again(tmp_path):
    assert programs("simulate spring --no-cache", tmp_path) == [] and not (tmp_path / "cache").exists()
    first = programs("simulate spring --overwrite", tmp_path)
    assert first and all(path.parent.parent == tmp_path / "cache" / "lfm_ppl" for path in first)
    times = [path.stat().st_mtime_ns for path in first]
    assert programs("simulate spring --overwrite", tmp_path) == first
    assert [path.stat().st_mtime_ns for path in first] == times
    assert (tmp_path / "cache" / "lfm_ppl").stat().st_mode & 0o077 == 0


def test_the_folder_and_its_size_are_set_for_the_process(home, tmp_path):
    session.cache_folder().mkdir(parents=True, mode=0o700)
    (session.cache_folder() / "killed-cache").write_bytes(b"")  # by a process that was killed before it wrote the time
    session.start(1)
    assert (session.cache_folder() / "killed-atime").is_file()
    assert Path(jax.config.jax_compilation_cache_dir) == session.cache_folder()
    assert session.cache_folder().is_dir() and session.cache_folder().parent == home / "lfm_ppl"
    assert jax.config.jax_compilation_cache_max_size == 2**30
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "own"))
    session.start(1)
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "own")  # set by the user


def test_the_environment_switches_it_off(home, monkeypatch):
    monkeypatch.setenv(session.SWITCH, "off")
    session.start(1)
    assert jax.config.jax_compilation_cache_dir is None and not home.exists()


def test_a_folder_that_cannot_be_written_is_a_warning(home):
    home.write_text("")
    with pytest.warns(UserWarning, match="compiled programs are not cached: .*LFM_PPL_CACHE=off"):
        session.start(1)
    assert jax.config.jax_compilation_cache_dir is None
