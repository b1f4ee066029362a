"""Markov chains on a bound model: one driver for every sampler.

1. Every chain starts at a point of finite density; density and gradient there are computed outside of the compiled
   program.
2. One compiled program, in which the data are an argument, advances all chains by a block of steps. Warm-up and
   sampling are the same program, and another data set of the same shape compiles nothing.
3. A block has as many steps as take about `BLOCK_S`. After each block the progress is shown, the state and the draws
   are stored if the last store is a second old, and a pending Ctrl-C ends the run.
4. Random keys belong to the state of a chain, so that the draws do not depend on the blocks, on the display or on
   interruptions.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from numpyro.infer.util import ParamInfo

from lfm_ppl.inference.bound_samplers import BoundSampler
from lfm_ppl.inference.schedule import Schedule
from lfm_ppl.utils import checks
from lfm_ppl.utils.interruption import Interruption, was_interrupt
from lfm_ppl.utils.programs import Program
from lfm_ppl.utils.progress import Console, Progress
from lfm_ppl.utils.random_keys import split_keys

CHAIN_METHODS = ("parallel", "vectorized", "sequential")

BLOCK_S = 2.0
"""Seconds that a block of steps should take, which is the time that Ctrl-C waits."""

_CHAIN_AXIS = PartitionSpec("chains")
"""Layout of arrays whose first axis is split over the devices, one chain on each."""

SURE_S = 60.0
"""Seconds of sampling before a warm-up counts as slow: the length of its first steps is not tuned yet."""

LONG_S = 1200.0
"""Remaining seconds from which on a slow warm-up prints advice."""

_LARGEST_GROWTH = 8
"""Largest ratio of the lengths of two successive blocks: steps of the warm-up differ in cost."""


@dataclass(frozen=True)
class Draws:
    """Draws of all chains.

    Attributes:
        z: (C, N, d) unconstrained draws; fewer than the schedule has if the run was stopped.
        statistics: name -> (C, N, ...).
        done: number of finished steps.
        total: number of steps of the schedule.
    """

    z: np.ndarray
    statistics: dict[str, np.ndarray]
    done: int
    total: int


@dataclass(frozen=True)
class Saved:
    """State of all chains, on the host.

    Attributes:
        done: number of finished steps.
        leaves: arrays of the state of all chains, in order.
        rows: "z" and the name of each statistic -> (C, N, ...); rows of draws to come are arbitrary.
    """

    done: int
    leaves: list[np.ndarray]
    rows: dict[str, np.ndarray]


class ChainStore(Protocol):
    """Storage of chains during a run."""

    def restore(self) -> Saved | None:
        """Return the state of an earlier run; None where there is none."""

    def due(self) -> bool:
        """Return whether it is time to save again."""

    def save(self, saved: Saved, draws: int) -> None:
        """Store the state of the chains and their first draws."""


def run_chains(key: jax.Array, sampler: BoundSampler, starts: np.ndarray | None, schedule: Schedule,
               store: ChainStore | None = None, show_progress: bool = False) -> Draws:
    """Run chains; Ctrl-C ends the run after the present block.

    Args:
        key: a JAX random key.
        sampler: the algorithm, with the model and its data.
        starts: (C, d) starting points of finite density; None where ``store`` has the state of the chains.
        schedule: numbers of steps and draws.
        store: storage of the state and the draws; None: there is none.
        show_progress: show the progress on standard error.

    Raises:
        KeyboardInterrupt: the second Ctrl-C.
    """
    total = schedule.steps
    saved = None if store is None else store.restore()
    if saved is not None and saved.done == total:
        return _draws(saved.rows, schedule.samples, total, total)
    if saved is None:
        assert starts is not None
        saved = _initial_state(key, sampler, starts, schedule.samples)
        if store is not None:
            store.save(saved, 0)
    chains = len(saved.leaves[0])
    program = _BlockProgram(sampler, schedule, chains, available_method(schedule.chain_method, chains))
    # One tuple, replaced at once, so that an interruption cannot separate the state from the number of steps.
    current = *program.to_device(saved), saved.done
    block_length, stored_steps = _BlockLength(), saved.done

    def save(state: Any, rows: Any, done: int) -> None:
        if store is not None:
            arrays = jax.tree_util.tree_map(np.asarray, rows)
            store.save(Saved(done, _to_host(state), arrays), schedule.draws_after(done))

    report = Console() if show_progress else None
    with (Progress(report, total, "steps", "sampling", saved.done) as progress, Interruption() as interruption):
        advice = _WarmupAdvice(sampler.slow_warmup_hint)
        progress.compile("compiling the sampler, and its first step")
        try:
            while current[-1] < total and not interruption.requests:
                state, rows, done = current
                block_end, start_time = min(done + block_length.steps, total), time.perf_counter()
                state, rows = jax.block_until_ready(program(state, rows, done, block_end))
                current = state, rows, block_end
                block_length.adapt(time.perf_counter() - start_time)
                interruption.defer()
                if store is not None and block_end < total and store.due():
                    save(*current)
                    stored_steps = block_end
                if report is not None:
                    draws, is_warmup = schedule.draws_after(block_end), block_end < schedule.warmup
                    progress.advance(block_end, f"{draws:,} of {schedule.samples:,} draws a chain, "
                                     + _divergences(rows, draws) + sampler.describe(state),
                                     " at the pace of the warm-up so far" if is_warmup else "")
                    if is_warmup:
                        advice.write(progress)
        except (KeyboardInterrupt, Exception) as error:
            if interruption.requests > 1 or not was_interrupt(error):
                raise
        if stored_steps < current[-1]:
            save(*current)
    _, rows, done = current
    return _draws(jax.tree_util.tree_map(np.asarray, rows), schedule.draws_after(done), done, total)


class _WarmupAdvice:
    """Advice on a warm-up that takes long, written once.

    Args:
        text: the advice; empty: none.
    """

    def __init__(self, text: str) -> None:
        self._text, self._start_time = text, time.perf_counter()

    def write(self, progress: Progress) -> None:
        """Write the advice if the pace is known and much time is left."""
        seconds_left = progress.seconds_left()
        if not self._text or seconds_left is None or seconds_left < LONG_S:
            return
        if time.perf_counter() - self._start_time > SURE_S:
            progress.write(f"note     {self._text}")
            self._text = ""


class _BlockLength:
    """Number of steps of a block, adapted to the duration of the last one."""

    def __init__(self) -> None:
        self.steps = 1
        self._is_compiled = False

    def adapt(self, seconds: float) -> None:
        """Adapt the length to the duration of a block; the first one includes the compilation and does not count."""
        if self._is_compiled:
            self.steps = max(1, int(self.steps * min(BLOCK_S / max(seconds, 1e-9), _LARGEST_GROWTH)))
        self._is_compiled = True


def _initial_state(key: jax.Array, sampler: BoundSampler, starts: np.ndarray, samples: int) -> Saved:
    """Return the state of all chains before the first step."""
    densities = [sampler.evaluate(start) for start in starts]
    energy, slope = (-np.stack([np.asarray(value) for value in values]) for values in zip(*densities, strict=True))
    keys = split_keys(key, len(starts))(slice(None))
    state = _init_program(sampler)(keys, np.asarray(starts), energy, slope, sampler.problem, sampler.tuning)
    row = jax.eval_shape(jax.vmap(sampler.algorithm.summary), state)
    rows = {name: np.zeros((leaf.shape[0], samples, *leaf.shape[1:]), leaf.dtype) for name, leaf in row.items()}
    return Saved(0, _to_host(state), rows)


def _init_program(sampler: BoundSampler) -> Any:
    """Return the compiled function from keys (C,), points (C, d), their energies and gradients to states."""
    bound, algorithm = sampler.bound, sampler.algorithm

    def init(key: jax.Array, z: jax.Array, energy: jax.Array, slope: jax.Array, y: Any, tuning: Any) -> Any:
        return algorithm.init(key, ParamInfo(bound.unravel(z), energy, bound.unravel(slope)), y, tuning)

    return sampler.program("start", lambda: Program(jax.vmap(init, in_axes=(0, 0, 0, 0, None, None))))


def _to_host(state: Any) -> list[np.ndarray]:
    return [np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)
            for leaf in jax.tree_util.tree_leaves(state)]


def _draws(rows: Mapping[str, np.ndarray], count: int, done: int, total: int) -> Draws:
    statistics = {name: np.asarray(values)[:, :count] for name, values in rows.items()}
    return Draws(statistics.pop("z"), statistics, done, total)


def _divergences(rows: Mapping[str, jax.Array], draws: int) -> str:
    """Return the number of divergences as the beginning of a text; empty where there are none."""
    count = int(np.asarray(rows["diverging"])[:, :draws].sum()) if "diverging" in rows else 0
    return f"{count:,} divergence{'s' * (count > 1)}, " if count else ""


def available_method(chain_method: str | None, chains: int) -> str:
    """Return how the chains run on the devices of this process; see `Schedule`."""
    has_enough_devices = jax.local_device_count() >= chains
    if chain_method is None:
        return "parallel" if has_enough_devices else "sequential"
    checks.one_of("chain_method", chain_method, CHAIN_METHODS)
    if chain_method == "parallel" and not has_enough_devices:
        warnings.warn(f"there are {jax.local_device_count()} devices for {chains} parallel chains, so that they run "
                      f"one after another; call numpyro.set_host_device_count({chains}) before JAX starts.",
                      stacklevel=3)
        return "sequential"
    return chain_method


class _BlockProgram:
    """The compiled function that advances all chains by a block of steps, with one of `CHAIN_METHODS`."""

    def __init__(self, sampler: BoundSampler, schedule: Schedule, chains: int, method: str) -> None:
        mesh = None
        if method == "parallel":
            mesh = Mesh(np.array(jax.local_devices()[:chains]), tuple(_CHAIN_AXIS))
        self._sampler, self._schedule, self._chains = sampler, schedule, chains
        self._is_sequential = method == "sequential"
        self._advance = sampler.program(("block", method, mesh), lambda: _advance(sampler, method, mesh))
        # The layout of the program's results; another one would compile the second block again.
        self._layout = None if mesh is None else NamedSharding(mesh, _CHAIN_AXIS)
        # Data on one device cannot be read by chains on several devices.
        self._problem = (sampler.problem if mesh is None
                          else jax.device_put(sampler.problem, NamedSharding(mesh, PartitionSpec())))

    def to_device(self, saved: Saved) -> tuple[Any, dict[str, jax.Array]]:
        """Return the state of all chains and their draws on the devices; the inverse of `_to_host`."""
        sampler, bound = self._sampler, self._sampler.bound
        points, energy = (jax.ShapeDtypeStruct((self._chains, *shape), float) for shape in ((bound.size,), ()))
        keys = jax.random.split(jax.random.key(0), self._chains)
        shapes, structure = jax.tree_util.tree_flatten(jax.eval_shape(
            _init_program(sampler), keys, points, energy, points, sampler.problem, sampler.tuning))
        state = jax.tree_util.tree_unflatten(structure, [
            self._leaf_to_device(leaf, shape) for leaf, shape in zip(saved.leaves, shapes, strict=True)])
        return state, {name: jax.device_put(rows, self._layout) for name, rows in saved.rows.items()}

    def _leaf_to_device(self, leaf: np.ndarray, shape: jax.ShapeDtypeStruct) -> jax.Array:
        if jnp.issubdtype(shape.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(jax.device_put(leaf, self._layout))
        return jax.device_put(np.asarray(leaf, shape.dtype), self._layout)

    def __call__(self, state: Any, rows: Any, first: int, end: int) -> tuple[Any, Any]:
        """Return the state and the draws after the steps from ``first`` to ``end``."""
        steps = first, end, self._schedule.warmup, self._schedule.thin
        if not self._is_sequential:
            return self._advance(state, rows, *steps, self._problem)
        chains = (jax.tree.map(lambda leaf, chain=chain: leaf[chain], (state, rows)) for chain in range(self._chains))
        results = [self._advance(*chain, *steps, self._problem) for chain in chains]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *results)


def _advance(sampler: BoundSampler, method: str, mesh: Mesh | None) -> Callable:
    """Return the compiled function that advances all chains, or one chain if they are sequential."""
    algorithm = sampler.algorithm

    def advance(state: Any, rows: Any, first: Any, end: Any, warmup: Any, thin: Any, y: Any) -> tuple[Any, Any]:
        def body(i: Any, carry: tuple) -> tuple:
            state, rows = carry
            state = algorithm.step(state, y)
            # Each step of a draw overwrites the row of that draw; the warm-up writes into the first row.
            index = jnp.maximum((i - warmup) // thin, 0)
            rows = jax.tree_util.tree_map(lambda row, value: row.at[index].set(value), rows, algorithm.summary(state))
            return state, rows

        return jax.lax.fori_loop(first, end, body, (state, rows))

    if method == "sequential":
        return Program(advance)
    if mesh is None:
        return Program(jax.vmap(advance, in_axes=(0, 0, None, None, None, None, None)))

    def advance_on_device(state: Any, rows: Any, *arguments: Any) -> tuple[Any, Any]:
        """Advance the chain of one device."""
        state, rows = jax.tree_util.tree_map(lambda leaf: leaf[0], (state, rows))
        return jax.tree_util.tree_map(lambda leaf: leaf[None], advance(state, rows, *arguments))

    replicated = PartitionSpec()
    in_specs = (_CHAIN_AXIS, _CHAIN_AXIS, *[replicated] * 5)
    return Program(jax.shard_map(advance_on_device, mesh=mesh, in_specs=in_specs, out_specs=_CHAIN_AXIS,
                                 check_vma=False))
