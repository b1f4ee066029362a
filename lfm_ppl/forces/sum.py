"""Several independent forces as one: side by side, or added."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.typing import ArrayLike

from lfm_ppl.forces.sde import Force


class Stack(eqx.Module):
    """Several independent forces side by side: one block-diagonal SDE with a vector output.

    Attributes:
        forces: R forces; none is legal. The states are in their order.

    Example:
        >>> from lfm_ppl.forces import Constant, Matern
        >>> stack = Stack((Matern(1.0, 2.0, order=1), Constant(3.0)))
        >>> stack.measurement(0.0).shape
        (2, 3)
    """

    forces: tuple[Force, ...]

    @property
    def state_dim(self) -> int:
        """Number n of states of all forces."""
        return sum(force.state_dim for force in self.forces)

    @property
    def noise_dim(self) -> int:
        """Number S of Brownian motions of all forces."""
        return sum(force.noise_dim for force in self.forces)

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

    def measurement(self, t: ArrayLike) -> Any:
        """Return H(t) (R, n), one row for each force."""
        rows = [force.measurement(t)[None, :] for force in self.forces]
        return block_diagonal(rows) if rows else np.zeros((0, 0))

    def mean_at(self, t: ArrayLike) -> jax.Array:
        """Return the means (R,) at time t."""
        return jnp.asarray([force.mean_at(t) for force in self.forces], dtype=float)

    @property
    def jump_times(self) -> tuple[float, ...]:
        """All times at which a force jumps, increasing, each once."""
        return tuple(sorted({time for force in self.forces for time in force.jump_times}))

    def jump(self, index: int) -> tuple[jax.Array, jax.Array]:
        """Return G (n, n) and Q (n, n) at ``jump_times[index]``; the other forces stay."""
        time = self.jump_times[index]
        pairs = [_jump_at(force, time) for force in self.forces]
        return block_diagonal([p[0] for p in pairs]), block_diagonal([p[1] for p in pairs])

    def jump_table(self) -> tuple[jax.Array, jax.Array] | None:
        """Return G and Q (K + 1, n, n) of all K jumps, the last entry (index -1) for no jump; None without any."""
        if not self.jump_times:
            return None
        nothing = (jnp.eye(self.state_dim), jnp.zeros((self.state_dim, self.state_dim)))
        pairs = [*(self.jump(index) for index in range(len(self.jump_times))), nothing]
        return jnp.stack([pair[0] for pair in pairs]), jnp.stack([pair[1] for pair in pairs])


class Sum(Force):
    """The sum of independent forces, itself a force: ``u(t) = sum_r u_r(t)``.

    States stack, measurements concatenate; means, covariances and spectral densities add, and
    jumps merge. ``force + force`` is the usual way to write it.

    Args:
        forces: at least one force; sums among them are flattened.

    Raises:
        TypeError: where an entry is not a force.
        ValueError: where there is none.

    Example:
        >>> from lfm_ppl.forces import Constant, Matern
        >>> force = Matern(1.0, 2.0) + Constant(3.0)
        >>> round(float(force.covariance(0.0)), 4)
        10.0
    """

    stack: Stack

    def __init__(self, forces: tuple[Force, ...]):
        flat: list[Force] = []
        for force in forces:
            if not isinstance(force, Force):
                raise TypeError(f"forces must contain forces only, got {force!r}.")
            flat.extend(force.forces if isinstance(force, Sum) else (force,))
        if not flat:
            raise ValueError("forces must contain at least one force, got none.")
        self.stack = Stack(tuple(flat))

    @property
    def forces(self) -> tuple[Force, ...]:
        """The forces that are added."""
        return self.stack.forces

    @property  # type: ignore[misc]  # Equinox lets a property fill in an abstract field
    def mean(self) -> Callable[[ArrayLike], jax.Array]:
        """The sum of the means, as a function of time."""
        return self.mean_at

    @property
    def state_dim(self) -> int:
        """Number n of states of all terms."""
        return self.stack.state_dim

    @property
    def noise_dim(self) -> int:
        """Number S of Brownian motions of all terms."""
        return self.stack.noise_dim

    @property
    def stationary(self) -> bool:
        """Whether every term is stationary."""
        return all(force.stationary for force in self.forces)

    def initial_covariance(self) -> jax.Array:
        """Return P0 (n, n), block-diagonal."""
        return self.stack.initial_covariance()

    def feedback(self) -> jax.Array:
        """Return F (n, n), block-diagonal."""
        return self.stack.feedback()

    def dispersion(self) -> jax.Array:
        """Return L (n, S), block-diagonal."""
        return self.stack.dispersion()

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (n, n) and process noise (n, n), block-diagonal."""
        return self.stack.discretise(dt)

    def measurement(self, t: ArrayLike) -> jax.Array | np.ndarray:
        """Return H(t) (n,), the measurements of the terms one after the other."""
        return self.stack.measurement(t).sum(0)

    def mean_at(self, t: ArrayLike) -> jax.Array:
        """Return the sum of the means at time t."""
        return self.stack.mean_at(t).sum()

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the sum of the closed-form covariances."""
        return functools.reduce(jnp.add, [force.covariance(t, s) for force in self.forces])

    def sde_covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the sum of the covariances that the terms have in state space."""
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

    @property
    def jump_times(self) -> tuple[float, ...]:
        """All times at which a term jumps."""
        return self.stack.jump_times

    def jump(self, index: int) -> tuple[jax.Array, jax.Array]:
        """Return G (n, n) and Q (n, n), block-diagonal, at ``jump_times[index]``."""
        return self.stack.jump(index)


def block_diagonal(blocks: Sequence[jax.Array | np.ndarray]) -> Any:
    """Return the matrix with ``blocks`` (r_i, c_i) on its diagonal, in NumPy if all are; (0, 0) without any."""
    if blocks and all(isinstance(block, np.ndarray) for block in blocks):
        return scipy.linalg.block_diag(*blocks)
    return jax.scipy.linalg.block_diag(*blocks) if blocks else jnp.zeros((0, 0))


def _jump_at(force, time):
    if time in force.jump_times:
        return force.jump(force.jump_times.index(time))
    return jnp.eye(force.state_dim), jnp.zeros((force.state_dim, force.state_dim))
