"""Named xarray datasets in one netCDF file, whichever ArviZ is installed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.utils.atomic_files import atomic_write

_JSON = "json:"


def write(
    groups: Mapping[str, xr.Dataset],
    attributes: Mapping[str, Any],
    path: str | Path,
    overwrite: bool = False,
) -> Path:
    """Write each dataset as a group of the netCDF file ``path``, and ``attributes`` at its root.

    netCDF attributes are strings and numbers. Everything else (None, booleans, lists, dicts) is
    written as ``json:...`` and read back by ``read``; other programs see the string.

    Args:
        groups: group name -> dataset.
        attributes: of the file as a whole.
        path: the file; written under a temporary name and renamed.
        overwrite: replace a file that exists.

    Returns:
        ``path`` as a Path.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is False.
    """
    with atomic_write(path, overwrite) as temporary:
        root = xr.Dataset(attrs=_encoded(attributes))
        root.to_netcdf(temporary, mode="w", engine="h5netcdf")
        for name, dataset in groups.items():
            _map_attributes(dataset, _encoded).to_netcdf(
                temporary, mode="a", group=name, engine="h5netcdf"
            )
    return Path(path)


def read(path: str | Path) -> tuple[dict[str, xr.Dataset], dict[str, Any]]:
    """Read what ``write`` wrote: the groups, in memory, and the attributes of the file.

    Args:
        path: a netCDF file.

    Returns:
        Group name -> dataset, and the attributes.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not netCDF (HDF5), or is cut short.
    """
    path = Path(path)
    if not path.is_file():
        problem = "is a folder" if path.is_dir() else "does not exist"
        raise FileNotFoundError(f"{path} {problem}; expected a netCDF file such as posterior.nc.")
    import h5netcdf

    try:
        with h5netcdf.File(path, "r") as file:
            names = list(file.groups)
        groups = {name: _read_group(path, name) for name in names}
        attributes = dict(_read_group(path, None).attrs)
    except (OSError, KeyError) as error:
        raise ValueError(
            f"{path} could not be read as a netCDF file ({error}). Expected a file written by "
            "lfm_ppl, such as the posterior.nc of `lfm-ppl fit`; it may be of another format or "
            "cut short in copying."
        ) from error
    return groups, attributes


def _read_group(path: Path, name: str | None) -> xr.Dataset:
    # decode_times would turn a variable whose unit is "hours" into time spans.
    with xr.open_dataset(
        path, group=name, engine="h5netcdf", decode_times=False, decode_timedelta=False
    ) as dataset:
        dataset = _map_attributes(dataset.load(), _decoded)
    for variable in dataset.variables.values():
        variable.encoding = {}
    # Strings come back as objects; fixed-width text is what went in.
    text = {
        name: (variable.dims, variable.values.astype(str), variable.attrs)
        for name, variable in dataset.variables.items()
        if variable.dtype.kind in "OT"
    }
    coordinates = {name: text.pop(name) for name in dataset.coords if name in text}
    return dataset.assign_coords(coordinates).assign(text)


def _map_attributes(dataset: xr.Dataset, change: Any) -> xr.Dataset:
    dataset = dataset.copy()
    dataset.attrs = change(dataset.attrs)
    for name in dataset.variables:
        dataset[name].attrs = change(dataset[name].attrs)
    return dataset


def _encoded(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {str(name): _encode(value) for name, value in attributes.items()}


def _encode(value: Any) -> Any:
    if isinstance(value, str) and value and not value.startswith(_JSON):
        return value
    if isinstance(value, (float, np.floating)):
        return float(value)
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
        value = int(value)
        if -(2**63) <= value < 2**63:
            return value
    return _JSON + json.dumps(value, default=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)) or hasattr(value, "__array__"):
        return np.asarray(value).tolist()
    if isinstance(value, (set, frozenset)):
        return sorted(value)
    return str(value)


def _decoded(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _decode(value) for name, value in attributes.items()}


def _decode(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, str) and value.startswith(_JSON):
        return json.loads(value[len(_JSON) :])
    return value
