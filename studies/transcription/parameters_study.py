"""The study of full posteriors of transcription factors: settings, tasks, table and figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lfm_ppl.parallel.task import Task

from .. import chains
from ..datasets import Column, TaskKind, number, row
from ..declaration import CHAINS, REALISATIONS, Data, Study, StudySettings, StudyTable, setting
from ..scores import estimate_cells
from . import figures, parameters, problem
from .parameters import LINKS, REFERENCE, SAMPLERS


@dataclass(frozen=True)
class TranscriptionParametersSettings(StudySettings):
    """Sizes of the study."""

    datasets: int = setting(2, "data sets for each link", quick=1, aliases=REALISATIONS)
    latent: tuple[int, int, int, int] = setting((2, 500, 1000, 1), "NUTS on the latent grid", quick=(2, 20, 20, 1),
                                                parts=CHAINS)
    nuts: tuple[int, int, int, int] = setting((2, 500, 1000, 1), "NUTS on the marginal likelihood",
                                              quick=(2, 20, 20, 1), parts=CHAINS)
    ram: tuple[int, int, int, int] = setting((4, 250, 1000, 200), "RAM", quick=(2, 50, 50, 5), parts=CHAINS)
    tree_depth: int = setting(10, "largest tree depth of NUTS", quick=4)
    links: tuple[str, ...] = setting(tuple(LINKS), "links of the factor", quick=("softplus",), choices=tuple(LINKS))


def tasks(settings: TranscriptionParametersSettings) -> list[Task]:
    """Return one task for each link, data set and sampler."""
    def task(index: int, link: str, label: str, sampler: parameters.SamplerConfiguration) -> Task:
        lengths = getattr(settings, "latent" if sampler.latent else sampler.kernel.lower())
        return Task(f"parameters/{problem.slug(f'{link} {label}')}/{index:03d}", settings.seed, {
            "study": "transcription-parameters", "sampler": label, **LINKS[link]._asdict(), "index": index,
            **dict(zip(chains.LENGTHS, lengths, strict=True)), "tree_depth": settings.tree_depth,
            **({"iterations": sampler.iterations} if sampler.iterations else {})})

    return [task(index, link, *entry) for index in range(settings.datasets) for link in settings.links
            for entry in SAMPLERS.items()]


COLUMNS: dict[str, Column] = {
    "coverage": lambda chain: ((chain.low <= chain.truth) & (chain.truth <= chain.high)).mean("parameter"),
    "RMSE": "rmse", "coverage force": "coverage",
    "ESS/CPU s": lambda chain: chain.ess.fillna(0.0).min("parameter") / chain.seconds,
    "least ESS": chains.least_ess, "R-hat": chains.largest_r_hat, "k": lambda chain: number(np.max, chain.k),
    "divergences": lambda chain: chain.divergences.mean()}


def agreement(settings: TranscriptionParametersSettings, data: Data) -> dict[str, Any]:
    """Return one row for each link and sampler.

    ``shift`` and ``sd ratio`` relative to the reference have Monte Carlo errors, see `chains.agreement`. ``coverage``
    is that of the true parameters by 95% intervals; the true noise and lengthscale are the medians of their priors. The
    force has ``RMSE`` and ``coverage force``. ``least ESS`` is the smallest bulk effective sample size of a parameter,
    and ``ESS/CPU s`` its ratio to the CPU time of compilation, warm-up and draws. Further columns are the largest
    ``R-hat``, the Pareto index ``k`` of weighted draws, and ``divergences`` of one run.
    """
    rows: dict[str, Any] = {}
    for link in settings.links:
        for sampler in SAMPLERS:
            posteriors, reference = (data[link].sel(sampler=label) for label in (sampler, REFERENCE))
            shift, ratio = chains.agreement(posteriors, reference)
            if sampler == REFERENCE:  # the agreement with itself is exact
                shift, ratio = shift._replace(error=np.nan), ratio._replace(error=np.nan)
            rows[f"{link}: {sampler}"] = {**estimate_cells("shift", shift), **estimate_cells("sd ratio", ratio),
                                          **row(posteriors, COLUMNS)}
    return rows


def tables(settings: TranscriptionParametersSettings, data: Data) -> dict[str, StudyTable]:
    """Return the table."""
    title = f"Against {REFERENCE}, {settings.datasets} data set{'s' if settings.datasets > 1 else ''}"
    return {"agreement": StudyTable.from_rows(title, agreement(settings, data))}


def draw(settings: TranscriptionParametersSettings, data: Data) -> dict[str, Figure]:
    """Return a figure of the first data set of each link."""
    return {f"posteriors-{problem.slug(link)}": figures.plot_posteriors(
        data[link], problem.data_set(LINKS[link], 0, settings.seed)) for link in settings.links}


KIND = TaskKind(parameters.compute, {
    "dataset parameter": "mean, sd, low, high, truth, ess, r_hat", "dataset parameter chain draw": "draws",
    "dataset time": "force_mean, force_sd", "dataset": "rmse, coverage, seconds, divergences, k"}, ("sampler",))
STUDY = Study(TranscriptionParametersSettings, tasks, dict.fromkeys(LINKS, KIND), tables, draw,
              {"parameter": ("parameter", parameters.NAMES)},
              task_kind=lambda task: problem.configuration(task).label)
