"""The series of a panel in a result: the name of their dimension, their labels, and one of them alone.

1. The dimension of the series has the name of the plate, and is a dimension of the group ``data``.
2. Where series have times of their own, the coordinate ``times`` of a group holds them, one row for each series.
3. In groups of observed entries the dimension is a coordinate of the entries.
4. `select_series` takes one series in every group, and drops the rows that pad it.
5. `panel_of` returns a panel for the model of all series, in which the other series have no data.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from lfm_ppl.io.input_table import OF_SERIES
from lfm_ppl.results import arviz_data, inputs
from lfm_ppl.results.result_view import DIMENSIONS, ENTRY, SELECTED_SERIES, ResultView
from lfm_ppl.results.scalars import unit_of, units_attribute
from lfm_ppl.results.sites import site_view
from lfm_ppl.utils import checks

if TYPE_CHECKING:  # figures need no JAX
    from lfm_ppl.inference.bound_model import BoundModel

SERIES = "series"
"""Dimension of the series where a plate has no usable name; a second name of it in ``coords`` of `lfm_ppl.fit`."""

TIMES = "times"
"""Coordinate (series, time) of series that have times of their own."""

_NOT_OF_SERIES = ("accuracy",)
"""Groups about the panel as a whole."""


def plate_dimension(bound: BoundModel) -> str | None:
    """Return the name of a panel's plate, which is the dimension of its series; None for one series."""
    if np.ndim(bound.y) != 3:
        return None
    plates = [frame.name for frame in bound.trace()[bound.site.name].get("cond_indep_stack", ())]
    return plates[0] if len(plates) == 1 and plates[0] not in DIMENSIONS else SERIES


def times_of(dataset: xr.Dataset) -> xr.DataArray:
    """Return the times of a group, (K,), or (B, K) where series have their own."""
    return dataset[TIMES] if TIMES in dataset.variables else dataset["time"]


def time_coordinate(times: np.ndarray, panel: tuple[str, ...], units: Mapping[str, str]) -> dict[str, Any]:
    """Return the coordinate of times (K,) along the dimension "time", or (B, K) of series that have their own."""
    label, dims = ("time", ("time",)) if np.ndim(times) == 1 else (TIMES, (*panel, "time"))
    return {label: (dims, times, units_attribute(["time"], units))}


def select_series(result: Any, series: Any) -> Any:
    """Return one series of a panel, or one of several likelihood sites, as a result of one series.

    Figures, tables, scores and reports of one series take it. Rows that pad the series, all missing at the time of the
    row before, are left out, and so is the accuracy report, which is about the panel. Parameters that series share stay
    as they are. The observations of a likelihood site are called ``y``, whatever its name.

    Args:
        result: what `lfm_ppl.fit` or `lfm_ppl.forecast` returned for a panel, or for a model with several likelihood
            sites.
        series: label of the series, or its position where no label equals it; name of the site.

    Returns:
        An ArviZ object with the names and dimensions of a result of one series, which shares the arrays of ``result``.
        Its attribute ``selected`` names the series of a panel. `lfm_ppl.forecast` takes it with the model of the panel
        or of all sites; `lfm_ppl.check_accuracy` takes the whole result instead.

    Raises:
        ValueError: the result is of one series, or has no such series or site.

    Example:
        >>> y = xr.Dataset({"y": (("patient", "time", "output"), np.arange(4.0).reshape(2, 2, 1))})
        >>> y = y.assign_coords(patient=["Ann", "Bo"], time=[0.0, 1.0], output=["dose"])
        >>> draws = xr.Dataset({"rate": (("chain", "draw", "patient"), np.ones((1, 5, 2)))})
        >>> panel = arviz_data.build({"posterior": draws.assign_coords(patient=["Ann", "Bo"]), "data": y})
        >>> one = select_series(panel, "Bo")
        >>> one["data"]["y"].values.ravel().tolist(), one["posterior"]["rate"].dims
        ([2.0, 3.0], ('chain', 'draw'))
    """
    view = ResultView.of(result)
    selected = site_view(view, series) if view.likelihood_sites else series_view(view, series)
    return arviz_data.build(selected.groups, selected.attrs)


def series_view(view: ResultView, series: Any) -> ResultView:
    """Return the view of one series of a panel, see `select_series`."""
    dimension, labels = view.series_dimension, view.series_labels
    if dimension is None:
        raise ValueError("the result is of one series, so that there is none to select; take the result.")
    index = _position(labels, series)
    observed = view.group("data")
    name = next(label for label in observed.data_vars if dimension in observed[label].dims and label != TIMES)
    is_observed = observed[name].notnull().any("output").transpose(dimension, "time").values
    times = _select(observed, dimension, index, labels[index])["time"].values
    is_later = np.diff(times, prepend=-np.inf) > 0
    groups = {}
    for label, dataset in view.groups.items():
        if label in _NOT_OF_SERIES:
            continue
        dataset = _select(dataset, dimension, index, labels[index])
        if label == "trajectories" and TIMES in view.groups[label].variables:
            # The times of trajectories are padded by the last one.
            dataset = dataset.isel(time=np.diff(dataset["time"].values, prepend=-np.inf) > 0)
        elif label in ("data", "one_step_ahead"):
            dataset = dataset.isel(time=is_observed[index] | is_later)
        elif label in (inputs.GROUP, inputs.FORECAST):
            dataset = _select_inputs(view.group(label), str(labels[index]))
        elif label == "predictions":
            last = np.max(times[is_observed[index]], initial=-np.inf)
            dataset = dataset.assign_attrs(last_observation=float(last))
        groups[label] = dataset
    posterior = view.posterior
    panel = {"dimension": dimension, "labels": labels, "index": index, "has_series_times": TIMES in observed.variables,
             "has_labels": dimension in observed.coords,
             "rows": observed.sizes["time"],
             "axes": {str(label): variable.dims.index(dimension) for label, variable in posterior.data_vars.items()
                      if dimension in variable.dims},
             "inputs": sorted({label.partition(OF_SERIES)[0] for label in view.inputs if OF_SERIES in label})}
    attrs = _select_mode(view, dimension, index)
    return view.with_groups(groups, attrs | {"selected": f"{dimension} {labels[index]}",
                                             SELECTED_SERIES: json.dumps(panel)})


def panel_of(view: ResultView) -> tuple[ResultView, Any]:
    """Return a panel in which the other series have no data, and the label of the selected series.

    The other series have its times, known inputs and parameters, for a model that needs numbers of all series.
    """
    panel = view.decoded(SELECTED_SERIES)
    dimension, labels, index = panel["dimension"], panel["labels"], panel["index"]
    is_selected = xr.DataArray(np.arange(len(labels)) == index, dims=dimension)

    def without_others(dataset: xr.Dataset, fill: float) -> xr.Dataset:
        # Rows pad the series again, so that its draws equal a forecast of the panel.
        rows, size = np.arange(panel["rows"]), dataset.sizes["time"]
        dataset = dataset.isel(time=np.minimum(rows, size - 1)).where(xr.DataArray(rows < size, dims="time"), fill)
        names = list(dataset.data_vars)
        filled = dataset.assign({name: dataset[name].where(is_selected, fill).transpose(*lead, dimension, ...)
                                 for name in names for lead in [[dim for dim in ("chain", "draw")
                                                                 if dim in dataset[name].dims]]})
        if panel["has_series_times"]:
            times = np.tile(dataset["time"].values, (len(labels), 1))
            filled = filled.drop_vars("time").assign_coords(
                {TIMES: ((dimension, "time"), times, dataset["time"].attrs)})
        return filled.assign_coords({dimension: labels}) if panel["has_labels"] else filled

    posterior = view.posterior
    repeated = {name: posterior[name].expand_dims({dimension: len(labels)}, axis)
                for name, axis in panel["axes"].items()}
    groups = {"posterior": posterior.assign(repeated),
              "data": without_others(view.group("data"), np.nan)}
    if "one_step_ahead" in view.groups:
        groups["one_step_ahead"] = without_others(view.groups["one_step_ahead"], 0.0)
    if inputs.GROUP in view.groups:
        groups[inputs.GROUP] = inputs.to_dataset(of_all_series(view, view.inputs))
    attrs = {name: value for name, value in view.attrs.items()
             if name not in (SELECTED_SERIES, "selected", arviz_data.MODE, arviz_data.DEGENERATE)}
    return view.with_groups(groups, attrs), labels[index]


def of_all_series(view: ResultView, tables: Mapping[str, Any]) -> dict[str, Any]:
    """Return known inputs of a selected series under the names that its panel has for them, the same for all series."""
    panel = view.decoded(SELECTED_SERIES)
    return {label: value for name, value in tables.items()
            for label in ([f"{name}{OF_SERIES}{series}" for series in panel["labels"]] if name in panel["inputs"]
                          else [name])}


def _select_inputs(stored: xr.Dataset, series: str) -> xr.Dataset:
    """Return the known inputs of a series, without its label in their names."""
    all_tables = inputs.from_dataset(stored)
    names = {name: name.partition(OF_SERIES) for name in all_tables}
    owned = {name: short for name, (short, _, owner) in names.items() if owner in ("", series)}
    tables = {owned[name]: table for name, table in all_tables.items() if name in owned}
    units = {short: unit_of(stored[name]) for name, short in owned.items()}
    return inputs.to_dataset(tables, {name: unit for name, unit in units.items() if unit})


def _position(labels: list[Any], series: Any) -> int:
    for index, label in enumerate(labels):
        if str(series) == str(label):
            return index
    if isinstance(series, (int, np.integer)) and -len(labels) <= series < len(labels):
        return int(series) % len(labels)
    raise ValueError(checks.unknown("series", str(series), list(map(str, labels))))


def _select(dataset: xr.Dataset, dimension: str, index: int, label: Any) -> xr.Dataset:
    """Return a group of one series, whose own times become the coordinate of the group."""
    if dimension in dataset.coords and dataset[dimension].dims == (ENTRY,):
        is_of_series = dataset[dimension].values == label
        return dataset.isel({ENTRY: is_of_series}).drop_vars(dimension)
    if dimension in dataset.dims:
        dataset = dataset.isel({dimension: index}, drop=True)
    if TIMES not in dataset.variables:
        return dataset
    times = dataset[TIMES]
    return dataset.drop_vars(TIMES).assign_coords(time=("time", times.values, times.attrs))


def _select_mode(view: ResultView, dimension: str, index: int) -> dict[str, Any]:
    """Return the attributes with the mode of one series, and its degenerate parameters."""
    modes, degenerate = view.decoded(arviz_data.MODE), view.decoded(arviz_data.DEGENERATE)
    for name, value in modes.items():
        variable = view.posterior.get(name.replace("/", "."))
        if variable is None or dimension not in variable.dims:
            continue
        axis = variable.dims.index(dimension) - 2
        modes[name] = np.take(value, index, axis).tolist()
        if name in degenerate:
            is_degenerate = np.isin(np.arange(np.size(value)), degenerate[name]).reshape(np.shape(value))
            degenerate[name] = np.flatnonzero(np.take(is_degenerate, index, axis)).tolist()
    changed = {arviz_data.MODE: modes, arviz_data.DEGENERATE: degenerate}
    return {**view.attrs, **{name: json.dumps(value) for name, value in changed.items() if name in view.attrs}}
