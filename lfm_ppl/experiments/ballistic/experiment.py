"""The study: its settings, tasks and tables."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy import stats

from lfm_ppl.engine.task import Task
from lfm_ppl.experiments import chains, study
from lfm_ppl.experiments.ballistic import figures
from lfm_ppl.experiments.ballistic.problem import TARGETS
from lfm_ppl.experiments.datasets import Column, TaskKind, row, rows, select_prefix
from lfm_ppl.experiments.scores import paired_ratio, sd_of
from lfm_ppl.experiments.simulated import parameters, states
from lfm_ppl.experiments.simulated.problem import MOST, true_z
from lfm_ppl.experiments.study import Data, Study, StudyTable, setting
from lfm_ppl.experiments.tasks import TaskFactory, slug, sort_by_dataset

REACH = 1.5
"""Of the grid about the true log alpha: a dozen posterior standard deviations wide."""

UNKNOWN = {"most likely parameters": "likely", "parameters integrated out": "posterior"}
ERRORS = {"RMSE {path} ({unit})": "rmse", "coverage {path}": "coverage", "CPU s": "seconds"}


@dataclass(frozen=True)
class BallisticSettings(study.StudySettings):
    """How much is computed."""

    runs: int = setting(500, "simulated targets", quick=4, aliases=study.REALISATIONS, per_seed=MOST)
    rules: tuple[str, ...] = setting(tuple(states.RULES), "linearisation; the model's own must be among them",
                                     quick=(states.REPORTED,), choices=tuple(states.RULES))
    particle_runs: int = setting(20, "of the targets, the first so many by particles, too", quick=2)
    particles: tuple[int, ...] = setting((500, 2_000, 10_000, 50_000), "their numbers; the source has 50,000",
                                         quick=(500,))
    chain_runs: int = setting(3, "of the targets, the first so many with NUTS and RAM, too", quick=1)
    drawn_runs: int = setting(500, "further targets, whose parameters are drawn from the prior", quick=2)
    draws: int = setting(1_000, "weighted draws of the parameters", quick=300)
    paths: int = setting(50, "draws over which the smoothed paths are averaged", quick=20)
    nuts: tuple[int, int, int, int] = setting((2, 300, 700, 1), "NUTS", quick=(2, 30, 30, 1), parts=study.CHAINS)
    ram: tuple[int, int, int, int] = setting((4, 100, 500, 15), "RAM", quick=(2, 50, 100, 5), parts=study.CHAINS)

    def __post_init__(self) -> None:
        """Check what a user gives."""
        super().__post_init__()
        if states.REPORTED not in self.rules:
            raise ValueError(f"rules must hold {states.REPORTED!r}, got {self.rules!r}.")


def all_tasks(settings: BallisticSettings) -> list[Task]:
    """Return every task."""
    few, chained = (min(settings.runs, count) for count in (settings.particle_runs, settings.chain_runs))
    tasks, weighted = TaskFactory("ballistic", settings.seed), {"draws": settings.draws, "paths": settings.paths}
    found = [*(one for rule in settings.rules
               for one in tasks.block_tasks(f"tracking/{slug(rule)}", settings.runs, 50, method=rule)),
             *tasks.block_tasks("parameters", settings.runs, 10, **weighted),
             *(one for count in settings.particles
               for one in tasks.dataset_tasks(f"particles/{count}", few, particles=count, steps=2, draws=4_000)),
             *(one for sampler in parameters.SAMPLERS for one in tasks.dataset_tasks(
                 f"chains/{sampler}", chained, sampler=sampler,
                 **dict(zip(chains.LENGTHS, getattr(settings, sampler.lower()), strict=True)))),
             *tasks.block_tasks("drawn", settings.drawn_runs, 10, **weighted),
             *tasks.block_tasks("known", settings.runs, 50)]
    return sort_by_dataset(found)


def tables(settings: BallisticSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    few, chained = (data[what].sizes["dataset"] for what in ("particles", "chains"))
    return {"tracking": StudyTable.from_rows(f"Means over {settings.runs} targets (standard errors)", tracked(data)),
            "particles": StudyTable.from_rows(f"Particles against the Gaussian filter and smoother, {few} targets",
                                              against_particles(data)),
            "parameters": StudyTable.from_rows(f"Parameters, in logarithms, {settings.runs} targets",
                                               of_parameters(data)),
            "agreement": StudyTable.from_rows(f"Against NUTS, {chained} targets", agreement(data))}


def tracked(data: Data) -> dict[str, Any]:
    """Return errors and coverage of each smoother over the measurement times, and CPU seconds without compilation.

    Where parameters are known the seconds are those of filter and smoother, else of searches and weights.
    """
    found = rows(select_prefix(data["tracking"], "smoother"), "method", ERRORS)
    for what, ending in (("parameters", ""), ("drawn", "; parameters drawn from the prior")):
        for label, name in UNKNOWN.items():
            errors = select_prefix(data[what], name).assign(seconds=data[what].seconds)
            found[f"{states.REPORTED}, {label}{ending}"] = row(errors, ERRORS)
    return found


def against_particles(data: Data) -> dict[str, Any]:
    """Return errors of the Gaussian filter and smoother and of particles on the same targets.

    ``ratio`` is the Gaussian's mean RMSE over that of particles, with the standard error of the paired differences. The
    log likelihood's difference has the filter's error in it, and the Monte Carlo error of particles. Traced paths pass
    through ``distinct`` particles at the first time.
    """
    particles = data["particles"]
    gaussian = data["tracking"].sel({"method": states.REPORTED}).isel(dataset=slice(particles.sizes["dataset"]))
    found: dict[str, Any] = {}
    for what, columns in (("filter", COMPARED), ("smoother", COMPARED | DISTINCT)):
        exact = select_prefix(gaussian, what).assign(log_likelihood=gaussian.log_likelihood)
        found[f"{what}, Gaussian"] = row(exact, {"RMSE {path} ({unit})": "rmse", "CPU s": "seconds"})
        both = select_prefix(particles, what).assign(particles[["log_likelihood", "distinct"]]).assign(
            {f"exact_{name}": exact[name] for name in ("rmse", "seconds", "log_likelihood")})
        found |= rows(both, "particles", columns, f"{what}, {{:,}} particles")
    return found


COMPARED: dict[str, Column] = {
    "RMSE {path} ({unit})": "rmse", "ratio {path}": lambda one: paired_ratio(one.exact_rmse, one.rmse),
    "CPU s": "seconds", "times as long": lambda one: one.seconds.mean() / one.exact_seconds.mean(),
    "log likelihood - Gaussian": lambda one: one.log_likelihood - one.exact_log_likelihood,
    "its sd": lambda one: sd_of(one.log_likelihood - one.exact_log_likelihood)}
DISTINCT: dict[str, Column] = {"distinct": lambda one: one.distinct.isel(time=0).mean()}
"""Columns of the table of particles."""


def of_parameters(data: Data) -> dict[str, Any]:
    """Return the truth, the maximum of the likelihood, and the posterior, in the logarithms of the parameters.

    ``maximum`` is the share of targets whose likelihood has one; ``coverage`` that of those whose central posterior
    intervals hold the truth: nominal for parameters drawn from the prior if the posterior is right, for one and the
    same truth as far as the data outweigh the prior. ``rank p`` is the p-value of Kolmogorov and Smirnov's test that
    the posterior probability of less than the truth is uniform over targets, ``k > 0.7`` the share of targets whose
    weights are not to be relied on.
    """
    most_likely: dict[str, Column] = {
        "truth": lambda one: true_z(TARGETS)[TARGETS.names.index(one.parameter)],
        "maximum": "exists", "most likely": lambda one: one.likely[one.exists],
        "its sd": lambda one: sd_of(one.likely[one.exists]), "posterior mean": "posterior_mean"}
    posterior: dict[str, Column] = {
        "posterior sd": "posterior_sd", **COVERED, "k > 0.7": lambda one: (one.k > 0.7).mean()}
    return {**rows(data["parameters"], "parameter", most_likely | posterior, "log {}"),
            **rows(data["drawn"], "parameter", posterior, "log {}, drawn from the prior"),
            "log alpha, the force's parameters known": row(data["known"], COVERED)}


def _coverage(level: float) -> Any:
    return lambda one: np.abs(one.below - 0.5) <= level / 2


COVERED: dict[str, Column] = {f"coverage {level:.0%}": _coverage(level) for level in parameters.LEVELS} | {
    "rank p": lambda one: stats.kstest(one.below, "uniform").pvalue}
"""Of posterior probabilities of less than the truth."""


def agreement(data: Data) -> dict[str, Any]:
    """Return how NUTS, RAM and weighted draws agree, see `chains.agreement`; chains' times are with compilation."""
    found, weighted = data["chains"], data["parameters"]
    samplers = {name: found.sel(sampler=name) for name in parameters.SAMPLERS}
    samplers["weighted draws"] = select_prefix(weighted, "posterior").assign(weighted[["k", "ess", "seconds"]]).isel(
        dataset=slice(found.sizes["dataset"]))
    return {name: chains.compare_with_reference(one, None if name == "NUTS" else samplers["NUTS"])
            for name, one in samplers.items()}


STUDY = Study(
    BallisticSettings, all_tasks,
    {"tracking": TaskKind(partial(states.gaussian, TARGETS), {
        "dataset path": "filter_rmse, smoother_rmse, smoother_coverage", "path time": "mean, sd",
        "dataset": "log_likelihood, filter_seconds, smoother_seconds"}, ("method",)),
     "particles": TaskKind(partial(states.particles, TARGETS), {
         "dataset path": "filter_rmse, smoother_rmse, smoother_coverage", "dataset path time": "mean, sd",
         "dataset": "log_likelihood, filter_seconds, smoother_seconds", "dataset time": "distinct"}, ("particles",)),
     **{what: TaskKind(partial(parameters.weighted, TARGETS, drawn=what == "drawn"), {
         "dataset parameter": "likely, posterior_mean, posterior_sd, below", "dataset": "exists, k, ess, seconds",
         "dataset path": "likely_rmse, likely_coverage, posterior_rmse, posterior_coverage", "parameter draw": "draws"})
        for what in ("parameters", "drawn")},
     "known": TaskKind(partial(parameters.alone, TARGETS, REACH), {"dataset": "below"}),
     "chains": TaskKind(partial(parameters.by_chains, TARGETS), {
         "dataset parameter": "mean, sd, ess, r_hat", "dataset": "seconds, divergences",
         "dataset parameter chain draw": "draws"}, ("sampler",))},
    tables, figures.draw, {"path": ("path", TARGETS.paths), "unit": ("path", TARGETS.units),
                           "parameter": ("parameter", TARGETS.names)})
