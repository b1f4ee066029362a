"""The likelihood of a NumPyro model, estimated by a particle filter in place of the Gaussian one.

1. `with_particles` replaces the likelihood site of a model by a `ParticleLikelihood` with a random key.
2. Its log density is the logarithm of an unbiased estimate of the likelihood.
3. `ParticlePotential` chooses the number of particles from the standard deviation of the estimate at one point.

Source: Andrieu, Doucet and Holenstein (2010), Journal of the Royal Statistical Society B 72.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import constraints

from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.handlers.likelihood_handler import LikelihoodHandler
from lfm_ppl.inference.likelihood import Likelihood
from lfm_ppl.inference.series_likelihood import SeriesLikelihood
from lfm_ppl.model.observation_noise import check_noise
from lfm_ppl.particles.particle_filter import ParticleSettings, check_settings, log_likelihood
from lfm_ppl.utils import checks
from lfm_ppl.utils.programs import Program

_REPLICATES = 64
"""Filters whose log likelihoods give the standard deviation of one; that is known to a tenth of itself then."""

_FEWEST, _MOST = 50, 200_000
"""Least and largest number of particles that is chosen automatically."""


class ParticleLikelihood(dist.Distribution):
    """A likelihood whose log density is the log of an unbiased estimate, from one run of a particle filter.

    Args:
        base: the likelihood of the model; its times are used, its rule is not.
        key: a JAX random key. The log density is a deterministic function of it.
        settings: checked settings of the filter.
        steps: integration steps between two times; None: as in ``base``.
    """

    support = constraints.real_matrix
    pytree_data_fields = ("base", "key")
    pytree_aux_fields = ("settings", "steps")

    def __init__(self, base: Likelihood, key: jax.Array, settings: ParticleSettings,
                 steps: int | None = None) -> None:
        self.base, self.key, self.settings, self.steps = base, key, settings, steps
        super().__init__(base.batch_shape, base.event_shape, validate_args=False)

    def log_prob(self, value: Any) -> jax.Array:
        """Return the log of the estimate; for a panel one for each series."""
        value = jnp.asarray(checks.unmask(value), float)
        return self.base.mapped(self._series_log_prob, value, self.base.split_key(self.key))

    def _series_log_prob(self, base: SeriesLikelihood, y: jax.Array, key: jax.Array) -> jax.Array:
        grid = build_time_grid(base.ssm, base.times, self.steps or base.steps, base.max_step)
        return log_likelihood(base.ssm, grid, y, key, self.settings)

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Simulate the model, as ``base`` does."""
        return self.base.sample(key, sample_shape)


class with_particles(LikelihoodHandler):  # noqa: N801 (an effect handler, named as NumPyro names its handlers)
    """Effect handler that replaces the likelihood of a model by a particle filter's estimate of it.

    Args:
        fn: a NumPyro model with a site ``MarginalLikelihood`` or ``panel``.
        key: a JAX random key; another one gives another estimate.
        settings: checked settings of the filter.
        steps: integration steps between two times; None: as in the model.

    Example:
        >>> import jax, jax.numpy as jnp, numpyro, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     system = lfm.LatentForceModel(
        ...         lambda x, u, t: x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
        >>> estimated = with_particles(model, jax.random.key(0), ParticleSettings(100, scheme="srk"))
        >>> trace = numpyro.handlers.trace(estimated).get_trace(jnp.arange(3.0), jnp.ones((3, 1)))
        >>> type(trace["y"]["fn"]).__name__
        'ParticleLikelihood'
    """

    supports_all_likelihoods = False

    def __init__(self, fn: Callable[..., Any] | None, key: jax.Array, settings: ParticleSettings,
                 steps: int | None = None) -> None:
        self.key, self.settings, self.steps = key, settings, steps
        super().__init__(fn)

    def missing(self) -> str:
        """Return the error of a model without a likelihood that could be replaced."""
        return ("the particle filter cannot replace the likelihood of this model: it needs a site "
                "numpyro.sample(name, lfm.MarginalLikelihood(...), obs=y) without constraints, mask, expand or plate "
                "(or an lfm.panel in its plate).")

    def replacement(self, likelihood: Likelihood, site: dict[str, Any]) -> Any:
        """Return the estimate."""
        return ParticleLikelihood(likelihood, self.key, self.settings, self.steps)


@dataclass(frozen=True)
class Tuned:
    """A number of particles, and the standard deviation of the log likelihood estimate that it gives."""

    particles: int
    sd: float


class ParticlePotential:
    """Potential energy of a model's unconstrained parameters, with the likelihood estimated by particles.

    Args:
        bound: the model and its data.
        settings: of the filter; the scheme is chosen, and everything checked, here.
        steps: integration steps between two times; None: as in the model.

    Raises:
        ValueError: there is no likelihood site, or several; what the particle filter raises.
    """

    def __init__(self, bound: BoundModel, settings: ParticleSettings, steps: int | None = None) -> None:
        if steps is not None:
            checks.positive_integer("particle_steps", steps)
        example = bound.site.example
        check_noise(example.ssm, example.time_grid.initial_time)
        self.settings = check_settings(example.ssm, settings)
        self._bound, self._steps = bound, steps

    def __call__(self, z: Any, key: jax.Array, particles: int | None = None, y: Any = None) -> jax.Array:
        """Return minus the log density at ``z``.

        Args:
            z: (d,) unconstrained parameters.
            key: of the particle filter.
            particles: their number; None: that of the settings.
            y: data in place of those that were bound, of the same shape.
        """
        settings = self.settings if particles is None else self.settings._replace(particles=particles)
        return -self._bound.log_density_with(lambda model: with_particles(model, key, settings, self._steps), z, y)

    def tune(self, z: Any, key: jax.Array) -> Tuned:
        """Choose the number of particles for which the log likelihood at ``z`` has a standard deviation near 1.

        The variance is inversely proportional to the number. Fewer particles make the chain stick to lucky
        estimates, more cost more than they gain.

        Args:
            z: (d,) unconstrained parameters, as central in the posterior as they are known to be.
            key: a JAX random key.

        Raises:
            ValueError: at ``z`` the estimates are not finite, or no number up to 200,000 is enough.

        Source: Doucet, Pitt, Deligiannidis and Kohn (2015), Biometrika 102(2).
        """
        particles = 200
        for attempt_key in jax.random.split(key, 8):
            sd = self.sd_of_estimates(z, attempt_key, particles)
            needed_particles = int(np.ceil(particles * np.clip(sd**2, 1 / 64, 8.0)))
            is_close = particles / 1.4 < needed_particles < particles * 1.4
            if is_close or (particles == _FEWEST and needed_particles <= _FEWEST):
                return Tuned(particles, sd)
            if particles == _MOST and needed_particles > _MOST:
                break
            particles = int(np.clip(needed_particles, _FEWEST, _MOST))
        if np.isfinite(sd) and particles < _MOST:
            return Tuned(particles, sd)
        raise ValueError(f"the log likelihood estimate has a standard deviation of {sd:.3g} with {_MOST} particles; "
                         "1 is out of reach. The observations may be too precise, or too many, for a "
                         "bootstrap filter, or the starting point is far from the posterior; give particles yourself.")

    def sd_of_estimates(self, z: Any, key: jax.Array, particles: int) -> float:
        """Return the standard deviation of the log likelihood estimate at ``z``, from 64 of them.

        Estimates of zero count as the worst of the others; infinite where they are the majority.
        """
        name = ("spread of estimates", self.settings._replace(particles=particles), self._steps)
        run = self._bound.program(name, lambda: Program(
            lambda z, keys, y: jax.lax.map(lambda k: self(z, k, particles, y), keys)), self._bound.constants)
        energies = np.asarray(run(z, jax.random.split(key, _REPLICATES), self._bound.constants))
        finite = np.isfinite(energies)
        if finite.mean() < 0.5:
            return float("inf")
        return float(np.where(finite, energies, energies[finite].max()).std(ddof=1))
