"""Computation of tasks whose results are stored one by one, so that a stopped run can be resumed."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfm_ppl.parallel.cluster import Workers, check_workers, compute_on_workers, start_workers
from lfm_ppl.parallel.errors import TasksFailedError
from lfm_ppl.parallel.task import Compute, Computed, Result, Task, compute_task
from lfm_ppl.storage.run_store import DamagedFileError, RunStore
from lfm_ppl.utils.progress import Reporter, TaskProgress


@dataclass(frozen=True)
class Outcome:
    """Result or error of a task, and whether the result was stored before this run."""

    task: Task
    result: Result | None
    error: Exception | None = None
    stored: bool = False

    @property
    def reason(self) -> str:
        """The error in one line."""
        return " ".join(f"{type(self.error).__name__}: {self.error}".split())


def run_tasks(tasks: Iterable[Task], compute: Compute, folder: str | Path | None, **options: Any) -> dict[str, Result]:
    """Compute the tasks as `outcomes` does, and return name -> result; raise TasksFailedError if some failed.

    Example:
        >>> tasks = [Task(f"square/{k}", 0, {"number": k}) for k in range(3)]
        >>> run_tasks(tasks, lambda task: {"value": task.settings["number"] ** 2}, folder=None)["square/2"]
        {'value': 4}
    """
    tasks = list(tasks)
    by_name = {outcome.task.name: outcome for outcome in outcomes(tasks, compute, folder, **options)}
    ordered = [by_name[task.name] for task in tasks]
    if failed := [outcome for outcome in ordered if outcome.error is not None]:
        reasons = {outcome.task.name: outcome.reason for outcome in failed}
        raise TasksFailedError(reasons, len(tasks), folder is not None) from failed[0].error
    return {outcome.task.name: outcome.result for outcome in ordered if outcome.result is not None}


def outcomes(tasks: Iterable[Task], compute: Compute, folder: str | Path | None, *, overwrite: bool = False,
             report: Reporter | None = None, workers: Workers = 1) -> Iterator[Outcome]:
    """Yield the outcome of each task as it ends, stored results first.

    Files are atomic, and a random key depends on its task only. A run that is killed and resumed therefore gives the
    same numbers as an uninterrupted one (measured times apart), for any order and any number of workers. (One process
    with several threads, ``workers=1``, may round sums differently; ``lfm-ppl compare --jobs 1`` has one thread.)

    Args:
        tasks: the tasks, in the order in which they are computed.
        compute: function from a task to its result, which cloudpickle can pickle.
        folder: folder of the files, locked until the last outcome or until the iterator is closed. None: no files.
        overwrite: replace results of other settings, which are an error otherwise. A damaged file is always replaced.
        report: function of each line of progress, or a `lfm_ppl.utils.progress.Console`; None: nothing is shown.
        workers: 1: this process; more: processes of this machine, which need ``if __name__ == "__main__":`` in a
            script; ``"tcp://host:port"``: the workers of a Dask scheduler; a `Cluster`.

    Raises:
        ValueError, FolderInUseError, ClusterError: two tasks share a file, or a stored result was made with other
            settings; another run holds the folder; there are no workers, or the scheduler is lost.
    """
    check_workers(workers)
    by_stem: dict[str, Task] = {}
    for task in tasks:
        if (first := by_stem.setdefault(task.stem, task)) is not task:
            raise ValueError(f"the tasks {first.name!r} and {task.name!r} share the file {task.stem}.npz; rename one.")
    with contextlib.ExitStack() as stack:
        store = None if folder is None else stack.enter_context(RunStore(folder))
        # Other settings of a stored result are an error before anything is computed.
        results = {} if store is None else {stem: _stored(task, store, overwrite) for stem, task in by_stem.items()}
        missing = [task for stem, task in by_stem.items() if results.get(stem) is None]
        done = len(by_stem) - len(missing)
        progress = TaskProgress(report, len(by_stem), done)
        stack.enter_context(progress)
        if done:
            progress.write(f"{done} of {len(by_stem)} tasks are stored already")
        for stem in list(results):
            if (result := results.pop(stem)) is not None:
                yield Outcome(by_stem[stem], result, stored=True)
        cluster = stack.enter_context(start_workers(workers, most=len(missing))) if missing else None
        if cluster is not None:
            progress.write(f"dashboard {cluster.client.dashboard_link}")
        computed = compute_on_workers(cluster, missing, compute) if cluster else _compute_here(missing, compute)
        for task, value, worker_count in computed:
            if isinstance(value, Exception):
                outcome, seconds = Outcome(task, None, value), None
                progress.write(f"failed: {task.name}: {outcome.reason}")
            else:
                arrays, seconds = value
                if store is not None:
                    store.put(task.stem, arrays, task.record())
                outcome = Outcome(task, _plain(arrays))
            progress.end_task(task.name, seconds, worker_count)
            yield outcome


def _compute_here(tasks: list[Task], compute: Compute) -> Iterator[Computed]:
    for task in tasks:
        try:
            yield task, compute_task(compute, task), 1
        except Exception as error:
            yield task, error, 1


def _stored(task: Task, store: RunStore, overwrite: bool) -> Result | None:
    """Return the stored result of a task; None if there is none, if it is damaged or if it is to be replaced."""
    arrays = None
    try:
        arrays = store.get(task.stem, task.record(), overwrite)
    except DamagedFileError:
        warnings.warn(f"{store.path(task.stem)} is damaged; its task runs again.", stacklevel=3)
    return arrays if arrays is None else _plain(arrays)


def _plain(arrays: Mapping[str, Any]) -> Result:
    """Return arrays of no dimension as numbers and text."""
    return {name: array if array.ndim else array.item() for name, array in arrays.items()}
