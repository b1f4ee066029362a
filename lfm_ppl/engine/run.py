"""Compute tasks that are stored one by one, so that a run that was stopped goes on where it was."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from lfm_ppl.engine import store
from lfm_ppl.engine.cluster import Workers, check_workers, started
from lfm_ppl.engine.errors import TasksFailedError
from lfm_ppl.engine.task import Result, Task, check_distinct
from lfm_ppl.engine.worker import computed
from lfm_ppl.utils.progress import Progress, Reporter


class Outcome(NamedTuple):
    """How a task ended.

    Attributes:
        task: which.
        result: None where it failed.
        error: why it failed.
        stored: whether the result was there before this run.
    """

    task: Task
    result: Result | None
    error: Exception | None = None
    stored: bool = False

    @property
    def reason(self) -> str:
        """Why it failed, in one line."""
        return "" if self.error is None else " ".join(f"{type(self.error).__name__}: {self.error}".split())


def run_tasks(tasks: Iterable[Task], compute: Callable[[Task], Mapping[str, Any]], folder: str | Path | None, *,
              overwrite: bool = False, report: Reporter | None = None, workers: Workers = 1) -> dict[str, Result]:
    """Compute every task that ``folder`` does not hold yet, each into a file of its own, and return all results.

    A file is there whole or not at all, and a random key depends on its task alone. A run that is killed and started
    again therefore ends with the same numbers as one that is not (measured times apart), in whatever order and by
    however many workers: each of them has one thread. (One process with several threads, ``workers=1``, may round sums
    otherwise; ``lfm-ppl compare --jobs 1`` has one.)

    Args:
        tasks: the tasks, in the order in which they are computed.
        compute: from a task to its result: numbers, arrays and text by name. With several workers a function that can
            be pickled (by cloudpickle); a script that starts them needs ``if __name__ == "__main__":``.
        folder: of the files; made where it does not exist, and held by one run at a time. None: nothing is stored.
        overwrite: compute again what was stored with other settings, which is an error otherwise.
        report: function of each line of progress, or a `lfm_ppl.utils.progress.Console`; None: nothing is shown.
        workers: what computes: 1, this process; more, so many others of this machine; ``"tcp://host:port"``, those of
            that scheduler of Dask; workers that were `started`. A task whose worker dies is given to another.

    Returns:
        Name of a task -> its result, in the order of the tasks.

    Raises:
        ValueError: two tasks share a file, or a stored result was made with other settings.
        TasksFailedError: tasks failed; all others are computed and stored.
        FolderInUseError: another run holds the folder.
        ClusterError: no workers can be had, or they are lost.

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
    for one in outcomes(tasks, compute, folder, overwrite=overwrite, report=report, workers=workers):
        if one.result is None:
            failed[one.task.name] = one
        else:
            results[one.task.name] = one.result
    if failed:
        ordered = [failed[task.name] for task in tasks if task.name in failed]
        raise TasksFailedError({one.task.name: one.reason for one in ordered}, len(tasks),
                               folder is not None) from ordered[0].error
    return {task.name: results[task.name] for task in tasks}


def outcomes(tasks: Iterable[Task], compute: Callable[[Task], Mapping[str, Any]], folder: str | Path | None, *,
             overwrite: bool = False, report: Reporter | None = None, workers: Workers = 1,
             alike: bool = False) -> Iterator[Outcome]:
    """Yield how each task ended, one by one as they end, those first that were stored; arguments as in `run_tasks`.

    The folder is held, and workers are kept, until the last one was taken or the iterator is closed. Tasks that are
    ``alike`` run the same programs: others wait for the first one, which compiles for all processes of this machine.

    Raises:
        ValueError, FolderInUseError, ClusterError: as `run_tasks`. A task that fails raises nothing.
    """
    check_workers(workers)
    tasks = list(tasks)
    check_distinct(tasks)
    with contextlib.ExitStack() as stack:
        if folder is not None:
            stack.enter_context(store.held(folder))
        # All are looked at before any is computed: that one has other settings should be known now.
        found = {} if folder is None else {task.name: store.stored(task, folder, overwrite) for task in tasks}
        missing = [task for task in tasks if found.get(task.name) is None]
        done = len(tasks) - len(missing)
        progress = stack.enter_context(Progress(report, len(tasks), "tasks", "computed", done))
        if done:
            progress.write(f"{done} of {len(tasks)} tasks are stored already")
        for task in tasks:
            if (result := found.pop(task.name, None)) is not None:
                yield Outcome(task, result, stored=True)
        for task, new in _computed(stack, missing, compute, workers, alike, progress):
            if isinstance(new, Exception):
                one = Outcome(task, None, new)
                progress.write(f"failed: {task.name}: {one.reason}")
            elif folder is None:
                one = Outcome(task, store.values(new))
            else:
                store.write(task, new, folder, overwrite=True)
                one = Outcome(task, store.read(task, folder))
            done += 1
            progress.advance(done, task.name)
            yield one


def _computed(stack: contextlib.ExitStack, tasks: list[Task], compute: Callable[[Task], Mapping[str, Any]],
              workers: Workers, alike: bool, progress: Progress) -> Iterator[tuple[Task, Any]]:
    """Yield each task with its arrays, or with the error that it ended with."""
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
            new: Any = computed(compute, task)
        except Exception as error:
            new = error
        yield task, new
