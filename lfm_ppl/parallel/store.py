"""Results of tasks in a folder: one atomic file per task, written by one run at a time."""

from __future__ import annotations

import contextlib
import json
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl.parallel.lock import FolderLock
from lfm_ppl.parallel.task import Result, Task
from lfm_ppl.results.files import writing

_TASK = "__task__"


class OtherSettingsError(ValueError):
    """A stored result was made with other settings."""


@contextlib.contextmanager
def locked(folder: str | Path) -> Iterator[Path]:
    """Make and lock a folder; the system releases the lock when the process ends.

    Raises:
        FolderInUseError: another run holds it.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    lock = FolderLock(folder)
    try:
        yield folder
    finally:
        lock.release()


def as_arrays(task: Task, result: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return a result as NumPy arrays.

    Raises:
        TypeError: the result is no mapping.
        ValueError: an entry is not a number, an array of numbers or text.
    """
    if not isinstance(result, Mapping):
        raise TypeError(f"the result of task {task.name} must be a dictionary of numbers, arrays and text, got "
                        f"{type(result).__name__}.")
    result_arrays = {name: np.asarray(value) for name, value in result.items()}
    for name, value in result_arrays.items():
        if value.dtype.kind not in "biufU" or name == _TASK:
            raise ValueError(f"the result of task {task.name} has an entry {name!r} that is not a number, an array of "
                             f"numbers or text, but {type(result[name]).__name__}.")
    return result_arrays


def plain_values(result_arrays: Mapping[str, np.ndarray]) -> Result:
    """Return a result with arrays of no dimension as numbers and text."""
    return {name: value.item() if value.ndim == 0 else value for name, value in result_arrays.items()}


def write(task: Task, result: Mapping[str, Any], folder: str | Path, overwrite: bool = False) -> Path:
    """Write the result of a task to its file in ``folder``, atomically.

    Raises:
        ValueError: an entry of the result is not a number, an array or text.
    """
    result_arrays = as_arrays(task, result)
    path = Path(folder) / task.file
    with writing(path, overwrite) as temporary:
        np.savez(temporary, **{_TASK: np.asarray(json.dumps(task.record()))}, **result_arrays)  # type: ignore[arg-type]
    return path


def read(task: Task, folder: str | Path) -> Result:
    """Read the result of a task.

    Raises:
        FileNotFoundError: it is not stored.
        OtherSettingsError: it was made with other settings.
        OSError, KeyError, zipfile.BadZipFile: the file is damaged.
    """
    path = Path(folder) / task.file
    with np.load(path) as file:
        result_arrays = {name: file[name] for name in file.files}
    record, task_record = json.loads(str(result_arrays.pop(_TASK))), task.record()
    if record != task_record:
        raise OtherSettingsError(
            f"{path} holds a result with other settings: {_difference(record, task_record)}. Choose another folder, "
            "or replace it with overwrite=True (--overwrite on the command line)."
        )
    return plain_values(result_arrays)


def stored_result(task: Task, folder: str | Path, overwrite: bool) -> Result | None:
    """Return the stored result of a task; None if there is none, or if it is to be replaced.

    Raises:
        OtherSettingsError: it was made with other settings, and ``overwrite`` is False.

    Warns:
        UserWarning: the file cannot be read.
    """
    try:
        return read(task, folder)
    except FileNotFoundError:
        return None
    except OtherSettingsError:
        if overwrite:
            return None
        raise
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        warnings.warn(f"{Path(folder) / task.file} cannot be read ({type(error).__name__}: {error}); its task runs "
                      "again.", stacklevel=3)
        return None


def _difference(stored_record: Mapping[str, Any], task_record: Mapping[str, Any]) -> str:
    """Name the first few settings that differ, as ``name stored -> wanted``."""
    flat = [{"name": record.get("name"), "seed": record.get("seed"), **record.get("settings", {})}
            for record in (stored_record, task_record)]
    names = [name for name in {**flat[0], **flat[1]} if flat[0].get(name) != flat[1].get(name)]
    return ", ".join(f"{name} is {flat[0].get(name)!r} there and {flat[1].get(name)!r} now" for name in names[:3])
