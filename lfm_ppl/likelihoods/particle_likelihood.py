"""The likelihood of a NumPyro model, estimated by a particle filter in place of the Gaussian one.

1. `with_particles` replaces the likelihood site of a model by a `ParticleLikelihood` with a random key.
2. Its log density is the logarithm of an unbiased estimate of the likelihood.

Source: Andrieu, Doucet and Holenstein (2010), Journal of the Royal Statistical Society B 72.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from numpyro.distributions import constraints

from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.likelihoods.handlers.likelihood_handler import LikelihoodHandler
from lfm_ppl.likelihoods.likelihood import Likelihood
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood
from lfm_ppl.particles.particle_filter import ParticleSettings, log_likelihood
from lfm_ppl.utils import checks


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
        grid = build_time_grid(base.ssm, base.times, self.steps or base.settings.steps, base.settings.max_step)
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
        ...         lambda x, u, t: x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
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
