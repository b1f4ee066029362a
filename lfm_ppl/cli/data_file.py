"""Data files as a model reads them: columns, inputs, unit of time."""

from __future__ import annotations

import argparse
import dataclasses

from lfm_ppl.cli import choices
from lfm_ppl.io import data, loading
from lfm_ppl.io.data_set import Data
from lfm_ppl.utils import calendar_time, checks


def output_columns(arguments: argparse.Namespace, model: loading.ModelFile) -> tuple[str, ...] | None:
    """Return the columns of a file that are outputs; None: all but the time."""
    names = model.outputs
    if arguments.outputs is not None:
        names = tuple(name.strip() for name in arguments.outputs.split(","))
        if model.outputs is not None and len(names) != len(model.outputs):
            raise ValueError(
                f"{model.name} has {checks.counted(len(model.outputs), 'output')} ({', '.join(model.outputs)}); "
                f"--outputs names {checks.counted(len(names), 'column')}."
            )
    return names


def read_data(path: str, model: loading.ModelFile, arguments: argparse.Namespace) -> Data:
    """Return the observations in a file, under the model's names of its outputs and inputs."""
    inputs = choices.inputs(arguments.inputs, model)
    observed = data.read_csv(path, output_columns(arguments, model), arguments.time_column, dict(inputs.values()),
                             arguments.time_unit, usual_unit=model_time_unit(model))
    check_time_unit(model, observed, path, arguments)
    return with_model_names(model, inputs, observed)


def check_time_unit(model: loading.ModelFile, observed: Data, path: str, arguments: argparse.Namespace) -> None:
    """Raise ValueError where the dates of a file cannot be counted in the unit that the model says."""
    unit = model.units.get("time")
    if observed.origin is not None and unit and model_time_unit(model) is None and not arguments.time_unit:
        raise ValueError(f"UNITS of {model.path} says that time is in {unit!r}, in which the dates of {path} cannot be "
                         f"counted. Write one of {', '.join(calendar_time.USUAL)}, or give --time-unit.")


def model_time_unit(model: loading.ModelFile) -> str | None:
    """Return the unit in which a model counts time, where it says so: that of dates in a file."""
    unit = model.units.get("time")
    return unit if unit in calendar_time.SECONDS else None


def with_model_names(model: loading.ModelFile, inputs: dict[str, tuple[str, str]], observed: Data) -> Data:
    """Return observations under the model's names of its outputs and inputs.

    Args:
        model: the model file.
        inputs: name -> column, interpolation, see `choices.inputs`.
        observed: as read.
    """
    return dataclasses.replace(observed, outputs=model.outputs or observed.outputs,
                               inputs={name: observed.inputs[column] for name, (column, _) in inputs.items()})
