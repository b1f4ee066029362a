"""A study as a declaration: settings, tasks, and the tables and figures that follow from their results.

`Study.run` works as follows:

1. Check the settings; for example, that the data files exist.
2. Build the tasks from the settings. Each task has a name, a random key and a kind.
3. Compute the tasks whose results the folder does not hold yet, and store each result in a separate file.
4. Build further tasks from these results, if the study declares `Study.follow_up_tasks`, and compute them likewise.
5. Combine the results of each kind of task into one `xarray.Dataset` (`TaskKind.collect`).
6. Derive tables and notes from the datasets.

`Study.save` writes every table as CSV and Markdown and every figure as PNG. The command line prints the tables and
collects them on one page.

A study is a module ``study.py`` in a separate folder, with

- a frozen subclass of `StudySettings`, each field declared by `setting`: the fields are checked, and become the options
  of ``lfm-ppl compare NAME``;
- a function that maps the settings to `lfm_ppl.parallel.task.Task` objects;
- for each kind of task a `TaskKind`: the function that computes one task, and the dimensions of its results;
- functions that map the settings and the datasets to the tables (`StudyTable`) and to the figures;
- ``STUDY``, a `Study` with these parts,

and a line in `lfm_ppl.studies.catalogue`. `lfm_ppl.studies.ballistic` is an example.

    @dataclass(frozen=True)
    class TrackingSettings(StudySettings):
        runs: int = setting(500, "simulated targets", quick=4, aliases=REALISATIONS)

    def tasks(settings: TrackingSettings) -> list[Task]:
        factory = TaskFactory("tracking", settings.seed)
        return sort_by_dataset(task for rule in ("EKF", "CKF")
                               for task in factory.dataset_tasks(f"track/{rule}", settings.runs, rule=rule))

    def compute(task: Task) -> Result:
        return {"rmse": ...}

    def tables(settings: TrackingSettings, data: Data) -> dict[str, StudyTable]:
        return {"errors": StudyTable.from_rows("Errors", rows(data["track"], "rule", {"RMSE": "rmse"}))}

    def figures(settings: TrackingSettings, data: Data) -> dict[str, Figure]:
        return {"errors": plot_errors(data["track"])}

    KINDS = {"track": TaskKind(compute, {"dataset": "rmse"}, by=("rule",))}
    STUDY = Study(TrackingSettings, tasks, KINDS, tables, figures)
"""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

from lfm_ppl.parallel.cluster import Workers, start_workers
from lfm_ppl.parallel.run import run_tasks
from lfm_ppl.parallel.task import Result, Task
from lfm_ppl.plots import style
from lfm_ppl.results.tables import write_csv, write_markdown
from lfm_ppl.utils import checks
from lfm_ppl.utils.atomic_files import atomic_write
from lfm_ppl.utils.progress import Reporter

from . import scores
from .datasets import TaskKind

Results = dict[str, Result]
"""Task name -> result."""

Data = Mapping[str, xr.Dataset]
"""Kind of task -> results of all tasks of this kind."""

TASKS = "tasks"
"""Subfolder of a study's folder, with one file for each task."""

REALISATIONS = ("--realisations", "--datasets", "--runs")
"""Synonyms of the option that sets the number of data sets, accepted by every study with simulated data."""

CHAINS = ("chains", "warm-up", "draws", "thinning")
"""Parts of a setting for the length of a sampler; samplers without thinning use the first three."""

_UNSET: Any = object()


@dataclass(frozen=True)
class SettingDeclaration:
    """Description of a setting, beside its default.

    Attributes:
        help: description for the command line; an empty text makes no option.
        quick: value in the quick version; by default the same as in the full version.
        choices: permitted texts, for a text or for each entry of a tuple of texts.
        parts: names of the whole numbers in a tuple of fixed length.
        metavar: placeholder for the value in the help.
        aliases: further names of the option.
        least: smallest permitted whole number.
        per_seed: largest number of data sets that one seed provides.
        increasing: whether the entries of a tuple of numbers must increase.
    """

    help: str
    quick: Any = _UNSET
    choices: Sequence[str] | None = None
    parts: Sequence[str] | None = None
    metavar: str | None = None
    aliases: Sequence[str] = ()
    least: int = 1
    per_seed: int | None = None
    increasing: bool = False


def setting(default: Any, help: str, **declaration: Any) -> Any:
    """Return a dataclass field for `StudySettings`; keyword arguments as the attributes of `SettingDeclaration`."""
    return dataclasses.field(default=default, metadata={"declaration": SettingDeclaration(help, **declaration)})


@dataclass(frozen=True)
class StudySettings:
    """Settings of any study; a study subclasses this and adds its fields."""

    seed: int = dataclasses.field(default=0, kw_only=True, metadata={
        "declaration": SettingDeclaration("seed of all random numbers", metavar="N", least=0)})

    def __post_init__(self) -> None:
        """Check every setting separately; a subclass adds checks that involve several settings."""
        for field, value_type in option_fields(type(self)):
            _check(field, value_type, getattr(self, field.name))

    @classmethod
    def quick(cls, **overrides: Any) -> Self:
        """Return settings for a run of a few minutes, which shows that everything works; overrides take precedence."""
        declared = {field.name: field.metadata["declaration"].quick for field in dataclasses.fields(cls)
                    if field.metadata}
        return cls(**{name: value for name, value in declared.items() if value is not _UNSET} | overrides)

    @classmethod
    def from_command_line(cls, report: Reporter | None, quick: bool = False, **values: Any) -> Self:
        """Return the settings for the options of a command line; a study that searches for data overrides this."""
        return cls.quick(**values) if quick else cls(**values)


def option_fields(settings: type[StudySettings]) -> list[tuple[dataclasses.Field, Any]]:
    """Return the fields that are options of the command line, with their types without None; the seed is last."""
    hints = typing.get_type_hints(settings)
    fields = [field for field in dataclasses.fields(settings) if field.metadata and field.metadata["declaration"].help]
    fields.sort(key=lambda field: field.name == "seed")
    members = {field.name: typing.get_args(hint) if isinstance(hint := hints[field.name], types.UnionType) else [hint]
               for field in fields}
    return [(field, next(member for member in members[field.name] if member is not types.NoneType))
            for field in fields]


def _check(field: dataclasses.Field, value_type: Any, value: Any) -> None:
    """Raise ValueError or TypeError, naming the setting, for a value that is not permitted."""
    declaration: SettingDeclaration = field.metadata["declaration"]
    if value is None and field.default is None:
        return
    if declaration.parts:
        checks.sizes(field.name, value, declaration.parts)
    elif typing.get_origin(value_type) is tuple:
        _check_sequence(field.name, typing.get_args(value_type)[0], value, declaration)
    elif value_type is int:
        _check_count(field.name, value, declaration)
    elif value_type is float:
        checks.positive(field.name, value)
    elif declaration.choices:
        checks.one_of(field.name, value, declaration.choices)


def _check_sequence(name: str, entry_type: type, value: Any, declaration: SettingDeclaration) -> None:
    is_nonempty = isinstance(value, tuple) and len(value) > 0
    if declaration.increasing and not (is_nonempty and list(value) == sorted(set(value))):
        raise ValueError(f"{name} must be a tuple of increasing numbers, got {value!r}.")
    if not is_nonempty or (entry_type is int or declaration.choices) and len(set(value)) < len(value):
        entries = "numbers" if entry_type is int else "labels"
        raise ValueError(f"{name} must be a tuple of different {entries}, at least one, got {value!r}.")
    for entry in value:
        if entry_type is int:
            _check_count(name, entry, declaration)
        elif declaration.choices:
            checks.one_of(name, entry, declaration.choices)


def _check_count(name: str, value: Any, declaration: SettingDeclaration) -> None:
    if declaration.least > 0 or not isinstance(value, int):
        checks.positive_integer(name, value)
    if value < declaration.least:
        raise ValueError(f"{name} must be at least {declaration.least}, got {value}.")
    if declaration.per_seed is not None and value > declaration.per_seed:
        raise ValueError(f"{name} is {value}, but one seed has {declaration.per_seed} data sets; use several seeds for "
                         "more.")


@dataclass(frozen=True)
class StudyTable:
    """A table of a study.

    Attributes:
        title: heading; a table without a title is written and not printed.
        frame: one row for each case; the column ``name se`` holds the standard errors of the column ``name``.
        printed: printed version of the table; by default ``frame`` with standard errors in parentheses.
        stored: whether the table is written to files as well as printed.
    """

    title: str
    frame: pd.DataFrame
    printed: pd.DataFrame | None = None
    stored: bool = True

    @classmethod
    def from_rows(cls, title: str, rows: Mapping[str, Mapping[str, Any]]) -> Self:
        """Return a table with the given rows: row name -> column -> value."""
        return cls(title, pd.DataFrame.from_dict(rows, orient="index"))


@dataclass(frozen=True)
class StudyResult:
    """Results of a study.

    Attributes:
        settings: settings of the run.
        results: task name -> result.
        data: results as one dataset for each kind of task.
        study_tables: file name -> table.
        notes: remarks on the tables.
    """

    settings: Any
    results: Results
    data: Data
    study_tables: dict[str, StudyTable]
    notes: tuple[str, ...] = ()

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """File name -> table, for all tables that are written to files."""
        return {name: table.frame for name, table in self.study_tables.items() if table.stored}

    @property
    def printed(self) -> dict[str, pd.DataFrame]:
        """Title -> printed version of the table."""
        return {table.title: scores.readable(table.frame) if table.printed is None else table.printed
                for table in self.study_tables.values() if table.title}


def _no_notes(settings: Any, data: Data) -> tuple[str, ...]:
    return ()


def _accept(settings: Any, report: Reporter | None) -> None:
    """Accept any settings."""


def _kind_by_name(task: Task) -> str:
    return task.settings.get("what", task.name.partition("/")[0])


@dataclass(frozen=True)
class Study:
    """A study.

    Attributes:
        settings: class of the settings.
        tasks: map from settings to tasks, in the order of computation.
        kinds: kind of task -> computation and layout of its results.
        tables: map from settings and data to tables by file name.
        figures: map from settings and data to figures by file name.
        coords: coordinate of the datasets -> its dimension and values.
        label: header of the first column of the tables, which holds the row names.
        notes: map from settings and data to remarks on the tables.
        follow_up_tasks: map from settings and the results of ``tasks`` to further tasks.
        check: check of the settings before the computation; its second argument reports progress.
        task_kind: map from a task to its kind; by default the task's setting ``what``, else the first part of its name.
    """

    settings: type[StudySettings]
    tasks: Callable[[Any], list[Task]]
    kinds: Mapping[str, TaskKind]
    tables: Callable[[Any, Data], dict[str, StudyTable]]
    figures: Callable[[Any, Data], dict[str, Figure]]
    coords: Mapping[str, tuple[str, Sequence[Any]]] = dataclasses.field(default_factory=dict)
    label: str = "case"
    notes: Callable[[Any, Data], tuple[str, ...]] = _no_notes
    follow_up_tasks: Callable[[Any, Results], list[Task]] | None = None
    check: Callable[[Any, Reporter | None], None] = _accept
    task_kind: Callable[[Task], str] = _kind_by_name

    def run(self, settings: Any, folder: str | Path, *, overwrite: bool = False, report: Reporter | None = None,
            workers: Workers = 1) -> StudyResult:
        """Compute all tasks that ``folder`` does not hold yet, and derive the tables.

        Args:
            settings: settings of the study.
            folder: folder of the study; its subfolder ``tasks`` holds one file for each task.
            overwrite: whether to recompute results that were stored with other settings.
            report: function called with each line of progress.
            workers: processes that compute; see `run_tasks`.

        Raises:
            FileNotFoundError, ValueError: data are missing or cannot be used, or the folder holds results of other
                settings.
        """
        self.check(settings, report)
        compute = functools.partial(_compute, self.task_kind, {kind: self.kinds[kind].compute for kind in self.kinds})
        run_all = functools.partial(run_tasks, compute=compute, folder=Path(folder) / TASKS, overwrite=overwrite,
                                    report=report)
        tasks = self.tasks(settings)
        if self.follow_up_tasks is None:
            return self.tabulate(settings, run_all(tasks, workers=workers), tasks)
        with start_workers(workers) as pool:  # starting workers takes seconds: both rounds share them
            results = run_all(tasks, workers=pool or 1)
            more_tasks = self.follow_up_tasks(settings, results)
            return self.tabulate(settings, results | run_all(more_tasks, workers=pool or 1), [*tasks, *more_tasks])

    def tabulate(self, settings: Any, results: Results, tasks: Sequence[Task] | None = None) -> StudyResult:
        """Return datasets, tables and notes for the results of all tasks; the tasks follow from the settings."""
        data = self.collect(settings, results, tasks)
        return StudyResult(settings, results, data, self.tables(settings, data), self.notes(settings, data))

    def collect(self, settings: Any, results: Results, tasks: Sequence[Task] | None = None) -> Data:
        """Return the results of all tasks as one dataset for each kind."""
        data = {}
        for kind, tasks_of_kind in self.tasks_by_kind(settings, results, tasks).items():
            dataset = self.kinds[kind].collect(tasks_of_kind, results)
            data[kind] = dataset.assign_coords({
                name: (dim, list(values)) for name, (dim, values) in self.coords.items() if dim in dataset.dims})
        return data

    def tasks_by_kind(self, settings: Any, results: Results,
                      tasks: Sequence[Task] | None = None) -> dict[str, list[Task]]:
        """Return the tasks of each kind, in the order of the kinds, without kinds that have no tasks."""
        if tasks is None:
            tasks = self.tasks(settings)
            if self.follow_up_tasks is not None:
                tasks = [*tasks, *self.follow_up_tasks(settings, {task.name: results[task.name] for task in tasks})]
        by_kind = {kind: [task for task in tasks if self.task_kind(task) == kind] for kind in self.kinds}
        return {kind: tasks_of_kind for kind, tasks_of_kind in by_kind.items() if tasks_of_kind}

    def save(self, result: StudyResult, folder: str | Path) -> list[Path]:
        """Write tables as CSV and as Markdown, and figures as PNG, over older ones; return the paths."""
        folder, written = Path(folder), []
        for name, table in result.tables.items():
            written.append(write_csv(table, folder / f"{name}.csv", True, index_label=self.label))
            written.append(write_markdown(scores.readable(table), folder / f"{name}.md", True))
        for name, figure in self.figures(result.settings, result.data).items():
            written.append(folder / f"{name}.png")
            with atomic_write(written[-1], True) as temporary, style.in_style():
                figure.savefig(temporary, format="png")
        return written


def _compute(task_kind: Callable[[Task], str], functions: Mapping[str, Callable[[Task], Result]], task: Task) -> Result:
    """Return the result of a task; at the top level, so that processes can pickle it."""
    return functions[task_kind(task)](task)
