"""Functions of posterior draws, in batches, with one compilation for any number of draws.

1. A batch is a block of draws of one size; the last batch repeats the last draw.
2. The size of a batch follows from the numbers that the smoother holds for a draw. Several batches run side by side in
   threads, so many that all threads end together.
3. On a CPU the draws of a batch go in fours, which is faster than all at once (`lfm_ppl.utils.batching`). Draws whose
   number of steps follows a tolerance go one after another: side by side, each would take as many steps as the slowest.
4. Batches are stored when they are complete, and read again by a resumed run.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

import jax
import numpy as np

from lfm_ppl.filtering.integrators.integrator import Stepping
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.utils.batching import BATCH_SIZE, mapped, on_cpu, side_by_side, threads
from lfm_ppl.utils.programs import Program
from lfm_ppl.utils.progress import Progress, Reporter
from lfm_ppl.utils.random_keys import split_keys

_SEQUENTIAL_BATCH = 8
"""Draws in a batch of draws that go one after another."""

_BATCHES_PER_THREAD, _SMALLEST_SHARED_BATCH = 4, 16
"""Batches for each thread, so that all end together, and draws that such a batch has at least."""

_LARGEST_BATCH_SIZE, _ACCELERATOR_FACTOR = 2_000_000, 25
"""Numbers that the smoother may hold for batches side by side, and the factor for an accelerator.

More draws go one batch after another. Trajectories of 512 draws took 76 ms in one batch on a GPU, 300 ms in nine.
"""


class BatchStore(Protocol):
    """Stores batches of results by the index of their first draw."""

    def get(self, start: int) -> Any:
        """Return a batch; None if it is not stored."""

    def put(self, start: int, part: Any) -> None:
        """Store a batch, a pytree of dicts or an array."""

    def flush(self) -> None:
        """Write all stored batches."""


@dataclass(frozen=True)
class DrawFunction:
    """A function of a draw of the parameters, compiled once for all draws.

    Attributes:
        name: name of the computation, or a tuple of it and all that ``function`` depends on besides the model and its
            arguments: the key of the compiled function.
        function: maps site values, a random key and the arguments to a pytree of arrays.
        arguments: pytrees, of which the first is a `Problem`, ``bound.problem`` or ``bound.constants``; empty: the
            former alone.
    """

    name: str | tuple
    function: Callable
    arguments: Sequence[Any] = ()


def map_draws(bound: BoundModel, per_draw: DrawFunction, draws: Mapping[str, Any], key: jax.Array, *,
              rows: int | None = None, report: Reporter | None = None, store: BatchStore | None = None) -> Any:
    """Return ``function(values, key, *arguments)`` of a `DrawFunction` for all draws (S, ...).

    Args:
        bound: the model and its data y.
        per_draw: the function.
        draws: site name -> (S, ...).
        key: a JAX random key.
        rows: rows of the scan over time, which decide the size of a batch; None: one draw after another.
        report: target of the progress.
        store: stores the batches.
    """
    draws = {site: np.asarray(value) for site, value in draws.items()}
    count = next(iter(draws.values())).shape[0]
    example = bound.site.example
    is_adaptive = any(integrator.stepping is Stepping.ADAPTIVE for integrator in example.integrators)
    is_vectorized = rows is not None and not is_adaptive
    batch, parallel = _batch_size(count, rows, example.ssm.state_dim, is_vectorized)

    def sequential(draws: Any, keys: jax.Array, *arguments: Any) -> Any:
        return jax.lax.map(lambda pair: per_draw.function(*pair, *arguments), (draws, keys))

    def by_fours(draws: Any, keys: jax.Array, *arguments: Any) -> Any:
        return mapped(lambda draw, key: per_draw.function(draw, key, *arguments), draws, keys, batch_size=BATCH_SIZE)

    name, arguments = per_draw.name, per_draw.arguments or (bound.problem,)
    run = bound.program(("map draws", is_vectorized, name), lambda: Program(by_fours if is_vectorized else sequential),
                        arguments[0])
    keys = split_keys(key, count)

    def batch_arguments(start: int) -> tuple[dict[str, np.ndarray], jax.Array, *tuple[Any, ...]]:
        index = np.minimum(np.arange(start, start + batch), count - 1)  # full batches: one shape
        return {site: value[index] for site, value in draws.items()}, keys(index), *arguments

    starts = range(0, count, batch)
    stored = {start: None if store is None else store.get(start) for start in starts}
    # Stored batches of another size cannot be used.
    results = {start: part for start, part in stored.items()
               if part is not None and len(jax.tree.leaves(part)[0]) == batch}
    batches = [batch_arguments(start) for start in starts if start not in results]
    if len(batches) > 1 and parallel > 1:
        run = cast(Program, run).compile(*batches[0])
    computed = side_by_side(lambda *batch: jax.tree.map(np.asarray, run(*batch)), batches, parallel)
    label = name if isinstance(name, str) else name[0]
    with contextlib.closing(computed) as new, Progress(report, count, "draws", label) as progress:
        progress.start()
        progress.compile(f"compiling, and the first of {count:,} draws")
        for start in starts:
            if start not in results:
                results[start] = next(new)
                if store is not None:
                    store.put(start, results[start])
            progress.advance(min(start + batch, count))
    if store is not None:
        store.flush()
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *(results[start] for start in starts))


def _batch_size(count: int, rows: int | None, state_dim: int, is_vectorized: bool) -> tuple[int, int]:
    """Return the number of draws in a batch, and the number of batches side by side."""
    numbers_per_draw = (rows or 1) * state_dim**2 * 6
    limit = _LARGEST_BATCH_SIZE * (1 if on_cpu() else _ACCELERATOR_FACTOR) // max(numbers_per_draw, 1)
    # Draws of unknown size, or as large as a batch, run alone.
    parallel = 1 if rows is None else int(np.clip(limit, 1, threads()))
    if not is_vectorized:
        return _SEQUENTIAL_BATCH, parallel
    largest = int(np.clip(limit // parallel, 1, count))
    shared = min(_BATCHES_PER_THREAD * parallel, count // _SMALLEST_SHARED_BATCH) if parallel > 1 else 1
    batch = -(-count // max(-(-count // largest), shared))  # all of one size
    if batch > BATCH_SIZE:
        batch = -(-batch // BATCH_SIZE) * BATCH_SIZE
    return batch, parallel
