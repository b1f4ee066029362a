"""Approximations of kernels: errors of their covariance functions, and predictions of random functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from scipy.stats import norm

from lfm_ppl import forces
from lfm_ppl.forces import Force, PeriodicCovariance
from lfm_ppl.forces.quasi_periodic import significant_functions
from lfm_ppl.parallel.task import Result, Task

from .. import scores
from ..tasks import stack_results
from . import problem
from .problem import MEASURED, PREDICTED
from .resonators import resonators
from .sparse_spectrum import SparseSpectrum, random_frequencies

EIGENFUNCTIONS, RESONATORS, RANDOM = METHODS = ("eigenfunctions", "resonators", "sparse spectrum")
"""Methods whose covariance functions are compared for each number of functions."""

EXACT, KPCA, COARSE = "exact", "22 eigenfunctions", "20 eigenfunctions on 20 points"
SPARSE, SPARSE_4 = "sparse spectrum, 22 frequencies", "sparse spectrum, 88 frequencies"
PREDICTORS = {EXACT: 0, SPARSE: 22, SPARSE_4: 88, KPCA: 22, COARSE: 20}
"""Approximation of the squared exponential -> number of eigenfunctions or frequencies."""


def covariance_errors(task: Task) -> Result:
    """Return the largest covariance error of each method for each number of functions; NaN if it does not apply.

    Errors of the sparse spectrum are means over draws of its frequencies; each frequency gives two functions, a cosine
    and a sine. ``left out`` is the mean variance outside the eigenfunctions. ``significant`` is the number of
    eigenfunctions at the default gamma, and ``at default`` their error.
    """
    name, draws = task.settings["kernel"], task.settings["draws"]
    kernel = problem.kernels()[name]
    times, exact = problem.covariance_on_grid(kernel)
    spectrum = problem.window_prior() if name == problem.NOT_PERIODIC else kernel if kernel.stationary else None

    def errors(count: int) -> Result:
        force, size = eigenfunctions(kernel, count), max(1, count // 2)
        row = {EIGENFUNCTIONS: covariance_error(force, times, exact), RESONATORS: np.nan, RANDOM: np.nan,
               "left out": np.mean(np.diag(exact) - force.sde_covariance(times, times))}
        if kernel.stationary:
            # Without noise and damping a resonator's covariance depends on the distance in time alone.
            covariance = resonators(kernel, count, explained_variance=0.0).covariance(times)
            row[RESONATORS] = np.abs(covariance - exact[:, 0]).max()
        if spectrum is not None:
            frequencies = random_frequencies(jax.random.fold_in(task.key, count), spectrum, size * draws)
            row[RANDOM] = _random_frequency_errors(np.reshape(frequencies, (draws, size)), times, exact).mean()
        return row

    significant = significant_functions(kernel)
    return stack_results([errors(feasible_count(kernel, count)) for count in task.settings["functions"]]) | {
        "significant": significant, "at default": covariance_error(eigenfunctions(kernel, significant), times, exact)}


def quadrature_errors(task: Task) -> Result:
    """Return the ``error`` of at most 22 eigenfunctions on the window for each number of quadrature points.

    ``sparse 22`` and ``sparse 88`` (100,) are the errors of draws of 22 and 88 frequencies.
    """
    kernel = problem.window_kernel()
    times, exact = problem.covariance_on_grid(kernel)
    result = {"error": np.asarray([covariance_error(eigenfunctions(kernel, min(22, points), points), times, exact)
                                   for points in task.settings["points"]])}
    for count in (22, 88):
        key = jax.random.fold_in(task.key, count)
        frequencies = np.stack([random_frequencies(jax.random.fold_in(key, index), problem.window_prior(), count)
                                for index in range(100)])
        result[f"sparse {count}"] = _random_frequency_errors(frequencies, times, exact)
    return result


def feasible_count(kernel: PeriodicCovariance, count: int) -> int:
    """Return the number of functions, odd for a stationary kernel: a constant, and pairs of a cosine and a sine."""
    return count - (count + 1) % 2 if kernel.stationary else count


def eigenfunctions(kernel: PeriodicCovariance, count: int, points: int = 200) -> forces.Periodic:
    """Return the force with ``count`` eigenfunctions, or with all if the kernel has fewer."""
    return forces.Periodic(kernel, functions=feasible_count(kernel, count), points=points, explained_variance=0.0)


def covariance_error(force: Force, times: np.ndarray, exact: np.ndarray) -> float:
    """Return the largest difference between the covariance of a force with eigenfunctions and the exact one."""
    return float(np.abs(np.asarray(force.sde_covariance(times[:, None], times)) - exact).max())


def _random_frequency_errors(frequencies: np.ndarray, times: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return the largest error (D,) of each of D draws of frequencies (D, S), whose covariance is a mean of cosines."""
    return np.abs(np.cos(times[:, None, None] * frequencies).mean(axis=-1) - exact[:, :1]).max(axis=0)


def draw_functions(seed: int, runs: int) -> np.ndarray:
    """Return values (runs, n + K) of random functions at the measured and the predicted times."""
    times = np.concatenate([MEASURED, PREDICTED])
    values, vectors = np.linalg.eigh(_squared_exponential(times[:, None], times))
    draws = np.random.default_rng((seed, 5)).normal(size=(runs, len(times)))
    return (draws * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def predict_functions(task: Task) -> Result:
    """Return the root mean squared error, log likelihood and coverage of every function, and the first prediction.

    The log likelihood is the sum of the log densities of the predicted points.
    """
    method, runs = task.settings["method"], task.settings["runs"]
    data, truth = np.split(draw_functions(task.seed, runs), [len(MEASURED)], axis=1)
    fixed_prior = None if "sparse" in method else prior_covariances(task, method, 0)
    posteriors = [condition(fixed_prior or prior_covariances(task, method, index), data[index])
                  for index in range(runs)]
    mean, variance = map(np.stack, zip(*posteriors, strict=True))
    density = norm.logpdf(truth, mean, np.sqrt(variance))
    return {"rmse": scores.rmse(mean, truth), "log likelihood": density.sum(axis=1),
            "coverage": scores.interval_coverage(*scores.interval(mean, np.sqrt(variance)), truth),
            "mean": mean[0], "variance": variance[0]}


def approximation(method: str, key: jax.Array) -> Force:
    """Return the force of a method; a sparse spectrum has random frequencies."""
    if "sparse" in method:
        return SparseSpectrum(1.0, random_frequencies(key, problem.window_prior(), PREDICTORS[method]))
    return eigenfunctions(problem.window_kernel(), PREDICTORS[method], 20 if method == COARSE else 200)


def prior_covariances(task: Task, method: str, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the covariance at the measured times, the cross-covariance (K, n) and the variances at predicted times.

    A sparse spectrum has new frequencies for each function ``index``.
    """
    covariance: Callable[..., Any] = _squared_exponential
    if method != EXACT:
        force = approximation(method, jax.random.fold_in(task.key, index))
        covariance = force.covariance if "sparse" in method else force.sde_covariance
    return (np.asarray(covariance(MEASURED[:, None], MEASURED)), np.asarray(covariance(PREDICTED[:, None], MEASURED)),
            np.asarray(covariance(PREDICTED, PREDICTED)))


def condition(prior: tuple[np.ndarray, np.ndarray, np.ndarray], data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance (K,) at the predicted times given measurements (n,)."""
    measured, cross, variance = prior
    gain = np.linalg.solve(measured + problem.NUGGET * np.eye(len(measured)), cross.T).T
    return gain @ data, np.maximum(variance - (gain * cross).sum(axis=1), 0.0) + problem.NUGGET


def _squared_exponential(t: np.ndarray, s: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * ((t - s) / problem.LENGTHSCALE) ** 2)
