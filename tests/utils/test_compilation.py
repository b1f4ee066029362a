"""How XLA compiles."""

import os
import subprocess
import sys

import jaxlib.version
import pytest

from lfm_ppl.utils.compilation import fast_loops, quick_compilation

OPTION = "xla_cpu_small_while_loop_byte_threshold"


@pytest.mark.parametrize(("initial_flags", "expected_flags"), [
    (None, f"--xla_backend_extra_options={OPTION}=1000000"),
    ("--xla_force_host_platform_device_count=2",
     f"--xla_force_host_platform_device_count=2 --xla_backend_extra_options={OPTION}=1000000"),
    ("--xla_backend_extra_options=other=1", f"--xla_backend_extra_options=other=1,{OPTION}=1000000"),
    (f"--xla_backend_extra_options={OPTION}=5", f"--xla_backend_extra_options={OPTION}=5"),
])
def test_fast_loops_join_the_flags_that_are_there(monkeypatch, initial_flags, expected_flags):
    if initial_flags is None:
        monkeypatch.delenv("XLA_FLAGS", raising=False)
    else:
        monkeypatch.setenv("XLA_FLAGS", initial_flags)
    fast_loops()
    assert os.environ["XLA_FLAGS"] == expected_flags
    fast_loops()
    assert os.environ["XLA_FLAGS"] == expected_flags, "once is enough"


@pytest.mark.parametrize("initial_flags", [None, "--xla_dump_to=here --xla_backend_optimization_level=2"])
def test_what_is_set_comes_after_quick_compilation_and_so_wins(monkeypatch, initial_flags):
    if initial_flags is None:
        monkeypatch.delenv("XLA_FLAGS", raising=False)
    else:
        monkeypatch.setenv("XLA_FLAGS", initial_flags)
    quick_compilation(1)
    assert os.environ["XLA_FLAGS"].startswith("--xla_backend_optimization_level=1")
    assert os.environ["XLA_FLAGS"].endswith("" if initial_flags is None else f" {initial_flags}")


@pytest.mark.parametrize(("version", "switches"), [((0, 10, 2), 3), ((0, 12, 0), 2), ((0, 13, 0), 1)])
def test_quick_compilation_uses_the_switches_that_a_version_has(monkeypatch, version, switches):
    monkeypatch.setattr(jaxlib.version, "__version_info__", version)
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    quick_compilation(0)
    assert len(os.environ["XLA_FLAGS"].split()) == switches


@pytest.mark.parametrize(("before", "environment", "devices"), [
    ("", {}, 3), ("", {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}, 2), ("", {"PJRT_NPROC": "1"}, 1),
    ("jax.numpy.ones(2).block_until_ready()", {}, 1)])
def test_a_first_fit_has_a_device_for_each_chain(before, environment, devices):
    code = f"""
import jax, os
from lfm_ppl.utils.compilation import prepare_chains
{before}
flags = os.environ.get("XLA_FLAGS")
prepare_chains(3)
prepare_chains(4)
assert jax.local_device_count() == {devices}, jax.local_device_count()
assert (os.environ.get("XLA_FLAGS") == flags) == {bool(before) or "PJRT_NPROC" in environment}
"""
    kept = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "PJRT_NPROC")}
    subprocess.run([sys.executable, "-c", code], check=True, env={**kept, "JAX_PLATFORMS": "cpu", **environment})
