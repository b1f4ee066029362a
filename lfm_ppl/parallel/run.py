"""Computation of tasks whose results are stored one by one, so that a stopped run can be resumed.

1. Lock the folder, and read the stored results of the tasks.
2. Compute the missing ones in this process or by workers.
3. Store each result in a file as it ends, and yield it; a failed task does not stop the others.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfm_ppl.parallel.cluster import Workers, check_workers, started
from lfm_ppl.parallel.errors import TasksFailedError
from lfm_ppl.parallel.store import plain_values, read_result, write_result
from lfm_ppl.parallel.task import Result, Task, check_distinct
from lfm_ppl.parallel.worker import computed
from lfm_ppl.utils.progress import Progress, Reporter
from lfm_ppl.utils.run_store import RunStore


@dataclass(frozen=True)
class Outcome:
    """Result or error of a task.

    Attributes:
        task: the task.
        result: its result; None after a failure.
        error: the error; None after a success.
        stored: whether the result was stored before this run.
    """

    task: Task
    result: Result | None
    error: Exception | None = None
    stored: bool = False

    @property
    def reason(self) -> str:
        """The error in one line; empty after a success."""
        return "" if self.error is None else " ".join(f"{type(self.error).__name__}: {self.error}".split())


def run_tasks(tasks: Iterable[Task], compute: Callable[[Task], Mapping[str, Any]], folder: str | Path | None, *,
              overwrite: bool = False, report: Reporter | None = None, workers: Workers = 1) -> dict[str, Result]:
    """Compute every task without a stored result, store each in a file, and return all results.

    Files are atomic, and a random key depends on its task only. A run that is killed and resumed therefore gives the
    same numbers as an uninterrupted one (measured times apart), for any order and any number of workers with one thread
    each. (One process with several threads, ``workers=1``, may round sums differently; ``lfm-ppl compare --jobs 1`` has
    one thread.)

    Args:
        tasks: the tasks, in the order in which they are computed.
        compute: function from a task to its result: numbers, arrays and text by name. With several workers cloudpickle
            must be able to pickle it; a script that starts them needs ``if __name__ == "__main__":``.
        folder: folder of the files, made if necessary and locked by the run. None: nothing is stored.
        overwrite: replace results that were stored with other settings, which are an error otherwise.
        report: function of each line of progress, or a `lfm_ppl.utils.progress.Console`; None: nothing is shown.
        workers: 1: this process; a larger number: processes of this machine; ``"tcp://host:port"``: the workers of a
            Dask scheduler; a `Cluster`. A task whose worker dies is given to another.

    Returns:
        Name of a task -> its result, in the order of the tasks.

    Raises:
        ValueError: two tasks share a file, or a stored result was made with other settings.
        TasksFailedError: tasks failed; all others are computed and stored.
        FolderInUseError: another run holds the folder.
        ClusterError: no workers, or the connection is lost.

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
    tasks = list(tasks)
    results: dict[str, Result] = {}
    failed: dict[str, Outcome] = {}
    for outcome in outcomes(tasks, compute, folder, overwrite=overwrite, report=report, workers=workers):
        if outcome.result is None:
            failed[outcome.task.name] = outcome
        else:
            results[outcome.task.name] = outcome.result
    if failed:
        ordered = [failed[task.name] for task in tasks if task.name in failed]
        raise TasksFailedError({outcome.task.name: outcome.reason for outcome in ordered}, len(tasks),
                               folder is not None) from ordered[0].error
    return {task.name: results[task.name] for task in tasks}


def outcomes(tasks: Iterable[Task], compute: Callable[[Task], Mapping[str, Any]], folder: str | Path | None, *,
             overwrite: bool = False, report: Reporter | None = None, workers: Workers = 1,
             alike: bool = False) -> Iterator[Outcome]:
    """Yield the outcome of each task as it ends, stored results first; arguments as in `run_tasks`.

    The folder is locked, and the workers run, until the last outcome or until the iterator is closed. Tasks that are
    ``alike`` run the same programs: they wait for the first one, which compiles for all processes of this machine.

    Raises:
        ValueError, FolderInUseError, ClusterError: as `run_tasks`. A task that fails raises nothing.
    """
    check_workers(workers)
    tasks = list(tasks)
    check_distinct(tasks)
    with contextlib.ExitStack() as stack:
        run_store = None if folder is None else stack.enter_context(RunStore(folder))
        # Other settings of a stored result are an error before anything is computed.
        stored = {} if run_store is None else {task.name: read_result(task, run_store, overwrite) for task in tasks}
        missing = [task for task in tasks if stored.get(task.name) is None]
        done = len(tasks) - len(missing)
        progress = stack.enter_context(Progress(report, len(tasks), "tasks", "computed", done))
        if done:
            progress.write(f"{done} of {len(tasks)} tasks are stored already")
        for task in tasks:
            if (result := stored.pop(task.name, None)) is not None:
                yield Outcome(task, result, stored=True)
        for task, computed_result in _computed(stack, missing, compute, workers, alike, progress):
            if isinstance(computed_result, Exception):
                outcome = Outcome(task, None, computed_result)
                progress.write(f"failed: {task.name}: {outcome.reason}")
            else:
                if run_store is not None:
                    write_result(task, computed_result, run_store)
                outcome = Outcome(task, plain_values(computed_result))
            done += 1
            progress.advance(done, task.name)
            yield outcome


def _computed(stack: contextlib.ExitStack, tasks: list[Task], compute: Callable[[Task], Mapping[str, Any]],
              workers: Workers, alike: bool, progress: Progress) -> Iterator[tuple[Task, Any]]:
    """Yield each task with its arrays or its error."""
    if not tasks:
        return
    cluster = stack.enter_context(started(workers, most=len(tasks)))
    if cluster is not None:
        if cluster.dashboard:
            progress.write(f"dashboard {cluster.dashboard}")
        progress.start()
        yield from cluster.computed(tasks, compute, alike)
        return
    progress.start()
    for task in tasks:
        try:
            result: Any = computed(compute, task)
        except Exception as error:
            result = error
        yield task, result
