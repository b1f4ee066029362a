"""The phi functions of a matrix, which integrate inputs that are polynomials in time.

`discretise_driven` and `phi_functions` use the power series and the doublings of `lfm_ppl.forces.discretise`.

Source: Al-Mohy and Higham (2009), SIAM J. Matrix Anal. Appl. 31(3); Hochbruck and Ostermann (2010), Acta Numerica 19,
section 2.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.forces.discretise import MOST_DOUBLINGS, as_arrays, discretise, repeat, substep_series
from lfm_ppl.utils.linalg import matmul


def discretise_driven(feedback: jax.Array, input_ends: jax.Array, diffusion: jax.Array,
                      duration: ArrayLike) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return transition, offset and process noise of a linear SDE with an input that is linear in time.

    For ``dz = (F z + b(s)) ds + L dbeta`` with ``D = L L'`` and b linear over the step, the state at the end is
    ``Phi z + offset + N(0, Q)``. Two more states carry b: a constant one, and the share of the step so far.

    Args:
        feedback: ``F`` (n, n), in 1/time.
        input_ends: b at the start and at the end, (2, n).
        diffusion: ``D`` (n, n).
        duration: length of the step, a scalar.

    Returns:
        ``Phi`` (n, n), the offset (n,) and ``Q`` (n, n).

    Example:
        >>> import jax.numpy as jnp
        >>> zero = jnp.zeros((1, 1))
        >>> float(discretise_driven(zero, jnp.array([[0.0], [2.0]]), zero, 3.0)[1][0])
        3.0
    """
    start, end = input_ends
    columns = duration * jnp.stack([start, end - start], axis=1)
    # The unit of the input must not raise the number of doublings.
    unit = jax.lax.stop_gradient(jnp.maximum(jnp.max(jnp.abs(columns), initial=0.0), 1e-150))
    below = np.zeros((2, columns.shape[0] + 2))
    below[1, -2] = 1.0
    augmented = jnp.concatenate([jnp.concatenate([duration * feedback, columns / unit], axis=1), below])
    transition, noise = discretise(augmented, jnp.pad(duration * diffusion, (0, 2)), 1.0)
    return transition[:-2, :-2], unit * transition[:-2, -2], noise[:-2, :-2]


def phi_functions(matrix: jax.Array, max_doublings: int = MOST_DOUBLINGS) -> jax.Array:
    r"""Return exp(X) and the functions phi_1, phi_2, phi_3 of a matrix X.

    They integrate inputs that are polynomials in time,

        phi_k(X) = int_0^1 exp(X (1 - s)) s^(k - 1) / (k - 1)! ds,
        phi_k(2 X) = (exp(X) phi_k(X) + sum_(0 <= j < k) phi_(k - j)(X) / j!) / 2^k.

    Args:
        matrix: X (n, n).
        max_doublings: as in `discretise`.

    Returns:
        (4, n, n); NaN where X needs more than `max_doublings` doublings.

    Example:
        >>> import jax.numpy as jnp
        >>> [round(float(phi), 4) for phi in phi_functions(jnp.array([[-1.0]]))[:, 0, 0]]
        [0.3679, 0.6321, 0.3679, 0.1321]
    """
    (matrix,) = as_arrays(matrix)
    series, _, doublings = substep_series(matrix, 1.0)
    orders = range(len(series))
    # phi_k(X) is the sum of X^j / (j + k)! over j.
    ratios = np.array([[math.factorial(j) / math.factorial(j + k) for j in orders] for k in range(4)])
    start = (jnp.asarray(ratios, series.dtype)[:, :, None, None] * series).sum(1)

    def double_once(phi: jax.Array) -> tuple[jax.Array]:
        exponential, first, second, third = matmul(phi[:1], phi)
        _, phi1, phi2, phi3 = phi
        return (jnp.stack([exponential, (first + phi1) / 2, (second + phi2 + phi1) / 4,
                           (third + phi3 + phi2 + phi1 / 2) / 8]),)

    (phi,) = repeat(double_once, (start,), doublings, max_doublings)
    return jnp.where(doublings <= max_doublings, phi, jnp.nan)


def scalar_phi_functions(z: jax.Array) -> jax.Array:
    """Return exp(z) and phi_1, phi_2, phi_3 of numbers z (...), see `phi_functions`: (4, ...).

    Where z is small they are sums of a series, because the closed formulas cancel.
    """
    is_small = jnp.abs(z) < 1.0
    small, large = jnp.where(is_small, z, 0.0), jnp.where(is_small, 1.0, z)
    third = jnp.ones_like(z)
    for order in range(20, 3, -1):
        third = 1.0 + small * third / order
    first_large = jnp.expm1(large) / large
    second_large = (first_large - 1.0) / large
    third = jnp.where(is_small, third / 6.0, (second_large - 0.5) / large)
    second = jnp.where(is_small, 0.5 + small * third, second_large)
    return jnp.stack([jnp.exp(z), jnp.where(is_small, 1.0 + small * second, first_large), second, third])
