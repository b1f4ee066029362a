"""A NumPyro model without its data: its sites, its densities and the functions compiled for it.

1. Run the model with numbers, at the prior's medians: its latent sites, their coordinates, its likelihood sites.
2. Run it with abstract parameters and data. A model that needs the values of its data (a Python branch, a NumPy
   function) fails here; its data become a constant of its programs (``data_index`` is None).
3. Decide whether the likelihood's times are constant. Arithmetic on constants gives tracers inside `jax.jit`; the
   constant times of step 1 then replace them. Times that depend on parameters or data stay traced.
4. Keep the compiled functions by name. Data are an argument of each, so that all data sets of one shape share them.
5. Run the model with abstract times and arrays, too. Where that works, they become arguments of programs, with the time
   grids that were laid out for their values. Where it fails, programs are compiled for the values.
6. Every call of `traced_model` runs the model anew. Two traced models share machine code where their programs have the
   same text (`lfm_ppl.utils.programs`), and the programs themselves only where `SharedPrograms` are in use, whose
   caller knows that the model function stays the same.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextvars import ContextVar
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

from lfm_ppl.filtering.time_grid import refuse_traced_times
from lfm_ppl.inference.likelihood_site import SiteTimes, likelihood_sites, record_likelihoods, replace_times
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood
from lfm_ppl.inference.model_arguments import Identity, ModelArguments, ModelInputs, shapes
from lfm_ppl.inference.unconstrained import check_latent, coordinate_names, latent_sites
from lfm_ppl.utils import checks
from lfm_ppl.utils.programs import Program, remembered

_MOST_STRUCTURES = 32
"""Structures of a model whose programs are kept for further data sets."""

_SITEWISE_STRATEGIES = (init_to_median, init_to_sample)
"""Initialisation strategies that depend on a site alone, so that they can be compiled."""

_DUPLICATE_NAME = re.compile("unique names but got `(.*)` duplicated")
"""NumPyro's message for a model with two sites of one name."""

_TRACING_ERRORS = (TypeError, ValueError, IndexError, AttributeError)
"""Errors of code that needs the value of a tracer: JAX's errors for Python branches, NumPy functions and masks, missing
attributes of NumPy arrays, and errors of this library for times that must be concrete."""


class SharedPrograms:
    """Programs of all models that are bound while they are in use, by the structure of the model.

    A model function is then read once for each structure of its arguments: only for callers that bind one model to many
    data sets, between which it does not change, such as `lfm_ppl.fit_many`.
    """

    def __init__(self) -> None:
        # None where programs need the values of the arguments.
        self.by_structure: OrderedDict[Hashable, dict[Hashable, Any] | None] = OrderedDict()

    def __reduce__(self) -> tuple[type[SharedPrograms], tuple]:
        """Leave the programs out, which belong to one process."""
        return SharedPrograms, ()

    @contextlib.contextmanager
    def in_use(self) -> Iterator[None]:
        """Let models that are bound in this context have these programs."""
        token = _programs_in_use.set(self)
        try:
            yield
        finally:
            _programs_in_use.reset(token)


_programs_in_use: ContextVar[SharedPrograms | None] = ContextVar("programs in use", default=None)


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
        likelihoods: the likelihood sites at the prior's medians, without observations.
        sites_of_times: names of likelihood sites that observe the times instead of the data.
        functions: name -> program, or another object, for the values of the arguments.
        programs: name -> program of `program_arguments`.
        inputs: arguments of these programs besides the data; None where they depend on the values of the arguments.
        identity: key of the model function among `SharedPrograms`.
    """

    def __init__(self, model: Callable, arguments: tuple, data_index: int | None, keywords: Mapping[str, Any],
                 data: Any, caller: str):
        self.model, self.arguments, self.data_index, self.keywords = model, arguments, data_index, dict(keywords)
        self.key = jax.random.key(0)
        self.caller = caller
        self.functions: dict[Hashable, Any] = {}
        self.programs = self.functions
        self.identity: Hashable = Identity(model)
        self.inputs: ModelInputs | None = None
        self._structures: list[Hashable] = []
        self._seeded = handlers.seed(model, self.key)
        trace = self._trace(data, self.key, init_to_median)
        likelihoods = likelihood_sites(trace)
        self.sites_of_times = [site.name for site in likelihoods if arguments and _equals(site.observed, arguments[0])
                               and not _contains(data, arguments[0])]
        self.likelihoods = tuple(site._replace(observed=None) for site in likelihoods)
        position = _unconstrained(latent_sites(trace))
        self.sites = tuple(position)
        self.names = coordinate_names(position)
        flat, self.unravel = ravel_pytree(position)
        self.size = int(flat.size)
        self._example = data

    def call(self, y: Any) -> tuple[tuple, dict[str, Any]]:
        """Return the positional and keyword arguments for data or `ModelArguments`; the latter may be traced."""
        arguments, keywords = self.arguments, self.keywords
        if isinstance(y, ModelArguments):
            y, (arguments, keywords) = y.data, y.inputs.value[0]
        if self.data_index is not None:
            arguments = (*arguments[:self.data_index], y, *arguments[self.data_index + 1:])
        return arguments, keywords

    def _trace(self, y: Any, key: jax.Array, strategy: Callable) -> dict[str, Any]:
        seeded = handlers.substitute(handlers.seed(self.model, key), substitute_fn=strategy)
        try:
            arguments, keywords = self.call(y)
            trace = handlers.trace(seeded).get_trace(*arguments, **keywords)
        except AssertionError as error:
            if (duplicate := _DUPLICATE_NAME.search(str(error))) is None:
                raise
            raise ValueError(f"two sites of the model have the name {duplicate[1]!r}; each numpyro.sample and "
                             "numpyro.deterministic needs its own name.") from error
        check_latent(latent_sites(trace), self.caller)
        return trace

    @functools.cached_property
    def site_times(self) -> dict[str, SiteTimes]:
        """The times of each likelihood by site, and their layouts, where they do not depend on parameters or data."""
        data = self._example if self.data_index is not None else None
        z, times = jnp.zeros(self.size), {}
        recorded = self._recorded(_measure, self._seeded, jax.eval_shape, z, shapes(data))
        if checks.traced([measured[:2] for measured in recorded.values()]):
            # In `jax.jvp`, unlike in `jax.jit`, only what depends on the inputs is traced.
            values = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype) if checks.traced(leaf) else leaf, data)
            recorded = self._recorded(_measure, self._seeded, lambda run, *point: jax.jvp(run, point, point), z, values)
        self._structures = [structure for _, _, structure in recorded.values()]
        for site in self.likelihoods:
            traced_times, layout, _ = recorded.get(site.name, (None, None, None))
            if not checks.traced(traced_times):
                times[site.name] = SiteTimes(site.distribution.times, None if checks.traced(layout) else layout)
        return times

    def _recorded(self, measure: Callable[[Any], Any], model: Callable, transformation: Callable,
                  *arguments: Any, only_site: str | None = None) -> dict[str, Any]:
        """Return what ``measure`` says of each likelihood in a transformed run of a model, by site.

        Args:
            measure: function of a likelihood.
            model: this model, seeded.
            transformation: such as `jax.eval_shape`, of a function of z and y.
            *arguments: its further arguments, z (d,) and y.
            only_site: name of the site whose likelihood is measured; None: of all sites.
        """
        recorder, results = record_likelihoods(model), {}

        def run(z: jax.Array, y: Any) -> jax.Array:
            if isinstance(y, ModelArguments):
                recorder.fn = self.with_times(y)
            density = potential_energy(recorder, *self.call(y), self.unravel(z))
            results.update({name: measure(likelihood) for name, likelihood in recorder.likelihoods.items()
                            if only_site in (None, name)})
            return density

        transformation(run, *arguments)
        return results

    def lay_out(self, site: str, requested_times: np.ndarray) -> ModelInputs:
        """Return the layout of a site with requested times (K,), an argument of `programs`."""
        # Other sites may have later initial times, or known inputs that end before the requested times.
        recorded = self._recorded(
            lambda likelihood: likelihood.lay_out(requested_times), self.with_times(self._example), jax.eval_shape,
            jnp.zeros(self.size), shapes(self._example), only_site=site)
        return ModelInputs.of((), recorded[site].padded())

    def take_inputs_as_arguments(self, identity: Hashable = None) -> TracedModel:
        """Make times, arrays among the arguments and time grids arguments of programs, if the model can be traced so.

        Not where a likelihood is a panel or has constraints, where its times depend on parameters, or where the
        structure of the model depends on the values of its arguments. Where `SharedPrograms` are in use, models of
        one identity, one structure and one shape of the arrays have the same programs.

        Args:
            identity: key of the model function; None: the function itself.
        """
        layouts = [self.site_times.get(site.name, SiteTimes(None)).layout for site in self.likelihoods]
        if self.data_index is None or not layouts or any(layout is None for layout in layouts):
            return self
        inputs = ModelInputs.of((self.arguments, self.keywords), {
            name: times._replace(layout=times.layout.padded()) for name, times in self.site_times.items()
            if times.layout is not None})
        arguments = shapes(ModelArguments(self._example, inputs))
        self.identity = self.identity if identity is None else identity
        leaves, structure = jax.tree.flatten(arguments)
        key = self.identity, structure, *self._structures, *((leaf.shape, str(leaf.dtype)) for leaf in leaves)
        by_structure = (_programs_in_use.get() or SharedPrograms()).by_structure
        programs = remembered(by_structure, key, lambda: {} if self._is_traceable(arguments) else None,
                              _MOST_STRUCTURES)
        if programs is not None:
            self.programs, self.inputs = programs, inputs
        return self

    def _is_traceable(self, arguments: ModelArguments) -> bool:
        """Return whether the model can be run with traced arguments, and has the same structure then."""
        try:
            with refuse_traced_times():
                traced = self._recorded(_traced_structure, self._seeded, jax.eval_shape, jnp.zeros(self.size),
                                        arguments)
        except Exception:  # of any kind: a model may do with its arguments what tracers cannot
            return False
        return list(traced.values()) == self._structures

    @functools.cached_property
    def sites_of_other_data(self) -> list[str]:
        """The names of likelihood sites whose observations are constants, where the data are an argument."""
        names: list[str] = []

        def run(y: Any) -> None:
            names.extend(site.name for site in likelihood_sites(self.trace(y)) if not checks.traced(site.observed))

        if self.data_index is not None:
            jax.eval_shape(run, shapes(self._example))
        return names

    def trace(self, y: Any) -> dict[str, Any]:
        """Return NumPyro's trace of the model at the prior's medians."""
        return self._trace(y, self.key, init_to_median)

    def trace_at(self, values: Mapping[str, Any], y: Any) -> dict[str, Any]:
        """Return NumPyro's trace of the model at values of its sites."""
        substituted = handlers.substitute(self.with_times(y), data={
            name: jnp.asarray(value, float) for name, value in values.items()})
        arguments, keywords = self.call(y)
        return handlers.trace(substituted).get_trace(*arguments, **keywords)

    def draw(self, y: Any, key: jax.Array, strategy: Callable) -> jax.Array:
        """Return unconstrained values of the latent sites, (d,), by a NumPyro initialisation strategy."""
        def run(key: jax.Array, y: Any) -> jax.Array:
            return ravel_pytree(_unconstrained(latent_sites(self._trace(y, key, strategy))))[0]

        if strategy not in _SITEWISE_STRATEGIES or self.data_index is None or checks.traced(y):
            return run(key, y)
        # With many data sets of one shape, running the model in Python would take longer than everything else.
        return self.program(("draw", strategy), lambda: Program(run))(key, self.program_arguments(y))

    def potential(self, z: jax.Array, y: Any, handler: Callable[[Callable], Callable] | None = None) -> Any:
        """Return minus the log density of the unconstrained parameters, Jacobian included.

        Args:
            z: (d,).
            y: the data.
            handler: maps the model to one with another likelihood.
        """
        model = self.with_times(y)
        return potential_energy(model if handler is None else handler(model), *self.call(y), self.unravel(z))

    def constrained_potential(self, z: jax.Array, y: Any) -> jax.Array:
        """Return minus the log density of the constrained parameters, without the Jacobian."""
        model = self.with_times(y)
        values = constrain_fn(model, *self.call(y), self.unravel(z))
        return -constrained_log_density(model, *self.call(y), values)[0]

    def constrain(self, z: jax.Array, y: Any) -> dict[str, jax.Array]:
        """Return the values of the latent and of the deterministic sites."""
        return constrain_fn(self._seeded, *self.call(y), self.unravel(z), return_deterministic=True)

    def unconstrain(self, values: Mapping[str, Any], y: Any) -> tuple[jax.Array, dict[str, Any]]:
        """Return z (d,) at the values of the latent sites, and the trace of these sites."""
        trace = latent_sites(self.trace_at(values, y))
        return ravel_pytree(_unconstrained(trace))[0], trace

    def with_times(self, y: Any) -> Callable:
        """Return the seeded model with constant times of its likelihoods, or with the times in `ModelArguments`."""
        if isinstance(y, ModelArguments):
            return replace_times(self._seeded, y.inputs.value[1])
        times = {name: SiteTimes(site_times.times) for name, site_times in self.site_times.items()}
        return replace_times(self._seeded, times) if times else self._seeded

    def program_arguments(self, y: Any) -> Any:
        """Return the data with all that programs take as arguments; the data alone where they take nothing else."""
        if self.data_index is None:
            return None
        return y if self.inputs is None or isinstance(y, ModelArguments) else ModelArguments(y, self.inputs)

    def memoized(self, name: Hashable, make: Callable[[], Any]) -> Any:
        """Return the object of this name, made by ``make`` at the first call."""
        if name not in self.functions:
            self.functions[name] = make()
        return self.functions[name]

    def program(self, name: Hashable, make: Callable[[], Any]) -> Any:
        """Return the program of this name, a function of `program_arguments`, whatever their values."""
        if name not in self.programs:
            self.programs[name] = make()
        return self.programs[name]


def _measure(likelihood: Any) -> tuple[Any, Any, Hashable]:
    """Return the times, and of a `MarginalLikelihood` the layout of its time grid and the structure of its model."""
    if not isinstance(likelihood, MarginalLikelihood):
        return likelihood.times, None, None
    layout = None if checks.traced(likelihood.times) else likelihood.lay_out()
    return likelihood.times, layout, _structure(likelihood)


def _structure(likelihood: MarginalLikelihood) -> Hashable:
    """Return what of a state-space model decides its program."""
    leaves, tree = jax.tree.flatten(likelihood.ssm)
    return tree, tuple(np.shape(leaf) for leaf in leaves)


def _traced_structure(likelihood: MarginalLikelihood) -> Hashable:
    """Return `_structure` where times and inputs are traced; raise ValueError if inputs are read in another way."""
    # A read at another function of time than t - lag may be seen in one span of time, and not in another.
    if likelihood.layout is not None and len(likelihood.model.input_reads(0.0, 1.0)) != len(likelihood.layout.rows):
        raise ValueError("the reads of known inputs depend on the times.")
    _ = likelihood.time_grid
    return _structure(likelihood)


def traced_model(model: Callable, arguments: tuple, keywords: Mapping[str, Any],
                 caller: str) -> tuple[TracedModel, Any]:
    """Return the traced model and its data, the last argument where it is a pytree of real arrays."""
    data_index = len(arguments) - 1 if arguments and _is_numeric(arguments[-1]) else None
    data = None if data_index is None else jax.tree.map(lambda leaf: jnp.asarray(checks.unmask(leaf)), arguments[-1])
    static = arguments if data_index is None else (*arguments[:-1], None)
    with jax.ensure_compile_time_eval():  # the call may come from compiled code
        try:
            traced = TracedModel(model, static, data_index, keywords, data, caller)
            _ = traced.site_times  # runs the model with tracers
        except _TRACING_ERRORS:
            # The model needs the values of its data; any other error is raised again.
            return TracedModel(model, arguments, None, keywords, data, caller), data
        is_concrete = not checks.traced((static, dict(keywords), data))
        return traced.take_inputs_as_arguments() if is_concrete else traced, data


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
