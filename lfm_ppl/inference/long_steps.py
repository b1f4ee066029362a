"""Explicit steps of a bound model that are too long for a fast decay at a point of its parameters."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.likelihoods.likelihood import Likelihood

EXPONENTIAL = "exponential_steps"
"""Attribute of a result, as JSON: the likelihood sites with exponential steps, because explicit ones were too long."""


def long_step_messages(bound: BoundModel, z: np.ndarray, has_method: bool = True) -> list[str]:
    """Return a sentence for each likelihood site with a step that is too long, see `lfm_ppl.filtering.stiffness`.

    Args:
        bound: the model and its data.
        z: (d,), concrete.
        has_method: whether ``method`` is a remedy; not so for particles.
    """
    messages = []
    for name, site_model in bound.site_models.items():
        if (message := site_model.long_step_message(z, has_method=has_method)) is not None:
            messages.append(f"site {name!r}: {message}" if bound.is_by_site else message)
    return messages


def stiff_sites(bound: BoundModel, z: np.ndarray) -> list[str]:
    """Return the names of likelihood sites with a step that is too long, where the model leaves steps and method open.

    Args:
        bound: the model and its data.
        z: (d,), concrete.
    """
    return [name for name, model in bound.site_models.items()
            if isinstance(bound.unbound.at_medians[name]["fn"], Likelihood)  # and no mask or expansion of one
            and "method" in model.site.example.accepted
            and not model.site.example.given & {"steps", "filter_steps", "max_step", "tolerance", "method"}
            and model.long_step_message(z) is not None]


def with_exponential_steps(bound: BoundModel, sites: Iterable[str]) -> BoundModel:
    """Return the model with exponential steps at likelihood sites of these names."""
    for name in sites:
        bound = bound.site_models[name].approximate(method="exponential").with_all_sites()
    return bound
