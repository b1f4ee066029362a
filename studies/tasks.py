"""Tasks of a study: their names, their data sets, and the combination of several results into one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lfm_ppl.parallel.task import Result, Task


@dataclass(frozen=True)
class TaskFactory:
    """Factory for the tasks of a study; the first part of a task's name is its kind.

    Attributes:
        study: name of the study.
        seed: seed of the study.
        digits: digits of data set numbers in task names.

    Example:
        >>> factory = TaskFactory("tracking", 0)
        >>> tasks = *factory.dataset_tasks("chains/NUTS", 2), *factory.block_tasks("track", 5, 3, rule="EKF")
        >>> [task.name for task in tasks]
        ['chains/NUTS/0000', 'chains/NUTS/0001', 'track/0000-0002', 'track/0003-0004']
        >>> tasks[-1].settings
        {'study': 'tracking', 'what': 'track', 'rule': 'EKF', 'first': 3, 'last': 4}
    """

    study: str
    seed: int
    digits: int = 4

    def task(self, name: str, /, **settings: Any) -> Task:
        """Return a task; its setting ``what`` is the first part of the name, unless ``settings`` sets it."""
        return Task(name, self.seed, {"study": self.study, "what": name.partition("/")[0], **settings})

    def dataset_tasks(self, name: str, count: int, /, **settings: Any) -> list[Task]:
        """Return one task for each of ``count`` data sets, with the setting ``index``."""
        return [self.task(f"{name}/{index:0{self.digits}d}", **settings, index=index) for index in range(count)]

    def block_tasks(self, name: str, count: int, size: int, /, **settings: Any) -> list[Task]:
        """Return one task for each block of at most ``size`` data sets, with the settings ``first`` and ``last``."""
        return [self.task(f"{name}/{first:0{self.digits}d}-{last:0{self.digits}d}", **settings, first=first, last=last)
                for first, last in dataset_blocks(count, size)]


def sort_by_dataset(tasks: Iterable[Task]) -> list[Task]:
    """Return tasks sorted by their first data set; the remaining time can then be estimated from all kinds of tasks."""
    return sorted(tasks, key=lambda task: dataset_indices(task)[0])


def dataset_indices(task: Task) -> range:
    """Return the indices of the data sets of a task.

    The settings of the task are ``index``, or ``first`` and ``last``, or ``first`` and ``count``.

    Example:
        >>> settings = {"index": 2}, {"first": 3, "last": 4}, {"first": 3, "count": 2}
        >>> [dataset_indices(Task("a", 0, entries)) for entries in settings]
        [range(2, 3), range(3, 5), range(3, 5)]
    """
    settings = task.settings
    if "index" in settings:
        return range(settings["index"], settings["index"] + 1)
    first = settings["first"]
    return range(first, settings["last"] + 1 if "last" in settings else first + settings["count"])


def dataset_blocks(count: int, size: int) -> list[tuple[int, int]]:
    """Return the first and the last index of each block of data sets; a block is computed and stored as one task.

    Example:
        >>> dataset_blocks(5, 2)
        [(0, 1), (2, 3), (4, 4)]
    """
    return [(first, min(first + size, count) - 1) for first in range(0, count, size)]


def stack_results(rows: Sequence[Result], first_only: Sequence[str] = ()) -> Result:
    """Return the results of several data sets as one result, with the data sets along the first axis.

    Args:
        rows: results of the data sets.
        first_only: entries that are taken from the first data set alone, for example for a figure.

    Example:
        >>> result = stack_results([{"rmse": 1.0, "path": [0.0]}, {"rmse": 2.0, "path": [3.0]}], first_only=["path"])
        >>> result["rmse"].tolist(), result["path"].tolist()
        ([1.0, 2.0], [0.0])
    """
    return {name: np.asarray(rows[0][name]) if name in first_only else np.stack([np.asarray(row[name]) for row in rows])
            for name in rows[0]}


def slug(label: str, removed: str = "(),") -> str:
    """Return a label as part of a task or file name: dashes for blanks, without the ``removed`` characters.

    Example:
        >>> slug("cubature, whole state"), slug("GHKF(7)")
        ('cubature-whole-state', 'GHKF7')
    """
    return "".join(character for character in label.replace(" ", "-") if character not in removed)
