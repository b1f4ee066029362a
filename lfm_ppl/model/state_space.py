"""Conversion of a latent force model to a state-space model.

1. Each force is a linear SDE. The joint state s = (x, z) stacks the physical state x and the states z of all forces.
2. The functions f and h of the model take the inputs w = (x, u) = K(t) s + k(t), where K contains the measurement rows
   and k the means of the forces.
3. `state_space` detects the structure of f and h from their jaxprs (`lfm_ppl.model.structure`). An input is non-linear
   if f is non-linear in it, averaged if its Jacobian varies, and constant otherwise.
4. Where several inputs enter through products only, a greedy choice makes as few of them as possible non-linear.
5. `Span` evaluates functions of time on the inner side of an interval's ends, where they may jump.
6. `check_times` checks the observation times.

Source: Hartikainen, Seppänen and Särkkä (2012), ICML, section 3.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.forces.sde import Stack, block_diagonal
from lfm_ppl.linearisation.input_selection import InputStructure
from lfm_ppl.model.events import StateMap, state_maps
from lfm_ppl.model.integration_plan import IntegrationPlan, integration_plan
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.structure import Pattern, pattern
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import matmul


class StateSpaceModel(eqx.Module):
    """The state-space form of a latent force model, with the joint state s = (x, z) of physical state and forces.

        dx = f(w, t) dt + G(w, t) dB,   dz = F z dt + L dbeta,   w = (x, u) = K(t) s + k(t),
        y_k = h(w(t_k), t_k) + r_k.

    Attributes:
        model: the latent force model.
        stack: its forces as one block-diagonal SDE.
        drift_structure: structure of f as a function of w.
        observation_structure: structure of h as a function of w.
        constant_measurement: whether K does not depend on time.
        constant_mean: whether k does not depend on time.
        plan: what is exact, what is integrated in steps, and what is linearised.
    """

    model: LatentForceModel
    stack: Stack
    drift_structure: InputStructure = eqx.field(static=True)
    observation_structure: InputStructure = eqx.field(static=True)
    constant_measurement: bool = eqx.field(static=True)
    constant_mean: bool = eqx.field(static=True)
    plan: IntegrationPlan = eqx.field(static=True)

    @property
    def physical_dim(self) -> int:
        """M, the number of physical states."""
        return self.model.initial_state.mean.shape[0]

    @property
    def force_dim(self) -> int:
        """Number of states of all forces."""
        return self.stack.state_dim

    @property
    def state_dim(self) -> int:
        """n, the number of joint states."""
        return self.physical_dim + self.force_dim

    @property
    def input_dim(self) -> int:
        """M + R, the number of inputs of f and h."""
        return self.physical_dim + len(self.stack.forces)

    @property
    def output_dim(self) -> int:
        """D, the number of outputs."""
        return len(self.model.output_names)

    @property
    def has_exact_likelihood(self) -> bool:
        """Whether the Gaussian filter computes the exact likelihood, up to the integration of known inputs.

        Dynamics and observation are linear then, with constant coefficients and Gaussian noise.
        """
        is_family = isinstance(self.model.observation, ObservationFamily)
        return self.plan.has_exact_transition and self.plan.has_exact_update and not is_family

    def initial(self) -> tuple[jax.Array, jax.Array]:
        """Return mean (n,) and covariance (n, n) of s at the initial time."""
        prior = self.model.initial_state
        mean = jnp.concatenate([prior.mean, jnp.zeros(self.force_dim, prior.mean.dtype)])
        return mean, jax.scipy.linalg.block_diag(prior.covariance, self.stack.initial_covariance())

    def input_map(self, t: Any) -> tuple[jax.Array, jax.Array]:
        """Return K (M + R, n) and k (M + R,) of w = K s + k at time t."""
        size = self.physical_dim
        matrix = block_diagonal([np.eye(size), self.stack.measurement(t)])
        return matrix, jnp.concatenate([jnp.zeros(size), self.stack.mean_at(t)])

    def inputs(self, s: jax.Array, t: Any) -> jax.Array:
        """Return w = (x, u) (M + R,) at the joint state s (n,) and time t."""
        matrix, offset = self.input_map(t)
        return matmul(matrix, s[:, None])[:, 0] + offset

    def split(self, w: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return x (M,) and u (R,) of w."""
        return w[: self.physical_dim], w[self.physical_dim:]

    def drift(self, w: jax.Array, t: Any) -> jax.Array:
        """Return f (M,), infusions included."""
        x, u = self.split(w)
        return jnp.asarray(self.model.drift(x, u, t), float)

    def dispersion(self, w: jax.Array, t: Any) -> jax.Array | None:
        """Return G (M, S), or None without process noise."""
        noise = self.model.process_noise
        return noise(*self.split(w), t) if callable(noise) else noise

    def observe(self, w: jax.Array, t: Any) -> jax.Array:
        """Return h (D,)."""
        x, u = self.split(w)
        return jnp.asarray(self.model.observation.function(x, u, t), float)

    def deterministics(self, w: jax.Array, t: Any) -> jax.Array:
        """Return the values (Q,) of the deterministics of the model."""
        x, u = self.split(w)
        model = self.model
        values = [jnp.asarray(model.deterministics[name](x, u, t), float) for name in model.deterministic_names]
        return jnp.stack(values) if values else jnp.zeros(0)

    def obs_cov(self, w: jax.Array, t: Any, row: Any) -> jax.Array:
        """Return R (D, D)."""
        x, u = self.split(w)
        return self.model.observation.covariance_at(x, u, t, row)

    def state_maps(self) -> StateMap | None:
        """Return the maps of the joint state at the events of the model, see `lfm_ppl.model.events.state_maps`."""
        return state_maps(self.model.events, self.model.state_names, self.state_dim)


def state_space(model: LatentForceModel) -> StateSpaceModel:
    """Return the state-space model of a latent force model, with the structure of its functions.

    Raises:
        ValueError: ``nonlinear_inputs`` omits an input that enters non-linearly; the message names it.
        TypeError: not a latent force model.
    """
    if not isinstance(model, LatentForceModel):
        raise TypeError(f"model must be an lfm.LatentForceModel, got {type(model).__name__}.")
    stack = Stack(model.force_list)
    size, total = len(model.state_names), len(model.state_names) + len(stack.forces)
    if total == 0:
        raise ValueError("the model has neither states nor forces.")

    def on_inputs(function: Callable[..., Any]) -> Callable[[jax.Array], jax.Array]:
        return lambda v: jnp.ravel(jnp.asarray(function(v[:size], v[size:total], v[total]), float))

    drift = pattern(on_inputs(model.drift), total + 1)
    extra = _dependence(on_inputs(model.process_noise), total) if callable(model.process_noise) else ()
    observe = pattern(on_inputs(model.observation.function), total + 1)
    varying = (_dependence(on_inputs(model.observation.covariance), total)
               if model.observation.varies_with_state else ())
    declared = None
    if model.nonlinear_inputs is not None:
        names = (*model.state_names, *model.force_names)
        declared = tuple(names.index(name) for name in model.nonlinear_inputs)
        _check_declared(on_inputs(model.dynamics), declared, names, drift)
    structures = (
        _classify(drift, extra, declared), _classify(observe, varying, None),
        not pattern(lambda v: jnp.ravel(stack.measurement(v[0])), 1).jacobian.any(),
        not pattern(lambda v: stack.mean_at(v[0]), 1).jacobian.any())
    return StateSpaceModel(model, stack, *structures, integration_plan(model, *structures))


def _dependence(function: Callable[[jax.Array], jax.Array], total: int) -> tuple[int, ...]:
    """Return the indices of the inputs, without time, on which a function depends."""
    depends = np.asarray(pattern(function, total + 1).jacobian.any(axis=0))
    return tuple(int(index) for index in np.flatnonzero(depends[:total]))


def _classify(sparsity: Pattern, extra: tuple[int, ...], declared: tuple[int, ...] | None) -> InputStructure:
    """Split the inputs into points, averaged and constant ones.

    Args:
        sparsity: pattern of the function; its last input is time.
        extra: further inputs that must be points, since a noise covariance depends on them.
        declared: inputs declared non-linear by the user, instead of the detected ones; None: detect them.
    """
    total = sparsity.hessian.shape[0] - 1
    curved = sparsity.hessian[:total, :total]
    nonlinear = [j for j in range(total) if curved[j].any()]
    if declared is not None:
        points = sorted(set(declared) | set(extra))
    else:
        # A set of inputs without a curved pair among themselves is linear given the other inputs. A greedy choice, by
        # the fewest pairs and then the latest index (forces), makes this set large and leaves few inputs to the points.
        linear_given: list[int] = []
        for j in sorted(nonlinear, key=lambda j: (curved[j].sum(), -j)):
            if j not in extra and not curved[j, [*linear_given, j]].any():
                linear_given.append(j)
        points = sorted((set(nonlinear) - set(linear_given)) | set(extra))
    linear_inputs = [j for j in range(total) if j not in points]
    averaged = tuple(j for j in linear_inputs if sparsity.hessian[j].any())
    return InputStructure(
        tuple(points), averaged, tuple(j for j in linear_inputs if j not in averaged),
        tuple(tuple(bool(v) for v in row[:total]) for row in sparsity.jacobian),
        bool(sparsity.jacobian[:, total].any()),
    )


def _check_declared(function: Callable[[jax.Array], jax.Array], declared: tuple[int, ...], names: tuple[str, ...],
                    sparsity: Pattern) -> None:
    """Raise ValueError if an undeclared input has a second derivative at random inputs.

    Traced parameters are replaced by random numbers.
    """
    total = len(names)
    undeclared = [j for j in range(total) if j not in declared]
    if not sparsity.hessian[np.ix_(undeclared, undeclared)].any():
        return
    closed = jax.make_jaxpr(function)(jnp.zeros(total + 1))
    generator = np.random.default_rng(0)
    with jax.ensure_compile_time_eval():
        consts = [generator.uniform(0.5, 1.5, np.shape(value)) if isinstance(value, jax.core.Tracer) else value
                  for value in closed.consts]
        hessian = jax.hessian(lambda v: jnp.stack(jax.core.eval_jaxpr(closed.jaxpr, consts, v))[0])
        curvature = np.max([np.nan_to_num(np.abs(hessian(jnp.asarray(generator.normal(size=total + 1))))).max(axis=0)
                            for _ in range(5)], axis=0)
    omitted_pairs = [(i, j) for i in undeclared for j in undeclared if curvature[i, j] > 1e-12]
    if omitted_pairs:
        i, j = omitted_pairs[0]
        pair = f"{names[i]!r}" if i == j else f"{names[i]!r} together with {names[j]!r}"
        raise ValueError(f"nonlinear_inputs leaves out {pair}, but the dynamics is not linear in it. Add it, or leave "
                         "nonlinear_inputs at None: the structure is then found automatically.")


_INSET = 4.0
"""Distance from the end of an interval at which functions are evaluated, in units of rounding of the times."""


class Span(NamedTuple):
    """The times of an interval, or of its end after some offset, at which functions of time are evaluated.

    A function of time may jump at either end of an interval, where the interval needs the value on its inner side.
    Times are therefore clipped to ``lower`` and ``upper``, which lie inside of the interval by a few units of rounding.

    Attributes:
        start: origin of time offsets.
        lower, upper: first and last time at which functions are evaluated.
    """

    start: Any
    lower: Any
    upper: Any

    @classmethod
    def between(cls, start: Any, end: Any, length: Any) -> Span:
        """Return the span of an interval whose ``length`` is known to more digits than ``end - start``."""
        depth = inset(start, end, length)
        return cls(start, jax.lax.stop_gradient(start + depth), jax.lax.stop_gradient(end - depth))

    def time(self, offset: Any = 0.0) -> jax.Array:
        """Return the clipped time at an offset from the start, with the derivative of the unclipped time."""
        t = self.start + offset
        return t + jax.lax.stop_gradient(jnp.clip(t, self.lower, self.upper) - t)

    def shifted(self, offset: Any) -> Span:
        """Return the span that starts at an offset from the start of this one."""
        return self._replace(start=self.start + offset)


def inset(start: Any, end: Any, length: Any, scale: Any = 0.0) -> Any:
    """Return the distances (N,) from the ends of intervals at which functions of time are evaluated.

    Args:
        start: start times of the intervals.
        end: end times of the intervals.
        length: lengths of the intervals.
        scale: magnitude of other numbers with which functions compare times, such as the times of a table.
    """
    xp = jnp if checks.traced((start, end, length, scale)) else np
    size = xp.maximum(xp.maximum(xp.abs(start), xp.abs(end)), scale)
    depth = xp.minimum(_INSET * np.finfo(jnp.result_type(float)).eps * size, 0.5 * xp.asarray(length))
    return jax.lax.stop_gradient(depth) if xp is jnp else depth


def check_times(times: Any, initial_time: Any) -> np.ndarray | None:
    """Check observation times; return them as a NumPy array, or None if they are traced.

    Raises:
        ValueError: the times are not a vector, empty, not finite, not sorted, or before the initial time; the message
            names the row.
    """
    if np.ndim(times) != 1 or np.shape(times)[0] == 0:
        raise ValueError(f"times must be a vector (T,) with at least one entry, got shape {np.shape(times)}.")
    checks.finite("times", times)
    concrete_times = checks.concrete(times)
    if concrete_times is None:
        return None
    disordered = np.flatnonzero(np.diff(concrete_times) < 0)
    if disordered.size:
        row = int(disordered[0]) + 1
        raise ValueError(f"times must not go back: row {row} is {concrete_times[row]:g} after "
                         f"{concrete_times[row - 1]:g}. Sort the rows by time; equal times are replicates and are "
                         "allowed.")
    start = None if initial_time is None else checks.concrete(initial_time)
    if start is not None and concrete_times[0] < start:
        raise ValueError(f"times[0] = {concrete_times[0]:g} lies before the model's initial_time = {float(start):g}; "
                         "set initial_time to the first time or earlier.")
    return concrete_times.astype(float)
