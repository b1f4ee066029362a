"""One latent force model for all regimes, in which the regime is part of the state.

Results, figures and checks read names, outputs and noise from it. Its state is that of the regimes, and an indicator of
each regime, 1 while the regime holds and 0 otherwise, so that the mean of an indicator is a probability.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.model.events import Event, Infusion
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.model.state_space import state_space
from lfm_ppl.switching.switched_model import check_structure
from lfm_ppl.utils import checks


def check_models(models: Any) -> dict[str, LatentForceModel]:
    """Return the models by name of the regime after checks.

    Raises:
        TypeError: not a mapping of names to latent force models.
        ValueError: fewer than two; the models differ in states, forces, outputs, deterministics, initial times or
            events; a force has a mean that is a function of time.
    """
    if not isinstance(models, Mapping) or not all(isinstance(model, LatentForceModel) for model in models.values()):
        raise TypeError('models must map the names of the regimes to latent force models, {"calm": model1, "abrupt": '
                        f"model2}}; got {type(models).__name__}.")
    if len(models) < 2:
        raise ValueError(f"models must hold at least two regimes, got {len(models)}; for one take "
                         "lfm.MarginalLikelihood.")
    models = {str(name): model for name, model in models.items()}
    check_structure({f"the regime {name!r}": state_space(model) for name, model in models.items()})
    initial_times = {name: model.initial_time for name, model in models.items()}
    if not checks.traced(list(initial_times.values())) and len({str(time) for time in initial_times.values()}) > 1:
        raise ValueError(f"the models of all regimes need one initial_time, got {initial_times}.")
    events: list[tuple[list[Any], Any]] = [jax.tree.flatten(model.events) for model in models.values()]
    first_leaves, first_structure = events[0]
    for leaves, structure in events[1:]:
        if structure != first_structure or not all(
                np.array_equal(a, b) for a, b in zip(leaves, first_leaves, strict=True) if not checks.traced((a, b))):
            raise ValueError("the models of all regimes need the same events, because the time grid is one for all.")
    for name, model in models.items():
        if any(callable(force.mean) for force in model.forces.values()):
            raise ValueError(f"the mean of a force of the regime {name!r} is a function of time; add it to the "
                             "dynamics.")
        if not isinstance(model.observation, GaussianObservation) or jnp.ndim(model.observation.covariance) == 3:
            raise ValueError(f"the regime {name!r} needs an lfm.GaussianObservation with one covariance for all rows, "
                             "because regimes are merged by the moments of the state.")
    return models


def joint_model(models: Mapping[str, LatentForceModel], probabilities: jax.Array) -> LatentForceModel:
    """Return the model whose state (x, indicators) has M + K entries.

    Args:
        models: by name of the regime.
        probabilities: (K,), of the regimes at the first observation.
    """
    members = list(models.values())
    first = members[0]
    size, count = len(first.state_names), len(members)

    def select(functions: Sequence[Callable[..., jax.Array]]) -> Callable[..., jax.Array]:
        """Return the function of the regime whose indicator is 1."""

        def selected(x: jax.Array, u: jax.Array, t: Any) -> jax.Array:
            values = [jnp.asarray(function(x[:size], u, t), float) for function in functions]
            return jnp.tensordot(x[size:], jnp.stack(values), 1)

        return selected

    drift = select([model.drift for model in members])
    initial = Gaussian(jnp.concatenate([first.initial_state.mean, probabilities]),
                       jnp.pad(first.initial_state.covariance, (0, count)))
    return LatentForceModel(
        dynamics=lambda x, u, t: jnp.concatenate([drift(x, u, t), jnp.zeros(count)]),
        forces=[(name, first.forces[name]) for name in first.force_names],
        observation=GaussianObservation(
            select([model.observation.function for model in members]),
            covariance=select([functools.partial(model.observation.covariance_at, row=0) for model in members]),
            angular=first.observation.angular, period=first.observation.period),
        initial_state=initial,
        process_noise=_joint_noise(members, size),
        initial_time=first.initial_time,
        state_names=(*first.state_names, *models),
        output_names=first.output_names,
        units={**first.units, **dict.fromkeys(models, "1")},
        deterministics={name: select([model.deterministics[name] for model in members])
                        for name in first.deterministic_names},
        events=[_joint_event(event, first.state_names, count) for event in first.events],
    )


def _joint_event(event: Event, state_names: Sequence[str], count: int) -> Event:
    """Return an event of the state (x, indicators), which leaves the indicators as they are.

    An infusion is part of the joint dynamics, and only its start remains.
    """
    direction = event.direction_in(state_names)
    padded = (jnp if checks.traced(direction) else np).pad(direction, (0, count))
    if isinstance(event, Infusion):
        return Event(event.event_times, 0.0, padded, 0.0, True, False)
    return Event(event.times, event.values, padded, event.lag, event.observation_first, event.is_reset)


def _joint_noise(members: Sequence[LatentForceModel], size: int) -> Callable[..., jax.Array] | None:
    """Return the dispersion (M + K, S) with the columns of all regimes, zero where the indicator is; None without."""
    if all(model.process_noise is None for model in members):
        return None

    def dispersion(x: jax.Array, u: jax.Array, t: Any) -> jax.Array:
        columns = []
        for index, model in enumerate(members):
            noise = model.process_noise
            if noise is not None:
                matrix = noise(x[:size], u, t) if callable(noise) else noise
                columns.append(x[size + index] * jnp.pad(matrix, ((0, len(members)), (0, 0))))
        return jnp.concatenate(columns, axis=1)

    return dispersion
