"""Workers: processes of this machine, or those of a scheduler, by Dask. Nothing here imports Dask before it is used."""

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

from lfm_ppl.engine import worker
from lfm_ppl.engine.errors import ClusterError
from lfm_ppl.engine.task import Task
from lfm_ppl.utils import checks, compilation
from lfm_ppl.utils.compilation import ONE_THREAD

_ANSWER_S = 15
"""Seconds in which a scheduler must answer."""

_WORKER_S = 60
"""Seconds in which a scheduler must have a worker."""

_ALONE_S = 60.0
"""Seconds for which tasks that are alike wait for the first one, which compiles for all."""

_RESERVE = "XLA_PYTHON_CLIENT_PREALLOCATE"
"""Environment variable: whether JAX takes three quarters of an accelerator's memory at its first computation."""

_COUNT_S = 1.0
"""Seconds after which workers are counted again."""

_LOST_S = 0.1
"""Seconds after which it is looked again whether a lost result is there."""

_RESTART_S = 20.0
"""Seconds in which Dask must have started a dead worker again, or another takes its place."""

_DEATHS = 4
"""Workers that may die over a task before it has failed; with one thread each, only the task itself can be why."""

_REMEDY = ("Start one with `dask scheduler`, and workers with `dask worker tcp://HOST:PORT --nthreads 1 --nworkers N` "
           "(in the same environment as here).")


class Cluster:
    """Workers that run; made by `started`.

    Attributes:
        dashboard: address of Dask's dashboard; None where there is none.
    """

    def __init__(self, client: Any, setup: worker.Setup, dashboard: str | None, local: Any = None,
                 wanted: int = 1) -> None:
        self._client, self._setup, self.dashboard = client, setup, dashboard
        # Dask starts a dead worker again, but gives up one that dies while it starts.
        self._local, self._wanted, self._complete = local, wanted, time.monotonic()

    def computed(self, tasks: Iterable[Task], compute: Callable[[Task], Mapping[str, Any]], alike: bool = False
                 ) -> Iterator[tuple[Task, dict[str, np.ndarray] | Exception]]:
        """Yield each task when it is computed, with its arrays or with the error that it ended with.

        A task whose worker dies is computed by another one. There are never more tasks under way than there are
        workers: so a dead worker leaves no doubt over which task it died, and what waits for the client is little.

        Args:
            tasks: the tasks.
            compute: from a task to its result.
            alike: whether they run the same programs. On this machine others then wait for the first one that is
                computed, a minute at most, and find what it compiled.

        Raises:
            ClusterError: the scheduler is lost, or a worker has other versions.
        """
        import cloudpickle
        from distributed import CancelledError, wait

        program, waiting = cloudpickle.dumps(compute), iter(tasks)
        running: dict[Any, Task] = {}
        counted, workers, begun = -np.inf, 1, time.monotonic()
        first = alike and self._local is not None

        def submit() -> None:
            nonlocal counted, workers
            if time.monotonic() - counted > _COUNT_S:
                counted, workers = time.monotonic(), max(self._count(), 1)
            most = 1 if first and time.monotonic() - begun < _ALONE_S else workers
            for task in itertools.islice(waiting, max(most - len(running), 0)):
                future = self._client.submit(worker.work, self._setup, program, pickle.dumps(task), pure=False,
                                             key=f"{task.name}-{uuid.uuid4().hex}")
                running[future] = task

        ready: list[Any] = []
        try:
            for address in self._client.nthreads() if first else ():
                # While the first task compiles, the others import what tasks need.
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
                    if future.status == "lost":  # its worker died with the result: Dask computes it again
                        time.sleep(_LOST_S)
                        continue
                    task = running.pop(future)
                    found = self._outcome(future)
                    first = first and isinstance(found, Exception)
                    submit()
                    yield task, found
                del future, ended  # results need not stay with the workers
        except (OSError, TimeoutError, CancelledError) as error:  # of Dask's own communication
            raise ClusterError(self._lost()) from error
        finally:
            with contextlib.suppress(Exception):
                self._client.cancel([*running, *ready], asynchronous=False)

    def _count(self) -> int:
        """Return the number of workers; where one was started here and stays away, start another in its place."""
        found = len(self._client.nthreads())
        if self._local is not None and found < self._wanted:
            if time.monotonic() - self._complete > _RESTART_S:
                self._local.scale(len(self._local.worker_spec) + self._wanted - found)
                self._complete = time.monotonic()
        else:
            self._complete = time.monotonic()
        return found

    def _outcome(self, future: Any) -> dict[str, np.ndarray] | Exception:
        from distributed import KilledWorker

        if future.status == "finished":
            return future.result()
        if future.status != "error":
            raise ClusterError(self._lost())
        error = future.exception()
        if isinstance(error, KilledWorker):
            return ClusterError(f"{_DEATHS} workers died over it, most likely for want of memory; take fewer (--jobs).")
        if isinstance(error, ClusterError):
            raise error
        return error if isinstance(error, Exception) else RuntimeError(f"{type(error).__name__}: {error}")

    def _lost(self) -> str:
        return ("the connection to the scheduler is lost. What is stored stays; the same call or command computes the "
                "rest.")


Workers = int | str | Cluster
"""What computes: so many processes of this machine, the address of a scheduler, or workers that run already."""


def check_workers(workers: Workers) -> None:
    """Raise where ``workers`` is neither a positive number, nor an address, nor a cluster.

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
    """Return how many processes there are CPUs for; 1 where Dask, which starts them, is not installed."""
    return 1 if importlib.util.find_spec("distributed") is None else compilation.cpus()


@contextlib.contextmanager
def started(workers: Workers, most: int | None = None) -> Iterator[Cluster | None]:
    """Start workers, or find those of a scheduler, and end what was started; None where this process is to compute.

    Args:
        workers: 1: this process; more: so many processes of this machine, with one thread each, that listen to this
            machine alone; ``"tcp://host:port"``: those of a scheduler; a cluster: itself.
        most: processes that are started at the most.

    Raises:
        ClusterError: Dask is not installed; the scheduler does not answer, has no workers, or some that do not fit.
    """
    check_workers(workers)
    if isinstance(workers, Cluster):
        yield workers
    elif workers == 1:
        yield None
    elif importlib.util.find_spec("distributed") is None:
        raise ClusterError("several processes need Dask: pip install 'lfm_ppl[cluster]', or take one (--jobs 1).")
    elif isinstance(workers, str):
        with _connected(workers) as client:
            setup = worker.Setup.here(None)
            check_fit(client, setup)
            yield Cluster(client, setup, _dashboard(client))
    else:
        wanted = workers if most is None else min(workers, most)
        with _embedded(wanted) as client:
            yield Cluster(client, worker.Setup.here(programs_folder()), _dashboard(client), client.cluster, wanted)


@contextlib.contextmanager
def _embedded(workers: int) -> Iterator[Any]:
    import dask
    from distributed import Client, LocalCluster

    # Two processes cannot each take most of an accelerator's memory.
    own = {"JAX_ENABLE_X64": str(int(jax.config.read("jax_enable_x64"))),
           _RESERVE: os.environ.get(_RESERVE, "false")}
    settings = {
        "distributed.worker.multiprocessing-method": "spawn",
        "distributed.nanny.pre-spawn-environ": {**_nanny_environment(), **ONE_THREAD, **own},
        "distributed.scheduler.allowed-failures": _DEATHS - 1,
        "distributed.scheduler.work-stealing": False,
        # It looks at the stack of a task every hundredth of a second, for a page of the dashboard.
        "distributed.worker.profile.enabled": False,
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
        # JAX keeps memory of its own, so that a bound would stop a worker for good where the system can still help.
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
    """Raise ClusterError where a worker has several threads or other versions."""
    threads = {address: count for address, count in client.nthreads().items() if count != 1}
    if threads:
        address, count = next(iter(threads.items()))
        raise ClusterError(f"the worker {address} has {count} threads, but models are traced by one at a time. Start "
                           "it with `dask worker ... --nthreads 1 --nworkers N`.")
    for address, found in client.run(worker.versions, on_error="return").items():
        if isinstance(found, BaseException):
            raise ClusterError(f"the worker {address} cannot run lfm_ppl {setup.versions['lfm_ppl']} "
                               f"({type(found).__name__}: {found}). Install the same versions on all machines.")
        worker.check_versions(found, setup.versions, address)


def _dashboard(client: Any) -> str | None:
    return client.dashboard_link if _has_dashboard() else None


def _has_dashboard() -> bool:
    return importlib.util.find_spec("bokeh") is not None


def programs_folder() -> str:
    """Return where processes find what others have compiled: this process's folder, or one that goes with it."""
    return jax.config.jax_compilation_cache_dir or _temporary().name  # type: ignore[attr-defined]


@functools.cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="lfm-ppl-")
