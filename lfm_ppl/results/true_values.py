"""The truth of simulated data, checked and laid out as a group of a result."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from lfm_ppl.io.truth import TRUTH, check_truth
from lfm_ppl.model.observation_noise import expected_observation
from lfm_ppl.results.labels import OUTPUT, Labels
from lfm_ppl.results.scalars import units_attribute
from lfm_ppl.utils import checks

if TYPE_CHECKING:
    from lfm_ppl.inference.bound_model import BoundModel


def true_functions(bound: BoundModel, truth: Mapping[str, Any],
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


def truth_dataset(truth: Mapping[str, Any], named: dict, units: Mapping[str, str],
                  posterior: xr.Dataset) -> xr.Dataset:
    """Return the group ``truth``, with the dimensions and units of the posterior."""
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
        # A parameter along the rows of the data has another time than the true path.
        if value.shape == posterior[label].shape[2:] and "time" not in dims:
            variables[label] = (dims, value)
            coords |= {name: posterior[name].values for name in dims}
        else:
            variables[label] = ([f"{label}_true_{axis}" for axis in range(value.ndim)], value)
    return xr.Dataset(variables, coords)
