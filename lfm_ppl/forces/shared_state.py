"""Forces with a common state: a switch from one to the other keeps u and its derivatives.

1. The state of a Matern or a squared exponential force is (v, v'/lam, v''/lam^2, ...), with a rate lam that depends on
   the lengthscale. The same state under another lengthscale means other derivatives.
2. With the measurement h and the feedback F_1 of the unit process, u^(k) = lam^k h F_1^k z. The matrix O with the rows
   h F_1^k therefore gives the derivatives, in units of lam^k, for Matern forces the identity.
3. The state z of one force in terms of that of another one, with equal u^(k), is

       T z,    T = O^-1 diag((lam / lam_ref)^k) O.

   `SharedState` is the force whose state is T z.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.forces.quasi_periodic import QuasiPeriodic
from lfm_ppl.forces.sde import Force, Sum
from lfm_ppl.forces.squared_exponential import SquaredExponential
from lfm_ppl.forces.stretched import Stretched
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import congruence, matmul


class SharedState(Force):
    """A force whose state has the entries of the state of another force of the same type and order.

    Args:
        force: the force.
        reference: the force whose state gives the units of the derivatives.
    """

    force: Stretched
    reference: Stretched

    def __init__(self, force: Stretched, reference: Stretched):
        self.force, self.reference = force, reference

    @property  # type: ignore[misc]  # Equinox lets a property fill in an abstract field
    def mean(self) -> Any:
        """The mean of the force."""
        return self.force.mean

    @property
    def state_dim(self) -> int:
        """Number n of states."""
        return self.force.state_dim

    @property
    def stationary(self) -> bool:
        """Whether the force is stationary."""
        return self.force.stationary

    def initial_covariance(self) -> jax.Array:
        """Return P0 (n, n)."""
        return congruence(self._to_reference, self.force.initial_covariance())

    def feedback(self) -> jax.Array:
        """Return F (n, n)."""
        return matmul(matmul(self._to_reference, self.force.feedback()), self._from_reference)

    def dispersion(self) -> jax.Array:
        """Return L (n, S)."""
        return matmul(self._to_reference, self.force.dispersion())

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (n, n) and process noise (n, n) over a step of length dt >= 0."""
        transition, noise = self.force.discretise(dt)
        identity = jnp.eye(self.state_dim)
        # T and its inverse are rounded: of the change alone, a step of no length stays the identity.
        change = matmul(matmul(self._to_reference, transition - identity), self._from_reference)
        return identity + change, congruence(self._to_reference, noise)

    def measurement(self, t: ArrayLike) -> jax.Array | np.ndarray:
        """Return H (n,), which is that of the force, as u itself is the first of the quantities that are equal."""
        return self.force.measurement(t)

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the covariance of u(t) and u(s)."""
        return self.force.covariance(t, s)

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Return the spectral density S(omega)."""
        return self.force.spectral_density(omega)

    def check_span(self, name: str, first: float, last: float) -> None:
        """Check the force against data that span ``first`` to ``last``."""
        self.force.check_span(name, first, last)

    @property
    def _to_reference(self) -> jax.Array:
        """T (n, n)."""
        return self._change(self.force.rate / self.reference.rate)

    @property
    def _from_reference(self) -> jax.Array:
        """The inverse of T (n, n)."""
        return self._change(self.reference.rate / self.force.rate)

    def _change(self, ratio: jax.Array) -> jax.Array:
        """Return O^-1 diag(ratio^k) O, exactly the identity for a ratio of one."""
        excess = jnp.cumprod(jnp.full(self.state_dim, ratio)) / ratio - 1.0
        derivatives = _unit_derivatives(self.force)
        return jnp.eye(self.state_dim) + matmul(np.linalg.inv(derivatives), excess[:, None] * derivatives)


def _unit_derivatives(force: Stretched) -> np.ndarray:
    """Return O (n, n), the rows h F_1^k."""
    size = force.state_dim
    first = force.unit.measurement if isinstance(force, SquaredExponential) else np.eye(size)[0]
    return np.stack([first @ np.linalg.matrix_power(force.unit.feedback, k) for k in range(size)])


def in_state_of(force: Force, reference: Force) -> Force:
    """Return the force with the state of ``reference``, so that a switch between them keeps u and its derivatives.

    A force whose state has the same meaning for all parameters is returned as it is, and so is one of the same
    lengthscale as ``reference``.

    Args:
        force: the force.
        reference: a force of the same structure, see `structure_of`.
    """
    if isinstance(force, Stretched) and isinstance(reference, Stretched):
        return force if force.state_dim == 1 or _is_equal(force, reference) else SharedState(force, reference)
    if isinstance(force, Sum) and isinstance(reference, Sum):
        return Sum(tuple(in_state_of(*pair) for pair in zip(force.forces, reference.forces, strict=True)))
    if isinstance(force, QuasiPeriodic) and isinstance(reference, QuasiPeriodic):
        evolution = in_state_of(force.evolution, reference.evolution)
        return eqx.tree_at(lambda periodic: periodic.evolution, force, evolution)
    return force


def structure_of(force: Force) -> str:
    """Return type, size and parts of a force in words."""
    parts: tuple[Force, ...] = ()
    if isinstance(force, Sum):
        parts = force.forces
    elif isinstance(force, QuasiPeriodic):
        parts = (force.evolution,)
    inner = " of " + ", ".join(map(structure_of, parts)) if parts else ""
    return f"{type(force).__name__} with {checks.counted(force.state_dim, 'state')}{inner}"


def _is_equal(force: Stretched, reference: Stretched) -> bool:
    """Return whether both have the same lengthscale, as far as it is known before compilation."""
    if force.lengthscale is reference.lengthscale:
        return True
    lengthscales = checks.concrete(force.lengthscale), checks.concrete(reference.lengthscale)
    return all(value is not None for value in lengthscales) and bool(lengthscales[0] == lengthscales[1])
