"""Paths with their bands, errors and times against particles, the posterior of the drag, and coverage."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.ballistic import chains, parameters, particles, problem, tables, tracking
from lfm_ppl.experiments.drawing import SHADE, TRUTH, band, bars, legend, line, patch
from lfm_ppl.experiments.scores import Z, mean_of, rate_of
from lfm_ppl.results.plots import style

COLOURS = {"altitude": style.BLUE, "speed": style.VERMILLION, "u": style.GREEN}
MARKERS = {"altitude": "o", "speed": "s", "u": "^"}
LINES = {"altitude": "-", "speed": "--", "u": "-."}
_SCALES = {"altitude": (1e-3, "km"), "speed": (1e-3, "km/s"), "u": (1.0, "m/s^2")}
_SHOWN = 40
"""Targets whose posteriors of the drag are drawn one by one."""


def draw(settings: Any, results: dict[str, Result]) -> dict[str, Figure]:
    """Return every figure by name."""
    return {"paths": plot_paths(settings, results), "particles": plot_particles(settings, results),
            "drag": plot_drag(settings, results), "coverage": plot_coverage(settings, results)}


@style.styled
def plot_paths(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the first target: smoothed paths with 95% bands (figure 1 a to c of the source), and their errors."""
    target = problem.target(0, settings.seed)
    own = results[next(one for one in tracking.tasks(settings) if one.settings["method"] == tracking.REPORTED).name]
    most = max(settings.particles)
    by = next(task for task in particles.tasks(settings) if task.settings["particles"] == most)
    figure = style.new_figure(width, 3.8)
    grid = figure.subplots(2, len(problem.PATHS), sharex=True)
    for index, path in enumerate(problem.PATHS):
        upper, lower = grid[:, index]
        mean, sd, truth = own["mean"][index], own["sd"][index], target.paths[index]
        factor, unit = _SCALES[path]
        upper.plot(target.times, factor * mean, color=style.BLUE, label="Gaussian smoother")
        band(upper, target.times, factor * mean, factor * sd, label="its 95% band")
        upper.plot(target.times, factor * truth, **TRUTH)
        upper.set_ylabel(style.with_unit(path, unit))
        band(lower, target.times, 0.0, sd, label="its 95% band")
        lower.plot(target.times, mean - truth, color=style.BLUE)
        lower.plot(target.times, results[by.name]["mean"][index] - truth, color=style.ORANGE, lw=0.9, ls="--",
                   label=f"{most:,} particles")
        lower.axhline(0.0, color=style.BLACK, lw=0.6)
        lower.set_ylabel(style.with_unit(f"error of {path}", tables.UNITS[path], 24))
        lower.set_xlabel("time (s)")
        for axes in (upper, lower):
            axes.set_xlim(target.times[0], target.times[-1])
            style.tidy(axes)
    legend(figure)
    return figure


@style.styled
def plot_particles(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw RMSE relative to the Gaussian smoother's, and CPU time, against the number of particles."""
    counts = sorted(settings.particles)
    few = min(settings.runs, settings.particle_runs)
    gaussian = {name: values[:few] for name, values in tables.of_rule(settings, results, tracking.REPORTED).items()}
    found = {count: tables.of_particles(settings, results, count) for count in counts}
    figure, (left, right) = style.in_a_row(width, 2, 2.5)
    for index, path in enumerate(problem.PATHS):
        ratios = [tables.paired_ratio(found[count]["smoother_rmse"][:, index], gaussian["smoother_rmse"][:, index])
                  for count in counts]
        bars(left, np.asarray(counts) * 1.06 ** (index - 1), ratios, color=COLOURS[path], ls=LINES[path],
             marker=MARKERS[path], lw=1.0, label=path)
    left.axhline(1.0, color=style.BLACK, lw=0.8)
    left.set_ylabel("RMSE of the particle smoother\nover the Gaussian smoother's")
    for what, dash in (("filter", "--"), ("smoother", "-")):
        right.plot(counts, [found[count][f"{what}_seconds"].mean() for count in counts], color=style.ORANGE, ls=dash,
                   marker="o", ms=3.0)
        right.axhline(gaussian[f"{what}_seconds"].mean(), color=style.BLUE, ls=dash, lw=1.0)
    right.set_ylabel("CPU time for a target (s)")
    for axes in (left, right):
        style.tidy(axes)
        axes.set_xscale("log")
        axes.set_xlabel("particles")
    right.set_yscale("log")
    legend(figure, line("particles", style.ORANGE, marker="o", ms=3.0), line("Gaussian", style.BLUE),
           line("smoother", style.GREY), line("filter", style.GREY, "--"))
    style.note_below(figure, f"Means over {few} targets; error bars are two standard errors of paired differences.")
    return figure


@style.styled
def plot_drag(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the posterior of log alpha of one target (figure 1 d of the source), of several, and ranks of the truth."""
    truth = problem.true_z()[0]
    found = tables.of_parameters(settings, results)
    figure, (first, several, ranks) = style.in_a_row(width, 3, 2.5)
    draws = results[parameters.tasks(settings)[0].name]["draws"][0]
    chain = results[next(task for task in chains.tasks(settings) if task.settings["sampler"] == tables.NUTS).name]
    low, high = np.quantile(np.concatenate([draws, chain["draws"][0].ravel()]), [0.0005, 0.9995])
    places = np.linspace(low, high, 200)
    first.fill_between(places, stats.gaussian_kde(draws)(places), color=SHADE, lw=0, label="weighted draws")
    first.plot(places, stats.gaussian_kde(chain["draws"][0].ravel())(places), color=style.VERMILLION, ls="--",
               label="NUTS")
    first.axvline(truth, color=style.BLACK, lw=0.9)
    first.set_xlabel("log alpha (alpha in 1/m)")
    first.set_ylabel("posterior density")
    first.set_ylim(bottom=0.0)
    first.set_title("first target")
    count = min(_SHOWN, settings.runs)
    mean, sd = found["posterior_mean"][:count, 0], found["posterior_sd"][:count, 0]
    outside = np.abs(found["below"][:count, 0] - 0.5) > 0.475
    for held, colour in ((~outside, style.BLUE), (outside, style.ORANGE)):
        several.errorbar(np.flatnonzero(held), mean[held], Z * sd[held], color=colour, ls="", marker="o", ms=2.0,
                         elinewidth=0.8)
    several.axhline(truth, color=style.BLACK, lw=0.9)
    several.set_xlabel("target")
    several.set_ylabel("log alpha, mean and 1.96 sd")
    several.set_title(f"{count} targets")
    cells = 10 if settings.runs >= 100 else 5
    low, high = stats.binom(settings.runs, 1 / cells).ppf([0.025, 0.975]) / settings.runs
    ranks.axhspan(low, high, color="#DDDDDD", lw=0, label="95% of shares")
    drawn = tables.of_parameters(settings, results, drawn=True)
    for given, colour, dash in ((found, style.BLUE, "-"), (drawn, style.GREEN, "--")):
        below = given["below"][:, 0]
        ranks.hist(below, cells, range=(0.0, 1.0), weights=np.full(len(below), 1 / len(below)),
                   histtype="step", color=colour, ls=dash)
    ranks.axhline(1 / cells, color=style.BLACK, lw=0.9)
    ranks.set_ylim(0.0, 1.8 / cells)
    ranks.set_xlabel("posterior probability\nof less than the truth")
    ranks.set_ylabel("share of targets")
    ranks.set_title(f"{settings.runs} targets")
    for axes in (first, several, ranks):
        style.tidy(axes)
    legend(figure, line("truth, and what is expected", style.BLACK, lw=0.9),
           line("95% interval without the truth", style.ORANGE, marker="o", ms=2.0),
           line("parameters drawn from the prior", style.GREEN, "--"))
    return figure


@style.styled
def plot_coverage(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the coverage of the 95% bands of paths, and of the posterior intervals of parameters."""
    found = tables.of_parameters(settings, results)
    rows = {"truth": tables.of_rule(settings, results, tracking.REPORTED)["smoother_coverage"],
            "most\nlikely": found["likely_coverage"], "integrated\nout": found["posterior_coverage"]}
    figure, (left, right) = style.in_a_row(width, 2, 2.5)
    left.axhspan(0.93, 0.97, color="#DDDDDD", lw=0)
    left.axhline(0.95, color=style.BLACK, lw=0.8)
    for index, path in enumerate(problem.PATHS):
        values = [mean_of(one[:, index]) for one in rows.values()]
        bars(left, np.arange(len(rows)) + 0.12 * (index - 1), values, color=COLOURS[path], marker=MARKERS[path])
    style.tidy(left)
    left.set_xticks(range(len(rows)), list(rows))
    left.set_xlabel("parameters of the smoother")
    left.set_ylabel("coverage of the 95% bands")
    right.plot([0.4, 1.0], [0.4, 1.0], color=style.BLACK, lw=0.8)
    for index, (name, path) in enumerate(zip(problem.NAMES, problem.PATHS, strict=True)):
        inside = np.abs(found["below"][:, index] - 0.5)
        rates = [rate_of(inside <= level / 2) for level in parameters.LEVELS]
        bars(right, np.array(parameters.LEVELS) + 0.006 * (index - 1), rates, color=style.CHAIN_COLOURS[3 + index],
             marker=MARKERS[path], label=f"log {name}")
    style.tidy(right)
    right.set_xlabel("probability of the posterior interval")
    right.set_ylabel("intervals that hold the truth")
    right.legend(loc="lower right")
    style.legend_above(figure, [
        *(line(path, COLOURS[path], "", marker=MARKERS[path], ms=3.0) for path in problem.PATHS),
        line("nominal", style.BLACK, lw=0.8), patch("93% to 97%", "#DDDDDD")])
    style.note_below(figure, f"{settings.runs} targets; error bars are two standard errors.")
    return figure
