"""The study: its settings, tasks and tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.engine.task import Task
from lfm_ppl.experiments import study
from lfm_ppl.experiments.chains import LENGTHS
from lfm_ppl.experiments.datasets import Column, TaskKind, merge_rows, rows
from lfm_ppl.experiments.ginzburg_landau import figures, parameters, problem, states
from lfm_ppl.experiments.scores import Estimate
from lfm_ppl.experiments.study import CHAINS, Data, Study, StudyTable, setting
from lfm_ppl.experiments.tasks import TaskFactory, slug, sort_by_dataset


@dataclass(frozen=True)
class GinzburgLandauSettings(study.StudySettings):
    """How much is computed."""

    realisations: int = setting(20, "for states and for MCMC", quick=2, aliases=study.REALISATIONS,
                                per_seed=problem.MOST)
    conditional: int = setting(100, "realisations for the conditional posteriors of single parameters", quick=4,
                               per_seed=problem.MOST)
    particles: int = setting(40_000, "of the filter, for states and in the figure of the conditional posteriors; the "
                             "source's", quick=500)
    smoother_particles: int = setting(1_000, "of the particle smoother", quick=200)
    smoother_draws: int = setting(200, "its trajectories", quick=50)
    conditional_particles: int = setting(4_000, "of the particle filter for the rates", quick=200)
    cells: int = setting(400, "of the grid", quick=160)
    draw_cells: int = setting(240, "of the grid for many parameter values", quick=120)
    nodes: int = setting(61, "parameter values of a conditional posterior", quick=31, least=4)
    paths: int = setting(100, "posterior draws over which the smoothed state is averaged", quick=10)
    marginal_particles: int = setting(1_000, "of particle-marginal RAM", quick=50)
    marginal_steps: int = setting(20, "of its particles between two observations", quick=10)
    ram: tuple[int, int, int] = setting((200, 500, 10), "RAM", quick=(50, 50, 5), parts=CHAINS[1:])
    nuts: tuple[int, int, int] = setting((250, 250, 1), "NUTS", quick=(20, 20, 1), parts=CHAINS[1:])
    pmmh: tuple[int, int, int] = setting((80, 240, 5), "particle-marginal RAM", quick=(10, 20, 2), parts=CHAINS[1:])
    tree_depth: int = setting(10, "largest of NUTS", quick=4)

    @property
    def figure(self) -> int:
        """The realisation of the figures: the model's default data where it is among those computed."""
        return problem.DEFAULT if min(self.realisations, self.conditional) > problem.DEFAULT else 0


def all_tasks(settings: GinzburgLandauSettings) -> list[Task]:
    """Return every task: all methods on the first realisations, then on the next.

    The figure of the conditional posteriors has a task of its own, with as many particles as the source.
    """
    tasks, count = TaskFactory("ginzburg-landau", settings.seed, digits=3), settings.realisations
    steps, particle_steps = {"steps": problem.STEPS}, {"steps": parameters.PARTICLE_STEPS}
    at_truth: dict[str, dict[str, Any]] = {
        problem.PARTICLES: {"particles": settings.particles, "smoother_particles": settings.smoother_particles,
                            "smoother_draws": settings.smoother_draws, **states.PARTICLE_STEPS},
        problem.GRID: {"cells": settings.cells, "marks": list(states.MARKS), "apart": states.APART}}
    likelihoods = {problem.PARTICLES: {"particles": settings.conditional_particles, **particle_steps},
                   problem.GRID: {"cells": settings.cells}}
    priors = {name: list(ends) for name, ends in parameters.INTERVALS.items()}
    posterior: dict[str, Any] = {"what": "conditional", "nodes": settings.nodes, "intervals": priors}
    found = [one for method in problem.METHODS for one in tasks.dataset_tasks(
        f"state/{slug(method)}", count, method=method, **at_truth.get(method, steps))]
    found += [one for method in problem.METHODS for one in tasks.block_tasks(
        f"conditional/{slug(method)}", settings.conditional, 10, method=method, **posterior,
        **likelihoods.get(method, steps))]
    found.append(tasks.task("conditional-figure/particle-filter", method=problem.PARTICLES, first=settings.figure,
                            last=settings.figure, particles=settings.particles, **particle_steps, **posterior))
    kernels = {"RAM": steps, "NUTS": steps | {"tree_depth": settings.tree_depth}, "PMMH": {
        "particles": settings.marginal_particles, "steps": settings.marginal_steps, "cells": settings.draw_cells}}
    for label, (kernel, _) in parameters.SAMPLERS.items():
        size = dict(zip(LENGTHS, (parameters.CHAINS, *getattr(settings, kernel.lower())), strict=True))
        found += tasks.dataset_tasks(f"mcmc/{slug(label)}", count, sampler=label, paths=settings.paths, **size,
                                     **kernels[kernel])
    return sort_by_dataset(found)


def tables(settings: GinzburgLandauSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    some, many = (f"{count} realisations" for count in (settings.realisations, settings.conditional))
    return {"comparison": StudyTable.from_rows(f"Means over {some} (standard errors)", comparison(data)),
            "rates": StudyTable.from_rows(f"Truth outside the 99% interval of a conditional posterior, {many}",
                                          rates(data)),
            "parameters": StudyTable.from_rows(f"Posteriors of the parameters, {some}", posteriors(data))}


def comparison(data: Data) -> dict[str, Any]:
    """Return scores of every method and sampler, with means over realisations.

    RMSE of filter and smoother over the fine times; the share of these times at which the 95% band holds the path; for
    MCMC the share of realisations in which the 95% interval of a parameter (all three pooled) holds the truth, the
    smallest bulk effective sample size of the three per second of CPU time of warm-up and draws, and the largest R-hat;
    CPU seconds, of all threads, for one realisation, without compilation.
    """
    smoother: dict[str, Column] = {"RMSE smoother": "smoother_rmse", "coverage smoother": "smoother_coverage"}
    empty = dict.fromkeys(("coverage parameters", "ESS/CPU s"), lambda one: Estimate(np.nan, np.nan))
    at_truth = {"RMSE filter": "filter_rmse", "coverage filter": "filter_coverage", **smoother, **empty,
                "CPU s": "seconds"}
    sampled = {
        **smoother, "coverage parameters": lambda one: _covered(one).mean("parameter"),
        "ESS/CPU s": lambda one: one.ess.min("parameter", skipna=False) / one.seconds, "CPU s": "seconds",
        "R-hat": lambda one: one.r_hat.max("parameter", skipna=False),
        "RMSE published": lambda one: parameters.PUBLISHED.get(one.sampler.item(), np.nan)}
    return {**rows(data["state"], "method", at_truth, "{}, true parameters"), **rows(data["mcmc"], "sampler", sampled)}


def rates(data: Data) -> dict[str, Any]:
    """Return how often the truth lies outside the central 99% interval of a conditional posterior.

    ``cut`` is the share of posteriors that an end of the flat prior's interval cuts off, ``differs`` the share of
    intervals that decide otherwise than the grid's.
    """
    found = parameters.outcomes(data["conditional"])
    exact = found.outside.sel({"method": problem.GRID})
    columns: dict[str, Column] = {
        "{parameter}": "outside", "pooled": lambda one: parameters.pooled(one.outside),
        "cut": lambda one: one.cut.mean(), "differs": lambda one: (one.outside != exact).mean(), "CPU s": "seconds"}
    return rows(found, "method", columns)


def posteriors(data: Data) -> dict[str, Any]:
    """Return posterior means and standard deviations by MCMC, averaged over realisations, and the coverage of each."""
    found = data["mcmc"].assign(coverage=_covered(data["mcmc"]))
    columns = {f"{name} {{parameter}}": name for name in ("mean", "sd", "coverage")}
    return {label: merge_rows(rows(found.sel(sampler=label), "parameter", columns))
            | {"divergences": float(found.divergences.sel(sampler=label).mean())} for label in parameters.SAMPLERS}


def _covered(one: xr.Dataset) -> xr.DataArray:
    return (one.low <= one.truth) & (one.truth <= one.high)


STUDY = Study(
    GinzburgLandauSettings, all_tasks,
    {"state": TaskKind(states.compute, {
        "dataset": "filter_rmse, filter_coverage, smoother_rmse, smoother_coverage, log_likelihood, seconds",
        "dataset time": "filter_mean, filter_low, filter_high, smoother_mean, smoother_low, smoother_high",
        "dataset cell": "x", "dataset mark": "marks", "dataset mark cell": "filter_density, smoother_density"},
        ("method",)),
     "conditional": TaskKind(parameters.conditional, {"member parameter node": "log_likelihood", "": "seconds"},
                             ("method", "first")),
     "conditional-figure": TaskKind(parameters.conditional, {"member parameter node": "log_likelihood"}),
     "mcmc": TaskKind(parameters.by_chains, {
         "dataset parameter": "mean, sd, low, high, ess, r_hat", "dataset": "divergences, seconds, smoother_rmse, "
         "smoother_coverage", "dataset time": "smoother_mean, smoother_low, smoother_high"}, ("sampler",))},
    tables, figures.draw, {"parameter": ("parameter", problem.NAMES), "truth": ("parameter", problem.TRUTH)},
    label="method", task_kind=lambda task: task.name.partition("/")[0])
