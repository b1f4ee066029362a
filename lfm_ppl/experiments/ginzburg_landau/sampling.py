"""MCMC over alpha, beta and sigma, and the smoothed state with them integrated out."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer import NUTS

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.ginzburg_landau import grid, problem, state
from lfm_ppl.experiments.timing import timed
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.inference.handlers.settings import approximate
from lfm_ppl.inference.kernels.particle_marginal import ParticleMarginalRAM
from lfm_ppl.inference.kernels.ram import RAM


class Sampler(NamedTuple):
    """A sampler and the likelihood that it uses.

    Attributes:
        kernel: "RAM", "NUTS" or "PMMH" (particle-marginal RAM).
        rule: name of the Gaussian filter; for "PMMH" None.
    """

    kernel: str
    rule: str | None


SAMPLERS = {"RAM, CKF": Sampler("RAM", "CKF"), "RAM, EKF": Sampler("RAM", "EKF"), "NUTS, CKF": Sampler("NUTS", "CKF"),
            "particle-marginal RAM": Sampler("PMMH", None)}
CHAINS = 4

TYPICAL = np.array([[0.34, -0.057, 0.033], [-0.057, 0.0134, -0.0116], [0.033, -0.0116, 0.0385]])
"""Covariance of log cubic, linear and log sigma in a posterior, averaged over six realisations: how RAM starts."""


def tasks(settings: Any) -> list[Task]:
    """Return one task for each sampler and realisation."""
    found = []
    for label, sampler in SAMPLERS.items():
        warmup, draws, thin = settings.chain(sampler.kernel)
        own: dict[str, Any] = {"steps": problem.STEPS}
        if sampler.kernel == "NUTS":
            own["tree_depth"] = settings.tree_depth
        if sampler.rule is None:
            own = {"particles": settings.marginal_particles, "steps": settings.marginal_steps,
                   "cells": settings.draw_cells}
        for index in range(settings.realisations):
            found.append(Task(
                f"mcmc/{slug(label)}/{index:03d}", settings.seed,
                {"experiment": "ginzburg-landau", "what": "mcmc", "sampler": label, "index": index, "chains": CHAINS,
                 "warmup": warmup, "draws": draws, "thin": thin, "paths": settings.paths, **own}))
    return found


def compute(task: Task) -> Result:
    """Return draws (3, chains, draws), their diagnostics, and the smoothed state on the fine times."""
    data = problem.realisation(task.settings["index"], task.seed)
    draws, divergences, seconds = sample(task.settings, data, task.key)
    result = {"draws": draws, "divergences": divergences, "seconds": seconds, **scores.diagnose(problem.NAMES, draws)}
    paths = integrated(task.settings, data, draws)
    return {**result, **paths,
            "smoother_rmse": scores.rmse(paths["smoother_mean"], data.path),
            "smoother_coverage": scores.covered(paths["smoother_low"], paths["smoother_high"], data.path)}


def sample(settings: Any, data: problem.Realisation, key: jax.Array) -> tuple[np.ndarray, int, float]:
    """Run the chains.

    Args:
        settings: of the task.
        data: the realisation.
        key: a JAX random key.

    Returns:
        Draws (3, chains, draws) of alpha, beta and sigma, the number of divergent transitions, and the CPU seconds of
        warm-up and draws, without compilation.
    """
    names = ("sampler", "warmup", "draws", "thin", "chains", "steps", "particles", "tree_depth")
    run = _program(*(settings.get(name) for name in names), tuple(data.times))
    seconds, (draws, divergences) = timed(run, jax.random.key_data(key), jnp.asarray(data.y))
    return np.asarray(draws), int(divergences), seconds


@functools.cache
def _program(label: str, warmup: int, draws: int, thin: int, chains: int, steps: int, particles: int | None,
             tree_depth: int | None, times: tuple[float, ...]) -> Callable:
    """Compile the chains once for all realisations: the observations are an argument."""
    kernel_name, rule = SAMPLERS[label]
    model = problem.model_file().model
    if rule is not None:
        model = approximate(model, rule=problem.GAUSSIAN[rule], steps=steps)

    def chain(key: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        kernel = _kernel(kernel_name, model, particles, steps, tree_depth)
        arguments = (np.array(times), y)
        begin = kernel.init(key, warmup * thin, None, arguments, {})

        def one(now: Any, _: None) -> tuple[Any, tuple]:
            now = jax.lax.fori_loop(0, thin, lambda _, s: kernel.sample(s, arguments, {}), now)
            return now, (now.z, getattr(now, "diverging", jnp.asarray(False)))

        # Warm-up and draws in one loop: the kernel tells them apart, and the likelihood is compiled once less.
        _, kept = jax.lax.scan(one, begin, length=warmup + draws)
        z, diverging = jax.tree_util.tree_map(lambda a: a[warmup:], kept)
        sites = jax.vmap(kernel.postprocess_fn(arguments, {}))(z)
        return jnp.stack([sites[name] for name in problem.NAMES]), diverging.sum()

    def run(key: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        keys = jax.random.split(jax.random.wrap_key_data(key), chains)
        # A Gaussian filter costs hardly more for four chains than for one; the particles of one fill the cache, and
        # chains of NUTS that run together all wait for the longest trajectory among them.
        size = chains if kernel_name == "RAM" else 1
        found, diverging = jax.lax.map(lambda k: chain(k, y), keys, batch_size=size)
        return jnp.moveaxis(found, 0, 1), diverging.sum()

    key = jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0)))
    return jax.jit(run).lower(key, jax.ShapeDtypeStruct((len(times), 1), float)).compile()


def _kernel(name: str, model: Any, particles: int | None, steps: int, tree_depth: int | None) -> Any:
    if name == "NUTS":
        return NUTS(model, dense_mass=True, forward_mode_differentiation=True, max_tree_depth=tree_depth or 10)
    if name == "RAM":
        return RAM(model, initial_covariance=TYPICAL)
    return ParticleMarginalRAM(model, particles=particles, particle_steps=steps, initial_covariance=TYPICAL)


def integrated(settings: Any, data: problem.Realisation, draws: np.ndarray) -> Result:
    """Return the smoothed state with the parameters integrated out.

    For draws spread over the chains the smoother gives mean m_s and variance v_s; then the mean is that of m_s and, by
    the law of total variance, the variance is the mean of v_s plus the variance of m_s. The band is the mean +- 1.96
    standard deviations, as in the source. The smoother is the sampler's own Gaussian one; for particle-marginal RAM,
    whose draws are from the exact posterior, it is the exact one on the grid.
    """
    chosen = scores.spread(draws, settings["paths"])
    rule = SAMPLERS[settings["sampler"]].rule
    if rule is not None:
        run = _smoother_program(rule, state.steps_between(data, settings["steps"]), len(chosen), tuple(data.fine))
    else:
        run = grid.moments_program(settings["cells"], len(chosen), tuple(data.fine))
    mean, variance = map(np.asarray, run(jnp.asarray(chosen), jnp.asarray(data.sparse)))
    return state.band("smoother", *scores.total_moments(mean, variance))


@functools.cache
def _smoother_program(rule: str, steps: int, count: int, fine: tuple[float, ...]) -> Callable:
    def one(theta: jax.Array, sparse: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = smooth(problem.system(theta), np.array(fine), sparse, problem.GAUSSIAN[rule], steps)
        return found.mean[:, 0], found.covariance[:, 0, 0]

    shapes = jax.ShapeDtypeStruct((count, 3), float), jax.ShapeDtypeStruct((len(fine), 1), float)
    return jax.jit(jax.vmap(one, in_axes=(0, None))).lower(*shapes).compile()


def slug(label: str) -> str:
    """Return a sampler's label as part of the name of a task."""
    return label.replace(", ", "-").replace(" ", "-")
