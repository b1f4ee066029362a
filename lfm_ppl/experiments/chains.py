"""Markov chains over the parameters of an experiment's model, and what they say."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from numpyro.infer import MCMC, NUTS

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.datasets import cell, number
from lfm_ppl.experiments.timing import timed
from lfm_ppl.inference.kernels.ram import RAM

LENGTHS = ("chains", "warmup", "draws", "thin")
"""Settings of a task: how many chains, and how long they are; see `sampler`."""

APART = 0.3
"""Standard deviation of the chains' starts around a mode, in the logarithm of every parameter: were they alike, R-hat
would say nothing."""


def nuts(model: Any, **settings: Any) -> NUTS:
    """Return NUTS with a dense mass matrix and forward-mode gradients, which are cheaper for up to ten parameters."""
    return NUTS(model, dense_mass=True, forward_mode_differentiation=True, **settings)


def sampler(kernel: Any, chains: int, warmup: int, draws: int, thin: int = 1, **settings: Any) -> MCMC:
    """Return the sampler of a kernel: RAM's chains side by side, those of others one after another.

    ``thin`` steps make one draw, in the warm-up, too; further ``settings`` are of `MCMC`.
    """
    return MCMC(kernel, num_warmup=warmup * thin, num_samples=draws * thin, thinning=thin, num_chains=chains,
                chain_method="vectorized" if isinstance(kernel, RAM) else "sequential", progress_bar=False, **settings)


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


def compared(found: xr.Dataset, reference: xr.Dataset | None) -> dict[str, Any]:
    """Return how well a sampler's posteriors agree with those of a reference, as a row of a table.

    Args:
        found: ``mean`` and ``sd`` (dataset, parameter), ``seconds`` (dataset); of chains ``draws``, ``divergences``,
            ``ess`` and ``r_hat`` (dataset, parameter), of weighted draws ``ess`` and the Pareto index ``k`` (dataset).
        reference: the same of another sampler; None: ``found`` is the reference.

    Returns:
        See `agreement`, and the smallest effective sample size, CPU seconds, and the largest R-hat or Pareto index.
    """
    row: dict[str, Any] = {}
    if reference is not None:
        for name, one in zip(("shift", "sd ratio"), agreement(found, reference), strict=True):
            row |= cell(name, one)
    row |= {"least ESS": least_ess(found), **cell("CPU s", found.seconds)}
    if "k" in found:
        return row | {"k": number(np.max, found.k)}
    return row | {"R-hat": largest_r_hat(found), "divergences": number(np.mean, found.divergences)}


def agreement(found: xr.Dataset, reference: xr.Dataset) -> tuple[scores.Estimate, scores.Estimate]:
    """Return how far posteriors are from those of a reference, data set by data set.

    Returns:
        The largest distance of a posterior mean from the reference's in its standard deviations, and the ratio of
        standard deviations furthest from one, over parameters and data sets, with their Monte Carlo errors, to be held
        against them as the largest of many.
    """
    both = found, reference
    mean, sd, ess = ([_by_parameter(one, name) for one in both] for name in ("mean", "sd", "ess"))
    errors = [_relative_errors_of_sd(one) for one in both]
    shift, ratio = (mean[0] - mean[1]) / sd[1], sd[0] / sd[1]
    worst = np.unravel_index(np.abs(shift).argmax(), shift.shape)
    with np.errstate(divide="ignore"):
        widest = np.unravel_index(np.abs(np.log(ratio)).argmax(), ratio.shape)
    return (scores.Estimate(float(abs(shift[worst])), float(np.sqrt(1 / ess[0] + 1 / ess[1])[worst])),
            scores.Estimate(float(ratio[widest]), float((ratio * np.hypot(*errors))[widest])))


def _by_parameter(found: xr.Dataset, name: str) -> np.ndarray:
    """Return a variable (N, P), also where there is one value for all parameters."""
    return found[name].broadcast_like(found["mean"]).transpose("dataset", "parameter").values


def _relative_errors_of_sd(found: xr.Dataset) -> np.ndarray:
    """Return Monte Carlo errors (N, P) of standard deviations; of weighted draws those of a normal distribution."""
    if "draws" not in found:
        return np.sqrt(0.5 / _by_parameter(found, "ess"))
    # Where samplers draw a different number, the shorter ones are filled up.
    every = found.draws.transpose("dataset", "parameter", "chain", "draw")
    return np.stack([scores.relative_errors_of_sd(one.dropna("chain", how="all").dropna("draw", how="all").values)
                     for one in every])


def least_ess(found: xr.Dataset) -> float:
    """Return the smallest effective sample size; a chain that does not move has none, and must not look otherwise."""
    return float(np.nan_to_num(found.ess).min())


def largest_r_hat(found: xr.Dataset) -> float:
    """Return the largest R-hat; infinite where a chain does not move."""
    return float(np.nan_to_num(found.r_hat, nan=np.inf).max())
