"""Simulation-based calibration of a sampler on a model.

1. Draw parameters from the prior and data from the model.
2. Sample the posterior, and rank the true parameters and the log likelihood among thinned draws.
3. Many data sets run as tasks; the data sets of a task share one compiled program.
4. Uniform ranks indicate a calibrated sampler (`p_values`).

Source: Talts et al. (2018), arXiv:1804.06788; Modrak et al. (2023), Bayesian Analysis, for the log likelihood.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers
from scipy import stats

from lfm_ppl.inference.bind import bind
from lfm_ppl.likelihoods.likelihood_site import likelihood_site
from lfm_ppl.parallel.cluster import Workers
from lfm_ppl.parallel.run import run_tasks
from lfm_ppl.parallel.task import Task
from lfm_ppl.utils import checks
from lfm_ppl.utils.atomic_files import atomic_write
from lfm_ppl.utils.progress import Reporter

LOG_LIKELIHOOD = "log likelihood"
METHODS = ("vectorized", "sequential")
_SIMULATIONS = 20_000
_BATCH = 25
"""Data sets of a task where there are several."""


@dataclass(frozen=True)
class Calibration:
    """Ranks of true parameters among posterior draws.

    Attributes:
        ranks: name of a scalar -> (data sets,), whole numbers in 0..draws.
        draws: posterior draws that each true value is ranked against.
    """

    ranks: dict[str, np.ndarray]
    draws: int


def calibrate(key: jax.Array, numpyro_model: Callable, times: Any, kernel: Callable, *, data_sets: int = 200,
              draws: int = 63, thin: int = 10, warmup: int = 500, batch: int | None = None, method: str | None = None,
              checkpoint: str | Path | None = None, overwrite: bool = False, report: Reporter | None = None,
              workers: Workers = 1) -> Calibration:
    """Rank true parameters among posterior draws, for many data sets that the model itself generates.

    For parameters theta* drawn from the prior and data drawn from the model at theta*, theta* is one more draw from
    the posterior. Its rank among L independent posterior draws is therefore uniform on 0..L, for every scalar function
    of parameters and data; here every parameter and the log likelihood. A sampler, or an approximate likelihood,
    that is too wide, too narrow or shifted shows in the ranks.

    Args:
        key: a JAX random key.
        numpyro_model: NumPyro model ``model(times, y=None)`` with one likelihood site.
        times: (T,).
        kernel: maps a NumPyro model to an MCMC kernel, such as ``lfm.RAM`` or ``numpyro.infer.NUTS``.
        data_sets: number of replications.
        draws: L. With 63 the 64 possible ranks fall into 2, 4, 8, 16 or 32 bins of equal width.
        thin: steps of the chain between two of these; the draws must be nearly independent.
        warmup: steps before the first.
        batch: data sets that make one task; by default all of them in this process, and 25 where there is a folder or
            there are several workers.
        method: "vectorized", the data sets of a task side by side, or "sequential", one after the other. Side by side
            all of them wait for whichever takes longest, at each step: for its tree with NUTS, and for its factors with
            an observation family or constraints. None: sequential for the latter, vectorized otherwise.
        checkpoint: folder that stores the ranks of each task, from which a stopped run resumes; None: no folder.
        overwrite: compute again what was stored with other settings.
        report: what to do with a line of progress; None: nothing.
        workers: what computes; see `lfm_ppl.parallel.run.run_tasks`.

    Returns:
        The ranks.

    Raises:
        TypeError: ``key`` is no random key.
        ValueError: the model has no likelihood site, a count is not a positive number, the method is unknown, or the
            folder holds ranks that were made with other settings.
        TasksFailedError: some tasks failed; the others are stored.

    Example:
        >>> import jax.numpy as jnp, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> def level(times, y=None):
        ...     system = lfm.LatentForceModel(
        ...         lambda x, u, t: jnp.zeros(1), {}, lfm.GaussianObservation(lambda x, u, t: x, sd=1.0),
        ...         lfm.Gaussian(numpyro.sample("level", dist.Normal())[None], jnp.zeros((1, 1))))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
        >>> found = calibrate(jax.random.key(0), level, [0.0, 1.0], lfm.RAM, data_sets=5, draws=7, warmup=20)
        >>> {name: rank.shape for name, rank in found.ranks.items()}
        {'level': (5,), 'log likelihood': (5,)}

    Source: Talts et al. (2018), Validating Bayesian inference algorithms with simulation-based calibration; Modrak et
    al. (2023), Bayesian Analysis, for the log likelihood as a test quantity.
    """
    checks.random_key(key)
    for name, value in (("data_sets", data_sets), ("draws", draws), ("thin", thin), ("warmup", warmup)):
        checks.positive_integer(name, value)
    if batch is None:
        is_inline = checkpoint is None and isinstance(workers, int) and workers == 1
        batch = data_sets if is_inline else min(_BATCH, data_sets)
    checks.positive_integer("batch", batch)
    if method is not None:
        checks.one_of("method", method, METHODS)
    compute = _Ranks(numpyro_model, np.asarray(times, float), kernel, draws, thin, warmup, batch, method)
    # Raises an error before anything is computed.
    likelihood_site(numpyro_model, (compute.times,), {}, jax.random.key(0))
    truth_keys, chain_keys = (np.asarray(jax.random.key_data(jax.random.split(subkey, data_sets)))
                              for subkey in jax.random.split(key))
    settings = {"key": np.asarray(jax.random.key_data(key)).ravel().tolist(), "times": compute.times.tolist(),
                "model": _name(numpyro_model), "kernel": _name(kernel), "draws": draws, "thin": thin, "warmup": warmup}
    tasks = [Task(f"data-sets/{first:05d}-{min(first + batch, data_sets) - 1:05d}", 0, settings,
                  (truth_keys[first:first + batch], chain_keys[first:first + batch], str(jax.random.key_impl(key))))
             for first in range(0, data_sets, batch)]
    outcomes = run_tasks(tasks, compute, checkpoint, overwrite=overwrite, report=report, workers=workers)
    parts = [outcomes[task.name] for task in tasks]
    return Calibration({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, draws)


@dataclass(eq=False)
class _Ranks:
    """From a task, the keys of some data sets, to the ranks of the true values in them."""

    model: Callable
    times: np.ndarray
    kernel: Callable
    draws: int
    thin: int
    warmup: int
    batch: int
    method: str | None = None

    @functools.cached_property
    def program(self) -> Callable:
        """The compiled function of the keys."""
        model, times = self.model, self.times
        site = likelihood_site(model, (times,), {}, jax.random.key(0))
        bound = bind(model, times, jnp.zeros_like(site.observed))

        def rank_statistics(keys: tuple[jax.Array, jax.Array]) -> dict[str, jax.Array]:
            trace = handlers.trace(handlers.seed(model, keys[0])).get_trace(times)
            y = trace[site.name]["value"]
            truth = {name: trace[name]["value"] for name in bound.sites}
            posterior = _chain(self.kernel(model), (times, y), keys[1], self.draws, self.thin, self.warmup)

            def score(theta: dict[str, jax.Array]) -> jax.Array:
                return bound.likelihood(theta, y).log_prob(y).sum()

            truth[LOG_LIKELIHOOD] = score(truth)
            posterior[LOG_LIKELIHOOD] = jax.lax.map(score, posterior)
            return {n: (posterior[n] < truth[n]).sum(0) for n in truth}

        # By default sequentially if factors take different numbers of iterations.
        method = self.method or ("sequential" if site.example.has_factors else "vectorized")
        # jax.lax.map with a batch size would evaluate both branches of each condition.
        batch_size = self.batch if self.batch > 1 and method == "vectorized" else None
        return jax.jit(lambda keys: jax.lax.map(rank_statistics, keys, batch_size=batch_size))

    def __call__(self, task: Task) -> dict[str, np.ndarray]:
        """Return name of a scalar -> ranks."""
        *keys, kind = task.data
        keys = tuple(jax.random.wrap_key_data(jnp.asarray(key_data), impl=kind) for key_data in keys)
        ranks = jax.device_get(self.program(keys))
        return {f"{name}[{','.join(map(str, index))}]" if index else name: value[:, *index]
                for name, value in ranks.items() for index in np.ndindex(value.shape[1:])}


def _name(function: Callable) -> str:
    return f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', type(function).__name__)}"


def _chain(kernel: Any, arguments: tuple, key: jax.Array, draws: int, thin: int, warmup: int) -> dict[str, jax.Array]:
    # The warm-up goes before the first draw in the same loop: a kernel takes long to compile, and is compiled once.
    counts = jnp.full(draws, thin).at[0].add(warmup)

    def step(state: Any, count: jax.Array) -> tuple[Any, Any]:
        state = jax.lax.fori_loop(0, count, lambda _, s: kernel.sample(s, arguments, {}), state)
        return state, state.z

    _, collected = jax.lax.scan(step, kernel.init(key, warmup, None, arguments, {}), counts)
    return jax.vmap(kernel.postprocess_fn(arguments, {}))(collected)


def p_values(rank: np.ndarray, draws: int, bins: int = 16) -> dict[str, float]:
    """Test that ranks are uniform on 0..draws.

    Args:
        rank: (data sets,).
        draws: largest possible rank.
        bins: of the chi-square statistic; a divisor of draws + 1.

    Returns:
        ``chi-square`` (Pearson's statistic) and ``ecdf`` (the largest distance of the distribution functions), by
        simulation under uniform ranks, so that neither rests on asymptotics.

    Raises:
        ValueError: ``bins`` is no divisor of draws + 1.

    Example:
        >>> low = np.zeros(100, int)
        >>> p_values(low, 63)["chi-square"] < 0.001
        True
    """
    if (draws + 1) % bins:
        raise ValueError(f"{draws} draws give {draws + 1} possible ranks, which do not fall into {bins} bins of equal "
                         "width; choose a divisor.")
    simulated = np.random.default_rng(0).integers(0, draws + 1, (_SIMULATIONS, len(rank)))
    # The observed ranks, in the first row, count among the simulated, so that no p-value is zero.
    counts = np.stack([np.bincount(row, minlength=draws + 1) for row in (rank, *simulated)])
    uniform = np.arange(1, draws + 2) / (draws + 1)
    statistics = {"chi-square": stats.chisquare(counts.reshape(len(counts), bins, -1).sum(axis=-1), axis=1).statistic,
                  "ecdf": np.abs(counts.cumsum(axis=1) / len(rank) - uniform).max(axis=1)}
    return {name: float((values >= values[0] - 1e-12).mean()) for name, values in statistics.items()}


def save(calibration: Calibration, path: str | Path, overwrite: bool = False) -> Path:
    """Write ranks to an .npz file, atomically, and return its path."""
    path = Path(path).with_suffix(".npz")
    with atomic_write(path, overwrite) as temporary:
        np.savez(temporary, draws=np.asarray(calibration.draws), **calibration.ranks)  # type: ignore[arg-type]
    return path


def load(path: str | Path) -> Calibration:
    """Read ranks that ``save`` wrote."""
    with np.load(path) as file:
        ranks = {name: file[name] for name in file.files}
    return Calibration(ranks, int(ranks.pop("draws")))
