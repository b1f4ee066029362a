"""Figures of the study: smoothed paths, errors and CPU times of particles, posteriors of the drag, and coverage."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from lfm_ppl.plots import style

from ..datasets import select_prefix
from ..declaration import Data
from ..drawing import SHADE, SPAN, TRUTH, band, bars, legend, line, patch
from ..scores import Z, estimate_mean, estimate_rate, paired_ratio
from . import parameters
from .problem import NAMES, PATHS, simulate_target, true_z
from .states import DEFAULT_RULE

COLOURS, MARKERS, LINES = (style.BLUE, style.VERMILLION, style.GREEN), "os^", ("-", "--", "-.")
_SCALES = ((1e-3, "km"), (1e-3, "km/s"), (1.0, "m/s^2"))
"""Factor and unit of each path."""

_MAX_INTERVALS = 40
"""Largest number of targets whose posterior interval of the drag is drawn."""


def draw(settings: Any, data: Data) -> dict[str, Figure]:
    """Return every figure by name."""
    return {"paths": plot_paths(data, settings.seed), "particles": plot_particles(data), "drag": plot_drag(data),
            "coverage": plot_coverage(data)}


@style.styled
def plot_paths(data: Data, seed: int = 0, *, width: str | float = "full") -> Figure:
    """Draw smoothed paths of the first target with 95% bands (figure 1 a to c of the source), and their errors."""
    target, smoothed = simulate_target(0, seed), data["tracking"].sel({"method": DEFAULT_RULE})
    particles = data["particles"].isel(dataset=0).sortby("particles").isel(particles=-1)
    figure = style.new_figure(width, 3.8)
    for index, (upper, lower) in enumerate(figure.subplots(2, len(PATHS), sharex=True).T):
        mean, sd, truth = smoothed["mean"][index], smoothed["sd"][index], target.paths[index]
        (factor, unit), (path, error_unit) = _SCALES[index], tuple(PATHS.items())[index]
        upper.plot(target.times, factor * mean, color=style.BLUE, label="Gaussian smoother")
        band(upper, target.times, factor * mean, factor * sd, label="its 95% band")
        upper.plot(target.times, factor * truth, **TRUTH)
        band(lower, target.times, 0.0, sd, label="its 95% band")
        lower.plot(target.times, mean - truth, color=style.BLUE)
        lower.plot(target.times, particles["mean"][index] - truth, color=style.ORANGE, lw=0.9, ls="--",
                   label=f"{int(particles.particles):,} particles")
        lower.axhline(0.0, color=style.BLACK, lw=0.6)
        style.tidy(upper, ylabel=style.with_unit(path, unit), xlim=target.times[[0, -1]])
        style.tidy(lower, ylabel=style.with_unit(f"error of {path}", error_unit, 24), xlabel="time (s)")
    legend(figure)
    return figure


@style.styled
def plot_particles(data: Data, *, width: str | float = "full") -> Figure:
    """Draw the RMSE relative to that of the Gaussian smoother, and the CPU time, against the number of particles."""
    particles = data["particles"].sortby("particles")
    counts, targets = particles.particles.values, particles.sizes["dataset"]
    gaussian = data["tracking"].sel({"method": DEFAULT_RULE}).isel(dataset=slice(targets))
    figure, (ratio_axes, time_axes) = style.in_a_row(width, 2, 2.5)
    for index, path in enumerate(PATHS):
        ratios = [paired_ratio(rmse[:, index], gaussian.smoother_rmse[:, index]) for rmse in particles.smoother_rmse]
        bars(ratio_axes, counts * 1.06 ** (index - 1), ratios, color=COLOURS[index], ls=LINES[index],
             marker=MARKERS[index], lw=1.0, label=path)
    ratio_axes.axhline(1.0, color=style.BLACK, lw=0.8)
    for kind, dash in (("filter", "--"), ("smoother", "-")):
        time_axes.plot(counts, select_prefix(particles, kind).seconds.mean("dataset"), color=style.ORANGE, ls=dash,
                       marker="o", ms=3.0)
        time_axes.axhline(select_prefix(gaussian, kind).seconds.mean(), color=style.BLUE, ls=dash, lw=1.0)
    style.tidy(ratio_axes, xscale="log", xlabel="particles",
               ylabel="RMSE of the particle smoother\nover the Gaussian smoother's")
    style.tidy(time_axes, xscale="log", xlabel="particles", yscale="log", ylabel="CPU time for a target (s)")
    legend(figure, line("particles", style.ORANGE, marker="o", ms=3.0), line("Gaussian", style.BLUE),
           line("smoother", style.GREY), line("filter", style.GREY, "--"))
    style.note_below(figure, f"Means over {targets} targets; error bars are two standard errors of paired differences.")
    return figure


@style.styled
def plot_drag(data: Data, *, width: str | float = "full") -> Figure:
    """Draw posteriors of log alpha, and the distribution of the posterior rank of the truth over targets.

    The first panel is figure 1 d of the source.
    """
    truth = true_z()[0]
    estimates, prior_estimates = (data[kind].isel(parameter=0) for kind in ("parameters", "drawn"))
    figure, (density_axes, target_axes, rank_axes) = style.in_a_row(width, 3, 2.5)
    chain = data["chains"].draws.sel(sampler="NUTS").isel(dataset=0, parameter=0).values.ravel()
    samples = estimates.draws.values, chain[np.isfinite(chain)]
    low, high = np.quantile(np.concatenate(samples), [0.0005, 0.9995])
    grid = np.linspace(low, high, 200)
    density_axes.fill_between(grid, stats.gaussian_kde(samples[0])(grid), color=SHADE, lw=0, label="weighted draws")
    density_axes.plot(grid, stats.gaussian_kde(samples[1])(grid), color=style.VERMILLION, ls="--", label="NUTS")
    count = min(_MAX_INTERVALS, runs := estimates.sizes["dataset"])
    mean, sd, is_outside = (variable[:count].values for variable in (
        estimates.posterior_mean, estimates.posterior_sd, np.abs(estimates.below - 0.5) > 0.475))
    for selection, colour in ((~is_outside, style.BLUE), (is_outside, style.ORANGE)):
        target_axes.errorbar(np.flatnonzero(selection), mean[selection], Z * sd[selection], color=colour, ls="",
                             marker="o", ms=2.0, elinewidth=0.8)
    cells = 10 if runs >= 100 else 5
    rank_axes.axhspan(*stats.binom(runs, 1 / cells).ppf([0.025, 0.975]) / runs, color=SPAN, lw=0, label="95% of shares")
    shares = []
    for ranks, colour, dash in ((estimates.below, style.BLUE, "-"), (prior_estimates.below, style.GREEN, "--")):
        weights = np.full(ranks.size, 1 / ranks.size)
        shares.append(rank_axes.hist(ranks, cells, range=(0.0, 1.0), weights=weights, histtype="step", color=colour,
                                     ls=dash)[0])
    density_axes.axvline(truth, color=style.BLACK, lw=0.9)
    target_axes.axhline(truth, color=style.BLACK, lw=0.9)
    rank_axes.axhline(1 / cells, color=style.BLACK, lw=0.9)
    style.tidy(density_axes, xlabel="log alpha (alpha in 1/m)", ylabel="posterior density", title="first target",
               ylim=(0.0, None))
    style.tidy(target_axes, xlabel="target", ylabel="log alpha, mean and 1.96 sd", title=f"{count} targets")
    style.tidy(rank_axes, xlabel="posterior probability\nof less than the truth", ylabel="share of targets",
               ylim=(0.0, max(1.8 / cells, 1.1 * float(np.max(shares)))), title=f"{runs} targets")
    legend(figure, line("truth, and what is expected", style.BLACK, lw=0.9),
           line("95% interval without the truth", style.ORANGE, marker="o", ms=2.0),
           line("parameters drawn from the prior", style.GREEN, "--"))
    return figure


@style.styled
def plot_coverage(data: Data, *, width: str | float = "full") -> Figure:
    """Draw the coverage of the 95% bands of paths and of the posterior intervals of parameters."""
    estimates, levels = data["parameters"], np.array(parameters.LEVELS)
    smoothers = {"truth": data["tracking"].smoother_coverage.sel({"method": DEFAULT_RULE}),
                 "most\nlikely": estimates.likely_coverage, "integrated\nout": estimates.posterior_coverage}
    figure, (path_axes, parameter_axes) = style.in_a_row(width, 2, 2.5)
    path_axes.axhspan(0.93, 0.97, color=SPAN, lw=0)
    path_axes.axhline(0.95, color=style.BLACK, lw=0.8)
    parameter_axes.plot([0.4, 1.0], [0.4, 1.0], color=style.BLACK, lw=0.8)
    for index, name in enumerate(NAMES):
        bars(path_axes, np.arange(len(smoothers)) + 0.12 * (index - 1),
             [estimate_mean(coverage[:, index]) for coverage in smoothers.values()],
             color=COLOURS[index], marker=MARKERS[index])
        distance = np.abs(estimates.below[:, index] - 0.5)
        bars(parameter_axes, levels + 0.006 * (index - 1), [estimate_rate(distance <= level / 2) for level in levels],
             color=style.CHAIN_COLOURS[3 + index], marker=MARKERS[index], label=f"log {name}")
    style.tidy(path_axes, xlabel="parameters of the smoother", ylabel="coverage of the 95% bands")
    path_axes.set_xticks(range(len(smoothers)), list(smoothers))
    style.tidy(parameter_axes, xlabel="probability of the posterior interval", ylabel="intervals that hold the truth")
    parameter_axes.legend(loc="lower right")
    style.legend_above(figure, [
        *(line(path, COLOURS[index], "", marker=MARKERS[index], ms=3.0) for index, path in enumerate(PATHS)),
        line("nominal", style.BLACK, lw=0.8), patch("93% to 97%", SPAN)])
    style.note_below(figure, f"{estimates.sizes['dataset']} targets; error bars are two standard errors.")
    return figure
