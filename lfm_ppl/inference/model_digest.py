"""A digest of a NumPyro model, equal in all processes, by which a stored run recognizes its model."""

from __future__ import annotations

import hashlib
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer.util import potential_energy

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.problem import Problem
from lfm_ppl.likelihoods.constrained_likelihood import ConstrainedLikelihood
from lfm_ppl.likelihoods.handlers.likelihood_handler import LikelihoodHandler
from lfm_ppl.likelihoods.likelihood import Likelihood
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.switching.switching_likelihood import Switching
from lfm_ppl.utils.programs import Program

_TIMES = 16
"""Number of times at which the functions of a model are evaluated."""


def model_digest(bound: BoundModel) -> str:
    """Return a digest of the values of prior, dynamics and observation, and of the settings of the likelihood.

    The point at whose moments its iterations start is one of these settings.

    They are evaluated at the prior's medians and at one other point, at 16 times and one state, without the filter.
    """
    times = np.unique(np.concatenate([np.ravel(part) for part in jax.tree.leaves(bound.times)]))
    selection = np.unique(np.linspace(0, len(times) - 1, _TIMES).round().astype(int))
    evaluate, recorder = bound.program("digest", lambda: _digest_program(bound))
    digest = hashlib.sha256(repr((bound.names, bound.size)).encode())
    for z in bound.probes():
        for leaf in jax.tree.leaves(evaluate(jnp.asarray(z), jnp.asarray(times[selection]), bound.problem)):
            is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
            array = np.asarray(jax.random.key_data(leaf) if is_key else leaf)
            digest.update(f"{array.shape}{array.dtype}".encode() + _rounded(array))
    if bound.anchor_point is not None:  # the moments are a function of it
        digest.update(np.asarray(bound.anchor_point, float).tobytes())
    digest.update(re.sub(r"0x[0-9a-f]+", "", recorder.settings).encode())  # addresses differ between processes
    return digest.hexdigest()


def _digest_program(bound: BoundModel) -> tuple[Any, _record_values]:
    """Return the compiled function from z, times and the problem to the values, and its recorder."""
    recorder = _record_values(bound.model)

    def evaluate(z: jax.Array, times: jax.Array, problem: Problem) -> tuple[jax.Array, list[Any]]:
        recorder.times = times
        prior = potential_energy(recorder, *problem.call(), bound.unravel(z))
        return prior, recorder.values

    return Program(evaluate), recorder


def _rounded(array: np.ndarray) -> bytes:
    """Return the bytes of an array, floating-point numbers to ten digits.

    XLA may order operations in another way in another process, which changes the last digits.
    """
    if array.dtype.kind != "f":
        return array.tobytes()
    finite = np.where(np.isfinite(array), array, 0.0)
    size = np.max(np.abs(finite), initial=0.0)
    fraction, exponent = np.frexp(np.where(np.abs(finite) > 1e-12 * size, array, 0.0))
    return np.round(np.asarray(fraction) * 2.0**33).tobytes() + np.asarray(exponent).tobytes()


class _record_values(LikelihoodHandler):  # noqa: N801 (an effect handler, named as NumPyro names its handlers)
    """Effect handler that evaluates the functions of the likelihood's model instead of the filter.

    Attributes:
        times: at which the functions are evaluated.
        values: arrays of the likelihood and values of its functions.
        settings: settings of the likelihood that are no arrays.
    """

    times: Any = None

    def __init__(self, model: Any) -> None:
        self.values: list[Any] = []
        self.settings = ""
        super().__init__(model)

    def begin(self) -> None:
        """Forget the previous run."""
        super().begin()
        self.values, self.settings = [], ""

    def replacement(self, likelihood: Likelihood, site: dict[str, Any]) -> Any:
        """Evaluate the models of the likelihood, of its first series for a panel."""
        distribution = likelihood.first
        ssm, model = distribution.ssm, distribution.model
        # Not the leaves of the distribution itself: NumPyro orders its fields by their hashes.
        names = sorted(set(type(likelihood).gather_pytree_data_fields()) - {"model", "models"})
        fields = [getattr(likelihood, name) for name in names]
        self.values += [*_arrays((fields, distribution.settings.rule)),
                        *(self._values(ssm) for ssm in distribution.ssms)]
        self.settings += repr((
            site["name"], distribution.settings, model.state_names, model.output_names,
            model.force_names, model.units, model.nonlinear_inputs, model.observation.angular,
            *([model.observation.period] if model.observation.angular else []),
            model.deterministic_names, ssm.stack.jump_times,
            [event.observation_first for event in model.events]))
        if isinstance(distribution, ConstrainedLikelihood):
            boxes, (x, u) = distribution.truncated_posterior().boxes, ssm.split(_point(ssm))
            self.values.append(jax.vmap(lambda t: boxes(x, u, t))(self.times))
            self.settings += repr((boxes.constraints.labels, distribution.grid, distribution.draws))
        elif isinstance(distribution, Switching):
            self.settings += repr((distribution.regime_names, distribution.merging))
        return super().replacement(likelihood, site)

    def _values(self, ssm: StateSpaceModel) -> list[Any]:
        """Return the arrays of a model, those that its functions read included, and values of the functions."""
        model, w = ssm.model, _point(ssm)

        def functions(t: jax.Array) -> list[Any]:
            values = [ssm.drift(w, t), ssm.dispersion(w, t), ssm.observe(w, t), ssm.obs_cov(w, t, 0), ssm.input_map(t),
                      ssm.deterministics(w, t)]
            if isinstance(model.observation, ObservationFamily):
                f = ssm.observe(w, t)
                values.append(model.observation.select_row(0).log_prob(f, f))
            return values

        tables = [value for function in model.traced_functions().values() for value in function.closed.consts]
        return [*_arrays((model, [table for table in tables if np.size(table) > 1])), ssm.initial(),
                ssm.stack.feedback(), ssm.stack.dispersion(), ssm.stack.jump_table(), ssm.state_maps(),
                jax.vmap(functions)(self.times)]


def _arrays(tree: Any) -> list[jax.Array]:
    return [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree) if eqx.is_array_like(leaf)]


def _point(ssm: StateSpaceModel) -> jax.Array:
    """Return state and forces (M + R,) at which functions are evaluated."""
    return 0.3 + 0.1 * jnp.arange(ssm.input_dim)
