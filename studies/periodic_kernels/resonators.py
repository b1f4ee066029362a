"""A sum of resonators whose prior is that of a periodic kernel."""

from __future__ import annotations

import jax.numpy as jnp
from jax.typing import ArrayLike

from lfm_ppl.forces import Constant, PeriodicCovariance, Resonator, Sum
from lfm_ppl.forces.basis import Waves
from lfm_ppl.forces.parameters import Mean, non_negative_parameter
from lfm_ppl.forces.quasi_periodic import EXPLAINED_VARIANCE, stationary_basis, warn_of_lost_variance
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import safe_sqrt


def resonators(kernel: PeriodicCovariance, functions: int | None = None, gamma: float = 0.01, noise: ArrayLike = 0.0,
               damping: ArrayLike = 0.0, mean: Mean = 0.0, explained_variance: float = EXPLAINED_VARIANCE) -> Sum:
    """Return the sum of a level and resonators that has a stationary periodic kernel as its prior.

    The leading eigenfunctions of such a kernel are a constant and pairs of cosine and sine, of frequencies j/D and
    variances q_j, its Fourier coefficients; a resonator of period D/j and scale sqrt(q_j) is the j-th pair. Without
    noise and damping the sum has the covariance of `Periodic` with as many functions. With noise, amplitude and phase
    of each resonator change with time independently, whereas a `QuasiPeriodic` force has one process for all weights.

    Args:
        kernel: a stationary periodic kernel.
        functions: 1 + 2 times the number of resonators; as in `QuasiPeriodic`.
        gamma: share of the largest eigenvalue above which an eigenvalue is significant.
        noise: noise of each resonator relative to its scale, per time^(1/2); >= 0.
        damping: damping of each resonator, per unit of time; >= 0.
        mean: mean of the force: a number, or a function of time.
        explained_variance: least share of the kernel's variance that the resonators must explain; 0: no warning.

    Warns:
        ApproximationWarning: as in `QuasiPeriodic`.

    Raises:
        ValueError: the kernel is not stationary, so that its eigenfunctions are not oscillations of one frequency;
            noise or damping is negative; and as in `QuasiPeriodic`.

    Example:
        >>> from lfm_ppl.forces import PeriodicMatern
        >>> kernel = PeriodicMatern(scale=1.0, lengthscale=1.0, period=24.0, order=2)
        >>> force = resonators(kernel)
        >>> len(force.forces), round(float(force.covariance(24.0)), 3)
        (3, 0.994)

    Source: Reece et al. (2014), appendix B.1.1.
    """
    noise_sd = non_negative_parameter("noise", noise)
    basis: Waves = stationary_basis(kernel, functions, gamma)
    warn_of_lost_variance(kernel, basis, explained_variance)
    scales = safe_sqrt(basis.powers)
    terms = [Resonator(kernel.period / (index + 1), scale, noise_sd * scale, damping)
             for index, scale in enumerate(scales)]
    level = checks.concrete(basis.level)
    # A kernel may have no level, but the level's force carries the mean. A tiny scale stands for zero.
    level_scale = safe_sqrt(basis.level) if level is None or level > 0 else jnp.asarray(1e-150)
    return Sum((Constant(level_scale, mean), *terms))
