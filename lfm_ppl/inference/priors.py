"""Priors and supports in words, and what a model assumes beside them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lfm_ppl.inference.handlers.pinned import Pinned

if TYPE_CHECKING:
    from lfm_ppl.model.latent_force_model import LatentForceModel

_MOST_NUMBERS = 4
"""Numbers of a vector that are printed."""


def prior(distribution: Any) -> str:
    """Return a distribution in words: its name and its arguments.

    Example:
        >>> import jax.numpy as jnp, numpyro.distributions as dist
        >>> prior(dist.LogNormal(0.0, 0.5).expand([3]).to_event(1))
        'LogNormal(0, 0.5)'

        Of a vector with fixed entries, the prior of the free ones, and the values of the others:

        >>> prior(Pinned(dist.LogNormal(jnp.array([0.0, 1.0, 1.0]), 0.5), (0,), jnp.array([0.8]), ("CDKN1A",)))
        'LogNormal(1, 0.5); fixed: CDKN1A = 0.8'
    """
    if isinstance(distribution, Pinned):
        size = distribution.shape()[0]
        free = np.setdiff1d(np.arange(size), distribution.indices)
        fixed = ", ".join(f"{label} = {_number(value)}" for label, value in zip(
            distribution.labels, np.asarray(distribution.values), strict=True))
        return f"{_in_words(distribution.base, size, free)}; fixed: {fixed}" if free.size else f"fixed: {fixed}"
    return _in_words(distribution)


def _in_words(distribution: Any, size: int | None = None, entries: np.ndarray | None = None) -> str:
    """Return name and arguments of a distribution; of a long vector the arguments of some entries."""
    while hasattr(distribution, "base_dist") and type(distribution).__name__ in (
            "Independent", "ExpandedDistribution", "MaskedDistribution"):
        distribution = distribution.base_dist
    values: list[Any] = [getattr(distribution, name, None) for name in distribution.arg_constraints]
    if entries is not None:
        values = [np.asarray(value)[entries] if np.shape(value) == (size,) else value for value in values]
    return f"{type(distribution).__name__}({', '.join(_number(value) for value in values if value is not None)})"


def support(constraint: Any) -> str:
    """Return a support in words.

    Example:
        >>> import numpyro.distributions as dist
        >>> support(dist.HalfNormal(1.0).support), support(dist.Uniform(2.0, 3.0).support)
        ('> 0', '2 to 3')
    """
    while hasattr(constraint, "base_constraint"):
        constraint = constraint.base_constraint
    low, high = (getattr(constraint, name, None) for name in ("lower_bound", "upper_bound"))
    if low is not None and high is not None:
        return f"{_number(low)} to {_number(high)}"
    if low is not None:
        return f"> {_number(low)}"
    if high is not None:
        return f"< {_number(high)}"
    return type(constraint).__name__.strip("_").lower()


def assumptions(model: LatentForceModel) -> dict[str, str]:
    """Describe the observations, forces and initial state of a model in words, with their numbers.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> noisy = lfm.LatentForceModel(lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 2.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])), lfm.Gaussian(jnp.zeros(1), jnp.ones(1)))
        >>> for topic, description in assumptions(noisy).items():
        ...     print(f"{topic} | {description}")
        observation | y0: Gaussian (sd 0.1)
        forces | u: Matern (scale 1, lengthscale 2, order 1)
        initial state | x0 = 0 (sd 1)
    """
    forces = [f"{name}: {_with_numbers(type(force).__name__, force, _FORCE_ATTRIBUTES)}"
              for name, force in model.forces.items()]
    mean, sd = np.asarray(model.initial_state.mean), _sd(model.initial_state.covariance)
    states = [f"{name} = {_number(value)} ({'known' if spread == 0 else f'sd {_number(spread)}'})"
              for name, value, spread in zip(model.state_names, mean, sd, strict=True)]
    return {"observation": "; ".join(_observation(model.observation, model.output_names)),
            "forces": "; ".join(forces) or "none", "initial state": "; ".join(states) or "none"}


_FORCE_ATTRIBUTES = ("scale", "lengthscale", "period", "order")
"""Attributes in the description of a force, where it has them."""


def _observation(observation: Any, names: tuple[str, ...]) -> list[str]:
    """Describe the distribution of each output in words."""
    if hasattr(observation, "parts"):
        descriptions, first = [], 0
        for part, size in zip(observation.parts, observation.sizes, strict=True):
            descriptions += _observation(part, names[first:first + size])
            first += size
        return descriptions
    kind = type(observation).__name__.strip("_").removesuffix("Observation").removesuffix("Family") or "own law"
    covariance = getattr(observation, "covariance", None)
    if callable(covariance):
        return [f"{name}: {kind} (sd a function of the state)" for name in names]
    if covariance is not None:
        if np.ndim(covariance) == 3:
            return [f"{name}: {kind} (a covariance for each row)" for name in names]
        return [f"{name}: {kind} (sd {_number(sd)})" for name, sd in zip(names, _sd(covariance), strict=True)]
    return [f"{', '.join(names)}: {_with_numbers(kind, observation, (*observation.per_entry, 'link'))}"]


def _with_numbers(kind: str, part: Any, fields: tuple[str, ...]) -> str:
    values = [(name, getattr(part, name, None)) for name in fields]
    numbers = ", ".join(f"{name} {value if isinstance(value, str) else _number(value)}" for name, value in values
                        if value is not None and not callable(value))
    return f"{kind} ({numbers})" if numbers else kind


def _sd(covariance: Any) -> np.ndarray:
    covariance = np.asarray(covariance)
    return np.sqrt(covariance if covariance.ndim == 1 else np.diagonal(covariance))


def _number(value: Any) -> str:
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        return type(value).__name__
    flat = array.ravel()
    if flat.size and np.all(flat == flat[0]):
        return f"{flat[0]:.3g}"
    numbers = ", ".join(f"{number:.3g}" for number in flat[:_MOST_NUMBERS])
    return f"[{numbers}{', ...' if flat.size > _MOST_NUMBERS else ''}]"
