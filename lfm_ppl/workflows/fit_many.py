"""Fits of one NumPyro model to many data sets: one after another or in several processes, and resumable.

1. Each data set becomes a task, whose settings are digests of data and model, and the options of `lfm_ppl.fit`. The
   seed of a fit depends on the seed of the run and on the name of the data set only.
2. `lfm_ppl.parallel` computes the tasks without a stored result, and stores each one (`lfm_ppl.results.packing`).
3. At the end a table, the draws of all data sets and the list of failures are written.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from lfm_ppl.inference.unbound_model import SharedModel
from lfm_ppl.parallel.cluster import Workers, check_workers
from lfm_ppl.parallel.run import outcomes
from lfm_ppl.parallel.task import Task
from lfm_ppl.results import arviz_data, tables
from lfm_ppl.results.packing import unpack_result
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.utils import checks
from lfm_ppl.utils.progress import Console, Reporter
from lfm_ppl.workflows.fit import fit
from lfm_ppl.workflows.fit_tasks import FitDataSet, fit_task

_GROUPS = "posterior", "sample_stats", "truth"
_SHARED_ATTRIBUTES = ("model", "rule", "steps", "max_step", "tolerance", "method", "sampler", "chains",
                      "warmup", "samples", "thin", "versions")
"""Groups and attributes of the object of all data sets."""

_NOT_SHARED = ("numpyro_model", "times", "y", "seed", "progress", "truth", "name", "checkpoint", "resume", "overwrite")
"""Arguments of `fit` that differ between data sets, or that `fit_many` does not have."""


@dataclasses.dataclass(frozen=True)
class Fitted:
    """The fit of one data set.

    ``result`` is the ArviZ object that `fit` returns, or None after an ``error``; ``stored`` says whether it was stored
    before this run.
    """

    name: str
    result: Any
    error: Exception | None = None
    stored: bool = False


class ManyFits:
    """The fits of many data sets, returned by `fit_many`.

    An iteration computes the results that are not stored yet, and yields a `Fitted` for each data set when it ends.
    Then `summary`, `failed` and `combined` cover all data sets. With a folder, a second iteration computes nothing.

    Attributes:
        names: names of the data sets.
        failed: name of a data set -> reason of its failure, so far.
        refused: name of a further data set -> reason why it has no data, such as an unreadable file; it counts as
            failed.
    """

    def __init__(self, compute: FitDataSet, tasks: Mapping[str, Task], out: Path | None, **task_options: Any) -> None:
        self.names = tuple(tasks)
        self.failed: dict[str, str] = {}
        self.refused: dict[str, str] = {}
        self._compute, self._tasks, self._out, self._task_options = compute, tasks, out, task_options
        self._tables: dict[str, pd.DataFrame] = {}
        self._draws: dict[str, dict[str, xr.Dataset]] = {}
        self._attrs: Mapping[str, Any] = {}

    def __len__(self) -> int:
        """Return the number of data sets."""
        return len(self.names) + len(self.refused)

    def __iter__(self) -> Iterator[Fitted]:
        """Yield the fit of each data set as it ends."""
        self.failed = dict(self.refused)
        for name, reason in self.refused.items():
            yield Fitted(name, None, ValueError(reason))
        names = {task.name: name for name, task in self._tasks.items()}
        folder = None if self._out is None else self._out / "fits"
        for outcome in outcomes(self._tasks.values(), self._compute, folder, **self._task_options):
            name, result = names[outcome.task.name], None
            if outcome.result is None:
                self.failed[name] = outcome.reason
            else:
                result = unpack_result(outcome.result)
                view = ResultView.of(result)
                self._tables[name], self._attrs = arviz_data.summary(view), view.attrs
                self._draws[name] = {group: view.groups[group] for group in _GROUPS if group in view.groups}
            yield Fitted(name, result, outcome.error, outcome.stored)
        if self._out is not None:
            self._write(self._out)

    def run(self) -> ManyFits:
        """Compute the results that are not stored yet, and return itself."""
        for _ in self:
            pass
        return self

    @property
    def summary(self) -> pd.DataFrame:
        """A row for each data set and parameter, with the columns of `lfm_ppl.results.arviz_data.summary`."""
        tables = {name: self._tables[name] for name in self.names if name in self._tables}
        return pd.concat(tables, names=["data set", "parameter"]) if tables else pd.DataFrame()

    @property
    def overview(self) -> pd.DataFrame:
        """A row for each parameter: its posterior means over the data sets, and the worst diagnostics.

        Columns: the number of ``data sets``, the ``mean`` of the posterior means with their standard deviation
        ``between sets``, the least and the largest of them ``lowest`` and ``highest``, the mean posterior standard
        deviation ``within a set``, and of chains the ``least ESS`` and the largest ``R-hat``.
        """
        summary = self.summary
        if summary.empty:
            return summary
        grouped = summary.groupby(level="parameter", sort=False)
        table = pd.DataFrame({
            "data sets": grouped["mean"].count(), "mean": grouped["mean"].mean(), "between sets": grouped["mean"].std(),
            "lowest": grouped["mean"].min(), "highest": grouped["mean"].max(), "within a set": grouped["sd"].mean()})
        if "ess_bulk" not in summary:  # draws about a mode
            return table
        return table.assign(**{"least ESS": grouped["ess_bulk"].min(), "R-hat": grouped["r_hat"].max()})

    def combined(self) -> Any:
        """Return one ArviZ object of all data sets, along a dimension ``data_set``.

        It holds the groups ``posterior``, ``sample_stats`` and ``truth`` if there are any. Parameters and draws that
        some data sets do not have are NaN there.

        Raises:
            ValueError: no data set has a posterior.
        """
        if not self._draws:
            raise ValueError("there is no posterior: no data set was fitted yet, or all of them failed.")
        joined = {}
        for group in _GROUPS:
            datasets = {name: self._draws[name][group] for name in self.names if group in self._draws.get(name, ())}
            if datasets:
                index = xr.DataArray(np.array(list(datasets), str), dims="data_set", name="data_set")
                dataset = xr.concat(list(datasets.values()), index, join="outer", data_vars="all", coords="minimal",
                                    compat="override")
                joined[group] = dataset.transpose("chain", "draw", "data_set", ..., missing_dims="ignore")
        shared = {name: value for name, value in self._attrs.items() if name in _SHARED_ATTRIBUTES}
        return arviz_data.build(joined, {**shared, "data_sets": len(self._draws)})

    def _write(self, out: Path) -> None:
        """Write the table, the draws and the failures of all data sets."""
        if self._draws:
            arviz_data.save(self.combined(), out / "posteriors.nc", overwrite=True)
            rows = self.summary.reset_index().set_index("data set")
            tables.write_csv(rows, out / "summary.csv", overwrite=True, index_label="data set")
        (out / "failed.csv").unlink(missing_ok=True)
        if self.failed:
            reasons = pd.DataFrame({"reason": self.failed})
            tables.write_csv(reasons, out / "failed.csv", overwrite=True, index_label="data set")


def fit_many(
    numpyro_model: Callable,
    data_sets: Mapping[str, Any] | Iterable[tuple[str, Any]],
    *,
    checkpoint: str | Path | None = None,
    workers: Workers = 1,
    seed: int = 0,
    each: Mapping[str, Mapping[str, Any]] | None = None,
    overwrite: bool = False,
    progress: bool = True,
    report: Reporter | None = None,
    **options: Any,
) -> ManyFits:
    """Fit a latent force model to each of many data sets.

    Data sets of equal shapes share the compiled programs of `fit` in each process, with individual times, known inputs
    and doses (`lfm.bind` names the exceptions), and the processes of one machine share a cache of compiled programs.
    The result of a data set is that of `fit` with the seed ``seed_of(name, seed)``, for any other data sets and any
    number of workers. The model, with all that it calls and reads, must not change while the results are iterated: a
    program is compiled once, for the model as it is then.

    Args:
        numpyro_model: the model, as in `fit`.
        data_sets: name -> ``(times, y)`` or `lfm.Data`, or an iterable of such pairs. Names are texts.
        checkpoint: folder of the results, so that a stopped run can be resumed: ``fits/``, a file for each data set,
            and at the end ``summary.csv``, ``posteriors.nc`` and, after failures, ``failed.csv``. None: nothing is
            stored.
        workers: 1: this process; more: the number of processes on this machine; ``"tcp://host:port"``: the workers of a
            Dask scheduler. A script that starts processes needs ``if __name__ == "__main__":``.
        seed: seed of all random numbers.
        each: name of a data set -> arguments of `fit` for this data set, as in ``{"patient-7": {"fixed": ...}}``; also
            ``truth`` and ``name``.
        overwrite: fit again where the folder has a result of other data, another model or other options.
        progress: show the number of fitted data sets and the time left on standard error, as in `fit`.
        report: function that gets each line of progress instead, such as ``print``.
        **options: further arguments of `fit`, such as ``sampler="map"``.

    Returns:
        The fits, which are computed during the iteration. A failed data set does not stop the others.

    Raises:
        ValueError, TypeError: no data set, a duplicate name, an unknown option.

    Example:
        >>> import jax.numpy as jnp, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        ...     lfmodel = lfm.LatentForceModel(
        ...         lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(lfmodel, times), obs=y)
        >>> times = np.arange(5.0)
        >>> data_sets = {f"plant-{k}": (times, np.sin(times + k)[:, None]) for k in range(3)}
        >>> fits = lfm.fit_many(model, data_sets, sampler="map", samples=50, trajectory_draws=0, progress=False)
        >>> for fitted in fits:
        ...     print(fitted.name, fitted.result["posterior"]["rate"].shape)
        plant-0 (1, 50)
        plant-1 (1, 50)
        plant-2 (1, 50)
        >>> fits.combined()["posterior"]["rate"].dims, fits.summary.shape[0], fits.failed
        (('chain', 'draw', 'data_set'), 3, {})
    """
    if not callable(numpyro_model):
        raise TypeError(f"numpyro_model must be a function of times and y, got {type(numpyro_model).__name__}.")
    check_workers(workers)
    shared = [name for name in inspect.signature(fit).parameters if name not in _NOT_SHARED]
    _check_options("options", options, shared)
    pairs = list(data_sets.items() if isinstance(data_sets, Mapping) else data_sets)
    if not pairs:
        raise ValueError("data_sets is empty; expected at least one pair of a name and (times, y).")
    own_options, names = dict(each or {}), dict(pairs)
    for name in own_options:
        checks.one_of("data set in each", name, names)
        _check_options(f"each[{name!r}]", own_options[name], [*shared, "truth", "name"])
    tasks: dict[str, Task] = {}
    compute = FitDataSet(SharedModel(numpyro_model))
    digests: dict[Any, str] = {}
    for name, value in pairs:
        if not isinstance(name, str) or not name:
            raise TypeError(f"the names of data sets must be texts, got {name!r}.")
        if name in tasks:
            raise ValueError(f"two data sets are called {name!r}; give every one a name of its own.")
        tasks[name] = fit_task(compute.model, name, value, {**options, **own_options.get(name, {})}, seed, digests)
    return ManyFits(compute, tasks, None if checkpoint is None else Path(checkpoint), workers=workers,
                    overwrite=overwrite, report=(report or Console()) if progress else None)


def _check_options(label: str, options: Mapping[str, Any], accepted: list[str]) -> None:
    for name in options:
        if name not in accepted:
            raise TypeError(f"{label}: {checks.unknown('argument of fit', name, accepted)}")
