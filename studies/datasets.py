"""Results of tasks as datasets with named dimensions, and rows of tables from these datasets.

1. A cell holds the tasks with equal values of the settings ``by``. For each entry, concatenate the results of a cell's
   tasks along the dimension ``dataset``.
2. Place the arrays of all cells in one array with a leading dimension for each setting in ``by``. Fill shorter and
   missing cells with NaN or empty text.
3. A row of a table evaluates each of its columns on such a dataset (`row`). Values of all data sets become their mean,
   or the share of True, with the standard error.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.parallel.task import Result, Task

from .scores import Estimate, estimate_cells, estimate_mean, estimate_rate

DATASET = "dataset"
"""Dimension of the independent replicates: simulated or measured records, targets, days, satellites."""

Column = str | Callable[[xr.Dataset], Any]
"""Column of a table: the name of a variable, or a function of the row's dataset."""

_LABEL = re.compile(r"{(\w+)")


@dataclass(frozen=True)
class TaskKind:
    """Tasks of one kind, and the layout of their results.

    A task computes one data set, its setting ``index``, or a block of data sets with stacked results. The tasks of a
    cell, which have equal settings ``by``, are ordered by their data sets.

    Attributes:
        compute: map from a task to its result.
        entries: dimensions, separated by blanks -> entries of a result with these dimensions, separated by commas.
            An entry without the dimension `DATASET` is taken from the first task of each cell.
        by: settings that become the leading dimensions.
    """

    compute: Callable[[Task], Result]
    entries: Mapping[str, str]
    by: tuple[str, ...] = ()

    def collect(self, tasks: Iterable[Task], results: Mapping[str, Result]) -> xr.Dataset:
        """Return the results of tasks as one dataset.

        Where a cell lacks an entry or has fewer data sets than others, numbers are NaN and text is empty; an array of
        True and False that is filled in this way becomes an array of 1, 0 and NaN.

        Raises:
            ValueError: some tasks of a cell lack an entry that others have.

        Example:
            >>> kind = TaskKind(lambda task: {"rmse": 2.0}, {"dataset": "rmse"}, ("rule",))
            >>> tasks = [Task(f"{rule}/{k}", 0, {"rule": rule, "index": k}) for rule in ("EKF", "CKF") for k in (0, 1)]
            >>> kind.collect(tasks, {task.name: kind.compute(task) for task in tasks}).rmse.shape
            (2, 2)
        """
        cells: dict[tuple, list[Task]] = {}
        for task in tasks:
            cells.setdefault(tuple(task.settings[name] for name in self.by), []).append(task)
        labels = [list(dict.fromkeys(column)) for column in zip(*cells, strict=True)]
        variables = {}
        for dims, entries in self.entries.items():
            for entry in entries.split(", "):
                arrays = {tuple(column.index(label) for column, label in zip(labels, cell, strict=True)):
                          _concatenate_datasets(cell_tasks, results, entry, dims)
                          for cell, cell_tasks in cells.items()
                          if any(entry in results[task.name] for task in cell_tasks)}
                if arrays:
                    variables[entry] = ((*self.by, *dims.split()), _pad_cells(arrays, tuple(map(len, labels))))
        return xr.Dataset(variables, dict(zip(self.by, labels, strict=True)))


def _concatenate_datasets(tasks: list[Task], results: Mapping[str, Result], entry: str, dims: str) -> np.ndarray:
    """Return one entry of a cell's results, concatenated along the data sets."""
    if missing := [task.name for task in tasks if entry not in results[task.name]]:
        raise ValueError(f"{entry!r} is missing in the result of {missing[0]}, and other tasks of its kind have it.")
    if DATASET not in dims.split():
        return np.asarray(results[tasks[0].name][entry])
    if dims.split()[0] != DATASET:
        raise ValueError(f"the dimension {DATASET!r} of {entry!r} must come first, got {dims!r}.")
    arrays = [(task, np.asarray(results[task.name][entry])) for task in tasks]
    return np.concatenate([array[None] if "index" in task.settings else array for task, array in arrays])


def _pad_cells(arrays: Mapping[tuple[int, ...], np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Return one array for the arrays of all cells, by cell index; NaN or "" fills missing entries."""
    shapes = {array.shape for array in arrays.values()}
    is_complete = len(shapes) == 1 and len(arrays) == np.prod(shape, dtype=int)
    dtype = np.result_type(*arrays.values())
    if not (is_complete or dtype.kind == "U"):
        dtype = np.dtype(float)
    padded_shape = (*shape, *(max(sizes) for sizes in zip(*shapes, strict=True)))
    padded: np.ndarray = np.full(padded_shape, np.nan if dtype.kind == "f" else np.zeros((), dtype), dtype)
    for cell_index, array in arrays.items():
        selection: tuple[Any, ...] = (*cell_index, *(slice(size) for size in array.shape))
        padded[selection] = array
    return padded


def select_prefix(dataset: xr.Dataset, prefix: str) -> xr.Dataset:
    """Return the variables named ``{prefix}_...``, renamed without the prefix.

    Example:
        >>> list(select_prefix(xr.Dataset({"filter_rmse": 1.0, "smoother_rmse": 2.0}), "filter"))
        ['rmse']
    """
    names = [str(name) for name in dataset if str(name).startswith(f"{prefix}_")]
    return dataset[names].rename({name: name.removeprefix(f"{prefix}_") for name in names})


def row(dataset: xr.Dataset, columns: Mapping[str, Column]) -> dict[str, Any]:
    """Return one row of a table.

    Args:
        dataset: results for the row.
        columns: column name -> values of all data sets, which become their mean or the share of True, with its standard
            error; an `Estimate`; or a number. A name with ``{path}`` gives a column for each entry of the dimension
            ``path``, and may contain other coordinates of this dimension.

    Example:
        >>> rmse = xr.Dataset({"rmse": (("dataset", "path"), np.ones((4, 2)))}, {"path": ["x", "v"]})
        >>> row(rmse, {"RMSE {path}": "rmse"})
        {'RMSE x': 1.0, 'RMSE x se': 0.0, 'RMSE v': 1.0, 'RMSE v se': 0.0}
    """
    cells: dict[str, Any] = {}
    for name, column in columns.items():
        for part in _split(dataset, name):
            label = name.format(**{str(key): value.item() for key, value in part.coords.items() if value.ndim == 0})
            cells |= cell(label, part[column] if isinstance(column, str) else column(part))
    return cells


def rows(dataset: xr.Dataset, dim: str, columns: Mapping[str, Column], label: str = "{}") -> dict[str, dict[str, Any]]:
    """Return one row for each entry of a dimension; ``label`` formats the entry as the row name."""
    return {label.format(entry): row(dataset.sel({dim: entry}), columns) for entry in dataset[dim].values}


def merge_rows(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return one row with the cells of several rows, whose columns all differ."""
    return {name: value for cells in rows.values() for name, value in cells.items()}


def _split(dataset: xr.Dataset, name: str) -> list[xr.Dataset]:
    """Return the parts of a dataset along the dimension in a column name such as ``RMSE {path}``."""
    placeholder = _LABEL.search(name)
    if placeholder is None or not dataset[placeholder[1]].dims:
        return [dataset]
    (dim,) = dataset[placeholder[1]].dims
    return [dataset.isel({dim: index}) for index in range(dataset.sizes[dim])]


def cell(name: str, value: Any) -> dict[str, Any]:
    """Return the cells for a value: values of all data sets, an estimate, a number or text."""
    if isinstance(value, xr.DataArray) and DATASET in value.dims:
        value = (estimate_rate if value.dtype == bool else estimate_mean)(value.values)
    if isinstance(value, Estimate):
        return estimate_cells(name, value)
    return {name: value if isinstance(value, str | int) else float(value)}


def number(statistic: Callable[[np.ndarray], Any], values: Any) -> float:
    """Return a NumPy statistic of values; unlike xarray's statistics it is NaN if a value is NaN.

    Example:
        >>> number(np.max, xr.DataArray([1.0, np.nan]))
        nan
    """
    return float(statistic(np.asarray(values)))
