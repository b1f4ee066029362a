"""ArviZ objects as flat arrays, for the results of tasks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.results import arviz_data
from lfm_ppl.results.result_view import ResultView

_STRUCTURE = "structure"
"""Name of the entry that holds attributes, groups, dimensions and names as JSON."""


def pack_result(result: Any, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return an ArviZ object as arrays by name, with further attributes."""
    arrays: dict[str, Any] = {}
    view = ResultView.of(result)
    structure: dict[str, Any] = {"attrs": {**view.attrs, **attributes}, "groups": {}}
    for group, dataset in view.groups.items():
        description = dataset.to_dict(data="array")
        for part in ("coords", "data_vars"):
            for name, variable in description[part].items():
                values = np.asarray(variable.pop("data"))
                arrays[f"{group}/{part}/{name}"] = values.astype(str) if values.dtype.kind == "O" else values
        structure["groups"][group] = description
    arrays[_STRUCTURE] = json.dumps(structure, default=lambda value: np.asarray(value).tolist())
    return arrays


def unpack_result(arrays: Mapping[str, Any]) -> Any:
    """Return the ArviZ object of the arrays of `pack_result`."""
    structure = json.loads(str(arrays[_STRUCTURE]))
    for group, description in structure["groups"].items():
        for part in ("coords", "data_vars"):
            for name, variable in description[part].items():
                variable["data"] = arrays[f"{group}/{part}/{name}"]
    datasets = {group: xr.Dataset.from_dict(description) for group, description in structure["groups"].items()}
    return arviz_data.build(datasets, structure["attrs"])
