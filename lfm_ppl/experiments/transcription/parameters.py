"""Full posteriors with all rates unknown: the marginal likelihood against the force as latent sites."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, NUTS, init_to_uniform

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.timing import timed
from lfm_ppl.experiments.transcription import problem
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.inference.handlers.on_latent_grid import on_latent_grid
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood
from lfm_ppl.linearisation.sigma_points import GaussHermite
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.results import importance

RULE, STEPS = GaussHermite(7), 6
AT = np.linspace(0.0, problem.END, 61)
"""The latent grid, with the exact weights for a production that is linear between its points; the force is reported
there."""

BATCH = 200
"""Draws whose iterated likelihoods are computed at a time."""

PATHS = 100
"""Draws over which the smoothed force is averaged."""

LINKS = {one.label: one for one in (problem.Configuration("softplus"), problem.Configuration("saturation", 0.5))}
VECTORS = ("basal", "decay", "sensitivity", "away")
NAMES = (*(f"{name}[{gene + 1}]" for name in VECTORS for gene in range(problem.GENES)), "noise_sd", "lengthscale")


class Sampler(NamedTuple):
    """A kernel and the model that it samples.

    Attributes:
        kernel: "NUTS" or "RAM".
        latent: whether the force is a latent site on a grid; otherwise it is filtered out.
        iterations: of posterior linearisation in the likelihood that the draws are weighted to. They come from the
            likelihood without, which is several times as fast and close enough for importance weights.
    """

    kernel: str
    latent: bool = False
    iterations: int = 0


SAMPLERS = {"NUTS, latent grid": Sampler("NUTS", latent=True), "NUTS, marginal": Sampler("NUTS"),
            "RAM, marginal": Sampler("RAM"), "RAM, iterated marginal": Sampler("RAM", iterations=5)}
REFERENCE = "NUTS, latent grid"


def model(times: Any, y: Any = None, link: str = "softplus", gamma: float | None = None) -> None:
    """Sample rates, start, noise and lengthscale, and score expression.

    B ~ U(0, 0.1), D ~ U(0, 2), S ~ U(0, 1) and A ~ U(-0.1, 0.1) with x(0) = A + B/D, the distributions that made the
    data, whose draws the source knew. The standard deviation of the noise and the lengthscale are the same in all data,
    and log-normal here about these values.
    """
    def each(name: str, low: float, high: float) -> jax.Array:
        return numpyro.sample(name, dist.Uniform(low, high).expand([problem.GENES]).to_event(1))

    basal, decay = each("basal", 0.0, 0.1), each("decay", 0.0, 2.0)
    sensitivity, away = each("sensitivity", 0.0, 1.0), each("away", -0.1, 0.1)
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(jnp.log(problem.NOISE), 0.5))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(problem.LENGTHSCALE), 0.5))
    rates = problem.Rates(basal, sensitivity, decay, away + basal / decay)
    system = problem.system(link, gamma, rates, noise_sd, lengthscale)
    numpyro.sample("y", MarginalLikelihood(system, times, rule=RULE, steps=STEPS), obs=y)


def tasks(settings: Any) -> list[Task]:
    """Return one task for each link, data set and sampler."""
    found = []
    for index in range(settings.datasets):
        for configuration in (LINKS[label] for label in settings.links):
            for label, sampler in SAMPLERS.items():
                size = "latent" if sampler.latent else sampler.kernel.lower()
                chains, warmup, draws, thin = getattr(settings, size)
                name = problem.slug(f"{configuration.label} {label}")
                own = {"iterations": sampler.iterations} if sampler.iterations else {}
                found.append(Task(f"parameters/{name}/{index:03d}", settings.seed, {
                    "experiment": "transcription-parameters", "sampler": label, "link": configuration.link,
                    "gamma": configuration.gamma, "index": index, "chains": chains, "warmup": warmup,
                    "draws": draws, "thin": thin, "tree_depth": settings.tree_depth, **own}))
    return found


def compute(task: Task) -> Result:
    """Return draws (parameters, chains, draws), their diagnostics, and the force at `AT`.

    ``k`` is the Pareto index of the weights, where draws are weighted; the diagnostics are then those of as many draws,
    taken from each chain by weight. Every chain keeps its share of the draws: where the weights of one are lower than
    those of others, R-hat shows it.
    """
    # The programs of one task serve no other, and would stay: half a gigabyte each.
    jax.clear_caches()
    settings = task.settings
    sampler = SAMPLERS[settings["sampler"]]
    data = problem.data_set(problem.Configuration(settings["link"], settings["gamma"]), settings["index"], task.seed)
    kwargs = {"link": settings["link"], "gamma": settings["gamma"]}
    kernel = _kernel(sampler, settings["tree_depth"])
    mcmc = MCMC(kernel, num_warmup=settings["warmup"] * settings["thin"],
                num_samples=settings["draws"] * settings["thin"], thinning=settings["thin"],
                num_chains=settings["chains"], chain_method="vectorized" if sampler.kernel == "RAM" else "sequential",
                progress_bar=False)

    def run() -> dict[str, jax.Array]:
        mcmc.run(task.key, problem.TIMES, data.y, **kwargs)
        return mcmc.get_samples(group_by_chain=True)

    seconds, drawn = timed(run)
    samples = {name: np.asarray(value) for name, value in drawn.items()}
    draws = np.stack([*(samples[name][..., gene] for name in VECTORS for gene in range(problem.GENES)),
                      samples["noise_sd"], samples["lengthscale"]])
    weighted = {}
    if sampler.iterations:
        more, (draws, weighted["k"]) = timed(lambda: _weighted(settings, sampler.iterations, data, draws))
        seconds += more
    divergences = 0 if sampler.kernel == "RAM" else int(np.sum(mcmc.get_extra_fields()["diverging"]))
    if sampler.latent:
        forces = samples["y_forces"].reshape(-1, len(AT))
        mean, sd = forces.mean(axis=0), forces.std(axis=0)
    else:
        mean, sd = _integrated(settings, sampler.iterations, data, draws)
    truth = np.interp(AT, problem.GRID, data.u)
    return {"draws": draws, **weighted, "divergences": divergences, "seconds": seconds, **scores.diagnose(NAMES, draws),
            "force_mean": mean, "force_sd": sd, "rmse": scores.rmse(mean, truth),
            "coverage": scores.covered(mean - scores.Z * sd, mean + scores.Z * sd, truth), "truth": true_values(data)}


def true_values(data: problem.DataSet) -> np.ndarray:
    """Return the true value of every parameter, in the order of `NAMES`."""
    rates = data.rates
    return np.concatenate([rates.basal, rates.decay, rates.sensitivity, rates.start - rates.basal / rates.decay,
                           [problem.NOISE, problem.LENGTHSCALE]])


def _kernel(sampler: Sampler, tree_depth: int) -> Any:
    strategy = init_to_uniform(radius=1.0)  # chains start apart, or R-hat would say nothing
    if sampler.kernel == "RAM":
        return RAM(model, init_strategy=strategy)
    chosen: Callable = on_latent_grid(model, AT) if sampler.latent else model
    return NUTS(chosen, init_strategy=strategy, dense_mass=not sampler.latent, max_tree_depth=tree_depth)


def _system(settings: Any, theta: jax.Array) -> LatentForceModel:
    """Return the model with parameters (P,)."""
    basal, decay, sensitivity, away = theta[:12].reshape(4, problem.GENES)
    rates = problem.Rates(basal, sensitivity, decay, away + basal / decay)
    return problem.system(settings["link"], settings["gamma"], rates, theta[12], theta[13])


def _weighted(settings: Any, iterations: int, data: problem.DataSet, draws: np.ndarray) -> tuple[np.ndarray, float]:
    """Return as many draws of the posterior with the iterated likelihood, and the Pareto index of their weights."""
    def log_ratio(theta: jax.Array) -> jax.Array:
        system = _system(settings, theta)
        iterated, plain = (MarginalLikelihood(system, problem.TIMES, rule=RULE, steps=STEPS, iterations=n)
                           for n in (iterations, 0))
        return iterated.log_prob(data.y) - plain.log_prob(data.y)

    flat = jnp.asarray(draws.reshape(len(draws), -1).T)
    ratios = jax.jit(lambda all_: jax.lax.map(log_ratio, all_, batch_size=min(BATCH, len(all_))))(flat)
    found = importance.smooth(np.asarray(ratios).reshape(draws.shape[1:]))
    if not np.isfinite(found.log_weight).any(axis=1).all():
        raise ValueError("the iterated likelihood is zero at all draws of a chain; no weights make it a chain of that "
                         "posterior.")
    # In the order of the chain, whose effective sample size would seem larger otherwise.
    taken = [np.sort(importance.resample(weights, len(weights), chain))
             for chain, weights in enumerate(found.log_weight)]
    return np.stack([draws[:, chain, index] for chain, index in enumerate(taken)], axis=1), found.k


def _integrated(settings: Any, iterations: int, data: problem.DataSet, draws: np.ndarray
                ) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of the force at `AT`, the parameters integrated out."""
    chosen = scores.spread(draws, min(PATHS, draws[0].size))

    def one(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = smooth(_system(settings, theta), problem.TIMES, data.y, RULE, STEPS, at=AT, iterations=iterations)
        force = found.force(problem.FACTOR)
        return force.mean, force.sd**2

    mean, variance = map(np.asarray, jax.jit(jax.vmap(one))(jnp.asarray(chosen)))
    return scores.total_moments(mean, variance)
