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

    They are compared at one standard deviation above and below the mean of a force, at the first, a middle and the last
    time, and at three states about the initial mean: a force that a product with the state shows is not even.

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
    measurement = stack.measurement(start)
    sds = jnp.sqrt(jnp.diagonal(measurement @ stack.initial_covariance() @ measurement.T))
    size = jnp.sqrt(jnp.diagonal(jnp.asarray(model.initial_state.covariance, float))) + jnp.abs(state) + 1.0
    pattern = jnp.where(np.arange(len(size)) % 2, -0.7, 1.0)
    observed = np.sort(np.ravel(np.asarray(times, float)))
    points = [(state + share * size * pattern, stack.mean_at(t), t) for share, t in zip(
        (0.0, 0.3, -0.2), (start, observed[len(observed) // 2], observed[-1]), strict=True)]

    def values(state: jax.Array, forces: jax.Array, t: Any) -> jax.Array:
        return jnp.concatenate([jnp.ravel(model.drift(state, forces, t)),
                                jnp.ravel(model.observation.function(state, forces, t))])

    # Traced once, so that functions see here what they see in a filter: their own checks of numbers do not run.
    closed = jax.make_jaxpr(values)(*points[0])

    def evaluate(*point: Any) -> jax.Array:
        return jax.core.eval_jaxpr(closed.jaxpr, closed.consts, *point)[0]

    centres = [evaluate(*point) for point in points]
    if checks.traced(centres):  # in compiled code, or by a variable that a function reads
        return []

    def sizes_of_parts(index: int) -> np.ndarray:
        """Return the sizes (3, 3) of the even part, of the odd part and of the value, at each point."""
        sizes = []
        for (state, forces, t), centre in zip(points, centres, strict=True):
            above, below = (evaluate(state, forces.at[index].add(sign * sds[index]), t) for sign in (1.0, -1.0))
            sizes.append([float(jnp.abs(part).max(initial=0.0))
                          for part in (above + below - 2.0 * centre, above - below, centre)])
        return np.array(sizes)

    def is_even(index: int) -> bool:
        sizes = sizes_of_parts(index)
        even, odd, value = sizes.max(axis=0)
        # Rounding of the value is no dependence.
        return bool(np.isfinite(sizes).all() and even > _ROUNDING * value and odd <= _ROUNDING * even)

    return [name for index, name in enumerate(model.force_names) if is_even(index)]


def even_force_message(name: str) -> str:
    """Return the text of the warning."""
    return (f"the model is an even function of the force {name!r} about its mean, such as its square: for a Gaussian "
            "filter, data then say nothing of the force, and the log likelihood may be far off. Use a function that "
            "distinguishes both signs, such as softplus or exp, or give the force a mean (mean=...).")
