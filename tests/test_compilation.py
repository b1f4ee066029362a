"""How XLA compiles."""

import os

import pytest

import lfm_ppl as lfm
from lfm_ppl.compilation import quick_compilation

OPTION = "xla_cpu_small_while_loop_byte_threshold"


@pytest.mark.parametrize(("before", "after"), [
    (None, f"--xla_backend_extra_options={OPTION}=1000000"),
    ("--xla_force_host_platform_device_count=2",
     f"--xla_force_host_platform_device_count=2 --xla_backend_extra_options={OPTION}=1000000"),
    ("--xla_backend_extra_options=other=1", f"--xla_backend_extra_options=other=1,{OPTION}=1000000"),
    (f"--xla_backend_extra_options={OPTION}=5", f"--xla_backend_extra_options={OPTION}=5"),
])
def test_fast_loops_join_the_flags_that_are_there(monkeypatch, before, after):
    if before is None:
        monkeypatch.delenv("XLA_FLAGS", raising=False)
    else:
        monkeypatch.setenv("XLA_FLAGS", before)
    lfm.fast_loops()
    assert os.environ["XLA_FLAGS"] == after
    lfm.fast_loops()
    assert os.environ["XLA_FLAGS"] == after, "once is enough"


@pytest.mark.parametrize("before", [None, "--xla_dump_to=here --xla_backend_optimization_level=2"])
def test_what_is_set_comes_after_quick_compilation_and_so_wins(monkeypatch, before):
    if before is None:
        monkeypatch.delenv("XLA_FLAGS", raising=False)
    else:
        monkeypatch.setenv("XLA_FLAGS", before)
    quick_compilation(1)
    words = os.environ["XLA_FLAGS"].split(" ")
    assert words[0] == "--xla_backend_optimization_level=1"
    assert words[-2:] == before.split() if before else all(words)
