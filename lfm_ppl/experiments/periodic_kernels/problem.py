"""The kernels that are compared, and the functions that are drawn."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from lfm_ppl.forces import (
    ModeratedPeriodicMatern,
    PeriodicKernel,
    PeriodicMatern,
    PeriodicSquaredExponential,
    SquaredExponential,
)
from lfm_ppl.forces.periodic_kernels import Kernel

PERIOD, WINDOW, LENGTHSCALE = 10.0, 130.0, 10.0
"""Of the periodic kernels; and of the squared exponential that is not periodic, on a window of time."""

NOT_PERIODIC = "squared exponential on a window"

NUGGET = 1e-8
"""Variance of the measurements, which have no noise otherwise, and of what is predicted."""


def kernels() -> dict[str, Kernel]:
    """Return every kernel by name, all of scale one."""
    found: dict[str, Kernel] = {"periodic squared exponential": PeriodicSquaredExponential(1.0, 0.5, PERIOD)}
    found |= {f"periodic Matern-{2 * order + 1}_2": PeriodicMatern(1.0, 0.5, PERIOD, order) for order in (2, 1, 0)}
    found["moderated periodic Matern-3_2"] = ModeratedPeriodicMatern(1.0, 0.5, PERIOD, 0.3, 1)
    return found | {NOT_PERIODIC: window_kernel()}


def window_kernel() -> PeriodicKernel:
    """Return the squared exponential of the source, repeated after the window, which nobody leaves."""

    def squared_exponential(t, s):
        return jnp.exp(-0.5 * ((t - s) / LENGTHSCALE) ** 2)

    return PeriodicKernel(squared_exponential, WINDOW)


def window_prior() -> SquaredExponential:
    """Return the same as a force, from whose spectrum frequencies are drawn."""
    return SquaredExponential(1.0, LENGTHSCALE)


def grid(kernel: Kernel, count: int = 131) -> np.ndarray:
    """Return times of one cycle (count,), its end left out."""
    return np.linspace(0.0, float(kernel.period), count + 1)[:-1]


def measured() -> np.ndarray:
    """Return the times of the measurements, every 10 units."""
    return np.arange(5.0, WINDOW, 10.0)


def predicted() -> np.ndarray:
    """Return the times at which functions are predicted, every unit but where they are measured."""
    times = np.arange(0.0, WINDOW, 1.0)
    return np.setdiff1d(times, measured())
