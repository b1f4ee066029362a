"""Approximations of kernels: errors of their covariance functions, and predictions of functions that are drawn."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from scipy.stats import norm

from lfm_ppl import forces
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.periodic_kernels import problem
from lfm_ppl.experiments.periodic_kernels.problem import MEASURED, PREDICTED
from lfm_ppl.experiments.tasks import stack_results
from lfm_ppl.forces import Force, PeriodicCovariance, random_frequencies

EIGENFUNCTIONS, RESONATORS, RANDOM = METHODS = ("eigenfunctions", "resonators", "sparse spectrum")
"""Whose covariance functions are compared, by the number of functions."""

EXACT, KPCA, COARSE = "exact", "22 eigenfunctions", "20 eigenfunctions on 20 points"
SPARSE, SPARSE_4 = "sparse spectrum, 22 frequencies", "sparse spectrum, 88 frequencies"
PREDICTING = {EXACT: 0, SPARSE: 22, SPARSE_4: 88, KPCA: 22, COARSE: 20}
"""What predicts functions of the squared exponential -> its number of eigenfunctions or frequencies."""


def covariance_errors(task: Task) -> Result:
    """Return the largest error of each method for each number of functions; NaN where there is none such.

    Those of the sparse spectrum are means over draws of its frequencies, of which two functions, a cosine and a sine,
    come from each; ``left out`` is the variance that the eigenfunctions do not have, and ``significant`` their number
    at the default gamma, with its error.
    """
    name, draws = task.settings["kernel"], task.settings["draws"]
    kernel = problem.kernels()[name]
    at, exact = problem.on_grid(kernel)
    spectrum = problem.window_prior() if name == problem.NOT_PERIODIC else kernel if kernel.stationary else None

    def errors(count: int) -> Result:
        force, size = eigenfunctions(kernel, count), max(1, count // 2)
        found = {EIGENFUNCTIONS: error(force, at, exact), RESONATORS: np.nan, RANDOM: np.nan,
                 "left out": np.mean(np.diag(exact) - force.sde_covariance(at, at))}
        if kernel.stationary:
            # Without noise and damping a resonator's covariance depends on the distance in time alone.
            covariance = forces.resonators(kernel, count, explained_variance=0.0).covariance(at)
            found[RESONATORS] = np.abs(covariance - exact[:, 0]).max()
        if spectrum is not None:
            frequencies = random_frequencies(jax.random.fold_in(task.key, count), spectrum, size * draws)
            found[RANDOM] = _of_random(np.reshape(frequencies, (draws, size)), at, exact).mean()
        return found

    significant = forces.significant_functions(kernel)
    return stack_results([errors(fitting(kernel, count)) for count in task.settings["functions"]]) | {
        "significant": significant, "at default": error(eigenfunctions(kernel, significant), at, exact)}


def quadrature_errors(task: Task) -> Result:
    """Return the ``error`` of 22 eigenfunctions on the window, or as many as there are, by the number of points.

    ``sparse 22`` and ``sparse 88`` (100,) are the errors of draws of so many frequencies.
    """
    kernel = problem.window_kernel()
    at, exact = problem.on_grid(kernel)
    found = {"error": np.asarray([error(eigenfunctions(kernel, min(22, points), points), at, exact)
                                  for points in task.settings["points"]])}
    for count in (22, 88):
        key = jax.random.fold_in(task.key, count)
        frequencies = np.stack([random_frequencies(jax.random.fold_in(key, index), problem.window_prior(), count)
                                for index in range(100)])
        found[f"sparse {count}"] = _of_random(frequencies, at, exact)
    return found


def fitting(kernel: PeriodicCovariance, count: int) -> int:
    """Return the number of functions; of a stationary kernel, which has pairs, one less if even."""
    return count - (count + 1) % 2 if kernel.stationary else count


def eigenfunctions(kernel: PeriodicCovariance, count: int, points: int = 200) -> forces.Periodic:
    """Return the force of so many eigenfunctions, as far as the kernel has them."""
    return forces.Periodic(kernel, functions=fitting(kernel, count), points=points, explained_variance=0.0)


def error(force: Force, at: np.ndarray, exact: np.ndarray) -> float:
    """Return the largest difference between the covariance of a force with eigenfunctions and the exact one."""
    return float(np.abs(np.asarray(force.sde_covariance(at[:, None], at)) - exact).max())


def _of_random(frequencies: np.ndarray, at: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return the largest error (D,) of each of D draws of frequencies (D, S), whose covariance is a mean of cosines."""
    return np.abs(np.cos(at[:, None, None] * frequencies).mean(axis=-1) - exact[:, :1]).max(axis=0)


def functions(seed: int, runs: int) -> np.ndarray:
    """Return values (runs, n + K) of functions at the measured and the predicted times."""
    times = np.concatenate([MEASURED, PREDICTED])
    values, vectors = np.linalg.eigh(_exact(times[:, None], times))
    draws = np.random.default_rng((seed, 5)).normal(size=(runs, len(times)))
    return (draws * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def predictions(task: Task) -> Result:
    """Return the root mean squared error, log likelihood and coverage of every function, and the first prediction.

    The log likelihood is the sum of the log densities of the predicted points.
    """
    method, runs = task.settings["method"], task.settings["runs"]
    data, truth = np.split(functions(task.seed, runs), [len(MEASURED)], axis=1)
    fixed = None if "sparse" in method else covariances(task, method, 0)
    mean, variance = (np.stack(rows) for rows in zip(*(
        predict(fixed or covariances(task, method, index), data[index]) for index in range(runs)), strict=True))
    density = norm.logpdf(truth, mean, np.sqrt(variance))
    return {"rmse": scores.rmse(mean, truth), "log likelihood": density.sum(axis=1),
            "coverage": scores.interval_coverage(*scores.interval(mean, np.sqrt(variance)), truth),
            "mean": mean[0], "variance": variance[0]}


def approximation(method: str, key: jax.Array) -> Force:
    """Return the force of a method; the frequencies of a sparse spectrum are drawn."""
    if "sparse" in method:
        return forces.SparseSpectrum(1.0, random_frequencies(key, problem.window_prior(), PREDICTING[method]))
    return eigenfunctions(problem.window_kernel(), PREDICTING[method], 20 if method == COARSE else 200)


def covariances(task: Task, method: str, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the prior covariances: of the measured times, of predicted and measured ones, and variances.

    Frequencies are drawn anew for each function ``index``.
    """
    between: Callable[..., Any] = _exact
    if method != EXACT:
        force = approximation(method, jax.random.fold_in(task.key, index))
        between = force.covariance if "sparse" in method else force.sde_covariance
    return (np.asarray(between(MEASURED[:, None], MEASURED)), np.asarray(between(PREDICTED[:, None], MEASURED)),
            np.asarray(between(PREDICTED, PREDICTED)))


def predict(prior: tuple[np.ndarray, np.ndarray, np.ndarray], data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance (K,) at the predicted times given measurements (n,)."""
    measured, cross, variance = prior
    gain = np.linalg.solve(measured + problem.NUGGET * np.eye(len(measured)), cross.T).T
    return gain @ data, np.maximum(variance - (gain * cross).sum(axis=1), 0.0) + problem.NUGGET


def _exact(t: np.ndarray, s: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * ((t - s) / problem.LENGTHSCALE) ** 2)
