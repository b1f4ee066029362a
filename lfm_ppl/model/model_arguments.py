"""Checks of the arguments of a latent force model before anything is traced: types, names, events and shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from lfm_ppl.forces.sde import Force
from lfm_ppl.model.events import Event
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.utils import checks


def checked_functions(deterministics: Mapping[str, Callable] | None, used_names: set[str]) -> dict[str, Callable]:
    """Return the deterministics after checks of their types and names."""
    deterministics = {} if deterministics is None else deterministics
    if not isinstance(deterministics, Mapping):
        raise TypeError("deterministics must be a mapping, name -> function (x, u, t), got "
                        f"{type(deterministics).__name__}.")
    for name, function in deterministics.items():
        if not callable(function):
            raise TypeError(f"the deterministic {name!r} must be a function (x, u, t), got {type(function).__name__}.")
        if name in used_names:
            raise ValueError(f"the name {name!r} of a deterministic is used for a state or a force; rename one.")
    return {str(name): function for name, function in deterministics.items()}


def check_types(dynamics: Any, observation: Any, initial_state: Any) -> None:
    """Raise TypeError for dynamics, an observation or an initial state of the wrong type."""
    if not callable(dynamics):
        raise TypeError(f"dynamics must be callable as f(x, u, t), got {type(dynamics).__name__}.")
    if not isinstance(observation, (GaussianObservation, ObservationFamily)):
        raise TypeError("observation must be an lfm.GaussianObservation, or a family such as lfm.PoissonObservation, "
                        f"got {type(observation).__name__}. Wrap the function: "
                        "lfm.GaussianObservation(lambda x, u, t: x, sd=0.1).")
    if not isinstance(initial_state, Gaussian):
        raise TypeError(f"initial_state must be an lfm.Gaussian, got {type(initial_state).__name__}.")


def describe_shape(result: Any) -> str:
    """Return a description of the result of a function that should have returned a vector."""
    if hasattr(result, "shape"):
        return f"{'an array' if result.shape else 'a number'} of shape {result.shape}"
    if isinstance(result, (list, tuple)):
        return f"a {type(result).__name__} of {len(result)}, which is not an array"
    return "None, as a function without `return` does" if result is None else type(result).__name__


def forces_by_name(forces: Any) -> tuple[tuple[str, ...], dict[str, Force]]:
    """Return the names of the forces and the forces by name, after checks of both."""
    if isinstance(forces, Force) or not isinstance(forces, Iterable):
        raise TypeError('forces must map names to forces, for example {"p53": lfm.Matern(1.0, 2.0)}, or {} for none; '
                        f"got {type(forces).__name__}.")
    items = list(forces.items()) if isinstance(forces, Mapping) else list(forces)
    for item in items:
        if not (isinstance(item, tuple) and len(item) == 2 and isinstance(item[0], str)):
            raise TypeError('forces must map names to forces, for example {"p53": lfm.Matern(1.0, 2.0)}; '
                            f"got {item!r}.")
        if not isinstance(item[1], Force):
            raise TypeError(f"the force {item[0]!r} must be a force such as lfm.Matern, got {type(item[1]).__name__}.")
    names = tuple(name for name, _ in items)
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"the force name {name!r} repeats; every force needs a different name.")
    return names, dict(items)


def checked_names(argument: str, names: Sequence[str] | None, size: int, prefix: str) -> tuple[str, ...]:
    """Return ``size`` names after a check of their number; None: ``prefix`` with numbers."""
    if names is None:
        return tuple(f"{prefix}{index}" for index in range(size))
    if isinstance(names, str) or len(names) != size:
        names = (names,) if isinstance(names, str) else tuple(names)
        source = {"output_names": "the observation returns", "state_names": "initial_state.mean has"}.get(argument)
        reason = f": {source} {size} {'entry' if size == 1 else 'entries'}" if source else ""
        raise ValueError(f"{argument} must hold {size} {'name' if size == 1 else 'names'}{reason}. It holds "
                         f"{', '.join(map(repr, names)) or 'none'}.")
    if len(set(names)) != size:
        raise ValueError(f"{argument} must not repeat, got {tuple(names)}.")
    return tuple(str(name) for name in names)


def checked_events(events: Sequence[Event], state_names: Sequence[str]) -> tuple[Event, ...]:
    """Return the events after checks of their types and the states that they change."""
    events = (events,) if isinstance(events, Event) else tuple(events)
    for event in events:
        if not isinstance(event, Event):
            raise TypeError("events must contain lfm.Dose, lfm.Infusion and lfm.Reset, got "
                            f"{type(event).__name__}.")
        event.check_target(state_names)
    return events


def checked_dispersion(value: Any, size: int) -> jax.Array | None:
    """Return a constant dispersion matrix (M, S) after a check of its shape; None without process noise."""
    if value is None:
        return None
    checks.finite("process_noise", value)
    value = jnp.asarray(value, float)
    if value.ndim != 2 or value.shape[0] != size:
        raise ValueError(f"process_noise must be a dispersion matrix ({size}, S), one row for each state, got shape "
                         f"{value.shape}. For independent noises use jnp.diag(standard_deviations).")
    return value
