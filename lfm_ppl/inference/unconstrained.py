"""The latent sites of a NumPyro model: which there are, and what their unconstrained coordinates are called."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def latent_sites(trace: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sites of a NumPyro trace that are sampled and not observed, by name."""
    return {name: site for name, site in trace.items() if site["type"] == "sample" and not site["is_observed"]}


def check_latent(sites: Mapping[str, Any], user: str) -> None:
    """Raise ValueError unless latent sites are continuous and there is at least one; ``user`` is for the message."""
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
