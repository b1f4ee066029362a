"""The sparse spectrum approximation: oscillations of random frequencies, for comparison with other forces."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.forces import Force, Matern, PeriodicCovariance, SquaredExponential
from lfm_ppl.forces.basis import Waves, fourier_coefficients
from lfm_ppl.forces.parameters import Mean, mean_parameter, positive_parameter
from lfm_ppl.utils import checks

_HARMONICS = 512


class SparseSpectrum(Force):
    r"""A sum of S oscillations that approximates a stationary Gaussian process by random frequencies.

        u(t) = sum_i a_i cos(w_i t) + b_i sin(w_i t),    a_i, b_i ~ N(0, scale^2 / S),
        k(t, s) = scale^2 / S sum_i cos(w_i (t - s)).

    With frequencies drawn from the spectral density of a kernel it is an unbiased estimate of the kernel, with an
    error of about ``scale^2 / sqrt(2 S)`` at long lags. It is meant for comparisons; `Matern`, `SquaredExponential`
    and, for periodic kernels, `Periodic` forces are more accurate and cheaper.

    Args:
        scale: standard deviation of u, in the units of the force; > 0.
        frequencies: (S,) w_i, in radians per unit of time.
        mean: a number, or a function of time.

    Raises:
        ValueError: the scale is not positive, or the frequencies are not a vector of finite numbers.

    Example:
        >>> import numpy as np
        >>> force = SparseSpectrum(scale=2.0, frequencies=np.array([1.0, 3.0]))
        >>> force.state_dim, float(force.covariance(0.0))
        (4, 4.0)

    Source: Lazaro-Gredilla et al. (2010), Journal of Machine Learning Research 11; Reece et al. (2014), section 5.
    """

    scale: jax.Array
    frequencies: jax.Array
    mean: Any

    def __init__(self, scale: ArrayLike, frequencies: ArrayLike, mean: Mean = 0.0):
        self.scale = positive_parameter("scale", scale)
        checks.finite("frequencies", frequencies)
        self.frequencies = jnp.asarray(frequencies, float)
        if self.frequencies.ndim != 1 or self.frequencies.shape[0] == 0:
            raise ValueError(f"frequencies must be a vector of at least one, got shape {self.frequencies.shape}.")
        self.mean = mean_parameter(mean)

    @property
    def _waves(self) -> Waves:
        count = self.frequencies.shape[0]
        return Waves(None, self.frequencies, self.scale**2 / count * jnp.ones(count))

    @property
    def stationary(self) -> bool:
        """True."""
        return True

    def initial_covariance(self) -> jax.Array:
        """Return P0 (n, n)."""
        return jnp.diag(self._waves.variances())

    def feedback(self) -> jax.Array:
        """Return F (n, n)."""
        return self._waves.feedback()

    def dispersion(self) -> jax.Array:
        """Return L (n, 0)."""
        return jnp.zeros((self.state_dim, 0))

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (n, n) and process noise (n, n), zero, over a step of length dt >= 0."""
        return self._waves.transition(dt), jnp.zeros((self.state_dim, self.state_dim))

    def measurement(self, t: ArrayLike) -> jax.Array:
        """Return H (n,), the same at all times."""
        return self._waves.row(t)

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return k(t - s), elementwise."""
        lag = jnp.asarray(t, float) - s
        return self.scale**2 * jnp.cos(lag[..., None] * self.frequencies).mean(-1)

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Raise NotImplementedError: the spectrum consists of lines."""
        raise NotImplementedError("a SparseSpectrum force has all its power at single frequencies, so its spectral "
                                  "density is not a function; use `covariance`.")

    def sde_spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Raise NotImplementedError like `spectral_density`."""
        return self.spectral_density(omega)


def random_frequencies(key: jax.Array, prior: Force | PeriodicCovariance, count: int) -> jax.Array:
    """Draw frequencies (count,) from the spectral density of a stationary kernel, in radians per unit of time.

    Args:
        key: JAX random key.
        prior: a `Matern` or `SquaredExponential` force, or a stationary periodic kernel, whose spectrum consists of
            lines at multiples of its frequency.
        count: S, the number of frequencies.

    Raises:
        TypeError: the prior is of another type, or the key is not a random key.
        ValueError: the kernel is not stationary.

    Example:
        >>> import jax
        >>> from lfm_ppl.forces import SquaredExponential
        >>> random_frequencies(jax.random.key(0), SquaredExponential(1.0, 10.0), 22).shape
        (22,)

    Source: Lazaro-Gredilla et al. (2010), section 3.
    """
    checks.random_key(key)
    checks.positive_integer("count", count)
    if isinstance(prior, Matern):
        # (1 + (w / lam)^2)^-(p + 1) is the density of Student's t with 2 p + 1 degrees of freedom.
        freedom = 2 * prior.order + 1
        return prior.rate / np.sqrt(freedom) * jax.random.t(key, freedom, (count,))
    if isinstance(prior, SquaredExponential):
        return jax.random.normal(key, (count,)) / prior.lengthscale
    if not isinstance(prior, PeriodicCovariance):
        raise TypeError("prior must be a lfm.Matern or lfm.SquaredExponential force or a stationary periodic kernel, "
                        f"got {type(prior).__name__}.")
    if not prior.stationary:
        raise ValueError(f"the kernel {prior.name!r} is not stationary, so it has no spectrum to draw from.")
    share = jnp.maximum(fourier_coefficients(prior, _HARMONICS), 0.0)
    return 2 * np.pi / prior.period * jax.random.choice(key, _HARMONICS + 1, (count,), p=share / share.sum())
