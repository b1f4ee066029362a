"""The log density of a bound model with a likelihood that is estimated by particles, and the choice of their number.

`ParticlePotential` chooses the number of particles from the standard deviation of the estimate at one point.

Source: Doucet, Pitt, Deligiannidis and Kohn (2015), Biometrika 102(2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.likelihoods.particle_likelihood import with_particles
from lfm_ppl.model.observation_noise import check_noise
from lfm_ppl.particles.particle_filter import ParticleSettings, check_settings
from lfm_ppl.utils import checks
from lfm_ppl.utils.programs import Program

_REPLICATES = 64
"""Filters whose log likelihoods give the standard deviation of one; that is known to a tenth of itself then."""

_FEWEST, _MOST = 50, 200_000
"""Least and largest number of particles that is chosen automatically."""


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
