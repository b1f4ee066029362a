"""The force protocol: a Gaussian process prior written as a linear SDE.

1. `Force` is one process u(t): the matrices F, L and P0 of its SDE, its measurement H(t) and its mean.
2. `Force.discretise` gives the exact transition and process noise of one step; the default is
   `lfm_ppl.forces.discretise`, and forces with a closed form override it.
3. Some forces jump at given times, ``z <- G z + N(0, Q)``.
4. `IndependentForces` joins the SDEs of several forces into one block-diagonal SDE.
5. `Stack` has one output per force: it is the force block of the joint state-space model.
6. `Sum` adds the outputs, and is a force itself.
7. `sde_covariance` and `sde_spectral_density` compute the second moments of the state-space form, which tests compare
   with the closed forms.

Source: Hartikainen, Seppanen and Sarkka (2012), ICML, section 3.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.typing import ArrayLike

from lfm_ppl.forces.discretise import discretise_dispersion
from lfm_ppl.utils.semidefinite import semidefinite_root


class ApproximationWarning(UserWarning):
    """The SDE of a force differs noticeably from the process that it approximates."""


class Force(eqx.Module):
    """A Gaussian process u(t) with a state-space form, the prior of an unobserved force.

        u(t) = mean(t) + H(t) z(t),    dz = F z dt + L dbeta,    z(t0) ~ N(0, P0),

    with a standard Brownian motion ``beta``. A subclass implements ``initial_covariance`` (P0), ``feedback`` (F) and
    ``dispersion`` (L, which includes the spectral density of the noise), and has a field ``mean``. All other methods
    have defaults. A subclass may override ``stationary`` (False by default), ``discretise`` by a closed form and
    ``measurement`` by a time-dependent row, and may add jumps of the state at given times. The functions of
    `lfm_ppl.forces.parameters` check constructor arguments.

    A force is a pytree: parameters are its array leaves, so that it passes through ``jax.jit``,
    ``jax.vmap`` and ``jax.grad``. Constructors check concrete parameters and let tracers pass.

    Attributes:
        mean: a number, or a function of time that returns a number; added to the process.
    """

    mean: eqx.AbstractVar[Any]

    @property
    def state_dim(self) -> int:
        """Number n of states. A subclass may state it as a class attribute, which saves tracing ``feedback``."""
        return jax.eval_shape(self.feedback).shape[0]

    @property
    def noise_dim(self) -> int:
        """Number S of independent Brownian motions that drive the states."""
        return jax.eval_shape(self.dispersion).shape[1]

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
        """Return H(t) (n,), by default the row that reads the first state.

        Return a NumPy array where H is constant: products with it then become slices (`lfm_ppl.utils.linalg.matmul`).
        """
        return np.eye(self.state_dim)[0]

    def mean_at(self, t: ArrayLike) -> jax.Array:
        """Return the mean of the force at time t, a scalar."""
        value = jnp.asarray(self.mean(t) if callable(self.mean) else self.mean)
        if value.shape != ():
            raise ValueError(f"mean must return one number, got an array of shape {value.shape}.")
        return value

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the closed-form covariance of u(t) and u(s), elementwise.

        For a stationary force it depends on ``t - s`` alone, so that ``covariance(lag)`` is its kernel.
        Forces that are not stationary count both times from the model's initial time.

        Raises:
            NotImplementedError: no closed form is known.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no closed-form covariance; `sde_covariance` computes it "
            "from the state-space form."
        )

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Return the closed-form spectral density S(omega), elementwise.

        It is two-sided in angular frequency: ``covariance(0) = 1/(2 pi) int S(omega) domega``.

        Raises:
            NotImplementedError: no closed form is known, or the process has no spectral density.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no closed-form spectral density; for a stationary force "
            "`sde_spectral_density` computes it from the state-space form."
        )

    def sde_covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the covariance of u(t) and u(s) under the state-space form, elementwise.

        ``H(t) exp(F (t - s)) P(s) H(s)'`` for t >= s. It equals ``covariance`` where the state-space form is exact.
        Times are counted as in ``covariance``.

        Raises:
            NotImplementedError: the force has jumps.
        """
        if self.jump_times:
            raise NotImplementedError(
                "the covariance of a force with jumps is not available between arbitrary times; "
                "simulate a model with this force instead."
            )
        return _covariance(self, t, s)

    def covariance_in_model(self, t: ArrayLike, s: ArrayLike, initial_time: ArrayLike) -> jax.Array:
        """Return the covariance of u(t) and u(s) in a model that starts at ``initial_time``, elementwise.

        The default is the closed form, or ``sde_covariance`` where there is none, with both times counted from
        ``initial_time``. A force whose covariance depends on absolute time overrides this method.

        Raises:
            NotImplementedError: the force has jumps and does not override this method.
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
            NotImplementedError: the force is not stationary.
        """
        if not self.stationary:
            raise NotImplementedError(
                f"{type(self).__name__} is not stationary, so it has no spectral density; "
                "use `sde_covariance`."
            )
        return _spectral_density(self, omega)

    @property
    def jump_times(self) -> tuple[float, ...]:
        """Increasing times at which the state jumps, as static Python numbers; none by default."""
        return ()

    def jump(self, index: int) -> tuple[jax.Array, jax.Array]:
        """Return G (n, n) and Q (n, n) of the jump ``z <- G z + N(0, Q)`` at ``jump_times[index]``.

        Args:
            index: a Python int, so that each jump may compute its matrices differently.

        Raises:
            IndexError: there is no jump with this index.
        """
        count = len(self.jump_times)
        raise IndexError(f"{type(self).__name__} has {count} jumps, so there is no jump at index {index}.")

    def check_span(self, name: str, first: float, last: float) -> None:
        """Check the force against data that span ``first`` to ``last``; the default accepts any span.

        Raises:
            ValueError: the data carry no information on the force, for example on a period longer than their span.
        """

    def __add__(self, term: "Force") -> "Force":
        """Return the sum of two independent forces."""
        return Sum((self, term)) if isinstance(term, Force) else NotImplemented

    def __radd__(self, term: Any) -> "Force":
        """Return the force itself for 0 + force, the first addition of ``sum(forces)``."""
        return self if isinstance(term, int) and term == 0 else NotImplemented


class IndependentForces(eqx.Module):
    """The block-diagonal SDE of several independent forces; base of `Stack` and `Sum`.

    Attributes:
        forces: R forces. The states are in their order.
    """

    forces: tuple[Force, ...]

    @property
    def state_dim(self) -> int:
        """Number n of states of all forces."""
        return sum(force.state_dim for force in self.forces)

    def initial_covariance(self) -> jax.Array:
        """Return P0 (n, n)."""
        return block_diagonal([force.initial_covariance() for force in self.forces])

    def feedback(self) -> jax.Array:
        """Return F (n, n)."""
        return block_diagonal([force.feedback() for force in self.forces])

    def dispersion(self) -> jax.Array:
        """Return L (n, S)."""
        return block_diagonal([force.dispersion() for force in self.forces])

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (n, n) and process noise (n, n) over a step of length dt >= 0."""
        pairs = [force.discretise(dt) for force in self.forces]
        return block_diagonal([p[0] for p in pairs]), block_diagonal([p[1] for p in pairs])

    @property
    def jump_times(self) -> tuple[float, ...]:
        """Distinct times at which a force jumps, increasing."""
        return tuple(sorted({time for force in self.forces for time in force.jump_times}))

    def jump(self, index: int) -> tuple[jax.Array, jax.Array]:
        """Return G (n, n) and Q (n, n) at ``jump_times[index]``; forces without a jump there are unchanged."""
        time = self.jump_times[index]
        pairs = [_jump_at(force, time) for force in self.forces]
        return block_diagonal([p[0] for p in pairs]), block_diagonal([p[1] for p in pairs])


class Stack(IndependentForces):
    """Several independent forces, perhaps none, as one block-diagonal SDE with a vector output.

    Example:
        >>> from lfm_ppl.forces import Constant, Matern
        >>> stack = Stack((Matern(1.0, 2.0, order=1), Constant(3.0)))
        >>> stack.measurement(0.0).shape
        (2, 3)
    """

    def measurement(self, t: ArrayLike) -> Any:
        """Return H(t) (R, n), one row for each force."""
        rows = [force.measurement(t)[None, :] for force in self.forces]
        return block_diagonal(rows) if rows else np.zeros((0, 0))

    def mean_at(self, t: ArrayLike) -> jax.Array:
        """Return the means (R,) at time t."""
        return jnp.asarray([force.mean_at(t) for force in self.forces], dtype=float)

    def jump_table(self) -> tuple[jax.Array, jax.Array] | None:
        """Return G and Q (K + 1, n, n) of all K jumps, or None without jumps.

        The last entry (index -1) is the identity without noise, for rows of a time grid without a jump.
        """
        if not self.jump_times:
            return None
        identity = (jnp.eye(self.state_dim), jnp.zeros((self.state_dim, self.state_dim)))
        pairs = [*(self.jump(index) for index in range(len(self.jump_times))), identity]
        return jnp.stack([pair[0] for pair in pairs]), jnp.stack([pair[1] for pair in pairs])

    def jump_roots(self) -> tuple[jax.Array, jax.Array] | None:
        """Return `jump_table` with a square root of Q in place of Q, for draws ``z <- G z + root N(0, I)``."""
        table = self.jump_table()
        return None if table is None else (table[0], jax.vmap(semidefinite_root)(table[1]))


class Sum(IndependentForces, Force):
    """The sum of independent forces, itself a force: ``u(t) = sum_r u_r(t)``.

    States are stacked and measurements concatenated; means, covariances and spectral densities are added, and jumps
    are merged. ``force + force`` is the usual way to write it.

    Args:
        forces: at least one force; sums among them are flattened.

    Raises:
        TypeError: an entry is not a force.
        ValueError: there are no forces.

    Example:
        >>> from lfm_ppl.forces import Constant, Matern
        >>> force = Matern(1.0, 2.0) + Constant(3.0)
        >>> round(float(force.covariance(0.0)), 4)
        10.0
    """

    def __init__(self, forces: tuple[Force, ...]):
        terms: list[Force] = []
        for force in forces:
            if not isinstance(force, Force):
                raise TypeError(f"forces must contain forces only, got {force!r}.")
            terms.extend(force.forces if isinstance(force, Sum) else (force,))
        if not terms:
            raise ValueError("forces must contain at least one force, got none.")
        self.forces = tuple(terms)

    @property  # type: ignore[misc]  # Equinox lets a property fill in an abstract field
    def mean(self) -> Callable[[ArrayLike], jax.Array]:
        """The sum of the means, as a function of time."""
        return self.mean_at

    @property
    def stationary(self) -> bool:
        """Whether every term is stationary."""
        return all(force.stationary for force in self.forces)

    def measurement(self, t: ArrayLike) -> jax.Array | np.ndarray:
        """Return H(t) (n,), the concatenated measurements of the terms."""
        return Stack(self.forces).measurement(t).sum(0)

    def mean_at(self, t: ArrayLike) -> jax.Array:
        """Return the sum of the means at time t."""
        return Stack(self.forces).mean_at(t).sum()

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the sum of the closed-form covariances."""
        return functools.reduce(jnp.add, [force.covariance(t, s) for force in self.forces])

    def sde_covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the sum of the state-space covariances of the terms."""
        return functools.reduce(jnp.add, [force.sde_covariance(t, s) for force in self.forces])

    def covariance_in_model(self, t: ArrayLike, s: ArrayLike, initial_time: ArrayLike) -> jax.Array:
        """Return the sum of the terms' covariances in a model that starts at ``initial_time``."""
        return functools.reduce(jnp.add, [f.covariance_in_model(t, s, initial_time) for f in self.forces])

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Return the sum of the closed-form spectral densities."""
        return functools.reduce(jnp.add, [f.spectral_density(omega) for f in self.forces])

    def check_span(self, name: str, first: float, last: float) -> None:
        """Check every term."""
        for force in self.forces:
            force.check_span(name, first, last)


def block_diagonal(blocks: Sequence[jax.Array | np.ndarray]) -> Any:
    """Return the block-diagonal matrix of ``blocks`` (r_i, c_i), in NumPy if all are NumPy; (0, 0) without blocks."""
    if blocks and all(isinstance(block, np.ndarray) for block in blocks):
        return scipy.linalg.block_diag(*blocks)
    return jax.scipy.linalg.block_diag(*blocks) if blocks else jnp.zeros((0, 0))


def _jump_at(force, time):
    if time in force.jump_times:
        return force.jump(force.jump_times.index(time))
    return jnp.eye(force.state_dim), jnp.zeros((force.state_dim, force.state_dim))


@eqx.filter_jit
def _covariance(force, t, s):
    def covariance_of_pair(t, s):
        late, early = jnp.maximum(t, s), jnp.minimum(t, s)
        variance = force.initial_covariance()
        if not force.stationary:
            transition, noise = force.discretise(early)
            variance = transition @ variance @ transition.T + noise
        row = force.measurement(late) @ force.transition(late - early)
        return row @ variance @ force.measurement(early)

    return jnp.vectorize(covariance_of_pair)(t, s)


@eqx.filter_jit
def _spectral_density(force, omega):
    feedback, dispersion = force.feedback(), force.dispersion()

    def density(w):
        resolvent = 1j * w * jnp.eye(force.state_dim) - feedback
        gain = force.measurement(0.0) @ jnp.linalg.solve(resolvent, dispersion + 0j)
        return (jnp.abs(gain) ** 2).sum()

    return jnp.vectorize(density)(omega)
