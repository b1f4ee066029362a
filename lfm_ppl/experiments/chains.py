"""Markov chains over the parameters of an experiment's model, and what they say."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer import MCMC, NUTS

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.timing import timed

APART = 0.3
"""Standard deviation of the chains' starts around a mode, in the logarithm of every parameter: were they alike, R-hat
would say nothing."""


def nuts(model: Any, **settings: Any) -> NUTS:
    """Return NUTS with a dense mass matrix and forward-mode gradients, which are cheaper for up to ten parameters."""
    return NUTS(model, dense_mass=True, forward_mode_differentiation=True, **settings)


def starts(names: Sequence[str], near: Any, chains: int, key: jax.Array, sd: float = APART) -> dict[str, jax.Array]:
    """Return where the chains start, by name: unconstrained values (chains,) around the logarithms ``near`` (P,).

    NumPyro wants those of a single chain without an axis.
    """
    drawn = jnp.asarray(near) + sd * jax.random.normal(key, (chains, len(names)))
    return {name: drawn[:, index] if chains > 1 else drawn[0, index] for index, name in enumerate(names)}


def sample(mcmc: MCMC, names: Sequence[str], key: jax.Array, *data: Any, **given: Any) -> Result:
    """Run chains.

    Args:
        mcmc: the sampler of a model, whose parameters are positive.
        names: of the P parameters.
        key: JAX random key.
        *data: the model's arguments.
        **given: of `MCMC.run`, and the model's keyword arguments.

    Returns:
        ``draws`` of the logarithms (P, chains, draws) with the entries of `scores.diagnose`, ``divergences``, and CPU
        ``seconds``.
    """
    def run() -> dict[str, jax.Array]:
        mcmc.run(key, *data, **given)
        return mcmc.get_samples(group_by_chain=True)

    seconds, drawn = timed(run)
    draws = np.log(np.stack([np.asarray(drawn[name]) for name in names]))
    divergences = int(np.sum(mcmc.get_extra_fields().get("diverging", 0)))
    return {"draws": draws, "seconds": seconds, "divergences": divergences, **scores.diagnose(names, draws)}
