"""The group ``predictions`` of a result: new observations, with their noise, at requested times.

1. Lay out draws of new observations, of noise-free outputs and of the paths.
2. Intervals are quantiles of the mixture of normal distributions over the draws, by bisection; of draws otherwise.
3. `summary` gives one row per time and output.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr
from scipy import special

from lfm_ppl.results.scalars import units_attribute
from lfm_ppl.results.series import time_coordinate

if TYPE_CHECKING:  # figures, which read predictions, need no JAX
    from lfm_ppl.inference.bound_model import BoundModel

GROUP = "predictions"

HELD_OUT = "held_out_data"
"""Group of the data that predictions were compared with."""

NOISE_FREE = "noise-free output"
"""What is said of ``outputs`` wherever they are stored."""

INTERVAL = (0.025, 0.975)

PERIODS = "periods"
"""Attribute of trajectories of forces: name -> period of those that repeat, as JSON."""

REGIMES = "regimes"
"""Attribute of trajectories of states: the states that indicate regimes, as JSON."""

SHOWN_PERIODS = 3
"""Number of periods, the last ones, that figures show of a force that repeats often."""

MEAN, SD, FREE_SD = "y_mean", "y_sd", "outputs_sd"
"""Mean of the normal distribution that y has at each draw, its sd, and its sd without the noise."""


def predictions(bound: BoundModel, paths: Mapping[str, np.ndarray], draw_index: np.ndarray, times: np.ndarray,
                labels: Mapping[str, Any] | None = None, series: str | None = None) -> xr.Dataset:
    """Lay out new observations, and the paths that they were drawn along.

    Args:
        bound: the model and its data.
        paths: what `lfm_ppl.inference.trajectories.trajectories` drew, each (C, S, ..., K, size).
        draw_index: (S,), draws of each chain.
        times: (K,), or (B, K) for each series of a panel.
        labels: dimension -> names, of "output" where they are not the model's, and of the series of a panel.
        series: dimension of the series of a panel; None for one series.

    Returns:
        Variables with dimensions chain, draw, (that of the series,) time and one more: the site's name (new
        observations, with noise); for Gaussian observations ``y_mean`` and ``y_sd`` (normal distribution of one at each
        draw; the predictive density is their mixture) and ``outputs_sd`` (its sd without the noise, zero where it is
        that given a path); ``outputs`` (noise-free), ``forces``, ``states`` and ``deterministics``.
    """
    site = bound.site
    model = site.example.ssm.model
    panel = () if series is None else (series,)
    labels = labels or {}
    outputs = list(labels.get("output", model.output_names))
    units = {new: model.units[old] for old, new in zip(model.output_names, outputs, strict=True) if old in model.units}
    units = {**model.units, **units}
    named = {"output": outputs, "state": list(model.state_names), "force": list(model.force_names),
             "deterministic": list(model.deterministic_names)}
    dimensions = ("chain", "draw", *panel, "time")

    def variable(kind: str, values: np.ndarray, description: str) -> tuple:
        return (*dimensions, kind), values, {"long_name": description, **units_attribute(named[kind], units)}

    variables = {site.name: variable("output", paths["prediction"], "new observation, with noise")}
    if "predictive_mean" in paths:  # not of an observation family, whose law is not normal
        variables |= {MEAN: variable("output", paths["predictive_mean"], "mean of the new observation at this draw"),
                      SD: variable("output", paths["predictive_sd"], "sd of the new observation at this draw"),
                      FREE_SD: variable("output", paths["output_sd"], f"sd of the {NOISE_FREE} at this draw")}
    angles = [named["output"][index] for index in model.observation.angular]
    if angles:
        variables[site.name][2].update({"angular": json.dumps(angles), "period": model.observation.period})
    words = {"output": NOISE_FREE, "state": "state", "force": "force", "deterministic": "of state and forces"}
    variables |= {f"{kind}s": variable(kind, paths[kind], word) for kind, word in words.items()
                  if paths[kind].shape[-1]}
    clock = time_coordinate(times, panel, units)
    coords = {"chain": np.arange(paths["prediction"].shape[0]), "draw": draw_index, **clock}
    coords |= {name: labels[name] for name in panel if name in labels}
    is_observed = np.isfinite(np.asarray(bound.y)).any(axis=-1)
    observed_times = np.broadcast_to(bound.times, is_observed.shape)[is_observed]
    attrs = {"observed": site.name, "last_observation": float(np.max(observed_times, initial=-np.inf))}
    return xr.Dataset(variables, {**coords, **{kind: names for kind, names in named.items() if names}}, attrs)


def held_out_data(times: np.ndarray, y: np.ndarray, observed: xr.Dataset) -> xr.Dataset:
    """Return data (T, D) that were not fitted as a group, with the names and units of those that were."""
    named = {"output": observed["output"].values, "time": ("time", times, observed["time"].attrs)}
    return xr.Dataset({"y": (("time", "output"), y, observed["y"].attrs)}, named)


def observed_variable(dataset: xr.Dataset) -> xr.DataArray:
    """Return the new observations of a dataset of predictions."""
    name = dataset.attrs.get("observed", "y")
    if name not in dataset:
        raise ValueError(f"the group {GROUP} has no variable {name!r}; it has "
                         f"{', '.join(map(str, dataset.data_vars))}. Expected what lfm.forecast made.")
    return dataset[name]


def summary(dataset: xr.Dataset) -> pd.DataFrame:
    """Return a row for each time and output: mean, sd and 95% interval of new data, and of the noise-free output.

    Args:
        dataset: the group `predictions` of one series.

    Returns:
        Indexed by time; columns output, mean, sd, q2.5, q97.5, noise_free_mean, noise_free_q2.5, noise_free_q97.5.
    """
    rows = []
    new = flat_draws(observed_variable(dataset))
    if MEAN in dataset and SD in dataset:
        mean = flat_draws(dataset[MEAN])
        spread = np.sqrt(np.mean(flat_draws(dataset[SD]) ** 2, axis=0) + mean.var(axis=0))
    else:
        mean, spread = new, new.std(axis=0)
    low, high = interval(dataset)
    below, above = noise_free_interval(dataset)
    free = mean.mean(axis=0) if MEAN in dataset else flat_draws(dataset["outputs"]).mean(axis=0)
    for k, time in enumerate(dataset["time"].values):
        for d, name in enumerate(dataset["output"].values):
            rows.append({"time": time, "output": str(name), "mean": mean[:, k, d].mean(), "sd": spread[k, d],
                         "q2.5": low[k, d], "q97.5": high[k, d], "noise_free_mean": free[k, d],
                         "noise_free_q2.5": below[k, d], "noise_free_q97.5": above[k, d]})
    return pd.DataFrame(rows).set_index("time")


def interval(dataset: xr.Dataset) -> np.ndarray:
    """Return the ends (2, K, D) of the 95% interval of new data, by their density where it is known."""
    if MEAN in dataset and SD in dataset:
        return mixture_quantiles(flat_draws(dataset[MEAN]), flat_draws(dataset[SD]), INTERVAL)
    return quantiles(flat_draws(observed_variable(dataset)), INTERVAL)


def quantiles(draws: np.ndarray, p: Any) -> np.ndarray:
    """Return quantiles (Q, ..., D) of draws (S, ..., D): whole numbers for an output whose draws are, as of counts.

    Example:
        >>> float(quantiles(np.array([0.0, 1.0, 1.0, 4.0]), 0.75)), float(quantiles(np.array([0.0, 1.5]), 0.5))
        (1.0, 0.75)
    """
    draws = np.asarray(draws)
    is_integer = np.all(draws == np.round(draws), axis=tuple(range(draws.ndim - 1)) if draws.ndim > 1 else None)
    linear = np.quantile(draws, p, axis=0)
    if not np.any(is_integer):
        return linear
    return np.where(is_integer, np.quantile(draws, p, axis=0, method="inverted_cdf"), linear)


def noise_free_interval(dataset: xr.Dataset) -> np.ndarray:
    """Return the ends (2, K, D) of the 95% interval of the noise-free outputs, by their density where it is known."""
    if MEAN in dataset and FREE_SD in dataset and bool((dataset[FREE_SD] > 0).any()):
        return mixture_quantiles(flat_draws(dataset[MEAN]), flat_draws(dataset[FREE_SD]), INTERVAL)
    return np.quantile(flat_draws(dataset["outputs"]), INTERVAL, axis=0)


def repeats_often(period: float, span: float) -> bool:
    """Return whether a figure of a force over ``span`` would show spikes instead of its periods."""
    return span > 2 * SHOWN_PERIODS * period


def flat_draws(variable: xr.DataArray) -> np.ndarray:
    """Return the draws (S, ..., K, D) of all chains, one chain after another."""
    variable = variable.transpose("chain", "draw", ..., "time", "output")
    return np.asarray(variable.values, float).reshape(-1, *variable.shape[2:])


def mixture_quantiles(mean: np.ndarray, sd: np.ndarray, p: Any, tolerance: float = 1e-9) -> np.ndarray:
    """Return quantiles (Q, ...) of the mixture of normal distributions (S, ...), by bisection.

    Args:
        mean: of the parts.
        sd: of the parts; those with zero are draws.
        p: (Q,) probabilities.
        tolerance: of a quantile, as a share of the usual spread, that of the median sd and of half of the means.
    """
    quantiles_found = []
    low, high = np.quantile(mean, (0.25, 0.75), axis=0)
    spread = np.median(sd, axis=0) + high - low
    with np.errstate(divide="ignore", invalid="ignore"):
        for probability in np.atleast_1d(np.asarray(p, float)):
            # The quantile of the mixture lies between the quantiles of its parts.
            bounds = mean + sd * special.ndtri(probability)
            low, high = bounds.min(axis=0), bounds.max(axis=0)
            limit = tolerance * np.where(spread > 0, spread, high - low)
            for _ in range(_MOST_HALVINGS):
                if not np.any(high - low > limit):
                    break
                middle = 0.5 * (low + high)
                share = np.where(sd > 0, special.ndtr((middle - mean) / sd), middle >= mean).mean(axis=0)
                low, high = np.where(share < probability, middle, low), np.where(share < probability, high, middle)
            quantiles_found.append(0.5 * (low + high))
    return np.array(quantiles_found)


_MOST_HALVINGS = 100
