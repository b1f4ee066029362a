"""Settings that every test needs: double precision, compiled programs kept between runs, and processes to run in."""

import contextlib
import gc
import os
import re
from pathlib import Path

import jax
import jaxlib.version
import pytest

jax.config.update("jax_enable_x64", True)

# Most of the time of a test is compilation. JAX_COMPILATION_CACHE_DIR moves the cache.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    root = Path(__file__).resolve().parent.parent
    jax.config.update("jax_compilation_cache_dir", str(root / ".jax_cache"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
os.environ["LFM_PPL_CACHE"] = "off"  # the command line keeps nothing in the home of who runs the tests


def _asked_for(config: pytest.Config, mark: str) -> bool:
    return mark in config.option.markexpr and f"not {mark}" not in config.option.markexpr


def pytest_configure(config: pytest.Config) -> None:
    """Compile faster, before a backend exists, except where speed is measured.

    Without optimisations tests take two thirds of the time, since they compile more than they compute (but for slow
    ones), and XLA's older emitters compile these small loops in half of what is left. Newer versions lack that switch,
    and XLA ends the process at a switch that it does not know.
    """
    if _asked_for(config, "performance"):
        return
    _keep_to_one_cpu(os.environ.get("PYTEST_XDIST_WORKER", ""))
    flags = [] if _asked_for(config, "slow") else ["--xla_backend_optimization_level=0"]
    if jaxlib.version.__version_info__ < (0, 11):
        flags.append("--xla_cpu_use_fusion_emitters=false")
    os.environ["XLA_FLAGS"] = " ".join([*flags, os.environ.get("XLA_FLAGS", "")])


def _keep_to_one_cpu(worker: str) -> None:
    """Run xdist's process gw0, gw1... on a CPU of its own: the threads of JAX in one get in the way of the others'."""
    several = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1
    if several and re.fullmatch(r"gw\d+", worker) and hasattr(os, "sched_setaffinity"):
        cpus = sorted(os.sched_getaffinity(0))
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, [cpus[int(worker[2:]) % len(cpus)]])


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """A worker per core up to four, each needs 2 GiB; one process where speed is measured."""
    return 0 if _asked_for(config, "performance") else min(os.cpu_count() or 1, 4)


@pytest.fixture(autouse=True, scope="module")
def release_compiled_programs():
    """Forget a file's compiled programs after it: each takes memory mappings, and Linux allows a process 65,530."""
    yield
    jax.clear_caches()
    gc.collect()
