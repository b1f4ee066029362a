"""The options of a sampler, checked before anything is computed."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

from numpyro.infer import NUTS

from lfm_ppl.inference.kernels.particle_marginal import ParticleMarginalRAM
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.utils import checks

KERNELS: dict[str, Any] = {"nuts": NUTS, "ram": RAM, "pmmh": ParticleMarginalRAM}
"""Sampler of `lfm_ppl.fit` -> kernel that takes ``sampler_options`` as arguments; "map" has none."""

_ARGUMENTS_OF_FIT = {
    "model": "the model is the first argument of fit",
    "potential_fn": "the model is the first argument of fit",
    "init_strategy": "pass it as init",
    "num_warmup": "pass it as warmup", "num_samples": "pass it as samples", "num_chains": "pass it as chains",
    "thinning": "pass it as thin", "chain_method": "it is an argument of fit", "progress_bar": "pass it as progress",
}


def check_options(sampler: str, options: Mapping[str, Any] | None) -> None:
    """Check that a sampler's kernel takes the options.

    Args:
        sampler: a name of `lfm_ppl.inference.samplers.SAMPLERS`.
        options: of the kernel; None for none.

    Raises:
        ValueError: an option that it does not know, with the nearest ones; one that is an argument of `lfm_ppl.fit`.
        TypeError: options that are no mapping.
    """
    if options is None:
        return
    if not isinstance(options, Mapping):
        raise TypeError('sampler_options must map names to values, for example {"target_accept_prob": 0.95}, got '
                        f"{options!r}.")
    if options and sampler not in KERNELS:
        raise ValueError(f"sampler_options are for the samplers {', '.join(KERNELS)}; {sampler!r} takes none, got "
                         f"{', '.join(map(repr, options))}.")
    for name in options:
        if name in _ARGUMENTS_OF_FIT:
            raise ValueError(f"sampler_options cannot hold {name!r}: {_ARGUMENTS_OF_FIT[name]}.")
        parameters = inspect.signature(KERNELS[sampler]).parameters
        accepted = [option for option in parameters if option not in _ARGUMENTS_OF_FIT]
        checks.one_of(f"option of the sampler {sampler!r} in sampler_options:", name, accepted)
