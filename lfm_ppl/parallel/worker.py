"""Workers: prepare the process once, then compute tasks."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import pickle
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata
from typing import Any

import jax
import numpy as np

from lfm_ppl.parallel.errors import ClusterError
from lfm_ppl.parallel.store import as_arrays
from lfm_ppl.parallel.task import Task
from lfm_ppl.utils.compilation import ONE_THREAD

_LIBRARIES = ("lfm_ppl", "jax", "jaxlib", "numpyro", "numpy")


@dataclass(frozen=True)
class Setup:
    """Settings of a process that reproduces the numbers of the client.

    Attributes:
        versions: library -> version.
        environment: variables that XLA reads at its first computation.
        double: whether JAX computes in double precision.
        programs: folder of compiled programs; None: the folder of the worker.
        shortest: shortest compilation in seconds that is cached there.
    """

    versions: Mapping[str, str]
    environment: Mapping[str, str]
    double: bool
    programs: str | None = None
    shortest: float = 1.0

    @classmethod
    def of_this_process(cls, programs: str | None) -> Setup:
        """Return the settings of this process, with one thread."""
        environment = dict(ONE_THREAD)
        if "XLA_FLAGS" in os.environ:
            environment["XLA_FLAGS"] = os.environ["XLA_FLAGS"]
        cache_folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
        shortest = jax.config.jax_persistent_cache_min_compile_time_secs if cache_folder else 0.0  # type: ignore[attr-defined]
        return cls(versions(), environment, bool(jax.config.read("jax_enable_x64")), programs, shortest)


def versions() -> dict[str, str]:
    """Return the versions that numbers depend on."""
    return {"python": ".".join(platform.python_version_tuple()[:2])} | {
        name: metadata.version(name) for name in _LIBRARIES}


def check_versions(worker_versions: Mapping[str, str], expected_versions: Mapping[str, str], where: str = "") -> None:
    """Raise ClusterError if versions differ."""
    differences = [
        f"{name} {worker_versions.get(name, 'missing')} (here {version})"
        for name, version in expected_versions.items()
        if worker_versions.get(name) != version
    ]
    if differences:
        raise ClusterError(f"the worker {where or platform.node()} has {', '.join(differences)}; its numbers would be "
                           "others. Install the same versions on all machines.")


_prepared: list[Setup] = []


def prepare(setup: Setup) -> None:
    """Apply the settings of the client, before the first computation of JAX in this process.

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
    """Compute a task in a worker; function and task are pickled, so that nothing is imported before `prepare`."""
    prepare(setup)
    return computed(_loaded(program), pickle.loads(task))


def get_ready(setup: Setup, program: bytes) -> None:
    """Prepare a worker, and import the modules of its tasks."""
    prepare(setup)
    _loaded(program)


@functools.lru_cache(maxsize=4)
def _loaded(program: bytes) -> Callable[[Task], Mapping[str, Any]]:
    """Return the function of a run, one object for all tasks, since compiled programs are cached by it."""
    return pickle.loads(program)


def computed(compute: Callable[[Task], Mapping[str, Any]], task: Task) -> dict[str, np.ndarray]:
    """Compute a task, and convert its result to arrays."""
    try:
        return as_arrays(task, compute(task))
    finally:
        return_memory()


def return_memory() -> None:
    """Return freed memory to the system; the C library keeps over half a gigabyte after a few compilations."""
    with contextlib.suppress(OSError, AttributeError):  # only with the GNU C library
        ctypes.CDLL("libc.so.6").malloc_trim(0)
