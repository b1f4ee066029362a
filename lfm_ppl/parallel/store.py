"""Results of tasks in a `RunStore`: one file per task, with the record of the task beside its arrays."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from lfm_ppl.parallel.task import Result, Task
from lfm_ppl.utils.run_store import DamagedFileError, RunStore

_TASK = "__task__"


class OtherSettingsError(ValueError):
    """A stored result was made with other settings."""


def as_arrays(task: Task, result: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return a result as NumPy arrays.

    Raises:
        TypeError: the result is no mapping.
        ValueError: an entry is not a number, an array of numbers or text.
    """
    if not isinstance(result, Mapping):
        raise TypeError(f"the result of task {task.name} must be a dictionary of numbers, arrays and text, got "
                        f"{type(result).__name__}.")
    arrays = {name: np.asarray(value) for name, value in result.items()}
    for name, value in arrays.items():
        if value.dtype.kind not in "biufU" or name == _TASK:
            raise ValueError(f"the result of task {task.name} has an entry {name!r} that is not a number, an array of "
                             f"numbers or text, but {type(result[name]).__name__}.")
    return arrays


def plain_values(arrays: Mapping[str, np.ndarray]) -> Result:
    """Return a result with arrays of no dimension as numbers and text."""
    return {name: value.item() if value.ndim == 0 else value for name, value in arrays.items()}


def write_result(task: Task, result: Mapping[str, Any], store: RunStore) -> None:
    """Store the result of a task.

    Raises:
        ValueError: an entry of the result is not a number, an array or text.
    """
    store.put(task.stem, {_TASK: json.dumps(task.record()), **as_arrays(task, result)})


def read_result(task: Task, store: RunStore, overwrite: bool = False) -> Result | None:
    """Return the stored result of a task; None if there is none, or if it is to be replaced.

    Raises:
        OtherSettingsError: it was made with other settings, and ``overwrite`` is False.

    Warns:
        UserWarning: the file is damaged.
    """
    try:
        arrays = store.get(task.stem)
        record = {} if arrays is None else json.loads(str(arrays.pop(_TASK)))
    except (DamagedFileError, KeyError) as error:
        warnings.warn(f"{store.path(task.stem)} cannot be read ({error}); its task runs again.", stacklevel=3)
        return None
    task_record = task.record()
    if arrays is not None and record == task_record:
        return plain_values(arrays)
    if arrays is None or overwrite:
        return None
    raise OtherSettingsError(f"{store.path(task.stem)} holds a result with other settings: "
                             f"{_difference(record, task_record)}. Choose another folder, or replace it with "
                             "overwrite=True (--overwrite on the command line).")


def _difference(stored_record: Mapping[str, Any], task_record: Mapping[str, Any]) -> str:
    """Return the first few settings that differ, as text."""
    flat = [{"name": record.get("name"), "seed": record.get("seed"), **record.get("settings", {})}
            for record in (stored_record, task_record)]
    names = [name for name in {**flat[0], **flat[1]} if flat[0].get(name) != flat[1].get(name)]
    return ", ".join(f"{name} is {flat[0].get(name)!r} there and {flat[1].get(name)!r} now" for name in names[:3])
