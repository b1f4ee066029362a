"""Post-processing of the draws of `lfm_ppl.fit`, and the result.

1. Score the observations under every draw, and replicate them.
2. Diagnose the likelihood: convergence of the factors, weights under constraints, resolution of the forces, and the
   error of the Gaussian approximation.
3. Draw a trajectory for some draws of each chain.
4. Lay out parameters, statistics, scores and trajectories as an ArviZ object with the attributes of the run.

A failure in steps 1 to 3 is a warning and leaves its group out: the draws took the time, and are never lost. Ctrl-C in
these steps leaves out the rest.
"""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lfm_ppl.accuracy.approximation import approximation_warnings, resolution_warnings
from lfm_ppl.accuracy.prior_conflict import prior_conflicts
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.factor_failures import factor_failures, failures_at, path_ess
from lfm_ppl.inference.samplers import GAUSSIAN_FILTER_SAMPLERS
from lfm_ppl.inference.trajectories import evenly_spaced, scores, trajectories
from lfm_ppl.io.data_set import Data
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.results import arviz_data
from lfm_ppl.results.inputs import remember
from lfm_ppl.results.layout import Labels, TrajectoryDraws, force_periods, lay_out
from lfm_ppl.results.predictions import SHOWN_PERIODS, repeats_often
from lfm_ppl.results.result_view import LIKELIHOODS
from lfm_ppl.results.sites import merge_sites
from lfm_ppl.storage.checkpoint import Checkpoint, is_finished
from lfm_ppl.storage.files import POSTERIOR
from lfm_ppl.storage.run_record import check_same
from lfm_ppl.utils.interruption import was_interrupt
from lfm_ppl.utils.progress import Console
from lfm_ppl.utils.random_keys import split_by_name
from lfm_ppl.workflows.fit_options import FitOptions, likelihood_settings, versions

ONLY_DRAWS = "all draws, without scores and trajectories"
"""Attribute ``partial`` of a result without any post-processing."""

_GRID_POINTS = 200
"""Number of grid points of trajectories where no times are requested; with a season, 16 a period and five times as many
at most."""

_SEASON_POINTS = 97
"""Number of points in the last periods of a force that repeats often."""


class ConvergenceWarning(UserWarning):
    """A diagnostic shows that the draws do not represent the posterior yet."""


@dataclass(frozen=True)
class SiteProblem:
    """A likelihood site with its data, and the labels of its groups of the result.

    Attributes:
        bound: the model with its data, without the fixed parameters, and with the site selected.
        labels: names of dimensions and entries.
        requested_times: times of the trajectories; None: a grid over the data.
        data: the data with known inputs; None where times and observations were passed themselves.
        clock: calendar time of t = 0 (None where times are plain numbers), and unit of time.
        truth: of simulated data.
        description: attributes on the likelihood of the site.
    """

    bound: BoundModel
    labels: Labels
    requested_times: Any = None
    data: Data | None = None
    clock: tuple[str | None, str] = (None, "")
    truth: Mapping[str, Any] | None = None
    description: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class FitProblem:
    """A model with its data, and the options of its fit.

    Attributes:
        bound: the model with its data, without the fixed parameters.
        sites: its likelihood sites by name.
        options: of the fit.
        description: attributes of the result that do not depend on the draws.
        user_attributes: further attributes; they replace others of the same name.
        start_time: of `time.perf_counter`.
    """

    bound: BoundModel
    sites: Mapping[str, SiteProblem]
    options: FitOptions
    description: dict[str, Any]
    user_attributes: dict[str, Any]
    start_time: float

    def with_bound(self, bound: BoundModel) -> FitProblem:
        """Return the same problem with other settings of its likelihoods, such as iterations that start at the mode."""
        sites = {name: replace(self.sites[name], bound=model, description={
            **self.sites[name].description, **likelihood_settings(model.site.example),
        }) for name, model in bound.site_models.items()}
        return replace(self, bound=bound, sites=sites, description=self.description | self.options.description(bound))


@dataclass(frozen=True)
class PosteriorDraws:
    """Draws of the parameters.

    Attributes:
        values: site -> (C, N, ...).
        statistics: statistic of the sampler -> (C, N).
        z: (C, N, d), unconstrained draws of the chains; None for "map".
        attributes: of the result, from the sampler.
        particle_options: keyword arguments of the particle smoother; empty for other samplers.
        partial: the number of draws where the run was stopped; None: all draws.
    """

    values: dict[str, np.ndarray]
    statistics: dict[str, np.ndarray]
    z: np.ndarray | None
    attributes: dict[str, Any]
    particle_options: dict[str, Any] = field(default_factory=dict)
    partial: str | None = None


@dataclass
class PostProcessing:
    """Quantities that are computed from the draws.

    Attributes:
        scores: of the observations by site, without the sites whose scores are not computed.
        trajectories: by site, see `draw_paths`.
        attributes: of the result.
        warnings: on the likelihood and the priors.
        partial: the groups that a result has after Ctrl-C; None: all.
    """

    scores: dict[str, Any] = field(default_factory=dict)
    trajectories: dict[str, TrajectoryDraws] = field(default_factory=dict)
    attributes: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    partial: str | None = None


def post_process(problem: FitProblem, draws: PosteriorDraws, store: Checkpoint | None,
                 show_progress: bool) -> PostProcessing:
    """Compute scores, diagnostics and trajectories; nothing for partial draws."""
    processed = PostProcessing()
    if draws.partial is not None:
        return processed
    if store is not None:  # the draws are safe, whatever happens below
        write_result(store, build_result(problem, draws, processed, store, ONLY_DRAWS))
    options = problem.options
    values = {site: draws.values[site].reshape(-1, *draws.values[site].shape[2:]) for site in problem.bound.sites}

    def batch_options(name: str) -> dict[str, Any]:
        return {"report": Console() if show_progress else None, "store": None if store is None else store.batches(name)}

    def label(text: str, name: str) -> str:
        return f"{text} of site {name}" if problem.bound.is_by_site else text

    def warn(name: str, messages: list[str]) -> None:
        processed.warnings += [f"site {name}: {text}" if problem.bound.is_by_site else text for text in messages]

    try:
        score_keys = split_by_name(options.keys["scores"], problem.sites)
        for name, site in problem.sites.items():
            processed.scores[name] = best_effort(label("scores of the observations", name), partial(
                scores, score_keys[name], site.bound, values, draws.particle_options.get("particle_settings"),
                draws.particle_options.get("particle_steps"), **batch_options(label("scores", name))), None)
        processed.attributes = _site_attributes(problem, draws, values)
        medians = {name: np.median(array, axis=0) for name, array in values.items()}
        at_medians = best_effort("model at the posterior medians", partial(problem.bound.trace_at, medians), {})
        processed.warnings += best_effort("comparison with the priors", partial(
            prior_conflicts, at_medians, medians), [])
        for name, site in problem.sites.items():
            if at_medians:
                warn(name, best_effort(label("resolution of the forces", name),
                                       partial(resolution_warnings, site.bound.site_of(at_medians)), []))
            if options.sampler in GAUSSIAN_FILTER_SAMPLERS:
                log_likelihood = _log_likelihood(site.bound, processed.scores[name])
                warn(name, best_effort(label("error of the likelihood", name), partial(
                    approximation_warnings, site.bound, values, log_likelihood), []))
        path_keys = split_by_name(options.keys["trajectories"], problem.sites)
        for name, site in problem.sites.items():
            processed.trajectories[name] = best_effort(label("trajectories", name), partial(
                draw_paths, path_keys[name], site.bound, draws.values, site.requested_times, options.trajectory_draws,
                **draws.particle_options, **batch_options(label("trajectories", name))), TrajectoryDraws())
    except KeyboardInterrupt:
        has_scores = all(processed.scores.get(name) is not None for name in problem.sites)
        processed.partial = "all draws and their scores, without trajectories" if has_scores else ONLY_DRAWS
    return processed


def _log_likelihood(bound: BoundModel, scores: Any) -> np.ndarray | None:
    """Return the log likelihood (S,) of each draw; None where it is not the sum of the scores."""
    if scores is None or isinstance(bound.site.example.model.observation, ObservationFamily):
        return None
    terms = scores["one_step_ahead"]
    return terms.reshape(len(terms), -1).sum(axis=1)


def _site_attributes(problem: FitProblem, draws: PosteriorDraws, values: Mapping[str, Any]) -> dict[str, str]:
    """Return attributes on the convergence of the factors and on the weights of constrained trajectories.

    Of several likelihood sites the one with the most failures, or the least weights, is reported.
    """
    options, z = problem.options, draws.z
    failures, weights = [], []
    for bound in (site.bound for site in problem.sites.values()):
        count_failures = None
        if options.sampler in GAUSSIAN_FILTER_SAMPLERS and z is not None:
            count_failures = partial(factor_failures, bound, z, options.seed)
        elif options.sampler == "map" and bound.site.example.constraints_in_words:
            count_failures = partial(failures_at, bound, values)
        if count_failures is not None:
            failures.append(best_effort("convergence of the factors", count_failures, None))
        weights.append(best_effort("weights under the constraints", partial(path_ess, bound, values), None))
    reports: dict[str, Any] = {
        arviz_data.FACTORS: max(filter(None, failures), key=lambda report: report.unconverged + report.impossible,
                                default=None),
        arviz_data.WEIGHTS: min(filter(None, weights), key=lambda report: report.least, default=None)}
    return {name: json.dumps(astuple(report)) for name, report in reports.items() if report is not None}


def draw_paths(key: jax.Array, bound: BoundModel, values: Mapping[str, np.ndarray], requested_times: Any, count: int,
               particle_settings: Any = None, particle_steps: int | None = None,
               **batch_options: Any) -> TrajectoryDraws:
    """Draw trajectories for draws that are spread evenly over each chain.

    Args:
        key: a JAX random key.
        bound: the model and its data.
        values: site -> draws of all chains (C, N, ...).
        requested_times: times of the trajectories; None: a grid over the data.
        count: number of trajectories.
        particle_settings: of the particle smoother; None: the Gaussian smoother.
        particle_steps: integration steps of the particles.
        **batch_options: ``report`` and ``store`` of `lfm_ppl.inference.trajectories.trajectories`.

    Returns:
        The trajectories (C, S, ...), with the draws of each chain and the times.
    """
    chains, samples = values[bound.sites[0]].shape[:2]
    draw_indices, rows = evenly_spaced(chains, samples, count)
    if not len(rows):
        return TrajectoryDraws(draw_indices)
    times = _trajectory_times(bound, requested_times)
    subset = {site: values[site].reshape(-1, *values[site].shape[2:])[rows] for site in bound.sites}
    paths = trajectories(key, bound, subset, times, particle_settings, particle_steps, **batch_options)
    if requested_times is None:
        paths.pop("prediction", None)  # stored at requested times only
    paths.pop("log_likelihood", None)
    by_chain = {name: path.reshape(chains, len(draw_indices), *path.shape[1:]) for name, path in paths.items()}
    return TrajectoryDraws(draw_indices, by_chain, times)


def _trajectory_times(bound: BoundModel, requested_times: Any) -> np.ndarray:
    """Return the times of the trajectories, (K,), or (B, K) on grids of series that have their own times."""
    if requested_times is not None:
        return np.atleast_1d(np.asarray(requested_times, float))
    model = bound.site.example.ssm.model
    periods = list(force_periods(model).values())
    if bound.times.ndim == 1:
        return _default_grid(bound.times, model.initial_time, periods)
    return pad_grids([_default_grid(times, model.initial_time, periods) for times in bound.times])


def pad_grids(grids: Sequence[np.ndarray]) -> np.ndarray:
    """Return the times of several series, (B, K), where shorter ones repeat their last time."""
    longest = max(map(len, grids))
    return np.array([np.pad(grid, (0, longest - len(grid)), "edge") for grid in grids])


def _default_grid(times: np.ndarray, initial_time: Any, periods: Sequence[float]) -> np.ndarray:
    """Return times that show a trajectory over the data of one series."""
    nodes = np.union1d(times[0] if initial_time is None else min(float(initial_time), times[0]), times)
    span = nodes[-1] - nodes[0]
    points = max([_GRID_POINTS, *(int(16 * span / period) for period in periods)])
    grid = subdivide(nodes, min(points, 5 * _GRID_POINTS))
    for period in periods:
        if repeats_often(period, span):
            grid = np.union1d(grid, np.linspace(times[-1] - SHOWN_PERIODS * period, times[-1], _SEASON_POINTS))
    return grid


def subdivide(nodes: np.ndarray, count: int) -> np.ndarray:
    """Return increasing nodes and times that divide each interval equally: ``count`` times or more.

    Between observations the band of a posterior is an arc. Points that divide the intervals equally show it; points on
    an equal grid over all of them would cut some arcs near the nodes.

    Example:
        >>> subdivide(np.array([0.0, 1.0, 5.0]), 6)
        array([0.  , 0.25, 0.5 , 0.75, 1.  , 2.  , 3.  , 4.  , 5.  ])
    """
    if len(nodes) < 2:
        return nodes
    gaps = np.diff(nodes)
    parts = np.maximum(np.ceil(gaps * (count - 1) / gaps.sum() * (1 - 1e-12)), np.clip(2 * count // len(nodes), 1, 4))
    return np.append(np.concatenate([start + gap * np.arange(number) / number
                                     for start, gap, number in zip(nodes, gaps, parts, strict=False)]), nodes[-1])


def build_result(problem: FitProblem, draws: PosteriorDraws, processed: PostProcessing, store: Checkpoint | None,
                 partial: str | None) -> Any:
    """Return the ArviZ object; ``partial`` describes what an incomplete result holds, None for a complete one."""
    seconds = time.perf_counter() - problem.start_time if store is None else store.seconds
    attributes = {
        **problem.description, "wall_time_s": round(seconds, 3), "versions": json.dumps(versions()),
        "created_at": datetime.now(UTC).isoformat(timespec="seconds"), **draws.attributes, **processed.attributes,
        "partial": partial, "run": None if store is None else store.record, **problem.user_attributes,
    }  # fmt: skip
    groups, site_attributes = lay_out_sites(problem.bound, problem.sites, draws.values, draws.statistics, processed)
    attributes |= site_attributes
    return arviz_data.build(groups, {name: value for name, value in attributes.items() if value is not None})


def lay_out_sites(bound: BoundModel, sites: Mapping[str, SiteProblem], values: dict[str, np.ndarray],
                  statistics: dict[str, np.ndarray],
                  processed: PostProcessing) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return groups and site attributes of a result, from ``values`` and ``statistics`` of `PosteriorDraws`."""
    groups: dict[str, dict[str, Any]] = {}
    attributes: dict[str, Any] = {}
    for name, site in sites.items():
        groups[name] = lay_out(site.bound, values, statistics, processed.scores.get(name),
                               processed.trajectories.get(name, TrajectoryDraws()), site.truth, site.labels)
        attributes |= remember(groups[name], site.data, *site.clock)
    if bound.is_by_site:
        settings = {name: {key: value for key, value in site.description.items() if value is not None}
                    for name, site in sites.items()}
        return merge_sites(groups), attributes | {LIKELIHOODS: json.dumps(settings)}
    (single,) = groups.values()
    return single, attributes


def write_result(store: Checkpoint, result: Any) -> None:
    """Write a result into the folder of the run."""
    arviz_data.save(result, store.folder / POSTERIOR, overwrite=True)


def best_effort(name: str, compute: Callable[[], Any], default: Any) -> Any:
    """Return ``compute()``; a failure is a warning and returns the default, so that the draws are not lost."""
    try:
        return compute()
    except Exception as error:
        if was_interrupt(error):
            raise KeyboardInterrupt from error
        reason = f"{type(error).__name__}: {error}"
        warnings.warn(f"the {name} could not be computed and are left out of the result: {reason}", stacklevel=3)
        return default


def note_warnings(result: Any, likelihood_warnings: Sequence[str] = ()) -> list[str]:
    """Store the warnings on convergence and likelihood in the attribute ``warnings``; return those on convergence."""
    convergence_warnings = arviz_data.convergence_warnings(result)
    result.attrs["warnings"] = json.dumps([*convergence_warnings, *likelihood_warnings])
    return convergence_warnings


def finished_result(folder: str | Path, record: Mapping[str, Any]) -> Any:
    """Return the result of a finished run; None for an unfinished one.

    Raises:
        ValueError: it is the result of another run; the message lists the differences.
    """
    path = Path(folder) / POSTERIOR
    if not is_finished(folder):
        return None
    result = arviz_data.load(path)
    run = result.attrs.get("run")
    if not isinstance(run, Mapping):
        raise ValueError(f"{path} has no record of its run, which cannot be resumed. Start a new run in another "
                         "folder.")
    check_same(folder, run, record)
    return result
