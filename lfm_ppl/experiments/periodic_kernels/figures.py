"""Covariance functions, eigenfunctions, draws, errors by the number of functions, and a predicted function."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.drawing import TRUTH, band, legend
from lfm_ppl.experiments.periodic_kernels import covariance, problem, regression
from lfm_ppl.forces import (
    CQM,
    SQM,
    WQM,
    Force,
    Periodic,
    PeriodicSquaredExponential,
    QuasiPeriodic,
    SparseSpectrum,
    change_points,
    random_frequencies,
)
from lfm_ppl.results.plots import style

_LINES = {covariance.EIGENFUNCTIONS: (style.BLUE, "-", "o"), covariance.RESONATORS: (style.GREEN, "--", "s"),
          covariance.RANDOM: (style.VERMILLION, "-.", "^")}


def draw(settings: Any, results: dict[str, Result]) -> dict[str, Figure]:
    """Return every figure by name."""
    return {"errors": plot_errors(settings, results), "covariances": plot_covariances(settings),
            "eigenfunctions": plot_eigenfunctions(), "draws": plot_draws(settings),
            "prediction": plot_prediction(settings, results)}


@style.styled
def plot_errors(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the largest error of the covariance function against the number of functions, for each kernel."""
    figure = style.new_figure(width, 3.8)
    panels = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
    own = [task for task in covariance.tasks(settings) if task.settings["what"] == "covariance"]
    for axes, task in zip(panels, own, strict=True):
        for method, (colour, line, marker) in _LINES.items():
            axes.loglog(settings.functions, np.maximum(results[task.name][method], 1e-16), line, color=colour,
                        marker=marker, ms=3, mfc="none" if method == covariance.RESONATORS else colour, label=method)
        axes.set_title(task.settings["kernel"].replace("_", "/"), fontsize=style.SMALL)
        axes.tick_params(labelsize=style.SMALL)
        axes.set_ylim(1e-13, 3.0)
    for axes in panels[3:]:
        axes.set_xlabel("functions")
    for axes in panels[::3]:
        axes.set_ylabel("largest error")
    legend(figure)
    return figure


@style.styled
def plot_covariances(settings: Any, *, width: str | float = "full") -> Figure:
    """Draw the squared exponential of scale 10 and what 22 functions, or 22 and 88 frequencies, make of it."""
    at = problem.grid(problem.window_kernel())
    figure, panels = style.in_a_row(width, 3, 2.4, sharey=True)
    exact = np.asarray(problem.window_prior().covariance(at))
    chosen: dict[str, Force] = {regression.KPCA: covariance.eigenfunctions(problem.window_kernel(), 22)}
    for label, count in ((regression.SPARSE, 22), (regression.SPARSE_4, 88)):
        key = jax.random.fold_in(jax.random.key(settings.seed), count)
        chosen[label] = SparseSpectrum(1.0, random_frequencies(key, problem.window_prior(), count))
    for axes, (label, force) in zip(panels, chosen.items(), strict=True):
        axes.plot(at, exact, color=style.BLACK, lw=0.8, label="squared exponential, scale 10")
        axes.plot(at, np.asarray(force.sde_covariance(at, 0.0)), "--", color=style.BLUE, label="approximation")
        axes.set_title(label, fontsize=style.SMALL)
        axes.set_xlabel("distance in time")
        style.tidy(axes)
    panels[0].set_ylabel("covariance")
    legend(figure)
    return figure


@style.styled
def plot_eigenfunctions(*, width: str | float = "full") -> Figure:
    """Draw the first eigenfunctions of a stationary kernel and of one that is not (figure 2 of the source)."""
    figure, panels = style.in_a_row(width, 2, 2.4, sharey=True)
    t = np.linspace(0.0, 2 * problem.PERIOD, 401)
    every = problem.kernels()
    for axes, name in zip(panels, ("periodic Matern-3_2", "moderated periodic Matern-3_2"), strict=True):
        force = Periodic(every[name], functions=3, explained_variance=0.0)
        looks = ((style.BLUE, "-", "first"), (style.VERMILLION, "--", "second"), (style.GREEN, "-.", "third"))
        for values, (colour, line, label) in zip(np.asarray(force.eigenfunctions(t)).T, looks, strict=True):
            axes.plot(t, values * np.sign(values[20] + 1e-9), color=colour, ls=line, label=label)
        axes.set_title(name.replace("_", "/"), fontsize=style.SMALL)
        axes.set_xlabel("time (period 10)")
        style.tidy(axes)
    panels[0].set_ylabel("eigenfunction")
    legend(figure)
    return figure


@style.styled
def plot_draws(settings: Any, *, width: str | float = "full") -> Figure:
    """Draw covariance functions and a force of each way in which weights may change (figure 5 of the source)."""
    kernel = PeriodicSquaredExponential(1.0, 1.0, problem.PERIOD)
    steps = change_points(problem.PERIOD, 0.0, 60.0)
    chosen = {"CQM, lengthscale 20": CQM(20.0), "SQM, lengthscale 2": SQM(2.0, steps),
              "WQM, growth 0.5": WQM(0.5, steps)}
    t = np.linspace(0.0, 60.0, 301)
    figure = style.new_figure(width, 4.2)
    grid = figure.subplots(3, 2, sharex=True)
    generator = np.random.default_rng(settings.seed)
    for (left, right), (label, evolution) in zip(grid, chosen.items(), strict=True):
        force = QuasiPeriodic(kernel, evolution, gamma=1e-6)
        left.plot(t, np.asarray(force.covariance(t, 5.0)), color=style.BLACK, lw=0.8, label="product of the kernels")
        left.plot(t, np.asarray(force.sde_covariance(t, 5.0)), "--", color=style.BLUE, label="state-space form")
        left.set_ylabel("covariance")
        left.set_title(f"{label}: with the force at time 5", fontsize=style.SMALL)
        values, vectors = np.linalg.eigh(np.asarray(force.sde_covariance(t[:, None], t)))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        for colour, line in ((style.BLUE, "-"), (style.VERMILLION, "--")):
            right.plot(t, root @ generator.normal(size=len(t)), color=colour, ls=line)
        right.set_ylabel("force")
        right.set_title(f"{label}: two draws", fontsize=style.SMALL)
        for axes in (left, right):
            style.tidy(axes)
    for axes in grid[-1]:
        axes.set_xlabel("time (period 10)")
    legend(figure)
    return figure


@style.styled
def plot_prediction(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the first function, its measurements, and how each approximation predicts it (figure 4 of the source)."""
    shown = (regression.SPARSE, regression.SPARSE_4, regression.KPCA, regression.EXACT)
    own = {task.settings["method"]: results[task.name] for task in regression.tasks(settings)}
    data, truth = np.split(regression.functions(settings.seed, settings.runs)[0], [len(problem.measured())])
    figure = style.new_figure(width, 3.6)
    panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    at = problem.predicted()
    for axes, method in zip(panels, shown, strict=True):
        mean, sd = own[method]["mean"], np.sqrt(own[method]["variance"])
        band(axes, at, mean, sd)
        axes.plot(at, mean, color=style.BLUE, label="mean")
        axes.plot(at, truth, **TRUTH)
        axes.plot(problem.measured(), data, "o", color=style.BLACK, ms=3, label="measured")
        axes.set_title(method, fontsize=style.SMALL)
        style.tidy(axes)
    for axes in panels[2:]:
        axes.set_xlabel("time (lengthscale 10)")
    for axes in panels[::2]:
        axes.set_ylabel("function")
    legend(figure)
    return figure
