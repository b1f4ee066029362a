"""ArviZ objects as flat arrays, for the results of tasks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.results import arviz_data

_STRUCTURE = "structure"
"""Name of the entry that holds attributes, groups, dimensions and names as JSON."""

_PARTS = ("data_vars", "coords")


def pack_result(result: Any, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return an ArviZ object as arrays by name, with further attributes."""
    arrays: dict[str, Any] = {}
    structure: dict[str, Any] = {"attrs": {**arviz_data.attributes(result), **attributes}, "groups": {}}
    for group in arviz_data.groups(result):
        dataset = arviz_data.group(result, group)
        group_structure: dict[str, Any] = {"attrs": dict(dataset.attrs)}
        for part in _PARTS:
            variables = getattr(dataset, part)
            group_structure[part] = {str(name): {"dims": list(map(str, variable.dims)), "attrs": dict(variable.attrs)}
                                     for name, variable in variables.items()}
            for name, variable in variables.items():
                values = np.asarray(variable.values)
                arrays[f"{group}/{part}/{name}"] = values.astype(str) if values.dtype.kind == "O" else values
        structure["groups"][group] = group_structure
    arrays[_STRUCTURE] = json.dumps(structure, default=lambda value: np.asarray(value).tolist())
    return arrays


def unpack_result(arrays: Mapping[str, Any]) -> Any:
    """Return the ArviZ object of the arrays of `pack_result`."""
    structure = json.loads(str(arrays[_STRUCTURE]))
    groups = {}
    for group, group_structure in structure["groups"].items():
        data_vars, coords = (
            {name: (variable["dims"], arrays[f"{group}/{part}/{name}"], variable["attrs"])
             for name, variable in group_structure[part].items()} for part in _PARTS)
        groups[group] = xr.Dataset(data_vars, coords, group_structure["attrs"])
    return arviz_data.build(groups, structure["attrs"])
