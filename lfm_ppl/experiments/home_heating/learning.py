"""Parameters of a window: the most likely ones under weak priors, and draws of their posterior."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer import MCMC

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments import chains
from lfm_ppl.experiments.home_heating import problem
from lfm_ppl.experiments.posteriors import LogPosterior
from lfm_ppl.inference.bound_model import bind_arguments
from lfm_ppl.inference.handlers.fixing import fix
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.optimise import quasi_newton

SAMPLERS = ("RAM", "NUTS")
_ITERATIONS = 60


def most_likely(method: str, store: str, functions: int, window: problem.Window,
                start: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Return the logarithms z (P,) of the parameters at the mode of their density given the first four days.

    The priors are the model file's, with standard deviations of 0.7 to 1 in the logarithm: without them some of the
    scales run away where four days say nothing of them.

    Args:
        method: the residual.
        store: one of `problem.STORES`.
        functions: eigenfunctions.
        window: five days, of which the first four are used.
        start: where to begin; None: at the prior medians.

    Returns:
        z, and its log density, to which the prior of what is known of the weather adds a constant.
    """
    objective = _posterior(method, store, functions).objective(_data(window))
    first = problem.medians(method, store) if start is None else start
    found = quasi_newton(objective, first, _ITERATIONS)
    return found.point, -found.value


def values_of(method: str, store: str, z: Any, outdoor: dict[str, Any]) -> dict[str, Any]:
    """Return every parameter by name."""
    return dict(zip(problem.names(method, store), jnp.exp(z), strict=True)) | outdoor


def _data(window: problem.Window) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the measurements of the first four days, and what is known of the weather."""
    return jnp.asarray(window.y[:problem.TRAIN]), {name: jnp.asarray(window.outdoor[name]) for name in problem.OUTDOOR}


@functools.cache
def _posterior(method: str, store: str, functions: int) -> LogPosterior:
    """Return the posterior given the first four days; what is compiled for it serves all windows."""
    with jax.ensure_compile_time_eval():
        example = jnp.zeros((problem.TRAIN, 3)), dict.fromkeys(problem.OUTDOOR, jnp.ones(()))
        return LogPosterior(bind_arguments(_model(method, store, functions), (example,), {}),
                            problem.names(method, store))


def _model(method: str, store: str, functions: int) -> Callable[[Any], None]:
    """Return the NumPyro model of the first four days, a function of `_data`."""
    def model(data: tuple[jax.Array, dict[str, jax.Array]]) -> None:
        y, outdoor = data
        times = problem.TIMES[:problem.TRAIN]
        temperatures, inputs = problem.given(y, times)
        fixed = fix(problem.model_file().model, outdoor)
        fixed(times, temperatures, inputs=inputs, **problem.keywords(method, store, functions))

    return model


def posterior(sampler: str, method: str, store: str, functions: int, window: problem.Window, near: np.ndarray,
              key: jax.Array, size: tuple[int, int, int]) -> Result:
    """Return draws of z and what is known of them, see `chains.sample`; chains start around ``near``.

    Args:
        sampler: one of `SAMPLERS`.
        method: the residual.
        store: one of `problem.STORES`.
        functions: eigenfunctions.
        window: five days, of which the first four are used.
        near: (P,) the mode.
        key: JAX random key.
        size: chains, warm-up and draws of each.
    """
    names = problem.names(method, store)
    start_key, run_key = jax.random.split(key)
    return chains.sample(_sampler(sampler, method, store, functions, *size), names, run_key, _data(window),
                         init_params=chains.starts(names, near, size[0], start_key))


@functools.cache
def _sampler(sampler: str, method: str, store: str, functions: int, count: int, warmup: int, draws: int) -> MCMC:
    """Return the sampler of a model: one, so that its programs are compiled once for all windows."""
    model = _model(method, store, functions)
    size = len(problem.names(method, store))
    ram = sampler == "RAM"
    kernel = RAM(model, initial_scale=0.3, initial_covariance=np.eye(size)) if ram else chains.nuts(model)
    return MCMC(kernel, num_warmup=warmup, num_samples=draws, num_chains=count,
                chain_method="vectorized" if ram else "sequential", progress_bar=False, jit_model_args=True)
