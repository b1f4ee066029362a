"""Known inputs and calendar time in a result: how they are stored beside the data, and read back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.data import Data, InputTable, model_keywords
from lfm_ppl.results import arviz_data

GROUP = "constant_data"
"""ArviZ's name for what a model is given beside the observations."""

ORIGIN = "time_origin"
"""Attribute of a result: the calendar time of t = 0 as ISO 8601 text."""


def to_dataset(inputs: Mapping[str, InputTable]) -> xr.Dataset:
    """Return known inputs, each over times of its own."""
    return xr.Dataset(
        {name: (f"{name}_time", np.asarray(table.values), {"interpolation": table.interpolation})
         for name, table in inputs.items()},
        {f"{name}_time": np.asarray(table.times) for name, table in inputs.items()})


def inputs_of(result: Any) -> dict[str, InputTable]:
    """Return the known inputs that a result was made with."""
    if not arviz_data.has_group(result, GROUP):
        return {}
    stored = arviz_data.group(result, GROUP)
    return {str(name): InputTable(np.asarray(stored[f"{name}_time"].values, float), np.asarray(one.values, float),
                                  str(one.attrs.get("interpolation", "previous")))
            for name, one in stored.data_vars.items()}


def keywords(result: Any, given: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the keyword arguments of the model of a result: those given, and its known inputs."""
    return model_keywords(inputs_of(result), given)


def remember(groups: dict[str, xr.Dataset], data: Data) -> dict[str, Any]:
    """Add the known inputs of data to the groups of a result, and the unit of time where the model does not name it.

    Returns:
        Attributes of the result.
    """
    if data.inputs:
        groups[GROUP] = to_dataset(data.inputs)
    for dataset in groups.values():
        for name in {"time", "at", "at_truth"} & set(dataset.coords):
            if data.units.get("time") and not dataset[name].attrs.get("units"):
                dataset[name].attrs["units"] = data.units["time"]
    return {} if data.origin is None else {ORIGIN: data.origin}
