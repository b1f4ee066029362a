"""How far each approximation's covariance function is from the exact one, by its number of functions."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments.periodic_kernels import problem
from lfm_ppl.forces import Force, Periodic, SparseSpectrum, random_frequencies, resonators, significant_functions
from lfm_ppl.forces.periodic_kernels import Kernel

EIGENFUNCTIONS, RESONATORS, RANDOM = "eigenfunctions", "resonators", "sparse spectrum"
METHODS = (EIGENFUNCTIONS, RESONATORS, RANDOM)


def tasks(settings: Any) -> list[Task]:
    """Return one task for each kernel, and one for the grid of the squared exponential on a window."""
    own = {"what": "covariance", "functions": list(settings.functions), "draws": settings.draws}
    found = [Task(f"covariance/{name.replace(' ', '_')}", settings.seed, own | {"kernel": name})
             for name in problem.kernels()]
    return [*found, Task("quadrature", settings.seed, {"what": "quadrature", "points": list(settings.points)})]


def compute(task: Task) -> Result:
    """Return the largest error of each method for each number of functions; NaN where there is none such.

    Those of the sparse spectrum are means over draws of its frequencies, of which two functions, a cosine and a sine,
    come from each; ``left out`` is the variance that the eigenfunctions do not have, and ``significant`` their number
    at the default gamma, with its error.
    """
    kernel = problem.kernels()[task.settings["kernel"]]
    at = problem.grid(kernel)
    exact = np.asarray(kernel(at[:, None], at))
    most = task.settings["functions"][-1]
    own = leading_parts(eigenfunctions(kernel, most), at)
    found: dict[str, list] = {method: [] for method in (*METHODS, "left out")}
    # The force of fewer functions is the sum of the first parts of the one with the most.
    other = ([np.asarray(one.covariance(at, 0.0))
              for one in resonators(kernel, own.shape[1], explained_variance=0.0).forces] if kernel.stationary else [])
    for count in task.settings["functions"]:
        count = fitting(kernel, count)
        covariance = own[:, :count] @ own[:, :count].T
        found[EIGENFUNCTIONS].append(np.abs(covariance - exact).max())
        found["left out"].append((np.diag(exact) - np.diag(covariance)).mean())
        # Without noise and damping a resonator's covariance depends on the distance in time alone.
        found[RESONATORS].append(np.abs(sum(other[:1 + count // 2]) - exact[:, 0]).max() if other else np.nan)
        found[RANDOM].append(_random(task, kernel, count, at, exact))
    significant = significant_functions(kernel)
    return {name: np.asarray(values) for name, values in found.items()} | {
        "significant": significant, "at default": error(eigenfunctions(kernel, significant), at, exact)}


def fitting(kernel: Kernel, count: int) -> int:
    """Return the number of functions; of a stationary kernel, which has pairs, one less if even."""
    return count - (count + 1) % 2 if kernel.stationary else count


def leading_parts(force: Periodic, at: np.ndarray) -> np.ndarray:
    """Return ``sqrt(mu_j) phi_j`` at times (K, J), the largest first and the two of a pair side by side."""
    parts = np.asarray(force.eigenfunctions(at)) * np.sqrt(np.maximum(np.asarray(force.eigenvalues()), 0.0))
    pairs = force.functions // 2
    order = [0, *np.stack([np.arange(pairs), pairs + np.arange(pairs)], axis=1).ravel() + 1]
    return parts[:, order] if force.kernel.stationary else parts


def eigenfunctions(kernel: Kernel, count: int, points: int = 200) -> Periodic:
    """Return the force of so many eigenfunctions, as far as the kernel has them."""
    return Periodic(kernel, functions=fitting(kernel, count), points=points, explained_variance=0.0)


def error(force: Force, at: np.ndarray, exact: np.ndarray) -> float:
    """Return the largest difference between the covariance of a force with eigenfunctions and the exact one."""
    return float(np.abs(np.asarray(force.sde_covariance(at[:, None], at)) - exact).max())


def _random(task: Task, kernel: Kernel, count: int, at: np.ndarray, exact: np.ndarray) -> float:
    prior = problem.window_prior() if task.settings["kernel"] == problem.NOT_PERIODIC else kernel
    if isinstance(prior, Kernel) and not prior.stationary:
        return np.nan
    size, draws = max(1, count // 2), task.settings["draws"]
    drawn = np.asarray(random_frequencies(jax.random.fold_in(task.key, count), prior, size * draws))
    return float(np.mean([np.abs(np.cos(at[:, None] * w).mean(axis=1) - exact[:, 0]).max()
                          for w in drawn.reshape(draws, size)]))


def quadrature(task: Task) -> Result:
    """Return the error of 22 eigenfunctions on the window, or as many as there are, by the number of points."""
    kernel = problem.window_kernel()
    at = problem.grid(kernel)
    exact = np.asarray(kernel(at[:, None], at))
    return {"error": np.asarray([error(eigenfunctions(kernel, min(22, points), points), at, exact)
                                 for points in task.settings["points"]]),
            "sparse 22": _published(task, 22, at, exact), "sparse 88": _published(task, 88, at, exact)}


def _published(task: Task, count: int, at: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return the errors of 100 draws of so many frequencies."""
    found = []
    for index in range(100):
        key = jax.random.fold_in(jax.random.fold_in(task.key, count), index)
        force = SparseSpectrum(1.0, random_frequencies(key, problem.window_prior(), count))
        found.append(np.abs(np.asarray(force.covariance(at)) - exact[:, 0]).max())
    return np.asarray(found)
