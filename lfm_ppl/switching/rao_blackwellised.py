"""Rao-Blackwellised particles: a linear model with a discrete input that follows a known rule.

Given the path of the discrete input and what its rule has read, a model that is linear in state and forces is Gaussian,
and one step of the Gaussian filter gives its moments exactly. So a particle carries the input and these moments. At a
decision it draws the reading r_k from its Gaussian, is conditioned on that draw, and gets the input that the rule
makes of it:

    r_k ~ N(G m + g, G P G' + V),    (m, P) <- (m, P) given r_k,    d_k = decide(d_k-1, r_k, t_k).

That is a factorisation of the joint distribution itself: the pairs (r_1:k, d_1:k) are draws from their distribution,
each with the exact distribution of the state given them. Averages over the particles are therefore unbiased, whatever
the number of particles, and vary no more than those of particles that draw the whole state. Observations weight the
particles by their exact density, as in any Rao-Blackwellised particle filter.

Where the input only adds to the dynamics, all particles share one covariance and differ in their means alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.filtering.filter import FilterState, check_observations, warn_single_precision
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.time_grid import Intervals, TimeGrid, with_observations
from lfm_ppl.filtering.update import Linearised, Update, update
from lfm_ppl.linalg import congruence, matmul, semidefinite_root, solve_semidefinite
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.particles.normals import normals
from lfm_ppl.particles.resampling import RESAMPLING, effective_sample_size, resample, reweighted
from lfm_ppl.switching.mixture import Mixture
from lfm_ppl.switching.rule import SwitchingRule
from lfm_ppl.switching.switched_model import (
    Build,
    SwitchedMap,
    check_initial,
    check_linear,
    decision_grid,
    first_moments,
    interval_maps,
    only_adds,
    switched,
)


class RaoBlackwellisedResult(eqx.Module):
    """The outcome of `rao_blackwellised`.

    Attributes:
        times: (T,).
        log_likelihood: (T,), logarithms of the estimates of p(y_k | y_1:k-1); zero where nothing is observed.
        mean, covariance: (T, n), (T, n, n), moments of the joint state given the observations so far.
        outputs: the outputs without noise, at each time a mixture of one Gaussian a particle.
        observed: the outputs with their observation noise.
        inputs: (T, N), values of the discrete input after each time.
        ess: (T,), effective sample size of the weights.
    """

    times: jax.Array
    log_likelihood: jax.Array
    mean: jax.Array
    covariance: jax.Array
    outputs: Mixture
    observed: Mixture
    inputs: jax.Array
    ess: jax.Array

    @property
    def input_mean(self) -> jax.Array:
        """(T,), the mean of the discrete input; for a heater, the probability that it is on."""
        return (jnp.exp(self.outputs.log_weights) * self.inputs).sum(1)


class _Particles(NamedTuple):
    """Means (N, n), covariances (N, n, n), or (n, n) where shared, indices of the input (N,), log weights (N,)."""

    mean: jax.Array
    covariance: jax.Array
    choice: jax.Array
    log_weights: jax.Array


class _Settings(NamedTuple):
    particles: int
    resampling: str
    threshold: float
    shared: bool


def rao_blackwellised(key: jax.Array, build: Build, rule: SwitchingRule, times: Any, *, y: Any = None,
                      start: FilterState | None = None, initial: Any = 0, decisions: Any = None,
                      particles: int = 1000, steps: int = 10, max_step: float | None = None,
                      resampling: str = "systematic", threshold: float = 0.5) -> RaoBlackwellisedResult:
    """Predict, or filter, a linear latent force model with a discrete input that follows a known rule.

    What a particle draws is what the rule reads, and nothing else; see the module. Within ``jax.jit`` the times must be
    known, and one compilation serves all values of everything else. Outside of it each call compiles anew, since
    ``build`` makes new functions: compile what is called repeatedly.

    Args:
        key: a JAX random key.
        build: from a value of the input to the `LatentForceModel` that holds while it has that value.
        rule: of the input, such as `lfm.Thermostat`.
        times: (T,), non-decreasing, at which the state is wanted or observed.
        y: (T, D), NaN where missing; None: nothing is observed, a prediction.
        start: the ``state`` of a filter's result, to go on from there; None: the model's initial state.
        initial: index in ``rule.values`` of the input at the start, or (N,), one for each particle.
        decisions: times at which the rule is applied, after an observation at the same time; None: ``times``.
        particles: N.
        steps: integration steps between two consecutive times; a time-invariant model is exact with any number.
        max_step: longest step; longer intervals get more.
        resampling: "systematic", "stratified" or "multinomial".
        threshold: resample where the effective sample size is below this share of N.

    Returns:
        Moments, mixtures of the outputs, and the input of every particle, at ``times``.

    Raises:
        ValueError: a model or a reading that is not linear, an ``initial`` that is no index, and as `lfm_ppl.filter`.
        TypeError: ``rule`` or ``key`` is something else.

    Example:
        >>> import jax, jax.numpy as jnp, lfm_ppl as lfm
        >>> def house(heater):
        ...     return lfm.LatentForceModel(
        ...         lambda x, u, t: 0.1 * (5.0 - x) + 2.0 * heater + u, {"rest": lfm.Matern(0.3, 2.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])),
        ...         lfm.Gaussian(jnp.array([18.0]), jnp.eye(1)))
        >>> found = rao_blackwellised(jax.random.key(0), house, lfm.Thermostat(20.0), jnp.arange(0.0, 24.0))
        >>> mean, sd = found.outputs.moments()
        >>> mean.shape, bool(abs(mean[-1, 0] - 20.0) < 2.0)
        ((24, 1), True)

    Source: Doucet, de Freitas, Murphy and Russell (2000), Rao-Blackwellised particle filtering for dynamic Bayesian
    networks; Reece et al. (2014), Efficient state-space inference of periodic latent force models, section 9.
    """
    checks.random_key(key)
    checks.positive_integer("particles", particles)
    checks.one_of("resampling", resampling, RESAMPLING)
    if not 0.0 <= threshold <= 1.0:
        raise ValueError(f"threshold must lie in [0, 1], a share of the particles, got {threshold}.")
    ssms = switched(build, rule)
    for ssm in ssms:
        check_linear(ssm, rule)
    grid, decides = decision_grid(ssms[0], times, decisions, start, steps, max_step)
    warn_single_precision()
    shape = (len(grid.observed), ssms[0].output_dim)
    y = jnp.full(shape, jnp.nan) if y is None else check_observations(y, *shape, empty=True)
    settings = _Settings(particles, resampling, threshold, only_adds(build))
    return _run(ssms, rule, grid, jnp.asarray(decides), y, jnp.asarray(times, float), first_moments(ssms[0], start),
                check_initial(initial, rule, particles), key, settings)


@eqx.filter_jit
def _run(ssms: tuple[StateSpaceModel, ...], rule: SwitchingRule, grid: TimeGrid, decides: jax.Array, y: jax.Array,
         times: jax.Array, begin: Moments, initial: jax.Array, key: jax.Array,
         settings: _Settings) -> RaoBlackwellisedResult:
    size = settings.particles
    maps = [interval_maps(ssm, rule, grid) for ssm in ssms]
    equal = jnp.full(size, -np.log(size))

    def row(particles: _Particles,
            inputs: tuple[Intervals, jax.Array, jax.Array, jax.Array]) -> tuple[_Particles, tuple]:
        one, observed, decide, row_key = inputs
        read_key, resample_key = jax.random.split(row_key)
        under = jax.tree_util.tree_map(lambda *parts: jnp.stack(parts), *(make(one) for make in maps))
        own = _of_particles(under, particles.choice, settings.shared)
        particles, log_likelihood = _observe(ssms[0], _move(particles, own, settings.shared), own, observed, settings)
        kept = _summary(particles, own, settings.shared)
        particles = jax.lax.cond(
            decide, lambda p: _decide(rule, p, own, one.end, read_key, settings.shared),
            lambda p: p, particles)
        weights = jnp.exp(particles.log_weights)
        ess = effective_sample_size(weights)
        kept = (*kept, jnp.asarray(rule.values)[particles.choice], ess, log_likelihood)
        needed = jnp.isfinite(observed).any() & (ess < settings.threshold * size)
        ancestors = jax.lax.cond(needed, lambda: resample(resample_key, weights, settings.resampling),
                                 lambda: jnp.arange(size))
        covariance = particles.covariance if settings.shared else particles.covariance[ancestors]
        return _Particles(particles.mean[ancestors], covariance, particles.choice[ancestors],
                          jnp.where(needed, equal, particles.log_weights)), kept

    covariance = begin.covariance
    first = _Particles(jnp.broadcast_to(begin.mean, (size, *begin.mean.shape)),
                       covariance if settings.shared else jnp.broadcast_to(covariance, (size, *covariance.shape)),
                       initial, equal)
    keys = jax.random.split(key, decides.shape[0])
    _, kept = jax.lax.scan(row, first, (*with_observations(grid.intervals, y), decides, keys))
    at = tuple(part[jnp.asarray(grid.observed)] for part in kept)
    mean, covariance, middle, variance, noise, log_weights, inputs, ess, log_likelihood = at
    return RaoBlackwellisedResult(times, log_likelihood, mean, covariance, Mixture(middle, variance, log_weights),
                                  Mixture(middle, variance + noise, log_weights), inputs, ess)


def _of_particles(under: SwitchedMap, choice: jax.Array, shared: bool) -> SwitchedMap:
    """Return the map of each particle; matrices that all share stay one matrix."""
    own = jax.tree_util.tree_map(lambda part: part[0] if shared else part[choice], under)
    return own._replace(offset=under.offset[choice], shift=under.shift[choice], read_shift=under.read_shift[choice])


def _move(particles: _Particles, own: SwitchedMap, shared: bool) -> _Particles:
    move = lambda phi, p, q: congruence(phi, p) + q  # noqa: E731
    covariance = (move if shared else jax.vmap(move))(own.phi, particles.covariance, own.noise)
    return particles._replace(mean=_times(own.phi, particles.mean, shared) + own.offset, covariance=covariance)


def _observe(ssm: StateSpaceModel, particles: _Particles, own: SwitchedMap, observed: jax.Array,
             settings: _Settings) -> tuple[_Particles, jax.Array]:
    """Condition each particle on an observation, and weight it by that observation's density."""
    at = None if settings.shared else 0
    value = _times(own.jacobian, particles.mean, settings.shared) + own.shift

    def one(value: jax.Array, jacobian: jax.Array, noise: jax.Array, mean: jax.Array, covariance: jax.Array) -> Update:
        return update(ssm, Linearised(value, jacobian, noise), observed, jnp.isfinite(observed),
                      Moments(mean, covariance))

    new = jax.vmap(one, (0, at, at, 0, at), Update(Moments(0, at), 0, 0, at, at, at, at))(  # type: ignore[arg-type]
        value, own.jacobian, own.variance, particles.mean, particles.covariance)
    log_weights, total = reweighted(particles.log_weights, new.log_likelihood, particles.log_weights)
    seen = jnp.isfinite(observed).any()
    return (particles._replace(mean=new.moments.mean, covariance=new.moments.covariance, log_weights=log_weights),
            jnp.where(seen, jnp.where(jnp.isnan(total), -jnp.inf, total), 0.0))


def _decide(rule: SwitchingRule, particles: _Particles, own: SwitchedMap, t: jax.Array, key: jax.Array,
            shared: bool) -> _Particles:
    """Draw the reading of each particle, condition the particle on it, and apply the rule."""
    middle = _times(own.reads, particles.mean, shared) + own.read_shift
    error = jnp.diag(rule.variance())

    def condition(reads: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        cross = matmul(covariance, reads.T)
        innovation_cov = matmul(reads, cross) + error
        gain = solve_semidefinite(innovation_cov, cross.T).T
        kept = jnp.eye(covariance.shape[0]) - matmul(gain, reads)
        return semidefinite_root(innovation_cov), gain, congruence(kept, covariance) + congruence(gain, error)

    root, gain, covariance = (condition if shared else jax.vmap(condition))(own.reads, particles.covariance)
    away = _times(root, normals(key, middle.shape[1], middle.shape[0]).T, shared)
    choice = jax.vmap(lambda d, r: rule.decide(d, r, t))(particles.choice, middle + away)
    return particles._replace(mean=particles.mean + _times(gain, away, shared), covariance=covariance,
                              choice=choice.astype(particles.choice.dtype))


def _summary(particles: _Particles, own: SwitchedMap, shared: bool) -> tuple[jax.Array, ...]:
    """Return moments of the joint state, and the mixture of the outputs with its noise."""
    mean, covariance, _, log_weights = particles
    weights = jnp.exp(log_weights)
    whole = weights @ mean
    centred = mean - whole
    within = covariance if shared else jnp.tensordot(weights, covariance, 1)
    innovation_cov = (congruence if shared else jax.vmap(congruence))(own.jacobian, covariance)
    variance, noise = (jnp.diagonal(part, axis1=-2, axis2=-1) for part in (innovation_cov, own.variance))
    if shared:
        variance, noise = variance[None], noise[None]
    return (whole, within + (centred * weights[:, None]).T @ centred,
            _times(own.jacobian, mean, shared) + own.shift, variance, noise, log_weights)


def _times(matrix: jax.Array, vectors: jax.Array, shared: bool) -> jax.Array:
    """Return the product of one matrix, or one for each particle, with the particles' vectors (N, k)."""
    return vectors @ matrix.T if shared else jnp.einsum("nij,nj->ni", matrix, vectors)
