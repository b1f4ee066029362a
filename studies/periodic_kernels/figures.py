"""Figures of the study: covariance functions and errors, eigenfunctions, draws, and a predicted function."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl import forces
from lfm_ppl.plots import style

from ..declaration import Data
from ..drawing import TRUTH, band, legend
from . import methods, problem

_LINES = {methods.EIGENFUNCTIONS: (style.BLUE, "-", "o"), methods.RESONATORS: (style.GREEN, "--", "s"),
          methods.RANDOM: (style.VERMILLION, "-.", "^")}


def draw(settings: Any, data: Data) -> dict[str, Figure]:
    """Return every figure by name."""
    return {"errors": plot_errors(settings, data), "covariances": plot_covariances(settings),
            "eigenfunctions": plot_eigenfunctions(), "draws": plot_draws(settings),
            "prediction": plot_prediction(settings, data)}


def _tidy(axes: Axes, title: str, **properties: Any) -> None:
    axes.set_title(title, fontsize=style.SMALL)
    style.tidy(axes, **properties)


@style.styled
def plot_errors(settings: Any, data: Data, *, width: str | float = "full") -> Figure:
    """Draw the largest error of the covariance function against the number of functions, for each kernel."""
    figure = style.new_figure(width, 3.8)
    panels = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
    for axes, kernel in zip(panels, data["covariance"].kernel.values, strict=True):
        for method, (colour, line, marker) in _LINES.items():
            errors = data["covariance"][method].sel(kernel=kernel)
            axes.loglog(settings.functions, np.maximum(errors, 1e-16), line, color=colour, marker=marker, ms=3,
                        mfc="none" if method == methods.RESONATORS else colour, label=method)
        axes.set_title(kernel.replace("_", "/"), fontsize=style.SMALL)
        axes.tick_params(labelsize=style.SMALL)
        axes.set(ylim=(1e-13, 3.0), xlabel="functions", ylabel="largest error")
        axes.label_outer()
    legend(figure)
    return figure


@style.styled
def plot_covariances(settings: Any, *, width: str | float = "full") -> Figure:
    """Draw the squared exponential of scale 10, and its approximations by 22 functions and by 22 and 88 frequencies."""
    times, prior = problem.covariance_on_grid(problem.window_kernel())[0], problem.window_prior()
    figure, panels = style.in_a_row(width, 3, 2.4, sharey=True)
    for axes, method in zip(panels, (methods.KPCA, methods.SPARSE, methods.SPARSE_4), strict=True):
        key = jax.random.fold_in(jax.random.key(settings.seed), methods.PREDICTORS[method])
        axes.plot(times, prior.covariance(times), color=style.BLACK, lw=0.8, label="squared exponential, scale 10")
        axes.plot(times, methods.approximation(method, key).sde_covariance(times, 0.0), "--", color=style.BLUE,
                  label="approximation")
        _tidy(axes, method, xlabel="distance in time")
    panels[0].set_ylabel("covariance")
    legend(figure)
    return figure


@style.styled
def plot_eigenfunctions(*, width: str | float = "full") -> Figure:
    """Draw the first eigenfunctions of a stationary and of a non-stationary kernel (figure 2 of the source)."""
    figure, panels = style.in_a_row(width, 2, 2.4, sharey=True)
    t = np.linspace(0.0, 2 * problem.PERIOD, 401)
    styles = ((style.BLUE, "-", "first"), (style.VERMILLION, "--", "second"), (style.GREEN, "-.", "third"))
    for axes, name in zip(panels, ("periodic Matern-3_2", "moderated periodic Matern-3_2"), strict=True):
        force = forces.Periodic(problem.kernels()[name], functions=3, explained_variance=0.0)
        for values, (colour, line, label) in zip(np.asarray(force.eigenfunctions(t)).T, styles, strict=True):
            axes.plot(t, values * np.sign(values[20] + 1e-9), color=colour, ls=line, label=label)
        _tidy(axes, name.replace("_", "/"), xlabel="time (period 10)")
    panels[0].set_ylabel("eigenfunction")
    legend(figure)
    return figure


@style.styled
def plot_draws(settings: Any, *, width: str | float = "full") -> Figure:
    """Draw covariance functions and sample paths of forces with varying weights (figure 5 of the source)."""
    kernel = forces.PeriodicSquaredExponential(1.0, 1.0, problem.PERIOD)
    steps = forces.change_points(problem.PERIOD, 0.0, 60.0)
    evolutions = {"CQM, lengthscale 20": forces.CQM(20.0), "SQM, lengthscale 2": forces.SQM(2.0, steps),
                  "WQM, growth 0.5": forces.WQM(0.5, steps)}
    t, generator = np.linspace(0.0, 60.0, 301), np.random.default_rng(settings.seed)
    figure = style.new_figure(width, 4.2)
    grid = figure.subplots(3, 2, sharex=True)
    for (covariance_axes, draw_axes), (label, evolution) in zip(grid, evolutions.items(), strict=True):
        force = forces.QuasiPeriodic(kernel, evolution, gamma=1e-6)
        covariance_axes.plot(t, force.covariance(t, 5.0), color=style.BLACK, lw=0.8, label="product of the kernels")
        covariance_axes.plot(t, force.sde_covariance(t, 5.0), "--", color=style.BLUE, label="state-space form")
        values, vectors = np.linalg.eigh(np.asarray(force.sde_covariance(t[:, None], t)))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        for colour, line in ((style.BLUE, "-"), (style.VERMILLION, "--")):
            draw_axes.plot(t, root @ generator.normal(size=len(t)), color=colour, ls=line)
        _tidy(covariance_axes, f"{label}: with the force at time 5", ylabel="covariance")
        _tidy(draw_axes, f"{label}: two draws", ylabel="force")
    for axes in grid[-1]:
        axes.set_xlabel("time (period 10)")
    legend(figure)
    return figure


@style.styled
def plot_prediction(settings: Any, data: Data, *, width: str | float = "full") -> Figure:
    """Draw the first function, its measurements, and its prediction by each method (figure 4 of the source)."""
    measured, truth = np.split(methods.draw_functions(settings.seed, settings.runs)[0], [len(problem.MEASURED)])
    figure = style.new_figure(width, 3.6)
    panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    for axes, method in zip(panels, (methods.SPARSE, methods.SPARSE_4, methods.KPCA, methods.EXACT), strict=True):
        prediction = data["regression"].sel({"method": method})
        band(axes, problem.PREDICTED, prediction["mean"], np.sqrt(prediction["variance"]))
        axes.plot(problem.PREDICTED, prediction["mean"], color=style.BLUE, label="mean")
        axes.plot(problem.PREDICTED, truth, **TRUTH)
        axes.plot(problem.MEASURED, measured, "o", color=style.BLACK, ms=3, label="measured")
        _tidy(axes, method, xlabel="time (lengthscale 10)", ylabel="function")
        axes.label_outer()
    legend(figure)
    return figure
