"""The latent force model in the form in which users write it.

`LatentForceModel` holds dynamics, forces, observation and initial state. Its constructor

1. checks types, names and shapes of the arguments,
2. traces every function once (`lfm_ppl.model.user_functions`), and checks the shape of its result and its indices,
3. refuses numbers made in single precision where JAX computes in double precision,
4. evaluates every function at the prior mean, outside of compiled code; the results must be finite. Functions of time
   wait for the initial time (`check_at`).

Source: Hartikainen, Seppänen and Särkkä (2012), ICML, section 3.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.forces.sde import Force
from lfm_ppl.model.events import Event, Infusion
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.inputs import Input, InputRead, check_reads, has_inputs, input_reads
from lfm_ppl.model.model_arguments import (
    check_types,
    checked_dispersion,
    checked_events,
    checked_functions,
    checked_names,
    describe_shape,
    forces_by_name,
)
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.time_degree import degree_in_time
from lfm_ppl.model.user_functions import TracedFunction, own_functions, trace_function
from lfm_ppl.utils import checks

_ROOTS = {"sqrt", "rsqrt", "cbrt", "pow"}
"""Primitives whose derivative at zero may be infinite."""


class LatentForceModel(eqx.Module):
    r"""A mechanistic model driven by unobserved forces.

        dx = f(x, u(t), t) dt + G(x, u(t), t) dB,    u_r(t) ~ GP,    y_k = h(x, u, t_k) + r_k.

    Args:
        dynamics: ``f(x, u, t) -> (M,)``; a function or an Equinox module. ``x`` is (M,), ``u`` is (R,) in the order
            of ``forces``.
        forces: name -> force; empty is legal. A sequence of (name, force) pairs is accepted too.
        observation: a Gaussian observation or an observation family.
        initial_state: distribution of x at the initial time; zero covariance is legal.
        process_noise: the dispersion G (M, S) of a unit Brownian motion on x, or a function ``(x, u, t) -> (M, S)``.
        initial_time: time of the initial state; None: the first time of the data.
        nonlinear_inputs: names of the states and forces that enter f non-linearly. None: they are detected from f.
        state_names: M names, for results and plots.
        output_names: D names of the components of y.
        units: units of "time", states, outputs, forces and deterministics, by name.
        deterministics: name -> ``(x, u, t) -> ()``, functions of state and forces, such as a rate ``softplus(u)``, a
            flow or a reproduction number. Results contain their trajectories and plot them, like
            ``numpyro.deterministic`` for parameters; they do not change the likelihood.
        events: what happens to the state at given times, `Dose`, `Infusion` and `Reset`; none by default.

    Functions that take a built model (`lfm.filter`, `lfm.smooth`, ...) read f, h and the others once for each model, as
    `jax.jit` does: where a variable that they read has changed, build the model again.

    Raises:
        ValueError, TypeError: f returns a wrong shape; a function takes an entry out of range, or is not made of JAX
            operations; names repeat or their number is wrong; the process noise has a wrong shape; a force was
            constructed in single precision. Outside of compiled code also: a function is not finite at the prior mean.
            (A function of time is evaluated once the initial time is known, here or with the data.)

    Example:
        >>> import jax.numpy as jnp
        >>> import lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     dynamics=lambda x, u, t: u - 0.5 * x,
        ...     forces={"drive": lfm.Matern(1.0, 2.0)},
        ...     observation=lfm.GaussianObservation(lambda x, u, t: x, sd=0.1),
        ...     initial_state=lfm.Gaussian(jnp.zeros(1), jnp.eye(1)),
        ... )
        >>> model.state_names
        ('x0',)

    Source: Hartikainen, Seppänen and Särkkä (2012), section 3.
    """

    dynamics: Callable[..., jax.Array]
    forces: dict[str, Force]
    observation: GaussianObservation | ObservationFamily
    initial_state: Gaussian
    process_noise: Any
    initial_time: Any
    events: tuple[Event, ...]
    infusions: tuple[tuple[Any, Input], ...]
    force_names: tuple[str, ...] = eqx.field(static=True)
    deterministics: dict[str, Callable[..., jax.Array]]
    deterministic_names: tuple[str, ...] = eqx.field(static=True)
    nonlinear_inputs: tuple[str, ...] | None = eqx.field(static=True)
    state_names: tuple[str, ...] = eqx.field(static=True)
    output_names: tuple[str, ...] = eqx.field(static=True)
    unit_items: tuple[tuple[str, str], ...] = eqx.field(static=True)
    _has_limited_inputs: bool = eqx.field(static=True)
    _has_integrated_inputs: bool = eqx.field(static=True)
    _functions_with_roots: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        dynamics: Callable[..., jax.Array],
        forces: Mapping[str, Force] | Sequence[tuple[str, Force]],
        observation: GaussianObservation | ObservationFamily,
        initial_state: Gaussian,
        process_noise: Any = None,
        initial_time: Any = None,
        nonlinear_inputs: Sequence[str] | None = None,
        state_names: Sequence[str] | None = None,
        output_names: Sequence[str] | None = None,
        units: Mapping[str, str] | None = None,
        deterministics: Mapping[str, Callable[..., jax.Array]] | None = None,
        events: Sequence[Event] = (),
    ):
        check_types(dynamics, observation, initial_state)
        self.force_names, self.forces = forces_by_name(forces)
        self.dynamics, self.initial_state = own_functions(dynamics), initial_state
        self.observation = own_functions(observation.with_output_sizes(
            lambda function: self._trace_observation(function).shape.shape[0]))
        if initial_time is not None:
            checks.finite("initial_time", initial_time)
        # A concrete time stays a NumPy array: inside jit jnp.asarray returns a tracer, but time grids need the number.
        concrete_time = None if initial_time is None else checks.concrete(initial_time)
        self.initial_time = initial_time if concrete_time is None else concrete_time.astype(float)
        size = initial_state.mean.shape[0]
        self.state_names = checked_names("state_names", state_names, size, "x")
        if overlap := set(self.state_names) & set(self.force_names):
            raise ValueError(f"the name {sorted(overlap)[0]!r} is used for a state and for a force; rename one.")
        self.events = checked_events(events, self.state_names)
        self.infusions = tuple((event.direction_in(self.state_names), event.rate_of_change())
                               for event in self.events if isinstance(event, Infusion) and len(event.times))
        self.process_noise = own_functions(process_noise if callable(process_noise)
                                           else checked_dispersion(process_noise, size))
        self.deterministics = own_functions(checked_functions(deterministics, {*self.state_names, *self.force_names}))
        self.deterministic_names = tuple(self.deterministics)
        functions = self.traced_functions()
        self.output_names = checked_names("output_names", output_names, functions["observation"].shape.shape[0], "y")
        if isinstance(self.observation, ObservationFamily):
            self.observation.check_shapes(len(self.output_names))
        self.unit_items = tuple(sorted((units or {}).items()))  # JAX sorts a dict that is an argument
        self.nonlinear_inputs = None if nonlinear_inputs is None else tuple(nonlinear_inputs)
        for name in self.nonlinear_inputs or ():
            checks.one_of("name in nonlinear_inputs", name, (*self.state_names, *self.force_names))
        self._functions_with_roots = tuple(name for name, function in functions.items() if _ROOTS & function.names())
        self._has_limited_inputs = any(has_inputs(function, is_limited=True) for function in functions.values())
        self._has_integrated_inputs = any(has_inputs(function) for function in _integrated_functions(functions))
        self._check_precision()
        if self.initial_time is not None or not any(
                function.depends_on_time for name, function in functions.items() if not name.startswith("determin")):
            self._check_finite(self.initial_time)

    def drift(self, x: jax.Array, u: jax.Array, t: Any) -> jax.Array:
        """Return dx/dt (M,): the dynamics, and the infusions, whose rates are constant between their ends."""
        change = self.dynamics(x, u, t)
        for direction, rate in self.infusions:
            change = change + direction * rate(t)
        return change

    @property
    def units(self) -> dict[str, str]:
        """Units by name."""
        return dict(self.unit_items)

    @property
    def force_list(self) -> tuple[Force, ...]:
        """The forces in their order."""
        return tuple(self.forces[name] for name in self.force_names)

    @property
    def _arguments(self) -> tuple[Any, Any, Any]:
        """x, u and t for traces."""
        u = jax.ShapeDtypeStruct((len(self.force_names),), jnp.result_type(float))
        return self.initial_state.mean, u, jnp.zeros(())

    def _trace_observation(self, function: Callable) -> TracedFunction:
        """Return a traced observation function; raise ValueError unless it returns a vector."""
        traced = trace_function("the observation function", "h(x, u, t)", function, *self._arguments)
        if len(getattr(traced.shape, "shape", ())) != 1:
            raise ValueError(f"the observation function must return a vector (D,), got {describe_shape(traced.shape)}. "
                             "For one output, return x[:1] or jnp.array([...]).")
        return traced

    def traced_functions(self) -> dict[str, TracedFunction]:
        """Return the traced functions of the model by name, after checks of their shapes and indices."""
        arguments, observation = self._arguments, self.observation
        functions = {"dynamics": trace_function("dynamics", "f(x, u, t)", self.dynamics, *arguments)}
        if callable(self.process_noise):
            functions["process_noise"] = trace_function("process_noise", "(x, u, t)", self.process_noise, *arguments)
        self._check_state_shapes(**functions)
        functions["observation"] = self._trace_observation(observation.function)
        (outputs,) = functions["observation"].shape.shape
        shape = jax.eval_shape(observation.covariance_at, *arguments, 0).shape
        if shape != (outputs, outputs):
            raise ValueError(f"the observation has {outputs} components, so its sd must be a number or ({outputs},), "
                             f"or its covariance ({outputs},) or ({outputs}, {outputs}); the covariance is {shape}.")
        if any(not 0 <= index < outputs for index in observation.angular):
            raise ValueError(f"angular indices must lie in 0..{outputs - 1}, got {observation.angular}.")
        if callable(observation.covariance):
            functions["covariance"] = trace_function("the observation covariance", "(x, u, t)", observation.covariance,
                                                     *arguments)
        for name, function in self.deterministics.items():
            traced = trace_function(f"the deterministic {name!r}", "(x, u, t)", function, *arguments)
            shape = getattr(traced.shape, "shape", traced.shape)
            if shape != ():
                raise ValueError(f"{traced.label} must return one number, shape (); it returned {shape}. The entry of "
                                 "a vector is x[0], u[0].")
            functions[f"deterministic {name}"] = traced
        for traced in functions.values():
            traced.check_indices(("x", "u"))
        means = {f"mean of {name}": trace_function(f"the mean of the force {name!r}", "(t)", force.mean_at,
                                                  arguments[2])
                 for name, force in self.forces.items() if callable(force.mean)}
        return functions | means

    def _check_state_shapes(self, dynamics: TracedFunction, process_noise: TracedFunction | None = None) -> None:
        """Raise ValueError unless dynamics and process noise have a row for each state."""
        size, shape = self.initial_state.mean.shape[0], getattr(dynamics.shape, "shape", None)
        if shape != (size,):
            raise ValueError(f"dynamics must return one derivative for each of the {size} entries of "
                             f"initial_state.mean, shape ({size},); it returned {describe_shape(dynamics.shape)}."
                             f"{'' if shape else ' Return jnp.array([...]).'}")
        noise: tuple[int, ...] = (size, 0) if process_noise is None else getattr(process_noise.shape, "shape", ())
        if len(noise) != 2 or noise[0] != size:
            raise ValueError(f"process_noise must return a dispersion matrix ({size}, S), got {noise}.")

    def _check_precision(self) -> None:
        """Raise ValueError if a part of the model has single precision while JAX computes in double precision."""
        precision = jnp.result_type(float)
        parts = {**{f"the force {name!r}": force for name, force in self.forces.items()},
                 "initial_state": self.initial_state, "the observation covariance": self.observation.covariance,
                 "process_noise": self.process_noise}
        for name, part in parts.items():
            for leaf in jax.tree_util.tree_leaves(part):
                dtype = getattr(leaf, "dtype", precision)
                if jnp.issubdtype(dtype, jnp.floating) and jnp.finfo(dtype).bits < jnp.finfo(precision).bits:
                    raise ValueError(f"{name} holds numbers in {dtype}, made before JAX was switched to {precision}; "
                                     "only seven digits of them are right. Call "
                                     'jax.config.update("jax_enable_x64", True) first, and make it after that.')

    def check_span(self, first: float, last: float) -> None:
        """Check the forces against data that span ``first`` to ``last``, see `lfm_ppl.Force.check_span`."""
        for name, force in self.forces.items():
            force.check_span(name, first, last)

    def check_at(self, time: Any, rows: int) -> None:
        """Check the functions at a time, and the parameters of the observation against the number of rows.

        Args:
            time: time at which the functions are evaluated, at the prior mean.
            rows: number of observations.

        Raises:
            ValueError: a function is not finite, the observation covariance is not a covariance matrix, or the number
                of matrices differs from the number of observations.
        """
        if isinstance(self.observation, ObservationFamily):
            self.observation.check_rows(rows)
        covariance = self.observation.covariance
        if np.ndim(covariance) == 3 and np.shape(covariance)[0] != rows:
            raise ValueError(f"the sd or covariance of the observation has {np.shape(covariance)[0]} rows, one for "
                             f"each time, but there are {rows} times.")
        self._check_precision()
        self._check_finite(time)

    def check_inputs(self, first: float, last: float) -> None:
        """Check that the tables of known inputs cover the times of the model from ``first`` to ``last``.

        Raises:
            ValueError: an input with ``outside="error"`` is read beyond its table; with "warn" it is a warning.
        """
        if self._has_limited_inputs:
            check_reads(tuple(self.traced_functions().values()), first, last)

    def input_reads(self, first: float, last: float) -> list[InputRead]:
        """Return the reads of known inputs between observations, see `lfm_ppl.model.inputs.input_reads`."""
        functions = _integrated_functions(self.traced_functions()) if self._has_integrated_inputs else []
        return input_reads(functions, first, last) + [
            InputRead("previous", _concrete(rate.times), _concrete(rate.values), 1.0, 0.0)
            for _, rate in self.infusions]

    @property
    def has_quadratic_inputs(self) -> bool:
        """Whether what is integrated is at most quadratic in time, between breakpoints of its known inputs."""
        return all(degree_in_time(function) <= 2.0 for function in _integrated_functions(self.traced_functions()))

    def _check_finite(self, time: Any) -> None:
        """Evaluate the functions at the prior mean, if it is concrete; ``time`` is None if it does not matter."""
        x = self.initial_state.mean
        # Inside compiled code the result of this addition is a tracer, even for a concrete time.
        t = jnp.asarray(0.0 if time is None else time, float) + 0.0
        u = None if checks.traced((self, t)) else jnp.asarray([force.mean_at(t) for force in self.force_list], float)
        if u is None or checks.traced(u):
            return
        observation = self.observation
        when = "" if time is None else f", t = {float(time):g}"
        where = f"at the prior mean x = {np.asarray(x)}, u = {np.asarray(u)}{when}"
        for label, function, names in (("dynamics", self.dynamics, self.state_names),
                                       ("observation function", observation.function, self.output_names)):
            value = checks.concrete(function(x, u, t))
            if value is not None and not np.all(np.isfinite(value)):
                raise ValueError(f"the {label} returned {value} {where}: the entry for "
                                 f"{names[int(np.argmin(np.isfinite(value)))]!r} is not finite. Change "
                                 "initial_state.mean, or guard the expression (for example jnp.maximum).")
            if label.split()[0] in self._functions_with_roots:
                self._check_derivative(label, function, names, (x, u, t), where)
            if value is not None and label != "dynamics" and isinstance(observation, ObservationFamily):
                observation.check_predictor(value, where, names)
        dispersion = checks.concrete(self.process_noise(x, u, t)) if callable(self.process_noise) else None
        if dispersion is not None and not np.all(np.isfinite(dispersion)):
            raise ValueError(f"process_noise is not finite {where}: {dispersion.tolist()}.")
        if callable(observation.covariance):
            checks.covariance_matrix(f"the observation covariance {where}",
                                     observation.covariance_at(x, u, t, jnp.asarray(0)))

    @staticmethod
    def _check_derivative(label: str, function: Callable, names: Sequence[str], arguments: tuple, where: str) -> None:
        """Warn if the derivative is not finite, such as that of a square root at zero, which has a finite value."""
        x, u, t = arguments
        derivative = checks.concrete(jax.jacfwd(lambda w: function(w[:len(x)], w[len(x):], t))(jnp.concatenate([x, u])))
        if derivative is not None and not np.all(np.isfinite(derivative)):
            is_finite = np.isfinite(np.asarray(derivative)).reshape(len(names), -1).all(axis=1)
            checks.warn(f"the derivative of the {label} is not finite {where}: that of the entry for "
                        f"{names[int(np.argmin(is_finite))]!r}. Likelihood and gradient may not be finite either. "
                        "Change initial_state.mean, or guard the expression, as in jnp.sqrt(jnp.maximum(x, 1e-6)).")


def _integrated_functions(functions: Mapping[str, TracedFunction]) -> list[TracedFunction]:
    """Return the functions that are evaluated between observations."""
    return [function for name, function in functions.items()
            if name in ("dynamics", "process_noise") or name.startswith("mean of ")]


def _concrete(values: Any) -> Any:
    """Return a NumPy array unless a value is traced: arithmetic on JAX arrays gives tracers in compiled code."""
    return values if checks.traced(values) else np.asarray(values)
