"""Explicit steps of a bound model that are too long for a fast decay at a point of its parameters."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.stiffness import ExplicitSteps, has_explicit_steps, long_step, long_step_message
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.map_draws import map_series
from lfm_ppl.utils.programs import Program


def long_step_messages(bound: BoundModel, z: np.ndarray, has_method: bool = True) -> list[str]:
    """Return a sentence for each likelihood site with a step that is too long, see `lfm_ppl.filtering.stiffness`.

    Args:
        bound: the model and its data.
        z: (d,), concrete.
        has_method: whether ``method`` is a remedy; not so for particles.
    """
    messages = []
    for name, site_model in bound.site_models.items():
        example = site_model.site.example
        if len(example.ssms) > 1 or not has_explicit_steps(example.ssm, example.rule, example.time_grid):
            continue
        long = long_step(_explicit_steps(site_model, z))
        if long is not None:
            message = long_step_message(long, example.ssm.model.state_names, example.steps,
                                        has_method and "method" in example.settings)
            messages.append(f"site {name!r}: {message}" if bound.is_by_site else message)
    return messages


def _explicit_steps(bound: BoundModel, z: np.ndarray) -> ExplicitSteps:
    def run(z: jax.Array, y: Any) -> Any:
        return map_series(bound.likelihood(z, y), lambda series, y: series.explicit_steps(y), bound.data(y))

    return bound.program("explicit steps", lambda: Program(run))(jnp.asarray(z, float), bound.arguments)
