"""Markov chains on a bound model: started outside of compiled code, advanced by one program."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Hashable, Mapping
from operator import attrgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro.infer import NUTS
from numpyro.infer.util import ParamInfo

from lfm_ppl import checks
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.fingerprint import signature
from lfm_ppl.inference.kernels import robust_metropolis
from lfm_ppl.inference.kernels.particle_marginal import ParticleMarginalRAM, ParticleMarginalState
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.kernels.robust_metropolis import RAMState, finite_or_infinity, initial_state

CHAIN_METHODS = ("parallel", "vectorized", "sequential")

_BLOCKS = 20
"""Parts of a run between two signs of life."""


class Transition(NamedTuple):
    """How a chain starts and moves. Both functions are traced, with the data as an argument.

    Attributes:
        identity: everything that the compiled functions depend on.
        start: ``(key, point, y, extra) -> state``, with ``point`` the energy and its gradient at the first z.
        step: ``(state, y) -> state``.
        fields: name of a statistic -> attribute of the state, dots for nested ones.
        evaluate: from z (d,) to the log density and, where the sampler needs it, the gradient (d,), zero elsewhere.
        extra: further arrays that the chain starts from; an argument of the compiled function.
        describe: from a state of all chains to a few words for the progress bar.
    """

    identity: Hashable
    start: Callable[[jax.Array, ParamInfo, Any, Any], Any]
    step: Callable[[Any, Any], Any]
    fields: Mapping[str, str]
    evaluate: Callable[[Any], tuple[Any, Any]]
    extra: Any = None
    describe: Callable[[Any], str] = lambda state: ""


def nuts(bound: BoundModel, warmup: int, options: Mapping[str, Any]) -> Transition:
    """Return the transition of NumPyro's NUTS with ``options``.

    A full mass matrix and forward-mode gradients are the default for up to ten parameters.
    """
    options = {"forward_mode_differentiation": bound.forward_mode, "dense_mass": bound.forward_mode, **options}
    forward_mode = bool(options.pop("forward_mode_differentiation"))
    both = bound.gradient(forward_mode)
    if isinstance(options["dense_mass"], bool):
        # In blocks of named sites, as NUTS itself has it where it knows their names.
        options["dense_mass"] = [tuple(sorted(bound.sites))] if options["dense_mass"] else []

    def kernel(y: Any) -> NUTS:
        # Whichever way NUTS asks for it, the gradient is the one that was traced already, by the mode that is wanted.
        @jax.custom_jvp
        def log_density(z: jax.Array) -> jax.Array:
            return bound.log_density(z, y)

        @log_density.defjvp
        def _(primals: tuple, tangents: tuple) -> tuple:
            value, gradient = both(primals[0], y)
            return value, gradient @ tangents[0]

        return NUTS(potential_fn=lambda z: -log_density(ravel_pytree(z)[0]), **options)

    def start(key: jax.Array, point: ParamInfo, y: Any, extra: Any) -> Any:
        return kernel(y).init(key, warmup, point, (), {})

    def step(state: Any, y: Any) -> Any:
        own = kernel(y)
        # The kernel's functions are made by `init`, whose state is not used and is dropped by the compiler.
        own.init(state.rng_key, warmup, ParamInfo(state.z, state.potential_energy, state.z_grad), (), {})
        return own.sample(state, (), {})

    fields = {"diverging": "diverging", "acceptance_rate": "accept_prob", "n_steps": "num_steps", "energy": "energy",
              "step_size": "adapt_state.step_size", "lp": "potential_energy"}
    return Transition(("nuts", warmup, forward_mode, signature(dict(options)) or object()), start, step, fields,
                      lambda z: both(jnp.asarray(z, float), bound.argument),
                      describe=lambda state: _words(state, state.adapt_state.step_size))


def random_walk(bound: BoundModel, kernel: RAM, warmup: int) -> Transition:
    """Return the transition of robust adaptive Metropolis with the settings of ``kernel``."""

    def start(key: jax.Array, point: ParamInfo, y: Any, chol: Any) -> RAMState:
        return initial_state(point.z, point.potential_energy, key, chol, warmup)

    def step(state: RAMState, y: Any) -> RAMState:
        return robust_metropolis.step(_potential(bound, y), *kernel.adaptation, state)

    fields = {"acceptance_rate": "accept_prob", "accepted": "accepted", "lp": "potential_energy"}
    return Transition(("ram", warmup, kernel.adaptation), start, step, fields, _value(bound),
                      jnp.asarray(kernel.initial_factor(bound.size)), lambda state: _words(state, state.step_size))


def particle_marginal(bound: BoundModel, kernel: ParticleMarginalRAM, warmup: int) -> Transition:
    """Return the transition of particle-marginal RAM with the settings of ``kernel``, which is prepared."""

    def estimate(y: Any) -> Callable[[Any, jax.Array], jax.Array]:
        assert kernel.estimate is not None and kernel.tuned is not None
        own, particles = kernel.estimate, kernel.tuned.particles
        return lambda z, key: own(ravel_pytree(z)[0], key, particles, y)

    def start(key: jax.Array, point: ParamInfo, y: Any, chol: Any) -> ParticleMarginalState:
        energy = finite_or_infinity(estimate(y)(point.z, jax.random.fold_in(key, 1)))
        surrogate = point.potential_energy if kernel.delayed else jnp.zeros_like(energy)
        ram = initial_state(point.z, energy, key, chol, warmup)
        return ParticleMarginalState(ram, surrogate, jnp.array(False), key)

    def step(state: ParticleMarginalState, y: Any) -> ParticleMarginalState:
        return kernel.step(estimate(y), _potential(bound, y) if kernel.delayed else None)(state)

    identity = ("pmmh", warmup, kernel.adaptation, kernel.settings, kernel.particle_steps, kernel.delayed)
    fields = {"acceptance_rate": "accept_prob", "accepted": "accepted", "lp": "potential_energy",
              "estimated": "estimated"}
    return Transition(identity, start, step, fields, _value(bound), jnp.asarray(kernel.initial_factor(bound.size)),
                      lambda state: _words(state, state.step_size))


def _value(bound: BoundModel) -> Callable[[Any], tuple[Any, Any]]:
    return lambda z: (bound.log_density(z), jnp.zeros(bound.size))


def _potential(bound: BoundModel, y: Any) -> Callable[[Any], jax.Array]:
    return lambda z: -bound.log_density(ravel_pytree(z)[0], y)


def _words(state: Any, step_size: Any) -> str:
    return f"step size {np.mean(step_size):.2e}, acceptance {np.mean(state.mean_accept_prob):.2f}"


class Draws(NamedTuple):
    """What chains collected.

    Attributes:
        z: (C, N, d) unconstrained draws.
        statistics: name -> (C, N, ...).
    """

    z: np.ndarray
    statistics: dict[str, np.ndarray]


def sample(key: jax.Array, bound: BoundModel, transition: Transition, starts: np.ndarray, *, warmup: int, samples: int,
           thin: int = 1, chain_method: str | None = None, progress: bool = False) -> Draws:
    """Run chains; the same seed gives the same draws whatever the chain method and the progress bar.

    Warm-up and sampling are one program, in which the data are an argument: another data set compiles nothing.

    Args:
        key: a JAX random key.
        bound: the model and its data.
        transition: of the sampler.
        starts: (C, d), where each chain starts; the density is finite there.
        warmup: steps before the first draw that is kept.
        samples: N, draws in each chain.
        thin: steps that make one draw.
        chain_method: "parallel" (a device for each chain), "vectorized" or "sequential"; None: parallel where there are
            enough devices, sequential otherwise.
        progress: show a bar on standard error.
    """
    chains = len(starts)
    method = _method(chain_method, chains)
    points = _points(bound, transition, starts)
    keys = jax.random.split(key, chains)
    begin = bound.compiled(("start", transition.identity), lambda: jax.jit(
        jax.vmap(transition.start, in_axes=(0, 0, None, None))))
    state = begin(keys, points, bound.argument, transition.extra)
    record = _recorder(transition)
    store = jax.tree_util.tree_map(lambda leaf: jnp.zeros((chains, samples, *leaf.shape[1:]), leaf.dtype),
                                   jax.eval_shape(jax.vmap(record), state))
    block = bound.compiled(("block", transition.identity, method), lambda: _block(transition, record, method))
    total = warmup + samples * thin
    edges = [0, total] if not progress else list(np.unique(np.linspace(0, total, _BLOCKS + 1).astype(int)))
    run = _one_by_one(block, chains) if method == "sequential" else block
    with _Bar(total, progress) as bar:
        for lower, upper in zip(edges[:-1], edges[1:], strict=True):
            state, store = run(state, store, int(lower), int(upper), warmup, thin, bound.argument)
            if progress:
                bar.advance(int(upper), transition.describe(jax.block_until_ready(state)))
    collected = jax.tree_util.tree_map(np.asarray, store)
    return Draws(collected.pop("z"), collected)


def _method(chosen: str | None, chains: int) -> str:
    enough = jax.local_device_count() >= chains
    if chosen is None:
        return "parallel" if enough else "sequential"
    checks.one_of("chain_method", chosen, CHAIN_METHODS)
    if chosen == "parallel" and not enough:
        warnings.warn(f"there are {jax.local_device_count()} devices for {chains} parallel chains, so that they run "
                      f"one after another; call numpyro.set_host_device_count({chains}) before JAX starts.",
                      stacklevel=4)
        return "sequential"
    return chosen


def _points(bound: BoundModel, transition: Transition, starts: np.ndarray) -> ParamInfo:
    """Return position, energy and gradient at the first point of each chain, by site and with chains as first axis."""
    found = [transition.evaluate(start) for start in starts]
    unravel = jax.vmap(bound.unravel)
    return ParamInfo(unravel(jnp.asarray(starts)), -jnp.stack([value for value, _ in found]),
                     unravel(-jnp.stack([gradient for _, gradient in found])))


def _recorder(transition: Transition) -> Callable[[Any], dict[str, jax.Array]]:
    def record(state: Any) -> dict[str, jax.Array]:
        fields = {name: jnp.asarray(attrgetter(path)(state)) for name, path in transition.fields.items()}
        return {"z": ravel_pytree(state.z)[0], **fields}

    return record


def _block(transition: Transition, record: Callable, method: str) -> Callable:
    """Return the compiled function that takes steps ``lower`` to ``upper`` of all chains (of one, in sequence)."""

    def advance(state: Any, store: Any, lower: Any, upper: Any, warmup: Any, thin: Any, y: Any) -> tuple[Any, Any]:
        def body(i: Any, carry: tuple) -> tuple:
            state, store = carry
            state = transition.step(state, y)
            # The last step of a draw is the one that stays; what the warm-up writes is overwritten.
            row = jnp.maximum((i - warmup) // thin, 0)
            store = jax.tree_util.tree_map(lambda kept, new: kept.at[row].set(new), store, record(state))
            return state, store

        return jax.lax.fori_loop(lower, upper, body, (state, store))

    if method == "sequential":
        return jax.jit(advance)
    axes = (0, 0, None, None, None, None, None)
    return jax.pmap(advance, in_axes=axes) if method == "parallel" else jax.jit(jax.vmap(advance, in_axes=axes))


def _one_by_one(block: Callable, chains: int) -> Callable:
    """Return the function that runs one chain after another."""

    def run(state: Any, store: Any, *rest: Any) -> tuple[Any, Any]:
        take = lambda c: jax.tree_util.tree_map(lambda leaf: leaf[c], (state, store))  # noqa: E731
        found = [block(*take(c), *rest) for c in range(chains)]
        return jax.tree_util.tree_map(lambda *leaves: jnp.stack(leaves), *found)

    return run


class _Bar:
    """A progress bar over all steps, or none."""

    def __init__(self, total: int, shown: bool) -> None:
        self._done, self._bar = 0, None
        if shown:
            from tqdm.auto import tqdm

            self._bar = tqdm(total=total, file=sys.stderr)

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *error: Any) -> None:
        if self._bar is not None:
            self._bar.close()

    def advance(self, done: int, words: str) -> None:
        """Show that so many steps are done."""
        if self._bar is not None:
            self._bar.set_postfix_str(words, refresh=False)
            self._bar.update(done - self._done)
        self._done = done
