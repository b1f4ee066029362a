"""Known inputs and calendar time in a result: how they are stored beside the data, and read back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.io.data_set import Data
from lfm_ppl.io.input_table import InputTable
from lfm_ppl.results.scalars import units_attribute

GROUP = "constant_data"
"""ArviZ's name for what a model is given beside the observations."""

FORECAST = "predictions_constant_data"
"""That of a forecast, of inputs that go on."""

ORIGIN = "time_origin"
"""Attribute of a result: the calendar time of t = 0 as ISO 8601 text."""


_PARTS = {"durations": "duration", "compartments": "compartment", "resets": "reset"}
"""Further fields of a table of doses -> endings of the names of their coordinates."""


def to_dataset(inputs: Mapping[str, InputTable], units: Mapping[str, str] | None = None) -> xr.Dataset:
    """Return known inputs, each over times of its own, with the units of those that have one.

    Doses have their number and their sum as attributes, and lengths of infusions, states and resets as coordinates.
    """
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {}
    for name, table in inputs.items():
        attributes: dict[str, Any] = {"interpolation": table.interpolation, **units_attribute([name], units)}
        if table.is_dose:
            attributes |= {"doses": len(table.times), "total": float(np.sum(table.values))}
        variables[name] = f"{name}_time", np.asarray(table.values), attributes
        coordinates[f"{name}_time"] = np.asarray(table.times)
        for field, ending in _PARTS.items():
            if (values := getattr(table, field)) is not None:
                coordinates[f"{name}_{ending}"] = f"{name}_{'reset' if field == 'resets' else 'time'}", values
    return xr.Dataset(variables, coordinates)


def from_dataset(stored: xr.Dataset) -> dict[str, InputTable]:
    """Return the known inputs of `to_dataset`, by name."""
    tables = {}
    for name, variable in stored.data_vars.items():
        parts = {field: np.asarray(stored[f"{name}_{ending}"].values)
                 for field, ending in _PARTS.items() if f"{name}_{ending}" in stored.coords}
        tables[str(name)] = InputTable(
            np.asarray(stored[f"{name}_time"].values, float), np.asarray(variable.values, float),
            str(variable.attrs.get("interpolation", "previous")), **parts)
    return tables


def remember(groups: dict[str, xr.Dataset], data: Data | None, origin: str | None, unit: str) -> dict[str, Any]:
    """Add known inputs, and the unit of time where the model names none, to groups; return attributes of the result.

    ``origin`` is the calendar time of t = 0, None where times are plain numbers.
    """
    if data is not None and data.inputs:
        groups[GROUP] = to_dataset(data.inputs, data.units)
    for dataset in groups.values():
        for name in {"time", "times"} & set(dataset.coords):
            if unit and not dataset[name].attrs.get("units"):
                dataset[name].attrs["units"] = unit
    return {} if origin is None else {ORIGIN: origin}
