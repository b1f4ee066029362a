"""The study of full posteriors: its settings, tasks, table and figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lfm_ppl.engine.task import Task
from lfm_ppl.experiments import chains, study
from lfm_ppl.experiments.datasets import Column, TaskKind, number, row
from lfm_ppl.experiments.scores import estimate_cells
from lfm_ppl.experiments.study import Data, Study, StudyTable, setting
from lfm_ppl.experiments.transcription import figures, parameters, problem
from lfm_ppl.experiments.transcription.parameters import LINKS, REFERENCE, SAMPLERS


@dataclass(frozen=True)
class TranscriptionParametersSettings(study.StudySettings):
    """How much is computed."""

    datasets: int = setting(2, "for each link", quick=1, aliases=study.REALISATIONS)
    latent: tuple[int, int, int, int] = setting((2, 500, 1000, 1), "NUTS on the latent grid", quick=(2, 20, 20, 1),
                                                parts=study.CHAINS)
    nuts: tuple[int, int, int, int] = setting((2, 500, 1000, 1), "NUTS on the marginal likelihood",
                                              quick=(2, 20, 20, 1), parts=study.CHAINS)
    ram: tuple[int, int, int, int] = setting((4, 250, 1000, 200), "RAM", quick=(2, 50, 50, 5), parts=study.CHAINS)
    tree_depth: int = setting(10, "largest of NUTS", quick=4)
    links: tuple[str, ...] = setting(tuple(LINKS), "how the factor acts", quick=("softplus",), choices=tuple(LINKS))


def tasks(settings: TranscriptionParametersSettings) -> list[Task]:
    """Return one task for each link, data set and sampler."""
    def task(index: int, link: str, label: str, sampler: parameters.Sampler) -> Task:
        lengths = getattr(settings, "latent" if sampler.latent else sampler.kernel.lower())
        return Task(f"parameters/{problem.slug(f'{link} {label}')}/{index:03d}", settings.seed, {
            "experiment": "transcription-parameters", "sampler": label, **LINKS[link]._asdict(), "index": index,
            **dict(zip(chains.LENGTHS, lengths, strict=True)), "tree_depth": settings.tree_depth,
            **({"iterations": sampler.iterations} if sampler.iterations else {})})

    return [task(index, link, *one) for index in range(settings.datasets) for link in settings.links
            for one in SAMPLERS.items()]


COLUMNS: dict[str, Column] = {
    "coverage": lambda found: ((found.low <= found.truth) & (found.truth <= found.high)).mean("parameter"),
    "RMSE": "rmse", "coverage force": "coverage",
    "ESS/CPU s": lambda found: found.ess.fillna(0.0).min("parameter") / found.seconds,
    "least ESS": chains.least_ess, "R-hat": chains.largest_r_hat, "k": lambda found: number(np.max, found.k),
    "divergences": lambda found: found.divergences.mean()}


def agreement(settings: TranscriptionParametersSettings, data: Data) -> dict[str, Any]:
    """Return one row for each link and sampler.

    ``shift`` and ``sd ratio`` from the reference with their Monte Carlo errors, see `chains.agreement`; ``coverage`` of
    the true parameters by 95% intervals, of which noise and lengthscale lie at the centre of their priors; ``RMSE`` of
    the force and ``coverage force``; ``least ESS``, the smallest bulk effective sample size of a parameter, and
    ``ESS/CPU s``, the same for a second of CPU time of warm-up and draws, compilation included, which takes more of it
    where several CPUs share the work of one process; the largest ``R-hat``, and Pareto index ``k`` where draws are
    weighted; ``divergences`` of one run.
    """
    rows: dict[str, Any] = {}
    for link in settings.links:
        for sampler in SAMPLERS:
            found, reference = (data[link].sel(sampler=label) for label in (sampler, REFERENCE))
            shift, ratio = chains.agreement(found, reference)
            if sampler == REFERENCE:  # it is no estimate how it agrees with itself
                shift, ratio = shift._replace(error=np.nan), ratio._replace(error=np.nan)
            rows[f"{link}: {sampler}"] = {**estimate_cells("shift", shift), **estimate_cells("sd ratio", ratio),
                                          **row(found, COLUMNS)}
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
