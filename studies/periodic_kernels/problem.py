"""Kernels of the study, and the times of its measurements and predictions."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from lfm_ppl import forces
from lfm_ppl.forces import PeriodicCovariance

PERIOD, WINDOW, LENGTHSCALE = 10.0, 130.0, 10.0
"""Period of the periodic kernels; length of the time window and lengthscale of the squared exponential."""

NOT_PERIODIC = "squared exponential on a window"

NUGGET = 1e-8
"""Variance added to measurements and predictions for numerical stability; there is no other noise."""

MEASURED = np.arange(5.0, WINDOW, 10.0)
"""Times of the measurements."""

PREDICTED = np.setdiff1d(np.arange(WINDOW), MEASURED)
"""Times of the predictions: all whole numbers in the window except the measurement times."""


def kernels() -> dict[str, PeriodicCovariance]:
    """Return every kernel by name, all of scale one."""
    matern = {f"periodic Matern-{2 * order + 1}_2": forces.PeriodicMatern(1.0, 0.5, PERIOD, order)
              for order in (2, 1, 0)}
    return {"periodic squared exponential": forces.PeriodicSquaredExponential(1.0, 0.5, PERIOD), **matern,
            "moderated periodic Matern-3_2": forces.ModeratedPeriodicMatern(1.0, 0.5, PERIOD, 0.3, 1),
            NOT_PERIODIC: window_kernel()}


def window_kernel() -> forces.PeriodicKernel:
    """Return the squared exponential of the source, repeated with the window as its period."""
    return forces.PeriodicKernel(lambda t, s: jnp.exp(-0.5 * ((t - s) / LENGTHSCALE) ** 2), WINDOW)


def window_prior() -> forces.SquaredExponential:
    """Return the squared exponential of the source as a force; its spectrum is the distribution of frequencies."""
    return forces.SquaredExponential(1.0, LENGTHSCALE)


def covariance_on_grid(kernel: PeriodicCovariance) -> tuple[np.ndarray, np.ndarray]:
    """Return times (K,) of one period, without its end, and the kernel's covariance (K, K) at these times."""
    times = np.linspace(0.0, float(kernel.period), 132)[:-1]
    return times, np.asarray(kernel(times[:, None], times))
