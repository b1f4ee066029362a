"""Methods for a problem: log evidence, posterior of the predictor, and predictions of held-out data.

1. Learn the parameters once by maximising the posterior density with the evidence of expectation propagation, or take
   the true ones (`learn_parameters`). All methods use the same parameters.
2. Approximate the posterior of the predictor by Gaussian factors: expectation propagation, variational, or Laplace.
3. Sample it exactly for reference: importance sampling for the evidence, elliptical slices for the moments.
4. Hold out each fold in turn, and score its data under the predictive distribution given the other folds.
5. Compare every method with the reference (`compare_methods`).

Source: Nickisch, Solin and Grigorevskiy (ICML 2018), section 4.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.parallel.task import Result, Task
from lfm_ppl.utils.random_keys import split_by_name

from .. import scores
from ..datasets import DATASET
from ..declaration import Data
from ..timing import time_call
from .problem import CountsProblem, ProblemSize, build_problem
from .reference import CHAINS, MonteCarloReference

REFERENCE = "reference"

METHODS = {"ep": "EP", "variational": "variational", "laplace": "Laplace", REFERENCE: REFERENCE}
"""Method of `lfm_ppl.FactorSettings`, or the reference -> label in the tables."""

NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(60)
"""Quadrature rule for integrals over the predictor."""

REPEATS, PREDICTIVE_DRAWS = 5, 4000
"""Evaluations of the evidence and its gradient for the mean CPU time, and draws for a predictive interval."""


def learn_parameters(task: Task) -> Result:
    """Return the parameters at the mode of the posterior with the evidence of EP, or the true parameters."""
    problem = _build_task_problem(task)
    if problem.true_parameters is not None:
        return dict(problem.true_parameters)
    mode = lfm.map_estimate(problem.model, problem.times, problem.y, restarts=1)
    if not mode.converged:
        raise ValueError(f"the parameters of {task.settings['problem']} were not found: {mode.message}")
    return {name: float(mode.parameters[name]) for name in problem.priors}


def apply_method(task: Task) -> Result:
    """Return the results of a method with fixed parameters.

    Returns:
        ``log evidence``; ``mean`` and ``sd`` (T,) of the predictor; the entries of `score_held_out`; CPU ``seconds`` of
        one evidence with its gradient, or of all draws. The reference also has ``log evidence error``, the standard
        error; ``share``, the effective sample size of importance sampling as a share of the draws; and the smallest
        ``ess`` and the largest ``r_hat`` over 40 rows.
    """
    method = _apply_reference if task.settings["method"] == REFERENCE else _apply_factors
    return method(task, _build_task_problem(task), dict(task.settings["parameters"]))


def _build_task_problem(task: Task) -> CountsProblem:
    settings = task.settings
    return build_problem(settings["problem"], ProblemSize(*settings["size"]), task.seed, settings["data"])


def _apply_factors(task: Task, problem: CountsProblem, parameters: dict[str, float]) -> Result:
    settings = problem.factors._replace(method=task.settings["method"])

    def likelihood(values: dict[str, Any]) -> lfm.MarginalLikelihood:
        return lfm.MarginalLikelihood(problem.build_model(**values), problem.times, factors=settings)

    evidence = jax.jit(jax.value_and_grad(lambda values, y: likelihood(values).log_prob(y)))

    @jax.jit
    def smooth_predictor(values: dict[str, Any], y: jax.Array) -> tuple[jax.Array, jax.Array]:
        distribution = likelihood(values)
        result, ssm = distribution.smooth(y), distribution.ssm

        def row(mean: jax.Array, covariance: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array]:
            f, jacobian = jax.value_and_grad(lambda s: ssm.observe(ssm.inputs(s, t), t)[0])(mean)
            return f, jacobian @ covariance @ jacobian

        return jax.vmap(row)(result.mean, result.covariance, jnp.asarray(problem.times))

    def moments(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return means and sds (T,); NaN where the factors did not converge, which gives variances of zero or less."""
        mean, variance = map(np.asarray, smooth_predictor(parameters, y))
        return np.where(variance > 0, mean, np.nan), np.sqrt(np.where(variance > 0, variance, np.nan))

    def predict(y: np.ndarray, is_held_out: np.ndarray, key: jax.Array) -> tuple[np.ndarray, ...]:
        m, s = (moment[is_held_out][:, None] for moment in moments(y))
        normal = np.asarray(jax.random.normal(key, (is_held_out.sum(), PREDICTIVE_DRAWS)))
        return m + s * NODES, WEIGHTS / WEIGHTS.sum(), m + s * normal

    log_z = float(evidence(parameters, problem.y)[0])  # compiles, so that the next line measures evaluations only
    seconds, _ = time_call(lambda: [evidence(parameters, problem.y) for _ in range(REPEATS)])
    mean, sd = moments(problem.y)
    return {"log evidence": log_z, "mean": mean, "sd": sd, "seconds": seconds / REPEATS,
            **score_held_out(task.key, task, problem, predict)}


def _apply_reference(task: Task, problem: CountsProblem, parameters: dict[str, float]) -> Result:
    draws = task.settings["draws"]
    reference = MonteCarloReference(problem.build_model(**parameters), problem.times, problem.factors)
    keys = split_by_name(task.key, ("sampler", "weights", "folds"))

    def sample(key: jax.Array, y: np.ndarray, draws: int) -> np.ndarray:
        return np.asarray(reference.sample(key, y, reference.proposal(y), draws))

    seconds, f = time_call(sample, keys["sampler"], problem.y, draws)
    rows = np.unique(np.linspace(0, len(problem.y) - 1, 40).astype(int))
    diagnostics = scores.diagnose([str(row) for row in rows], np.moveaxis(f[..., rows], -1, 0))
    log_weight = np.asarray(reference.log_weights(keys["weights"], problem.y,
                                                  reference.proposal(problem.y), CHAINS * draws))
    weight = np.exp(log_weight - log_weight.max())

    def predict(y: np.ndarray, is_held_out: np.ndarray, key: jax.Array) -> tuple[np.ndarray, ...]:
        f = sample(key, y, max(draws // 5, 100))
        f = f[..., is_held_out].reshape(-1, is_held_out.sum()).T
        columns = np.linspace(0, f.shape[1] - 1, PREDICTIVE_DRAWS).astype(int)
        return f, np.full(f.shape[1], 1.0 / f.shape[1]), f[:, columns]

    return {"log evidence": log_weight.max() + np.log(weight.mean()),
            "log evidence error": weight.std() / weight.mean() / np.sqrt(weight.size),
            "share": weight.sum() ** 2 / (weight**2).sum() / weight.size, "mean": f.mean(axis=(0, 1)),
            "sd": f.std(axis=(0, 1)), "seconds": seconds, "ess": diagnostics["ess"].min(),
            "r_hat": diagnostics["r_hat"].max(),
            **score_held_out(keys["folds"], task, problem, predict)}


def score_held_out(key: jax.Array, task: Task, problem: CountsProblem, predict: Callable) -> Result:
    """Return the ``log density`` (T,) of each row given the other folds, and its 95% interval, ``low`` and ``high``.

    Args:
        key: random key of the draws.
        task: the task.
        problem: the problem.
        predict: map from data (T, 1), a mask (T,) of K held-out rows and a random key to predictors (K, S), their
            weights (S,), and draws of the predictors (K, D).
    """
    family: Any = problem.build_model(**task.settings["parameters"]).observation
    density, low, high = (np.full(len(problem.y), np.nan) for _ in range(3))
    for fold, fold_key in enumerate(jax.random.split(key, int(problem.folds.max()) + 1)):
        is_held_out = problem.folds == fold
        keys = split_by_name(fold_key, ("predictors", "data"))
        f, weights, draws = predict(np.where(is_held_out[:, None], np.nan, problem.y), is_held_out, keys["predictors"])
        log_density = family.log_prob(jnp.asarray(f), jnp.asarray(problem.y[is_held_out]))
        density[is_held_out] = np.log(np.exp(np.asarray(log_density)) @ weights)
        y = np.asarray(family.sample(keys["data"], jnp.asarray(draws)))
        low[is_held_out], high[is_held_out] = np.quantile(y, (0.025, 0.975), axis=1)
    return {"log density": density, "low": low, "high": high}


def compare_methods(settings: Any, data: Data, name: str) -> xr.Dataset:
    """Return the results of all methods for a problem, with their errors against the reference.

    Returns:
        The stored results, with ``times`` and ``y`` (dataset), and

        - ``inside`` (method, dataset): whether a held-out value is in its interval; absent for binary data;
        - ``covered`` (method): share of the true predictor in 95% bands; absent where the truth is unknown;
        - ``excess``: log evidence minus that of the reference, with its standard error ``excess error``;
        - ``excess NLPD`` (dataset): negative log predictive density minus that of the reference;
        - ``mean error``: largest error of the predictor's means, in posterior sds;
        - ``sd error``: largest relative error of its sds.

        Differences from the reference are NaN for the reference itself.
    """
    problem = build_problem(name, settings.size, settings.seed, settings.data)
    # Remove the padding of shorter data. Remaining NaN show factors that did not converge, and must stay visible.
    results = data["comparison"].sel(problem=name, drop=True).isel({DATASET: slice(len(problem.times))})
    results = results.assign(times=(DATASET, problem.times), y=(DATASET, problem.y[:, 0]))
    reference = results.sel({"method": REFERENCE}, drop=True)
    approximations = results.where(results.method != REFERENCE)
    if name != "bernoulli":
        results["inside"] = (results["low"] <= results["y"]) & (results["y"] <= results["high"])
    if (truth := problem.truth) is not None:
        reach = scores.Z * results["sd"]
        is_covered = (results["mean"] - reach <= truth) & (truth <= results["mean"] + reach)
        results["covered"] = is_covered.mean(DATASET)
    mean_error = (approximations["mean"] - reference["mean"]) / reference["sd"]
    sd_error = approximations["sd"] / reference["sd"] - 1.0
    return results.assign({
        "excess": approximations["log evidence"] - reference["log evidence"],
        "excess error": reference["log evidence error"].where(results.method != REFERENCE),
        "excess NLPD": reference["log density"] - approximations["log density"],
        "mean error": abs(mean_error).max(DATASET, skipna=False), "sd error": abs(sd_error).max(DATASET, skipna=False)})
