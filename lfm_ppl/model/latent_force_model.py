"""The latent force model as its user writes it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.forces.sde import Force
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.inputs import InputRead, check_reads, has_inputs, input_reads, reads_inputs
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.user_functions import Traced, trace


class LatentForceModel(eqx.Module):
    r"""A mechanistic model pushed by unobserved forces.

        dx = f(x, u(t), t) dt + G(x, u(t), t) dB,    u_r(t) ~ GP,    y_k = h(x, u, t_k) + r_k.

    Args:
        dynamics: ``f(x, u, t) -> (M,)``; a function or an Equinox module. ``x`` is (M,), ``u`` is (R,) in the order
            of ``forces``.
        forces: name -> force; empty is legal. A sequence of (name, force) pairs is accepted too.
        observation: what is measured.
        initial_state: distribution of x at the initial time; zero covariance is legal.
        process_noise: the dispersion G (M, S) of a unit Brownian motion on x, or a function ``(x, u, t) -> (M, S)``.
        initial_time: when the initial state holds; None: the first time of the data.
        nonlinear_inputs: names of the states and forces that enter f non-linearly. None: found from f itself.
        state_names: M names, for results and plots.
        output_names: D names of the components of y.
        units: unit of "time", of states, outputs, forces and deterministics, by name.
        deterministics: name -> ``(x, u, t) -> ()``, what follows from state and forces: a rate ``softplus(u)`` where
            the dynamics use it, a flow, a reproduction number. Drawn along every trajectory, as
            ``numpyro.deterministic`` is of the parameters, with a figure of its own; it changes no likelihood.

    Raises:
        ValueError, TypeError: f returns a wrong shape; a function takes an entry out of range, or is not made of JAX
            operations; names repeat or are of a wrong number; the process noise has a wrong shape; a force was made in
            single precision. Outside of compiled code also: a function is not finite at the prior mean. (One that
            depends on time is tried where the initial time is known, here or with the data.)

    Example:
        >>> import jax.numpy as jnp
        >>> import lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     dynamics=lambda x, u, t: u - 0.5 * x,
        ...     forces={"drive": lfm.Matern(1.0, 2.0)},
        ...     observation=lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])),
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
    force_names: tuple[str, ...] = eqx.field(static=True)
    deterministics: dict[str, Callable[..., jax.Array]]
    deterministic_names: tuple[str, ...] = eqx.field(static=True)
    nonlinear_inputs: tuple[str, ...] | None = eqx.field(static=True)
    state_names: tuple[str, ...] = eqx.field(static=True)
    output_names: tuple[str, ...] = eqx.field(static=True)
    unit_items: tuple[tuple[str, str], ...] = eqx.field(static=True)
    _reads_inputs: bool = eqx.field(static=True)
    _integrates_inputs: bool = eqx.field(static=True)
    _with_roots: tuple[str, ...] = eqx.field(static=True)

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
    ):
        _check_types(dynamics, observation, initial_state)
        self.force_names, self.forces = _named_forces(forces)
        self.dynamics, self.initial_state = dynamics, initial_state
        self.observation = self._resolved(observation)
        if initial_time is not None:
            checks.finite("initial_time", initial_time)
        # Kept as NumPy where it is known: inside jit jnp.asarray would make a tracer of it, too late to plan rows by.
        known = None if initial_time is None else checks.concrete(initial_time)
        self.initial_time = initial_time if known is None else known.astype(float)
        size = initial_state.mean.shape[0]
        self.state_names = _names("state_names", state_names, size, "x")
        if overlap := set(self.state_names) & set(self.force_names):
            raise ValueError(f"the name {sorted(overlap)[0]!r} is used for a state and for a force; rename one.")
        self.process_noise = process_noise if callable(process_noise) else _dispersion(process_noise, size)
        self.deterministics = _functions(deterministics, {*self.state_names, *self.force_names})
        self.deterministic_names = tuple(self.deterministics)
        functions = self._traced()
        self.output_names = _names("output_names", output_names, functions["observation"].shape.shape[0], "y")
        if isinstance(self.observation, ObservationFamily):
            self.observation.check_shapes(len(self.output_names))
        self.unit_items = tuple((units or {}).items())
        self.nonlinear_inputs = None if nonlinear_inputs is None else tuple(nonlinear_inputs)
        for name in self.nonlinear_inputs or ():
            checks.one_of("name in nonlinear_inputs", name, (*self.state_names, *self.force_names))
        self._with_roots = tuple(name for name, function in functions.items() if function.takes_roots)
        self._reads_inputs = any(reads_inputs(function) for function in functions.values())
        self._integrates_inputs = any(has_inputs(function) for function in _integrated(functions))
        self._check_precision()
        if self.initial_time is not None or not any(
                function.depends_on_time for name, function in functions.items() if not name.startswith("determin")):
            self._check_finite(self.initial_time)

    @property
    def units(self) -> dict[str, str]:
        """Units by name."""
        return dict(self.unit_items)

    @property
    def force_list(self) -> tuple[Force, ...]:
        """The forces in their order."""
        return tuple(self.forces[name] for name in self.force_names)

    def _resolved(self, observation: Any) -> GaussianObservation | ObservationFamily:
        """Return the observation, a family told the number of its outputs."""
        if not isinstance(observation, ObservationFamily):
            return observation
        u = jax.ShapeDtypeStruct((len(self.force_names),), jnp.result_type(float))

        def size(function: Callable) -> int:
            traced = trace("the observation function", "h(x, u, t)", function, self.initial_state.mean, u,
                           jnp.zeros(()))
            return _vector_size(traced.shape)

        return observation.resolved(size)

    def _traced(self) -> dict[str, Traced]:
        """Trace every function of the model, and check what is seen so; means of forces stand under their names."""
        size = self.initial_state.mean.shape[0]
        u = jax.ShapeDtypeStruct((len(self.force_names),), jnp.result_type(float))
        arguments = (self.initial_state.mean, u, jnp.zeros(()))
        drift = trace("dynamics", "f(x, u, t)", self.dynamics, *arguments)
        if getattr(drift.shape, "shape", None) != (size,):
            raise ValueError(f"dynamics must return one derivative for each of the {size} entries of "
                             f"initial_state.mean, shape ({size},); it returned {_returned(drift.shape)}."
                             f"{'' if getattr(drift.shape, 'shape', ()) else ' Return jnp.array([...]).'}")
        functions = {"dynamics": drift, "observation": self._traced_observation(arguments)}
        if callable(self.process_noise):
            noise = trace("process_noise", "(x, u, t)", self.process_noise, *arguments)
            found: Any = getattr(noise.shape, "shape", ())
            if len(found) != 2 or found[0] != size:
                raise ValueError(f"process_noise must return a dispersion matrix ({size}, S), got {found}.")
            functions["process_noise"] = noise
        if callable(self.observation.covariance):
            functions["covariance"] = trace("the observation covariance", "(x, u, t)", self.observation.covariance,
                                            *arguments)
        functions |= {f"deterministic {name}": found for name, found in self._traced_deterministics(arguments).items()}
        for function in functions.values():
            function.check_indices(("x", "u"))
        for name, force in self.forces.items():
            if callable(force.mean):
                functions[f"mean of {name}"] = trace(f"the mean of the force {name!r}", "(t)", force.mean_at,
                                                     arguments[-1])
        return functions

    def _traced_deterministics(self, arguments: tuple) -> dict[str, Traced]:
        found = {}
        for name, function in self.deterministics.items():
            label = f"the deterministic {name!r}"
            found[name] = trace(label, "(x, u, t)", function, *arguments)
            shape = getattr(found[name].shape, "shape", found[name].shape)
            if shape != ():
                raise ValueError(f"{label} must return one number, shape (); it returned {shape}. The entry of a "
                                 "vector is x[0], u[0].")
        return found

    def _traced_observation(self, arguments: tuple) -> Traced:
        traced = trace("the observation function", "h(x, u, t)", self.observation.function, *arguments)
        outputs = _vector_size(traced.shape)
        covariance = jax.eval_shape(self.observation.covariance_at, *arguments, 0)
        if covariance.shape != (outputs, outputs):
            raise ValueError(f"the observation has {outputs} components, so its covariance must be ({outputs},) or "
                             f"({outputs}, {outputs}); it is {covariance.shape}.")
        if any(not 0 <= index < outputs for index in self.observation.angular):
            raise ValueError(f"angular indices must lie in 0..{outputs - 1}, got {self.observation.angular}.")
        return traced

    def _check_precision(self) -> None:
        """Raise where a force or the model was made in single precision, and JAX runs in double precision now."""
        wanted = jnp.result_type(float)
        parts = {**{f"the force {name!r}": force for name, force in self.forces.items()},
                 "initial_state": self.initial_state, "the observation covariance": self.observation.covariance,
                 "process_noise": self.process_noise}
        for name, part in parts.items():
            for leaf in jax.tree_util.tree_leaves(part):
                found = getattr(leaf, "dtype", wanted)
                if jnp.issubdtype(found, jnp.floating) and jnp.finfo(found).bits < jnp.finfo(wanted).bits:
                    raise ValueError(f"{name} holds numbers in {found}, made before JAX was told to compute in "
                                     f"{wanted}; seven digits of them are right. Call "
                                     'jax.config.update("jax_enable_x64", True) first, and make it after that.')

    def check_span(self, first: float, last: float) -> None:
        """Check the forces against data from ``first`` to ``last``; raise ValueError where one does not suit them."""
        for name, force in self.forces.items():
            force.check_span(name, first, last)

    def check_at(self, time: Any, rows: int) -> None:
        """Check what depends on where and how often the model is observed.

        Args:
            time: at which the functions are tried, at the prior mean.
            rows: number of observations.

        Raises:
            ValueError: a function is not finite there, the observation covariance is no covariance, or there is not
                one matrix for each observation.
        """
        if isinstance(self.observation, ObservationFamily):
            self.observation.check_rows(rows)
        covariance = self.observation.covariance
        if np.ndim(covariance) == 3 and np.shape(covariance)[0] != rows:
            raise ValueError(f"the observation covariance holds {np.shape(covariance)[0]} matrices, one for each time, "
                             f"but there are {rows} times.")
        self._check_precision()
        self._check_finite(time)

    def check_inputs(self, first: float, last: float) -> None:
        """Check that no known input ends before the model's times, from ``first`` to ``last``.

        Raises:
            ValueError: an input with ``outside="error"`` does; with "warn" it is a warning, with "hold" nothing.
        """
        if self._reads_inputs:
            check_reads(tuple(self._traced().values()), first, last)

    def input_reads(self, first: float, last: float) -> list[InputRead]:
        """Return which known inputs are integrated, and when they are read; see `lfm_ppl.model.inputs.input_reads`."""
        return input_reads(_integrated(self._traced()), first, last) if self._integrates_inputs else []

    def _check_finite(self, time: Any) -> None:
        """Try the functions at the prior mean, where that is known; ``time`` is None where it does not matter."""
        x = self.initial_state.mean
        # Inside compiled code this is a tracer, whatever is known.
        t = jnp.asarray(0.0 if time is None else time, float) + 0.0
        if checks.traced((self, t)):
            return
        u = jnp.asarray([force.mean_at(t) for force in self.force_list], float)
        if checks.traced(u):
            return
        when = "" if time is None else f", t = {float(time):g}"
        where = f"at the prior mean x = {np.asarray(x)}, u = {np.asarray(u)}{when}"
        for label, function, names in (("dynamics", self.dynamics, self.state_names),
                                       ("observation function", self.observation.function, self.output_names)):
            value = checks.concrete(function(x, u, t))
            if value is not None and not np.all(np.isfinite(value)):
                name = names[int(np.argmin(np.isfinite(value)))]
                raise ValueError(f"the {label} returned {value} {where}: the entry for {name!r} is not finite. "
                                 "Change initial_state.mean, or guard the expression (for example jnp.maximum)."
                                 + self._traced()[label.split()[0]].not_finite(*map(np.asarray, (x, u, t))))
            if label.split()[0] in self._with_roots:
                self._check_derivative(label, function, names, (x, u, t), where)
            if value is not None and function is self.observation.function and isinstance(self.observation,
                                                                                           ObservationFamily):
                self.observation.check_predictor(value, where, names)
        if callable(self.process_noise):
            dispersion = checks.concrete(self.process_noise(x, u, t))
            if dispersion is not None and not np.all(np.isfinite(dispersion)):
                raise ValueError(f"process_noise is not finite {where}: {dispersion.tolist()}.")
        if callable(self.observation.covariance):
            noise = checks.concrete(self.observation.covariance_at(x, u, t, jnp.asarray(0)))
            if noise is not None:
                checks.covariance_matrix(f"the observation covariance {where}", noise)

    @staticmethod
    def _check_derivative(label: str, function: Callable, names: Sequence[str], at: tuple, where: str) -> None:
        """Warn: a square root has a value at zero, but no derivative there, and none below."""
        x, u, t = at
        derivative = checks.concrete(jax.jacfwd(lambda w: function(w[:len(x)], w[len(x):], t))(jnp.concatenate([x, u])))
        if derivative is not None and not np.all(np.isfinite(derivative)):
            finite = np.isfinite(np.asarray(derivative)).reshape(len(names), -1).all(axis=1)
            checks.warn(f"the derivative of the {label} is not finite {where}: that of the entry for "
                        f"{names[int(np.argmin(finite))]!r}. Likelihood and gradient may not be finite either. Change "
                        "initial_state.mean, or guard the expression (for example jnp.sqrt(jnp.maximum(x, 1e-6))).")


def _integrated(functions: Mapping[str, Traced]) -> list[Traced]:
    """Return the functions that are evaluated between two observations."""
    return [function for name, function in functions.items()
            if name in ("dynamics", "process_noise") or name.startswith("mean of ")]


def _functions(given: Mapping[str, Callable] | None, taken: set[str]) -> dict[str, Callable]:
    """Return the deterministics, checked."""
    if given is not None and not isinstance(given, Mapping):
        raise TypeError(f"deterministics must be a mapping, name -> function (x, u, t), got {type(given).__name__}.")
    for name, function in (given or {}).items():
        if not callable(function):
            raise TypeError(f"the deterministic {name!r} must be a function (x, u, t), got {type(function).__name__}.")
        if name in taken:
            raise ValueError(f"the name {name!r} of a deterministic is used for a state or a force; rename one.")
    return {str(name): function for name, function in (given or {}).items()}


def _check_types(dynamics: Any, observation: Any, initial_state: Any) -> None:
    if not callable(dynamics):
        raise TypeError(f"dynamics must be callable as f(x, u, t), got {type(dynamics).__name__}.")
    if not isinstance(observation, (GaussianObservation, ObservationFamily)):
        raise TypeError("observation must be an lfm.GaussianObservation, or a family such as lfm.PoissonObservation, "
                        f"got {type(observation).__name__}. Wrap the function: "
                        "lfm.GaussianObservation(lambda x, u, t: x, variances).")
    if not isinstance(initial_state, Gaussian):
        raise TypeError(f"initial_state must be an lfm.Gaussian, got {type(initial_state).__name__}.")


def _vector_size(found: Any) -> int:
    if len(getattr(found, "shape", ())) != 1:
        raise ValueError(f"the observation function must return a vector (D,), got {_returned(found)}. "
                         "For one output, return x[:1] or jnp.array([...]).")
    return found.shape[0]


def _returned(found: Any) -> str:
    """Return in words what a function returned that should have returned a vector."""
    if hasattr(found, "shape"):
        return f"{'an array' if found.shape else 'a number'} of shape {found.shape}"
    if isinstance(found, (list, tuple)):
        return f"a {type(found).__name__} of {len(found)}, which is no array"
    return "None, as a function without `return` does" if found is None else type(found).__name__


def _named_forces(forces: Any) -> tuple[tuple[str, ...], dict[str, Force]]:
    if isinstance(forces, Force) or not isinstance(forces, Iterable):
        raise TypeError('forces must map names to forces, for example {"p53": lfm.Matern(1.0, 2.0)}, or {} for none; '
                        f"got {type(forces).__name__}.")
    items = list(forces.items()) if isinstance(forces, Mapping) else list(forces)
    for item in items:
        if not (isinstance(item, tuple) and len(item) == 2 and isinstance(item[0], str)):
            raise TypeError('forces must map names to forces, for example {"p53": lfm.Matern(1.0, 2.0)}; '
                            f"got {item!r}.")
        if not isinstance(item[1], Force):
            raise TypeError(f"the force {item[0]!r} must be a force such as lfm.Matern, got {type(item[1]).__name__}.")
    names = tuple(name for name, _ in items)
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"the force name {name!r} repeats; every force needs a name of its own.")
    return names, dict(items)


def _names(argument: str, given: Sequence[str] | None, size: int, prefix: str) -> tuple[str, ...]:
    if given is None:
        return tuple(f"{prefix}{index}" for index in range(size))
    if isinstance(given, str) or len(given) != size:
        names = (given,) if isinstance(given, str) else tuple(given)
        what = {"output_names": "the observation returns", "state_names": "initial_state.mean has"}.get(argument)
        why = f": {what} {size} {'entry' if size == 1 else 'entries'}" if what else ""
        raise ValueError(f"{argument} must hold {size} {'name' if size == 1 else 'names'}{why}. It holds "
                         f"{', '.join(map(repr, names)) or 'none'}.")
    if len(set(given)) != size:
        raise ValueError(f"{argument} must not repeat, got {tuple(given)}.")
    return tuple(str(name) for name in given)


def _dispersion(value: Any, size: int) -> jax.Array | None:
    if value is None:
        return None
    checks.finite("process_noise", value)
    value = jnp.asarray(value, float)
    if value.ndim != 2 or value.shape[0] != size:
        raise ValueError(f"process_noise must be a dispersion matrix ({size}, S), one row for each state, got shape "
                         f"{value.shape}. For independent noises use jnp.diag(standard_deviations).")
    return value
