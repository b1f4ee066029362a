"""Exact terms that factors approximate: a function of the predictor for each entry of the data or each constraint."""

from __future__ import annotations

from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp

from lfm_ppl.filtering.ep.quadrature import MeanVariance, TiltedMoments, tilted_moments
from lfm_ppl.model.observation_noise import row_log_prob
from lfm_ppl.model.observations.family import ObservationFamily


class EntryTerms(Protocol):
    """Exact terms p_i(f_i) of arrays (T, D). An entry without a term has log Z = 0."""

    def tilted(self, cavity: MeanVariance, centre: MeanVariance, power: float) -> TiltedMoments:
        """Return log int N(f; cavity) p(f)^power df, and mean and variance of the normalised product; (T, D) each.

        Args:
            cavity: mean and variance of each entry given the factors of all others.
            centre: its present marginal, the location and width of the product for a quadrature.
            power: of the term.
        """

    @property
    def present(self) -> jax.Array:
        """Whether an entry has a term, (T, D)."""


class FamilyTerms(eqx.Module):
    """Exact terms of data under an observation family.

    Attributes:
        family: the observation family.
        y: (T, D), NaN where missing.
    """

    family: ObservationFamily
    y: jax.Array

    @property
    def present(self) -> jax.Array:
        """Whether an entry is present, (T, D)."""
        return jnp.isfinite(self.y)

    def log_prob(self, f: jax.Array) -> jax.Array:
        """Return log p(y | f), entry by entry, zero where missing; ``f`` is (..., T, D)."""
        if f.ndim > 2:
            return jax.vmap(self.log_prob)(f)
        return jax.vmap(lambda row, f, y: row_log_prob(self.family, row, f, y))(jnp.arange(len(f)), f, self.y)

    def tilted(self, cavity: MeanVariance, centre: MeanVariance, power: float,
               is_coarse: bool = False) -> TiltedMoments:
        """Return the tilted moments by quadrature, with half of the nodes if ``is_coarse``."""
        # Where the rule is exact the integral does not depend on the location of its nodes. That of few nodes may, far
        # from a Gaussian product, so that no derivative is taken of coarse moments.
        return tilted_moments(lambda f: power * self.log_prob(f), cavity, jax.lax.stop_gradient(centre), is_coarse)
