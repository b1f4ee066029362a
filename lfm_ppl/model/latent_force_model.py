"""The latent force model as its user writes it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.forces.sde import Force
from lfm_ppl.model.observation import Gaussian, GaussianObservation
from lfm_ppl.model.resolution import check_resolution


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
        units: unit of "time", of states, outputs and forces, by name.

    Raises:
        ValueError, TypeError: f returns a wrong shape, or NaN at the prior mean; names repeat or are of a wrong
            number; the process noise has a wrong shape.

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
    observation: GaussianObservation
    initial_state: Gaussian
    process_noise: Any
    initial_time: Any
    force_names: tuple[str, ...] = eqx.field(static=True)
    nonlinear_inputs: tuple[str, ...] | None = eqx.field(static=True)
    state_names: tuple[str, ...] = eqx.field(static=True)
    output_names: tuple[str, ...] = eqx.field(static=True)
    unit_items: tuple[tuple[str, str], ...] = eqx.field(static=True)

    def __init__(
        self,
        dynamics: Callable[..., jax.Array],
        forces: Mapping[str, Force] | Sequence[tuple[str, Force]],
        observation: GaussianObservation,
        initial_state: Gaussian,
        process_noise: Any = None,
        initial_time: Any = None,
        nonlinear_inputs: Sequence[str] | None = None,
        state_names: Sequence[str] | None = None,
        output_names: Sequence[str] | None = None,
        units: Mapping[str, str] | None = None,
    ):
        _check_types(dynamics, observation, initial_state)
        self.force_names, self.forces = _named_forces(forces)
        self.dynamics, self.observation, self.initial_state = dynamics, observation, initial_state
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
        self._check_dynamics(size)
        self.output_names = _names("output_names", output_names, self._outputs(size), "y")
        self.unit_items = tuple((units or {}).items())
        self.nonlinear_inputs = None if nonlinear_inputs is None else tuple(nonlinear_inputs)
        for name in self.nonlinear_inputs or ():
            checks.one_of("name in nonlinear_inputs", name, (*self.state_names, *self.force_names))

    @property
    def units(self) -> dict[str, str]:
        """Units by name."""
        return dict(self.unit_items)

    @property
    def force_list(self) -> tuple[Force, ...]:
        """The forces in their order."""
        return tuple(self.forces[name] for name in self.force_names)

    def _check_dynamics(self, size: int) -> None:
        u = jax.ShapeDtypeStruct((len(self.force_names),), jnp.result_type(float))
        x, t = self.initial_state.mean, jnp.zeros(())
        found = _traced_shape("dynamics", "f(x, u, t)", self.dynamics, x, u, t)
        if getattr(found, "shape", None) != (size,):
            raise ValueError(f"dynamics must return one derivative for each of the {size} entries of "
                             f"initial_state.mean, shape ({size},); it returned {getattr(found, 'shape', found)}.")
        if not callable(self.process_noise) and self.process_noise is not None:
            return
        if callable(self.process_noise):
            found = _traced_shape("process_noise", "(x, u, t)", self.process_noise, x, u, t)
            if len(found.shape) != 2 or found.shape[0] != size:
                raise ValueError(f"process_noise must return a dispersion matrix ({size}, S), got {found.shape}.")

    def _outputs(self, size: int) -> int:
        u = jax.ShapeDtypeStruct((len(self.force_names),), jnp.result_type(float))
        arguments = (self.initial_state.mean, u, jnp.zeros(()))
        found = _traced_shape("the observation function", "h(x, u, t)", self.observation.function, *arguments)
        if len(getattr(found, "shape", ())) != 1:
            raise ValueError("the observation function must return a vector (D,), got "
                             f"{f'shape {found.shape}' if hasattr(found, 'shape') else type(found).__name__}. "
                             "For one output, return x[:1] or jnp.array([...]).")
        outputs = found.shape[0]
        covariance = jax.eval_shape(self.observation.covariance_at, *arguments, 0)
        if covariance.shape != (outputs, outputs):
            raise ValueError(f"the observation has {outputs} components, so its covariance must be ({outputs},) or "
                             f"({outputs}, {outputs}); it is {covariance.shape}.")
        if any(not 0 <= index < outputs for index in self.observation.angular):
            raise ValueError(f"angular indices must lie in 0..{outputs - 1}, got {self.observation.angular}.")
        return outputs

    def check_span(self, first: float, last: float) -> None:
        """Check the forces against data from ``first`` to ``last``; raise ValueError where one does not suit them."""
        for name, force in self.forces.items():
            force.check_span(name, first, last)

    def check_resolution(self, times: Any, y: Any) -> None:
        """Warn (`lfm.ApproximationWarning`) of squared exponential forces of too low an order for data at ``times``."""
        check_resolution(self, times, y)

    def check_at(self, time: Any, rows: int) -> None:
        """Check what depends on where and how often the model is observed.

        Args:
            time: at which the functions are tried, at the prior mean.
            rows: number of observations.

        Raises:
            ValueError: a function is not finite there, the observation covariance is no covariance, or there is not
                one matrix for each observation.
        """
        covariance = self.observation.covariance
        if np.ndim(covariance) == 3 and np.shape(covariance)[0] != rows:
            raise ValueError(f"the observation covariance holds {np.shape(covariance)[0]} matrices, one for each time, "
                             f"but there are {rows} times.")
        x = self.initial_state.mean
        u = jnp.asarray([force.mean_at(time) for force in self.force_list], float)
        if checks.traced((self, time, u)):
            return
        where = f"at the prior mean x = {np.asarray(x)}, u = {np.asarray(u)}, t = {float(time):g}"
        for label, function, names in (("dynamics", self.dynamics, self.state_names),
                                       ("observation function", self.observation.function, self.output_names)):
            value = checks.concrete(function(x, u, jnp.asarray(time, float)))
            if value is not None and not np.all(np.isfinite(value)):
                name = names[int(np.argmin(np.isfinite(value)))]
                raise ValueError(f"the {label} returned {value} {where}: the entry for {name!r} is not finite. "
                                 "Change initial_state.mean, or guard the expression (for example jnp.maximum).")
        if callable(self.process_noise):
            dispersion = checks.concrete(self.process_noise(x, u, jnp.asarray(time, float)))
            if dispersion is not None and not np.all(np.isfinite(dispersion)):
                raise ValueError(f"process_noise is not finite {where}: {dispersion.tolist()}.")
        if callable(covariance):
            noise = checks.concrete(self.observation.covariance_at(x, u, jnp.asarray(time, float), jnp.asarray(0)))
            if noise is not None:
                checks.covariance_matrix(f"the observation covariance {where}", noise)


def _traced_shape(what: str, form: str, function: Callable, *arguments: Any) -> Any:
    """Return the shape of a function's value; a wrong number of arguments gets a message of its own."""
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError as error:
        raise TypeError(f"{what} must take three arguments, {form}: {error}.") from None
    except ValueError:  # no signature to be had
        pass
    return jax.eval_shape(function, *arguments)


def _check_types(dynamics: Any, observation: Any, initial_state: Any) -> None:
    if not callable(dynamics):
        raise TypeError(f"dynamics must be callable as f(x, u, t), got {type(dynamics).__name__}.")
    if not isinstance(observation, GaussianObservation):
        raise TypeError(f"observation must be an lfm.GaussianObservation, got {type(observation).__name__}. Wrap the "
                        "function: lfm.GaussianObservation(lambda x, u, t: x, variances).")
    if not isinstance(initial_state, Gaussian):
        raise TypeError(f"initial_state must be an lfm.Gaussian, got {type(initial_state).__name__}.")


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
        raise ValueError(f"{argument} must hold {size} names, got {given!r}.")
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
