"""The experiments that can be run by name."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from lfm_ppl import checks
from lfm_ppl.engine.cluster import Workers
from lfm_ppl.engine.run import Reporter

_MODULES = {"ginzburg-landau": "lfm_ppl.experiments.ginzburg_landau.report",
            "gps": "lfm_ppl.experiments.gps.report",
            "home-heating": "lfm_ppl.experiments.home_heating.report",
            "transcription": "lfm_ppl.experiments.transcription.report",
            "transcription-parameters": "lfm_ppl.experiments.transcription.parameters_report",
            "ballistic": "lfm_ppl.experiments.ballistic.report",
            "periodic-kernels": "lfm_ppl.experiments.periodic_kernels.report",
            "call-centre": "lfm_ppl.experiments.call_centre.report",
            "constrained": "lfm_ppl.experiments.constrained.report",
            "counts": "lfm_ppl.experiments.counts.report"}


class Wanted(NamedTuple):
    """What a user may ask of an experiment.

    Attributes:
        folder: for tasks, tables and figures.
        realisations: number of data sets; None: the experiment's own.
        conditional: number of data sets for the conditional posteriors, where the experiment has them; None: its own.
        seed: of everything random.
        quick: a small version that shows that everything runs.
        overwrite: compute again what was stored with other settings.
        report: what to do with a line of progress; None: nothing.
        workers: what computes; see `run_tasks`.
        data: a folder of files, where the experiment reads some; None: it makes its own data.
        satellites: names, where the experiment has satellites; None: all.
        train_days: days to learn from, where the experiment predicts those after them; None: its own.
        axes: of small forces, where the experiment has them; None: its own.
    """

    folder: Path
    realisations: int | None = None
    conditional: int | None = None
    seed: int = 0
    quick: bool = False
    overwrite: bool = False
    report: Reporter | None = None
    workers: Workers = 1
    data: str | None = None
    satellites: tuple[str, ...] | None = None
    train_days: float | None = None
    axes: str | None = None

    def counts(self, **names: str) -> dict[str, Any]:
        """Return the seed, and what a user gave, under the names that the experiment's settings have.

        Args:
            names: ``realisations``, ``conditional``, ``data``, ``satellites``, ``train_days`` and ``axes``, where the
                experiment has them -> name in its settings.

        Raises:
            ValueError: something is given that the experiment does not have.

        Example:
            >>> Wanted(Path("out"), realisations=10).counts(realisations="datasets")
            {'seed': 0, 'datasets': 10}
        """
        choices = ("realisations", "conditional", "data", "satellites", "train_days", "axes")
        given = {name: value for name in choices if (value := getattr(self, name)) is not None}
        for name in given:
            if name not in names:
                raise ValueError(f"this experiment does not take --{name.replace('_', '-')}; leave it out.")
        return {"seed": self.seed} | {names[name]: value for name, value in given.items()}


class Report(NamedTuple):
    """What an experiment found.

    Attributes:
        tables: title -> table, to be printed.
        written: the files.
        notes: what to know when reading the tables, printed below them.
    """

    tables: dict[str, pd.DataFrame]
    written: list[Path]
    notes: tuple[str, ...] = ()


class Experiment(NamedTuple):
    """An experiment.

    Attributes:
        name: on the command line.
        summary: one line.
        run: from what is wanted to what was found.
    """

    name: str
    summary: str
    run: Callable[[Wanted], Report]


def names() -> tuple[str, ...]:
    """Return the names of the experiments."""
    return tuple(_MODULES)


def experiment(name: str) -> Experiment:
    """Return an experiment by name, with dashes or underscores.

    Raises:
        ValueError: there is none of this name; the message has the nearest ones.

    Example:
        >>> experiment("ginzburg_landau").name
        'ginzburg-landau'
    """
    wanted = name.replace("_", "-")
    if wanted not in _MODULES:
        raise ValueError(checks.unknown("experiment", name, _MODULES))
    module = importlib.import_module(_MODULES[wanted])
    return Experiment(wanted, module.SUMMARY, module.run)
