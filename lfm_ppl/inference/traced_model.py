"""A NumPyro model without its data: its sites, its densities and the functions compiled for it.

1. Run the model with numbers, at the prior's medians: its latent sites, their coordinates, its likelihood sites.
2. Run it with abstract parameters and data. A model that needs the values of its data (a Python branch, a NumPy
   function) fails here; its data become a constant of its programs (``data_index`` is None).
3. Decide whether the likelihood's times are constant. Arithmetic on constants gives tracers inside `jax.jit`; the
   constant times of step 1 then replace them. Times that depend on parameters or data stay traced.
4. Keep the compiled functions by name. Data are an argument of each, so that all data sets of one shape share them.
5. Keep the latest models (`traced_model`), by the identity of the model function, its other arguments, the shapes of
   the data and the variables that the function reads.

`jax.jit` does the caching by shapes and dtypes.
"""

from __future__ import annotations

import functools
import re
import types
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro import handlers
from numpyro.distributions import biject_to
from numpyro.infer import init_to_median, init_to_sample
from numpyro.infer.util import constrain_fn, potential_energy
from numpyro.infer.util import log_density as constrained_log_density

from lfm_ppl.inference.likelihood_site import (
    LikelihoodSite,
    likelihood_sites,
    record_times,
    replace_times,
    single_site,
)
from lfm_ppl.inference.unconstrained import check_latent, coordinate_names, latent_sites
from lfm_ppl.utils import checks

_CACHED_MODELS = 8
"""Models whose compiled functions are kept for the next data set."""

_SITEWISE_STRATEGIES = (init_to_median, init_to_sample)
"""Initialisation strategies that depend on a site alone, so that they can be compiled."""

_DUPLICATE_NAME = re.compile("unique names but got `(.*)` duplicated")
"""NumPyro's message for a model with two sites of one name."""

_TRACING_ERRORS = (TypeError, ValueError, IndexError, AttributeError)
"""Errors of code that needs the value of a tracer: JAX's errors for Python branches, NumPy functions and masks, missing
attributes of NumPy arrays, and errors of this library for times that must be concrete."""


class TracedModel:
    """A NumPyro model without its data, and the functions compiled for it.

    Args:
        model: a NumPyro model.
        arguments: its positional arguments; the entry of the data is ignored.
        data_index: index of the data among them; None: no argument is data, or the model needs the values of the data,
            which then are one of ``arguments``.
        keywords: its keyword arguments.
        data: an example of the data.
        caller: name of the calling function, for messages.

    Attributes:
        sites: names of the latent sites.
        names: names of the unconstrained coordinates.
        size: number of unconstrained coordinates d.
        sites_of_times: names of likelihood sites that observe the times instead of the data.
        functions: name -> compiled function, or another object that depends on the model alone.
    """

    def __init__(self, model: Callable, arguments: tuple, data_index: int | None, keywords: Mapping[str, Any],
                 data: Any, caller: str):
        self.model, self.arguments, self.data_index, self.keywords = model, arguments, data_index, dict(keywords)
        self.key = jax.random.key(0)
        self.caller = caller
        self.functions: dict[Hashable, Any] = {}
        self._seeded = handlers.seed(model, self.key)
        trace = self._trace(data, self.key, init_to_median)
        likelihoods = likelihood_sites(trace)
        self.sites_of_times = [site.name for site in likelihoods if arguments and _equals(site.observed, arguments[0])
                               and not _contains(data, arguments[0])]
        self._likelihoods = [site._replace(observed=None) for site in likelihoods]
        position = _unconstrained(latent_sites(trace))
        self.sites = tuple(position)
        self.names = coordinate_names(position)
        flat, self.unravel = ravel_pytree(position)
        self.size = int(flat.size)
        self._example = data

    def call(self, y: Any) -> tuple:
        """Return the positional arguments with the data in their place."""
        if self.data_index is None:
            return self.arguments
        return (*self.arguments[:self.data_index], y, *self.arguments[self.data_index + 1:])

    def _trace(self, y: Any, key: jax.Array, strategy: Callable) -> dict[str, Any]:
        seeded = handlers.substitute(handlers.seed(self.model, key), substitute_fn=strategy)
        try:
            trace = handlers.trace(seeded).get_trace(*self.call(y), **self.keywords)
        except AssertionError as error:
            if (duplicate := _DUPLICATE_NAME.search(str(error))) is None:
                raise
            raise ValueError(f"two sites of the model have the name {duplicate[1]!r}; each numpyro.sample and "
                             "numpyro.deterministic needs its own name.") from error
        check_latent(latent_sites(trace), self.caller)
        return trace

    @functools.cached_property
    def constant_times(self) -> Any:
        """The likelihood's times; None where they depend on parameters or data or there is no likelihood."""
        recorder, data = record_times(self._seeded), self._example

        def run(z: jax.Array, y: Any) -> jax.Array:
            return potential_energy(recorder, self.call(y), self.keywords, self.unravel(z))

        z = jnp.zeros(self.size)
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), data)
        if self.data_index is None:
            jax.eval_shape(lambda z: run(z, data), z)
        else:
            jax.eval_shape(run, z, shapes)
        if len(self._likelihoods) != 1:
            return None
        if checks.traced(recorder.times):
            # In `jax.jvp`, unlike in `jax.jit`, only what depends on the inputs is traced.
            values = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype) if checks.traced(leaf) else leaf, data)
            if self.data_index is None:
                jax.jvp(lambda z: run(z, values), (z,), (z,))
            else:
                jax.jvp(run, (z, values), (z, jax.tree.map(jnp.zeros_like, values)))
            if checks.traced(recorder.times):
                return None
        return self.site.distribution.times

    @property
    def site(self) -> LikelihoodSite:
        """The likelihood site at the prior's medians."""
        return single_site(self._likelihoods)

    def trace(self, y: Any) -> dict[str, Any]:
        """Return NumPyro's trace of the model at the prior's medians."""
        return self._trace(y, self.key, init_to_median)

    def trace_at(self, values: Mapping[str, Any], y: Any) -> dict[str, Any]:
        """Return NumPyro's trace of the model at values of its sites."""
        substituted = handlers.substitute(self.with_constant_times(), data={
            name: jnp.asarray(value, float) for name, value in values.items()})
        return handlers.trace(substituted).get_trace(*self.call(y), **self.keywords)

    def draw(self, y: Any, key: jax.Array, strategy: Callable) -> jax.Array:
        """Return unconstrained values of the latent sites, (d,), by a NumPyro initialisation strategy."""
        def run(key: jax.Array, y: Any) -> jax.Array:
            return ravel_pytree(_unconstrained(latent_sites(self._trace(y, key, strategy))))[0]

        if strategy not in _SITEWISE_STRATEGIES or self.data_index is None or checks.traced(y):
            return run(key, y)
        # With many data sets of one shape, running the model in Python would take longer than everything else.
        return self.memoized(("draw", strategy), lambda: jax.jit(run))(key, y)

    def potential(self, z: jax.Array, y: Any, handler: Callable[[Callable], Callable] | None = None) -> Any:
        """Return minus the log density of the unconstrained parameters, Jacobian included.

        Args:
            z: (d,).
            y: the data.
            handler: maps the model to one with another likelihood.
        """
        model = self.with_constant_times()
        return potential_energy(model if handler is None else handler(model), self.call(y), self.keywords,
                                self.unravel(z))

    def constrained_potential(self, z: jax.Array, y: Any) -> jax.Array:
        """Return minus the log density of the constrained parameters, without the Jacobian."""
        model = self.with_constant_times()
        values = constrain_fn(model, self.call(y), self.keywords, self.unravel(z))
        return -constrained_log_density(model, self.call(y), self.keywords, values)[0]

    def constrain(self, z: jax.Array, y: Any) -> dict[str, jax.Array]:
        """Return the values of the latent and of the deterministic sites."""
        return constrain_fn(self._seeded, self.call(y), self.keywords, self.unravel(z), return_deterministic=True)

    def unconstrain(self, values: Mapping[str, Any], y: Any) -> tuple[jax.Array, dict[str, Any]]:
        """Return z (d,) at the values of the latent sites, and the trace of these sites."""
        trace = latent_sites(self.trace_at(values, y))
        return ravel_pytree(_unconstrained(trace))[0], trace

    def with_constant_times(self) -> Callable:
        """Return the seeded model, with concrete times where they are constant."""
        return self._seeded if self.constant_times is None else replace_times(self._seeded, self.constant_times)

    def memoized(self, name: Hashable, make: Callable[[], Any]) -> Any:
        """Return the object of this name, made by ``make`` at the first call."""
        if name not in self.functions:
            self.functions[name] = make()
        return self.functions[name]


_models: OrderedDict[Hashable, TracedModel] = OrderedDict()


def traced_model(model: Callable, arguments: tuple, keywords: Mapping[str, Any],
                 caller: str) -> tuple[TracedModel, Any]:
    """Return the traced model and its data, the last argument where it is a pytree of real arrays.

    A model that was traced before with equal arguments and data of the same shape is returned again.
    """
    data_index = len(arguments) - 1 if arguments and _is_numeric(arguments[-1]) else None
    data = None if data_index is None else jax.tree.map(lambda leaf: jnp.asarray(checks.unmask(leaf)), arguments[-1])
    static = arguments if data_index is None else (*arguments[:-1], None)
    key = signature((static, dict(keywords), jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)), data)))
    variables = _variables(model)
    # Whatever is built from tracers must not be reused after their trace has ended.
    is_cached = key is not None and not checks.traced(data) and not checks.traced(jax.tree.leaves(variables))
    key = (model, key, signature(variables))
    with jax.ensure_compile_time_eval():  # the call may come from compiled code
        if is_cached and key in _models:
            _models.move_to_end(key)
            return _models[key], data
        try:
            traced = TracedModel(model, static, data_index, keywords, data, caller)
            _ = traced.constant_times  # runs the model with tracers
        except _TRACING_ERRORS:
            # The model needs the values of its data; any other error is raised again.
            return TracedModel(model, arguments, None, keywords, data, caller), data
    if is_cached:
        _models[key] = traced
        if len(_models) > _CACHED_MODELS:
            _models.popitem(last=False)
    return traced, data


def signature(value: Any) -> Hashable:
    """Return a hashable object that is equal for equal pytrees; None for a pytree with tracers.

    Arrays are compared by shape, dtype and bytes, objects without a hash by identity.
    """
    leaves, structure = jax.tree.flatten(value)
    if checks.traced(leaves):
        return None
    return structure, tuple(_leaf_signature(leaf) for leaf in leaves)


def _leaf_signature(leaf: Any) -> Hashable:
    if isinstance(leaf, (np.ndarray, np.generic, jax.Array)):
        return np.shape(leaf), str(np.asarray(leaf).dtype), np.asarray(leaf).tobytes()
    try:
        hash(leaf)
    except TypeError:
        return _Identity(leaf)
    return type(leaf), leaf


class _Identity:
    """Hash an object by its identity, and keep it alive so that its identity is not reused."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, candidate: object) -> bool:
        """Whether both refer to the same object."""
        return isinstance(candidate, _Identity) and candidate.value is self.value

    def __hash__(self) -> int:
        """Return the hash of the identity."""
        return id(self.value)


def _variables(function: Callable) -> dict[str, Any]:
    """Return the global and closure variables that a Python function reads, functions inside it included.

    A function whose variables have changed is another model. Variables of functions that it calls are not followed, as
    in `jax.jit`.
    """
    if not isinstance(function, types.FunctionType):
        return {}
    names = set(_global_names(function.__code__))
    variables = {name: value for name, value in function.__globals__.items() if name in names}
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    for name, cell in cells:
        try:
            variables[name] = cell.cell_contents
        except ValueError:  # a variable without a value so far
            continue
    return variables


def _global_names(code: types.CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _global_names(constant)


def _unconstrained(sites: Mapping[str, Any]) -> dict[str, jax.Array]:
    return {name: biject_to(site["fn"].support).inv(site["value"]) for name, site in sites.items()}


def _equals(observed: Any, times: Any) -> bool:
    """Return whether the observations of a site are the times, whatever their shape."""
    if not all(isinstance(value, (np.ndarray, jax.Array)) and not checks.traced(value) for value in (observed, times)):
        return False
    return np.size(observed) == np.size(times) > 1 and np.array_equal(np.ravel(observed), np.ravel(times))


def _contains(data: Any, times: Any) -> bool:
    """Return whether a column of the data equals the times, so that observing them may be meant; True for tracers."""
    if checks.traced(data):
        return True
    columns = [np.moveaxis(np.atleast_1d(leaf), -1, 0) for leaf in jax.tree.leaves(data)]
    return any(_equals(np.asarray(array), times) for leaf in columns for array in (leaf, *leaf))


def _is_numeric(value: Any) -> bool:
    """Return whether an argument may be data: a pytree whose leaves are all arrays of real numbers."""
    leaves = jax.tree.leaves(value)
    return bool(leaves) and all(isinstance(leaf, (np.ndarray, jax.Array)) and jnp.issubdtype(leaf.dtype, jnp.floating)
                                for leaf in leaves)
