"""The latent sites of a NumPyro model: which there are, and what their unconstrained coordinates are called."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from numpyro import handlers
from numpyro.infer import init_to_uniform


def latent_sites(trace: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sites of a NumPyro trace that are sampled and not observed, by name."""
    return {name: site for name, site in trace.items() if site["type"] == "sample" and not site["is_observed"]}


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
    seeded_model = handlers.substitute(handlers.seed(model, rng_key), substitute_fn=init_to_uniform)
    check_latent(latent_sites(handlers.trace(seeded_model).get_trace(*args, **kwargs)), user)


def check_latent(sites: Mapping[str, Any], user: str) -> None:
    """Raise ValueError unless latent sites are continuous and there is at least one; see `check_latent_sites`."""
    discrete = [name for name, site in sites.items() if site["fn"].support.is_discrete]
    if discrete:
        raise ValueError(
            f"{user} needs continuous parameters, but the model has discrete latent sites: "
            f"{', '.join(map(repr, discrete))}. Sum over their values inside the model (for "
            "example with dist.MixtureSameFamily), or condition on them with numpyro.handlers."
        )
    if not sites:
        raise ValueError(
            f"{user} found no latent site in the model, so there are no parameters to sample: every sample site is "
            "observed or substituted. Give at least one parameter a prior with numpyro.sample(name, distribution), "
            "without obs. For the forces of a model whose parameters are known use lfm.smooth."
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
