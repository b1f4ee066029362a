"""A NumPyro model as a function of its unconstrained parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro import handlers
from numpyro.distributions import biject_to
from numpyro.infer import init_to_median, init_to_uniform
from numpyro.infer.util import constrain_fn, log_density, potential_energy


class UnconstrainedModel:
    """The densities of a model with its data, as functions of one unconstrained vector (d,).

    The flat order is that of ``coordinate_names``. Every method but ``draw`` can be traced.

    Args:
        model: a NumPyro model whose latent sites are continuous.
        args: its positional arguments.
        kwargs: its keyword arguments.
        key: random key for what the model draws besides its sites.
    """

    def __init__(
        self, model: Callable, args: tuple, kwargs: Mapping[str, Any], key: jax.Array
    ) -> None:
        self.key = key
        self._model, self._call = model, (args, dict(kwargs))
        self._seeded = handlers.seed(model, key)
        position = self._draw_sites(key, init_to_median)
        self.sites = tuple(position)
        _, self.unravel = ravel_pytree(position)

    def potential(self, flat: jax.Array) -> jax.Array:
        """Return minus the log density of the unconstrained parameters, Jacobian included."""
        return potential_energy(self._seeded, *self._call, self.unravel(flat))

    def constrained_potential(self, flat: jax.Array) -> jax.Array:
        """Return minus the log density of the constrained parameters, without the Jacobian."""
        values = constrain_fn(self._seeded, *self._call, self.unravel(flat))
        return -log_density(self._seeded, *self._call, values)[0]

    def constrain(self, flat: jax.Array) -> dict[str, jax.Array]:
        """Return the values of the latent and of the deterministic sites."""
        z = self.unravel(flat)
        return constrain_fn(self._seeded, *self._call, z, return_deterministic=True)

    def draw(self, key: jax.Array, strategy: Callable) -> jax.Array:
        """Return a point (d,) drawn by a NumPyro initialisation strategy."""
        return ravel_pytree(self._draw_sites(key, strategy))[0]

    def _draw_sites(self, key: jax.Array, strategy: Callable) -> dict[str, jax.Array]:
        drawn = handlers.substitute(handlers.seed(self._model, key), substitute_fn=strategy)
        args, kwargs = self._call
        trace = handlers.trace(drawn).get_trace(*args, **kwargs)
        return {
            name: biject_to(site["fn"].support).inv(site["value"])
            for name, site in trace.items()
            if site["type"] == "sample" and not site["is_observed"]
        }


def check_latent_sites(
    model: Callable, args: tuple, kwargs: Mapping[str, Any], rng_key: jax.Array, user: str
) -> None:
    """Raise ValueError unless every latent site of a model is continuous and there is at least one.

    Args:
        model: a NumPyro model.
        args: its positional arguments.
        kwargs: its keyword arguments.
        rng_key: key for the values of the latent sites.
        user: who asks, for the message.

    Raises:
        ValueError: a latent site is discrete, or no latent site is left to sample.
    """
    # init_to_uniform also serves improper priors, from which nothing can be drawn
    drawn = handlers.substitute(handlers.seed(model, rng_key), substitute_fn=init_to_uniform)
    trace = handlers.trace(drawn).get_trace(*args, **kwargs)
    latent = [s for s in trace.values() if s["type"] == "sample" and not s["is_observed"]]
    discrete = [site["name"] for site in latent if site["fn"].support.is_discrete]
    if discrete:
        raise ValueError(
            f"{user} needs continuous parameters, but the model has discrete latent sites: "
            f"{', '.join(map(repr, discrete))}. Sum over their values inside the model (for "
            "example with dist.MixtureSameFamily), or condition on them with numpyro.handlers."
        )
    if not latent:
        raise ValueError(
            f"{user} found no latent site in the model: every sample site is observed or "
            "substituted. Give at least one parameter a prior with numpyro.sample(name, "
            "distribution), without obs."
        )


def coordinate_names(position: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the name of every coordinate of the flattened unconstrained parameters.

    The flat order is that of ``jax.flatten_util.ravel_pytree``: sites sorted by name, each in C
    order. Covariances of the unconstrained parameters are laid out in it.

    Args:
        position: site name -> unconstrained value.

    Returns:
        One name for each coordinate: the site's name, with the index in brackets unless the value
        is a scalar.

    Example:
        >>> coordinate_names({"noise": 0.1, "decay": [1.0, 2.0]})
        ('decay[0]', 'decay[1]', 'noise')
    """
    names = []
    for site in sorted(position):
        for index in np.ndindex(np.shape(position[site])):
            names.append(f"{site}[{','.join(map(str, index))}]" if index else site)
    return tuple(names)
