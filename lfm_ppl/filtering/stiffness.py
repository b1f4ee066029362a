r"""Warnings of steps that are too long for a fast decay, by another pass, so that the filter itself costs no more.

A Runge-Kutta step of length h takes the constant linear part of the dynamics by its exact exponential, and integrates
the rest explicitly. Two limits follow.

1. The rest, with the Jacobian K: an eigenvalue lambda of K that does not grow must satisfy abs(lambda) h < 2.5, or the
   step leaves the region of stability and amplifies what should decay. (A positive real part is growth, and no
   instability: it counts as zero.)
2. The linear part: the rest of the drift, or noise, drives a decay of rate lambda, which settles within 1 / lambda. The
   step integrates this by Simpson's rule, with an error of 0.2% for lambda h = 1.5. A state with a much larger lambda h
   settles at lambda h / 6 times its right value.

`explicit_steps` follows the mean through each interval from the filtered mean at its start, by linearly implicit Euler
steps, which are stable, and records K where it is largest: a decay that saturates may be slow at all rows and fast
between them. `long_step_message` compares the eigenvalues with the steps, outside of compiled code.

Source: Hairer and Wanner (1996), Solving Ordinary Differential Equations II, sections IV.2 and IV.7.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from lfm_ppl.filtering.breakdown import FilterWarning
from lfm_ppl.filtering.integrators.methods import choose_integrator
from lfm_ppl.filtering.intervals import Intervals, TimeGrid, as_arrays, with_state_maps
from lfm_ppl.filtering.transition import linear_part
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import fastest_rate, matmul
from lfm_ppl.utils.programs import shared_jit

_LIMIT, _LINEAR_LIMIT = 2.5, 1.5
"""Largest product of step and rate, in the explicit part and in the linear part."""

_PROPOSED = 1.0
"""The product with the number of steps that a message proposes."""

_FED = 1e-3
"""Share of a decay that the rest of the drift or the noise must balance to count as feeding it."""

_PARTICIPATION = 0.1
"""Least participation of a state in a mode of the linear part, of one in all."""

_SHARES = np.array([0.25, 0.5, 0.75])
"""Points of a step of the mean at which the Jacobian is evaluated, besides its start."""

_MOST_STEPS = 10_000
"""Largest number of steps that a message proposes."""


class ExplicitSteps(NamedTuple):
    """What the limits of the steps depend on, of N intervals; a panel has an axis of series before all others.

    Attributes:
        jacobian: (N, M, M), Jacobian K of the explicit part in the physical state, where it is largest.
        mean: (N, M), filtered mean at the start.
        remainder: (N, M), drift less its linear part there.
        noise: (N, M), variance of the process noise there, per unit of time.
        linear: (M, M), the constant linear part.
        step: (N,), length of a step.
        end: (N,), time at the end of the interval.
        observation: (N,), index of the observation at the end, -1 where there is none.
    """

    jacobian: Any
    mean: Any
    remainder: Any
    noise: Any
    linear: Any
    step: Any
    end: Any
    observation: Any


class LongStep(NamedTuple):
    """The first row that is reached by a step beyond the limit.

    Attributes:
        series: index of the series of a panel; None without one.
        row: index of the observation; None after the last one.
        time: end of the interval.
        state: index of the state that decays.
        rate: of its decay.
        step: length of the step.
        largest: largest product of step and rate in all rows of all series.
        is_linear: whether the decay is one of the linear part.
    """

    series: int | None
    row: int | None
    time: float
    state: int
    rate: float
    step: float
    largest: float
    is_linear: bool


def explicit_steps(ssm: StateSpaceModel, grid: TimeGrid, filtered_mean: jax.Array,
                   initial_mean: jax.Array | None = None) -> ExplicitSteps:
    """Follow the mean from the filtered means (T, n), and record the Jacobian of the explicit part.

    ``initial_mean`` (n,) is that at the initial time; None: the model's.
    """
    size = ssm.physical_dim
    linear = linear_part(ssm, jnp.asarray(grid.initial_time, float)).rows
    grid = with_state_maps(ssm, grid)
    start = ssm.initial()[0] if initial_mean is None else initial_mean

    def follow(state: jax.Array, interval: Intervals) -> tuple[jax.Array, ExplicitSteps]:
        x, z = state[:size], state[size:]
        h = interval.length / grid.steps

        def drift(x: jax.Array, t: jax.Array) -> jax.Array:
            return ssm.drift(ssm.inputs(jnp.concatenate([x, z]), t), t)

        def implicit_step(carry: tuple, index: jax.Array) -> tuple[tuple, None]:
            x, largest, jacobian = carry
            t = interval.span.time(index * h)
            full = jax.jacfwd(drift)(x, t)
            change = jnp.linalg.solve(jnp.eye(size) - h * full, h * drift(x, t))
            change = jnp.where(jnp.isfinite(change), change, 0.0)
            # Points along the step: one that is too long may cross the region where a decay is fast.
            later = jax.vmap(lambda share: jax.jacfwd(drift)(x + share * change, t))(_SHARES)
            explicit = jnp.concatenate([full[None], later]) - linear[:, :size]
            rates = jnp.append(jax.vmap(fastest_rate)(explicit), largest)
            rates = jnp.where(jnp.isfinite(rates), rates, -1.0)
            candidates = jnp.concatenate([explicit, jacobian[None]])
            fastest = jnp.argmax(rates)
            return (x + change, rates[fastest], candidates[fastest]), None

        first = (x, jnp.asarray(-1.0), jnp.zeros((size, size)))
        (end, _, jacobian), _ = jax.lax.scan(implicit_step, first, jnp.arange(grid.steps))
        t = interval.span.time()
        inputs = ssm.inputs(state, t)
        dispersion = ssm.dispersion(inputs, t)
        noise = jnp.zeros(size) if dispersion is None else (dispersion**2).sum(1)
        remainder = ssm.drift(inputs, t) - matmul(linear, state[:, None])[:, 0]
        state = jnp.concatenate([end, z])
        state = state if interval.state_map is None else interval.state_map.apply(state)
        state = jnp.where(interval.observation >= 0, filtered_mean[interval.observation], state)
        return state, ExplicitSteps(jacobian, x, remainder, noise, None, h, interval.end, interval.observation)

    intervals = as_arrays(grid.intervals)
    return jax.lax.scan(follow, start, intervals)[1]._replace(linear=linear[:, :size])


_compiled_explicit_steps = shared_jit(explicit_steps)


def warn_of_long_steps(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, steps: int, filtered_mean: Any,
                       log_likelihood: Any, initial_mean: Any = None) -> None:
    """Warn where a step is too long for a fast decay; nothing happens in compiled code.

    Where a log likelihood is not finite, `lfm_ppl.filtering.breakdown.warn_of_breakdown` speaks.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        grid: the time grid.
        steps: integration steps between two consecutive times.
        filtered_mean: (T, n), of the joint state at the observations; or a function that returns it.
        log_likelihood: result of the filter, of any shape.
        initial_mean: (n,), at the initial time; None: the model's.
    """
    if checks.traced((ssm, grid, log_likelihood, initial_mean)):
        return
    is_explicit = choose_integrator(ssm, rule, grid.method, grid.tolerance).is_explicit
    if not is_explicit or not np.isfinite(np.asarray(log_likelihood)).all():
        return
    mean = filtered_mean() if callable(filtered_mean) else filtered_mean
    warn_of_message(long_step_message(_compiled_explicit_steps(ssm, grid, mean, initial_mean), ssm.model.state_names,
                                      steps))


def warn_of_message(message: str | None) -> None:
    """Warn of a step that is too long; None: there is none."""
    if message is not None:
        checks.warn(message, FilterWarning)


def decay_rates(matrices: np.ndarray) -> np.ndarray:
    """Return the moduli (..., M) of the eigenvalues of matrices (..., M, M), a positive real part taken as zero."""
    eigenvalues = np.linalg.eigvals(matrices)
    return np.hypot(np.minimum(eigenvalues.real, 0.0), eigenvalues.imag)


def long_step(steps: ExplicitSteps) -> LongStep | None:
    """Return the first row that is reached by a step beyond the limit; None without one. Arguments are concrete."""
    arrays = ExplicitSteps(*(np.asarray(a) for a in steps))
    if arrays.step.ndim == 1:
        return _long_step_of_series(arrays)
    long_steps = [long._replace(series=series) for series in range(len(arrays.step))
                  if (long := _long_step_of_series(ExplicitSteps(*(a[series] for a in arrays)))) is not None]
    # The number of steps is one for all series.
    return long_steps[0]._replace(largest=max(long.largest for long in long_steps)) if long_steps else None


def _long_step_of_series(steps: ExplicitSteps) -> LongStep | None:
    explicit, linear = _explicit_products(steps), _linear_products(steps)
    largest_linear = linear.max(axis=1, initial=0.0)
    is_long = (explicit > _LIMIT) | (largest_linear > _LINEAR_LIMIT)
    if not is_long.any():
        return None
    index = int(np.argmax(is_long))
    is_linear = not explicit[index] > _LIMIT
    matrix, mode = steps.linear, int(np.argmax(linear[index]))
    if not is_linear:
        matrix = steps.jacobian[index]
        mode = int(np.argmax(decay_rates(matrix)))
    # The order of the eigenvalues is that of LAPACK in both functions.
    state = int(np.argmax(_participations(matrix)[:, mode]))
    is_row = steps.observation[index:] >= 0
    end = index + int(np.argmax(is_row))
    step = float(steps.step[index])
    product = float(largest_linear[index] if is_linear else explicit[index])
    return LongStep(None, int(steps.observation[end]) if is_row.any() else None, float(steps.end[end]), state,
                    product / step, step, float(np.maximum(explicit, largest_linear).max()), is_linear)


def _explicit_products(steps: ExplicitSteps) -> np.ndarray:
    """Return the product (N,) of step and fastest decay of the explicit part; zero where it is below the limit."""
    products = np.zeros(len(steps.step))
    size = np.abs(steps.jacobian)
    bound = np.minimum(size.sum(1).max(1, initial=0.0), size.sum(2).max(1, initial=0.0)) * steps.step
    candidates = np.flatnonzero((bound > _LIMIT) & np.isfinite(bound))
    if len(candidates):
        products[candidates] = decay_rates(steps.jacobian[candidates]).max(axis=1) * steps.step[candidates]
    return products


def _linear_products(steps: ExplicitSteps) -> np.ndarray:
    """Return the products (N, M) of step and decay of each mode of the linear part; zero where nothing feeds it."""
    rates = decay_rates(steps.linear)
    members = _participations(steps.linear) > _PARTICIPATION
    level = _FED * rates[:, None] * np.abs(steps.mean[:, None, :])
    is_fed = np.abs(steps.remainder)[:, None, :] > level
    is_fed |= rates[:, None] * steps.noise[:, None, :] > level**2
    return np.where((is_fed & members.T).any(axis=2), rates * steps.step[:, None], 0.0)


def _participations(matrix: np.ndarray) -> np.ndarray:
    """Return the participation (M, M) of each state (row) in each mode (column) of a matrix, in any units."""
    _, left_vectors, right_vectors = scipy.linalg.eig(matrix, left=True, right=True)
    products = np.abs(left_vectors.conj() * right_vectors)
    return products / np.maximum(products.sum(axis=0), 1e-300)


def long_step_message(explicit: ExplicitSteps, state_names: tuple[str, ...], steps: int, has_method: bool = True,
                      regime_names: tuple[str, ...] = ()) -> str | None:
    """Return a sentence on the first step that is too long, with the remedy; None where no step is.

    Args:
        explicit: what limits the steps, concrete.
        state_names: names of the states.
        steps: integration steps between two consecutive times.
        has_method: whether the likelihood has a ``method``.
        regime_names: names of the regimes, where the series of ``explicit`` are regimes.
    """
    long = long_step(explicit)
    if long is None:
        return None
    series = ""
    if long.series is not None:
        series = f"regime {regime_names[long.series]!r}, " if regime_names else f"series {long.series}, "
    row = "after the last row" if long.row is None else f"row {long.row}"
    product = long.rate * long.step
    consequence = (f"the level at which it settles is off by {100 * _simpson_error(product):.2g}%" if long.is_linear
                   else "explicit integration is unstable")
    number = int(np.ceil(steps * long.largest / _PROPOSED))
    remedies = ['method="exponential"'] if has_method else []
    remedies += [f"steps={number} or more"] if number <= _MOST_STEPS else []
    return (f"steps are too long for the state {state_names[long.state]!r}, which decays at the rate {long.rate:.3g} "
            f"at {series}{row} (time {long.time:.6g}): a step of {long.step:.3g} is {product:.3g} time constants long, "
            f"and {consequence}. Use {' or '.join(remedies) or 'more steps'}.")


def _simpson_error(product: float) -> float:
    """Return the relative error of Simpson's rule for the integral of exp(-s) from 0 to a number of time constants."""
    return product * (1.0 + 4.0 * np.exp(-0.5 * product) + np.exp(-product)) / (-6.0 * np.expm1(-product)) - 1.0
