"""What the data say about the parameters: conditional posteriors of single ones, and MCMC over all three.

A conditional posterior is that of one parameter under a flat prior, given the others at the truth: does its central 99%
interval hold the truth? With MCMC there is also the smoothed state with the parameters marginalised.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.chains import nuts
from lfm_ppl.experiments.ginzburg_landau import problem, states
from lfm_ppl.experiments.tasks import dataset_indices
from lfm_ppl.experiments.timing import time_call
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.fokker_planck_grid import grid_filter
from lfm_ppl.inference.handlers.settings import approximate
from lfm_ppl.inference.kernels.particle_marginal import ParticleMarginalRAM
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood
from lfm_ppl.model.state_space import state_space
from lfm_ppl.particles import particle_filter

INTERVALS = {"alpha": (-2.0, 1.5), "beta": (0.04, 1.5), "sigma": (1.0, 16.0)}
"""Where the flat priors lie."""

OUTSIDE = 0.01
"""The truth is outside of the central 99% interval."""

PARTICLE_STEPS = 20
"""Steps of the particle filter between two observations."""

SAMPLERS = {"RAM, CKF": ("RAM", "CKF"), "RAM, EKF": ("RAM", "EKF"), "NUTS, CKF": ("NUTS", "CKF"),
            "particle-marginal RAM": ("PMMH", problem.GRID)}
"""Label -> kernel, and the method that gives the likelihood, the grid's estimated by particles, and smooths states."""

CHAINS = 4
TYPICAL = np.array([[0.34, -0.057, 0.033], [-0.057, 0.0134, -0.0116], [0.033, -0.0116, 0.0385]])
"""Covariance of log cubic, linear and log sigma in a posterior, averaged over six realisations: how RAM starts."""

PUBLISHED = {"RAM, EKF": 0.895, "RAM, CKF": 0.935}
"""RMSE of the smoothed state in the source's figure 2.5, for its one realisation."""


def nodes(name: str, count: int) -> np.ndarray:
    """Return the values of a parameter at which the likelihood is computed: denser where the parameter is smaller.

    Example:
        >>> [round(float(v), 3) for v in nodes("sigma", 3)]
        [1.0, 4.0, 16.0]
    """
    low, high = INTERVALS[name]
    return np.linspace(low, high, count) if low <= 0 else np.geomspace(low, high, count)


def conditional(task: Task) -> Result:
    """Return ``log_likelihood`` (realisations, 3, nodes), and CPU ``seconds`` for all of them, without compilation."""
    settings = task.settings
    data = [problem.realisation(index, task.seed) for index in dataset_indices(task)]
    run = _likelihoods(settings["method"], settings.get("particles", settings.get("cells")), settings.get("steps", 1),
                       tuple(data[0].times), len(data), settings["nodes"])
    keys = jax.vmap(functools.partial(jax.random.fold_in, jax.random.key(task.seed)))(np.array(dataset_indices(task)))
    seconds, values = time_call(run, np.stack([one.y for one in data]), keys)
    return {"log_likelihood": np.asarray(values).reshape(len(data), 3, -1), "seconds": seconds}


@functools.cache
def _likelihoods(method: str, size: int, steps: int, times: tuple[float, ...], number: int, count: int) -> Callable:
    """Compile the log likelihood (N, P) of N realisations at all nodes: with so many particles, or cells of a grid.

    It takes observations (N, T, 1), and for particles the keys (N,).
    """
    points: Any = np.tile(problem.TRUTH, (3, count, 1))
    for index, name in enumerate(problem.NAMES):
        points[index, :, index] = nodes(name, count)
    points = points.reshape(-1, 3)

    def one(theta: jax.Array, y: jax.Array, key: jax.Array) -> jax.Array:
        system = problem.system(theta)
        if method in problem.GAUSSIAN:
            return MarginalLikelihood(system, np.array(times), problem.GAUSSIAN[method], steps=steps,
                                      iterations=0).log_prob(y)
        ssm = state_space(system)
        time_grid = build_time_grid(ssm, np.array(times), steps)
        if method == problem.GRID:
            return grid_filter.log_likelihood(ssm, time_grid, y, states.cells_of(size))
        settings = particle_filter.check_settings(ssm, particle_filter.ParticleSettings(size))
        return particle_filter.log_likelihood(ssm, time_grid, y, key, settings)

    def run(y: jax.Array, keys: jax.Array) -> jax.Array:
        if method == problem.GRID:
            # The transition matrix of a parameter value serves all data sets.
            return jax.lax.map(lambda theta: one(theta, y, keys), points).T
        if method == problem.PARTICLES:
            # The same random numbers at every parameter value: a posterior feels only differences between them.
            return jax.lax.map(lambda pair: jax.lax.map(lambda theta: one(theta, *pair), points), (y, keys))
        # All parameter values side by side, one realisation after another, is faster than all at once.
        return jax.lax.map(lambda pair: jax.vmap(one, in_axes=(0, None, None))(points, *pair), (y, keys))

    keys = jax.random.split(jax.random.key(0), number)
    return jax.jit(run).lower(np.zeros((number, len(times), 1)), keys).compile()


def log_likelihoods(found: xr.Dataset) -> xr.DataArray:
    """Return the log likelihoods (method, dataset, parameter, node) of all blocks, whose last one may be shorter."""
    rows = found.log_likelihood.stack(dataset=("first", "member")).dropna("dataset", how="all")
    return rows.transpose("method", "dataset", "parameter", "node")


def outcomes(found: xr.Dataset) -> xr.Dataset:
    """Judge the conditional posteriors of every method.

    Returns:
        ``below``, the posterior probability of less than the truth; ``outside``, whether the truth lies outside the
        central 99% interval; ``cut``, whether an end of the flat prior cuts it off; CPU ``seconds`` of a realisation.
    """
    rows = log_likelihoods(found)
    below, cut = xr.zeros_like(rows[..., 0]), xr.zeros_like(rows[..., 0], bool)
    for place in np.ndindex(below.shape):
        posterior = scores.GridPosterior(nodes(problem.NAMES[place[-1]], rows.sizes["node"]), rows.values[place])
        below[place], cut[place] = posterior.below(problem.TRUTH[place[-1]]), posterior.is_cut_off()
    return xr.Dataset({"below": below, "outside": (below < OUTSIDE / 2) | (below > 1 - OUTSIDE / 2), "cut": cut,
                       "seconds": found.seconds.sum("first") / rows.sizes["dataset"]})


def pooled(outside: xr.DataArray) -> scores.Estimate:
    """Return the share of posteriors (dataset, parameter) that leave the truth out.

    Its standard error is that of the mean over realisations: they are independent, the parameters of one are not.
    """
    share = scores.mean_of(outside.mean("parameter"))
    spread = outside.any() and outside.sizes["dataset"] > 1
    return share if spread else scores.Estimate(share.value, scores.rate_of(outside).error)


def by_chains(task: Task) -> Result:
    """Return draws of alpha, beta and sigma, and the smoothed state with them marginalised.

    For draws spread over the chains the smoother gives mean m_s and variance v_s; then the mean is that of m_s and, by
    the law of total variance, the variance is the mean of v_s plus the variance of m_s. The band is the mean +- 1.96
    standard deviations, as in the source. The smoother is the sampler's own Gaussian one; for particle-marginal RAM,
    whose draws are from the exact posterior, it is the exact one on the grid.

    Returns:
        ``draws`` (3, chains, draws), their diagnostics (`scores.diagnose`), and ``divergences``; CPU ``seconds`` of
        warm-up and draws, without compilation; mean, band and scores of the smoothed state.
    """
    settings, data = task.settings, problem.realisation(task.settings["index"], task.seed)
    names = ("sampler", "warmup", "draws", "thin", "chains", "steps", "particles", "tree_depth")
    run = _chains(*(settings.get(name) for name in names), tuple(data.times))
    seconds, (draws, divergences) = time_call(run, task.key, data.y)
    draws = np.asarray(draws)
    mean, variance = map(np.asarray, _smoothed(
        scores.thin_draws(draws, settings["paths"]), data.sparse, SAMPLERS[settings["sampler"]][1],
        states.size_of(settings, data), tuple(data.fine)))
    paths = states.band("smoother", *scores.total_moments(mean, variance))
    return {"draws": draws, "divergences": int(divergences), "seconds": seconds,
            **scores.diagnose(problem.NAMES, draws), **paths, **states.judged("smoother", paths, data.path)}


@functools.cache
def _chains(label: str, warmup: int, draws: int, thin: int, chains: int, steps: int, particles: int | None,
            tree_depth: int | None, times: tuple[float, ...]) -> Callable:
    """Compile the chains once for all realisations: the observations are an argument."""
    name, method = SAMPLERS[label]
    model = problem.model_file().model
    if method in problem.GAUSSIAN:
        model = approximate(model, rule=problem.GAUSSIAN[method], steps=steps)

    def chain(key: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        kernel: Any = RAM(model, initial_covariance=TYPICAL)
        if name == "NUTS":
            kernel = nuts(model, max_tree_depth=tree_depth)
        elif name == "PMMH":
            kernel = ParticleMarginalRAM(model, particles=particles, particle_steps=steps, initial_covariance=TYPICAL)
        arguments = (np.array(times), y)

        def one(now: Any, _: None) -> tuple[Any, tuple]:
            now = jax.lax.fori_loop(0, thin, lambda _, s: kernel.sample(s, arguments, {}), now)
            return now, (now.z, getattr(now, "diverging", jnp.asarray(False)))

        # Warm-up and draws in one loop: the kernel tells them apart, and the likelihood is compiled once less.
        begin = kernel.init(key, warmup * thin, None, arguments, {})
        _, every = jax.lax.scan(one, begin, length=warmup + draws)
        z, diverging = jax.tree_util.tree_map(lambda a: a[warmup:], every)
        sites = jax.vmap(kernel.postprocess_fn(arguments, {}))(z)
        return jnp.stack([sites[name] for name in problem.NAMES]), diverging.sum()

    def run(key: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        # A Gaussian filter costs hardly more for four chains than for one; the particles of one fill the cache, and
        # chains of NUTS that run together all wait for the longest trajectory among them.
        found, diverging = jax.lax.map(lambda key: chain(key, y), jax.random.split(key, chains),
                                       batch_size=chains if name == "RAM" else 1)
        return jnp.moveaxis(found, 0, 1), diverging.sum()

    return jax.jit(run).lower(jax.random.key(0), np.zeros((len(times), 1))).compile()


@functools.partial(jax.jit, static_argnames=("method", "size", "fine"))
def _smoothed(points: jax.Array, sparse: jax.Array, method: str, size: int, fine: tuple[float, ...]) -> tuple:
    """Return smoothed mean and variance, (S, K) each, at parameters (S, 3)."""
    # The transition matrices of a grid at all parameters together would fill the memory.
    return jax.lax.map(lambda theta: states.solved(method, theta, sparse, np.array(fine), size)[2], points,
                       batch_size=None if method == problem.GRID else len(points))
