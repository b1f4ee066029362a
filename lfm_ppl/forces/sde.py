"""The force protocol: a Gaussian process prior written as a linear SDE."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.forces.discretise import discretise_dispersion


class ApproximationWarning(UserWarning):
    """The SDE of a force differs from the process that it stands for, by more than can be left unsaid."""


class Force(eqx.Module):
    """A Gaussian process u(t) with a state-space form, the prior of an unobserved force.

        u(t) = mean(t) + H(t) z(t),    dz = F z dt + L dbeta,    z(t0) ~ N(0, P0),

    with a standard Brownian motion ``beta``. A subclass says ``initial_covariance`` (P0),
    ``feedback`` (F), ``dispersion`` (L, spectral density folded in) and its dimensions; everything
    else has a default. It may replace ``discretise`` by a closed form, the measurement by one that
    depends on time, and add jumps of the state at given times.

    A force is a pytree: parameters are its array leaves, so that it passes through ``jax.jit``,
    ``jax.vmap`` and ``jax.grad``. Constructors check concrete parameters and let tracers pass.

    Attributes:
        mean: a number, or a function of time that returns a number; added to the process.
    """

    mean: eqx.AbstractVar[Any]

    @property
    def state_dim(self) -> int:
        """Number n of states."""
        raise NotImplementedError

    @property
    def noise_dim(self) -> int:
        """Number S of independent Brownian motions that drive the states."""
        raise NotImplementedError

    @property
    def stationary(self) -> bool:
        """Whether P0 is the stationary covariance and H does not depend on time."""
        return False

    def initial_covariance(self) -> jax.Array:
        """Return P0 (n, n), the covariance of the state at the model's initial time."""
        raise NotImplementedError

    def feedback(self) -> jax.Array:
        """Return F (n, n)."""
        raise NotImplementedError

    def dispersion(self) -> jax.Array:
        """Return L (n, S)."""
        raise NotImplementedError

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (n, n) and process noise (n, n) over a step of length dt >= 0."""
        return discretise_dispersion(self.feedback(), self.dispersion(), dt)

    def transition(self, dt: ArrayLike) -> jax.Array:
        """Return exp(F dt) (n, n)."""
        return self.discretise(dt)[0]

    def process_noise(self, dt: ArrayLike) -> jax.Array:
        """Return the covariance (n, n) that a step of length dt adds, exact for any dt."""
        return self.discretise(dt)[1]

    def measurement(self, t: ArrayLike) -> jax.Array | np.ndarray:
        """Return H(t) (n,); the first state by default. A constant one is best a NumPy array."""
        return np.eye(self.state_dim)[0]

    def mean_at(self, t: ArrayLike) -> jax.Array:
        """Return the mean of the force at time t, a scalar."""
        value = jnp.asarray(self.mean(t) if callable(self.mean) else self.mean)
        if value.shape != ():
            raise ValueError(f"mean must return one number, got an array of shape {value.shape}.")
        return value

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the closed-form covariance of u(t) and u(s), elementwise.

        For a stationary force only ``t - s`` matters, so that ``covariance(lag)`` is its kernel.
        Forces that are not stationary count both times from the model's initial time.

        Raises:
            NotImplementedError: where no closed form is known.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no closed-form covariance; `sde_covariance` computes it "
            "from the state-space form."
        )

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Return the closed-form spectral density S(omega), elementwise.

        It is two-sided in angular frequency: ``covariance(0) = 1/(2 pi) int S(omega) domega``.

        Raises:
            NotImplementedError: where no closed form is known or no spectral density exists.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no closed-form spectral density; for a stationary force "
            "`sde_spectral_density` computes it from the state-space form."
        )

    def sde_covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the covariance of u(t) and u(s) that the state-space form has, elementwise.

        ``H(t) exp(F (t - s)) P(s) H(s)'`` for t >= s. It equals ``covariance`` for an exact form
        and shows the approximation otherwise. Times as in ``covariance``.

        Raises:
            NotImplementedError: for a force with jumps.
        """
        if self.jump_times:
            raise NotImplementedError(
                "the covariance of a force with jumps is not available between arbitrary times; "
                "simulate a model with this force instead."
            )
        return _covariance(self, t, s)

    def covariance_in_model(self, t: ArrayLike, s: ArrayLike, initial_time: ArrayLike) -> jax.Array:
        """Return the covariance of u(t) and u(s) in a model that starts at ``initial_time``, elementwise.

        It is the closed form, or that of the state-space form where there is none, with both times counted from
        ``initial_time``. A force whose covariance depends on the time itself replaces it.

        Raises:
            NotImplementedError: for a force with jumps that does not replace it.
        """
        if self.jump_times:
            raise NotImplementedError(f"{type(self).__name__} jumps, and has no covariance between arbitrary times.")
        t, s = jnp.asarray(t) - initial_time, jnp.asarray(s) - initial_time
        try:
            return self.covariance(t, s)
        except NotImplementedError:
            return self.sde_covariance(t, s)

    def sde_spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Return the spectral density ``|H (i omega - F)^-1 L|^2`` of the state-space form.

        Raises:
            NotImplementedError: for a force that is not stationary.
        """
        if not self.stationary:
            raise NotImplementedError(
                f"{type(self).__name__} is not stationary, so it has no spectral density; "
                "use `sde_covariance`."
            )
        return _spectral_density(self, omega)

    @property
    def jump_times(self) -> tuple[float, ...]:
        """Increasing times at which the state jumps; none by default. They are static."""
        return ()

    def jump(self, index: int) -> tuple[jax.Array, jax.Array]:
        """Return G (n, n) and Q (n, n) of the jump ``z <- G z + N(0, Q)`` at ``jump_times[index]``.

        Args:
            index: a Python int, so that each jump may have matrices of its own making.

        Raises:
            IndexError: where there is no such jump.
        """
        count = len(self.jump_times)
        raise IndexError(f"{type(self).__name__} has {count} jumps, so none at index {index}.")

    def check_span(self, name: str, first: float, last: float) -> None:
        """Check the force against data from ``first`` to ``last``; all is well by default.

        Raises:
            ValueError: nothing can be learned from such data, for example about a period longer than they are.
        """

    def __add__(self, other: "Force") -> "Force":
        """Return the force that is the sum of two independent forces."""
        # The sum is itself a force, so its module imports this one.
        from lfm_ppl.forces.sum import Sum

        return Sum((self, other)) if isinstance(other, Force) else NotImplemented

    def __radd__(self, other: Any) -> "Force":
        """Return the force itself for 0 + force, with which ``sum(forces)`` begins."""
        return self if isinstance(other, int) and other == 0 else NotImplemented


@eqx.filter_jit
def _covariance(force, t, s):
    def between(t, s):
        late, early = jnp.maximum(t, s), jnp.minimum(t, s)
        variance = force.initial_covariance()
        if not force.stationary:
            transition, noise = force.discretise(early)
            variance = transition @ variance @ transition.T + noise
        row = force.measurement(late) @ force.transition(late - early)
        return row @ variance @ force.measurement(early)

    return jnp.vectorize(between)(t, s)


@eqx.filter_jit
def _spectral_density(force, omega):
    feedback, dispersion = force.feedback(), force.dispersion()

    def density(w):
        resolvent = 1j * w * jnp.eye(force.state_dim) - feedback
        gain = force.measurement(0.0) @ jnp.linalg.solve(resolvent, dispersion + 0j)
        return (jnp.abs(gain) ** 2).sum()

    return jnp.vectorize(density)(omega)
