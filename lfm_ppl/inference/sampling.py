"""Markov chains on a bound model: started outside of compiled code, advanced by one program.

One function for each sampler returns its `Transition`; `sample` runs any of them.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Hashable, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from numpyro.infer import NUTS
from numpyro.infer.hmc import HMCState
from numpyro.infer.util import ParamInfo

from lfm_ppl import checks
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.fingerprint import signature
from lfm_ppl.inference.interruption import Interruption, was_interrupt
from lfm_ppl.inference.kernels import robust_metropolis
from lfm_ppl.inference.kernels.particle_marginal import ParticleMarginalRAM, ParticleMarginalState
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.kernels.robust_metropolis import RAMState, finite_or_infinity, initial_state
from lfm_ppl.inference.laplace_start import Laplace
from lfm_ppl.inference.progress import Progress, Stage
from lfm_ppl.inference.random_keys import split_keys

CHAIN_METHODS = ("parallel", "vectorized", "sequential")

BLOCK_S = 2.0
"""Time that a block of steps is to take: that long, and no longer, Ctrl-C waits for it."""

_CHAINS = PartitionSpec("chains")
"""Arrays whose first axis is split over the devices, a chain on each."""

_GROWTH = 8
"""Most that a block may be longer than the one before it: steps of the warm-up differ in length."""


_PSEUDO_DRAWS = 20
"""Weight of the Laplace approximation in the estimates of the covariance of a warm-up, in draws."""

_ACCEPTANCE, _ACCEPTANCE_AT_MODE = 0.8, 0.9
"""Acceptance that NUTS aims at. With the posterior's covariance as mass matrix the shorter steps of the higher one cost
a quarter more gradients, and of the p53 data no draw diverged, where one to three of 1,000 did."""

_AT_MODE = ("this warm-up is slow, and the time left may still grow. From the posterior mode, with the covariance "
            "there, steps are often many times longer: Ctrl-C, and again without init (lfm-ppl fit without --init).")


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
        if_slow: what to tell whoever waits for a long warm-up; empty where there is nothing to do about it.
    """

    identity: Hashable
    start: Callable[[jax.Array, ParamInfo, Any, Any], Any]
    step: Callable[[Any, Any], Any]
    fields: Mapping[str, str]
    evaluate: Callable[[Any], tuple[Any, Any]]
    extra: Any = None
    describe: Callable[[Any], str] = lambda state: ""
    if_slow: str = ""


class LaplaceNUTSState(NamedTuple):
    """State of a NUTS chain whose mass matrix is regularised by a Laplace approximation.

    Attributes:
        hmc: NumPyro's state.
        laplace: the approximation; the same at every step.
    """

    hmc: HMCState
    laplace: Laplace

    @property
    def z(self) -> Any:
        """Unconstrained parameters by site."""
        return self.hmc.z


def _with_pseudo_draws(state: HMCState, laplace: Laplace) -> HMCState:
    """Return the state with `_PSEUDO_DRAWS` draws of the approximation in every empty estimate of the covariance.

    NumPyro begins an estimate at the start of each window of the warm-up, and a window may have few draws for d
    parameters. Welford's algorithm continues from the mean, the sum of squares and the count of the pseudo-draws, so
    that the inverse mass matrix is (n S + n_0 C) / (n + n_0).
    """

    def begin(estimate: tuple) -> tuple:
        mean, sum_of_squares, count = estimate
        is_empty = count == 0
        return (jnp.where(is_empty, laplace.mode, mean),
                jnp.where(is_empty, _PSEUDO_DRAWS * laplace.covariance, sum_of_squares),
                jnp.where(is_empty, _PSEUDO_DRAWS, count))

    adaptation = state.adapt_state
    (sites, estimate), = adaptation.mm_state.items()  # one dense block of all sites
    return state._replace(adapt_state=adaptation._replace(mm_state={sites: begin(estimate)}))


def nuts(bound: BoundModel, warmup: int, options: Mapping[str, Any], laplace: Laplace | None = None) -> Transition:
    """Return the transition of NumPyro's NUTS with ``options``.

    A dense mass matrix and forward-mode gradients are the default for up to ten parameters; with a Laplace
    approximation the mass matrix is dense for any number.

    Args:
        bound: the model.
        warmup: steps of each chain.
        options: of NUTS.
        laplace: approximation of the posterior; its covariance is the initial inverse mass matrix, which is dense, and
            regularises those of the warm-up. None: the warm-up begins with the identity.
    """
    options = {"forward_mode_differentiation": bound.forward_mode,
               "dense_mass": laplace is not None or bound.forward_mode,
               "target_accept_prob": _ACCEPTANCE if laplace is None else _ACCEPTANCE_AT_MODE, **options}
    forward_mode = bool(options.pop("forward_mode_differentiation"))
    both = bound.gradient(forward_mode)
    if isinstance(options["dense_mass"], bool):
        # In blocks of named sites, as NUTS itself has it where it knows their names.
        options["dense_mass"] = [tuple(sorted(bound.sites))] if options["dense_mass"] else []

    def kernel(y: Any, **more: Any) -> NUTS:
        # Whichever way NUTS asks for it, the gradient is the one that was traced already, by the mode that is wanted.
        @jax.custom_jvp
        def log_density(z: jax.Array) -> jax.Array:
            return bound.log_density(z, y)

        @log_density.defjvp
        def _(primals: tuple, tangents: tuple) -> tuple:
            value, gradient = both(primals[0], y)
            return value, gradient @ tangents[0]

        return NUTS(potential_fn=lambda z: -log_density(ravel_pytree(z)[0]), **options, **more)

    def start(key: jax.Array, point: ParamInfo, y: Any, extra: Any) -> Any:
        if extra is None:
            return kernel(y).init(key, warmup, point, (), {})
        state = kernel(y, inverse_mass_matrix=extra.covariance).init(key, warmup, point, (), {})
        return LaplaceNUTSState(_with_pseudo_draws(state, extra), extra)

    def step(state: Any, y: Any) -> Any:
        hmc = state if laplace is None else state.hmc
        own = kernel(y)
        # The kernel's functions are made by `init`, whose state is not used and is dropped by the compiler.
        own.init(hmc.rng_key, warmup, ParamInfo(hmc.z, hmc.potential_energy, hmc.z_grad), (), {})
        hmc = own.sample(hmc, (), {})
        return hmc if laplace is None else LaplaceNUTSState(_with_pseudo_draws(hmc, state.laplace), state.laplace)

    def describe(state: Any) -> str:
        hmc = state if laplace is None else state.hmc
        return _words(hmc, hmc.adapt_state.step_size)

    prefix = "" if laplace is None else "hmc."
    fields = {"diverging": "diverging", "acceptance_rate": "accept_prob", "n_steps": "num_steps", "energy": "energy",
              "step_size": "adapt_state.step_size", "lp": "potential_energy"}
    return Transition(("nuts", warmup, forward_mode, laplace is not None, signature(dict(options)) or object()),
                      start, step, {name: prefix + path for name, path in fields.items()},
                      lambda z: both(jnp.asarray(z, float), bound.argument),
                      None if laplace is None else jax.tree_util.tree_map(jnp.asarray, laplace), describe,
                      _AT_MODE if laplace is None and "inverse_mass_matrix" not in options else "")


def random_walk(bound: BoundModel, kernel: RAM, warmup: int) -> Transition:
    """Return the transition of robust adaptive Metropolis with the settings of ``kernel``."""

    def start(key: jax.Array, point: ParamInfo, y: Any, chol: Any) -> RAMState:
        return initial_state(point.z, point.potential_energy, key, chol, warmup)

    def step(state: RAMState, y: Any) -> RAMState:
        return robust_metropolis.step(_potential(bound, y), *kernel.adaptation, state)

    fields = {"acceptance_rate": "accept_prob", "accepted": "accepted", "lp": "potential_energy"}
    return Transition(("ram", warmup, kernel.adaptation), start, step, fields, _value(bound),
                      extra=jnp.asarray(kernel.initial_factor(bound.size)),
                      describe=lambda state: _words(state, state.step_size))


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
    return Transition(identity, start, step, fields, _value(bound),
                      extra=jnp.asarray(kernel.initial_factor(bound.size)),
                      describe=lambda state: _words(state, state.step_size))


def _value(bound: BoundModel) -> Callable[[Any], tuple[Any, Any]]:
    return lambda z: (bound.log_density(z), jnp.zeros(bound.size))


def _potential(bound: BoundModel, y: Any) -> Callable[[Any], jax.Array]:
    return lambda z: -bound.log_density(ravel_pytree(z)[0], y)


def _words(state: Any, step_size: Any) -> str:
    return f"step size {np.mean(step_size):.2e}, acceptance {np.mean(state.mean_accept_prob):.2f}"


class Draws(NamedTuple):
    """What chains collected.

    Attributes:
        z: (C, N, d) unconstrained draws; fewer than were asked for where the run was stopped.
        statistics: name -> (C, N, ...).
        done: steps that were taken.
        total: steps that were asked for.
    """

    z: np.ndarray
    statistics: dict[str, np.ndarray]
    done: int
    total: int


class Saved(NamedTuple):
    """Where chains stood.

    Attributes:
        done: steps that were taken.
        leaves: arrays of the state of all chains, in order.
        rows: "z" and the name of each statistic -> (C, N, ...), of which the first draws are known.
    """

    done: int
    leaves: list[np.ndarray]
    rows: dict[str, np.ndarray]


class Keeper(Protocol):
    """Keeps chains while they run."""

    def restore(self) -> Saved | None:
        """Return where an earlier run stood; None where there is none."""

    def due(self) -> bool:
        """Whether it is time to save again."""

    def save(self, saved: Saved, draws: int) -> None:
        """Keep where chains stand, with so many draws of each."""


def sample(key: jax.Array, bound: BoundModel, transition: Transition, starts: np.ndarray | None, *, warmup: int,
           samples: int, thin: int = 1, chain_method: str | None = None, progress: bool = False,
           keeper: Keeper | None = None) -> Draws:
    """Run chains; the same seed gives the same draws whatever the blocks, the progress bar, and stops on the way.

    Warm-up and sampling are one program, in which the data are an argument: another data set compiles nothing. It is
    called for a block of steps at a time, as many as take about `BLOCK_S`. Ctrl-C ends the run after the present block.

    Args:
        key: a JAX random key.
        bound: the model and its data.
        transition: of the sampler.
        starts: (C, d), where each chain starts; the density is finite there. None where ``keeper`` has their state.
        warmup: steps before the first draw that is kept.
        samples: N, draws in each chain.
        thin: steps that make one draw.
        chain_method: "parallel" (a device for each chain), "vectorized" or "sequential"; None: parallel where there are
            enough devices, sequential otherwise.
        progress: show on standard error how far it is.
        keeper: keeps the state of the chains and their draws, and knows those of an earlier run.

    Raises:
        KeyboardInterrupt: the second Ctrl-C.
    """
    total = warmup + samples * thin
    saved = None if keeper is None else keeper.restore()
    if saved is not None and saved.done == total:
        return _draws(saved.rows, samples, total, total)
    if saved is None:
        assert starts is not None
        saved = _first(key, bound, transition, starts, samples)
        if keeper is not None:
            keeper.save(saved, 0)
    chains = len(saved.leaves[0])
    run = _Block(bound, transition, chains, available_method(chain_method, chains))
    now = *run.placed(saved), saved.done
    pace, on_disk = _Pace(), saved.done
    drawn = lambda done: max((done - warmup) // thin, 0)  # noqa: E731

    def keep(state: Any, store: Any, done: int) -> None:
        if keeper is not None:
            keeper.save(Saved(done, _on_host(state), jax.tree_util.tree_map(np.asarray, store)), drawn(done))

    with Progress(total, saved.done, progress, warmup, transition.if_slow) as shown, Interruption() as stop:
        try:
            while now[-1] < total and not stop.requests:
                state, store, lower = now
                upper, began = min(lower + pace.steps, total), time.perf_counter()
                state, store = jax.block_until_ready(run(state, store, lower, upper, warmup, thin))
                now = state, store, upper
                pace.took(time.perf_counter() - began)
                stop.defer()
                if keeper is not None and upper < total and keeper.due():
                    keep(*now)
                    on_disk = upper
                shown.advance(upper, lambda: Stage(  # noqa: B023 (called at once)
                    drawn(upper), samples, _divergences(store, drawn(upper)), transition.describe(state)))  # noqa: B023
        except (KeyboardInterrupt, Exception) as error:
            if stop.requests > 1 or not was_interrupt(error):
                raise
        if on_disk < now[-1]:
            keep(*now)
    _, store, done = now
    return _draws(jax.tree_util.tree_map(np.asarray, store), drawn(done), done, total)


class _Pace:
    """Chooses how many steps make a block, by the time that the last one took."""

    def __init__(self) -> None:
        self.steps = 1
        self._compiled = False

    def took(self, seconds: float) -> None:
        """Learn what a block took; the first one may take as long as the compilation."""
        if self._compiled:
            self.steps = max(1, int(self.steps * min(BLOCK_S / max(seconds, 1e-9), _GROWTH)))
        self._compiled = True


def _first(key: jax.Array, bound: BoundModel, transition: Transition, starts: np.ndarray, samples: int) -> Saved:
    """Return the state before the first step."""
    found = [transition.evaluate(start) for start in starts]
    energy, slope = (-np.stack([np.asarray(each) for each in values]) for values in zip(*found, strict=True))
    keys = split_keys(key, len(starts))(slice(None))
    state = _beginning(bound, transition)(keys, np.asarray(starts), energy, slope, bound.argument, transition.extra)
    return Saved(0, _on_host(state), _rows(transition, state, samples))


def _rows(transition: Transition, state: Any, samples: int) -> dict[str, np.ndarray]:
    """Return where so many draws of chains in a ``state``, or of its shapes, will stand."""
    row = jax.eval_shape(jax.vmap(_recorder(transition)), state)
    return {name: np.zeros((leaf.shape[0], samples, *leaf.shape[1:]), leaf.dtype) for name, leaf in row.items()}


def _beginning(bound: BoundModel, transition: Transition) -> Any:
    """Return `_start`, compiled."""
    return bound.compiled(("start", transition.identity), lambda: jax.jit(_start(bound, transition)))


def _start(bound: BoundModel, transition: Transition) -> Callable:
    """Return the function from keys (C,), first points (C, d), energies and their gradients to states."""
    def start(key: jax.Array, z: jax.Array, energy: jax.Array, slope: jax.Array, y: Any, extra: Any) -> Any:
        return transition.start(key, ParamInfo(bound.unravel(z), energy, bound.unravel(slope)), y, extra)

    return jax.vmap(start, in_axes=(0, 0, 0, 0, None, None))


def _like(bound: BoundModel, transition: Transition, chains: int) -> Any:
    """Return shapes and types of the state of all chains."""
    points, energy = (jax.ShapeDtypeStruct((chains, *shape), float) for shape in ((bound.size,), ()))
    return jax.eval_shape(_beginning(bound, transition), jax.random.split(jax.random.key(0), chains), points, energy,
                          points, bound.argument, transition.extra)


def _on_host(state: Any) -> list[np.ndarray]:
    return [np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)
            for leaf in jax.tree_util.tree_leaves(state)]


def _on_device(leaves: Sequence[np.ndarray], like: Any, layout: NamedSharding | None) -> Any:
    """Return the state whose arrays are ``leaves``, laid out over devices; the inverse of `_on_host`."""
    shapes, structure = jax.tree_util.tree_flatten(like)
    return jax.tree_util.tree_unflatten(structure, [
        jax.random.wrap_key_data(jax.device_put(leaf, layout)) if jnp.issubdtype(shape.dtype, jax.dtypes.prng_key)
        else jax.device_put(np.asarray(leaf, shape.dtype), layout)
        for leaf, shape in zip(leaves, shapes, strict=True)])


def _draws(rows: Mapping[str, np.ndarray], count: int, done: int, total: int) -> Draws:
    collected = {name: np.asarray(values)[:, :count] for name, values in rows.items()}
    return Draws(collected.pop("z"), collected, done, total)


def _divergences(store: Mapping[str, jax.Array], draws: int) -> int:
    return int(np.asarray(store["diverging"])[:, :draws].sum()) if "diverging" in store else 0


def available_method(chosen: str | None, chains: int) -> str:
    """Return how chains run side by side on the devices that there are; arguments as in `sample`."""
    enough = jax.local_device_count() >= chains
    if chosen is None:
        return "parallel" if enough else "sequential"
    checks.one_of("chain_method", chosen, CHAIN_METHODS)
    if chosen == "parallel" and not enough:
        warnings.warn(f"there are {jax.local_device_count()} devices for {chains} parallel chains, so that they run "
                      f"one after another; call numpyro.set_host_device_count({chains}) before JAX starts.",
                      stacklevel=3)
        return "sequential"
    return chosen


def _recorder(transition: Transition) -> Callable[[Any], dict[str, jax.Array]]:
    def record(state: Any) -> dict[str, jax.Array]:
        fields = {name: jnp.asarray(attrgetter(path)(state)) for name, path in transition.fields.items()}
        return {"z": ravel_pytree(state.z)[0], **fields}

    return record


def _mesh(chains: int) -> Mesh:
    """Return the devices of chains side by side, one for each."""
    return Mesh(np.array(jax.local_devices()[:chains]), tuple(_CHAINS))


class _Block:
    """The compiled function that takes a block of steps of all chains, by one of `CHAIN_METHODS`."""

    def __init__(self, bound: BoundModel, transition: Transition, chains: int, method: str) -> None:
        mesh = _mesh(chains) if method == "parallel" else None
        self._function = bound.compiled(("block", transition.identity, method, mesh),
                                        lambda: _advance(transition, method, mesh))
        self._chains, self._one_by_one = chains, method == "sequential"
        # Laid out as the program leaves them, or the second block would be compiled anew for another layout.
        self._layout = None if mesh is None else NamedSharding(mesh, _CHAINS)
        # Data may lie on one device, where chains on several cannot read them.
        self._argument = (bound.argument if mesh is None
                          else jax.device_put(bound.argument, NamedSharding(mesh, PartitionSpec())))
        self.like = _like(bound, transition, chains)

    def placed(self, saved: Saved) -> tuple[Any, dict[str, jax.Array]]:
        """Return the state of all chains, and their draws, on the devices."""
        return (_on_device(saved.leaves, self.like, self._layout),
                {name: jax.device_put(rows, self._layout) for name, rows in saved.rows.items()})

    def __call__(self, state: Any, store: Any, *rest: Any) -> tuple[Any, Any]:
        """Return the state and the draws after steps; ``rest``: the first step, the last, the warm-up, and thinning."""
        if not self._one_by_one:
            return self._function(state, store, *rest, self._argument)
        found = [self._function(*self._one(state, store, c), *rest, self._argument) for c in range(self._chains)]
        return jax.tree_util.tree_map(lambda *leaves: jnp.stack(leaves), *found)

    def _one(self, state: Any, store: Any, chain: int) -> tuple[Any, Any]:
        return jax.tree_util.tree_map(lambda leaf: leaf[chain], (state, store))


def _advance(transition: Transition, method: str, mesh: Mesh | None) -> Callable:
    """Return the compiled function that takes steps ``lower`` to ``upper`` of all chains (of one, in sequence)."""
    record = _recorder(transition)

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
    if mesh is None:
        return jax.jit(jax.vmap(advance, in_axes=(0, 0, None, None, None, None, None)))

    def own(state: Any, store: Any, *rest: Any) -> tuple[Any, Any]:
        """Advance the one chain of a device."""
        state, store = jax.tree_util.tree_map(lambda leaf: leaf[0], (state, store))
        return jax.tree_util.tree_map(lambda leaf: leaf[None], advance(state, store, *rest))

    one = PartitionSpec()
    return jax.jit(jax.shard_map(own, mesh=mesh, in_specs=(_CHAINS, _CHAINS, one, one, one, one, one),
                                 out_specs=_CHAINS, check_vma=False))
