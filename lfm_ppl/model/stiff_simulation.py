"""Simulation of stiff models: exponential steps, a bound on all steps, and a warning of states that are not finite.

Source: Jimenez, Shoji and Ozaki (1999), Journal of Statistical Physics 94, for the linearised SDE.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.forces.phi_functions import discretise_driven
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import matmul, outer_square
from lfm_ppl.utils.semidefinite import semidefinite_root

_MOST_NODES = 20_000
"""Largest number of breakpoints that bound the steps."""


def divide_steps(times: Any, start: Any, steps: int, breakpoints: Any, longest_step: float) -> Any:
    """Return breakpoints with which no step is longer than ``longest_step``, as far as their number allows that.

    Arguments as in `simulate_on`, times and start concrete.
    """
    row_times = np.unique(np.append(np.asarray(times, float), float(start)))
    gaps = np.diff(row_times)
    is_long = gaps > longest_step * steps * (1 + 1e-9)
    if not is_long.any():
        return breakpoints
    spacing = max(longest_step, float(gaps[is_long].sum()) / _MOST_NODES)
    nodes = [np.linspace(first, first + gap, int(np.ceil(gap / spacing)) + 1)[1:-1]
             for first, gap in zip(row_times[:-1][is_long], gaps[is_long], strict=True)]
    return jnp.concatenate([jnp.asarray(breakpoints, float), *nodes])


def exponential_change(h: jax.Array, jacobian: jax.Array, drift: jax.Array, drift_at_end: jax.Array,
                       dispersion: jax.Array | None, key: jax.Array) -> jax.Array:
    """Return the change c (M,) of the physical state by the exact solution of the linearised SDE.

    It is dc = (J c + b(s)) ds + G dB over a step of length h, with the Jacobian J and the dispersion G at the start of
    the step, and b linear in time from ``drift`` to ``drift_at_end``, both at the state at the start.
    """
    size = drift.shape[0]
    diffusion = jnp.zeros((size, size)) if dispersion is None else outer_square(dispersion)
    _, change, covariance = discretise_driven(jacobian, jnp.stack([drift, drift_at_end]), diffusion, h)
    if dispersion is None:
        return change
    return change + matmul(semidefinite_root(covariance), jax.random.normal(key, (size, 1)))[:, 0]


def warn_of_infinite_states(states: Any, times: Any, names: tuple[str, ...]) -> None:
    """Warn where a simulated state (..., T, M) is not finite, with the first time and state; not in compiled code."""
    if checks.traced((states, times)) or not np.size(states):
        return
    is_bad = ~np.isfinite(np.reshape(states, (-1, *np.shape(states)[-2:])))
    if is_bad.any():
        is_path_bad = is_bad.any(axis=(1, 2))
        row, state = np.argwhere(is_bad[int(np.argmax(is_path_bad))])[0]
        time = float(np.asarray(times)[..., row].min())
        checks.warn(f"the simulated state {names[state]!r} is not finite from time {time:.6g} on, in "
                    f"{int(is_path_bad.sum())} of {len(is_bad)} paths: the model grows without bound, a function of it "
                    "is not defined there, or steps are too long (steps=...).")
