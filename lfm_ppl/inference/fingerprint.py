"""What a NumPyro model computes, recorded in one run of it: whether it is still the model that was compiled."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Hashable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.inference.handlers.likelihood_handler import LikelihoodHandler
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood, Panel
from lfm_ppl.model.observations.family import ObservationFamily


class Recording(NamedTuple):
    """What one run of a model leaves.

    Attributes:
        fingerprint: equal for models that compute the same, whatever their code has read in the meantime; None where
            what they compute is traced itself.
        times_follow: whether the times of the likelihood follow from parameters or data.
    """

    fingerprint: Hashable
    times_follow: bool


def record(energy: Callable[[jax.Array, Any], Any], size: int, y: Any) -> Recording:
    """Record a run of a model without its filter.

    A model is a function that may read anything: the name of a variable says nothing of its present value. What it
    computes is in the jaxpr of its prior, its dynamics and its observation, with the constants in it.

    Args:
        energy: from unconstrained parameters (d,) and data to the potential energy; runs the model.
        size: d.
        y: data of the model, an example for their shape.

    Raises:
        TypeError, ValueError, ...: whatever the model raises; JAX's errors for one that asks parameters or data for
            values.
    """
    traced, shape, settings = _traced(energy, size, y)
    times = len(jax.tree_util.tree_leaves(shape[2]))
    return Recording(_fingerprint(traced, settings), _follow(traced.jaxpr, times))


def portable(energy: Callable[[jax.Array, Any], Any], size: int, y: Any) -> str:
    """Return a digest that is equal in all processes for models that compute the same; arguments as in `record`.

    The order of the constants of a jaxpr, and with it the names of its variables, differ from process to process, and
    so does that of its outputs, among which are the fields of a NumPyro distribution. Here variables are numbered in
    the order of their use, a constant stands where it is first used, and outputs are sorted.
    """
    traced, _, settings = _traced(energy, size, y)
    found = hashlib.sha256()
    for word in (*_words(traced.jaxpr, traced.consts, sort=True), *settings):
        found.update(_without_addresses(word).encode() if isinstance(word, str) else word)
    return found.hexdigest()


def _words(jaxpr: Any, constants: Any, sort: bool = False) -> Iterator[str | bytes]:
    """Yield what a jaxpr does, in the order in which it does it; its outputs in any order, if they may be sorted."""
    values, numbers = dict(zip(jaxpr.constvars, constants, strict=True)), {v: i for i, v in enumerate(jaxpr.invars)}

    def named(variables: Any) -> Iterator[str | bytes]:
        for variable in variables:
            if hasattr(variable, "val"):
                yield f"{np.asarray(variable.val).tolist()}:{variable.aval} "
                continue
            if variable in values and variable not in numbers:
                yield _bytes(values[variable])
            yield f"{numbers.setdefault(variable, len(numbers))}:{variable.aval} "

    yield from named(jaxpr.invars)
    for equation in jaxpr.eqns:
        yield f"{equation.primitive}"
        yield from named(equation.invars)
        for name, value in sorted(equation.params.items()):
            yield f"{name}="
            yield from _parameter(value)
        yield from named(equation.outvars)
    yield "return "
    if not sort:
        yield from named(jaxpr.outvars)
        return
    yield from sorted(f"{numbers[v]}" if not hasattr(v, "val") and v in numbers
                      else f"{v.aval}{_bytes(v.val if hasattr(v, 'val') else values[v])!r}" for v in jaxpr.outvars)


def _parameter(value: Any) -> Iterator[str | bytes]:
    if hasattr(value, "jaxpr") and hasattr(value, "consts"):
        yield from _words(value.jaxpr, value.consts)
    elif hasattr(value, "eqns"):
        yield from _words(value, [()] * len(value.constvars))
    elif isinstance(value, (tuple, list)):
        for inner in value:
            yield from _parameter(inner)
    elif isinstance(value, (np.ndarray, jax.Array)):
        yield _bytes(value)
    elif isinstance(value, (set, frozenset)):
        yield from sorted(map(repr, value))
    elif not callable(value):  # of functions the jaxprs are there, too
        yield repr(value)


def _traced(energy: Callable[[jax.Array, Any], Any], size: int, y: Any) -> tuple[Any, Any, list[str]]:
    """Return the jaxpr of a run of a model without its filter, the shapes of what it gives, and the settings."""
    runs = []

    def run(z: jax.Array, y: Any, at: jax.Array, t: jax.Array) -> Any:
        runs.append(_ingredients(at, t))
        with runs[-1]:
            value = energy(z, y)
        return value, [part for part in runs[-1].values if part is not None], runs[-1].times

    traced, shape = jax.make_jaxpr(run, return_shape=True)(jnp.zeros(size), y, jnp.zeros(()), jnp.zeros(()))
    return traced, shape, runs[-1].settings


def signature(value: Any) -> Hashable:
    """Return what is equal for equal models and arguments; None where equality cannot be told."""
    leaves, structure = jax.tree_util.tree_flatten(value)
    if checks.traced(leaves):
        return None
    parts = tuple((np.shape(leaf), str(np.asarray(leaf).dtype), np.asarray(leaf).tobytes())
                  if isinstance(leaf, (np.ndarray, np.generic, jax.Array)) else (type(leaf), leaf) for leaf in leaves)
    try:
        hash((structure, parts))
    except TypeError:
        return None
    return structure, parts


class _ingredients(LikelihoodHandler):  # noqa: N801 (an effect handler, named as NumPyro names its handlers)
    """Runs everything of a likelihood that a user wrote, and not the filter: ``values``, and the other ``settings``."""

    def __init__(self, at: jax.Array, t: jax.Array) -> None:
        self.at, self.t = at, t
        self.values: list[Any] = []
        self.settings: list[str] = []
        self.times: list[Any] = []
        super().__init__()

    def replacement(self, likelihood: MarginalLikelihood | Panel, site: dict[str, Any]) -> Any:
        """Return a likelihood of one."""
        one = likelihood.first if isinstance(likelihood, Panel) else likelihood
        ssm, model = one.ssm, one.model
        # Tracers, so that the functions themselves are recorded, and not what they are at one point.
        t, w = self.t, jnp.full(ssm.input_dim, self.at)
        self.times.append(likelihood.times)
        self.values += eqx.filter(jax.tree_util.tree_leaves((likelihood, one.rule)), eqx.is_array_like) + [
            ssm.drift(w, t), ssm.dispersion(w, t), ssm.observe(w, t), ssm.obs_cov(w, t, 0), ssm.input_map(t),
            ssm.initial(), ssm.stack.feedback(), ssm.stack.dispersion(), ssm.stack.jump_table()]
        if model.deterministic_names:
            self.values.append(ssm.deterministics(w, t))
            self.settings.append(str(model.deterministic_names))
        if isinstance(model.observation, ObservationFamily):
            f = ssm.observe(w, t)
            self.values.append(model.observation.at(0).log_prob(f, f))
        self.settings.append(str((
            one.rule, one.steps, one.max_step, one.iterations, one.damping, one.tolerance, one.sites, model.state_names,
            model.output_names, model.force_names, model.units, model.nonlinear_inputs, model.observation.angular,
            ssm.stack.jump_times, site["name"])))
        if one.constrained:
            problem = one.bounded()
            self.values.append(problem.boxes(*ssm.split(w), t))
            self.settings.append(str((problem.boxes.constraints.labels, one.grid, one.draws)))
        return super().replacement(likelihood, site)


def _fingerprint(traced: Any, settings: list[str]) -> Hashable:
    constants = _constants(traced)
    if checks.traced(constants):
        return None
    parts = tuple((np.shape(one), _bytes(one)) for one in constants)
    return _without_addresses(str(traced.jaxpr)), parts, tuple(settings)


def _without_addresses(text: str) -> str:
    """Return a text without what is left of functions in it."""
    return re.sub(r"0x[0-9a-f]+", "", text)


def _follow(jaxpr: Any, times: int) -> bool:
    """Whether the last ``times`` outputs depend on an input but for the last two."""
    following = set(jaxpr.invars[:-2])
    for equation in jaxpr.eqns:
        if any(variable in following for variable in equation.invars if not hasattr(variable, "val")):
            following |= set(equation.outvars)
    outputs = jaxpr.outvars[len(jaxpr.outvars) - times:]
    return any(variable in following for variable in outputs if not hasattr(variable, "val"))


def _constants(traced: Any) -> list[Any]:
    """Return the constants of a jaxpr and of all within it."""
    found = list(traced.consts) if hasattr(traced, "consts") else []
    for equation in getattr(traced, "jaxpr", traced).eqns:
        for value in equation.params.values():
            for inner in value if isinstance(value, (tuple, list)) else [value]:
                if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                    found += _constants(inner)
    return found


def _bytes(constant: Any) -> bytes:
    is_key = jax.dtypes.issubdtype(getattr(constant, "dtype", float), jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(constant) if is_key else constant).tobytes()
