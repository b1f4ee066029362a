"""Parameters of a window: the most likely ones under weak priors, and draws of their posterior."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers
from numpyro.infer import MCMC

from lfm_ppl.experiments import chains
from lfm_ppl.experiments.home_heating import problem
from lfm_ppl.experiments.tasks import Result
from lfm_ppl.inference.fixing import fix
from lfm_ppl.inference.optimise import Objective, quasi_newton
from lfm_ppl.inference.ram import RAM

SAMPLERS = ("RAM", "NUTS")
_ITERATIONS = 60


class _Compiled(Objective):
    """An objective whose value and gradient come from one compiled program, which serves all data."""

    def __init__(self, both: Callable[[jax.Array], tuple[jax.Array, jax.Array]]):
        super().__init__(lambda z: both(z)[0])
        self._both = both

    def value_and_gradient(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the value and the gradient (d,)."""
        self.evaluations += 1
        value, gradient = self._both(jnp.asarray(point))
        return float(value), np.asarray(gradient, float)


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
        z, and its log density.
    """
    program = _program(method, store, functions)
    y, outdoor = jnp.asarray(window.y[:problem.TRAIN]), {k: jnp.asarray(v) for k, v in window.outdoor.items()}
    objective = _Compiled(lambda z: program(z, y, outdoor))
    first = problem.medians(method, store) if start is None else start
    found = quasi_newton(objective, first, _ITERATIONS)
    return found, -objective.value(found)


def values_of(method: str, store: str, z: Any, outdoor: dict[str, Any]) -> dict[str, Any]:
    """Return every parameter by name."""
    return dict(zip(problem.names(method, store), jnp.exp(z), strict=True)) | outdoor


@functools.cache
def _program(method: str, store: str, functions: int) -> Callable[..., tuple[jax.Array, jax.Array]]:
    names, times = problem.names(method, store), problem.TIMES[:problem.TRAIN]

    def energy(z: jax.Array, y: jax.Array, outdoor: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        values = values_of(method, store, z, outdoor)
        seeded = handlers.seed(handlers.substitute(problem.model_file().model, data=values), jax.random.key(0))
        trace = handlers.trace(seeded).get_trace(times, y, **problem.keywords(method, store, functions))
        prior = sum(trace[name]["fn"].log_prob(values[name]) for name in names)
        total = -(trace["y"]["fn"].log_prob(y) + prior + z.sum())
        return total, total

    def both(z: jax.Array, y: jax.Array, outdoor: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        # Forward mode: with so few parameters it is as fast as reverse mode, and compiles in less than half the time.
        gradient, value = jax.jacfwd(energy, has_aux=True)(z, y, outdoor)
        return value, gradient

    return jax.jit(both)


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
    outdoor = [jnp.asarray(window.outdoor[name]) for name in problem.OUTDOOR]
    return chains.sample(_sampler(sampler, method, store, functions, *size), names, run_key,
                         jnp.asarray(window.y[:problem.TRAIN]), *outdoor,
                         init_params=chains.starts(names, near, size[0], start_key))


@functools.cache
def _sampler(sampler: str, method: str, store: str, functions: int, count: int, warmup: int, draws: int) -> MCMC:
    """Return the sampler of a model: one, so that its programs are compiled once for all windows."""

    def model(y: jax.Array, *outdoor: jax.Array) -> None:
        fixed = fix(problem.model_file().model, dict(zip(problem.OUTDOOR, outdoor, strict=True)))
        fixed(problem.TIMES[:problem.TRAIN], y, **problem.keywords(method, store, functions))

    size = len(problem.names(method, store))
    ram = sampler == "RAM"
    kernel = RAM(model, initial_scale=0.3, initial_covariance=np.eye(size)) if ram else chains.nuts(model)
    return MCMC(kernel, num_warmup=warmup, num_samples=draws, num_chains=count,
                chain_method="vectorized" if ram else "sequential", progress_bar=False, jit_model_args=True)
