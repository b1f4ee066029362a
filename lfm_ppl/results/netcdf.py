"""Named xarray datasets in one netCDF file, the same with ArviZ 0.23 and ArviZ 1.x.

xarray writes and reads the groups as a `DataTree`. Three conversions remain, so that a file gives back what went in:

1. netCDF attributes are strings and numbers: None, booleans, lists, dicts and empty strings are stored as ``json:...``.
2. Variables with the unit "hours" would be decoded into time spans: times are not decoded.
3. Strings are read as objects, which ArviZ cannot index by: they become text of fixed width.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.utils.atomic_files import atomic_write

_JSON = "json:"


def write(groups: Mapping[str, xr.Dataset], attributes: Mapping[str, Any], path: str | Path,
          overwrite: bool = False) -> Path:
    """Write each dataset as a group of a netCDF file, atomically, and return its path.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is False.
    """
    datasets = {"/": xr.Dataset(attrs=attributes), **groups}
    tree = xr.DataTree.from_dict({name: _with_attributes(dataset, _encode) for name, dataset in datasets.items()})
    with atomic_write(path, overwrite) as temporary:
        tree.to_netcdf(temporary, engine="h5netcdf")
    return Path(path)


def read(path: str | Path) -> tuple[dict[str, xr.Dataset], dict[str, Any]]:
    """Return the groups of a file of `write`, in memory, and its attributes.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not netCDF (HDF5), or is cut short.
    """
    path = Path(path)
    if not path.is_file():
        problem = "is a folder" if path.is_dir() else "does not exist"
        raise FileNotFoundError(f"{path} {problem}; expected a netCDF file such as posterior.nc.")
    try:
        with xr.open_datatree(path, engine="h5netcdf", decode_times=False, decode_timedelta=False) as tree:
            datasets = {name: node.to_dataset().load() for name, node in tree.children.items()}
            attributes = {str(name): _decode(value) for name, value in tree.attrs.items()}
    except (OSError, KeyError) as error:
        raise ValueError(
            f"{path} could not be read as a netCDF file ({error}). Expected a file written by lfm_ppl, such as the "
            "posterior.nc of `lfm-ppl fit`; it may be of another format or cut short in copying.") from error
    return {name: _with_text(_with_attributes(dataset, _decode)) for name, dataset in datasets.items()}, attributes


def _with_text(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset whose strings have a fixed width, without the encoding of its file."""
    texts = {name: (variable.dims, variable.values.astype(str), variable.attrs)
             for name, variable in dataset.variables.items() if variable.dtype.kind in "OT"}
    coordinates = {name: texts.pop(name) for name in dataset.coords if name in texts}
    return dataset.assign_coords(coordinates).assign(texts).drop_encoding()


def _with_attributes(dataset: xr.Dataset, convert: Callable[[Any], Any]) -> xr.Dataset:
    dataset = dataset.copy()
    for part in (dataset, *(dataset[name] for name in dataset.variables)):
        part.attrs = {str(name): convert(value) for name, value in part.attrs.items()}
    return dataset


def _encode(value: Any) -> Any:
    if isinstance(value, str) and value and not value.startswith(_JSON):
        return value
    if isinstance(value, (float, np.floating)):
        return float(value)
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool) and -(2**63) <= value < 2**63:
        return int(value)
    return _JSON + json.dumps(value, default=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)) or hasattr(value, "__array__"):
        return np.asarray(value).tolist()
    return sorted(value) if isinstance(value, (set, frozenset)) else str(value)


def _decode(value: Any) -> Any:
    value = value.item() if isinstance(value, np.generic) else value
    return json.loads(value[len(_JSON):]) if isinstance(value, str) and value.startswith(_JSON) else value
