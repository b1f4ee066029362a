"""The results of a study's tasks as datasets with named dimensions, and rows of tables from them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments.scores import Estimate, mean_of, pair, rate_of

DATASET = "dataset"
"""The dimension of what is simulated or measured: records, targets, days, satellites."""

Column = str | Callable[[xr.Dataset], Any]
"""What stands in a column of a table: a variable, or a function of the row's dataset."""

_LABEL = re.compile(r"{(\w+)")


class Kind(NamedTuple):
    """Tasks of one kind, and what their results are.

    A task is of one data set, its setting ``index``, or of a block of them whose results are stacked; those with the
    same settings ``by`` come in the order of their data sets.

    Attributes:
        compute: from a task to its result.
        entries: dimensions, with blanks between -> the entries of a result that have them, with commas between. Those
            without the dimension `DATASET` are taken from the first task of each cell.
        by: settings that become dimensions in front of these.
    """

    compute: Callable[[Task], Result]
    entries: Mapping[str, str]
    by: tuple[str, ...] = ()

    def gathered(self, tasks: Iterable[Task], results: Mapping[str, Result]) -> xr.Dataset:
        """Return the results of tasks; NaN where a cell lacks an entry or has fewer data sets than others.

        What is True or False is 1 and 0 then, and text that is missing is empty.

        Raises:
            ValueError: some tasks of a cell have an entry that others lack.

        Example:
            >>> kind = Kind(lambda task: {"rmse": 2.0}, {"dataset": "rmse"}, ("rule",))
            >>> tasks = [Task(f"{rule}/{k}", 0, {"rule": rule, "index": k}) for rule in ("EKF", "CKF") for k in (0, 1)]
            >>> kind.gathered(tasks, {task.name: kind.compute(task) for task in tasks}).rmse.shape
            (2, 2)
        """
        cells: dict[tuple, list[Task]] = {}
        for task in tasks:
            cells.setdefault(tuple(task.settings[name] for name in self.by), []).append(task)
        labels = [list(dict.fromkeys(column)) for column in zip(*cells, strict=True)]
        variables = {}
        for names, entries in self.entries.items():
            for entry in entries.split(", "):
                arrays = {tuple(column.index(label) for column, label in zip(labels, cell, strict=True)):
                          _joined(own, results, entry, names)
                          for cell, own in cells.items() if any(entry in results[task.name] for task in own)}
                if arrays:
                    variables[entry] = ((*self.by, *names.split()), _filled(arrays, tuple(map(len, labels))))
        return xr.Dataset(variables, dict(zip(self.by, labels, strict=True)))


def _joined(tasks: list[Task], results: Mapping[str, Result], entry: str, names: str) -> np.ndarray:
    """Return one entry of the tasks of a cell, one data set after another."""
    if missing := [task.name for task in tasks if entry not in results[task.name]]:
        raise ValueError(f"{entry!r} is missing in the result of {missing[0]}, and other tasks of its kind have it.")
    if DATASET not in names.split():
        return np.asarray(results[tasks[0].name][entry])
    if names.split()[0] != DATASET:
        raise ValueError(f"the dimension {DATASET!r} of {entry!r} must come first, got {names!r}.")
    arrays = [(task, np.asarray(results[task.name][entry])) for task in tasks]
    return np.concatenate([array[None] if "index" in task.settings else array for task, array in arrays])


def _filled(arrays: Mapping[tuple[int, ...], np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Return arrays by their places in a table of this shape as one array, NaN or "" where there is nothing."""
    shapes = {array.shape for array in arrays.values()}
    whole = len(shapes) == 1 and len(arrays) == np.prod(shape, dtype=int)
    dtype = np.result_type(*arrays.values())
    if not (whole or dtype.kind == "U"):
        dtype = np.dtype(float)
    full = (*shape, *(max(sizes) for sizes in zip(*shapes, strict=True)))
    every: np.ndarray = np.full(full, np.nan if dtype.kind == "f" else np.zeros((), dtype), dtype)
    for place, array in arrays.items():
        within: tuple[Any, ...] = (*place, *(slice(size) for size in array.shape))
        every[within] = array
    return every


def part(found: xr.Dataset, prefix: str) -> xr.Dataset:
    """Return the variables whose names begin with a prefix and an underscore, without it.

    Example:
        >>> list(part(xr.Dataset({"filter_rmse": 1.0, "smoother_rmse": 2.0}), "filter"))
        ['rmse']
    """
    names = [str(name) for name in found if str(name).startswith(f"{prefix}_")]
    return found[names].rename({name: name.removeprefix(f"{prefix}_") for name in names})


def row(found: xr.Dataset, columns: Mapping[str, Column]) -> dict[str, Any]:
    """Return one row of a table.

    Args:
        found: what the row is of.
        columns: name -> what stands there: values of all data sets, whose mean, or share of what is true, is taken
            with its standard error; an `Estimate`; or a number. A name with ``{path}`` stands for a column for each
            entry of the dimension ``path``, and may have other coordinates of it.

    Example:
        >>> rmse = xr.Dataset({"rmse": (("dataset", "path"), np.ones((4, 2)))}, {"path": ["x", "v"]})
        >>> row(rmse, {"RMSE {path}": "rmse"})
        {'RMSE x': 1.0, 'RMSE x se': 0.0, 'RMSE v': 1.0, 'RMSE v se': 0.0}
    """
    cells: dict[str, Any] = {}
    for name, column in columns.items():
        for one in _split(found, name):
            label = name.format(**{str(key): value.item() for key, value in one.coords.items() if value.ndim == 0})
            cells |= cell(label, one[column] if isinstance(column, str) else column(one))
    return cells


def rows(found: xr.Dataset, dim: str, columns: Mapping[str, Column], label: str = "{}") -> dict[str, dict[str, Any]]:
    """Return a row for each entry of a dimension by its label, which may stand within a longer one."""
    return {label.format(one): row(found.sel({dim: one}), columns) for one in found[dim].values}


def in_one_row(several: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the cells of several rows, all of different columns, as those of one."""
    return {name: value for cells in several.values() for name, value in cells.items()}


def _split(found: xr.Dataset, name: str) -> list[xr.Dataset]:
    named = _LABEL.search(name)
    if named is None or not found[named[1]].dims:
        return [found]
    (dim,) = found[named[1]].dims
    return [found.isel({dim: index}) for index in range(found.sizes[dim])]


def cell(name: str, value: Any) -> dict[str, Any]:
    """Return the entries of a row for a value: those of an estimate, of values of all data sets, or a number."""
    if isinstance(value, xr.DataArray) and DATASET in value.dims:
        value = (rate_of if value.dtype == bool else mean_of)(value.values)
    if isinstance(value, Estimate):
        return pair(name, value)
    return {name: value if isinstance(value, str | int) else float(value)}


def number(statistic: Callable[[np.ndarray], Any], values: Any) -> float:
    """Return a statistic of NumPy, which is NaN where a value is; those of xarray leave NaN out.

    Example:
        >>> number(np.max, xr.DataArray([1.0, np.nan]))
        nan
    """
    return float(statistic(np.asarray(values)))
