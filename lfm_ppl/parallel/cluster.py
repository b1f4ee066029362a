"""Workers by Dask: processes of this machine, or the workers of a scheduler. Dask is imported when it is used.

1. `start_workers` starts a local cluster or connects to a scheduler; Dask restarts dead workers.
2. `compute_on_workers` keeps one task per worker submitted. Dask repeats tasks that fail or whose worker dies.
3. A worker computes with one thread and the settings of this process, so that the numbers are the same.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import itertools
import logging
import os
import pickle
import re
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from typing import TYPE_CHECKING, Any

import jax

from lfm_ppl.parallel.errors import ClusterError
from lfm_ppl.parallel.task import Compute, Computed, Task, TimedArrays, compute_task
from lfm_ppl.utils import checks, compilation

if TYPE_CHECKING:
    from distributed import Client

_HAS_DASK = importlib.util.find_spec("distributed") is not None

_CACHE_FOLDER, _SHORTEST = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
_CACHE_SIZE = "jax_compilation_cache_max_size"
_ANSWER_S = 30
"""Seconds in which a scheduler must answer, and then in which it must have a worker."""


@dataclass(frozen=True)
class Cluster:
    """Running workers, and settings of JAX for them."""

    client: Client
    jax_config: dict[str, Any]


Workers = int | str | Cluster
"""Number of processes of this machine, address of a scheduler, or running workers."""


def check_workers(workers: Workers) -> None:
    """Raise ValueError unless ``workers`` is a positive number, an address or a cluster."""
    if isinstance(workers, str):
        if not re.fullmatch(r"(tcp|tls|ucx|ws|wss)://.+:\d+", workers):
            raise ValueError(f"the address of a scheduler looks like tcp://host:8786, got {workers!r}.")
    elif not isinstance(workers, Cluster):
        checks.positive_integer("workers", workers)


def available() -> int:
    """Return the number of CPUs; 1 if Dask, which starts processes, is not installed."""
    return compilation.cpus() if _HAS_DASK else 1


@contextlib.contextmanager
def start_workers(workers: Workers, most: int | None = None) -> Iterator[Cluster | None]:
    """Start at most ``most`` processes or connect to a scheduler, and close them at the end; None for this process."""
    check_workers(workers)
    if workers == 1:
        yield None
    elif isinstance(workers, Cluster):
        yield workers
    elif not _HAS_DASK:
        raise ClusterError("several processes need Dask: pip install 'lfm_ppl[cluster]', or use one (--jobs 1).")
    else:
        with contextlib.ExitStack() as stack:
            yield (_connect(workers, stack) if isinstance(workers, str)
                   else _start_processes(min(workers, most or workers), stack))


def _start_processes(count: int, stack: contextlib.ExitStack) -> Cluster:
    import dask
    from distributed import Client, LocalCluster

    cache = {name: getattr(jax.config, name) for name in (_CACHE_FOLDER, _SHORTEST, _CACHE_SIZE)}
    if cache[_CACHE_FOLDER] is None:
        cache = {_CACHE_FOLDER: stack.enter_context(tempfile.TemporaryDirectory(prefix="lfm-ppl-")), _SHORTEST: 0.0}
    # The profiler of the dashboard samples the stack every hundredth of a second.
    stack.enter_context(dask.config.set({"distributed.worker.profile.enabled": False}))
    # JAX keeps freed memory, so that a memory limit would pause workers for good. Ctrl-C is for this process alone; it
    # ends the workers, which would print tracebacks otherwise.
    processes = stack.enter_context(LocalCluster(
        n_workers=count, threads_per_worker=1, processes=True, host="127.0.0.1", memory_limit=0,
        dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL,
        preload=["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"]))
    return Cluster(stack.enter_context(Client(processes)), cache)


def _connect(address: str, stack: contextlib.ExitStack) -> Cluster:
    from distributed import Client

    remedy = ("Start it with `dask scheduler`, and workers in the same environment as here with "
              "`dask worker tcp://HOST:PORT --nthreads 1 --nworkers N`.")
    try:
        client = stack.enter_context(Client(address, timeout=_ANSWER_S))
        client.wait_for_workers(1, timeout=_ANSWER_S)
    except (OSError, TimeoutError, ValueError) as error:
        raise ClusterError(f"no scheduler with workers answers at {address} ({error}). {remedy}") from error
    if max(client.nthreads().values()) > 1:
        raise ClusterError(f"a worker of {address} has several threads, but models are traced by one. {remedy}")
    try:
        client.run(_versions)
    except ModuleNotFoundError as error:
        raise ClusterError(f"a worker of {address} does not have lfm_ppl ({error}). {remedy}") from error
    return Cluster(client, {})


def compute_on_workers(cluster: Cluster, tasks: list[Task], compute: Compute) -> Iterator[Computed]:
    """Yield each task when it ends, with the value of `compute_task` or its error, and the number of workers."""
    import cloudpickle
    from distributed import CancelledError, KilledWorker, as_completed

    # By default each process would take three quarters of an accelerator's memory.
    defaults = {"XLA_FLAGS": "", "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    environment = compilation.ONE_THREAD | {name: os.environ.get(name, text) for name, text in defaults.items()}
    jax_config = {"jax_enable_x64": jax.config.read("jax_enable_x64"), **cluster.jax_config}
    client, program, settings = cluster.client, cloudpickle.dumps(compute), (_versions(), environment, jax_config)
    waiting, futures, ended = iter(tasks), dict[Any, Task](), as_completed(loop=client.loop)

    def submit() -> int:
        worker_count = max(len(client.nthreads()), 1)
        # One task per worker: the scheduler would hold the data of all tasks in memory otherwise.
        for task in itertools.islice(waiting, max(worker_count - len(futures), 0)):
            future = client.submit(_compute_on_worker, program, pickle.dumps(task), *settings, pure=False, retries=1)
            futures[future] = task
            ended.add(future)
        return worker_count

    try:
        submit()
        for future in ended:
            task, error = futures.pop(future), future.exception()
            if isinstance(error, ClusterError):
                raise error
            if isinstance(error, KilledWorker):
                error = ClusterError("workers died during this task, probably for lack of memory; use fewer (--jobs).")
            outcome = future.result() if error is None else error
            del future  # workers may free the result
            yield task, outcome, submit()
    except (OSError, TimeoutError, CancelledError) as error:  # of Dask's communication
        raise ClusterError("the connection to the scheduler is lost. Stored results are kept; the same call or command "
                           "computes the rest.") from error
    finally:
        with contextlib.suppress(Exception):
            client.cancel(list(futures))


def _compute_on_worker(program: bytes, task: bytes, versions: dict, environment: dict, jax_config: dict) -> TimedArrays:
    """Compute a task; function and task are pickled, so that JAX computes nothing before its settings."""
    if _versions() != versions:
        raise ClusterError(f"a worker has {_versions()}, and this process {versions}; its numbers would be others. "
                           "Install the same versions on all machines.")
    os.environ.update(environment)
    for name, value in jax_config.items():
        jax.config.update(name, value)
    return compute_task(_load(program), pickle.loads(task))


@functools.lru_cache(maxsize=4)
def _load(program: bytes) -> Compute:
    """Return the function of a run, one object for all tasks, since compiled programs are cached by it."""
    return pickle.loads(program)


def _versions() -> dict[str, str]:
    """Return the versions that numbers depend on."""
    return {"python": "{}.{}".format(*sys.version_info[:2])} | {
        name: metadata.version(name) for name in ("lfm_ppl", "jax", "jaxlib", "numpyro", "numpy")}
