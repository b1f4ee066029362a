"""The tasks of a study: what they are called, of which data sets they are, and one result from those of several."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lfm_ppl.engine.task import Result, Task


@dataclass(frozen=True)
class Tasks:
    """What makes the tasks of a study, whose names begin with what they are.

    Attributes:
        experiment: the study.
        seed: of everything random.
        digits: of the numbers of data sets in names.

    Example:
        >>> tasks = Tasks("made-up", 0)
        >>> [task.name for task in (*tasks.each("chains/NUTS", 2), *tasks.blocks("track", 5, 3, rule="EKF"))]
        ['chains/NUTS/0000', 'chains/NUTS/0001', 'track/0000-0002', 'track/0003-0004']
        >>> tasks.blocks("track", 5, 3, rule="EKF")[-1].settings
        {'experiment': 'made-up', 'what': 'track', 'rule': 'EKF', 'first': 3, 'last': 4}
    """

    experiment: str
    seed: int
    digits: int = 4

    def one(self, name: str, /, **settings: Any) -> Task:
        """Return a task of this name, whose settings hold the study, and ``what`` it is.

        That is the first part of its name unless it is given.
        """
        own = {"experiment": self.experiment, "what": name.partition("/")[0], **settings}
        return Task(name, self.seed, own)

    def each(self, name: str, count: int, /, **settings: Any) -> list[Task]:
        """Return a task for each of ``count`` data sets, its setting ``index``."""
        return [self.one(f"{name}/{index:0{self.digits}d}", **settings, index=index) for index in range(count)]

    def blocks(self, name: str, count: int, size: int, /, **settings: Any) -> list[Task]:
        """Return a task for each block of at most ``size`` data sets, its settings ``first`` and ``last``."""
        return [self.one(f"{name}/{first:0{self.digits}d}-{last:0{self.digits}d}", **settings, first=first, last=last)
                for first, last in blocks(count, size)]


def in_order(tasks: Iterable[Task]) -> list[Task]:
    """Return tasks of the first data sets first, so that the time left can be told."""
    return sorted(tasks, key=lambda task: indices(task)[0])


def indices(task: Task) -> range:
    """Return the data sets of a task.

    They are its setting ``index``, those from ``first`` to ``last``, or ``count`` from ``first`` on.

    Example:
        >>> [indices(Task("a", 0, of)) for of in ({"index": 2}, {"first": 3, "last": 4}, {"first": 3, "count": 2})]
        [range(2, 3), range(3, 5), range(3, 5)]
    """
    given = task.settings
    if "index" in given:
        return range(given["index"], given["index"] + 1)
    return range(given["first"], given["last"] + 1 if "last" in given else given["first"] + given["count"])


def blocks(count: int, size: int) -> list[tuple[int, int]]:
    """Return first and last index of each block of data sets that are computed in one go, and stored in one file.

    Example:
        >>> blocks(5, 2)
        [(0, 1), (2, 3), (4, 4)]
    """
    return [(first, min(first + size, count) - 1) for first in range(0, count, size)]


def stacked(rows: Sequence[Result], shown: Sequence[str] = ()) -> Result:
    """Return the results of data sets, one row each, as one result.

    Args:
        rows: of the data sets.
        shown: entries that are kept of the first one alone, for a figure.

    Returns:
        Entry -> array, a row for each data set.

    Example:
        >>> found = stacked([{"rmse": 1.0, "path": [0.0]}, {"rmse": 2.0, "path": [3.0]}], shown=["path"])
        >>> found["rmse"].tolist(), found["path"].tolist()
        ([1.0, 2.0], [0.0])
    """
    return {name: np.asarray(rows[0][name]) if name in shown else np.stack([np.asarray(row[name]) for row in rows])
            for name in rows[0]}


def slug(label: str, dropped: str = "(),") -> str:
    """Return a label as part of the name of a task or a file, without the characters that are dropped.

    Example:
        >>> slug("cubature, whole state"), slug("GHKF(7)")
        ('cubature-whole-state', 'GHKF7')
    """
    return "".join(one for one in label.replace(" ", "-") if one not in dropped)
