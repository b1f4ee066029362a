"""Named scalar parameters and units of the variables of a result."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from lfm_ppl.utils.checks import unknown

SAMPLE_DIMS = ("chain", "draw")

DERIVED = "derived"
"""Attribute of a variable of the posterior that is computed from the sampled ones."""


def scalar_draws(dataset: xr.Dataset) -> dict[str, np.ndarray]:
    """Return every scalar of ``dataset`` by name: vector entries as ``decay[CDKN1A]``.

    Args:
        dataset: variables of dimensions (chain, draw, ...).

    Returns:
        Label -> draws of shape (chain, draw), in the order of the variables.
    """
    draws = {}
    for name, variable in dataset.data_vars.items():
        # Variables without both dimensions, such as a shared mass matrix, are not draws.
        if not set(SAMPLE_DIMS) <= set(variable.dims):
            continue
        variable = variable.transpose(*SAMPLE_DIMS, ...)
        flat = variable.values.reshape(*variable.shape[:2], -1)
        for index, label in enumerate(_labels(str(name), variable)):
            draws[label] = flat[..., index]
    return draws


def choose(draws: Mapping[str, np.ndarray], names: str | Sequence[str] | None) -> list[str]:
    """Return the labels that ``names`` ask for: ``decay`` stands for all of ``decay[...]``.

    Args:
        draws: what ``scalar_draws`` returned.
        names: labels or names of parameters; None for all that vary.

    Returns:
        Labels, in the order asked for, without repetition.

    Raises:
        ValueError: a name is unknown.
    """
    if names is None:
        return [label for label, values in draws.items() if np.ptp(values) != 0.0]
    selected: dict[str, None] = {}
    for name in [names] if isinstance(names, str) else names:
        labels = [label for label in draws if label == name or label.partition("[")[0] == name]
        if not labels:
            sites = dict.fromkeys(label.partition("[")[0] for label in draws)
            raise ValueError(unknown("parameter", name, [*sites, *(d for d in draws if "[" in d)]))
        selected.update(dict.fromkeys(labels))
    return list(selected)


def sampled(posterior: xr.Dataset) -> list[str]:
    """Return the labels of what was sampled and varies; of all that varies where a result does not tell them apart."""
    free = posterior[[name for name, variable in posterior.data_vars.items() if not variable.attrs.get(DERIVED)]]
    return choose(scalar_draws(free), None) or choose(scalar_draws(posterior), None)


def scalar_truth(posterior: xr.Dataset, truth: xr.Dataset) -> dict[str, float]:
    """Return the true value of each scalar of ``posterior`` that ``truth`` knows, by label."""
    values: dict[str, float] = {}
    for name, variable in posterior.data_vars.items():
        if name not in truth.data_vars or not set(SAMPLE_DIMS) <= set(variable.dims):
            continue
        labels = _labels(str(name), variable)
        value = truth[name]
        if value.size == 1:  # one value for every entry of a vector
            values.update(dict.fromkeys(labels, value.item()))
        elif set(value.dims) <= set(value.coords):
            named = zip(_labels(str(name), value), value.values.ravel(), strict=True)
            values.update({label: float(v) for label, v in named if label in labels})
        elif value.size == len(labels):
            values.update(zip(labels, map(float, value.values.ravel()), strict=True))
    return values


def units_attribute(names: Sequence[str], units: Mapping[str, str] | str | None) -> dict[str, str]:
    """Return the attribute that gives a variable its unit, or one unit for each of ``names``.

    The attribute is a plain string where all units agree, else a JSON object, because netCDF
    attributes cannot be dicts. ``unit_of`` reads both.

    Example:
        >>> units_attribute(["x", "v"], {"x": "m", "v": "m/s"})
        {'units': '{"x": "m", "v": "m/s"}'}
        >>> units_attribute(["x", "y"], {"x": "m", "y": "m"})
        {'units': 'm'}
        >>> units_attribute(["x"], None)
        {}
    """
    if isinstance(units, str):
        return {"units": units} if units else {}
    known_units = {name: units[name] for name in names if units.get(name)} if units else {}
    if not known_units:
        return {}
    if set(known_units) == set(names) and len(set(known_units.values())) == 1:
        return {"units": next(iter(known_units.values()))}
    return {"units": json.dumps(known_units)}


def unit_of(variable: xr.DataArray, name: str | None = None) -> str:
    """Return the unit of ``variable``, or of its entry ``name``; empty where it is not known."""
    units = variable.attrs.get("units", "")
    if isinstance(units, str) and units.startswith("{"):
        try:
            units = json.loads(units)
        except json.JSONDecodeError:
            return str(units)
    if isinstance(units, Mapping):
        units = units.get(name, "")
    return str(units or "")


def _labels(name: str, variable: xr.DataArray) -> list[str]:
    dims = [dim for dim in variable.dims if dim not in SAMPLE_DIMS]
    if not dims:
        return [name]
    # Without a coordinate, the labels of a dimension are 0, 1, ...
    ticks = [variable[dim].values for dim in dims]
    return [f"{name}[{','.join(map(str, entry))}]" for entry in itertools.product(*ticks)]
