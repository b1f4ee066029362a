"""Experiments as tasks that are stored one by one, so that a run that was stopped goes on where it was."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import hashlib
import itertools
import json
import multiprocessing
import os
import signal
import tempfile
import threading
import time
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lfm_ppl import checks
from lfm_ppl.results.files import writing

Result = dict[str, Any]
"""Name -> number or small array."""

_TASK = "__task__"
_REWRITE_S = 1.0
"""Least time between two progress lines."""


@dataclasses.dataclass(frozen=True)
class Task:
    """One piece of an experiment: what is computed in one go and stored in one file.

    Attributes:
        name: unlike that of every other task of the experiment, such as ``state/EKF/007``.
        seed: of the experiment. The key of the task follows from it and from the name alone.
        settings: whatever the result depends on, in values that JSON knows.

    Example:
        >>> task = Task("state/EKF/007", 0, {"model": "ginzburg-landau", "steps": 60})
        >>> task.file
        'state-EKF-007.npz'
    """

    name: str
    seed: int
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the name and that the settings can be stored."""
        if not self.name or set(self.name) - set(_ALLOWED):
            raise ValueError(f"the name of a task takes letters, digits and any of / - _ . ( ), got {self.name!r}.")
        try:
            json.dumps(dict(self.settings), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise TypeError(f"the settings of task {self.name} must be what JSON can store: {error}.") from None

    @property
    def file(self) -> str:
        """Name of the file that holds the result."""
        return f"{self.name.replace('/', '-')}.npz"

    @property
    def key(self) -> jax.Array:
        """JAX random key of the task, the same whatever else runs and in whatever order."""
        digest = hashlib.sha256(self.name.encode()).digest()
        return jax.random.fold_in(jax.random.key(self.seed), int.from_bytes(digest[:4], "big"))

    def record(self) -> dict[str, Any]:
        """Return what is stored beside the result, as JSON gives it back."""
        return json.loads(json.dumps({"name": self.name, "seed": self.seed, "settings": dict(self.settings)}))


_ALLOWED = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789/-_.()"


def run_tasks(tasks: Iterable[Task], compute: Callable[[Task], Mapping[str, Any]], folder: str | Path, *,
              overwrite: bool = False, report: Callable[[str], None] | None = None,
              workers: int = 1) -> dict[str, Result]:
    """Compute every task that ``folder`` does not hold yet, each into a file of its own, and return all results.

    A file is there whole or not at all, and a random key depends on its task alone. A run that is killed and started
    again therefore ends with the same numbers as one that is not (measured times apart), if it has as many processes:
    sums that are split among other numbers of CPUs are rounded otherwise.

    Args:
        tasks: the tasks, in the order in which they are computed.
        compute: from a task to its result: numbers, arrays and text by name. With several workers a function at the
            top of a module.
        folder: of the files; made where it does not exist.
        overwrite: compute again what was stored with other settings, which is an error otherwise.
        report: what to do with a line of progress, such as ``print``; None: nothing.
        workers: processes that compute; each compiles what it finds compiled by no other one, also by those of an
            earlier call.

    Returns:
        Name of a task -> its result, read from its file, in the order of the tasks.

    Raises:
        ValueError: two tasks share a file, or a stored result was made with other settings.
        RuntimeError: a process ended by itself.

    Warns:
        UserWarning: a file cannot be read; its task is computed again.

    Example:
        >>> import tempfile
        >>> tasks = [Task(f"square/{k}", 0, {"number": k}) for k in range(3)]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     found = run_tasks(tasks, lambda task: {"value": task.settings["number"] ** 2}, folder)
        >>> float(found["square/2"]["value"])
        4.0
    """
    checks.positive_integer("workers", workers)
    tasks, folder = list(tasks), Path(folder)
    _check_distinct(tasks)
    stored = {task.name: _stored(task, folder, overwrite) for task in tasks}
    missing = [task for task in tasks if stored[task.name] is None]
    progress = _Progress(len(tasks), len(missing), report)
    for task in _computed(missing, compute, folder, min(workers, len(missing))):
        stored[task.name] = read(task, folder)
        progress.done(task)
    return {task.name: result for task in tasks if (result := stored[task.name]) is not None}


def _computed(tasks: list[Task], compute: Callable[[Task], Mapping[str, Any]], folder: Path,
              workers: int) -> Iterator[Task]:
    """Compute and store the tasks; yield each when its file is there."""
    if workers <= 1:
        for task in tasks:
            _compute_and_write(compute, task, folder)
            yield task
        return
    double = bool(jax.config.read("jax_enable_x64"))
    waiting, context = iter(tasks), multiprocessing.get_context("spawn")
    begun = context.Value("i", 0)
    programs = jax.config.jax_compilation_cache_dir or _programs().name  # type: ignore[attr-defined]
    shortest = jax.config.jax_persistent_cache_min_compile_time_secs  # type: ignore[attr-defined]
    with ProcessPoolExecutor(workers, context, _start_worker, (double, begun, workers, programs, shortest)) as pool:
        # As many at a time as there are processes. After an error, or Ctrl-C, what has begun is let finish and kept.
        running = {pool.submit(_compute_and_write, compute, task, folder): task
                   for task in itertools.islice(waiting, workers)}
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                task = running.pop(future)
                try:
                    future.result()
                except BrokenProcessPool:
                    raise RuntimeError("a computing process ended by itself, most likely for want of memory; what is "
                                       "stored stays. Start again with fewer workers (--jobs).") from None
                for following in itertools.islice(waiting, 1):
                    running[pool.submit(_compute_and_write, compute, following, folder)] = following
                yield task


@functools.cache
def _programs() -> tempfile.TemporaryDirectory[str]:
    """Return a folder where processes find what others have compiled; it goes when this process ends."""
    return tempfile.TemporaryDirectory(prefix="lfm-ppl-")


def _start_worker(double: bool, begun: Any, workers: int, programs: str, shortest: float) -> None:
    # Ctrl-C reaches every process of a terminal; the parent decides. If that is killed, there is nobody to work for.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with begun.get_lock():
        number, begun.value = begun.value, begun.value + 1
    _keep_to_share(number, workers)
    jax.config.update("jax_enable_x64", double)
    jax.config.update("jax_compilation_cache_dir", programs)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", shortest)


def _keep_to_share(number: int, workers: int) -> None:
    """Run on this worker's share of the CPUs alone, where the system lets it, before JAX counts them for its threads.

    Each process would otherwise have as many threads as there are CPUs, which hand small operations to one another: two
    Hamiltonian chains side by side on two CPUs took over four times as long as one by itself.
    """
    if hasattr(os, "sched_setaffinity"):  # not on macOS and Windows
        with contextlib.suppress(OSError):  # a sandbox may forbid it
            os.sched_setaffinity(0, share(os.sched_getaffinity(0), number, workers))


def share(cpus: Iterable[int], number: int, workers: int) -> list[int]:
    """Return the CPUs of worker ``number``: disjoint and all of them together, or one each where they are too few.

    Example:
        >>> share([0, 1, 2], 0, 2), share([0, 1, 2], 1, 2), share([0, 1], 2, 3)
        ([0, 2], [1], [0])
    """
    ordered = sorted(cpus)
    return ordered[number % workers::workers] or [ordered[number % len(ordered)]]


def available_cpus() -> int:
    """Return the number of CPUs that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _compute_and_write(compute: Callable[[Task], Mapping[str, Any]], task: Task, folder: Path) -> None:
    write(task, compute(task), folder, overwrite=True)
    _return_memory()


def _return_memory() -> None:
    """Give freed memory back to the system: the C library keeps it, over half a gigabyte after a few compilations."""
    with contextlib.suppress(OSError, AttributeError):  # neither on macOS nor on Windows, nor with another C library
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def write(task: Task, result: Mapping[str, Any], folder: str | Path, overwrite: bool = False) -> Path:
    """Write the result of a task to its file in ``folder``, whole or not at all.

    Raises:
        ValueError: an entry of the result is not a number, an array or text.
    """
    arrays = {name: np.asarray(value) for name, value in result.items()}
    for name, value in arrays.items():
        if value.dtype.kind not in "biufU" or name == _TASK:
            raise ValueError(f"the result of task {task.name} has an entry {name!r} that is not a number, an array of "
                             f"numbers or text, but {type(result[name]).__name__}.")
    path = Path(folder) / task.file
    with writing(path, overwrite) as temporary:
        np.savez(temporary, **{_TASK: np.asarray(json.dumps(task.record()))}, **arrays)  # type: ignore[arg-type]
    return path


def read(task: Task, folder: str | Path) -> Result:
    """Read the result of a task.

    Raises:
        FileNotFoundError: it is not stored.
        ValueError: it was made with other settings.
        OSError, KeyError, zipfile.BadZipFile: the file is damaged.
    """
    path = Path(folder) / task.file
    with np.load(path) as kept:
        found = {name: kept[name] for name in kept.files}
    record, wanted = json.loads(str(found.pop(_TASK))), task.record()
    if record != wanted:
        raise _Other(f"{path} holds a result that was made with other settings: {_difference(record, wanted)}. Choose "
                     "another folder, or replace it with overwrite=True (--overwrite on the command line).")
    return {name: value.item() if value.ndim == 0 else value for name, value in found.items()}


class _Other(ValueError):
    """A stored result is that of another task."""


def _stored(task: Task, folder: Path, overwrite: bool) -> Result | None:
    try:
        return read(task, folder)
    except FileNotFoundError:
        return None
    except _Other:
        if overwrite:
            return None
        raise
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        warnings.warn(f"{folder / task.file} cannot be read ({type(error).__name__}: {error}); its task runs again.",
                      stacklevel=3)
        return None


def _difference(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """Name the first few settings that differ, as ``name stored -> wanted``."""
    flat = [{"name": record.get("name"), "seed": record.get("seed"), **record.get("settings", {})}
            for record in (found, wanted)]
    names = [name for name in {**flat[0], **flat[1]} if flat[0].get(name) != flat[1].get(name)]
    return ", ".join(f"{name} is {flat[0].get(name)!r} there and {flat[1].get(name)!r} now" for name in names[:3])


def _check_distinct(tasks: list[Task]) -> None:
    seen: dict[str, str] = {}
    for task in tasks:
        if task.file in seen:
            raise ValueError(f"the tasks {seen[task.file]!r} and {task.name!r} share the file {task.file}; give every "
                             "task a name of its own.")
        seen[task.file] = task.name


class _Progress:
    """Lines such as ``12/40 state/EKF/003, about 2 min left``, at most one a second."""

    def __init__(self, total: int, missing: int, report: Callable[[str], None] | None) -> None:
        self.total, self.missing, self.report = total, missing, report
        self.finished, self.started, self.last = 0, time.perf_counter(), -np.inf
        if report is not None and missing < total:
            report(f"{total - missing} of {total} tasks are stored already")

    def done(self, task: Task) -> None:
        self.finished += 1
        now = time.perf_counter()
        if self.report is None or (now - self.last < _REWRITE_S and self.finished < self.missing):
            return
        self.last = now
        left = (now - self.started) / self.finished * (self.missing - self.finished)
        count = self.total - self.missing + self.finished
        self.report(f"{count}/{self.total} {task.name}, {duration(left)} left" if left else
                    f"{count}/{self.total} {task.name}")


def duration(seconds: float) -> str:
    """Return a length of time in the words of a person.

    Example:
        >>> [duration(s) for s in (0.4, 42.0, 400.0, 8000.0)]
        ['0.4 s', '42 s', '7 min', '2.2 h']
    """
    checks.finite("seconds", seconds)
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
