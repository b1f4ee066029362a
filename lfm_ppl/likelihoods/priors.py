"""Priors and supports in words, and what a model assumes beside them."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.likelihoods.handlers.pinned import Pinned

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
    distribution = _unwrapped(distribution)
    values: list[Any] = [getattr(distribution, name, None) for name in distribution.arg_constraints]
    if entries is not None:
        values = [np.asarray(value)[entries] if np.shape(value) == (size,) else value for value in values]
    return f"{type(distribution).__name__}({', '.join(_number(value) for value in values if value is not None)})"


def prior_interval(distribution: Any) -> str:
    """Return the median and the 95% interval of a prior, entry by entry, and its name in words.

    Example:
        >>> import jax.numpy as jnp, numpyro.distributions as dist
        >>> prior_interval(dist.LogNormal(0.0, 0.5).expand([3]).to_event(1))
        'median 1, 95% 0.375 to 2.66 (LogNormal)'
    """
    if isinstance(distribution, Pinned):
        words = prior(distribution)
        free = np.setdiff1d(np.arange(distribution.shape()[0]), distribution.indices)
        fixed = words[words.index("fixed: "):]
        return f"{_interval_in_words(distribution.base, free)}; {fixed}" if free.size else fixed
    return _interval_in_words(distribution)


def _interval_in_words(distribution: Any, entries: Any = ...) -> str:
    base = _unwrapped(distribution)
    if base.support.is_discrete:
        return _in_words(base)
    quantiles = _quantiles_or_draws(base)
    if quantiles is None:
        return _in_words(base)
    median, low, high = (_number(np.broadcast_to(value, distribution.shape())[entries]) for value in quantiles[:3])
    return f"median {median}, 95% {low} to {high} ({type(base).__name__})"


def central_interval(distribution: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the ends of the central 99% of a prior, entry by entry; None where it has no such interval.

    Example:
        >>> import numpyro.distributions as dist
        >>> [round(float(end), 2) for end in central_interval(dist.Normal(1.0, 1.0))]
        [-1.58, 3.58]
    """
    base = _unwrapped(distribution)
    if isinstance(distribution, Pinned) or base.support.is_discrete:
        return None
    quantiles = _quantiles_or_draws(base)
    return None if quantiles is None else (quantiles[3], quantiles[4])


def _quantiles_or_draws(base: Any) -> np.ndarray | None:
    """Return the quantiles (5, ...) of a distribution of single entries; None of an improper one."""
    try:
        return np.asarray(_quantiles(base))
    except (NotImplementedError, ImportError, AttributeError):  # no closed form: draws give two digits
        try:
            draws = base.sample(jax.random.key(0), (_DRAWS,))
        except NotImplementedError:
            return None
        return np.vectorize("{:.2g}".format)(np.quantile(draws, _INTERVAL, axis=0)).astype(float)


_INTERVAL = (0.5, 0.025, 0.975, 0.005, 0.995)
"""Probabilities of the median and of the ends of the intervals of 95% and 99%."""

_DRAWS = 20_000
"""Number of draws for the quantiles of a prior without closed form."""


@jax.jit
def _quantiles(distribution: Any) -> jax.Array:
    """Return the quantiles (5, ...); compiled, because `fit_many` describes the same priors for each data set."""
    return jax.vmap(distribution.icdf)(jnp.array(_INTERVAL))


def _unwrapped(distribution: Any) -> Any:
    """Return the distribution of single entries, without expansions, masks and reinterpreted dimensions."""
    while hasattr(distribution, "base_dist") and type(distribution).__name__ in (
            "Independent", "ExpandedDistribution", "MaskedDistribution"):
        distribution = distribution.base_dist
    return distribution


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
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.1), lfm.Gaussian(jnp.zeros(1), jnp.ones(1)))
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


def without_parameters(description: str, another: str) -> str:
    """Return a description without the numbers that depend on parameters.

    Args:
        description: of the model, see `assumptions`.
        another: the same at other values of all parameters.

    Example:
        >>> without_parameters("u: Matern (scale 1, order 2)", "u: Matern (scale 1.3, order 2)")
        'u: Matern (scale estimated, order 2)'
    """
    texts = [_NUMBER.split(text) for text in (description, another)]
    if len(texts[0]) != len(texts[1]):
        return description
    return "".join(first if first == second else "estimated" for first, second in zip(*texts, strict=True))


_NUMBER = re.compile(r"(\[[^\]]*\]|(?<![\w.])-?\d[\d.]*(?:e[+-]?\d+)?)")

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
    kind = type(observation).__name__.strip("_").removesuffix("Observation").removesuffix("Family")
    kind = "own law" if kind in ("", "Distribution") else kind
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
