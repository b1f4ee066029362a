"""A study as a declaration: settings, tasks, and the tables and figures that follow from their results.

What a study adds to its problem is a module ``experiment.py`` in a folder of its own, with

- a frozen subclass of `StudySettings`, each field made by `setting`, which are checked, and are the options of
  ``lfm-ppl compare NAME``;
- a function of the settings that returns the `lfm_ppl.engine.task.Task` objects;
- for each kind of task how one is computed and which dimensions its results have (`Kind`): all of them become one
  `xarray.Dataset`;
- functions of the settings and these datasets that return the tables (`Table`) and the figures;
- ``STUDY``, a `Study` of these;

and a line in `lfm_ppl.experiments.catalogue`. `lfm_ppl.experiments.ballistic` shows one. Everything else is here: a run
computes what its folder does not hold yet, writes every table as CSV and Markdown and every figure as PNG, and the
command line prints the tables and puts them on one page.

    @dataclass(frozen=True)
    class TrackingSettings(StudySettings):
        runs: int = setting(500, "simulated targets", quick=4, aliases=study.REALISATIONS)

    def tasks(settings: TrackingSettings) -> list[Task]:
        made = Tasks("made-up", settings.seed)
        return in_order(one for rule in ("EKF", "CKF") for one in made.each(f"track/{rule}", settings.runs, rule=rule))

    def compute(task: Task) -> Result:
        return {"rmse": ...}

    def tables(settings: TrackingSettings, data: Data) -> dict[str, Table]:
        return {"errors": Table.of("Errors", rows(data["track"], "rule", {"RMSE": "rmse"}))}

    def figures(settings: TrackingSettings, data: Data) -> dict[str, Figure]:
        return {"errors": plot_errors(data["track"])}

    STUDY = Study(TrackingSettings, tasks, {"track": Kind(compute, {"dataset": "rmse"}, by=("rule",))}, tables, figures)
"""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

from lfm_ppl import checks
from lfm_ppl.engine.cluster import Workers, started
from lfm_ppl.engine.run import Reporter, run_tasks
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.datasets import Kind
from lfm_ppl.results.files import writing
from lfm_ppl.results.plots import style
from lfm_ppl.results.tables import write_csv, write_markdown

Results = dict[str, Result]
"""Name of a task -> its result."""

Data = Mapping[str, xr.Dataset]
"""Kind of task -> the results of all such tasks."""

TASKS = "tasks"
"""The subfolder of a study's folder with a file for each task."""

REALISATIONS = ("--realisations", "--datasets", "--runs")
"""Options by any of which a user gives the number of data sets, whatever a study calls them."""

CHAINS = ("chains", "warm-up", "draws", "thinning")
"""Parts of a setting that says how long a sampler runs; those of the first three serve where nothing is thinned."""

_KEPT: Any = object()


class Declared(NamedTuple):
    """What a study says of a setting.

    Attributes:
        help: what it is, for the command line; empty: no option is made of it.
        quick: its value in the quick version; as the default where it is left out.
        choices: what a text, or each of several, may be.
        parts: what the whole numbers of a tuple of fixed length are.
        metavar: what stands for the value in the help.
        aliases: options that mean the same as the one of its name.
        least: the least whole number.
        per_seed: the largest number that one seed has data sets for.
        increasing: whether several numbers must increase.
    """

    help: str
    quick: Any = _KEPT
    choices: Sequence[str] | None = None
    parts: Sequence[str] | None = None
    metavar: str | None = None
    aliases: Sequence[str] = ()
    least: int = 1
    per_seed: int | None = None
    increasing: bool = False


def setting(default: Any, help: str, **about: Any) -> Any:
    """Return a field of `StudySettings`: its value, a tuple for several, and what else is `Declared` of it."""
    return dataclasses.field(default=default, metadata={"declared": Declared(help, **about)})


class Option(NamedTuple):
    """A setting that a user can give.

    Attributes:
        name: of the field.
        kind: int, float or str.
        many: whether it is a tuple of any length of these.
        optional: whether it may be None.
        default: its value.
        declared: what the study says of it.
    """

    name: str
    kind: type
    many: bool
    optional: bool
    default: Any
    declared: Declared

    @property
    def flags(self) -> list[str]:
        """The options of the command line that give it."""
        return list(dict.fromkeys([f"--{self.name.replace('_', '-')}", *self.declared.aliases]))

    def check(self, value: Any) -> None:
        """Raise ValueError or TypeError, naming the setting, unless it may have this value."""
        about = self.declared
        if value is None and self.optional:
            return
        if about.parts:
            checks.sizes(self.name, value, about.parts)
        elif self.many:
            self._check_several(value)
        elif self.kind is int:
            self._check_count(value)
        elif self.kind is float:
            checks.positive(self.name, value, f"See {self.flags[0]}.")
        elif about.choices:
            checks.one_of(self.name, value, about.choices)

    def _check_several(self, value: Any) -> None:
        about, what = self.declared, "numbers" if self.kind is int else "labels"
        known = isinstance(value, tuple) and len(value) > 0
        if about.increasing and not (known and list(value) == sorted(set(value))):
            raise ValueError(f"{self.name} must be a tuple of increasing numbers, got {value!r}.")
        if not known or (self.kind is int or about.choices) and len(set(value)) < len(value):
            raise ValueError(f"{self.name} must be a tuple of different {what}, at least one, got {value!r}.")
        for one in value:
            if self.kind is int:
                self._check_count(one)
            elif about.choices:
                checks.one_of(self.name, one, about.choices)

    def _check_count(self, value: Any) -> None:
        about = self.declared
        if about.least > 0 or not isinstance(value, int):
            checks.positive_integer(self.name, value)
        if value < about.least:
            raise ValueError(f"{self.name} must be at least {about.least}, got {value}.")
        if about.per_seed is not None and value > about.per_seed:
            raise ValueError(f"{self.name} is {value}, and one seed has {about.per_seed} records of a kind; use "
                             "several seeds for more.")


@dataclasses.dataclass(frozen=True)
class StudySettings:
    """How much is computed; the fields of a study's own subclass follow."""

    seed: int = dataclasses.field(default=0, kw_only=True, metadata={
        "declared": Declared("of everything random", metavar="N", least=0)})

    def __post_init__(self) -> None:
        """Check every setting by itself; a study that has more to check extends this."""
        for one in options(type(self)):
            one.check(getattr(self, one.name))

    @classmethod
    def quick(cls, **given: Any) -> Self:
        """Return settings that show in minutes that everything runs, and no more, but for those that are given."""
        small = {one.name: one.metadata["declared"].quick for one in dataclasses.fields(cls) if one.metadata}
        return cls(**{name: value for name, value in small.items() if value is not _KEPT} | given)

    @classmethod
    def chosen(cls, report: Reporter | None, quick: bool = False, **given: Any) -> Self:
        """Return the settings that a user of the command line chose; a study that looks for data extends this."""
        return cls.quick(**given) if quick else cls(**given)


def options(settings: type[StudySettings]) -> tuple[Option, ...]:
    """Return what a user can give, in the order of the fields."""
    hints, found = typing.get_type_hints(settings), []
    for one in dataclasses.fields(settings):
        if (declared := one.metadata.get("declared")) is None or not declared.help:
            continue
        kinds = [hints[one.name]]
        if isinstance(hints[one.name], types.UnionType):
            kinds = [kind for kind in typing.get_args(hints[one.name]) if kind is not types.NoneType]
        many = typing.get_origin(kinds[0]) is tuple
        kind = typing.get_args(kinds[0])[0] if many else kinds[0]
        found.append(Option(one.name, kind, many and not declared.parts, hints[one.name] != kinds[0], one.default,
                            declared))
    return tuple(sorted(found, key=lambda one: one.name == "seed"))


class Table(NamedTuple):
    """A table of a study.

    Attributes:
        title: printed above it; empty: it is written and not printed.
        frame: one row a case; where a column ``name`` has standard errors they are the column ``name se``.
        printed: what is printed of it; None: all, with standard errors in parentheses.
        stored: whether it is written; else it is printed alone.
    """

    title: str
    frame: pd.DataFrame
    printed: pd.DataFrame | None = None
    stored: bool = True

    @classmethod
    def of(cls, title: str, rows: Mapping[str, Mapping[str, Any]]) -> Self:
        """Return a table of rows by name, each a column -> value."""
        return cls(title, pd.DataFrame.from_dict(rows, orient="index"))


class Found(NamedTuple):
    """What a study found.

    Attributes:
        settings: that it ran with.
        results: of every task, by name.
        data: the same as one dataset for each kind of task.
        named: the tables, by the names of their files.
        notes: what to know when reading them.
    """

    settings: Any
    results: Results
    data: Data
    named: dict[str, Table]
    notes: tuple[str, ...] = ()

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """The tables that are written, by name."""
        return {name: one.frame for name, one in self.named.items() if one.stored}

    @property
    def printed(self) -> dict[str, pd.DataFrame]:
        """Title -> table as it is printed."""
        return {one.title: scores.readable(one.frame) if one.printed is None else one.printed
                for one in self.named.values() if one.title}


@dataclasses.dataclass(frozen=True)
class Study:
    """A study.

    Attributes:
        settings: the class of its settings.
        tasks: from the settings to the tasks, in the order in which they are computed.
        kinds: kind of task -> how it is computed, and what its results are.
        tables: from settings and data to tables, by the names of their files.
        figures: from settings and data to figures, by the names of their files.
        coords: name -> dimension and values of a coordinate of the data.
        label: header of the tables' first column, which holds the names of the rows.
        notes: from settings and data to what is to be known when reading the tables.
        then: from settings and the results of ``tasks`` to further tasks.
        check: of the settings, before anything is computed, with what to do with a line of progress.
        what: from a task to its kind; by default its setting ``what``, or what its name begins with.
    """

    settings: type[StudySettings]
    tasks: Callable[[Any], list[Task]]
    kinds: Mapping[str, Kind]
    tables: Callable[[Any, Data], dict[str, Table]]
    figures: Callable[[Any, Data], dict[str, Figure]]
    coords: Mapping[str, tuple[str, Sequence[Any]]] = dataclasses.field(default_factory=dict)
    label: str = "case"
    notes: Callable[[Any, Data], tuple[str, ...]] = lambda settings, data: ()
    then: Callable[[Any, Results], list[Task]] | None = None
    check: Callable[[Any, Reporter | None], None] = lambda settings, report: None
    what: Callable[[Task], str] = lambda task: task.settings.get("what", task.name.partition("/")[0])

    def run(self, settings: Any, folder: str | Path, *, overwrite: bool = False, report: Reporter | None = None,
            workers: Workers = 1) -> Found:
        """Compute what is not stored yet in ``folder``, and tabulate everything.

        Args:
            settings: how much.
            folder: of the study; its subfolder ``tasks`` holds a file for each task.
            overwrite: compute again what was stored with other settings.
            report: what to do with a line of progress; None: nothing.
            workers: what computes; see `run_tasks`.

        Raises:
            FileNotFoundError, ValueError: data that are not there or cannot be used; the folder holds results made
                with other settings.
        """
        self.check(settings, report)
        computed = functools.partial(_computed, self.what, {what: kind.compute for what, kind in self.kinds.items()})
        done = functools.partial(run_tasks, compute=computed, folder=Path(folder) / TASKS, overwrite=overwrite,
                                 report=report)
        tasks = self.tasks(settings)
        if self.then is None:
            return self.found(settings, done(tasks, workers=workers), tasks)
        with started(workers) as running:  # once, for both rounds
            results = done(tasks, workers=running or 1)
            more = self.then(settings, results)
            return self.found(settings, results | done(more, workers=running or 1), [*tasks, *more])

    def found(self, settings: Any, results: Results, tasks: Sequence[Task] | None = None) -> Found:
        """Return what follows from the results of all tasks, which are asked for where they are not given."""
        data = self.gathered(settings, results, tasks)
        return Found(settings, results, data, self.tables(settings, data), self.notes(settings, data))

    def gathered(self, settings: Any, results: Results, tasks: Sequence[Task] | None = None) -> Data:
        """Return the results of all tasks as one dataset for each kind."""
        data = {}
        for what, own in self.by_kind(settings, results, tasks).items():
            one = self.kinds[what].gathered(own, results)
            data[what] = one.assign_coords({name: (dim, list(values)) for name, (dim, values) in self.coords.items()
                                            if dim in one.dims})
        return data

    def by_kind(self, settings: Any, results: Results, tasks: Sequence[Task] | None = None) -> dict[str, list[Task]]:
        """Return the tasks of each kind of which there are any, in the order of the kinds."""
        if tasks is None:
            tasks = self.tasks(settings)
            if self.then is not None:
                tasks = [*tasks, *self.then(settings, {task.name: results[task.name] for task in tasks})]
        found = {what: [task for task in tasks if self.what(task) == what] for what in self.kinds}
        return {what: own for what, own in found.items() if own}

    def save(self, found: Found, folder: str | Path) -> list[Path]:
        """Write tables as CSV in full and as Markdown, and figures as PNG, replacing older ones; return their paths."""
        folder, written = Path(folder), []
        for name, table in found.tables.items():
            written.append(write_csv(table, folder / f"{name}.csv", True, index_label=self.label))
            written.append(write_markdown(scores.readable(table), folder / f"{name}.md", True))
        for name, figure in self.figures(found.settings, found.data).items():
            written.append(folder / f"{name}.png")
            with writing(written[-1], True) as temporary, style.in_style():
                figure.savefig(temporary, format="png")
        return written


def _computed(what: Callable[[Task], str], kinds: Mapping[str, Callable[[Task], Result]], task: Task) -> Result:
    return kinds[what(task)](task)
