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


def agreement(found: Sequence[Result], reference: Sequence[Result]) -> tuple[scores.Estimate, scores.Estimate]:
    """Return how far posteriors are from those of a reference, data set by data set.

    Returns:
        The largest distance of a posterior mean from the reference's in its standard deviations, and the ratio of
        standard deviations furthest from one, over parameters and data sets, with their Monte Carlo errors, to be held
        against them as the largest of many.
    """
    pairs = list(zip(found, reference, strict=True))
    shift = np.stack([(one["mean"] - exact["mean"]) / exact["sd"] for one, exact in pairs])
    ratio = np.stack([one["sd"] / exact["sd"] for one, exact in pairs])
    error = np.stack([np.sqrt(1 / one["ess"] + 1 / exact["ess"]) for one, exact in pairs])
    spread = ratio * np.stack([np.hypot(*map(_relative_error_of_sd, both)) for both in pairs])
    worst = np.unravel_index(np.abs(shift).argmax(), shift.shape)
    with np.errstate(divide="ignore"):
        widest = np.unravel_index(np.abs(np.log(ratio)).argmax(), ratio.shape)
    return (scores.Estimate(float(abs(shift[worst])), float(error[worst])),
            scores.Estimate(float(ratio[widest]), float(spread[widest])))


def _relative_error_of_sd(found: Result) -> np.ndarray:
    """Return Monte Carlo errors of standard deviations; of weighted draws those of a normal distribution."""
    return scores.relative_errors_of_sd(found["draws"]) if "draws" in found else np.sqrt(0.5 / found["ess"])


def least_ess(one: Result) -> float:
    """Return the smallest effective sample size; a chain that does not move has none, and must not look otherwise."""
    return float(np.nan_to_num(one["ess"]).min())


def largest_r_hat(one: Result) -> float:
    """Return the largest R-hat; infinite where a chain does not move."""
    return float(np.nan_to_num(one["r_hat"], nan=np.inf).max())
