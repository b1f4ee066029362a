"""Particle-marginal robust adaptive Metropolis: an exact chain from an unbiased likelihood estimate."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro.infer import init_to_median
from numpyro.util import is_prng_key

from lfm_ppl import checks
from lfm_ppl.inference.bound_model import BoundModel, bind_arguments
from lfm_ppl.inference.kernels.kernel import of_chains
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.kernels.robust_metropolis import (
    RAMState,
    acceptance,
    adapted,
    choose,
    finite_or_infinity,
    propose,
)
from lfm_ppl.inference.particle_likelihood import ParticlePotential, Tuned
from lfm_ppl.particles.particle_filter import ParticleSettings

_TARGET, _TARGET_ONE = 0.12, 0.21
"""Half of what RAM aims at: noise of sd one in the log likelihood halves the acceptance at any scale."""

_DELAYED = 0.5
"""Share of the steps with delayed acceptance, where it is asked for; the others ask the particle filter at once."""


class ParticleMarginalState(NamedTuple):
    """What the chain carries: the state of RAM, whose fields can be read as its own, and more.

    Attributes:
        ram: its ``potential_energy`` is minus the log of the ESTIMATED density at ``z``, from when ``z`` was proposed.
        surrogate_energy: minus the log density at ``z`` with the Gaussian filter's likelihood; zero if not used.
        estimated: whether the last proposal reached the particle filter.
        rng_key: random key of the next step, in the place of RAM's; ``MCMC`` replaces it after a warm-up.
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

    where Z is the estimate with which x was accepted: it is carried along and never drawn again, which makes the
    posterior of the parameters the chain's invariant distribution whatever the number of particles. With ``delayed``
    acceptance, in every other step at random, a proposal first has to pass the test with the Gaussian filter's
    likelihood L; the particle filter runs only then, and the second test, with ``min(1, Z' L / (Z L'))``, makes up for
    the first. It saves estimates where the filter is nearly right. Where L is far too small in a part of the posterior,
    such steps hardly ever reach it or leave it again; the steps between, which do without L, keep the chain moving.

    Args:
        model: a NumPyro model with one likelihood site, ``lfm.MarginalLikelihood`` or ``lfm.panel``.
        particles: N; None: chosen so that the log likelihood has a standard deviation near 1.
        tune_at: unconstrained parameters at which N is chosen; None: where the first chain starts.
        delayed: two-stage acceptance in half of the steps. Vectorised chains compute every estimate all the same.
        particle_steps: integration steps of the particles between two times; None: the model's ``steps``.
        resampling: as in `lfm_ppl.particle_filter`, and so are the next two.
        threshold: of the effective sample size.
        scheme: of the steps.
        target_accept_prob: by default 0.12, and 0.21 in one dimension.
        initial_scale: as in `RAM`, and so are all that follow.
        initial_covariance: of the proposal.
        adapt: "warmup" or "throughout".
        exponent: of the adaptation.
        init_strategy: a NumPyro strategy for the first point of each chain.

    Attributes:
        delayed: whether acceptance is delayed.
        particle_steps: as given.
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
        ...         lambda x, u, t: x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
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
        tune_at: Any = None,
        delayed: bool = False,
        particle_steps: int | None = None,
        resampling: str = "systematic",
        threshold: float = 0.5,
        scheme: str = "auto",
        target_accept_prob: float | None = None,
        initial_scale: float | None = None,
        initial_covariance: Any = None,
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
        self._tuned_for: Any = None
        self.tuned: Tuned | None = None

    def init(
        self,
        rng_key: jax.Array,
        num_warmup: int,
        init_params: Any = None,
        model_args: tuple = (),
        model_kwargs: dict | None = None,
    ) -> ParticleMarginalState:
        """Return the state before the first step; arguments as in `RAM`."""
        start: RAMState = super().init(rng_key, num_warmup, init_params, model_args, model_kwargs)
        single = is_prng_key(rng_key)
        first_key = rng_key if single else rng_key[0]
        first = start.z if single else jax.tree_util.tree_map(lambda leaf: leaf[0], start.z)
        self._prepare(first, model_args, model_kwargs or {})
        estimate_key = jax.random.fold_in(first_key, 1)
        y = model_args[-1] if model_args else None
        estimate = jax.jit(partial(self._energy, y))
        if single:
            energy = estimate(start.z, estimate_key)
        else:
            energy = jax.lax.map(lambda pair: estimate(*pair), (start.z, jax.random.split(estimate_key, len(rng_key))))
        energy = finite_or_infinity(energy)
        surrogate = start.potential_energy if self.delayed else jnp.zeros_like(energy)
        return ParticleMarginalState(start._replace(potential_energy=energy), surrogate,
                                     jnp.zeros(np.shape(energy), bool), start.rng_key)

    @property
    def settings(self) -> ParticleSettings:
        """Settings of the particle filter, with the number of particles that was chosen."""
        assert self.estimate is not None and self.tuned is not None, "init must be called first."
        return self.estimate.settings._replace(particles=self.tuned.particles)

    def prepare(self, bound: BoundModel, start: Any, tuned: Tuned | None = None) -> None:
        """Check the filter and choose the number of particles: with numbers, since it decides what is compiled.

        Args:
            bound: the model and its data.
            start: (d,), where the number is chosen unless ``tune_at`` says otherwise.
            tuned: what was chosen before; None: choose.
        """
        self.estimate = ParticlePotential(bound, self._settings, self.particle_steps)
        if tuned is not None:
            self.tuned = tuned
            return
        if checks.traced(bound.y):
            # Data that are arguments of a compiled program: there is nothing to choose the number by.
            if self._particles is None:
                raise ValueError("the number of particles is chosen by the data, which are not known here; give "
                                 "particles, or run with numbers (jit_model_args=False).")
            self.tuned = Tuned(self._particles, float("nan"))
            return
        data = np.asarray(bound.y).tobytes()
        if self.tuned is not None and data == self._tuned_for:
            return
        self._tuned_for = data
        key = jax.random.key(0)
        z = start if self._tune_at is None else ravel_pytree(self._tune_at)[0]
        if checks.traced(z):
            z = bound.draw(key, self._init_strategy)
        if self._particles is None:
            self.tuned = self.estimate.tune(z, key)
        else:
            self.tuned = Tuned(self._particles, self.estimate.sd_of_estimates(z, key, self._particles))

    def _prepare(self, start: Any, args: tuple, kwargs: dict) -> None:
        assert self.model is not None
        with jax.ensure_compile_time_eval():  # chains that run in parallel are initialised within a trace
            self.prepare(bind_arguments(self.model, args, kwargs, "ParticleMarginalRAM"), ravel_pytree(start)[0])

    def sample(self, state: ParticleMarginalState, model_args: tuple,  # type: ignore[override]
               model_kwargs: dict | None) -> ParticleMarginalState:
        """Return the state after one step of every chain in ``state``."""
        surrogate = self._potential(model_args, model_kwargs or {}) if self.delayed else None
        one_chain = self.step(partial(self._energy, model_args[-1] if model_args else None), surrogate)
        return of_chains(one_chain, state.rng_key)(state)

    def step(self, estimate: Callable, surrogate: Callable | None) -> Callable:
        """Return the step of one chain; arguments as in `particle_marginal_step`."""
        return partial(particle_marginal_step, estimate, surrogate, *self.adaptation)

    def _energy(self, y: Any, z: Any, key: jax.Array) -> jax.Array:
        assert self.estimate is not None and self.tuned is not None, "init must be called before sample."
        return self.estimate(ravel_pytree(z)[0], key, self.tuned.particles, y)


def particle_marginal_step(
    estimate: Callable[[Any, jax.Array], jax.Array],
    surrogate: Callable[[Any], jax.Array] | None,
    target_accept_prob: float | None,
    exponent: float,
    throughout: bool,
    state: ParticleMarginalState,
) -> ParticleMarginalState:
    """Propose, estimate, accept or reject, and adapt.

    Args:
        estimate: ``(z, key)`` -> minus the log of an unbiased estimate of the density. NaN or an infinity rejects.
        surrogate: minus the log of a cheap density that has to accept first; None: there is none.
        target_accept_prob: of the RAM adaptation; None for the default.
        exponent: of the adaptation steps.
        throughout: adapt after the warm-up as well.
        state: the state ``n - 1``.

    Returns:
        The state ``n``.
    """
    rng_key, key_noise, key_accept, key_particles, key_first = jax.random.split(state.rng_key, 5)
    proposal, noise = propose(state.ram, key_noise)
    first = gain = jnp.zeros_like(state.surrogate_energy)
    passed = jnp.array(True)
    if surrogate is not None:
        first = finite_or_infinity(surrogate(proposal))
        mixed, uniform = jax.random.uniform(key_first, (2,))
        gain = jnp.where(mixed < _DELAYED, state.surrogate_energy - first, 0.0)
        passed = uniform < acceptance(gain)
    energy = jax.lax.cond(passed, lambda: finite_or_infinity(estimate(proposal, key_particles)),
                          lambda: jnp.full_like(state.potential_energy, jnp.inf))
    accept_prob = passed * acceptance(state.potential_energy - energy - gain)
    accepted = jax.random.uniform(key_accept) < accept_prob
    moved = state.ram._replace(
        z=choose(accepted, proposal, state.z),
        potential_energy=jnp.where(accepted, energy, state.potential_energy),
        accepted=accepted,
    )
    target = target_accept_prob or (_TARGET_ONE if noise.size == 1 else _TARGET)
    moved = adapted(moved, noise, accept_prob, target, exponent, throughout)
    return ParticleMarginalState(moved, jnp.where(accepted, first, state.surrogate_energy), passed, rng_key)
