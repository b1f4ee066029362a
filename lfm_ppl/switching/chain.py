"""A Markov chain of regimes in continuous time, as the controller of a discrete input."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from lfm_ppl.forces.discretise import MOST_DOUBLINGS, repeat, substep_series
from lfm_ppl.switching.controller import Controller
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import matmul


def check_rates(rates: Any, count: int) -> jax.Array:
    """Return transition rates (K, K) with rows that sum to zero, after checks.

    Raises:
        ValueError: not a square matrix, a negative rate, or a diagonal that is not minus the sum of its row.
    """
    if np.shape(rates) != (count, count):
        raise ValueError(f"rates must be a matrix ({count}, {count}), one row and column for each regime, got shape "
                         f"{np.shape(rates)}.")
    checks.finite("rates", rates)
    value = checks.concrete(rates)
    rates = jnp.asarray(rates, float)
    leaving = rates - jnp.diag(jnp.diagonal(rates))
    if value is not None:
        off = value - np.diag(np.diag(value))
        if (off < 0).any():
            raise ValueError(f"rates must not be negative off the diagonal, got {value.tolist()}.")
        diagonal = np.diag(value)
        if np.any((diagonal != 0) & ~np.isclose(diagonal, -off.sum(1))):
            hint = (" These are transition probabilities over a step dt: pass scipy.linalg.logm(P) / dt."
                    if np.allclose(value.sum(1), 1.0) else "")
            raise ValueError("the diagonal of rates must be zero, or minus the sum of the other rates of its row, got "
                             f"{value.tolist()}.{hint}")
    leaving = jnp.where(leaving < 0.0, jnp.nan, leaving)  # a density of -inf where the rates are traced
    return leaving - jnp.diag(leaving.sum(1))


def check_probabilities(probabilities: Any, count: int) -> jax.Array:
    """Return the probabilities (K,) after checks.

    Raises:
        ValueError: a wrong number of them, a negative one, or a sum that is not 1.
    """
    if np.shape(probabilities) != (count,):
        raise ValueError(f"initial must hold {count} probabilities, one for each regime, got shape "
                         f"{np.shape(probabilities)}.")
    value = checks.concrete(probabilities)
    if value is not None and (np.any(value < 0) or not np.isclose(value.sum(), 1.0)):
        raise ValueError(f"initial must hold probabilities that sum to 1, got {value.tolist()}.")
    probabilities = jnp.asarray(probabilities, float)
    is_valid = (probabilities >= 0).all() & (jnp.abs(probabilities.sum() - 1.0) < 1e-6)
    return jnp.where(is_valid, probabilities, jnp.nan)  # a density of -inf where they are traced


def transition_matrices(rates: jax.Array, lengths: jax.Array) -> jax.Array:
    """Return the transition probabilities exp(rates dt) (N, K, K) over times ``lengths`` (N,)."""

    def normalised(probabilities: jax.Array) -> jax.Array:
        return probabilities / probabilities.sum(-1, keepdims=True)

    def transition(length: jax.Array) -> jax.Array:
        series, _, doublings = substep_series(rates, length)
        # Each squaring would double the error of the sums of the rows, for rates that are fast compared with the data.
        (probabilities,) = repeat(lambda p: (normalised(matmul(p, p)),),
                                  (normalised(jnp.maximum(series.sum(0), 0.0)),), doublings, MOST_DOUBLINGS)
        return jnp.where(doublings <= MOST_DOUBLINGS, probabilities, jnp.nan)

    return jax.vmap(transition)(lengths)


class MarkovChain(Controller):
    """A Markov chain as a controller: its reading is a random number that does not depend on the state.

    Attributes:
        times: (T,), times of the decisions, increasing.
        transitions: (T, K, K), probabilities from each of these times to the next.
    """

    times: jax.Array
    transitions: jax.Array
    values: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, times: Any, transitions: Any) -> None:
        self.times, self.transitions = jnp.asarray(times, float), jnp.asarray(transitions, float)
        self.values = tuple(float(index) for index in range(self.transitions.shape[-1]))

    def reading(self, x: jax.Array, u: jax.Array, t: Any) -> jax.Array:
        """Return zero; the error of the reading is the random number."""
        return jnp.zeros(1)

    def variance(self) -> jax.Array:
        """Return the variance (1,) of the random number."""
        return jnp.ones(1)

    def decide(self, index: jax.Array, reading: jax.Array, t: Any) -> jax.Array:
        """Return the index of the next regime."""
        row = self.transitions[jnp.searchsorted(self.times, t, side="right") - 1, index]
        return jnp.minimum((ndtr(reading[0]) > jnp.cumsum(row)).sum(), row.shape[0] - 1)
