"""Constraints as boxes 0 <= c <= width, one for each bounded quantity, and the exact terms of data and boxes."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.stats import norm

from lfm_ppl.constrained.constraints import Constraints
from lfm_ppl.constrained.truncated import truncated_moments
from lfm_ppl.filtering.ep.quadrature import MeanVariance, TiltedMoments


class Boxes(eqx.Module):
    """The constraints with both bounds of a quantity as one box 0 <= c(x, u, t) <= width.

    Expectation propagation with two half lines as two factors has an error of 0.2 in the log evidence, because the
    factors are correlated. A box is one factor, whose truncated normal moments have a closed form.

    Attributes:
        constraints: the constraints c >= 0.
        widths: (B,), upper minus lower bound; infinity for a quantity with one bound.
        indices: B indices of constraints, the first bound of each box.
    """

    constraints: Constraints
    widths: jax.Array
    indices: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
        """Return the distance (B,) of each quantity from its lower bound, or from its upper bound if it is the only."""
        values = self.constraints(x, u, t)
        return jnp.stack([values[index] for index in self.indices]) if self.indices else values[:0]

    @property
    def count(self) -> int:
        """Number of boxes B at a time."""
        return len(self.indices)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the boxes, each the label of its first bound."""
        return tuple(self.constraints.labels[index] for index in self.indices)

    def slacks(self, values: jax.Array) -> jax.Array:
        """Return the slacks (..., C) of all constraints from the values (..., B) of the boxes."""
        constraints, lower_count = self.constraints, len(self.constraints.lower_indices)
        slack = jnp.zeros((*values.shape[:-1], constraints.count))
        slack = slack.at[..., list(self.indices)].set(values)
        for i, index in enumerate(constraints.upper_indices):
            if index in constraints.lower_indices:
                box = self.indices.index(constraints.lower_indices.index(index))
                slack = slack.at[..., lower_count + i].set(self.widths[box] - values[..., box])
        return slack

    def box_of(self, index: int) -> tuple[int, float, jax.Array] | None:
        """Return the box of an entry of (x, u, y), its direction (1 or -1) and its first bound; None without a box."""
        constraints, lower_count = self.constraints, len(self.constraints.lower_indices)
        if index in constraints.lower_indices:
            i = constraints.lower_indices.index(index)
            return self.indices.index(i), 1.0, constraints.lower[i]
        if index in constraints.upper_indices:
            i = constraints.upper_indices.index(index)
            return self.indices.index(lower_count + i), -1.0, constraints.upper[i]
        return None


def build_boxes(constraints: Constraints) -> Boxes:
    """Combine both bounds of a quantity into one box."""
    lower, upper = constraints.lower_indices, constraints.upper_indices
    indices = [*range(len(lower)), *(len(lower) + i for i, index in enumerate(upper) if index not in lower),
               *range(len(lower) + len(upper), constraints.count)]
    widths = jnp.full(constraints.count, jnp.inf)
    for i, index in enumerate(upper):
        if index in lower:
            j = lower.index(index)
            widths = widths.at[j].set(constraints.upper[i] - constraints.lower[j])
    return Boxes(constraints, widths[jnp.asarray(indices, int)], tuple(indices))


class BoundedTerms(eqx.Module):
    """Exact terms N(y; f, R) of the data, and 1(0 <= f <= width) of the constraints.

    Attributes:
        y: (K, D), NaN where missing.
        variance: (K, D), noise variances R.
        is_constrained: (K, B), whether the constraint holds at the row.
        widths: (B,), widths of the boxes.
    """

    y: jax.Array
    variance: jax.Array
    is_constrained: jax.Array
    widths: jax.Array

    @property
    def present(self) -> jax.Array:
        """Whether an entry has a term, (K, D + B)."""
        return jnp.concatenate([jnp.isfinite(self.y), self.is_constrained], axis=1)

    def tilted(self, cavity: MeanVariance, _quadrature_point: MeanVariance, power: float) -> TiltedMoments:
        """Return the tilted moments in closed form.

        Any power of an indicator is the indicator itself; ``power`` must be 1 for the data. ``_quadrature_point``
        is for other families.
        """
        outputs = self.y.shape[1]
        gaussian = _gaussian_tilted(MeanVariance(*(a[:, :outputs] for a in cavity)), self.y, self.variance)
        truncated = truncated_moments(MeanVariance(*(a[:, outputs:] for a in cavity)), self.widths)
        return TiltedMoments(*(jnp.concatenate(pair, axis=1) for pair in zip(gaussian, truncated, strict=True)))


def _gaussian_tilted(cavity: MeanVariance, y: jax.Array, variance: jax.Array) -> TiltedMoments:
    """Return the tilted moments for terms N(y; f, variance)."""
    y = jnp.where(jnp.isfinite(y), y, 0.0)
    total = cavity.variance + variance
    gain = cavity.variance / total
    shift = gain * (y - cavity.mean)
    return TiltedMoments(norm.logpdf(y, cavity.mean, jnp.sqrt(total)), cavity.mean + shift, gain * variance, shift)
