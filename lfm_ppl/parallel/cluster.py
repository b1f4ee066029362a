"""Workers by Dask: processes of this machine, or the workers of a scheduler. Dask is imported when it is used.

1. `started` starts a local cluster, or connects to a scheduler and checks versions and threads of its workers.
2. `Cluster.computed` submits one task per worker, and another one when a task ends.
3. A task whose worker dies is submitted again by Dask; after four deaths it has failed.
4. Similar tasks on this machine wait for the first one, whose compiled programs they share.
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
import tempfile
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import jax
import numpy as np

from lfm_ppl.parallel import worker
from lfm_ppl.parallel.errors import ClusterError
from lfm_ppl.parallel.task import Task
from lfm_ppl.utils import checks, compilation
from lfm_ppl.utils.compilation import ONE_THREAD

_ANSWER_S = 15
"""Seconds in which a scheduler must answer."""

_WORKER_S = 60
"""Seconds in which a scheduler must have a worker."""

_ALONE_S = 60.0
"""Seconds for which similar tasks wait for the first one, which compiles for all."""

_RESERVE = "XLA_PYTHON_CLIENT_PREALLOCATE"
"""Environment variable: whether JAX takes three quarters of an accelerator's memory at its first computation."""

_COUNT_S = 1.0
"""Seconds after which workers are counted again."""

_LOST_S = 0.1
"""Seconds between two checks for a lost result."""

_RESTART_S = 20.0
"""Seconds in which Dask must have started a dead worker again, or another takes its place."""

_DEATHS = 4
"""Number of workers that may die during a task before it fails."""

_REMEDY = ("Start one with `dask scheduler`, and workers with `dask worker tcp://HOST:PORT --nthreads 1 --nworkers N` "
           "(in the same environment as here).")


class Cluster:
    """Running workers; made by `started`.

    Attributes:
        dashboard: address of Dask's dashboard; None without one.
    """

    def __init__(self, client: Any, setup: worker.Setup, dashboard: str | None, local: Any = None,
                 worker_count: int = 1) -> None:
        self._client, self._setup, self.dashboard = client, setup, dashboard
        # Dask restarts a dead worker, but not one that dies while it starts.
        self._local, self._wanted, self._complete = local, worker_count, time.monotonic()

    def computed(self, tasks: Iterable[Task], compute: Callable[[Task], Mapping[str, Any]], alike: bool = False
                 ) -> Iterator[tuple[Task, dict[str, np.ndarray] | Exception]]:
        """Yield each task when it ends, with its arrays or its error.

        A task whose worker dies is computed by another one. At most one task per worker is submitted, so that the task
        of a dead worker is known and few results wait for the client.

        Args:
            tasks: the tasks.
            compute: function from a task to its result.
            alike: whether the tasks run the same programs. On this machine they then wait for the first one, a minute
                at most, and use its compiled programs.

        Raises:
            ClusterError: the scheduler is lost, or a worker has other versions.
        """
        import cloudpickle
        from distributed import CancelledError, wait

        program, waiting = cloudpickle.dumps(compute), iter(tasks)
        running: dict[Any, Task] = {}
        counted, workers, start_time = -np.inf, 1, time.monotonic()
        first = alike and self._local is not None

        def submit() -> None:
            nonlocal counted, workers
            if time.monotonic() - counted > _COUNT_S:
                counted, workers = time.monotonic(), max(self._count(), 1)
            most = 1 if first and time.monotonic() - start_time < _ALONE_S else workers
            for task in itertools.islice(waiting, max(most - len(running), 0)):
                future = self._client.submit(worker.work, self._setup, program, pickle.dumps(task), pure=False,
                                             key=f"{task.name}-{uuid.uuid4().hex}")
                running[future] = task

        ready: list[Any] = []
        try:
            for address in self._client.nthreads() if first else ():
                # While the first task compiles, the other workers import modules.
                ready.append(self._client.submit(worker.get_ready, self._setup, program, pure=False, workers=[address],
                                                 allow_other_workers=True))
            submit()
            while running:
                try:
                    ended = wait(list(running), timeout=_COUNT_S, return_when="FIRST_COMPLETED").done
                except TimeoutError:
                    submit()
                    continue
                for future in ended:
                    if future.status == "lost":  # its worker died: Dask computes it again
                        time.sleep(_LOST_S)
                        continue
                    task = running.pop(future)
                    outcome = self._outcome(future)
                    first = first and isinstance(outcome, Exception)
                    submit()
                    yield task, outcome
                del future, ended  # workers may free the results
        except (OSError, TimeoutError, CancelledError) as error:  # of Dask's communication
            raise ClusterError(self._lost()) from error
        finally:
            with contextlib.suppress(Exception):
                self._client.cancel([*running, *ready], asynchronous=False)

    def _count(self) -> int:
        """Return the number of workers, and replace a local worker that does not come back."""
        running_count = len(self._client.nthreads())
        if self._local is not None and running_count < self._wanted:
            if time.monotonic() - self._complete > _RESTART_S:
                self._local.scale(len(self._local.worker_spec) + self._wanted - running_count)
                self._complete = time.monotonic()
        else:
            self._complete = time.monotonic()
        return running_count

    def _outcome(self, future: Any) -> dict[str, np.ndarray] | Exception:
        from distributed import KilledWorker

        if future.status == "finished":
            return future.result()
        if future.status != "error":
            raise ClusterError(self._lost())
        error = future.exception()
        if isinstance(error, KilledWorker):
            return ClusterError(
                f"{_DEATHS} workers died during this task, probably for lack of memory; use fewer workers (--jobs)."
            )
        if isinstance(error, ClusterError):
            raise error
        return error if isinstance(error, Exception) else RuntimeError(f"{type(error).__name__}: {error}")

    def _lost(self) -> str:
        return ("the connection to the scheduler is lost. Stored results are kept; the same call or command computes "
                "the rest.")


Workers = int | str | Cluster
"""Number of processes of this machine, address of a scheduler, or running workers."""


def check_workers(workers: Workers) -> None:
    """Raise ValueError unless ``workers`` is a positive number, an address or a cluster.

    Example:
        >>> check_workers("localhost")
        Traceback (most recent call last):
            ...
        ValueError: the address of a scheduler looks like tcp://host:8786 (or tls://host:8786), got 'localhost'.
    """
    if isinstance(workers, Cluster):
        return
    if not isinstance(workers, str):
        checks.positive_integer("workers", workers)
    elif not re.fullmatch(r"(tcp|tls|ucx|ws|wss)://.+:\d+", workers):
        raise ValueError("the address of a scheduler looks like tcp://host:8786 (or tls://host:8786), got "
                         f"{workers!r}.")


def available() -> int:
    """Return the number of CPUs; 1 if Dask, which starts processes, is not installed."""
    return 1 if importlib.util.find_spec("distributed") is None else compilation.cpus()


@contextlib.contextmanager
def started(workers: Workers, most: int | None = None) -> Iterator[Cluster | None]:
    """Start workers, or connect to a scheduler, and stop started workers at the end; None for this process.

    Args:
        workers: 1: this process; a larger number: processes of this machine, with one thread each and local
            connections; ``"tcp://host:port"``: the workers of a scheduler; a cluster: itself.
        most: largest number of processes.

    Raises:
        ClusterError: Dask is not installed; the scheduler does not answer, or has no workers, or unsuitable ones.
    """
    check_workers(workers)
    if isinstance(workers, Cluster):
        yield workers
    elif workers == 1:
        yield None
    elif importlib.util.find_spec("distributed") is None:
        raise ClusterError(
            "several processes need Dask: pip install 'lfm_ppl[cluster]', or use one process (--jobs 1)."
        )
    elif isinstance(workers, str):
        with _connected(workers) as client:
            setup = worker.Setup.of_this_process(None)
            check_fit(client, setup)
            yield Cluster(client, setup, _dashboard(client))
    else:
        worker_count = workers if most is None else min(workers, most)
        with _embedded(worker_count) as client:
            yield Cluster(
                client,
                worker.Setup.of_this_process(programs_folder()),
                _dashboard(client),
                client.cluster,
                worker_count,
            )


@contextlib.contextmanager
def _embedded(workers: int) -> Iterator[Any]:
    import dask
    from distributed import Client, LocalCluster

    # Two processes cannot each take most of an accelerator's memory.
    jax_environment = {"JAX_ENABLE_X64": str(int(jax.config.read("jax_enable_x64"))),
           _RESERVE: os.environ.get(_RESERVE, "false")}
    settings = {
        "distributed.worker.multiprocessing-method": "spawn",
        "distributed.nanny.pre-spawn-environ": {**_nanny_environment(), **ONE_THREAD, **jax_environment},
        "distributed.scheduler.allowed-failures": _DEATHS - 1,
        "distributed.scheduler.work-stealing": False,
        # The profiler of the dashboard samples the stack every hundredth of a second.
        "distributed.worker.profile.enabled": False,
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
        # JAX keeps freed memory, so that a memory limit would pause workers for good.
        local = stack.enter_context(LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1", memory_limit=0,
            dashboard_address="127.0.0.1:0" if _has_dashboard() else None, silence_logs=logging.CRITICAL))
        yield stack.enter_context(Client(local))


def _nanny_environment() -> dict[str, str]:
    import dask

    return {name: str(value) for name, value in dask.config.get("distributed.nanny.pre-spawn-environ").items()}


@contextlib.contextmanager
def _connected(address: str) -> Iterator[Any]:
    from distributed import Client

    try:
        client = Client(address, timeout=_ANSWER_S)
    except (OSError, TimeoutError, ValueError) as error:
        raise ClusterError(f"no scheduler answers at {address} ({error}). {_REMEDY}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_WORKER_S)
        except (TimeoutError, OSError) as error:
            raise ClusterError(f"the scheduler at {address} has no workers. {_REMEDY}") from error
        yield client


def check_fit(client: Any, setup: worker.Setup) -> None:
    """Raise ClusterError if a worker has several threads or other versions."""
    threads = {address: count for address, count in client.nthreads().items() if count != 1}
    if threads:
        address, count = next(iter(threads.items()))
        raise ClusterError(f"the worker {address} has {count} threads, but models are traced by one at a time. Start "
                           "it with `dask worker ... --nthreads 1 --nworkers N`.")
    for address, worker_versions in client.run(worker.versions, on_error="return").items():
        if isinstance(worker_versions, BaseException):
            raise ClusterError(
                f"the worker {address} cannot run lfm_ppl {setup.versions['lfm_ppl']} "
                f"({type(worker_versions).__name__}: {worker_versions}). Install the same versions on all machines."
            )
        worker.check_versions(worker_versions, setup.versions, address)


def _dashboard(client: Any) -> str | None:
    return client.dashboard_link if _has_dashboard() else None


def _has_dashboard() -> bool:
    return importlib.util.find_spec("bokeh") is not None


def programs_folder() -> str:
    """Return the shared folder of compiled programs: the cache of this process, or a temporary folder."""
    return jax.config.jax_compilation_cache_dir or _temporary().name  # type: ignore[attr-defined]


@functools.cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="lfm-ppl-")
