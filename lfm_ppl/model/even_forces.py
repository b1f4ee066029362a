"""Forces that a Gaussian filter cannot see, because the model is an even function of them.

Where dynamics and observation depend on ``u**2`` and the mean of u is zero, u and -u are equally likely. Data are then
uncorrelated with u, so that no linearisation, with any rule and any number of iterations, learns anything of u.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.forces.sde import Stack
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.utils import checks

_ROUNDING = 1e-9
"""Largest ratio of odd to even parts that is rounding."""


def even_forces(model: LatentForceModel, times: Any) -> list[str]:
    """Return the names of forces of which dynamics and observation are even functions, about the prior mean.

    They are compared at one standard deviation above and below the mean of a force, at the initial mean of the state
    and of the other forces. A function that does not depend on the force there is not called even.

    Args:
        model: the latent force model.
        times: (T,).

    Returns:
        The list is empty if a value is traced, or not finite.
    """
    if not model.force_list or checks.traced((model, times)):
        return []
    start = np.asarray(times, float).flat[0] if model.initial_time is None else model.initial_time
    stack, state = Stack(model.force_list), jnp.asarray(model.initial_state.mean, float)
    mean, measurement = stack.mean_at(start), stack.measurement(start)
    sds = jnp.sqrt(jnp.diagonal(measurement @ stack.initial_covariance() @ measurement.T))

    def values(forces: Any) -> jax.Array:
        return jnp.concatenate([jnp.ravel(model.drift(state, forces, start)),
                                jnp.ravel(model.observation.function(state, forces, start))])

    centre = values(mean)
    if checks.traced(centre):  # in compiled code, or by a variable that a function reads
        return []
    rounding, names = _ROUNDING * float(jnp.abs(centre).max(initial=0.0)), []
    for index, name in enumerate(model.force_names):
        above, below = (values(mean.at[index].add(sign * sds[index])) for sign in (1.0, -1.0))
        size = float(jnp.abs(above + below - 2.0 * centre).max(initial=0.0))
        # Rounding of the centre is no dependence.
        if size > rounding and float(jnp.abs(above - below).max(initial=0.0)) <= _ROUNDING * size:
            names.append(name)
    return names


def even_force_message(name: str) -> str:
    """Return the text of the warning."""
    return (f"the model is an even function of the force {name!r} about its mean, such as its square: for a Gaussian "
            "filter, data then say nothing of the force, and the log likelihood may be far off. Use a function that "
            "distinguishes both signs, such as softplus or exp, or give the force a mean (mean=...).")
