"""What each method makes of a problem: the log evidence, the predictor's posterior, predictions of held-out data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.counts import problem
from lfm_ppl.experiments.counts.reference import CHAINS, Reference
from lfm_ppl.experiments.datasets import DATASET
from lfm_ppl.experiments.study import Data
from lfm_ppl.experiments.timing import time_call
from lfm_ppl.inference.map import map_estimate

REFERENCE = "reference"

METHODS = {"ep": "EP", "variational": "variational", "laplace": "Laplace", REFERENCE: REFERENCE}
"""Those of sites, by what `lfm_ppl.SiteSettings` calls them, and the reference -> the name of a row."""

NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(60)
"""Of the integral of a density over the predictor."""

REPEATS, DRAWN = 5, 4000
"""Evidences with gradient over which the time is averaged; predictive draws whose quantiles are an interval."""


def learn(task: Task) -> Result:
    """Return the parameters at the mode of the posterior with EP's evidence."""
    one = _problem(task)
    if one.given is not None:
        return dict(one.given)
    found = map_estimate(one.model, one.times, one.y, restarts=1)
    if not found.converged:
        raise ValueError(f"the parameters of {task.settings['problem']} were not found: {found.message}")
    return {name: float(found.parameters[name]) for name in one.priors}


def compute(task: Task) -> Result:
    """Return what a method finds, with parameters that are given.

    Returns:
        ``log evidence``; ``mean`` and ``sd`` (T,) of the predictor; the entries of `held_out`; CPU ``seconds`` of an
        evidence with its gradient, or of all draws. Of the reference, too: ``log evidence error``, the standard error;
        ``share``, the effective one of importance samples; the least ``ess`` and the largest ``r_hat`` of 40 entries.
    """
    judge = _reference if task.settings["method"] == REFERENCE else _sites
    return judge(task, _problem(task), dict(task.settings["parameters"]))


def _problem(task: Task) -> problem.Problem:
    given = task.settings
    return problem.problem(given["problem"], problem.Size(*given["size"]), task.seed, given["data"])


def _sites(task: Task, one: problem.Problem, theta: dict[str, float]) -> Result:
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

    def moments(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return means and sds (T,); NaN where a variance is not positive: sites that did not converge."""
        mean, variance = map(np.asarray, smoothed(theta, y))
        return np.where(variance > 0, mean, np.nan), np.sqrt(np.where(variance > 0, variance, np.nan))

    def predicted(y: np.ndarray, held: np.ndarray, key: jax.Array) -> tuple[np.ndarray, ...]:
        m, s = (moment[held][:, None] for moment in moments(y))
        normal = np.asarray(jax.random.normal(key, (held.sum(), DRAWN)))
        return m + s * NODES, WEIGHTS / WEIGHTS.sum(), m + s * normal

    log_z = float(evidence(theta, one.y)[0])  # compiled here
    seconds, _ = time_call(lambda: [evidence(theta, one.y) for _ in range(REPEATS)])
    mean, sd = moments(one.y)
    return {"log evidence": log_z, "mean": mean, "sd": sd, "seconds": seconds / REPEATS,
            **held_out(task, one, predicted)}


def _reference(task: Task, one: problem.Problem, theta: dict[str, float]) -> Result:
    draws, reference = task.settings["draws"], Reference(one.build(**theta), one.times, one.sites)
    key, fold_key = jax.random.split(task.key)

    def sampled(key: jax.Array, y: np.ndarray, draws: int) -> np.ndarray:
        return np.asarray(reference.sample(key, y, reference.proposal(y), draws))

    seconds, f = time_call(sampled, key, one.y, draws)
    rows = np.unique(np.linspace(0, len(one.y) - 1, 40).astype(int))
    checked = scores.diagnose([str(row) for row in rows], np.moveaxis(f[..., rows], -1, 0))
    log_weight = np.asarray(reference.log_weights(jax.random.fold_in(key, 1), one.y, reference.proposal(one.y),
                                                  CHAINS * draws))
    weight = np.exp(log_weight - log_weight.max())

    def predicted(y: np.ndarray, held: np.ndarray, key: jax.Array) -> tuple[np.ndarray, ...]:
        f = sampled(jax.random.fold_in(fold_key, int(held.argmax())), y, max(draws // 5, 100))
        f = f[..., held].reshape(-1, held.sum()).T
        spread = np.linspace(0, f.shape[1] - 1, DRAWN).astype(int)
        return f, np.full(f.shape[1], 1.0 / f.shape[1]), f[:, spread]

    return {"log evidence": log_weight.max() + np.log(weight.mean()),
            "log evidence error": weight.std() / weight.mean() / np.sqrt(weight.size),
            "share": weight.sum() ** 2 / (weight**2).sum() / weight.size, "mean": f.mean(axis=(0, 1)),
            "sd": f.std(axis=(0, 1)), "seconds": seconds, "ess": checked["ess"].min(), "r_hat": checked["r_hat"].max(),
            **held_out(task, one, predicted)}


def held_out(task: Task, one: problem.Problem, predicted: Callable) -> Result:
    """Return the ``log density`` (T,) of each entry given the other folds, and its 95% interval, ``low`` and ``high``.

    Args:
        task: whose key is that of the draws.
        one: the problem.
        predicted: from data (T, 1), which K rows are held out (T,), and a key, to predictors (K, S), their weights
            (S,), and draws of predictors (K, D).
    """
    family: Any = one.build(**task.settings["parameters"]).observation
    density, low, high = (np.full(len(one.y), np.nan) for _ in range(3))
    for fold in range(int(one.folds.max()) + 1):
        held = one.folds == fold
        key, sample_key = jax.random.split(jax.random.fold_in(task.key, fold))
        f, weights, draws = predicted(np.where(held[:, None], np.nan, one.y), held, key)
        log_density = family.log_prob(jnp.asarray(f), jnp.asarray(one.y[held]))
        density[held] = np.log(np.exp(np.asarray(log_density)) @ weights)
        y = np.asarray(family.sample(sample_key, jnp.asarray(draws)))
        low[held], high[held] = np.quantile(y, (0.025, 0.975), axis=1)
    return {"log density": density, "low": low, "high": high}


def compared(settings: Any, data: Data, name: str) -> xr.Dataset:
    """Return the results of all methods for a problem, with what they are judged by.

    Returns:
        What is stored, with ``times`` and ``y`` (dataset), and ``inside`` (method, dataset): whether a held-out value
        is in its interval; left out where all are yes or no. ``covered`` (method): share of the true predictor in 95%
        bands; left out where nobody knows it. Less the reference's, and NaN for the reference itself: ``excess`` of the
        log evidence, with ``excess error``, the standard error; ``excess NLPD`` (dataset); ``mean error``, the largest
        of the predictor's means in posterior sds; ``sd error``, that of its sds, as a share.
    """
    one = problem.problem(name, settings.size, settings.seed, settings.data)
    # What fills up shorter data is cut off: NaN that are left are sites that did not converge, and must show.
    found = data["comparison"].sel(problem=name, drop=True).isel({DATASET: slice(len(one.times))})
    found = found.assign(times=(DATASET, one.times), y=(DATASET, one.y[:, 0]))
    exact, other = found.sel({"method": REFERENCE}, drop=True), found.where(found.method != REFERENCE)
    if name != "bernoulli":
        found["inside"] = (found["low"] <= found["y"]) & (found["y"] <= found["high"])
    if one.truth is not None:
        reach = scores.Z * found["sd"]
        found["covered"] = ((found["mean"] - reach <= one.truth) & (one.truth <= found["mean"] + reach)).mean(DATASET)
    away, wider = (other["mean"] - exact["mean"]) / exact["sd"], other["sd"] / exact["sd"] - 1.0
    return found.assign({
        "excess": other["log evidence"] - exact["log evidence"],
        "excess error": exact["log evidence error"].where(found.method != REFERENCE),
        "excess NLPD": exact["log density"] - other["log density"],
        "mean error": abs(away).max(DATASET, skipna=False), "sd error": abs(wider).max(DATASET, skipna=False)})
