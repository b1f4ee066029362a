"""Data files as a model reads them: columns, inputs, unit of time."""

from __future__ import annotations

import dataclasses

from lfm_ppl.cli import choices
from lfm_ppl.cli.options import Columns, DataOptions
from lfm_ppl.io import data, time_columns
from lfm_ppl.io import table as tables
from lfm_ppl.io.data_set import Data, in_unit
from lfm_ppl.io.loading import ModelFile
from lfm_ppl.utils import calendar_time, checks

_ROWS_OF_HEADER = 3
"""Rows that show the names of columns, after a line ``sep=``, and a row below them."""


def read_data(path: str, model: ModelFile, options: DataOptions) -> Data:
    """Return the observations in a file, under the model's names of its outputs and inputs."""
    inputs = choices.inputs(options.columns, model)
    observed = data.read_csv(path, output_columns(options.columns, model), options.columns.time_column,
                             dict(inputs.values()), options.time_unit, usual_unit=_time_unit(model))
    return _with_model_names(observed, model, inputs, path, options)


def read_series(model: ModelFile, options: DataOptions) -> dict[str, Data]:
    """Return the observations of each series of a file, under the model's names of its outputs and inputs."""
    assert options.data is not None and options.series is not None
    inputs = choices.inputs(options.columns, model)
    series = data.read_series(options.data, options.series, output_columns(options.columns, model),
                              options.columns.time_column, dict(inputs.values()), options.time_unit, _time_unit(model))
    return {name: _with_model_names(observed, model, inputs, options.data, options)
            for name, observed in series.items()}


def output_columns(columns: Columns, model: ModelFile) -> tuple[str, ...] | None:
    """Return the columns of a file that are outputs; None: all but the time."""
    if columns.outputs is None:
        return model.outputs
    names = tuple(name.strip() for name in columns.outputs.split(","))
    if model.outputs is not None and len(names) != len(model.outputs):
        raise ValueError(f"{model.name} has {checks.counted(len(model.outputs), 'output')} "
                         f"({', '.join(model.outputs)}); --outputs names {checks.counted(len(names), 'column')}.")
    return names


def unit_of_file(options: DataOptions) -> str | None:
    """Return the unit of the times in a file, by --time-unit or the name of the column; None where neither says it."""
    if options.time_unit is not None:
        return calendar_time.UNITS[options.time_unit]
    return None if options.data is None else column_unit(options.data, options.columns.time_column, options.series)


def column_unit(path: str, time_column: str | None, series: str | None = None) -> str | None:
    """Return the unit in the name of the time column of a file, h of ``time_h``; None where it has none."""
    table = tables.read_file(path, _ROWS_OF_HEADER)
    if series is not None:
        table = tables.Table(table.label, table.frame.drop(columns=series))
    return time_columns.unit_of(time_columns.find_time_column(table, time_column))


def _time_unit(model: ModelFile) -> str | None:
    """Return the model's unit of time if dates can be converted to it."""
    unit = model.units.get("time")
    return unit if unit in calendar_time.SECONDS else None


def _with_model_names(observed: Data, model: ModelFile, inputs: dict[str, tuple[str, str]], path: str,
                      options: DataOptions) -> Data:
    """Return observations under the model's names of its outputs and inputs, with times in its unit.

    Raises:
        ValueError: the times of the file cannot be converted to the model's unit of time.
    """
    unit, unit_of_file = model.units.get("time"), observed.units.get("time")
    if unit and _time_unit(model) is None and (observed.origin is not None and not options.time_unit or (
            observed.origin is None and unit_of_file)):
        kind, remedy = (("dates", ", or give --time-unit.") if observed.origin is not None
                        else (f"times in {unit_of_file}", " there, or leave out the unit."))
        raise ValueError(f"UNITS of {model.path} says that time is in {unit!r}, to which the {kind} of {path} cannot "
                         f"be converted. Write one of {', '.join(calendar_time.USUAL)}{remedy}")
    observed = dataclasses.replace(observed, outputs=model.outputs or observed.outputs,
                                   inputs={name: observed.inputs[column] for name, (column, _) in inputs.items()
                                           if column in observed.inputs})
    return in_unit(observed, unit or "")
