"""The study of full posteriors: its settings, table and figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments import chains, study
from lfm_ppl.experiments.drawing import band, line
from lfm_ppl.experiments.scores import Z, mean_of, pair
from lfm_ppl.experiments.study import Results, Study, Table, setting
from lfm_ppl.experiments.transcription import parameters, problem
from lfm_ppl.results.plots import style

MARKERS, LINES = "osD^", ("-", "--", "-.", ":")
COLOURS = {parameters.REFERENCE: style.GREY, "NUTS, marginal": style.BLUE, "RAM, marginal": style.ORANGE,
           "RAM, iterated marginal": style.GREEN}


@dataclass(frozen=True)
class Settings(study.Settings):
    """How much is computed."""

    datasets: int = setting(2, "for each link", quick=1, aliases=study.REALISATIONS)
    latent: tuple[int, int, int, int] = setting((2, 500, 1000, 1), "NUTS on the latent grid", quick=(2, 20, 20, 1),
                                                parts=study.CHAINS)
    nuts: tuple[int, int, int, int] = setting((2, 500, 1000, 1), "NUTS on the marginal likelihood",
                                              quick=(2, 20, 20, 1), parts=study.CHAINS)
    ram: tuple[int, int, int, int] = setting((4, 250, 1000, 200), "RAM", quick=(2, 50, 50, 5), parts=study.CHAINS)
    tree_depth: int = setting(10, "largest of NUTS", quick=4)
    links: tuple[str, ...] = setting(tuple(parameters.LINKS), "how the factor acts", quick=("softplus",),
                                     choices=tuple(parameters.LINKS))


def tabulated(settings: Settings, results: Results) -> dict[str, Table]:
    """Return the table."""
    title = f"Against {parameters.REFERENCE}, {settings.datasets} data set{'s' if settings.datasets > 1 else ''}"
    return {"agreement": Table(title, agreement(by_cell(settings, results)))}


def by_cell(settings: Settings, results: Results) -> dict[tuple[str, str], list[Result]]:
    """Return (link, sampler) -> results of all data sets."""
    return problem.by_cell(parameters.tasks(settings), results, "sampler")


def agreement(cells: Mapping[tuple[str, str], list[Result]]) -> pd.DataFrame:
    """Return one row for each link and sampler.

    Returns:
        ``shift``, the largest distance of a posterior mean from the reference's in its standard deviations, and ``sd
        ratio``, the ratio of standard deviations that is furthest from one, over all parameters and data sets; ``shift
        se`` and ``sd ratio se`` are the Monte Carlo errors of these two, to be held against them, as the largest of
        many; ``coverage`` of the true parameters by 95% intervals, of which noise and lengthscale lie at the centre of
        their priors; ``RMSE`` of the force and ``coverage force``; ``least ESS``, the smallest bulk effective sample
        size of a parameter, and ``ESS/CPU s``, the same for a second of CPU time of warm-up and draws, compilation
        included, which takes more of it where several CPUs share the work of one process; the largest ``R-hat``, and
        Pareto index ``k`` where draws are weighted; ``divergences`` of one run.
    """
    rows = {}
    for (label, sampler), found in cells.items():
        reference = cells[label, parameters.REFERENCE]
        shift, ratio = chains.agreement(found, reference)
        if sampler == parameters.REFERENCE:
            shift, ratio = shift._replace(error=np.nan), ratio._replace(error=np.nan)
        row = pair("shift", shift) | pair("sd ratio", ratio)
        least = [chains.least_ess(one) for one in found]
        covered = [np.mean((one["low"] <= one["truth"]) & (one["truth"] <= one["high"])) for one in found]
        for name, values in (("coverage", covered), ("RMSE", [one["rmse"] for one in found]),
                             ("coverage force", [one["coverage"] for one in found]),
                             ("ESS/CPU s", [ess / one["seconds"] for ess, one in zip(least, found, strict=True)])):
            row |= pair(name, mean_of(values))
        row |= {"least ESS": min(least), "R-hat": max(map(chains.largest_r_hat, found)),
                "k": float(np.max([one.get("k", np.nan) for one in found])),
                "divergences": float(np.mean([one["divergences"] for one in found]))}
        rows[f"{label}: {sampler}"] = row
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def draw(settings: Settings, results: Results) -> dict[str, Figure]:
    """Return a figure of the first data set of each link."""
    cells = by_cell(settings, results)
    return {f"posteriors-{problem.slug(link)}": plot_posteriors(
        {sampler: cells[link, sampler][0] for sampler in parameters.SAMPLERS},
        problem.data_set(parameters.LINKS[link], 0, settings.seed)) for link in settings.links}


@style.styled
def plot_posteriors(samplers: Mapping[str, Result], data: problem.DataSet, *, width: str | float = "full") -> Figure:
    """Draw the 95% intervals of all parameters and the force by each sampler, with the truth.

    Args:
        samplers: sampler -> its result on the data set.
        data: the data set.
        width: "column" (3.4 in), "full" (7 in), or inches.
    """
    figure = style.new_figure(width, 4.6)
    upper, lower = figure.subplots(2, 1)
    for number, (sampler, found) in enumerate(samplers.items()):
        # Each parameter in standard deviations of the reference about its mean, so that all fit one axis.
        reference = samplers[parameters.REFERENCE]
        centre, scale = reference["mean"], reference["sd"]
        place = np.arange(len(parameters.NAMES)) + 0.16 * (number - (len(samplers) - 1) / 2)
        upper.vlines(place, (found["low"] - centre) / scale, (found["high"] - centre) / scale, color=COLOURS[sampler])
        upper.plot(place, (found["mean"] - centre) / scale, ls="", marker=MARKERS[number], ms=2.5,
                   color=COLOURS[sampler])
        mean, sd = found["force_mean"], found["force_sd"]
        lower.plot(parameters.AT, mean, color=COLOURS[sampler], ls=LINES[number])
        if sampler == parameters.REFERENCE:
            band(lower, parameters.AT, mean, sd, color=COLOURS[sampler], alpha=0.3, label="")
        else:
            for end in (-Z, Z):
                lower.plot(parameters.AT, mean + end * sd, color=COLOURS[sampler], lw=0.6, ls=LINES[number])
    reference = samplers[parameters.REFERENCE]
    upper.plot(np.arange(len(parameters.NAMES)), (reference["truth"] - reference["mean"]) / reference["sd"], ls="",
               marker="_", ms=12, color=style.BLACK)
    upper.set_ylabel("mean and 95%\n(sd of the reference)")
    lower.plot(problem.GRID, data.u, color=style.BLACK, lw=0.7)
    lower.set_ylabel("force u, mean\nand 95% band")
    lower.set_xlabel("time")
    lower.set_xlim(0.0, problem.END)
    for axes in (upper, lower):
        style.tidy(axes)
    upper.set_xticks(range(len(parameters.NAMES)), parameters.NAMES, rotation=40, ha="right")
    style.legend_above(figure, [
        *(line(sampler, COLOURS[sampler], LINES[number], marker=MARKERS[number], ms=2.5)
          for number, sampler in enumerate(samplers)), line("truth", style.BLACK)])
    return figure


STUDY = Study(Settings, parameters.tasks, parameters.compute, tabulated, draw)
