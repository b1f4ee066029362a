"""The study of the double well: settings, tasks and tables.

1. At the true parameters, filter and smooth every realisation by each method (kind ``state``).
2. For each parameter, evaluate the likelihood on a grid with the other two at the truth (kind ``conditional``).
3. Sample all three parameters by MCMC, and marginalise them from the smoothed state (kind ``mcmc``).
4. Compare errors, coverage and CPU times of methods and samplers in tables.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.parallel.task import Task

from ..chains import LENGTHS
from ..datasets import Column, TaskKind, merge_rows, rows
from ..declaration import CHAINS, REALISATIONS, Data, Study, StudySettings, StudyTable, setting
from ..scores import Estimate
from ..tasks import TaskFactory, slug, sort_by_dataset
from . import figures, parameters, problem, states


@dataclass(frozen=True)
class GinzburgLandauSettings(StudySettings):
    """Sizes of the study."""

    realisations: int = setting(20, "realisations for states and for MCMC", quick=2, aliases=REALISATIONS,
                                per_seed=problem.MAX_REALISATIONS)
    conditional: int = setting(100, "realisations for the conditional posteriors of single parameters", quick=4,
                               per_seed=problem.MAX_REALISATIONS)
    particles: int = setting(40_000, "particles of the filter, for states and for the figure of conditional "
                             "posteriors; the source's number", quick=500)
    smoother_particles: int = setting(1_000, "particles of the particle smoother", quick=200)
    smoother_draws: int = setting(200, "trajectories of the particle smoother", quick=50)
    conditional_particles: int = setting(4_000, "particles of the filter for conditional posteriors", quick=200)
    cells: int = setting(400, "cells of the grid", quick=160)
    draw_cells: int = setting(240, "cells of the grid for many parameter values", quick=120)
    nodes: int = setting(61, "parameter values of a conditional posterior", quick=31, least=4)
    paths: int = setting(100, "posterior draws in the average of the smoothed state", quick=10)
    marginal_particles: int = setting(1_000, "particles of particle-marginal RAM", quick=50)
    marginal_steps: int = setting(20, "steps of these particles between two observations", quick=10)
    ram: tuple[int, int, int] = setting((200, 500, 10), "RAM", quick=(50, 50, 5), parts=CHAINS[1:])
    nuts: tuple[int, int, int] = setting((250, 250, 1), "NUTS", quick=(20, 20, 1), parts=CHAINS[1:])
    pmmh: tuple[int, int, int] = setting((80, 240, 5), "particle-marginal RAM", quick=(10, 20, 2), parts=CHAINS[1:])
    tree_depth: int = setting(10, "largest tree depth of NUTS", quick=4)

    @property
    def figure(self) -> int:
        """Index of the realisation in the figures: the model's default data if the study includes them."""
        return problem.DEFAULT if min(self.realisations, self.conditional) > problem.DEFAULT else 0


def all_tasks(settings: GinzburgLandauSettings) -> list[Task]:
    """Return all tasks, sorted by realisation.

    The figure of the conditional posteriors has a separate task, with the source's number of particles.
    """
    factory, count = TaskFactory("ginzburg-landau", settings.seed, digits=3), settings.realisations
    steps, particle_steps = {"steps": problem.STEPS}, {"steps": parameters.PARTICLE_STEPS}
    at_truth: dict[str, dict[str, Any]] = {
        problem.PARTICLES: {"particles": settings.particles, "smoother_particles": settings.smoother_particles,
                            "smoother_draws": settings.smoother_draws, **states.PARTICLE_STEPS},
        problem.GRID: {"cells": settings.cells, "marks": list(states.MARKS), "apart": states.APART}}
    likelihoods = {problem.PARTICLES: {"particles": settings.conditional_particles, **particle_steps},
                   problem.GRID: {"cells": settings.cells}}
    priors = {name: list(bounds) for name, bounds in parameters.INTERVALS.items()}
    posterior: dict[str, Any] = {"what": "conditional", "nodes": settings.nodes, "intervals": priors}
    tasks = [task for method in problem.METHODS for task in factory.dataset_tasks(
        f"state/{slug(method)}", count, method=method, **at_truth.get(method, steps))]
    tasks += [task for method in problem.METHODS for task in factory.block_tasks(
        f"conditional/{slug(method)}", settings.conditional, 10, method=method, **posterior,
        **likelihoods.get(method, steps))]
    tasks.append(factory.task("conditional-figure/particle-filter", method=problem.PARTICLES, first=settings.figure,
                              last=settings.figure, particles=settings.particles, **particle_steps, **posterior))
    kernels = {"RAM": steps, "NUTS": steps | {"tree_depth": settings.tree_depth}, "PMMH": {
        "particles": settings.marginal_particles, "steps": settings.marginal_steps, "cells": settings.draw_cells}}
    for label, (kernel, _) in parameters.SAMPLERS.items():
        size = dict(zip(LENGTHS, (parameters.CHAINS, *getattr(settings, kernel.lower())), strict=True))
        tasks += factory.dataset_tasks(f"mcmc/{slug(label)}", count, sampler=label, paths=settings.paths, **size,
                                       **kernels[kernel])
    return sort_by_dataset(tasks)


def tables(settings: GinzburgLandauSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    realisations = f"{settings.realisations} realisations"
    return {"comparison": StudyTable.from_rows(f"Means over {realisations} (standard errors)", comparison_rows(data)),
            "rates": StudyTable.from_rows("Truth outside the 99% interval of a conditional posterior, "
                                          f"{settings.conditional} realisations", rate_rows(data)),
            "parameters": StudyTable.from_rows(f"Posteriors of the parameters, {realisations}", posterior_rows(data))}


def comparison_rows(data: Data) -> dict[str, Any]:
    """Return mean scores of every method and sampler over realisations.

    Scores of paths are the RMSE of filter and smoother over the fine times, and the share of these times at which the
    95% band contains the path. Scores of MCMC are the coverage of 95% intervals (all three parameters pooled), the
    smallest bulk effective sample size per CPU second of warm-up and draws, and the largest R-hat. CPU seconds
    are summed over all threads for one realisation, without compilation.
    """
    smoother: dict[str, Column] = {"RMSE smoother": "smoother_rmse", "coverage smoother": "smoother_coverage"}
    empty = dict.fromkeys(("coverage parameters", "ESS/CPU s"), lambda realisations: Estimate(np.nan, np.nan))
    at_truth = {"RMSE filter": "filter_rmse", "coverage filter": "filter_coverage", **smoother, **empty,
                "CPU s": "seconds"}
    sampled = {
        **smoother, "coverage parameters": lambda chains: _is_covered(chains).mean("parameter"),
        "ESS/CPU s": lambda chains: chains.ess.min("parameter", skipna=False) / chains.seconds, "CPU s": "seconds",
        "R-hat": lambda chains: chains.r_hat.max("parameter", skipna=False),
        "RMSE published": lambda chains: parameters.PUBLISHED.get(chains.sampler.item(), np.nan)}
    return {**rows(data["state"], "method", at_truth, "{}, true parameters"), **rows(data["mcmc"], "sampler", sampled)}


def rate_rows(data: Data) -> dict[str, Any]:
    """Return the share of conditional posteriors whose central 99% interval does not contain the truth.

    ``cut`` is the share of posteriors that the bounds of the flat prior truncate. ``differs`` is the share of intervals
    that contain the truth while the grid's does not, or the reverse.
    """
    dataset = parameters.outcomes(data["conditional"])
    exact = dataset.outside.sel({"method": problem.GRID})
    columns: dict[str, Column] = {
        "{parameter}": "outside", "pooled": lambda posteriors: parameters.pooled_rate(posteriors.outside),
        "cut": lambda posteriors: posteriors.cut.mean(),
        "differs": lambda posteriors: (posteriors.outside != exact).mean(), "CPU s": "seconds"}
    return rows(dataset, "method", columns)


def posterior_rows(data: Data) -> dict[str, Any]:
    """Return posterior means and standard deviations by MCMC, averaged over realisations, and coverage."""
    dataset = data["mcmc"].assign(coverage=_is_covered(data["mcmc"]))
    columns = {f"{name} {{parameter}}": name for name in ("mean", "sd", "coverage")}
    return {label: merge_rows(rows(dataset.sel(sampler=label), "parameter", columns))
            | {"divergences": float(dataset.divergences.sel(sampler=label).mean())} for label in parameters.SAMPLERS}


def _is_covered(dataset: xr.Dataset) -> xr.DataArray:
    return (dataset.low <= dataset.truth) & (dataset.truth <= dataset.high)


STUDY = Study(
    GinzburgLandauSettings, all_tasks,
    {"state": TaskKind(states.compute, {
        "dataset": "filter_rmse, filter_coverage, smoother_rmse, smoother_coverage, log_likelihood, seconds",
        "dataset time": "filter_mean, filter_low, filter_high, smoother_mean, smoother_low, smoother_high",
        "dataset cell": "x", "dataset mark": "marks", "dataset mark cell": "filter_density, smoother_density"},
        ("method",)),
     "conditional": TaskKind(parameters.conditional_likelihoods, {
         "member parameter node": "log_likelihood", "": "seconds"}, ("method", "first")),
     "conditional-figure": TaskKind(parameters.conditional_likelihoods, {"member parameter node": "log_likelihood"}),
     "mcmc": TaskKind(parameters.sample_posterior, {
         "dataset parameter": "mean, sd, low, high, ess, r_hat", "dataset": "divergences, seconds, smoother_rmse, "
         "smoother_coverage", "dataset time": "smoother_mean, smoother_low, smoother_high"}, ("sampler",))},
    tables, figures.draw, {"parameter": ("parameter", problem.NAMES), "truth": ("parameter", problem.TRUTH)},
    label="method", task_kind=lambda task: task.name.partition("/")[0])
