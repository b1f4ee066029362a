"""What a NumPyro model computes, recorded in one run of it: whether it is still the model that was compiled."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.inference.handlers.likelihood_handler import LikelihoodHandler
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood, Panel


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
    runs = []

    def run(z: jax.Array, y: Any, at: jax.Array, t: jax.Array) -> Any:
        runs.append(_ingredients(at, t))
        with runs[-1]:
            value = energy(z, y)
        return value, [part for part in runs[-1].values if part is not None], runs[-1].times

    traced, shape = jax.make_jaxpr(run, return_shape=True)(jnp.zeros(size), y, jnp.zeros(()), jnp.zeros(()))
    times = len(jax.tree_util.tree_leaves(shape[2]))
    return Recording(_fingerprint(traced, runs[-1].settings), _follow(traced.jaxpr, times))


def digest(energy: Callable[[jax.Array, Any], Any], size: int, y: Any) -> str:
    """Return a short text that is equal for models that compute the same, in other processes, too; see `record`.

    It is made of what a model computes, without its filter, at one point, to eight digits: the text of a jaxpr and the
    order of what is in it differ from process to process.
    """
    settings: list[str] = []

    def run(z: jax.Array, y: Any, at: jax.Array, t: jax.Array) -> Any:
        with _ingredients(at, t) as recorded:
            value = energy(z, y)
        settings[:] = recorded.settings
        return value, [part for part in recorded.values if part is not None], recorded.times

    found = jax.jit(run)(jnp.linspace(-0.3, 0.4, size), y, jnp.asarray(0.23), jnp.asarray(0.41))
    numbers = [[f"{number:.7e}" for number in np.asarray(_number(one), float).ravel()]
               for one in jax.tree_util.tree_leaves(found)]
    text = re.sub(r"0x[0-9a-f]+", "", repr((sorted(numbers), settings)))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


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
        self.settings.append(str((
            one.rule, one.steps, one.max_step, one.iterations, one.damping, one.tolerance, model.state_names,
            model.output_names, model.force_names, model.units, model.nonlinear_inputs, model.observation.angular,
            ssm.stack.jump_times, site["name"])))
        return super().replacement(likelihood, site)


def _fingerprint(traced: Any, settings: list[str]) -> Hashable:
    constants = _constants(traced)
    if checks.traced(constants):
        return None
    parts = tuple((np.shape(one), _bytes(one)) for one in constants)
    # What is left of functions in a jaxpr is their address.
    return re.sub(r"0x[0-9a-f]+", "", str(traced.jaxpr)), parts, tuple(settings)


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
    return np.asarray(_number(constant)).tobytes()


def _number(constant: Any) -> Any:
    """Return the numbers of a random key, and anything else as it is."""
    is_key = jax.dtypes.issubdtype(getattr(constant, "dtype", float), jax.dtypes.prng_key)
    return jax.random.key_data(constant) if is_key else constant
