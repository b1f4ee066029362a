"""Paths with their bands, errors and times against particles, the posterior of the drag, and coverage."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from lfm_ppl.experiments.ballistic.problem import TARGETS
from lfm_ppl.experiments.datasets import select_prefix
from lfm_ppl.experiments.drawing import SHADE, SPAN, TRUTH, band, bars, legend, line, patch
from lfm_ppl.experiments.scores import Z, mean_of, paired_ratio, rate_of
from lfm_ppl.experiments.simulated import parameters
from lfm_ppl.experiments.simulated.problem import record, true_z
from lfm_ppl.experiments.simulated.states import REPORTED
from lfm_ppl.experiments.study import Data
from lfm_ppl.results.plots import style

COLOURS, MARKERS, LINES = (style.BLUE, style.VERMILLION, style.GREEN), "os^", ("-", "--", "-.")
_SCALES = ((1e-3, "km"), (1e-3, "km/s"), (1.0, "m/s^2"))
_SHOWN = 40
"""Targets whose posteriors of the drag are drawn one by one."""


def draw(settings: Any, data: Data) -> dict[str, Figure]:
    """Return every figure by name."""
    return {"paths": plot_paths(data, settings.seed), "particles": plot_particles(data), "drag": plot_drag(data),
            "coverage": plot_coverage(data)}


@style.styled
def plot_paths(data: Data, seed: int = 0, *, width: str | float = "full") -> Figure:
    """Draw the first target: smoothed paths with 95% bands (figure 1 a to c of the source), and their errors."""
    target, own = record(TARGETS, 0, seed), data["tracking"].sel({"method": REPORTED})
    particles = data["particles"].isel(dataset=0).sortby("particles").isel(particles=-1)
    figure = style.new_figure(width, 3.8)
    for index, (upper, lower) in enumerate(figure.subplots(2, len(TARGETS.paths), sharex=True).T):
        mean, sd, truth = own["mean"][index], own["sd"][index], target.paths[index]
        (factor, unit), path = _SCALES[index], TARGETS.paths[index]
        upper.plot(target.times, factor * mean, color=style.BLUE, label="Gaussian smoother")
        band(upper, target.times, factor * mean, factor * sd, label="its 95% band")
        upper.plot(target.times, factor * truth, **TRUTH)
        band(lower, target.times, 0.0, sd, label="its 95% band")
        lower.plot(target.times, mean - truth, color=style.BLUE)
        lower.plot(target.times, particles["mean"][index] - truth, color=style.ORANGE, lw=0.9, ls="--",
                   label=f"{int(particles.particles):,} particles")
        lower.axhline(0.0, color=style.BLACK, lw=0.6)
        style.tidy(upper, ylabel=style.with_unit(path, unit), xlim=target.times[[0, -1]])
        style.tidy(lower, ylabel=style.with_unit(f"error of {path}", TARGETS.units[index], 24), xlabel="time (s)")
    legend(figure)
    return figure


@style.styled
def plot_particles(data: Data, *, width: str | float = "full") -> Figure:
    """Draw RMSE relative to the Gaussian smoother's, and CPU time, against the number of particles."""
    found = data["particles"].sortby("particles")
    counts, few = found.particles.values, found.sizes["dataset"]
    gaussian = data["tracking"].sel({"method": REPORTED}).isel(dataset=slice(few))
    figure, (left, right) = style.in_a_row(width, 2, 2.5)
    for index, path in enumerate(TARGETS.paths):
        ratios = [paired_ratio(one[:, index], gaussian.smoother_rmse[:, index]) for one in found.smoother_rmse]
        bars(left, counts * 1.06 ** (index - 1), ratios, color=COLOURS[index], ls=LINES[index], marker=MARKERS[index],
             lw=1.0, label=path)
    left.axhline(1.0, color=style.BLACK, lw=0.8)
    for what, dash in (("filter", "--"), ("smoother", "-")):
        right.plot(counts, select_prefix(found, what).seconds.mean("dataset"), color=style.ORANGE, ls=dash, marker="o",
                   ms=3.0)
        right.axhline(select_prefix(gaussian, what).seconds.mean(), color=style.BLUE, ls=dash, lw=1.0)
    style.tidy(left, xscale="log", xlabel="particles",
               ylabel="RMSE of the particle smoother\nover the Gaussian smoother's")
    style.tidy(right, xscale="log", xlabel="particles", yscale="log", ylabel="CPU time for a target (s)")
    legend(figure, line("particles", style.ORANGE, marker="o", ms=3.0), line("Gaussian", style.BLUE),
           line("smoother", style.GREY), line("filter", style.GREY, "--"))
    style.note_below(figure, f"Means over {few} targets; error bars are two standard errors of paired differences.")
    return figure


@style.styled
def plot_drag(data: Data, *, width: str | float = "full") -> Figure:
    """Draw the posterior of log alpha of one target (figure 1 d of the source), of several, and ranks of the truth."""
    truth, (found, drawn) = true_z(TARGETS)[0], (data[name].isel(parameter=0) for name in ("parameters", "drawn"))
    figure, (first, several, ranks) = style.in_a_row(width, 3, 2.5)
    chain = data["chains"].draws.sel(sampler="NUTS").isel(dataset=0, parameter=0).values.ravel()
    both = found.draws.values, chain[np.isfinite(chain)]
    low, high = np.quantile(np.concatenate(both), [0.0005, 0.9995])
    places = np.linspace(low, high, 200)
    first.fill_between(places, stats.gaussian_kde(both[0])(places), color=SHADE, lw=0, label="weighted draws")
    first.plot(places, stats.gaussian_kde(both[1])(places), color=style.VERMILLION, ls="--", label="NUTS")
    count = min(_SHOWN, runs := found.sizes["dataset"])
    mean, sd, outside = (one[:count].values for one in (
        found.posterior_mean, found.posterior_sd, np.abs(found.below - 0.5) > 0.475))
    for held, colour in ((~outside, style.BLUE), (outside, style.ORANGE)):
        several.errorbar(np.flatnonzero(held), mean[held], Z * sd[held], color=colour, ls="", marker="o", ms=2.0,
                         elinewidth=0.8)
    cells = 10 if runs >= 100 else 5
    ranks.axhspan(*stats.binom(runs, 1 / cells).ppf([0.025, 0.975]) / runs, color=SPAN, lw=0, label="95% of shares")
    shares = [ranks.hist(given, cells, range=(0.0, 1.0), weights=np.full(given.size, 1 / given.size), histtype="step",
                         color=colour, ls=dash)[0]
              for given, colour, dash in ((found.below, style.BLUE, "-"), (drawn.below, style.GREEN, "--"))]
    for mark, place in ((first.axvline, truth), (several.axhline, truth), (ranks.axhline, 1 / cells)):
        mark(place, color=style.BLACK, lw=0.9)
    style.tidy(first, xlabel="log alpha (alpha in 1/m)", ylabel="posterior density", title="first target",
               ylim=(0.0, None))
    style.tidy(several, xlabel="target", ylabel="log alpha, mean and 1.96 sd", title=f"{count} targets")
    style.tidy(ranks, xlabel="posterior probability\nof less than the truth", ylabel="share of targets",
               ylim=(0.0, max(1.8 / cells, 1.1 * float(np.max(shares)))), title=f"{runs} targets")
    legend(figure, line("truth, and what is expected", style.BLACK, lw=0.9),
           line("95% interval without the truth", style.ORANGE, marker="o", ms=2.0),
           line("parameters drawn from the prior", style.GREEN, "--"))
    return figure


@style.styled
def plot_coverage(data: Data, *, width: str | float = "full") -> Figure:
    """Draw the coverage of the 95% bands of paths, and of the posterior intervals of parameters."""
    found, levels = data["parameters"], np.array(parameters.LEVELS)
    rows = {"truth": data["tracking"].smoother_coverage.sel({"method": REPORTED}),
            "most\nlikely": found.likely_coverage, "integrated\nout": found.posterior_coverage}
    figure, (left, right) = style.in_a_row(width, 2, 2.5)
    left.axhspan(0.93, 0.97, color=SPAN, lw=0)
    left.axhline(0.95, color=style.BLACK, lw=0.8)
    right.plot([0.4, 1.0], [0.4, 1.0], color=style.BLACK, lw=0.8)
    for index, name in enumerate(TARGETS.names):
        bars(left, np.arange(len(rows)) + 0.12 * (index - 1), [mean_of(one[:, index]) for one in rows.values()],
             color=COLOURS[index], marker=MARKERS[index])
        inside = np.abs(found.below[:, index] - 0.5)
        bars(right, levels + 0.006 * (index - 1), [rate_of(inside <= level / 2) for level in levels],
             color=style.CHAIN_COLOURS[3 + index], marker=MARKERS[index], label=f"log {name}")
    style.tidy(left, xlabel="parameters of the smoother", ylabel="coverage of the 95% bands")
    left.set_xticks(range(len(rows)), list(rows))
    style.tidy(right, xlabel="probability of the posterior interval", ylabel="intervals that hold the truth")
    right.legend(loc="lower right")
    style.legend_above(figure, [
        *(line(path, COLOURS[index], "", marker=MARKERS[index], ms=3.0) for index, path in enumerate(TARGETS.paths)),
        line("nominal", style.BLACK, lw=0.8), patch("93% to 97%", SPAN)])
    style.note_below(figure, f"{found.sizes['dataset']} targets; error bars are two standard errors.")
    return figure
