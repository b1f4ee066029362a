"""Functions drawn from a Gaussian process, measured every 10 units, and predicted by each approximation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.stats import norm

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.periodic_kernels import problem
from lfm_ppl.experiments.periodic_kernels.covariance import eigenfunctions
from lfm_ppl.forces import SparseSpectrum, random_frequencies

EXACT, KPCA, COARSE = "exact", "22 eigenfunctions", "20 eigenfunctions on 20 points"
SPARSE, SPARSE_4 = "sparse spectrum, 22 frequencies", "sparse spectrum, 88 frequencies"
METHODS = {EXACT: 0, SPARSE: 22, SPARSE_4: 88, KPCA: 22, COARSE: 20}


class Prediction(NamedTuple):
    """Mean and variance (K,) of a function at the predicted times."""

    mean: np.ndarray
    variance: np.ndarray


def tasks(settings: Any) -> list[Task]:
    """Return one task for each method; all have the same functions."""
    return [Task(f"regression/{name.replace(' ', '_').replace(',', '')}", settings.seed,
                 {"what": "regression", "method": name, "runs": settings.runs}) for name in METHODS]


def functions(seed: int, runs: int) -> np.ndarray:
    """Return values (runs, n + K) of functions at the measured and the predicted times."""
    times = np.concatenate([problem.measured(), problem.predicted()])
    values, vectors = np.linalg.eigh(_exact(times[:, None], times))
    draws = np.random.default_rng((seed, 5)).normal(size=(runs, len(times)))
    return (draws * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def compute(task: Task) -> Result:
    """Return the root mean squared error, log likelihood and coverage of every function, and the first prediction.

    The log likelihood is the sum of the log densities of the predicted points.
    """
    method, runs = task.settings["method"], task.settings["runs"]
    data, truth = np.split(functions(task.seed, runs), [len(problem.measured())], axis=1)
    fixed = covariances(task, method, 0) if METHODS[method] == 0 or "sparse" not in method else None
    found = [predict(fixed or covariances(task, method, index), data[index]) for index in range(runs)]
    mean, variance = np.stack([one.mean for one in found]), np.stack([one.variance for one in found])
    density = norm.logpdf(truth, mean, np.sqrt(variance))
    return {"rmse": np.sqrt(np.mean((truth - mean) ** 2, axis=1)), "log likelihood": density.sum(axis=1),
            "coverage": np.mean(np.abs(truth - mean) < scores.Z * np.sqrt(variance), axis=1),
            "mean": mean[0], "variance": variance[0]}


def covariances(task: Task, method: str, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the prior covariances: of the measured times, of predicted and measured ones, and variances."""
    here, there = problem.measured(), problem.predicted()
    between: Callable[..., Any]
    if method == EXACT:
        between = _exact
    elif "sparse" in method:
        key = jax.random.fold_in(task.key, index)
        frequencies = np.asarray(random_frequencies(key, problem.window_prior(), METHODS[method]))
        between = SparseSpectrum(1.0, frequencies).covariance
    else:
        points = 20 if method == COARSE else 200
        between = eigenfunctions(problem.window_kernel(), METHODS[method], points).sde_covariance
    return (np.asarray(between(here[:, None], here)), np.asarray(between(there[:, None], here)),
            np.asarray(between(there, there)))


def predict(prior: tuple[np.ndarray, np.ndarray, np.ndarray], data: np.ndarray) -> Prediction:
    """Condition a Gaussian process on measurements (n,)."""
    own, cross, variance = prior
    gain = np.linalg.solve(own + problem.NUGGET * np.eye(len(own)), cross.T).T
    return Prediction(gain @ data, np.maximum(variance - (gain * cross).sum(axis=1), 0.0) + problem.NUGGET)


def _exact(t: np.ndarray, s: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * ((t - s) / problem.LENGTHSCALE) ** 2)
