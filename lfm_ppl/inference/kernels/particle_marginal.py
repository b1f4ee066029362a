"""Particle-marginal robust adaptive Metropolis: an exact chain from an unbiased likelihood estimate.

One step:
1. Propose ``x' = x + S U``, as robust adaptive Metropolis does.
2. With delayed acceptance, in half of the steps, accept x' first with the Gaussian filter's likelihood.
3. Estimate the likelihood at x' with a particle filter, and accept with the ratio of the estimates (and the inverse
   ratio of step 2). The estimate at an accepted point is kept, never drawn again.
4. In the warm-up, adapt S to half of the acceptance probability of an exact likelihood.

Source: Andrieu, Doucet and Holenstein (2010), JRSS B 72(3); Golightly, Henderson and Sherlock (2015), Statistics and
Computing 25.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpy.typing import ArrayLike
from numpyro.infer import init_to_median
from numpyro.infer.util import ParamInfo
from numpyro.util import is_prng_key

from lfm_ppl.inference.bind import bind_arguments
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.kernels.algorithm import SamplingAlgorithm
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.kernels.robust_metropolis import (
    Adaptation,
    RAMState,
    acceptance,
    adapt_proposal,
    choose,
    finite_or_infinity,
    initial_state,
    propose,
    summary,
)
from lfm_ppl.inference.particle_potential import ParticlePotential, Tuned
from lfm_ppl.particles.particle_filter import ParticleSettings
from lfm_ppl.utils import checks
from lfm_ppl.utils.random_keys import split_by_name

_TARGET, _TARGET_ONE = 0.12, 0.21
"""Target acceptance in several dimensions and in one: half of RAM's, since noise of sd one in the log likelihood halves
the acceptance at any scale."""

_DELAYED = 0.5
"""Share of the steps with delayed acceptance, if it is on; the other steps run the particle filter at once."""


class ParticleMarginalState(NamedTuple):
    """State of a chain: that of RAM, whose fields are also attributes of this object, and three fields more.

    Attributes:
        ram: state of RAM; ``potential_energy`` is minus the log of the ESTIMATED density at ``z``, drawn when ``z`` was
            proposed.
        surrogate_energy: minus the log density at ``z`` with the Gaussian filter's likelihood; zero if not used.
        estimated: whether the last proposal reached the particle filter.
        rng_key: random key of the next step; RAM's is not used. ``MCMC`` replaces it after a warm-up.
    """

    ram: RAMState
    surrogate_energy: jax.Array
    estimated: jax.Array
    rng_key: jax.Array

    def __getattr__(self, name: str) -> Any:
        return getattr(self.ram, name)


class ParticleMarginalRAM(RAM):
    r"""Robust adaptive Metropolis on an estimated likelihood, with the exact posterior as its limit.

    The likelihood is estimated, without bias, by a bootstrap particle filter on the model itself. A proposal x' with
    estimate Z' is accepted with probability

        min(1, p(x') Z' / (p(x) Z)),

    where Z is the estimate with which x was accepted. It is kept and never drawn again, so that the posterior of the
    parameters is the invariant distribution of the chain for any number of particles. With ``delayed`` acceptance, in
    half of the steps at random, a proposal must first be accepted with the Gaussian filter's likelihood L. The particle
    filter runs only then, and the second acceptance, with ``min(1, Z' L / (Z L'))``, corrects for the first. This saves
    estimates where the filter is accurate. Where L is far too small in a part of the posterior, such steps hardly ever
    enter or leave it; the other steps, which do not use L, keep the chain moving.

    Args:
        model: a NumPyro model with one likelihood site, ``lfm.MarginalLikelihood`` or ``lfm.panel``.
        particles: N; None: chosen so that the log likelihood has a standard deviation near 1.
        tune_at: unconstrained parameters at which N is chosen; None: the starting point of the first chain.
        delayed: two-stage acceptance in half of the steps. Vectorised chains compute every estimate nevertheless.
        particle_steps: integration steps of the particles between two times; None: the model's ``steps``.
        resampling: resampling scheme, as in `lfm_ppl.particle_filter`.
        threshold: effective sample size below which particles are resampled, as in `lfm_ppl.particle_filter`.
        scheme: integration scheme of the particles, as in `lfm_ppl.particle_filter`.
        target_accept_prob: by default 0.12, and 0.21 in one dimension.
        initial_scale: factor of the first proposal, as in `RAM`.
        initial_covariance: covariance of the first proposal, as in `RAM`.
        adapt: "warmup" or "throughout", as in `RAM`.
        exponent: exponent of the adaptation, as in `RAM`.
        init_strategy: a NumPyro strategy for the first point of each chain.

    Attributes:
        delayed: whether acceptance is delayed.
        particle_steps: integration steps of the particles between two times.
        estimate: after the start, the estimated potential energy.
        tuned: after the start, the number of particles and the standard deviation of the log likelihood estimate
            (NaN where the data were traced).

    Raises:
        ValueError: what `RAM` and `lfm_ppl.particle_filter` raise; no number of particles is enough.

    Example:
        >>> import jax, jax.numpy as jnp, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> from numpyro.infer import MCMC
        >>> def model(times, y=None):
        ...     noise = numpyro.sample("noise", dist.LogNormal(0.0, 0.5))
        ...     system = lfm.LatentForceModel(
        ...         lambda x, u, t: x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=noise * jnp.eye(1))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
        >>> mcmc = MCMC(ParticleMarginalRAM(model, particles=20), num_warmup=20, num_samples=20, progress_bar=False)
        >>> mcmc.run(jax.random.key(0), jnp.arange(3.0), jnp.ones((3, 1)))
        >>> mcmc.get_samples()["noise"].shape
        (20,)

    Source: Andrieu, Doucet and Holenstein (2010), JRSS B 72(3); Vihola (2012), Statistics and Computing 22; Golightly,
    Henderson and Sherlock (2015), Statistics and Computing 25, for delayed acceptance.
    """

    def __init__(
        self,
        model: Callable,
        particles: int | None = None,
        tune_at: ArrayLike | None = None,
        delayed: bool = False,
        particle_steps: int | None = None,
        resampling: str = "systematic",
        threshold: float = 0.5,
        scheme: str = "auto",
        target_accept_prob: float | None = None,
        initial_scale: float | None = None,
        initial_covariance: ArrayLike | None = None,
        adapt: str = "warmup",
        exponent: float = 2 / 3,
        init_strategy: Callable = init_to_median,
    ) -> None:
        super().__init__(model, None, target_accept_prob, initial_scale, initial_covariance, adapt, exponent,
                         init_strategy)
        if particles is not None:
            checks.positive_integer("particles", particles)
        if not isinstance(delayed, bool):
            raise TypeError(f"delayed must be True or False, got {delayed!r}.")
        self._settings = ParticleSettings(particles or 1, resampling, threshold, scheme)
        self.delayed = delayed
        self._tune_at = tune_at
        self.particle_steps = particle_steps
        self._particles = particles
        self.estimate: ParticlePotential | None = None
        self._tuned_observations: bytes | None = None
        self.tuned: Tuned | None = None

    def starting_point(self, key: jax.Array, init_params: Any, args: tuple,
                       kwargs: dict) -> tuple[ParamInfo, jax.Array]:
        """Return the starting point of RAM; choose the number of particles there."""
        point, factor = super().starting_point(key, init_params, args, kwargs)
        first_z = point.z if is_prng_key(key) else jax.tree_util.tree_map(lambda leaf: leaf[0], point.z)
        assert self.model is not None
        with jax.ensure_compile_time_eval():  # parallel chains are initialised within a trace
            bound = bind_arguments(self.model, args, kwargs, "ParticleMarginalRAM")
            self.prepare(bound, ravel_pytree(first_z)[0])
        return point, factor

    def algorithm(self, num_warmup: int = 0) -> SamplingAlgorithm:
        """Return the algorithm; the observations are the last positional argument of the model."""

        def estimate_at(data: tuple[tuple, dict]) -> Callable[[Any, jax.Array], jax.Array]:
            args, _ = data
            return self.estimate_at(args[-1] if args else None)

        return particle_marginal(estimate_at, self._potential_at if self.delayed else None, self.adaptation, num_warmup)

    @property
    def settings(self) -> ParticleSettings:
        """Settings of the particle filter, with the number of particles that was chosen."""
        assert self.estimate is not None and self.tuned is not None, "init must be called first."
        return self.estimate.settings._replace(particles=self.tuned.particles)

    def prepare(self, bound: BoundModel, start: ArrayLike | None, tuned: Tuned | None = None) -> None:
        """Check the filter and choose the number of particles, outside of compiled code, since shapes depend on it.

        Args:
            bound: the model and its data.
            start: (d,), where the number is chosen, unless ``tune_at`` is set.
            tuned: the number of an earlier run; None: choose it.
        """
        self.estimate = ParticlePotential(bound, self._settings, self.particle_steps)
        if tuned is not None:
            self.tuned = tuned
            return
        if checks.traced(bound.y):
            # The data are arguments of a compiled program, so that no estimate can be computed here.
            if self._particles is None:
                raise ValueError("the number of particles is chosen by the data, which are not known here; give "
                                 "particles, or run with numbers (jit_model_args=False).")
            self.tuned = Tuned(self._particles, float("nan"))
            return
        observations = np.asarray(bound.y).tobytes()
        if self.tuned is not None and observations == self._tuned_observations:
            return
        self._tuned_observations = observations
        keys = split_by_name(jax.random.key(0), ("start", "estimates"))
        z = start if self._tune_at is None else ravel_pytree(self._tune_at)[0]
        if checks.traced(z):
            z = bound.draw(keys["start"], self._init_strategy)
        if self._particles is None:
            self.tuned = self.estimate.tune(z, keys["estimates"])
        else:
            self.tuned = Tuned(self._particles, self.estimate.sd_of_estimates(z, keys["estimates"], self._particles))

    def estimate_at(self, y: Any) -> Callable[[Any, jax.Array], jax.Array]:
        """Return the function from a position and a key to the estimated potential energy, given observations."""
        assert self.estimate is not None and self.tuned is not None, "init must be called before sample."
        potential, particles = self.estimate, self.tuned.particles

        def estimate(z: Any, key: jax.Array) -> jax.Array:
            return potential(ravel_pytree(z)[0], key, particles, y)

        return estimate


def particle_marginal(estimate_at: Callable[[Any], Callable[[Any, jax.Array], jax.Array]],
                      surrogate_at: Callable[[Any], Callable[[Any], jax.Array]] | None, adaptation: Adaptation,
                      num_warmup: int) -> SamplingAlgorithm:
    """Return particle-marginal RAM; its tuning is the first proposal factor (d, d).

    Args:
        estimate_at: from the data to minus the log of an unbiased estimate of the density, a function of position and
            key. NaN or an infinity rejects.
        surrogate_at: from the data to minus the log of a cheap density that accepts first; None: there is none.
        adaptation: of the proposal; its target is 0.21 in one dimension and 0.12 otherwise where it is None.
        num_warmup: number of steps that adapt the proposal.
    """

    def init(key: jax.Array, point: ParamInfo, data: Any, factor: jax.Array) -> ParticleMarginalState:
        key, estimate_key = jax.random.split(key)
        energy = finite_or_infinity(jax.jit(estimate_at(data))(point.z, estimate_key))
        surrogate_energy = jnp.zeros_like(energy) if surrogate_at is None else point.potential_energy
        ram = initial_state(point.z, energy, key, factor, num_warmup)
        return ParticleMarginalState(ram, surrogate_energy, jnp.array(False), key)

    def step(state: ParticleMarginalState, data: Any) -> ParticleMarginalState:
        estimate = estimate_at(data)
        rng_key, key_noise, key_accept, key_particles, key_first = jax.random.split(state.rng_key, 5)
        proposal, noise = propose(state.ram, key_noise)
        surrogate_energy = log_ratio = jnp.zeros_like(state.surrogate_energy)
        is_estimated = jnp.array(True)
        if surrogate_at is not None:
            surrogate_energy = finite_or_infinity(surrogate_at(data)(proposal))
            branch_uniform, uniform = jax.random.uniform(key_first, (2,))
            log_ratio = jnp.where(branch_uniform < _DELAYED, state.surrogate_energy - surrogate_energy, 0.0)
            is_estimated = uniform < acceptance(log_ratio)
        energy = jax.lax.cond(is_estimated, lambda: finite_or_infinity(estimate(proposal, key_particles)),
                              lambda: jnp.full_like(state.potential_energy, jnp.inf))
        accept_prob = is_estimated * acceptance(state.potential_energy - energy - log_ratio)
        accepted = jax.random.uniform(key_accept) < accept_prob
        ram = state.ram._replace(z=choose(accepted, proposal, state.z), accepted=accepted,
                                 potential_energy=jnp.where(accepted, energy, state.potential_energy))
        target = adaptation.target_accept_prob or (_TARGET_ONE if noise.size == 1 else _TARGET)
        ram = adapt_proposal(ram, noise, accept_prob, adaptation._replace(target_accept_prob=target))
        surrogate_energy = jnp.where(accepted, surrogate_energy, state.surrogate_energy)
        return ParticleMarginalState(ram, surrogate_energy, is_estimated, rng_key)

    def summary_with_estimates(state: ParticleMarginalState) -> dict[str, jax.Array]:
        return {**summary(state), "estimated": state.estimated}

    return SamplingAlgorithm(init, step, summary_with_estimates)
