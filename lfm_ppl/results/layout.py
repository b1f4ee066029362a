"""Layout of the groups of a result: variables, dimensions, coordinates and units.

1. Name the dimensions of each site (`lfm_ppl.results.labels`).
2. Lay out posterior, sampler statistics, data, scores, trajectories, predictions and truth as datasets. The groups that
   ArviZ compares with each other have one dimension for all observed entries: ArviZ knows no missing values.
3. Add means and 95% intervals to trajectories, from the mixture of normal distributions over the draws.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import xarray as xr

from lfm_ppl.forces.quasi_periodic import QuasiPeriodic
from lfm_ppl.inference.trajectories import LOG_PRIOR
from lfm_ppl.results.labels import OUTPUT, Labels
from lfm_ppl.results.predictions import GROUP, INTERVAL, NOISE_FREE, PERIODS, REGIMES, mixture_quantiles, predictions
from lfm_ppl.results.result_view import ENTRY
from lfm_ppl.results.scalars import DERIVED, units_attribute
from lfm_ppl.results.series import time_coordinate, times_of
from lfm_ppl.results.true_values import true_functions, truth_dataset
from lfm_ppl.utils import checks

if TYPE_CHECKING:
    from lfm_ppl.inference.bound_model import BoundModel
    from lfm_ppl.model.latent_force_model import LatentForceModel


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
        groups["truth"] = truth_dataset(truth, named, units, groups["posterior"])
        for kind, values in true_functions(bound, truth, draws).items():
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
