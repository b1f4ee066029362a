"""Simulation-based calibration: does a sampler draw from the posterior of a model?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers

from lfm_ppl import checks
from lfm_ppl.inference.bound_model import bind, likelihood_site
from lfm_ppl.results.files import writing

LOG_LIKELIHOOD = "log likelihood"
_SIMULATIONS = 20_000


class Calibration(NamedTuple):
    """Ranks of true parameters among posterior draws.

    Attributes:
        ranks: name of a scalar -> (data sets,), whole numbers in 0..draws.
        draws: posterior draws that each true value is ranked against.
    """

    ranks: dict[str, np.ndarray]
    draws: int


def calibrate(key: jax.Array, model: Callable, times: Any, kernel: Callable, *, data_sets: int = 200, draws: int = 63,
              thin: int = 10, warmup: int = 500, batch: int | None = None) -> Calibration:
    """Rank true parameters among posterior draws, for many data sets that the model itself generates.

    For parameters theta* drawn from the prior and data drawn from the model at theta*, theta* is one more draw from
    the posterior. Its rank among L independent posterior draws is therefore uniform on 0..L, for every scalar function
    of parameters and data; here every parameter and the log likelihood. A sampler, or an approximate likelihood,
    that is too wide, too narrow or shifted shows in the ranks.

    Args:
        key: a JAX random key.
        model: NumPyro model ``model(times, y=None)`` with one likelihood site.
        times: (T,).
        kernel: maps a NumPyro model to an MCMC kernel, such as ``lfm.RAM`` or ``numpyro.infer.NUTS``.
        data_sets: number of replications.
        draws: L. With 63 the 64 possible ranks fall into 2, 4, 8, 16 or 32 bins of equal width.
        thin: steps of the chain between two of these; the draws must be nearly independent.
        warmup: steps before the first.
        batch: data sets that run side by side; all by default. (NUTS side by side takes as long as its longest tree.)

    Returns:
        The ranks.

    Raises:
        TypeError: ``key`` is no random key.
        ValueError: the model has no likelihood site, or a count is not a positive number.

    Example:
        >>> import jax.numpy as jnp, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> def level(times, y=None):
        ...     system = lfm.LatentForceModel(
        ...         lambda x, u, t: jnp.zeros(1), {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.ones(1)),
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
    times = np.asarray(times, float)
    site = likelihood_site(model, (times,), {}, key)
    bound = bind(model, times, jnp.zeros_like(site.observed))
    truth_keys, chain_keys = jax.random.split(key)

    def one(keys: tuple[jax.Array, jax.Array]) -> dict[str, jax.Array]:
        trace = handlers.trace(handlers.seed(model, keys[0])).get_trace(times)
        y = trace[site.name]["value"]
        truth = {name: trace[name]["value"] for name in bound.sites}
        posterior = _chain(kernel(model), (times, y), keys[1], draws, thin, warmup)
        score = lambda theta: bound.likelihood(theta, y).log_prob(y).sum()  # noqa: E731
        truth[LOG_LIKELIHOOD] = score(truth)
        posterior[LOG_LIKELIHOOD] = jax.lax.map(score, posterior)
        return {n: (posterior[n] < truth[n]).sum(0) for n in truth}

    keys = (jax.random.split(truth_keys, data_sets), jax.random.split(chain_keys, data_sets))
    found = jax.jit(lambda k: jax.lax.map(one, k, batch_size=batch or data_sets))(keys)
    return Calibration(_scalars({name: np.asarray(value) for name, value in found.items()}), draws)


def _chain(kernel: Any, arguments: tuple, key: jax.Array, draws: int, thin: int, warmup: int) -> dict[str, jax.Array]:
    state = kernel.init(key, warmup, None, arguments, {})
    advance = lambda count, state: jax.lax.fori_loop(  # noqa: E731
        0, count, lambda _, s: kernel.sample(s, arguments, {}), state)
    state = advance(warmup, state)

    def step(state: Any, _: None) -> tuple[Any, Any]:
        state = advance(thin, state)
        return state, state.z

    _, collected = jax.lax.scan(step, state, length=draws)
    return jax.vmap(kernel.postprocess_fn(arguments, {}))(collected)


def _scalars(found: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    flat = {}
    for name, value in found.items():
        for index in np.ndindex(value.shape[1:]):
            flat[f"{name}[{','.join(map(str, index))}]" if index else name] = value[(slice(None), *index)]
    return flat


def chi_square(rank: np.ndarray, draws: int, bins: int) -> float:
    """Return Pearson's statistic of ranks in ``bins`` bins of equal width; draws + 1 must be a multiple of bins."""
    if (draws + 1) % bins:
        raise ValueError(f"{draws} draws give {draws + 1} possible ranks, which do not fall into {bins} bins of equal "
                         "width; choose a divisor.")
    counts = np.bincount(rank * bins // (draws + 1), minlength=bins)
    expected = len(rank) / bins
    return float(((counts - expected) ** 2 / expected).sum())


def ecdf_distance(rank: np.ndarray, draws: int) -> float:
    """Return the largest distance of the empirical distribution function of the ranks from the uniform one."""
    counts = np.bincount(rank, minlength=draws + 1)
    uniform = np.arange(1, draws + 2) / (draws + 1)
    return float(np.abs(counts.cumsum() / len(rank) - uniform).max())


def p_values(rank: np.ndarray, draws: int, bins: int = 16) -> dict[str, float]:
    """Test that ranks are uniform on 0..draws.

    Args:
        rank: (data sets,).
        draws: largest possible rank.
        bins: of the chi-square statistic; a divisor of draws + 1.

    Returns:
        ``chi-square`` and ``ecdf`` (the largest distance of the distribution functions), by simulation under
        uniform ranks, so that neither rests on asymptotics.

    Example:
        >>> low = np.zeros(100, int)
        >>> p_values(low, 63)["chi-square"] < 0.001
        True
    """
    null = np.random.default_rng(0).integers(0, draws + 1, (_SIMULATIONS, len(rank)))
    found = {}
    for name, statistic in (("chi-square", lambda r: chi_square(r, draws, bins)),
                            ("ecdf", lambda r: ecdf_distance(r, draws))):
        simulated = np.array([statistic(row) for row in null])
        # The observed one counts among the simulated, so that no p-value is zero.
        found[name] = float((1 + (simulated >= statistic(rank) - 1e-12).sum()) / (_SIMULATIONS + 1))
    return found


def save(calibration: Calibration, path: str | Path, overwrite: bool = False) -> Path:
    """Write ranks to an .npz file, whole or not at all, and return its path; an existing file is kept unless said."""
    path = Path(path).with_suffix(".npz")
    with writing(path, overwrite) as temporary:
        np.savez(temporary, draws=np.asarray(calibration.draws), **calibration.ranks)  # type: ignore[arg-type]
    return path


def load(path: str | Path) -> Calibration:
    """Read ranks that ``save`` wrote."""
    with np.load(path) as kept:
        ranks = {name: kept[name] for name in kept.files}
    return Calibration(ranks, int(ranks.pop("draws")))
