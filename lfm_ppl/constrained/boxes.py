"""Constraints as boxes: 0 <= c <= width, one for each bounded quantity, and the factors of a model under them."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.stats import norm

from lfm_ppl.constrained.constraints import Constraints
from lfm_ppl.constrained.truncated import truncated_moments
from lfm_ppl.filtering.quadrature import Marginal, Tilted


class Boxes(eqx.Module):
    """The constraints with both bounds of a quantity as one: 0 <= c(x, u, t) <= width.

    Two half lines as two sites of expectation propagation answer each other, and their evidence is off by .2; the
    moments of a normal distribution between two bounds are known.

    Attributes:
        constraints: c >= 0.
        widths: (B,), the upper bound less the lower one, infinity where a quantity has one bound.
        kept: those of the constraints that are left.
    """

    constraints: Constraints
    widths: jax.Array
    kept: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
        """Return (B,), the distance of each quantity from its lower bound, or from the upper where it has no other."""
        values = self.constraints(x, u, t)
        return jnp.stack([values[index] for index in self.kept]) if self.kept else values[:0]

    @property
    def count(self) -> int:
        """B, the number of boxes at a time."""
        return len(self.kept)

    @property
    def labels(self) -> tuple[str, ...]:
        """Of the boxes, by their first bound."""
        return tuple(self.constraints.labels[index] for index in self.kept)

    def slacks(self, values: jax.Array) -> jax.Array:
        """Return the slacks (..., C) of all constraints from the values (..., B) of the boxes."""
        given, below = self.constraints, len(self.constraints.lower_indices)
        slack = jnp.zeros((*values.shape[:-1], given.count))
        slack = slack.at[..., list(self.kept)].set(values)
        for i, index in enumerate(given.upper_indices):
            if index in given.lower_indices:
                j = given.lower_indices.index(index)
                slack = slack.at[..., below + i].set(self.widths[self.kept.index(j)] - values[..., self.kept.index(j)])
        return slack

    def box_of(self, index: int) -> tuple[int, float, jax.Array] | None:
        """Return the box of an entry of (x, u, y), the sign of its direction and the bound it starts at, if any."""
        given, below = self.constraints, len(self.constraints.lower_indices)
        if index in given.lower_indices:
            i = given.lower_indices.index(index)
            return self.kept.index(i), 1.0, given.lower[i]
        if index in given.upper_indices:
            i = given.upper_indices.index(index)
            return self.kept.index(below + i), -1.0, given.upper[i]
        return None


def boxes(constraints: Constraints) -> Boxes:
    """Put both bounds of a quantity together."""
    below, above = constraints.lower_indices, constraints.upper_indices
    kept = [*range(len(below)), *(len(below) + i for i, index in enumerate(above) if index not in below),
            *range(len(below) + len(above), constraints.count)]
    widths = jnp.full(constraints.count, jnp.inf)
    for i, index in enumerate(above):
        if index in below:
            j = below.index(index)
            widths = widths.at[j].set(constraints.upper[i] - constraints.lower[j])
    return Boxes(constraints, widths[jnp.asarray(kept, int)], tuple(kept))


class BoundedTerms(eqx.Module):
    """Factors N(y; f, R) of the data, and 1(0 <= f <= width) of the constraints.

    Attributes:
        y: (K, D), NaN where missing.
        variance: (K, D), R.
        held: (K, B), whether the constraint holds at the row.
        widths: (B,).
    """

    y: jax.Array
    variance: jax.Array
    held: jax.Array
    widths: jax.Array

    @property
    def present(self) -> jax.Array:
        """(K, D + B), whether an entry has a factor."""
        return jnp.concatenate([jnp.isfinite(self.y), self.held], axis=1)

    def tilted(self, cavity: Marginal, near: Marginal, power: float) -> Tilted:
        """Return the tilted moments in closed form; the power of an indicator is itself, that of the data must be 1."""
        data = self.y.shape[1]
        measured = _measured(Marginal(*(a[:, :data] for a in cavity)), self.y, self.variance)
        truncated = truncated_moments(Marginal(*(a[:, data:] for a in cavity)), self.widths)
        return Tilted(*(jnp.concatenate(pair, axis=1) for pair in zip(measured, truncated, strict=True)))


def _measured(cavity: Marginal, y: jax.Array, variance: jax.Array) -> Tilted:
    y = jnp.where(jnp.isfinite(y), y, 0.0)
    total = cavity.variance + variance
    gain = cavity.variance / total
    shift = gain * (y - cavity.mean)
    return Tilted(norm.logpdf(y, cavity.mean, jnp.sqrt(total)), cavity.mean + shift, gain * variance, shift)
