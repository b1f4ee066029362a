"""The posterior of positive parameters in their logarithms, compiled once for all data sets of one shape."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lfm_ppl as lfm
from lfm_ppl.inference.optimise import Objective, value_and_gradient
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood
from lfm_ppl.utils.programs import Program


class LogPosterior:
    """The posterior of a bound model in the logarithms z of its parameters, in the order of ``names``.

    The unconstrained value of a positive parameter is its logarithm, so that z is the bound model's vector, permuted.

    Args:
        bound: the model; its data are an example of their shape.
        names: its parameters, all of them positive numbers, in the order of z.
        forward_mode: how gradients are taken; None: the faster way.

    Attributes:
        central: z (P,) in the middle of the prior, the median of a few draws, where a search may start; whether the
            density is finite there is not known.

    Raises:
        ValueError: other names than the model's; a parameter that is not positive.
    """

    def __init__(self, bound: lfm.BoundModel, names: Sequence[str], forward_mode: bool | None = None) -> None:
        self.bound, self.names = bound, tuple(names)
        if sorted(names) != sorted(bound.names):
            raise ValueError(f"names must be the model's parameters, in any order: {', '.join(bound.names)}; got "
                             f"{', '.join(names)}.")
        start = bound.draw(jax.random.key(0))
        positive = {site: jnp.exp(value) for site, value in bound.unravel(start).items()}
        if np.any(wrong := ~np.isclose(bound.unconstrain(positive), start, rtol=1e-9, atol=1e-9)):
            raise ValueError(f"the logarithm of {bound.names[int(np.argmax(wrong))]} is not its unconstrained value; "
                             "expected a prior of positive numbers without an upper end.")
        about = dict(zip(bound.names, start, strict=True))
        self.central = np.array([about[name] for name in names])
        self._order = np.array([self.names.index(name) for name in bound.names])
        self._forward_mode = bound.forward_mode if forward_mode is None else forward_mode

    def values(self, z: Any) -> dict[str, jax.Array]:
        """Return every parameter by name; z (P,) may be traced."""
        return dict(zip(self.names, jnp.exp(jnp.asarray(z)), strict=True))

    def likelihood(self, z: Any, y: Any = None) -> SeriesLikelihood:
        """Return the likelihood with parameters exp(z), which may be traced."""
        likelihood = self.bound.likelihood(self.values(z), y)
        assert isinstance(likelihood, SeriesLikelihood)
        return likelihood

    def log_densities(self, z: Any, y: Any) -> tuple[jax.Array, jax.Array]:
        """Return the log likelihood log p(y | z) and the log prior density of z (P,).

        Where parameters are fixed the second has their prior densities, too. Both arguments may be traced.
        """
        position = jnp.asarray(z, float)[self._order]
        return self.bound.log_likelihood(position, y), self.bound.log_prior(position, y)

    def log_densities_of(self, draws: np.ndarray, y: Any, batch: int = 10) -> tuple[np.ndarray, np.ndarray]:
        """Return the same of several z (K, P), each (K,).

        Args:
            draws: (K, P).
            y: the data.
            batch: how many are computed at a time; a thousand no longer fit the CPU's cache, and take seven times as
                long each.
        """
        run = self.bound.program(("log densities of draws", self.names, batch), lambda: Program(
            lambda all_, y: jax.lax.map(lambda z: self.log_densities(z, y), all_, batch_size=batch)))
        log_likelihood, log_prior = run(jnp.asarray(draws), self.bound.problem_of(y))
        return np.asarray(log_likelihood), np.asarray(log_prior)

    def objective(self, y: Any, prior: float = 1.0) -> Objective:
        """Return minus the log posterior density of z as the objective of a search, from one program for all data.

        Args:
            y: the data.
            prior: weight of the log prior density; 0 leaves minus the log likelihood.
        """
        def energy(z: jax.Array, y: Any, prior: jax.Array) -> jax.Array:
            log_likelihood, log_prior = self.log_densities(z, y)
            return -log_likelihood - prior * log_prior

        run = self.bound.program(("energy", self.names, self._forward_mode),
                                 lambda: Program(value_and_gradient(energy, self._forward_mode)))
        problem = self.bound.problem_of(y)
        return Objective(lambda z: run(z, problem, prior))
