"""Markov chains for the parameters of a study's model, their diagnostics, and their agreement with a reference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from numpyro.infer import MCMC, NUTS

import lfm_ppl as lfm
from lfm_ppl.parallel.task import Result

from . import scores
from .datasets import cell, number
from .timing import time_call

LENGTHS = ("chains", "warmup", "draws", "thin")
"""Task settings with the number and the length of chains; arguments of `sampler`."""

START_SD = 0.3
"""Standard deviation of the chains' starts about a mode, in the logarithm of each parameter. R-hat detects chains that
have not converged only if they start at different points."""


def nuts(model: Any, **settings: Any) -> NUTS:
    """Return NUTS with a dense mass matrix and forward-mode gradients, which are cheaper for a few parameters."""
    return NUTS(model, dense_mass=True, forward_mode_differentiation=True, **settings)


def sampler(kernel: Any, chains: int, warmup: int, draws: int, thin: int = 1, **settings: Any) -> MCMC:
    """Return the MCMC driver of a kernel; chains of RAM run in parallel, chains of other kernels in sequence.

    Each draw takes ``thin`` steps, in the warm-up as well; further ``settings`` as in `MCMC`.
    """
    return MCMC(kernel, num_warmup=warmup * thin, num_samples=draws * thin, thinning=thin, num_chains=chains,
                chain_method="vectorized" if isinstance(kernel, lfm.RAM) else "sequential", progress_bar=False,
                **settings)


def draw_starts(names: Sequence[str], centre: Any, chains: int, key: jax.Array,
                sd: float = START_SD) -> dict[str, jax.Array]:
    """Return random starts of chains: name -> unconstrained values (chains,) about the logarithms ``centre`` (P,).

    The values of a single chain are scalars, as NumPyro requires.
    """
    starts = jnp.asarray(centre) + sd * jax.random.normal(key, (chains, len(names)))
    return {name: starts[:, index] if chains > 1 else starts[0, index] for index, name in enumerate(names)}


def sample(mcmc: MCMC, names: Sequence[str], key: jax.Array, *data: Any, **keywords: Any) -> Result:
    """Run chains and return their draws and diagnostics.

    Args:
        mcmc: MCMC driver of a model with positive parameters.
        names: names of the P parameters.
        key: JAX random key.
        *data: arguments of the model.
        **keywords: keyword arguments of `MCMC.run` and of the model.

    Returns:
        ``draws`` (P, chains, draws) of the logarithms, the entries of `scores.diagnose`, ``divergences``, and CPU
        ``seconds``.
    """
    def run() -> dict[str, jax.Array]:
        mcmc.run(key, *data, **keywords)
        return mcmc.get_samples(group_by_chain=True)

    seconds, samples = time_call(run)
    draws = np.log(np.stack([np.asarray(samples[name]) for name in names]))
    divergences = int(np.sum(mcmc.get_extra_fields().get("diverging", 0)))
    return {"draws": draws, "seconds": seconds, "divergences": divergences, **scores.diagnose(names, draws)}


def compare_with_reference(posteriors: xr.Dataset, reference: xr.Dataset | None) -> dict[str, Any]:
    """Return a table row with the agreement of a sampler's posteriors with a reference, and their diagnostics.

    Args:
        posteriors: ``mean`` and ``sd`` (dataset, parameter), ``seconds`` (dataset); for chains ``draws``,
            ``divergences``, ``ess`` and ``r_hat`` (dataset, parameter); for importance samples ``ess`` and the Pareto
            index ``k`` (dataset).
        reference: the same entries for the reference sampler; None if ``posteriors`` is the reference.

    Returns:
        The shift and the ratio of standard deviations (see `agreement`), the smallest effective sample size, CPU
        seconds, and the largest R-hat or Pareto index.
    """
    row: dict[str, Any] = {}
    if reference is not None:
        for name, estimate in zip(("shift", "sd ratio"), agreement(posteriors, reference), strict=True):
            row |= cell(name, estimate)
    row |= {"least ESS": least_ess(posteriors), **cell("CPU s", posteriors.seconds)}
    if "k" in posteriors:
        return row | {"k": number(np.max, posteriors.k)}
    return row | {"R-hat": largest_r_hat(posteriors), "divergences": number(np.mean, posteriors.divergences)}


def agreement(posteriors: xr.Dataset, reference: xr.Dataset) -> tuple[scores.Estimate, scores.Estimate]:
    """Return the largest differences between posteriors and their references, over parameters and data sets.

    Returns:
        The largest difference of posterior means, in standard deviations of the reference, and the ratio of standard
        deviations with the largest absolute logarithm. Each has the Monte Carlo error of a single comparison; the
        maximum of many comparisons exceeds it even if the posteriors agree.
    """
    pair = posteriors, reference
    mean, sd, ess = ([_by_parameter(dataset, name) for dataset in pair] for name in ("mean", "sd", "ess"))
    errors = [_relative_errors_of_sd(dataset) for dataset in pair]
    shift, ratio = (mean[0] - mean[1]) / sd[1], sd[0] / sd[1]
    largest_shift = np.unravel_index(np.abs(shift).argmax(), shift.shape)
    with np.errstate(divide="ignore"):
        largest_ratio = np.unravel_index(np.abs(np.log(ratio)).argmax(), ratio.shape)
    return (scores.Estimate(float(abs(shift[largest_shift])), float(np.sqrt(1 / ess[0] + 1 / ess[1])[largest_shift])),
            scores.Estimate(float(ratio[largest_ratio]), float((ratio * np.hypot(*errors))[largest_ratio])))


def _by_parameter(posteriors: xr.Dataset, name: str) -> np.ndarray:
    """Return a variable as an array (N, P), with values repeated where all parameters share one."""
    return posteriors[name].broadcast_like(posteriors["mean"]).transpose("dataset", "parameter").values


def _relative_errors_of_sd(posteriors: xr.Dataset) -> np.ndarray:
    """Return relative Monte Carlo errors (N, P) of standard deviations; for weighted draws under normality."""
    if "draws" not in posteriors:
        return np.sqrt(0.5 / _by_parameter(posteriors, "ess"))
    # The draws are padded with NaN where samplers have different numbers of chains or draws.
    padded = posteriors.draws.transpose("dataset", "parameter", "chain", "draw")
    return np.stack([scores.relative_errors_of_sd(draws.dropna("chain", how="all").dropna("draw", how="all").values)
                     for draws in padded])


def least_ess(posteriors: xr.Dataset) -> float:
    """Return the smallest effective sample size; it is 0, not NaN, for a chain that does not move."""
    return float(np.nan_to_num(posteriors.ess).min())


def largest_r_hat(posteriors: xr.Dataset) -> float:
    """Return the largest R-hat; it is infinite for a chain that does not move."""
    return float(np.nan_to_num(posteriors.r_hat, nan=np.inf).max())
