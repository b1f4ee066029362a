"""The group ``predictions`` of a result: new observations, with their noise, at times that were asked for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.marginal_likelihood import Panel
from lfm_ppl.results import arviz_data
from lfm_ppl.results.scalars import units_attribute

GROUP = "predictions"

NOISE_FREE = "noise-free output"
"""What is said of ``outputs`` wherever they are stored."""

MEAN, SD = "y_mean", "y_sd"
"""Moments of the normal distribution that y has at each draw."""


def predictions(bound: BoundModel, paths: Mapping[str, np.ndarray], chosen: np.ndarray, times: np.ndarray) -> xr.Dataset:
    """Lay out new observations, and the paths that they were drawn along.

    Args:
        bound: the model and its data.
        paths: what `lfm_ppl.inference.posterior.trajectories` drew, each (C, S, ..., K, size).
        chosen: (S,) which draws of each chain.
        times: (K,).

    Returns:
        Variables with dimensions chain, draw, (series,) time and one more: the site's name (new observations, with
        noise), ``y_mean`` and ``y_sd`` (normal distribution of one at each draw; the predictive density is their
        mixture), ``outputs`` (noise-free), ``forces`` and ``states``.
    """
    site = bound.site
    model = site.example.ssm.model
    panel = ("series",) if isinstance(site.distribution, Panel) else ()
    named = {"output": list(model.output_names), "state": list(model.state_names), "force": list(model.force_names)}
    place = ("chain", "draw", *panel, "time")

    def variable(kind: str, values: np.ndarray, what: str) -> tuple:
        return (*place, kind), values, {"long_name": what, **units_attribute(named[kind], model.units)}

    variables = {site.name: variable("output", paths["prediction"], "new observation, with noise"),
                 MEAN: variable("output", paths["predictive_mean"], "mean of the new observation at this draw"),
                 SD: variable("output", paths["predictive_sd"], "sd of the new observation at this draw")}
    angles = [named["output"][index] for index in model.observation.angular]
    variables[site.name][2].update({"angular": json.dumps(angles)} if angles else {})
    words = {"output": NOISE_FREE, "state": "state", "force": "force"}
    variables |= {f"{kind}s": variable(kind, paths[kind], word) for kind, word in words.items()
                  if paths[kind].shape[-1]}
    clock = {"time": ("time", times, units_attribute(["time"], model.units))}
    coords = {"chain": np.arange(paths["prediction"].shape[0]), "draw": chosen, **clock}
    attrs = {"observed": site.name, "last_observation": float(last_observation(bound.times, np.asarray(bound.y)))}
    return xr.Dataset(variables, {**coords, **{kind: names for kind, names in named.items() if names}}, attrs)


def last_observation(times: np.ndarray, y: np.ndarray) -> float:
    """Return the time of the last observation that is not missing."""
    seen = np.isfinite(y).any(axis=-1)
    return float(np.max(np.broadcast_to(times, seen.shape)[seen], initial=-np.inf))


def observed_variable(dataset: xr.Dataset) -> xr.DataArray:
    """Return the new observations of a dataset of predictions."""
    name = dataset.attrs.get("observed", "y")
    if name not in dataset:
        raise ValueError(f"the group {GROUP} has no variable {name!r}; it has {', '.join(map(str, dataset.data_vars))}. "
                         "Expected what lfm.forecast made.")
    return dataset[name]


def of_result(result: Any) -> xr.Dataset:
    """Return the predictions of a result, or the dataset itself where it is one.

    Raises:
        ValueError: the result has none; the message says how to get them.
    """
    return result if isinstance(result, xr.Dataset) else arviz_data.group(result, GROUP)
