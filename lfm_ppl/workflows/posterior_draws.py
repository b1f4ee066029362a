"""Draws of the posterior of a bound model: by chains, or about its mode.

1. Find the sampler and the starting points, or read what a resumed run found.
2. Run the chains, and constrain the points that they recorded. During the run a partial result is written.
3. Instead of both, find the posterior mode and draw from its Laplace approximation.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from lfm_ppl.forces.sde import ApproximationWarning
from lfm_ppl.inference import sampling
from lfm_ppl.inference.bound_model import BoundModel, StartError
from lfm_ppl.inference.degenerate_mode import degenerate_entries
from lfm_ppl.inference.laplace_start import NEGLIGIBLE_RISE
from lfm_ppl.inference.long_steps import EXPONENTIAL, long_step_messages
from lfm_ppl.inference.map import check_sites, mode_of
from lfm_ppl.inference.schedule import Schedule
from lfm_ppl.inference.start_failure import start_failure
from lfm_ppl.results import arviz_data
from lfm_ppl.storage.checkpoint import Checkpoint
from lfm_ppl.utils import checks
from lfm_ppl.utils.progress import waiting
from lfm_ppl.workflows.fit_options import FitOptions
from lfm_ppl.workflows.fit_results import (
    FitProblem,
    PosteriorDraws,
    PostProcessing,
    best_effort,
    build_result,
    write_result,
)
from lfm_ppl.workflows.fit_starts import FALLBACK, ChainStart, check_init, find_start

_MODE = "mode"
"""Name of the mode and its draws in the folder of a run."""

_ATTRIBUTES, _DRAWS = "attributes", "draws/"
"""Entry of the attributes among the arrays of a mode, and prefix of the entries of its draws."""

_MODE_SEARCH = "posterior mode: compiling and searching"
_START_SEARCH = "start: compiling and searching for starting points"


@contextlib.contextmanager
def explain_start_failure(bound: BoundModel) -> Iterator[None]:
    """Add the part of the density that fails at the prior median to the error of a failed search for a start."""
    try:
        yield
    except StartError as error:
        reason = best_effort("reason why there is nowhere to start", lambda: start_failure(bound), None)
        if reason is None:
            raise
        raise ValueError(f"{error} At the prior median, {reason}") from error


def find_chain_start(problem: FitProblem, store: Checkpoint | None, show_progress: bool) -> ChainStart:
    """Find the sampler and the starting points, or read what a resumed run found."""
    bound, options = problem.bound, problem.options
    setup = store.setup if store is not None and store.has_state else None
    text = _MODE_SEARCH if options.init in (None, "map") else _START_SEARCH
    with waiting(text, show_progress and setup is None):
        start = find_start(bound, options, setup)
    if show_progress and setup is None and FALLBACK in start.attributes:
        print(f"note     {start.attributes[FALLBACK]}", file=sys.stderr, flush=True)
    if show_progress:
        print(f"likelihood: {_likelihood_in_words(start, options)}", file=sys.stderr, flush=True)
    if start.points is not None:
        # With the steps of the model, the program that looked for stiffness is there already.
        has_new_steps = EXPONENTIAL in start.attributes or any(tuning.steps for tuning in start.tunings.values())
        _warn_of_long_steps(problem.with_bound(start.sampler.bound) if has_new_steps else problem,
                            start.points[0] if start.mode is None else start.mode)
    if store is not None and setup is None:
        store.setup = start.setup
    return start


def _likelihood_in_words(start: ChainStart, options: FitOptions) -> str:
    """Return the likelihood of the chains: what was tuned, and how the others are computed."""
    bound = start.sampler.bound
    if not start.tunings:
        return str(options.description(bound)["likelihood"])
    stiff_sites = json.loads(start.attributes.get(EXPONENTIAL, "[]"))
    words = {name: str(start.tunings.get(name, model.site.example.description))
             + (", exponential steps" if name in stiff_sites else "") for name, model in bound.site_models.items()}
    return "; ".join(f"{name}: {text}" if bound.is_by_site else text for name, text in words.items())


def sample_chains(problem: FitProblem, start: ChainStart, store: Checkpoint | None,
                  show_progress: bool) -> PosteriorDraws:
    """Run the chains; after Ctrl-C, return the finished draws.

    Raises:
        KeyboardInterrupt: there are no draws.
    """
    bound, options = problem.bound, problem.options
    assert options.thin is not None
    attributes = {**start.attributes, "thin": options.thin}
    if store is not None:
        store.write_partial = _partial_result_writer(problem, attributes, store)
    schedule = Schedule(start.attributes["warmup"] * options.thin, options.samples, options.thin, options.chain_method)
    chains = sampling.run_chains(options.keys["chains"], start.sampler, start.points, schedule, store, show_progress)
    count = chains.z.shape[1]
    if count == 0:
        raise KeyboardInterrupt(f"stopped in the warm-up, after {chains.done:,} of {chains.total:,} steps; there are "
                                "no draws yet")
    partial = _number_of_draws(count, options.samples) if chains.done < chains.total else None
    values, statistics = _constrained_draws(bound, {"z": chains.z, **chains.statistics}, options.samples)
    return PosteriorDraws(values, statistics, chains.z, attributes, start.particle_options, partial)


def _warn_of_long_steps(problem: FitProblem, z: np.ndarray) -> None:
    """Warn, before the sampling, of steps that are too long for a fast decay at the start or the mode z (d,)."""
    has_method = problem.options.sampler != "pmmh"
    messages = best_effort("check of the steps", lambda: long_step_messages(problem.bound, z, has_method), [])
    for message in messages:
        checks.warn(message, ApproximationWarning)


def _partial_result_writer(problem: FitProblem, attributes: dict[str, Any],
                           store: Checkpoint) -> Callable[[Mapping[str, np.ndarray]], None]:
    """Return the function that writes a result of the first draws during the run."""
    samples = problem.options.samples

    def write(rows: Mapping[str, np.ndarray]) -> None:
        values, statistics = _constrained_draws(problem.bound, rows, samples)
        draws = PosteriorDraws(values, statistics, None, attributes)
        partial = _number_of_draws(rows["z"].shape[1], samples)
        write_result(store, build_result(problem, draws, PostProcessing(), store, partial))

    return lambda rows: best_effort("partial result", lambda: write(rows), None)


def _number_of_draws(count: int, samples: int) -> str:
    return f"{count} of {samples} draws a chain, without scores and trajectories"


def _constrained_draws(bound: BoundModel, rows: Mapping[str, np.ndarray], samples: int) -> tuple[dict, dict]:
    """Return site name -> draws, and the statistics, from the rows that the chains recorded."""
    z = rows["z"]
    count = z.shape[1]
    # Padded to the full number of draws, so that one program serves every number.
    padded = np.concatenate([z, np.repeat(z[:, -1:], samples - count, axis=1)], axis=1)
    values = {site: draws[:, :count] for site, draws in bound.constrain_draws(padded).items()}
    statistics = {name: row for name, row in rows.items() if name != "z"} | {"lp": -rows["lp"]}
    if "n_steps" in statistics:
        statistics["tree_depth"] = np.ceil(np.log2(statistics["n_steps"] + 1)).astype(int)
    return values, statistics


def draw_about_mode(problem: FitProblem, store: Checkpoint | None, show_progress: bool) -> PosteriorDraws:
    """Return draws from the Laplace approximation at the posterior mode."""
    bound, options = problem.bound, problem.options
    if isinstance(options.init, Mapping):
        check_sites(bound, options.init)
    else:
        check_init(options.init)

    def compute() -> dict[str, Any]:
        init = None if isinstance(options.init, str) else options.init
        mode = mode_of(options.keys["mode"], bound, init=init, negligible_rise=NEGLIGIBLE_RISE)
        _warn_of_long_steps(problem, mode.mode)
        attributes = {"map_converged": int(mode.converged), "map_message": mode.message,
                      "map_log_density": float(mode.log_density), "log_evidence": float(mode.log_evidence),
                      arviz_data.MODE: json.dumps({name: value.tolist() for name, value in
                                                   {**mode.parameters, **mode.deterministic}.items()})}
        draws = mode.sample(options.keys["chains"], options.samples)
        degenerate = best_effort("check of the mode", lambda: degenerate_entries(bound, mode, draws), {})
        attributes |= {arviz_data.DEGENERATE: json.dumps(degenerate)} if degenerate else {}
        return {_ATTRIBUTES: np.asarray(json.dumps(attributes)),
                **{f"{_DRAWS}{name}": values for name, values in draws.items()}}

    with waiting(_MODE_SEARCH, show_progress and not (store is not None and store.has(_MODE))):
        arrays = compute() if store is None else store.get_or_compute(_MODE, compute)
    values = {name.removeprefix(_DRAWS): np.asarray(value)[None] for name, value in arrays.items()
              if name.startswith(_DRAWS)}
    return PosteriorDraws(values, {}, None, json.loads(str(arrays[_ATTRIBUTES])))
