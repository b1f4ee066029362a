"""What happens where a task is computed: the process is prepared once, then a result is arrays."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import pickle
import platform
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import Any, NamedTuple

import jax
import numpy as np

from lfm_ppl.engine import store
from lfm_ppl.engine.errors import ClusterError
from lfm_ppl.engine.task import Task
from lfm_ppl.utils.compilation import ONE_THREAD

_LIBRARIES = ("lfm_ppl", "jax", "jaxlib", "numpyro", "numpy")


class Setup(NamedTuple):
    """What a process must be like to find the numbers of the one that asks.

    Attributes:
        versions: library -> version.
        environment: variables that XLA reads at its first computation.
        double: whether JAX computes in double precision.
        programs: folder of compiled programs; None: the worker's own.
        shortest: seconds of compilation from which on a program is kept there.
    """

    versions: Mapping[str, str]
    environment: Mapping[str, str]
    double: bool
    programs: str | None = None
    shortest: float = 1.0

    @classmethod
    def here(cls, programs: str | None) -> Setup:
        """Return that of this process, with one thread."""
        environment = dict(ONE_THREAD)
        if "XLA_FLAGS" in os.environ:
            environment["XLA_FLAGS"] = os.environ["XLA_FLAGS"]
        kept = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
        shortest = jax.config.jax_persistent_cache_min_compile_time_secs if kept else 0.0  # type: ignore[attr-defined]
        return cls(versions(), environment, bool(jax.config.read("jax_enable_x64")), programs, shortest)


def versions() -> dict[str, str]:
    """Return what the numbers of this process depend on."""
    return {"python": ".".join(platform.python_version_tuple()[:2])} | {
        name: metadata.version(name) for name in _LIBRARIES}


def check_versions(found: Mapping[str, str], wanted: Mapping[str, str], where: str = "") -> None:
    """Raise ClusterError where they differ."""
    other = [f"{name} {found.get(name, 'missing')} (here {version})" for name, version in wanted.items()
             if found.get(name) != version]
    if other:
        raise ClusterError(f"the worker {where or platform.node()} has {', '.join(other)}; its numbers would be "
                           "others. Install the same versions on all machines.")


_prepared: list[Setup] = []


def prepare(setup: Setup) -> None:
    """Give this process the settings of the one that asks, before JAX computes anything in it.

    Raises:
        ClusterError: it has other versions.
    """
    if _prepared == [setup]:
        return
    check_versions(versions(), setup.versions)
    os.environ.update(setup.environment)
    jax.config.update("jax_enable_x64", setup.double)
    if setup.programs is not None:
        jax.config.update("jax_compilation_cache_dir", setup.programs)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", setup.shortest)
    _prepared[:] = [setup]


def work(setup: Setup, program: bytes, task: bytes) -> dict[str, np.ndarray]:
    """Compute a task in a worker; both are pickled, so that nothing of them is imported before the preparation."""
    prepare(setup)
    return computed(_loaded(program), pickle.loads(task))


def get_ready(setup: Setup, program: bytes) -> None:
    """Prepare a worker, and import what the tasks of a run need, before it is given the first one."""
    prepare(setup)
    _loaded(program)


@functools.lru_cache(maxsize=4)
def _loaded(program: bytes) -> Callable[[Task], Mapping[str, Any]]:
    """Return the function of a run, the same one for all its tasks: what was compiled for it is found by it."""
    return pickle.loads(program)


def computed(compute: Callable[[Task], Mapping[str, Any]], task: Task) -> dict[str, np.ndarray]:
    """Compute a task; a result that cannot be stored is an error here already."""
    try:
        return store.arrays(task, compute(task))
    finally:
        return_memory()


def return_memory() -> None:
    """Give freed memory back to the system: the C library keeps it, over half a gigabyte after a few compilations."""
    with contextlib.suppress(OSError, AttributeError):  # neither on macOS nor on Windows, nor with another C library
        ctypes.CDLL("libc.so.6").malloc_trim(0)
