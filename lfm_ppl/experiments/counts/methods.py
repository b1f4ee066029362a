"""What each method makes of a problem: the log evidence, the predictor's posterior, predictions of held-out data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lfm_ppl as lfm
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.counts.problem import Problem, Size, problem
from lfm_ppl.experiments.counts.reference import Reference
from lfm_ppl.experiments.timing import timed
from lfm_ppl.inference.map import map_estimate
from lfm_ppl.model.observations.family import ObservationFamily

METHODS = {"ep": "EP", "variational": "variational", "laplace": "Laplace"}
REFERENCE = "reference"

NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(60)
"""Of the integral of a density over the predictor."""

REPEATS = 5
"""Evidences with gradient over which the time is averaged."""

DRAWN = 4000
"""Predictive draws of a held-out entry, whose quantiles are an interval."""


def of_task(task: Task) -> Problem:
    """Return the problem of a task."""
    given = task.settings
    return problem(given["problem"], Size(*given["size"]), task.seed, given["data"])


def learn(task: Task) -> Result:
    """Return the parameters at the mode of the posterior with EP's evidence."""
    one = of_task(task)
    if one.given is not None:
        return dict(one.given)
    found = map_estimate(one.model, one.times, one.y, restarts=1)
    if not found.converged:
        raise ValueError(f"the parameters of {task.settings['problem']} were not found: {found.message}")
    return {name: float(found.parameters[name]) for name in one.priors}


def compute(task: Task) -> Result:
    """Return what a method finds, with parameters that are given."""
    one, theta = of_task(task), dict(task.settings["parameters"])
    if task.settings["method"] == REFERENCE:
        return _reference(task, one, theta)
    return _sites(task, one, theta)


def _sites(task: Task, one: Problem, theta: dict[str, float]) -> Result:
    settings = one.sites._replace(method=task.settings["method"])

    def likelihood(values: dict[str, Any]) -> lfm.MarginalLikelihood:
        return lfm.MarginalLikelihood(one.build(**values), one.times, sites=settings)

    evidence = jax.jit(jax.value_and_grad(lambda values, y: likelihood(values).log_prob(y)))

    @jax.jit
    def smoothed(values: dict[str, Any], y: jax.Array) -> tuple[jax.Array, jax.Array]:
        distribution = likelihood(values)
        result, ssm = distribution.smooth(y), distribution.ssm

        def row(mean: jax.Array, covariance: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array]:
            f, jacobian = jax.value_and_grad(lambda s: ssm.observe(ssm.inputs(s, t), t)[0])(mean)
            return f, jacobian @ covariance @ jacobian

        return jax.vmap(row)(result.mean, result.covariance, jnp.asarray(one.times))

    log_z = float(evidence(theta, one.y)[0])  # compiled here
    seconds, _ = timed(lambda: [evidence(theta, one.y) for _ in range(REPEATS)])
    mean, sd = _moments(smoothed(theta, one.y))
    family = _family(one.build(**theta))

    def predicted(y: np.ndarray, held: np.ndarray, key: jax.Array) -> tuple[np.ndarray, np.ndarray]:
        m, s = (a[held][:, None] for a in _moments(smoothed(theta, y)))
        density = np.asarray(_densities(family, jnp.asarray(m + s * NODES), jnp.asarray(one.y[held])))
        return (np.log(density @ (WEIGHTS / WEIGHTS.sum())),
                m + s * np.asarray(jax.random.normal(key, (held.sum(), DRAWN))))

    return {"log evidence": log_z, "mean": mean, "sd": sd, "seconds": seconds / REPEATS,
            **held_out(task, one, family, predicted)}


def _reference(task: Task, one: Problem, theta: dict[str, float]) -> Result:
    draws = task.settings["draws"]
    system = one.build(**theta)
    family = _family(system)
    reference = Reference(system, one.times, one.sites)
    key, fold_key = jax.random.split(task.key)
    seconds, found = timed(lambda: reference.sample(key, one.y, draws))
    weighed = reference.weigh(jax.random.fold_in(key, 1), one.y, draws)

    def predicted(y: np.ndarray, held: np.ndarray, key: jax.Array) -> tuple[np.ndarray, np.ndarray]:
        f = reference.sample(jax.random.fold_in(fold_key, int(held.argmax())), y, max(draws // 5, 100))
        f = f.reshape(-1, f.shape[-1])[:, held].T
        density = np.asarray(_densities(family, jnp.asarray(f), jnp.asarray(one.y[held])))
        return np.log(density.mean(axis=1)), f[:, np.linspace(0, f.shape[1] - 1, DRAWN).astype(int)]

    return {"log evidence": weighed.log_evidence, "log evidence error": weighed.error, "share": weighed.share,
            "mean": found.mean(axis=(0, 1)), "sd": found.std(axis=(0, 1)), "seconds": seconds,
            **scores_of_chains(found), **held_out(task, one, family, predicted)}


def _family(model: lfm.LatentForceModel) -> ObservationFamily:
    assert isinstance(model.observation, ObservationFamily)
    return model.observation


def scores_of_chains(draws: np.ndarray) -> Result:
    """Return the smallest effective sample size and the largest R-hat of the predictor's entries."""
    rows = np.unique(np.linspace(0, draws.shape[-1] - 1, 40).astype(int))
    found = scores.diagnose([str(row) for row in rows], np.moveaxis(draws[..., rows], -1, 0))
    return {"ess": float(found["ess"].min()), "r_hat": float(found["r_hat"].max())}


def held_out(task: Task, one: Problem, family: ObservationFamily, predicted: Callable) -> Result:
    """Predict each fold from the others.

    Args:
        task: whose key is that of the draws.
        one: the problem.
        family: of the data.
        predicted: from data (T, 1), which rows are held out (T,), and a key to their log predictive densities (K,) and
            draws of their predictor (K, S).

    Returns:
        ``log density`` (T,) of each entry, held out, and ends ``low`` and ``high`` (T,) of its 95% interval.
    """
    density, low, high = (np.full(len(one.y), np.nan) for _ in range(3))
    for fold in range(int(one.folds.max()) + 1):
        held = one.folds == fold
        key, sample_key = jax.random.split(jax.random.fold_in(task.key, fold))
        density[held], f = predicted(np.where(held[:, None], np.nan, one.y), held, key)
        y = np.asarray(family.sample(sample_key, jnp.asarray(f)))
        low[held], high[held] = np.quantile(y, (0.025, 0.975), axis=1)
    return {"log density": density, "low": low, "high": high}


def _moments(found: tuple[jax.Array, jax.Array]) -> tuple[np.ndarray, np.ndarray]:
    """Return means and sds (T,); NaN where a variance is not positive: sites that did not converge."""
    mean, variance = (np.asarray(a) for a in found)
    valid = variance > 0
    return np.where(valid, mean, np.nan), np.sqrt(np.where(valid, variance, np.nan))


def _densities(family: ObservationFamily, f: jax.Array, y: jax.Array) -> jax.Array:
    """Return p(y | f) (K, S) of entries (K, 1) at predictors (K, S)."""
    return jnp.exp(family.log_prob(f, y))
