"""A NumPyro model without its data: its sites, and its densities as functions of a `Problem`.

1. Run the model with numbers, at the prior's medians: its latent sites, their coordinates, its likelihood sites.
2. Run it with abstract parameters and data. A model that needs the values of its data (a Python branch, a NumPy
   function) fails here; its data become constants of its programs.
3. Decide whether the likelihood's times are constant. Arithmetic on constants gives tracers inside `jax.jit`; the
   constant times of step 1 then replace them. Times that depend on parameters or data stay traced.
4. Run the model with abstract times and arrays, too. Where that works, they become leaves of the `Problem`, with the
   time grids that were laid out for their values. Where it fails, programs are compiled for the values.
5. Every call of `model_and_problems` runs the model anew. Two models share machine code where their programs have the
   same text (`lfm_ppl.utils.programs`), and the programs themselves only as a `SharedModel`, whose caller knows that
   the model function stays the same.

A trace is NumPyro's: name of a site -> its distribution and value. What JAX traces, tracers, is abstract or traced.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Callable, Hashable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro import handlers
from numpyro.distributions import biject_to
from numpyro.infer import init_to_median
from numpyro.infer.util import constrain_fn, potential_energy
from numpyro.infer.util import log_density as constrained_log_density

from lfm_ppl.filtering.time_grid import refuse_traced_times
from lfm_ppl.inference.problem import Problem, is_numeric, shapes
from lfm_ppl.inference.unconstrained import check_latent, coordinate_names, latent_sites
from lfm_ppl.likelihoods.handlers.binding import SiteTimes, record_likelihoods, replace_anchors, replace_times
from lfm_ppl.likelihoods.likelihood_site import LikelihoodSite, likelihood_sites
from lfm_ppl.likelihoods.marginal_likelihood import MarginalLikelihood
from lfm_ppl.utils import checks

_DUPLICATE_NAME = re.compile("unique names but got `(.*)` duplicated")
"""NumPyro's message for a model with two sites of one name."""

_TRACING_ERRORS = (TypeError, ValueError, IndexError, AttributeError)
"""Errors of code that needs the value of a tracer: JAX's errors for Python branches, NumPy functions and masks, missing
attributes of NumPy arrays, and errors of this library for times that must be concrete."""


class Programs:
    """The compiled functions of a model, by name, and which of its problems can be traced, by structure."""

    def __init__(self) -> None:
        self.by_name: dict[Hashable, Any] = {}
        self.is_traceable: dict[Hashable, bool] = {}
        self._of_modified: dict[Hashable, Programs] = {}

    def of_modified(self, name: Hashable) -> Programs:
        """Return the programs of the model that a modification of this name makes of this one."""
        return self._of_modified.setdefault(name, Programs())


class SharedModel:
    """A NumPyro model whose bound models share their programs, for callers that bind it to many data sets.

    The model must not change meanwhile: it is read once for each program.
    """

    def __init__(self, model: Callable) -> None:
        functools.update_wrapper(self, model)
        self.fn, self.programs = model, Programs()  # ``fn`` as in NumPyro's handlers

    def modified(self, name: Hashable, modify: Callable[[Callable], Callable]) -> SharedModel:
        """Return the model that a function makes of this one; the name says everything of the function."""
        model = SharedModel(modify(self.fn))
        model.programs = self.programs.of_modified(name)
        return model

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Run the model."""
        return self.fn(*arguments, **keywords)

    def __reduce__(self) -> tuple[type[SharedModel], tuple]:
        """Leave the programs out, which belong to one process."""
        return SharedModel, (self.fn,)


class UnboundModel:
    """A NumPyro model that was run with numbers: its densities are functions of z and a problem.

    Args:
        model: a NumPyro model.
        problem: its arguments and data.
        caller: name of the calling function, for messages.

    Attributes:
        sites: names of the latent sites.
        names: names of the unconstrained coordinates.
        size: number of unconstrained coordinates d.
        unravel: from z (d,) to the unconstrained value of each latent site.
        at_medians: NumPyro's trace at the prior's medians, with the first data.
        likelihoods: the likelihood sites of this trace, without observations.
        sites_of_times: names of likelihood sites that observe the times instead of the data.
    """

    def __init__(self, model: Callable, problem: Problem, caller: str) -> None:
        self.model, self.caller, self.key = model, caller, jax.random.key(0)
        self._seeded = handlers.seed(model, self.key)
        self.at_medians = self.trace(problem)
        likelihoods = likelihood_sites(self.at_medians)
        arguments, _ = problem.call()
        self.sites_of_times = [site.name for site in likelihoods if arguments and _equals(site.observed, arguments[0])
                               and not _contains(problem.observations, arguments[0])]
        self.likelihoods: tuple[LikelihoodSite, ...] = tuple(site._replace(observed=None) for site in likelihoods)
        position = _unconstrained(latent_sites(self.at_medians))
        self.sites = tuple(position)
        self.names = coordinate_names(position)
        flat, self.unravel = ravel_pytree(position)
        self.size = int(flat.size)

    # --- runs of the model

    def trace(self, problem: Problem, key: jax.Array | None = None,
              strategy: Callable = init_to_median) -> dict[str, Any]:
        """Return NumPyro's trace of the model at values of a NumPyro initialisation strategy."""
        seeded = handlers.seed(self.model, self.key if key is None else key)
        arguments, keywords = problem.call()
        try:
            trace = handlers.trace(handlers.substitute(seeded, substitute_fn=strategy)).get_trace(*arguments,
                                                                                                  **keywords)
        except AssertionError as error:
            if (duplicate := _DUPLICATE_NAME.search(str(error))) is None:
                raise
            raise ValueError(f"two sites of the model have the name {duplicate[1]!r}; each numpyro.sample and "
                             "numpyro.deterministic needs its own name.") from error
        check_latent(latent_sites(trace), self.caller)
        return trace

    def trace_at(self, values: Mapping[str, Any], problem: Problem) -> dict[str, Any]:
        """Return NumPyro's trace of the model at values of its sites."""
        substituted = handlers.substitute(self.with_times(problem), data={
            name: jnp.asarray(value, float) for name, value in values.items()})
        arguments, keywords = problem.call()
        return handlers.trace(substituted).get_trace(*arguments, **keywords)

    def with_times(self, problem: Problem) -> Callable:
        """Return the seeded model whose likelihoods have the times and the anchors of the problem."""
        grids, anchors = problem.grids, problem.anchors
        model = replace_times(self._seeded, grids) if grids else self._seeded
        return replace_anchors(model, anchors) if anchors else model

    def draw(self, key: jax.Array, problem: Problem, strategy: Callable) -> jax.Array:
        """Return unconstrained values of the latent sites, (d,), by a NumPyro initialisation strategy."""
        return ravel_pytree(_unconstrained(latent_sites(self.trace(problem, key, strategy))))[0]

    # --- densities and parameters

    def log_density(self, z: jax.Array, problem: Problem,
                    handler: Callable[[Callable], Callable] | None = None) -> Any:
        """Return the log density of the unconstrained parameters, Jacobian included.

        Args:
            z: (d,).
            problem: data, times and inputs.
            handler: maps the model to one with another likelihood.
        """
        model = self.with_times(problem)
        arguments, keywords = problem.call()
        return -potential_energy(model if handler is None else handler(model), arguments, keywords, self.unravel(z))

    def constrained_log_density(self, z: jax.Array, problem: Problem) -> jax.Array:
        """Return the log density of the constrained parameters, without the Jacobian."""
        model, (arguments, keywords) = self.with_times(problem), problem.call()
        values = constrain_fn(model, arguments, keywords, self.unravel(z))
        return constrained_log_density(model, arguments, keywords, values)[0]

    def constrain(self, z: jax.Array, problem: Problem) -> dict[str, jax.Array]:
        """Return the values of the latent and of the deterministic sites."""
        return constrain_fn(self._seeded, *problem.call(), self.unravel(z), return_deterministic=True)

    def unconstrain(self, values: Mapping[str, Any], problem: Problem) -> tuple[jax.Array, dict[str, Any]]:
        """Return z (d,) at the values of the latent sites, and the trace of these sites."""
        trace = latent_sites(self.trace_at(values, problem))
        return ravel_pytree(_unconstrained(trace))[0], trace

    # --- the times of the likelihoods

    def constant_times(self, problem: Problem) -> tuple[dict[str, SiteTimes], list[Hashable]]:
        """Return the times of each likelihood by site and their layouts, if they depend on no parameters and no data.

        The second value has the structure of the model of each likelihood.
        """
        z, times = jnp.zeros(self.size), {}
        measured = self._measured(_measure, problem, jax.eval_shape, z, shapes(problem))
        if checks.traced([site[:2] for site in measured.values()]):
            # In `jax.jvp`, unlike in `jax.jit`, only what depends on the inputs is traced.
            values = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype) if checks.traced(leaf) else leaf,
                                  problem)
            measured = self._measured(_measure, problem, lambda run, *point: jax.jvp(run, point, point), z, values)
        for site in self.likelihoods:
            site_times, layout, _ = measured.get(site.name, (None, None, None))
            if not checks.traced(site_times):
                times[site.name] = SiteTimes(site.distribution.times, None if checks.traced(layout) else layout)
        return times, [structure for _, _, structure in measured.values()]

    def lay_out(self, site: str, problem: Problem, requested_times: np.ndarray) -> Any:
        """Return the layout of the time grid of a site with requested times (K,)."""
        # Other sites may have later initial times, or known inputs that end before the requested times.
        measured = self._measured(lambda likelihood: likelihood.lay_out(requested_times), problem, jax.eval_shape,
                                  jnp.zeros(self.size), shapes(problem), only_site=site)
        return measured[site].padded()

    def structures(self, problem: Problem) -> list[Hashable]:
        """Return the structure of the model of each likelihood where all leaves of the problem are traced."""
        with refuse_traced_times():
            return list(self._measured(_traced_structure, problem, jax.eval_shape, jnp.zeros(self.size),
                                       shapes(problem)).values())

    def _measured(self, measure: Callable[[Any], Any], problem: Problem, transformation: Callable, *point: Any,
                  only_site: str | None = None) -> dict[str, Any]:
        """Return what ``measure`` says of each likelihood in a transformed run of the model, by site.

        Args:
            measure: function of a likelihood.
            problem: it holds the times of the likelihoods.
            transformation: such as `jax.eval_shape`, of a function of z and the problem.
            *point: its further arguments, z (d,) and a problem.
            only_site: name of the site whose likelihood is measured; None: of all sites.
        """
        results: dict[str, Any] = {}

        def run(z: jax.Array, problem: Problem) -> jax.Array:
            recorder = record_likelihoods(self.with_times(problem))
            density = potential_energy(recorder, *problem.call(), self.unravel(z))
            results.update({name: measure(likelihood) for name, likelihood in recorder.likelihoods.items()
                            if only_site in (None, name)})
            return density

        transformation(run, *point)
        return results

    def sites_of_other_data(self, problem: Problem) -> list[str]:
        """Return the names of likelihood sites whose observations are constants, where the data are an argument."""
        names: list[str] = []

        def run(data: Any) -> None:
            names.extend(site.name for site in likelihood_sites(self.trace(problem.with_data(data)))
                         if not checks.traced(site.observed))

        if problem.data is not None:
            jax.eval_shape(run, shapes(problem.data))
        return names


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


def model_and_problems(model: Callable, arguments: tuple, keywords: Mapping[str, Any], caller: str,
                       programs: Programs | None = None) -> tuple[UnboundModel, Problem, Problem]:
    """Return the unbound model, its problem with constant times and inputs, and the problem that its programs take.

    The last argument is the data where it is a pytree of real arrays.

    Args:
        model: a NumPyro model.
        arguments: its positional arguments.
        keywords: its keyword arguments.
        caller: name of the calling function, for messages.
        programs: of a model that is bound to several data sets; they know which problems can be traced.
    """
    data = arguments[-1] if arguments and is_numeric(arguments[-1]) else None
    if data is not None:
        data = jax.tree.map(lambda leaf: jnp.asarray(checks.unmask(leaf)), data)
        arguments = (*arguments[:-1], data)
    with jax.ensure_compile_time_eval():  # the call may come from compiled code
        try:
            problem = Problem.of_constants(arguments, keywords, data)
            unbound = UnboundModel(model, problem, caller)
            times, structures = unbound.constant_times(problem)
        except _TRACING_ERRORS:
            # The model needs the values of its data; any other error is raised again, by its first density at last.
            problem = Problem.of_constants(arguments, keywords)
            unbound = UnboundModel(model, problem, caller)
            times, structures = {}, []
            with contextlib.suppress(*_TRACING_ERRORS):
                times, structures = unbound.constant_times(problem)
        tabulated = None if checks.traced((arguments, dict(keywords))) else _with_traced_inputs(
            unbound, problem, times, structures, programs or Programs())
    constant = {name: site_times._replace(layout=None) for name, site_times in times.items()}
    problem = problem.with_grids(constant)
    return unbound, problem, tabulated or problem


def _with_traced_inputs(unbound: UnboundModel, problem: Problem, times: Mapping[str, SiteTimes],
                        structures: list[Hashable], programs: Programs) -> Problem | None:
    """Return the problem with times, arrays among the arguments and time grids as leaves; None: it cannot be traced so.

    Not where a likelihood is a panel or has constraints, where its times depend on parameters, or where the structure
    of the model depends on the values of its arguments.
    """
    layouts = [times.get(site.name, SiteTimes(None)).layout for site in unbound.likelihoods]
    if problem.data is None or not layouts or any(layout is None for layout in layouts):
        return None
    tabulated = problem.with_traced_inputs({
        name: site_times._replace(layout=site_times.layout.padded()) for name, site_times in times.items()
        if site_times.layout is not None})
    key = tabulated.kind, *structures
    if key not in programs.is_traceable:
        try:
            programs.is_traceable[key] = unbound.structures(tabulated) == structures
        except Exception:  # of any kind: a model may do with its arguments what tracers cannot
            programs.is_traceable[key] = False
    return tabulated if programs.is_traceable[key] else None


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
