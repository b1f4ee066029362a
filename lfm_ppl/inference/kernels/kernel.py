"""The adapter from a `SamplingAlgorithm` to ``numpyro.infer.MCMC``."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer.mcmc import MCMCKernel
from numpyro.infer.util import ParamInfo
from numpyro.util import identity, is_prng_key

from lfm_ppl.inference.kernels.algorithm import SamplingAlgorithm
from lfm_ppl.utils import checks


class Kernel(MCMCKernel):
    """Base class of the kernels: a subclass defines its algorithm and its starting point.

    The data of the algorithm are the pair ``(model_args, model_kwargs)``.

    Args:
        model: a NumPyro model, None for a kernel of a potential function.
    """

    _chain_axes: ClassVar[Any] = 0
    """Axis of the chains in the state, or a state with the axis of each field; None for a field that chains share."""

    def __init__(self, model: Callable | None) -> None:
        self._model = model
        # MCMC initializes a kernel whose _sample_fn is None.
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
        """Return the map from the parameters of the chain to the stored sites."""
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
        rng_key, start_key = split(rng_key)
        data = model_args, model_kwargs or {}
        point, tuning = self.starting_point(start_key, init_params, *data)
        algorithm = self.algorithm(num_warmup)

        def init_chain(key: jax.Array, point: ParamInfo) -> Any:
            return algorithm.init(key, point, data, tuning)

        state = map_chains(init_chain, rng_key, out_axes=self._chain_axes)(rng_key, point)
        self._sample_fn = self.sample
        return state

    def sample(self, state: Any, model_args: tuple, model_kwargs: dict | None) -> Any:
        """Return the state after one step of every chain in ``state``."""
        algorithm, data = self.algorithm(), (model_args, model_kwargs or {})

        def step_chain(state: Any) -> Any:
            return algorithm.step(state, data)

        return map_chains(step_chain, state.rng_key, (self._chain_axes,), self._chain_axes)(state)

    @abstractmethod
    def algorithm(self, num_warmup: int = 0) -> SamplingAlgorithm:
        """Return the algorithm; the length of the warm-up is used by its ``init`` only."""

    @abstractmethod
    def starting_point(self, key: jax.Array, init_params: Any, args: tuple, kwargs: dict) -> tuple[ParamInfo, Any]:
        """Return the position and potential energy of each chain, and the tuning of ``init``."""

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_sample_fn": None}


def map_chains(function: Callable, rng_key: jax.Array, in_axes: Any = 0, out_axes: Any = 0) -> Callable:
    """Return the function for as many chains as there are keys."""
    return function if is_prng_key(rng_key) else jax.vmap(function, in_axes, out_axes)


def as_floating_point(position: Any) -> Any:
    """Return a position as arrays of floating-point numbers."""
    return jax.tree_util.tree_map(lambda leaf: jnp.asarray(leaf) * 1.0, position)


def check_start(value: jax.Array, message: str) -> None:
    """Raise ValueError where the value at the start is known and not finite; ``message`` has a field for it."""
    concrete_value = checks.concrete(value)
    if concrete_value is not None and not np.all(np.isfinite(concrete_value)):
        raise ValueError(message.format(concrete_value))
