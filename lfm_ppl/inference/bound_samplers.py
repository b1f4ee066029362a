"""The samplers of `lfm_ppl.fit` on a bound model: algorithm, tuning and starting values of each."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.kernels.algorithm import SamplingAlgorithm
from lfm_ppl.inference.kernels.particle_marginal import ParticleMarginalRAM, particle_marginal
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.kernels.robust_metropolis import robust_metropolis
from lfm_ppl.inference.nuts import NUTSState, nuts, nuts_options
from lfm_ppl.inference.problem import Problem, signature
from lfm_ppl.inference.symmetrising import SymmetrisingTransform

_SLOW_WARMUP_HINT = (
    "this warm-up is slow, and the time left may still grow. From the posterior mode, with the covariance "
    "there, steps are often many times longer: Ctrl-C, and again without init (lfm-ppl fit without --init).")


@dataclass(frozen=True)
class BoundSampler:
    """A sampling algorithm on a bound model.

    Attributes:
        bound: the model and its data.
        algorithm: the Markov chain; its data are `problem`.
        identity: key of the compiled programs; it holds everything that the algorithm depends on besides the model.
        evaluate: from z (d,) to the log density and, if the algorithm uses it, the gradient (d,), else zeros.
        tuning: arrays for ``algorithm.init``, an argument of the compiled program.
        describe: from the state of all chains to a short text for the progress display.
        slow_warmup_hint: advice during a long warm-up; empty where there is none.
        problem: data, times and inputs as the algorithm takes them.
    """

    bound: BoundModel
    algorithm: SamplingAlgorithm
    identity: Hashable
    evaluate: Callable[[Any], tuple[Any, Any]]
    tuning: Any
    describe: Callable[[Any], str]
    problem: Problem
    slow_warmup_hint: str = ""

    def program(self, name: Hashable, make: Callable[[], Callable]) -> Callable:
        """Return the compiled function of this name, made at the first call."""
        return self.bound.program((name, self.identity), make, self.problem)


def nuts_sampler(bound: BoundModel, num_warmup: int, options: Mapping[str, Any],
                 transform: SymmetrisingTransform | None = None) -> BoundSampler:
    """Return NumPyro's NUTS.

    Args:
        bound: the model and its data.
        num_warmup: warm-up steps of each chain.
        options: arguments of NUTS.
        transform: from the position of a chain to the unconstrained parameters. Its correlation matrix is the initial
            inverse mass matrix, which is dense, and regularises the estimates of the warm-up. None: there is none, and
            the warm-up starts with the identity.
    """
    completed = nuts_options(bound, options, transform is not None)
    gradient = bound.gradient(bool(completed["forward_mode_differentiation"]))

    def evaluate(z: Any) -> tuple[jax.Array, jax.Array]:
        return gradient(jnp.asarray(z, float), bound.y)

    def describe(state: NUTSState) -> str:
        return _step_size_and_acceptance(state.hmc.adapt_state.step_size, state.hmc.mean_accept_prob)

    has_default_mass = transform is None and "inverse_mass_matrix" not in options
    return BoundSampler(
        bound, nuts(bound, num_warmup, completed),
        ("nuts", num_warmup, transform is not None, signature(completed) or object()), evaluate,
        jax.tree_util.tree_map(jnp.asarray, transform), describe, bound.problem,
        _SLOW_WARMUP_HINT if has_default_mass else "")


def ram_sampler(bound: BoundModel, num_warmup: int, kernel: RAM) -> BoundSampler:
    """Return robust adaptive Metropolis with the settings of ``kernel``."""
    algorithm = robust_metropolis(_potential_at(bound), kernel.adaptation, num_warmup)
    return _random_walk(bound, algorithm, ("ram", num_warmup, kernel.adaptation), kernel)


def particle_marginal_sampler(bound: BoundModel, num_warmup: int, kernel: ParticleMarginalRAM) -> BoundSampler:
    """Return particle-marginal RAM with the settings of ``kernel``, whose number of particles is chosen."""
    surrogate_at = _potential_at(bound) if kernel.delayed else None
    algorithm = particle_marginal(kernel.estimate_at, surrogate_at, kernel.adaptation, num_warmup)
    identity = ("pmmh", num_warmup, kernel.adaptation, kernel.settings, kernel.particle_steps, kernel.delayed)
    return _random_walk(bound, algorithm, identity, kernel)


def _random_walk(bound: BoundModel, algorithm: SamplingAlgorithm, identity: Hashable, kernel: RAM) -> BoundSampler:
    def evaluate(z: Any) -> tuple[jax.Array, jax.Array]:
        return bound.log_density(z), jnp.zeros(bound.size)

    def describe(state: Any) -> str:
        return _step_size_and_acceptance(state.step_size, state.mean_accept_prob)

    # A particle filter needs the values of the times.
    problem = bound.constants if isinstance(kernel, ParticleMarginalRAM) else bound.problem
    return BoundSampler(bound, algorithm, identity, evaluate, jnp.asarray(kernel.initial_factor(bound.size)), describe,
                        problem)


def _potential_at(bound: BoundModel) -> Callable[[Any], Callable[[Any], jax.Array]]:
    """Return the function from the data to minus the log density, a function of the sites' unconstrained values."""
    def potential_at(y: Any) -> Callable[[Any], jax.Array]:
        return lambda z: -bound.log_density(ravel_pytree(z)[0], y)

    return potential_at


def _step_size_and_acceptance(step_size: Any, acceptance: Any) -> str:
    return f"step size {np.mean(step_size):.2e}, acceptance {np.mean(acceptance):.2f}"
