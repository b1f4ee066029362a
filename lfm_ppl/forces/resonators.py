"""Resonators that carry the prior of a periodic kernel."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from lfm_ppl import checks
from lfm_ppl.forces.basis import Waves
from lfm_ppl.forces.constant import Constant
from lfm_ppl.forces.parameters import standard_deviation_parameter
from lfm_ppl.forces.periodic_kernels import Kernel
from lfm_ppl.forces.quasi_periodic import EXPLAINED_VARIANCE, stationary_basis, warn_of_lost_variance
from lfm_ppl.forces.resonator import Resonator
from lfm_ppl.forces.sde import Sum
from lfm_ppl.linalg import safe_sqrt


def resonators(kernel: Kernel, functions: int | None = None, gamma: float = 0.01, noise: Any = 0.0, damping: Any = 0.0,
               mean: Any = 0.0, explained_variance: float = EXPLAINED_VARIANCE) -> Sum:
    """Return a level and resonators whose prior is a stationary periodic kernel.

    The leading eigenfunctions of such a kernel are a constant and pairs of cosine and sine, of frequencies j/D and
    variances q_j, its Fourier coefficients; a resonator of period D/j and scale sqrt(q_j) is the j-th pair. Without
    noise and damping the sum has the covariance of `Periodic` with as many functions; with them, each resonator may
    change its amplitude and phase with time, where a `QuasiPeriodic` force has one process for all.

    Args:
        kernel: a stationary periodic kernel.
        functions: 1 + 2 times the number of resonators; as in `QuasiPeriodic`.
        gamma: share of the largest eigenvalue above which one counts.
        noise: of each resonator, as a share of its scale, per time^(1/2); >= 0.
        damping: of each resonator, per unit of time; >= 0.
        mean: a number, or a function of time: the bias.
        explained_variance: share of the kernel's variance that the resonators are to keep; 0 where any will do.

    Warns:
        ApproximationWarning: as `QuasiPeriodic`.

    Raises:
        ValueError: a kernel that is not stationary: its eigenfunctions are no oscillations of one frequency, and as
            resonators would need a frequency that is not finite where they are zero; a negative noise or damping; and
            as `QuasiPeriodic`.

    Example:
        >>> from lfm_ppl.forces import PeriodicMatern
        >>> kernel = PeriodicMatern(scale=1.0, lengthscale=1.0, period=24.0, order=2)
        >>> force = resonators(kernel)
        >>> len(force.forces), round(float(force.covariance(24.0)), 3)
        (3, 0.994)

    Source: Reece et al. (2014), appendix B.1.1.
    """
    noise = standard_deviation_parameter("noise", noise)
    basis: Waves = stationary_basis(kernel, functions, gamma)
    warn_of_lost_variance(kernel, basis, explained_variance)
    scales = safe_sqrt(basis.powers)
    found = [Resonator(kernel.period / (index + 1), scale, noise * scale, damping)
             for index, scale in enumerate(scales)]
    level = checks.concrete(basis.level)
    # A kernel may have no level at all, but its mean needs a place.
    spread = safe_sqrt(basis.level) if level is None or level > 0 else jnp.asarray(1e-150)
    return Sum((Constant(spread, mean), *found))
