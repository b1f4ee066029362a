"""Inference of the parameters: conditional posteriors of single parameters, and MCMC over all three.

1. A conditional posterior is the posterior of one parameter under a flat prior, with the other two at the truth.
   Evaluate the log likelihood at the nodes of its grid (`conditional_likelihoods`).
2. Record whether its central 99% interval contains the truth (`outcomes`), and pool the parameters (`pooled_rate`).
3. Sample all three parameters by RAM, NUTS or particle-marginal RAM (`sample_posterior`). Smooth the state at selected
   draws, and mix the smoothed distributions.

Each program is compiled once for all realisations.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.fokker_planck_grid import grid_filter
from lfm_ppl.model.state_space import state_space
from lfm_ppl.parallel.task import Result, Task
from lfm_ppl.particles import particle_filter

from .. import scores
from ..chains import LENGTHS, nuts
from ..tasks import dataset_indices
from ..timing import time_call
from . import problem, states

INTERVALS = {"alpha": (-2.0, 1.5), "beta": (0.04, 1.5), "sigma": (1.0, 16.0)}
"""Bounds of the flat priors."""

OUTSIDE = 0.01
"""Probability outside the central 99% interval."""

PARTICLE_STEPS = 20
"""Steps of the particle filter between two observations."""

SAMPLERS = {"RAM, CKF": ("RAM", "CKF"), "RAM, EKF": ("RAM", "EKF"), "NUTS, CKF": ("NUTS", "CKF"),
            "particle-marginal RAM": ("PMMH", problem.GRID)}
"""Label -> kernel, and method of the likelihood and of the smoother. Particles estimate the likelihood of the grid."""

CHAINS = 4
TYPICAL = np.array([[0.34, -0.057, 0.033], [-0.057, 0.0134, -0.0116], [0.033, -0.0116, 0.0385]])
"""Posterior covariance of log cubic, linear and log sigma, averaged over six realisations; initial proposal of RAM."""

PUBLISHED = {"RAM, EKF": 0.895, "RAM, CKF": 0.935}
"""RMSE of the smoothed state in the source's figure 2.5, for its one realisation."""


def nodes(name: str, count: int) -> np.ndarray:
    """Return the values of a parameter at which the likelihood is computed; positive ones in geometric progression.

    Example:
        >>> [round(float(v), 3) for v in nodes("sigma", 3)]
        [1.0, 4.0, 16.0]
    """
    low, high = INTERVALS[name]
    return np.linspace(low, high, count) if low <= 0 else np.geomspace(low, high, count)


def conditional_likelihoods(task: Task) -> Result:
    """Return ``log_likelihood`` (realisations, 3, nodes), and CPU ``seconds`` for all of them, without compilation."""
    settings = task.settings
    data = [problem.realisation(index, task.seed) for index in dataset_indices(task)]
    size = settings.get("particles", settings.get("cells"))
    run = _compile_likelihoods(settings["method"], size, settings.get("steps", 1), tuple(data[0].times), len(data),
                               settings["nodes"])
    keys = jax.vmap(functools.partial(jax.random.fold_in, jax.random.key(task.seed)))(np.array(dataset_indices(task)))
    seconds, values = time_call(run, np.stack([realisation.y for realisation in data]), keys)
    return {"log_likelihood": np.asarray(values).reshape(len(data), 3, -1), "seconds": seconds}


@functools.cache
def _compile_likelihoods(method: str, size: int, steps: int, times: tuple[float, ...], data_sets: int,
                         node_count: int) -> Callable:
    """Compile a function from observations (N, T, 1) and keys (N,) to log likelihoods (N, P) at all nodes.

    ``size`` is the number of particles or of grid cells; only particles use the keys.
    """
    points: Any = np.tile(problem.TRUTH, (3, node_count, 1))
    for index, name in enumerate(problem.NAMES):
        points[index, :, index] = nodes(name, node_count)
    points = points.reshape(-1, 3)

    def log_likelihood(theta: jax.Array, y: jax.Array, key: jax.Array) -> jax.Array:
        system = problem.system(theta)
        if method in problem.GAUSSIAN:
            return lfm.MarginalLikelihood(system, np.array(times), problem.GAUSSIAN[method], steps=steps,
                                          iterations=0).log_prob(y)
        ssm = state_space(system)
        time_grid = build_time_grid(ssm, np.array(times), steps)
        if method == problem.GRID:
            return grid_filter.log_likelihood(ssm, time_grid, y, states.build_grid(size))
        settings = particle_filter.check_settings(ssm, particle_filter.ParticleSettings(size))
        return particle_filter.log_likelihood(ssm, time_grid, y, key, settings)

    def run(y: jax.Array, keys: jax.Array) -> jax.Array:
        if method == problem.GRID:
            # The transition matrix of a parameter value serves all data sets.
            return jax.lax.map(lambda theta: log_likelihood(theta, y, keys), points).T
        if method == problem.PARTICLES:
            # Common random numbers at all parameter values: only differences of the log likelihood matter.
            return jax.lax.map(lambda pair: jax.lax.map(lambda theta: log_likelihood(theta, *pair), points), (y, keys))
        # All parameter values side by side, one realisation after another, is faster than all at once.
        return jax.lax.map(lambda pair: jax.vmap(log_likelihood, in_axes=(0, None, None))(points, *pair), (y, keys))

    keys = jax.random.split(jax.random.key(0), data_sets)
    return jax.jit(run).lower(np.zeros((data_sets, len(times), 1)), keys).compile()


def log_likelihoods(dataset: xr.Dataset) -> xr.DataArray:
    """Return the log likelihoods (method, dataset, parameter, node) of all blocks; the last block may be shorter."""
    rows = dataset.log_likelihood.stack(dataset=("first", "member")).dropna("dataset", how="all")
    return rows.transpose("method", "dataset", "parameter", "node")


def outcomes(dataset: xr.Dataset) -> xr.Dataset:
    """Compare the conditional posteriors of every method with the truth.

    Returns:
        ``below``, the posterior probability of values below the truth; ``outside``, whether the truth lies outside the
        central 99% interval; ``cut``, whether a bound of the flat prior truncates the posterior; CPU ``seconds`` of a
        realisation.
    """
    rows = log_likelihoods(dataset)
    below, cut = xr.zeros_like(rows[..., 0]), xr.zeros_like(rows[..., 0], bool)
    for cell in np.ndindex(below.shape):
        posterior = scores.GridPosterior(nodes(problem.NAMES[cell[-1]], rows.sizes["node"]), rows.values[cell])
        below[cell], cut[cell] = posterior.cdf(problem.TRUTH[cell[-1]]), posterior.is_cut_off()
    return xr.Dataset({"below": below, "outside": (below < OUTSIDE / 2) | (below > 1 - OUTSIDE / 2), "cut": cut,
                       "seconds": dataset.seconds.sum("first") / rows.sizes["dataset"]})


def pooled_rate(is_outside: xr.DataArray) -> scores.Estimate:
    """Return the share of posteriors (dataset, parameter) whose interval does not contain the truth.

    The standard error is that of the mean over realisations, since only realisations are independent.
    """
    share = scores.estimate_mean(is_outside.mean("parameter"))
    spread = is_outside.any() and is_outside.sizes["dataset"] > 1
    return share if spread else scores.Estimate(share.value, scores.estimate_rate(is_outside).error)


def sample_posterior(task: Task) -> Result:
    """Return draws of alpha, beta and sigma, and the smoothed state with them marginalised.

    At evenly spaced draws s the smoother has mean m_s and variance v_s. The mean of the mixture is the mean of m_s; by
    the law of total variance, its variance is the mean of v_s plus the variance of m_s. The band is the mean +- 1.96
    standard deviations, as in the source. The smoother is the Gaussian smoother of the sampler's likelihood. Draws of
    particle-marginal RAM come from the exact posterior, and use the exact smoother on the grid.

    Returns:
        ``draws`` (3, chains, draws), their diagnostics (`scores.diagnose`), and ``divergences``; CPU ``seconds`` of
        warm-up and draws, without compilation; mean, band and scores of the smoothed state.
    """
    settings, data = task.settings, problem.realisation(task.settings["index"], task.seed)
    lengths = tuple(settings[name] for name in LENGTHS)
    run = _compile_chains(settings["sampler"], lengths, settings.get("steps"), settings.get("particles"),
                          settings.get("tree_depth"), tuple(data.times))
    seconds, (draws, divergences) = time_call(run, task.key, data.y)
    draws = np.asarray(draws)
    mean, variance = map(np.asarray, _smooth_at_draws(
        scores.thin_draws(draws, settings["paths"]), data.sparse, SAMPLERS[settings["sampler"]][1],
        states.solver_size(settings, data), tuple(data.fine)))
    paths = states.band("smoother", *scores.total_moments(mean, variance))
    return {"draws": draws, "divergences": int(divergences), "seconds": seconds,
            **scores.diagnose(problem.NAMES, draws), **paths, **states.score_path("smoother", paths, data.path)}


@functools.cache
def _compile_chains(label: str, lengths: tuple[int, ...], steps: Any, particles: int | None, tree_depth: int | None,
                    times: tuple[float, ...]) -> Callable:
    """Compile a function from a key and observations (T, 1) to the draws and divergences of all chains.

    ``lengths`` are the settings `LENGTHS`: number of chains, warm-up, draws and thinning.
    """
    (chains, warmup, draws, thin), (name, method) = lengths, SAMPLERS[label]
    model = problem.model_file().model
    if method in problem.GAUSSIAN:
        model = lfm.approximate(model, rule=problem.GAUSSIAN[method], steps=steps)

    def chain(key: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        kernel: Any = lfm.RAM(model, initial_covariance=TYPICAL)
        if name == "NUTS":
            kernel = nuts(model, max_tree_depth=tree_depth)
        elif name == "PMMH":
            kernel = lfm.ParticleMarginalRAM(model, particles=particles, particle_steps=steps,
                                             initial_covariance=TYPICAL)
        arguments = (np.array(times), y)

        def step(state: Any, _: None) -> tuple[Any, tuple]:
            state = jax.lax.fori_loop(0, thin, lambda _, s: kernel.sample(s, arguments, {}), state)
            return state, (state.z, getattr(state, "diverging", jnp.asarray(False)))

        # One loop for warm-up and draws, which the kernel distinguishes, compiles the likelihood only once.
        start = kernel.init(key, warmup * thin, None, arguments, {})
        _, records = jax.lax.scan(step, start, length=warmup + draws)
        z, diverging = jax.tree.map(lambda a: a[warmup:], records)
        sites = jax.vmap(kernel.postprocess_fn(arguments, {}))(z)
        return jnp.stack([sites[name] for name in problem.NAMES]), diverging.sum()

    def run(key: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        # A Gaussian filter costs hardly more for four chains than for one. The particles of one chain fill the cache,
        # and parallel chains of NUTS all wait for the longest trajectory.
        samples, diverging = jax.lax.map(lambda key: chain(key, y), jax.random.split(key, chains),
                                         batch_size=chains if name == "RAM" else 1)
        return jnp.moveaxis(samples, 0, 1), diverging.sum()

    return jax.jit(run).lower(jax.random.key(0), np.zeros((len(times), 1))).compile()


@functools.partial(jax.jit, static_argnames=("method", "size", "fine"))
def _smooth_at_draws(points: jax.Array, sparse: jax.Array, method: str, size: int, fine: tuple[float, ...]) -> tuple:
    """Return smoothed mean and variance, (S, K) each, at parameters (S, 3)."""
    # The transition matrices of a grid at all parameters together would fill the memory.
    return jax.lax.map(lambda theta: states.solve(method, theta, sparse, np.array(fine), size)[2], points,
                       batch_size=None if method == problem.GRID else len(points))
