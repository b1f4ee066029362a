"""The study of targets on reentry: settings, tasks and tables.

1. Track every target with each linearisation rule, at the true parameters (kind ``tracking``).
2. Track the first targets with particle filters and smoothers of increasing size (``particles``).
3. Estimate the parameters of every target by maximum likelihood and by importance sampling (``parameters``), and again
   for targets whose parameters are drawn from the prior (``drawn``).
4. Sample the posteriors of the first targets by NUTS and RAM (``chains``).
5. Compute the posterior of the drag with the other parameters known (``known``).

Source: Hartikainen, Seppanen and Sarkka (ICML 2012), section 5.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy import stats

from lfm_ppl.parallel.task import Task

from .. import chains
from ..datasets import Column, TaskKind, row, rows, select_prefix
from ..declaration import CHAINS, REALISATIONS, Data, Study, StudySettings, StudyTable, setting
from ..scores import paired_ratio, sample_sd
from ..tasks import TaskFactory, slug, sort_by_dataset
from . import figures, parameters, states
from .problem import NAMES, PATHS, RECORDS_PER_SEED, true_z

UNKNOWN = {"most likely parameters": "likely", "parameters integrated out": "posterior"}
"""Label of a smoother with unknown parameters -> prefix of its entries."""

ERRORS = {"RMSE {path} ({unit})": "rmse", "coverage {path}": "coverage", "CPU s": "seconds"}
"""Columns of the table of smoothers."""


@dataclass(frozen=True)
class BallisticSettings(StudySettings):
    """Sizes of the study."""

    runs: int = setting(500, "simulated targets", quick=4, aliases=REALISATIONS, per_seed=RECORDS_PER_SEED)
    rules: tuple[str, ...] = setting(tuple(states.RULES), "linearisation rules; must include the model's default",
                                     quick=(states.DEFAULT_RULE,), choices=tuple(states.RULES))
    particle_runs: int = setting(20, "targets that particles track as well, from the first on", quick=2)
    particles: tuple[int, ...] = setting((500, 2_000, 10_000, 50_000), "numbers of particles; the source has 50,000",
                                         quick=(500,))
    chain_runs: int = setting(3, "targets with posteriors by NUTS and RAM as well, from the first on", quick=1)
    drawn_runs: int = setting(500, "further targets with parameters drawn from the prior", quick=2)
    draws: int = setting(1_000, "importance samples of the parameters", quick=300)
    paths: int = setting(50, "draws over which the smoothed paths are averaged", quick=20)
    nuts: tuple[int, int, int, int] = setting((2, 300, 700, 1), "NUTS", quick=(2, 30, 30, 1), parts=CHAINS)
    ram: tuple[int, int, int, int] = setting((4, 100, 500, 15), "RAM", quick=(2, 50, 100, 5), parts=CHAINS)

    def __post_init__(self) -> None:
        """Check that the rules include the default one, which the other comparisons use."""
        super().__post_init__()
        if states.DEFAULT_RULE not in self.rules:
            raise ValueError(f"rules must hold {states.DEFAULT_RULE!r}, got {self.rules!r}.")


def all_tasks(settings: BallisticSettings) -> list[Task]:
    """Return all tasks, sorted by data set."""
    particle_runs, chain_runs = (min(settings.runs, count) for count in (settings.particle_runs, settings.chain_runs))
    factory, sizes = TaskFactory("ballistic", settings.seed), {"draws": settings.draws, "paths": settings.paths}
    tasks: list[Task] = []
    for rule in settings.rules:
        tasks += factory.block_tasks(f"tracking/{slug(rule)}", settings.runs, 50, method=rule)
    tasks += factory.block_tasks("parameters", settings.runs, 10, **sizes)
    for count in settings.particles:
        tasks += factory.dataset_tasks(f"particles/{count}", particle_runs, particles=count, steps=2, draws=4_000)
    for sampler in parameters.SAMPLERS:
        lengths = dict(zip(chains.LENGTHS, getattr(settings, sampler.lower()), strict=True))
        tasks += factory.dataset_tasks(f"chains/{sampler}", chain_runs, sampler=sampler, **lengths)
    tasks += factory.block_tasks("drawn", settings.drawn_runs, 10, **sizes)
    tasks += factory.block_tasks("known", settings.runs, 50)
    return sort_by_dataset(tasks)


def tables(settings: BallisticSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    particle_runs, chain_runs = (data[kind].sizes["dataset"] for kind in ("particles", "chains"))
    return {"tracking": StudyTable.from_rows(f"Means over {settings.runs} targets (standard errors)",
                                             compare_smoothers(data)),
            "particles": StudyTable.from_rows(
                f"Particles against the Gaussian filter and smoother, {particle_runs} targets",
                compare_with_particles(data)),
            "parameters": StudyTable.from_rows(f"Parameters, in logarithms, {settings.runs} targets",
                                               summarize_parameters(data)),
            "agreement": StudyTable.from_rows(f"Against NUTS, {chain_runs} targets", agreement(data))}


def compare_smoothers(data: Data) -> dict[str, Any]:
    """Return errors and coverage of each smoother over the measurement times, and CPU seconds without compilation.

    With known parameters the CPU time is that of filter and smoother, otherwise that of searches and weights.
    """
    table = rows(select_prefix(data["tracking"], "smoother"), "method", ERRORS)
    for kind, ending in (("parameters", ""), ("drawn", "; parameters drawn from the prior")):
        for label, prefix in UNKNOWN.items():
            errors = select_prefix(data[kind], prefix).assign(seconds=data[kind].seconds)
            table[f"{states.DEFAULT_RULE}, {label}{ending}"] = row(errors, ERRORS)
    return table


def compare_with_particles(data: Data) -> dict[str, Any]:
    """Return errors of the Gaussian filter and smoother and of particles, on the same targets.

    ``ratio`` is the Gaussian smoother's mean RMSE over that of particles, with the standard error of paired
    differences. The difference of log likelihoods contains the error of the Gaussian filter and the Monte Carlo error
    of particles. ``distinct`` is the number of distinct particles on the traced paths at the first time.
    """
    particles = data["particles"]
    gaussian = data["tracking"].sel({"method": states.DEFAULT_RULE}).isel(dataset=slice(particles.sizes["dataset"]))
    table: dict[str, Any] = {}
    for kind, columns in (("filter", PARTICLE_FILTER), ("smoother", PARTICLE_FILTER | DISTINCT)):
        exact = select_prefix(gaussian, kind).assign(log_likelihood=gaussian.log_likelihood)
        table[f"{kind}, Gaussian"] = row(exact, {"RMSE {path} ({unit})": "rmse", "CPU s": "seconds"})
        paired = select_prefix(particles, kind).assign(particles[["log_likelihood", "distinct"]]).assign(
            {f"exact_{name}": exact[name] for name in ("rmse", "seconds", "log_likelihood")})
        table |= rows(paired, "particles", columns, f"{kind}, {{:,}} particles")
    return table


PARTICLE_FILTER: dict[str, Column] = {
    "RMSE {path} ({unit})": "rmse", "ratio {path}": lambda paired: paired_ratio(paired.exact_rmse, paired.rmse),
    "CPU s": "seconds", "times as long": lambda paired: paired.seconds.mean() / paired.exact_seconds.mean(),
    "log likelihood - Gaussian": lambda paired: paired.log_likelihood - paired.exact_log_likelihood,
    "its sd": lambda paired: sample_sd(paired.log_likelihood - paired.exact_log_likelihood)}
"""Columns of the table of particles."""

DISTINCT: dict[str, Column] = {"distinct": lambda paired: paired.distinct.isel(time=0).mean()}
"""Further columns for smoothers."""


def summarize_parameters(data: Data) -> dict[str, Any]:
    """Return truth, maximum of the likelihood and posterior, in the logarithms of the parameters.

    ``maximum`` is the share of targets whose likelihood has a maximum. ``coverage`` is the share of targets whose
    central posterior interval contains the truth. A correct posterior has nominal coverage for parameters drawn from
    the prior, and for a fixed truth as far as the data outweigh the prior. ``rank p`` is the p-value of the
    Kolmogorov-Smirnov test that the posterior probability of values below the truth is uniform over targets.
    ``k > 0.7`` is the share of targets with unreliable weights.
    """
    most_likely: dict[str, Column] = {
        "truth": lambda targets: true_z()[NAMES.index(targets.parameter)],
        "maximum": "exists", "most likely": lambda targets: targets.likely[targets.exists],
        "its sd": lambda targets: sample_sd(targets.likely[targets.exists]), "posterior mean": "posterior_mean"}
    posterior: dict[str, Column] = {
        "posterior sd": "posterior_sd", **COVERAGE, "k > 0.7": lambda targets: (targets.k > 0.7).mean()}
    return {**rows(data["parameters"], "parameter", most_likely | posterior, "log {}"),
            **rows(data["drawn"], "parameter", posterior, "log {}, drawn from the prior"),
            "log alpha, the force's parameters known": row(data["known"], COVERAGE)}


def _coverage(level: float) -> Any:
    return lambda targets: np.abs(targets.below - 0.5) <= level / 2


COVERAGE: dict[str, Column] = {f"coverage {level:.0%}": _coverage(level) for level in parameters.LEVELS} | {
    "rank p": lambda targets: stats.kstest(targets.below, "uniform").pvalue}
"""Columns that follow from posterior probabilities of values below the truth."""


def agreement(data: Data) -> dict[str, Any]:
    """Return the agreement of NUTS, RAM and weighted draws; CPU times of chains include compilation."""
    chain_data, weighted = data["chains"], data["parameters"]
    samplers = {name: chain_data.sel(sampler=name) for name in parameters.SAMPLERS}
    samplers["weighted draws"] = select_prefix(weighted, "posterior").assign(weighted[["k", "ess", "seconds"]]).isel(
        dataset=slice(chain_data.sizes["dataset"]))
    return {name: chains.compare_with_reference(posteriors, None if name == "NUTS" else samplers["NUTS"])
            for name, posteriors in samplers.items()}


KINDS = {
    "tracking": TaskKind(states.run_gaussian, {
        "dataset path": "filter_rmse, smoother_rmse, smoother_coverage", "path time": "mean, sd",
        "dataset": "log_likelihood, filter_seconds, smoother_seconds"}, ("method",)),
    "particles": TaskKind(states.run_particles, {
        "dataset path": "filter_rmse, smoother_rmse, smoother_coverage", "dataset path time": "mean, sd",
        "dataset": "log_likelihood, filter_seconds, smoother_seconds", "dataset time": "distinct"}, ("particles",)),
    **{kind: TaskKind(partial(parameters.estimate_targets, from_prior=kind == "drawn"), {
        "dataset parameter": "likely, posterior_mean, posterior_sd, below", "dataset": "exists, k, ess, seconds",
        "dataset path": "likely_rmse, likely_coverage, posterior_rmse, posterior_coverage", "parameter draw": "draws"})
       for kind in ("parameters", "drawn")},
    "known": TaskKind(parameters.rank_targets, {"dataset": "below"}),
    "chains": TaskKind(parameters.sample_chains, {
        "dataset parameter": "mean, sd, ess, r_hat", "dataset": "seconds, divergences",
        "dataset parameter chain draw": "draws"}, ("sampler",)),
}

STUDY = Study(BallisticSettings, all_tasks, KINDS, tables, figures.draw, {
    "path": ("path", tuple(PATHS)), "unit": ("path", tuple(PATHS.values())), "parameter": ("parameter", NAMES)})
