"""Full posteriors with all rates unknown, with the force marginalised or as latent sites.

1. The model has uniform priors of the rates and starts of three genes, and log-normal priors of noise and lengthscale.
2. Sample it by NUTS with the force as latent sites on a grid; by NUTS and RAM on the marginal likelihood of a
   Gauss-Hermite filter.
3. For an iterated likelihood, weight RAM's draws by the Pareto-smoothed likelihood ratio, and resample each chain.
4. Summarise the force from the latent sites, or mix smoothed forces at evenly spaced draws.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import NUTS, init_to_uniform

import lfm_ppl as lfm
from lfm_ppl.accuracy import importance_weights
from lfm_ppl.parallel.task import Result, Task
from lfm_ppl.utils.programs import forget_executables

from .. import chains, scores
from ..timing import time_call
from . import problem

RULE, STEPS = lfm.GaussHermite(7), 6
FORCE_TIMES = np.linspace(0.0, problem.END, 61)
"""Times of the latent grid and of the reported force. The grid's weights are exact for a production that is linear
between its points."""

BATCH, PATHS = 200, 100
"""Batch size of the iterated likelihoods, and number of draws in the average of the smoothed force."""

LINKS = {entry.label: entry for entry in (problem.Configuration("softplus"), problem.Configuration("saturation", 0.5))}
UNIFORM = {"basal": (0.0, 0.1), "decay": (0.0, 2.0), "sensitivity": (0.0, 1.0), "away": (-0.1, 0.1)}
LEVELS = {"noise_sd": problem.NOISE, "lengthscale": problem.LENGTHSCALE}
NAMES = (*(f"{name}[{gene + 1}]" for name in UNIFORM for gene in range(problem.GENES)), *LEVELS)


@dataclass(frozen=True)
class SamplerConfiguration:
    """A kernel and its model.

    Attributes:
        kernel: "NUTS" or "RAM".
        latent: whether the force is a latent site on a grid; the marginal likelihood has no force.
        iterations: iterations of posterior linearisation in the target likelihood. Draws come from the likelihood
            without iterations, which is several times as fast, and are weighted.
    """

    kernel: str
    latent: bool = False
    iterations: int = 0


SAMPLERS = {"NUTS, latent grid": SamplerConfiguration("NUTS", latent=True),
            "NUTS, marginal": SamplerConfiguration("NUTS"), "RAM, marginal": SamplerConfiguration("RAM"),
            "RAM, iterated marginal": SamplerConfiguration("RAM", iterations=5)}
REFERENCE = "NUTS, latent grid"


def model(times: Any, y: Any = None, link: str = "softplus", gamma: float | None = None) -> None:
    """Sample rates, start, noise and lengthscale, and score expression.

    B ~ U(0, 0.1), D ~ U(0, 2), S ~ U(0, 1) and A ~ U(-0.1, 0.1) with x(0) = A + B/D, as in the simulation of the data.
    In the source these values are known. The standard deviation of the noise and the lengthscale are constant in all
    data, and have log-normal priors with these medians.
    """
    rates = [numpyro.sample(name, dist.Uniform(low, high).expand([problem.GENES]).to_event(1))
             for name, (low, high) in UNIFORM.items()]
    levels = [numpyro.sample(name, dist.LogNormal(jnp.log(value), 0.5)) for name, value in LEVELS.items()]
    numpyro.sample("y", _likelihood(jnp.concatenate([*rates, jnp.stack(levels)]), link, gamma, times=times), obs=y)


def _likelihood(theta: jax.Array, link: str, gamma: float | None, iterations: int = 0, times: Any = problem.TIMES
                ) -> lfm.MarginalLikelihood:
    """Return the likelihood of parameters (P,) in the order of `NAMES`."""
    basal, decay, sensitivity, excess = theta[:12].reshape(4, problem.GENES)
    rates = problem.Rates(basal, sensitivity, decay, excess + basal / decay)
    system = problem.system(link, gamma, rates, theta[12], theta[13])
    return lfm.MarginalLikelihood(system, times, rule=RULE, steps=STEPS, iterations=iterations)


def compute(task: Task) -> Result:
    """Return draws (parameters, chains, draws), their diagnostics, and the force at `FORCE_TIMES`.

    Weighted draws have the Pareto index ``k`` of their weights, and are resampled within each chain before the
    diagnostics. Every chain keeps its number of draws, so that R-hat detects chains with lower weights.
    """
    # Programs of one task, half a gigabyte each, are of no use to other tasks.
    jax.clear_caches()
    forget_executables()
    settings, configuration = task.settings, problem.configuration(task)
    sampler = SAMPLERS[settings["sampler"]]
    data = problem.data_set(configuration, settings["index"], task.seed)
    start = init_to_uniform(radius=1.0)  # R-hat needs different starts
    kernel: Any = lfm.RAM(model, init_strategy=start) if sampler.kernel == "RAM" else NUTS(
        lfm.on_latent_grid(model, FORCE_TIMES) if sampler.latent else model, init_strategy=start,
        dense_mass=not sampler.latent, max_tree_depth=settings["tree_depth"])
    mcmc = chains.sampler(kernel, *(settings[name] for name in chains.LENGTHS))

    def run() -> dict[str, jax.Array]:
        mcmc.run(task.key, problem.TIMES, data.y, **configuration._asdict())
        return mcmc.get_samples(group_by_chain=True)

    seconds, samples = time_call(run)
    draws = np.concatenate([*(np.moveaxis(np.asarray(samples[name]), -1, 0) for name in UNIFORM),
                            [samples[name] for name in LEVELS]])
    weights: Result = {}
    if sampler.iterations:
        weighting_seconds, (draws, weights["k"]) = time_call(_resample_draws, settings, sampler.iterations, data, draws)
        seconds += weighting_seconds
    if sampler.latent:
        forces = np.asarray(samples["y_forces"]).reshape(-1, len(FORCE_TIMES))
        mean, sd = forces.mean(axis=0), forces.std(axis=0)
    else:
        mean, sd = _marginalise_force(settings, sampler.iterations, data, draws)
    truth = np.interp(FORCE_TIMES, problem.GRID, data.u)
    return {"draws": draws, **weights, "divergences": int(np.sum(mcmc.get_extra_fields().get("diverging", 0))),
            "seconds": seconds, **scores.diagnose(NAMES, draws), "force_mean": mean, "force_sd": sd,
            "rmse": scores.rmse(mean, truth), "truth": true_parameters(data),
            "coverage": scores.interval_coverage(*scores.interval(mean, sd), truth)}


def true_parameters(data: problem.DataSet) -> np.ndarray:
    """Return the true value of every parameter, in the order of `NAMES`."""
    rates = data.rates
    return np.concatenate([rates.basal, rates.decay, rates.sensitivity, rates.start - rates.basal / rates.decay,
                           [*LEVELS.values()]])


def _resample_draws(settings: Mapping[str, Any], iterations: int, data: problem.DataSet, draws: np.ndarray
              ) -> tuple[np.ndarray, float]:
    """Return draws resampled to the posterior with the iterated likelihood, and the Pareto index of the weights."""
    def log_ratio(theta: jax.Array) -> jax.Array:
        iterated, plain = (_likelihood(theta, settings["link"], settings["gamma"], n).log_prob(data.y)
                           for n in (iterations, 0))
        return iterated - plain

    flat = jnp.asarray(draws.reshape(len(draws), -1).T)
    ratios = jax.jit(lambda points: jax.lax.map(log_ratio, points, batch_size=min(BATCH, len(points))))(flat)
    smoothed = importance_weights.smooth(np.asarray(ratios).reshape(draws.shape[1:]))
    if not np.isfinite(smoothed.log_weight).any(axis=1).all():
        raise ValueError("the iterated likelihood is zero at all draws of a chain, which cannot be weighted; use more "
                         "draws or no iterations.")
    # Another order than that of the chain would overstate the effective sample size.
    indices = [np.sort(importance_weights.resample(weights, len(weights), chain))
               for chain, weights in enumerate(smoothed.log_weight)]
    return np.stack([draws[:, chain, index] for chain, index in enumerate(indices)], axis=1), smoothed.k


def _marginalise_force(settings: Mapping[str, Any], iterations: int, data: problem.DataSet, draws: np.ndarray
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of the force at `FORCE_TIMES` with the parameters marginalised."""
    def smooth_force(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        likelihood = _likelihood(theta, settings["link"], settings["gamma"], iterations)
        force = likelihood.smooth(data.y, at=FORCE_TIMES).force(problem.FACTOR)
        return force.mean, force.sd**2

    thinned = jnp.asarray(scores.thin_draws(draws, min(PATHS, draws[0].size)))
    return scores.total_moments(*map(np.asarray, jax.jit(jax.vmap(smooth_force))(thinned)))
