"""The kernels that are compared, and the times at which functions are measured and predicted."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from lfm_ppl import forces
from lfm_ppl.forces import PeriodicCovariance

PERIOD, WINDOW, LENGTHSCALE = 10.0, 130.0, 10.0
"""Of the periodic kernels; and of the squared exponential that is not periodic, on a window of time."""

NOT_PERIODIC = "squared exponential on a window"

NUGGET = 1e-8
"""Variance of the measurements, which have no noise otherwise, and of what is predicted."""

MEASURED = np.arange(5.0, WINDOW, 10.0)
"""Times of the measurements."""

PREDICTED = np.setdiff1d(np.arange(WINDOW), MEASURED)
"""Times at which functions are predicted, every unit but where they are measured."""


def kernels() -> dict[str, PeriodicCovariance]:
    """Return every kernel by name, all of scale one."""
    found: dict[str, PeriodicCovariance] = {
        "periodic squared exponential": forces.PeriodicSquaredExponential(1.0, 0.5, PERIOD)}
    found |= {f"periodic Matern-{2 * order + 1}_2": forces.PeriodicMatern(1.0, 0.5, PERIOD, order)
              for order in (2, 1, 0)}
    found["moderated periodic Matern-3_2"] = forces.ModeratedPeriodicMatern(1.0, 0.5, PERIOD, 0.3, 1)
    return found | {NOT_PERIODIC: window_kernel()}


def window_kernel() -> forces.PeriodicKernel:
    """Return the squared exponential of the source, repeated after the window, which nobody leaves."""
    return forces.PeriodicKernel(lambda t, s: jnp.exp(-0.5 * ((t - s) / LENGTHSCALE) ** 2), WINDOW)


def window_prior() -> forces.SquaredExponential:
    """Return the same as a force, from whose spectrum frequencies are drawn."""
    return forces.SquaredExponential(1.0, LENGTHSCALE)


def on_grid(kernel: PeriodicCovariance) -> tuple[np.ndarray, np.ndarray]:
    """Return times (K,) of one cycle, its end left out, and the kernel's covariance (K, K) at them."""
    times = np.linspace(0.0, float(kernel.period), 132)[:-1]
    return times, np.asarray(kernel(times[:, None], times))
