"""Layout of the groups of a result: variables, dimensions, coordinates and units.

1. Name the dimensions of each site by plates, outputs, or the user's labels.
2. Lay out posterior, sampler statistics, data, scores, trajectories, predictions and truth as datasets. The groups that
   ArviZ compares with each other have one dimension for all observed entries: ArviZ knows no missing values.
3. Add means and 95% intervals to trajectories, from the mixture of normal distributions over the draws.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from lfm_ppl.forces.quasi_periodic import QuasiPeriodic
from lfm_ppl.inference.trajectories import LOG_PRIOR
from lfm_ppl.io.truth import TRUTH, check_truth
from lfm_ppl.model.observation_noise import expected_observation
from lfm_ppl.results.predictions import GROUP, INTERVAL, NOISE_FREE, PERIODS, REGIMES, mixture_quantiles, predictions
from lfm_ppl.results.result_view import ENTRY
from lfm_ppl.results.scalars import DERIVED, units_attribute
from lfm_ppl.results.series import SERIES, plate_dimension, time_coordinate, times_of
from lfm_ppl.utils import checks

if TYPE_CHECKING:
    from lfm_ppl.inference.bound_model import BoundModel
    from lfm_ppl.model.latent_force_model import LatentForceModel

OUTPUT = "output"


@dataclass(frozen=True)
class Labels:
    """Names of dimensions, and of what stands along them.

    Attributes:
        dims: site -> a name, or None where there is none, for each axis of its value.
        coords: dimension -> labels.
        derived: names of the deterministic sites.
        series: dimension of the series of a panel, the name of its plate; None for one series.
    """

    dims: Mapping[str, tuple[str | None, ...]]
    coords: Mapping[str, list]
    derived: frozenset[str] = frozenset()
    series: str | None = None

    @classmethod
    def of(cls, bound: BoundModel, dims: Mapping[str, Sequence[str]] | None = None,
           coords: Mapping[str, Sequence[Any]] | None = None, y: Any = None) -> Labels:
        """Return the names that a model and its user give.

        A site's own dimensions come from ``dims``, else from ``event_dims`` of its ``infer`` and from the plates that
        it stands in. The plate of a panel is the dimension of the series in all groups, with the labels of the data or
        the numbers from zero.

        Args:
            bound: the model.
            dims: site -> names of the axes of its value.
            coords: dimension -> labels.
            y: the data as they were given, whose column names, or labels of the first dimension, are kept.

        Raises:
            ValueError: a site that the model has not; a number of names or labels that does not fit.
        """
        trace = bound.trace()
        site = bound.site
        series = plate_dimension(bound)
        plates = [frame.name for frame in trace[site.name].get("cond_indep_stack", ())]
        renamed = {plates[0]: series} if series is not None and len(plates) == 1 else {}
        likelihoods = {likelihood.name for likelihood in bound.traced.likelihoods}
        dimensions = {name: _axes(site_trace, renamed) for name, site_trace in trace.items()
                      if name not in likelihoods and site_trace["type"] in ("sample", "deterministic")}
        derived = frozenset(name for name in dimensions if trace[name]["type"] == "deterministic")
        for name, requested_dims in (dims or {}).items():
            names: list[str] = [requested_dims] if isinstance(requested_dims, str) else list(requested_dims)
            if name not in dimensions:
                raise ValueError(f"dims: {checks.unknown('parameter', name, dimensions)}")
            if len(names) != len(dimensions[name]):
                raise ValueError(f"dims: {name!r} has {len(dimensions[name])} dimensions, of shape "
                                 f"{np.shape(trace[name]['value'])}, and {len(names)} names: {', '.join(names)}.")
            dimensions[name] = tuple(str(text) for text in names)
        sizes = {OUTPUT: len(site.example.ssm.model.output_names)}
        sizes |= {} if series is None else {series: np.shape(bound.y)[0]}
        for name, axes in dimensions.items():
            for text, size in zip(axes, np.shape(trace[name]["value"]), strict=True):
                if text is not None and sizes.setdefault(text, size) != size:
                    raise ValueError(f"the dimension {text!r} has {sizes[text]} entries elsewhere and {size} in "
                                     f"{name!r}; give them different names.")
        if series is not None:
            renamed = {SERIES: series, **renamed}
        labels = {renamed.get(text, text): list(values) for text, values in (coords or {}).items()}
        if series is not None and series not in labels:
            has_labels = getattr(y, "dims", None) and y.dims[0] in y.coords  # an array of xarray
            labels[series] = y[y.dims[0]].values.tolist() if has_labels else list(range(sizes[series]))
        if OUTPUT not in labels and hasattr(y, "columns"):
            labels[OUTPUT] = [str(column) for column in y.columns]
        for text, values in labels.items():
            if text not in sizes:
                raise ValueError(f"coords: {checks.unknown('dimension', text, sizes)}")
            if len(values) != sizes[text] or len(set(values)) < len(values):
                raise ValueError(f"coords: the dimension {text!r} needs {sizes[text]} labels, each of them once; got "
                                 f"{len(values)}: {', '.join(map(str, values))}.")
        return cls(dimensions, labels, derived, series)


def _axes(site: Mapping[str, Any], renamed: Mapping[str, str]) -> tuple[str | None, ...]:
    """Return a name for each axis of the value of a site in a trace."""
    ndim = np.ndim(site["value"])
    events = site["fn"].event_dim if site["type"] == "sample" else 0
    names: list[str | None] = [None] * ndim
    event_dims = tuple((site.get("infer") or {}).get("event_dims", ()))
    if event_dims:
        names[ndim - len(event_dims):] = [str(text) for text in event_dims]
    frames = site.get("cond_indep_stack") or ()
    if site["type"] == "sample" or len(frames) == ndim:
        for frame in frames:
            axis = ndim - events + frame.dim
            if 0 <= axis < ndim:
                names[axis] = renamed.get(frame.name, frame.name)
    return tuple(names)


class TrajectoryDraws(NamedTuple):
    """Trajectories at some draws of each chain.

    Attributes:
        draw_index: (S,), draws of each chain that have trajectories.
        paths: `lfm_ppl.inference.trajectories.trajectories`, (C, S, ...); None: no trajectories.
        times: (K,) times of the trajectories; None: the times of the data.
    """

    draw_index: np.ndarray | None = None
    paths: dict[str, np.ndarray] | None = None
    times: np.ndarray | None = None


def lay_out(bound: BoundModel, draws: dict, stats: dict, scores: dict | None, trajectories: TrajectoryDraws,
            truth: Mapping[str, Any] | None, labels: Labels) -> dict[str, xr.Dataset]:
    """Return the groups of a result.

    Args:
        bound: the model and its data.
        draws: site -> (C, N, ...).
        stats: statistic of the sampler -> (C, N).
        scores: `lfm_ppl.inference.trajectories.scores` of all draws, one chain after another; None: no scores.
        trajectories: trajectories at some of the draws.
        truth: truth of simulated data.
        labels: names of axes.
    """
    draw_index, paths, grid = trajectories
    site, times, y = bound.site, bound.times, np.asarray(bound.y)
    chains, samples = next(iter(draws.values())).shape[:2]
    model = site.example.ssm.model
    units = model.units
    panel = () if labels.series is None else (labels.series,)
    along = (*panel, "time")
    coords: dict[str, Any] = {"chain": np.arange(chains), "draw": np.arange(samples)}
    clock: dict[str, Any] = time_coordinate(times, panel, units)
    outputs = labels.coords.get(OUTPUT, list(model.output_names))
    units = units | {new: units[old] for old, new in zip(model.output_names, outputs, strict=True) if old in units}
    named = {"output": outputs, "state": list(model.state_names), "force": list(model.force_names),
             "deterministic": list(model.deterministic_names)}

    def variable(dims: Sequence[str], values: Any, names: Sequence[str] = ()) -> tuple:
        return tuple(dims), np.asarray(values), units_attribute(names, units)

    sample = ("chain", "draw", *along)
    which = {name: labels.coords[name] for name in panel}
    data_coords = {**clock, **which, "output": named["output"]}
    data = xr.Dataset({site.name: variable((*along, "output"), y, named["output"])}, data_coords)
    is_observed = np.isfinite(y)
    entries = entry_coordinates(data, is_observed)
    groups = {
        # Sites differ in their outputs, and the dimension "output" of a parameter does not say whose they are.
        "posterior": _posterior(draws, coords, {**named, OUTPUT: []} if bound.is_by_site else named, labels),
        "sample_stats": xr.Dataset({k: (("chain", "draw"), v) for k, v in stats.items()}, coords),
        "data": data,
        "observed_data": xr.Dataset({site.name: (ENTRY, y[is_observed], data[site.name].attrs)}, entries),
    }
    if scores is not None:
        split = {label: value.reshape(chains, samples, *value.shape[1:]) for label, value in scores.items()}
        of_entries = ("chain", "draw", ENTRY)
        groups["log_likelihood"] = xr.Dataset(
            {site.name: (of_entries, split["leave_one_out"][:, :, is_observed])}, {**coords, **entries})
        groups["posterior_predictive"] = xr.Dataset(
            {site.name: (of_entries, split["replicate"][:, :, is_observed], data[site.name].attrs)},
            {**coords, **entries})
        counted = [groups[name] for name in ("observed_data", "posterior_predictive")]
        if all(_are_whole(dataset[site.name].values) for dataset in counted):  # ArviZ knows counts by their type
            for dataset in counted:
                dataset[site.name] = dataset[site.name].astype(int)
        groups["log_prior"] = xr.Dataset({label.removeprefix(LOG_PRIOR): (("chain", "draw"), value)
                                          for label, value in split.items() if label.startswith(LOG_PRIOR)}, coords)
        groups["one_step_ahead"] = xr.Dataset(
            {"log_density": variable(sample, split["one_step_ahead"]),
             "residual": variable((*sample, "output"), split["residual"])}, {**coords, **data_coords})
    if paths is not None:
        thinned = {"chain": np.arange(chains), "draw": draw_index}
        dimensions = ("chain", "draw", *panel, "time")
        path_coords = {} if grid is None else time_coordinate(grid, panel, units)
        groups["trajectories"] = xr.Dataset(
            {f"{kind}s": variable((*dimensions, kind), paths[kind], named[kind])
             for kind in named if paths[kind].shape[-1]},
            {**thinned, **path_coords, **which, **{kind: named[kind] for kind in named if named[kind]}})
        groups["trajectories"]["outputs"].attrs["long_name"] = NOISE_FREE
        if periods := force_periods(model):
            groups["trajectories"]["forces"].attrs[PERIODS] = json.dumps(periods)
        if site.example.regime_names:
            groups["trajectories"]["states"].attrs[REGIMES] = json.dumps(site.example.regime_names)
        groups["trajectories"] = with_summaries(groups["trajectories"], paths)
        if "prediction" in paths and grid is not None:
            groups[GROUP] = predictions(bound, paths, np.asarray(draw_index), grid, labels.coords, labels.series)
    if truth:
        groups["truth"] = _truth(truth, named, units, groups["posterior"])
        for kind, values in _true_functions(bound, truth, draws).items():
            new = {f"{kind}s": variable(("time", kind), values, named[kind])}
            truth_group = groups["truth"]
            if f"{kind}s" in truth_group:  # some of them, by the user
                truth_group = truth_group.drop_dims(kind)
            groups["truth"] = truth_group.assign(new).assign_coords({kind: named[kind]})
    return groups


def _are_whole(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).all() and (values == np.round(values)).all())


def entry_coordinates(data: xr.Dataset, is_observed: np.ndarray) -> dict[str, Any]:
    """Return time, output and series of each observed entry, along the dimension `ENTRY`.

    Args:
        data: of one site, with dimensions (time, output) or (series, time, output).
        is_observed: whether an entry of the data is observed, of the shape of the data.
    """
    dims = list(next(data[name].dims for name in data.data_vars))
    times = times_of(data).transpose(*(dim for dim in dims if dim in times_of(data).dims))
    index = dict(zip(dims, np.nonzero(is_observed), strict=True))
    coordinates = {str(dim): (ENTRY, data[dim].values[index[dim]]) for dim in dims if dim != "time"}
    return {"time": (ENTRY, times.values[tuple(index[str(dim)] for dim in times.dims)], times.attrs), **coordinates}


def force_periods(model: LatentForceModel) -> dict[str, float]:
    """Return the period of each force that repeats, exactly or nearly, by name."""
    periods = {name: checks.concrete(force.period) for name, force in model.forces.items()
               if isinstance(force, QuasiPeriodic)}
    return {name: float(period) for name, period in periods.items() if period is not None}


def with_summaries(trajectories: xr.Dataset, paths: Mapping[str, np.ndarray]) -> xr.Dataset:
    """Return trajectories with the mean and the 95% interval at each time, where their density is known.

    That is a mixture of normal distributions, one for each draw of the parameters. The quantiles of a mixture are
    smooth in time and much more accurate than the quantiles of the draws: 400 draws leave an error of a seventh of
    an sd. Functions that are not linear have several points for each draw, which move smoothly in time.

    Args:
        trajectories: draws of states, forces and outputs, (chain, draw, ..., at, kind).
        paths: `lfm_ppl.inference.trajectories.trajectories`, (C, S, ..., K, size).

    Returns:
        Variables ``states_summary``, ``forces_summary``, ``deterministics_summary``, ``outputs_summary``
        (noise-free) and ``new_data_summary`` (with the noise) are added, with the dimension ``statistic``: mean, q2.5,
        q97.5. Quantities known by draws only have no summary.
    """
    datasets = {}
    for name, (mean, sd) in {"states": ("state_mean", "state_sd"), "forces": ("force_mean", "force_sd"),
                             "deterministics": ("deterministic_points", None),
                             "outputs": ("predictive_mean", "output_sd"),
                             "new_data": ("predictive_mean", "predictive_sd")}.items():
        if "output_points" in paths and mean == "predictive_mean":
            mean, sd = "output_points", None if name == "outputs" else "noise_sd_points"
        if mean not in paths or paths[mean].shape[-1] == 0 or (sd is not None and not np.any(paths.get(sd, 0.0) > 0)):
            continue
        like = trajectories["outputs" if name == "new_data" else name]
        dims = [dim for dim in like.dims if dim not in ("chain", "draw")]
        shape = tuple(like.sizes[dim] for dim in dims)

        def flat(label: str, shape: tuple[int, ...] = shape) -> np.ndarray:
            values = paths[label]
            # The axis of points goes beside the axes of the draws.
            return (np.moveaxis(values, -3, 2) if label.endswith("_points") else values).reshape(-1, *shape)

        means = flat(mean)
        bounds = (np.quantile(means, INTERVAL, axis=0) if sd is None
                else mixture_quantiles(means, flat(sd), INTERVAL, _TOLERANCE))
        attrs = {"units": like.attrs["units"]} if "units" in like.attrs else {}
        datasets[f"{name}_summary"] = (("statistic", *dims), np.concatenate([means.mean(axis=0)[None], bounds]), attrs)
    return trajectories.assign(datasets).assign_coords(statistic=list(STATISTICS)) if datasets else trajectories


_TOLERANCE = 1e-4
"""Tolerance of the ends of an interval, in usual standard deviations of a draw, far below the Monte Carlo error."""

STATISTICS = ("mean", "q2.5", "q97.5")
"""Statistics of a summary of trajectories at each time."""


def _posterior(draws: dict, coords: dict, named: Mapping[str, list], labels: Labels) -> xr.Dataset:
    variables: dict[str, Any] = {}
    extra: dict[str, Any] = {}
    # Sampled sites come before derived ones.
    for label, value in sorted(draws.items(), key=lambda item: item[0] in labels.derived):
        shape = value.shape[2:]
        site_dims = labels.dims.get(label, (None,) * len(shape))
        site_dims = site_dims if len(site_dims) == len(shape) else (None,) * len(shape)
        dims = [name or f"{label}_dim_{axis}" for axis, name in enumerate(site_dims)]
        for name, size in zip(dims, shape, strict=True):
            ticks = labels.coords.get(name, named.get(name, ()))
            extra[name] = list(ticks) if len(ticks) == size else np.arange(size)
        variables[label] = (("chain", "draw", *dims), value, {DERIVED: 1} if label in labels.derived else {})
    return xr.Dataset(variables, {**coords, **extra})


def _true_functions(bound: BoundModel, truth: Mapping[str, Any],
                    draws: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return outputs (K, D), noise-free, and deterministics (K, Q) along the true path, where all of it is known.

    The dictionary is empty if the model fixes a parameter at another value. So it is if the model raises an error for
    the truth, of which a warning tells.
    """
    parameters, forces = truth.get("parameters") or {}, truth.get("forces") or {}
    model = bound.site.example.ssm.model
    if (np.ndim(bound.y) != 2 or truth.get("times") is None or truth.get("state") is None
            or not set(bound.sites) <= set(parameters) or not set(model.force_names) <= set(forces)):
        return {}
    times = np.asarray(truth["times"], float)
    parts = [np.asarray(truth["state"], float), *(np.asarray(forces[name], float) for name in model.force_names)]
    size = len(model.state_names)
    if [part.shape for part in parts] != [(len(times), size), *[(len(times),)] * len(model.force_names)]:
        return {}
    if any(_is_fixed_elsewhere(draws[name], parameters[name]) for name in set(parameters) & set(draws)):
        return {}
    values = {name: np.broadcast_to(np.asarray(parameters[name], float), draws[name].shape[2:]) for name in bound.sites}
    w = jnp.asarray(np.column_stack(parts))
    try:
        ssm = bound.likelihood(values).ssm
        series = {OUTPUT: np.asarray(jax.vmap(functools.partial(expected_observation, ssm))(w, jnp.asarray(times)))}
        if model.deterministic_names:
            series["deterministic"] = np.asarray(jax.vmap(ssm.deterministics)(w, times))
    except Exception as error:  # of user code; the draws are worth having without it
        checks.warn("the true outputs are left out of the figures: at the true parameters the model raises "
                    f"{type(error).__name__}: {error}")
        return {}
    return series


def _is_fixed_elsewhere(draws: np.ndarray, truth: Any) -> bool:
    """Return whether an element is the same in all draws (C, S, ...) and differs from the truth."""
    try:
        fixed = np.ptp(draws, axis=(0, 1)) == 0
        return bool(np.any(fixed & ~np.isclose(draws[0, 0], np.broadcast_to(truth, fixed.shape))))
    except ValueError:
        return True


def _true_states(truth: Mapping[str, Any]) -> np.ndarray:
    state = truth.get("state")
    return np.zeros(0) if state is None else np.asarray(state, float)


def checked_truth(bound: BoundModel, truth: Mapping[str, Any] | None, labels: Labels) -> dict[str, Any]:
    """Return the entries of a truth that a result can store, as in `lfm_ppl.Data.truth`, and warn of the others.

    Raises:
        ValueError: inconsistent entries.
    """
    if not truth:
        return {}
    entries = dict(truth)
    for name in [name for name in entries if name not in TRUTH]:
        checks.warn(f"{checks.unknown('entry of the truth', name, TRUTH)} It is ignored.")
        del entries[name]
    if np.ndim(bound.y) != 2 and set(entries) - {"parameters"}:
        checks.warn("the truth of several series is limited to parameters; states and forces are ignored.")
        entries = {name: value for name, value in entries.items() if name == "parameters"}
    try:
        check_truth(entries)
    except ValueError as error:
        raise ValueError(f"the truth is inconsistent: {error}") from None
    for message in unplaced(bound, entries, labels):
        checks.warn(message)
    return entries


def unplaced(bound: BoundModel, truth: Mapping[str, Any], labels: Labels) -> list[str]:
    """Return a message for each entry of a truth that the model does not have."""
    model = bound.site.example.ssm.model
    expected_names = {"force": model.force_names, "deterministic": model.deterministic_names,
             "parameter": (*bound.sites, *sorted(labels.derived))}
    errors = [checks.unknown(f"{kind} in the truth", name, names) for kind, names in expected_names.items()
             for name in truth.get(f"{kind}s") or {} if name not in names]
    columns = _true_states(truth).shape[1:]
    if columns and columns != (len(model.state_names),):
        errors.append(f"the truth has {columns[0]} states, the model {len(model.state_names)}: "
                     f"{', '.join(model.state_names) or 'none'}.")
    return [f"{message} It is left out of the figures." for message in errors]


def _truth(truth: Mapping[str, Any], named: dict, units: Mapping[str, str],
           posterior: xr.Dataset) -> xr.Dataset:
    variables: dict[str, Any] = {}
    coords: dict[str, Any] = {}
    if truth.get("times") is not None:
        coords["time"] = ("time", np.asarray(truth["times"], float), units_attribute(["time"], units))
    for kind in ("force", "deterministic"):
        paths = truth.get(f"{kind}s") or {}
        stored_labels = [label for label in named[kind] if label in paths]
        if stored_labels:
            coords[kind] = stored_labels
            values = np.stack([np.asarray(paths[label]) for label in stored_labels], axis=1)
            variables[f"{kind}s"] = (("time", kind), values,
                                     units_attribute(stored_labels, units))
    if _true_states(truth).shape[1:] == (len(named["state"]),):
        coords["state"] = named["state"]
        variables["states"] = (("time", "state"), np.asarray(truth["state"]),
                               units_attribute(named["state"], units))
    for label, value in (truth.get("parameters") or {}).items():
        value = np.asarray(value, float)
        if label not in posterior:
            continue
        dims = posterior[label].dims[2:]
        if value.shape == posterior[label].shape[2:]:
            variables[label] = (dims, value)
            coords |= {name: posterior[name].values for name in dims}
        else:
            variables[label] = ([f"{label}_true_{axis}" for axis in range(value.ndim)], value)
    return xr.Dataset(variables, coords)
