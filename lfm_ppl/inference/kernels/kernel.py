"""What `numpyro.infer.MCMC` asks of every kernel: one chain or several at once, a starting point, copies."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer.mcmc import MCMCKernel
from numpyro.util import identity, is_prng_key

from lfm_ppl import checks


class Kernel(MCMCKernel):
    """Base of the kernels: a subclass says how chains start (`begin`) and how they move (`sample`).

    Args:
        model: a NumPyro model, None for a kernel that needs none.
    """

    def __init__(self, model: Callable | None) -> None:
        self._model = model
        # MCMC takes a kernel without a _sample_fn for one that was not initialised
        self._sample_fn: Callable | None = None

    @property
    def model(self) -> Callable | None:
        """The NumPyro model, if there is one."""
        return self._model

    @property
    def sample_field(self) -> str:
        """Field of the state that holds the parameters."""
        return "z"

    def postprocess_fn(self, args: tuple, kwargs: dict) -> Callable:
        """Return the map from the parameters of the chain to those that are stored."""
        return identity

    def init(self, rng_key: jax.Array, num_warmup: int, init_params: Any = None, model_args: tuple = (),
             model_kwargs: dict | None = None) -> Any:
        """Return the state before the first step.

        Args:
            rng_key: a key, or an array of keys, one for each vectorised chain.
            num_warmup: number of warm-up steps.
            init_params: starting point, a pytree or site -> value; with a leading axis of chains where there are
                several keys.
            model_args: positional arguments of the model.
            model_kwargs: keyword arguments of the model.
        """
        split = jax.random.split if is_prng_key(rng_key) else jax.vmap(jax.random.split, out_axes=1)
        rng_key, model_key = split(rng_key)
        state = self.begin(rng_key, model_key, num_warmup, init_params, model_args, model_kwargs or {})
        self._sample_fn = self.sample
        return state

    @abstractmethod
    def begin(self, rng_key: jax.Array, model_key: jax.Array, num_warmup: int, init_params: Any, args: tuple,
              kwargs: dict) -> Any:
        """Return the state before the first step, with a key for the chain and one for its starting point."""

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_sample_fn": None}


def of_chains(function: Callable, rng_key: jax.Array) -> Callable:
    """Return a function of one chain for as many as there are keys."""
    return function if is_prng_key(rng_key) else jax.vmap(function)


def floating(point: Any) -> Any:
    """Return a starting point as arrays of floating-point numbers."""
    return jax.tree_util.tree_map(lambda leaf: jnp.asarray(leaf) * 1.0, point)


def check_start(value: jax.Array, said: str) -> None:
    """Raise ValueError with ``said``, into which the numbers go, where they are known and not all finite."""
    known = checks.concrete(value)
    if known is not None and not np.all(np.isfinite(known)):
        raise ValueError(said.format(known))
