"""Settings that every test needs: double precision, compiled programs kept between runs, and processes to run in."""

import contextlib
import ctypes
import gc
import os
import re
import warnings
from pathlib import Path

import jax
import pytest

from lfm_ppl.utils.compilation import quick_compilation
from lfm_ppl.utils.programs import forget_executables

# ArviZ 0.23 writes the date of an announcement when it is first imported on a day, which two workers cannot do at once:
# the process that starts them does it before.
with warnings.catch_warnings():
    warnings.simplefilter("ignore", FutureWarning)
    import arviz  # noqa: F401

pytest_plugins = ["synthetic_result"]

jax.config.update("jax_enable_x64", True)

# Most of the time of a test is compilation. JAX_COMPILATION_CACHE_DIR moves the cache.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    root = Path(__file__).resolve().parent.parent
    jax.config.update("jax_compilation_cache_dir", str(root / ".jax_cache"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
# Where an operation came from, with pytest's fifty frames for each, is written into no program.
jax.config.update("jax_include_full_tracebacks_in_locations", False)
jax.config.update("jax_traceback_in_locations_limit", 0)
# Tracing makes millions of objects that live: looking through them for garbage took 7% of the time.
gc.set_threshold(50_000, 20, 50)
os.environ["LFM_PPL_CACHE"] = "off"  # the command line keeps nothing in the home of who runs the tests


EVERY_CASE = ("test_contract.py", "test_code_blocks.py", "test_docs.py")
"""Modules all of whose cases run by default."""


def _asked_for(config: pytest.Config, mark: str) -> bool:
    return mark in config.option.markexpr and f"not {mark}" not in config.option.markexpr


def pytest_configure(config: pytest.Config) -> None:
    """Compile faster, before a backend exists, except where speed is measured.

    Without optimisations tests take two thirds of the time, since they compile more than they compute (but for slow
    ones, whose programs are optimised in full).
    """
    if _asked_for(config, "performance"):
        return
    _keep_to_one_cpu(os.environ.get("PYTEST_XDIST_WORKER", ""))
    quick_compilation(3 if _asked_for(config, "slow") else 0)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all but the first case of a parametrised test as thorough; a model or a page is no variation."""
    tested = set()
    for item in items:
        name = item.nodeid.partition("[")[0]
        is_first = name not in tested or item.path.name in EVERY_CASE
        if is_first and not any(item.get_closest_marker(mark) for mark in ("slow", "performance", "thorough")):
            tested.add(name)
        elif not is_first:
            item.add_marker(pytest.mark.thorough)


def _keep_to_one_cpu(worker: str) -> None:
    """Run xdist's process gw0, gw1... on a CPU of its own: the threads of JAX in one get in the way of the others'."""
    several = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1
    if several and re.fullmatch(r"gw\d+", worker) and hasattr(os, "sched_setaffinity"):
        cpus = sorted(os.sched_getaffinity(0))
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, [cpus[int(worker[2:]) % len(cpus)]])


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """A worker per core up to four, each needs 2 GiB or more; one process where speed is measured."""
    return 0 if _asked_for(config, "performance") else min(os.cpu_count() or 1, 4)


@pytest.fixture(autouse=True, scope="module")
def release_compiled_programs():
    """Forget compiled programs after a file where they have become many; until then later files use them too.

    Linux allows a process 65,530 memory mappings, of which each program takes some, and a worker has 2 to 4 GiB. Memory
    that is free, but still the process's, is given back first: it would look like programs for ever.
    """
    yield
    _release_programs_where_crowded()


@pytest.fixture
def release_programs_of_test():
    """Forget compiled programs after a single test where they have become many: some tests make thousands."""
    yield
    _release_programs_where_crowded()


def _release_programs_where_crowded() -> None:
    if _crowded():
        _give_back_free_memory()
        if _crowded():
            jax.clear_caches()
            forget_executables()
            gc.collect()
            _give_back_free_memory()


def _crowded() -> bool:
    with contextlib.suppress(AttributeError, OSError, ValueError):  # /proc is Linux's
        page = os.sysconf("SC_PAGE_SIZE")
        workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
        share = os.sysconf("SC_PHYS_PAGES") * page // (2 * workers)
        mappings = Path("/proc/self/maps").read_bytes().count(b"\n")
        resident = int(Path("/proc/self/statm").read_text().split()[1]) * page
        return mappings > 30_000 or resident > min(max(share, 2 * 2**30), 4 * 2**30)
    return True


def _give_back_free_memory() -> None:
    with contextlib.suppress(AttributeError, OSError, TypeError):  # glibc's
        ctypes.CDLL(None).malloc_trim(0)
