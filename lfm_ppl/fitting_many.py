"""From a NumPyro model and many data sets to as many posteriors: one by one, in several processes, resumable."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import json
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd
import xarray as xr

from lfm_ppl import checks
from lfm_ppl.data import Data, model_keywords
from lfm_ppl.engine.cluster import Workers, check_workers
from lfm_ppl.engine.run import Reporter, outcomes
from lfm_ppl.engine.task import Task, check_distinct
from lfm_ppl.fitting import fit
from lfm_ppl.inference.bound_model import bind
from lfm_ppl.inference.model_digest import model_digest
from lfm_ppl.results import arviz_data, tables
from lfm_ppl.results.checkpoint import digest

FITS, SUMMARY, POSTERIORS, FAILED = "fits", "summary.csv", "posteriors.nc", "failed.csv"
"""What a folder of results holds: a file for each data set, and over all of them a table, draws, and what failed."""

WARNINGS = "warnings"
"""Attribute of a result: what `fit` warned of, as a list in JSON."""

_OWN = ("numpyro_model", "times", "y", "seed", "progress", "truth", "name", "checkpoint", "resume", "overwrite")
"""Arguments of `fit` that a data set has of its own, or none of."""

_STRUCTURE = "structure"


class Fitted(NamedTuple):
    """What came of one data set.

    Attributes:
        name: of the data set.
        result: the ArviZ object that `fit` returns; None where it failed.
        error: why it failed.
        stored: whether the result was there before this run.
    """

    name: str
    result: Any
    error: Exception | None = None
    stored: bool = False


class ManyFits:
    """The fits of many data sets; made by `fit_many`.

    Iterating over it computes what is not stored yet, and yields a `Fitted` for each data set as it ends; afterwards
    `summary`, `failed` and `combined` tell of all of them. Iterating again computes nothing where there is a folder.

    Attributes:
        names: of the data sets.
        failed: name of a data set -> why it failed, so far.
        refused: name of a further data set -> why there is none, such as a file that cannot be read; failed, too.
    """

    def __init__(self, model: Callable, tasks: Mapping[str, Task], out: Path | None, engine: Mapping[str, Any]) -> None:
        self.names = tuple(tasks)
        self.failed: dict[str, str] = {}
        self.refused: dict[str, str] = {}
        self._model, self._tasks, self._out, self._engine = model, dict(tasks), out, dict(engine)
        self._tables: dict[str, pd.DataFrame] = {}
        self._draws: dict[str, dict[str, xr.Dataset]] = {}
        self._attrs: dict[str, Any] = {}

    def __len__(self) -> int:
        """Return the number of data sets."""
        return len(self.names) + len(self.refused)

    def __iter__(self) -> Iterator[Fitted]:
        """Yield the fit of each data set as it ends."""
        self.failed = dict(self.refused)
        for name, reason in self.refused.items():
            yield Fitted(name, None, ValueError(reason))
        names = {task.name: name for name, task in self._tasks.items()}
        for one in outcomes(self._tasks.values(), _Fit(self._model), self._out and self._out / FITS, alike=True,
                            **self._engine):
            name = names[one.task.name]
            if one.result is None:
                self.failed[name] = one.reason
                yield Fitted(name, None, one.error)
            else:
                result = unpacked(one.result)
                self._keep(name, result)
                yield Fitted(name, result, stored=one.stored)
        if self._out is not None:
            self._write(self._out)

    def run(self) -> ManyFits:
        """Compute all that is not stored yet, and return itself."""
        for _ in self:
            pass
        return self

    def _keep(self, name: str, result: Any) -> None:
        self._tables[name] = arviz_data.summary(result)
        self._attrs = arviz_data.attributes(result)
        self._draws[name] = {group: arviz_data.group(result, group) for group in ("posterior", "sample_stats", "truth")
                             if arviz_data.has_group(result, group)}

    @property
    def summary(self) -> pd.DataFrame:
        """A row for each data set and parameter, with the columns of `lfm_ppl.results.arviz_data.summary`."""
        kept = {name: self._tables[name] for name in self.names if name in self._tables}
        return pd.concat(kept, names=["data set", "parameter"]) if kept else pd.DataFrame()

    @property
    def overview(self) -> pd.DataFrame:
        """A row for each parameter: its posterior means over the data sets, and the worst diagnostics.

        Columns: the number of ``data sets``, the ``mean`` of the posterior means with their standard deviation
        ``between sets``, the least and the largest of them ``lowest`` and ``highest``, the mean posterior standard
        deviation ``within a set``, and of chains the ``least ESS`` and the largest ``R-hat``.
        """
        found = self.summary
        if found.empty:
            return found
        grouped = found.groupby(level="parameter", sort=False)
        table = pd.DataFrame({
            "data sets": grouped["mean"].count(), "mean": grouped["mean"].mean(), "between sets": grouped["mean"].std(),
            "lowest": grouped["mean"].min(), "highest": grouped["mean"].max(), "within a set": grouped["sd"].mean()})
        if "ess_bulk" not in found:  # draws about a mode
            return table
        return table.assign(**{"least ESS": grouped["ess_bulk"].min(), "R-hat": grouped["r_hat"].max()})

    def combined(self) -> Any:
        """Return one ArviZ object of all data sets, along a dimension ``data_set``.

        It holds the groups ``posterior``, ``sample_stats`` and ``truth``, as far as there are any. What the data sets
        do not share, such as a parameter or draws, is NaN where it is missing.

        Raises:
            ValueError: no data set has a posterior.
        """
        kept = [name for name in self.names if name in self._draws]
        if not kept:
            raise ValueError("there is no posterior: no data set was fitted yet, or all of them failed.")
        joined = {}
        for group in dict.fromkeys(group for name in kept for group in self._draws[name]):
            own = [name for name in kept if group in self._draws[name]]
            along = xr.concat([self._draws[name][group] for name in own], _named(own), join="outer", data_vars="all",
                              coords="minimal", compat="override")
            first = [name for name in ("chain", "draw") if name in along.dims]
            joined[group] = along.transpose(*first, "data_set", ...)
        shared = {name: value for name, value in self._attrs.items() if name in (
            "model", "rule", "steps", "max_step", "iterations", "tolerance", "sampler", "chains", "warmup", "samples",
            "thin", "versions")}
        return arviz_data.build(joined, {**shared, "data_sets": len(kept)})

    def _write(self, out: Path) -> None:
        """Write what is made of all fits anew."""
        if self._draws:
            arviz_data.save(self.combined(), out / POSTERIORS, overwrite=True)
            flat = self.summary.reset_index().set_index("data set")
            tables.write_csv(flat, out / SUMMARY, overwrite=True, index_label="data set")
        (out / FAILED).unlink(missing_ok=True)
        if self.failed:
            reasons = pd.DataFrame({"reason": self.failed})
            tables.write_csv(reasons, out / FAILED, overwrite=True, index_label="data set")


def fit_many(
    numpyro_model: Callable,
    data_sets: Mapping[str, Any] | Iterable[tuple[str, Any]],
    *,
    out: str | Path | None = None,
    workers: Workers = 1,
    seed: int = 0,
    each: Mapping[str, Mapping[str, Any]] | None = None,
    overwrite: bool = False,
    report: Reporter | None = None,
    **options: Any,
) -> ManyFits:
    """Fit a latent force model to many data sets, each by itself.

    Data sets with equal times and shapes share the compiled programs of `fit` in each process, and processes share what
    they compile: on one machine the first data set is fitted by itself, or at least begins a minute before the others.
    The numbers of a data set follow from the seed and from its name alone: they are those of a `fit` with the seed
    `seed_of` gives, whatever other data sets there are and however many workers.

    Args:
        numpyro_model: as for `fit`.
        data_sets: name -> ``(times, y)`` or `lfm.Data`, or an iterable of such pairs. Names are texts.
        out: folder of the results, so that a run that was stopped goes on where it was: ``fits/``, a file for each data
            set, and at the end ``summary.csv``, ``posteriors.nc`` and, where any failed, ``failed.csv``. None: nothing
            is stored.
        workers: 1: this process; more: so many others of this machine; ``"tcp://host:port"``: those of a scheduler of
            Dask. A script that starts processes needs ``if __name__ == "__main__":``.
        seed: of everything random.
        each: name of a data set -> arguments of `fit` that it has of its own, as in ``{"patient-7": {"fixed": ...}}``;
            ``truth`` and ``name`` are possible, too.
        overwrite: fit again where the folder has a result of other data, another model or other options.
        report: what to do with a line of progress, such as ``print``; None: nothing.
        **options: further arguments of `fit`, such as ``sampler="map"``.

    Returns:
        The fits, computed as one iterates over them. A data set that fails stops no other one.

    Raises:
        ValueError, TypeError: no data set, a name that stands twice, an unknown option.

    Example:
        >>> import jax.numpy as jnp, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        ...     lfmodel = lfm.LatentForceModel(
        ...         lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(lfmodel, times), obs=y)
        >>> times = np.arange(5.0)
        >>> data_sets = {f"plant-{k}": (times, np.sin(times + k)[:, None]) for k in range(3)}
        >>> fits = lfm.fit_many(model, data_sets, sampler="map", samples=50, trajectory_draws=0)
        >>> for one in fits:
        ...     print(one.name, one.result["posterior"]["rate"].shape)
        plant-0 (1, 50)
        plant-1 (1, 50)
        plant-2 (1, 50)
        >>> fits.combined()["posterior"]["rate"].dims, fits.summary.shape[0], fits.failed
        (('chain', 'draw', 'data_set'), 3, {})
    """
    if not callable(numpyro_model):
        raise TypeError(f"numpyro_model must be a function of times and y, got {type(numpyro_model).__name__}.")
    check_workers(workers)
    known = [name for name in inspect.signature(fit).parameters if name not in _OWN]
    _check_options("options", options, known)
    pairs = list(data_sets.items() if isinstance(data_sets, Mapping) else data_sets)
    if not pairs:
        raise ValueError("data_sets is empty; expected at least one pair of a name and (times, y).")
    each = dict(each or {})
    names = [name for name, _ in pairs]
    for name in each:
        if name not in names:
            raise ValueError(checks.unknown("data set in each", name, names))
        _check_options(f"each[{name!r}]", each[name], [*known, "truth", "name"])
    tasks: dict[str, Task] = {}
    digests: dict[Any, str] = {}
    for name, value in pairs:
        if not isinstance(name, str) or not name:
            raise TypeError(f"the names of data sets must be texts, got {name!r}.")
        if name in tasks:
            raise ValueError(f"two data sets are called {name!r}; give every one a name of its own.")
        tasks[name] = _task(numpyro_model, name, value, {**options, **each.get(name, {})}, seed, digests)
    check_distinct(tasks.values())
    return ManyFits(numpyro_model, tasks, None if out is None else Path(out),
                    {"workers": workers, "overwrite": overwrite, "report": report})


def seed_of(name: str, seed: int = 0) -> int:
    """Return the seed with which `fit_many` fits a data set.

    Example:
        >>> seed_of("plant-0") != seed_of("plant-1")
        True
    """
    return int.from_bytes(hashlib.sha256(f"{seed}/{name}".encode()).digest()[:4], "big") >> 1


def _check_options(what: str, given: Mapping[str, Any], known: list[str]) -> None:
    for name in given:
        if name not in known:
            raise TypeError(f"{what}: {checks.unknown('argument of fit', name, known)}")


def _task(model: Callable, name: str, value: Any, options: dict[str, Any], seed: int, digests: dict[Any, str]) -> Task:
    keywords = options.get("model_kwargs") or {}
    if isinstance(value, Data):
        times, y = value.times, value.y
        keywords = model_keywords(value.inputs, keywords)
    else:
        if isinstance(value, (list, tuple)) and value:  # units that the gaps of data sets decide could differ
            checks.refuse_dates(f"data set {name!r}: times", value[0])
        try:
            times, y = (np.asarray(checks.unmask(part), float) for part in value)
        except (TypeError, ValueError):
            raise TypeError(f"data set {name!r} must be (times, y) or lfm.Data, got {type(value).__name__}.") from None
    options = {"name": getattr(model, "__name__", "model"), "seed": seed_of(name, seed), **options}
    named = {key: one for key, one in options.items() if key not in ("truth", "name", "seed", "model_kwargs")}
    settings = {"data": digest(times, y), "model": _model_digest(model, times, y, keywords, digests),
                "options": _plain({**named, "model_kwargs": keywords})}
    if isinstance(value, Data):
        settings["named"] = _plain({"outputs": value.outputs, "units": dict(value.units), "origin": value.origin})
    data = (value, None) if isinstance(value, Data) else (times, y)
    return Task(file_name(name), seed, settings, (*data, options))


def _model_digest(model: Callable, times: np.ndarray, y: np.ndarray, keywords: Any, digests: dict[Any, str]) -> str:
    """Return a short text that another model, or the same one after its code has changed, does not have."""
    key = (times.tobytes(), y.shape, json.dumps(_plain(dict(keywords or {}))))
    if key not in digests:
        try:
            digests[key] = model_digest(bind(model, times, y, **dict(keywords or {}))) or "unknown"
        except Exception:  # what is wrong with this data set is told when its turn comes
            return "none"
    return digests[key]


def _plain(value: Any) -> Any:
    """Return a value as JSON knows it; what has no such form by its name."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else repr(value)
    if hasattr(value, "tolist"):
        return _plain(np.asarray(value).tolist())
    leaves = jax.tree_util.tree_leaves(value)
    if not (len(leaves) == 1 and leaves[0] is value):  # a known input
        return [type(value).__name__, *map(_plain, leaves)]
    return re.sub(r" at 0x[0-9a-f]+", "", getattr(value, "__qualname__", repr(value)))


def file_name(name: str) -> str:
    """Return the name as a file may have it; what had to be changed gets a digest, so that no two become one."""
    safe = re.sub(r"[^A-Za-z0-9_.()-]", "_", name)[:80]
    safe = safe if safe.strip(".") else f"_{safe}"
    return safe if safe == name else f"{safe}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def _named(names: list[str]) -> xr.DataArray:
    return xr.DataArray(np.array(names, str), dims="data_set", name="data_set")


@dataclasses.dataclass(frozen=True)
class _Fit:
    """From a task, a data set, to the result of its fit, as arrays."""

    model: Callable

    def __call__(self, task: Task) -> dict[str, Any]:
        times, y, options = task.data
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            result = fit(self.model, times, y, progress=False, **options)
        said = [str(one.message) for one in caught if issubclass(one.category, UserWarning)]
        return packed(result, {WARNINGS: json.dumps(said)})


def packed(result: Any, attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Return an ArviZ object as arrays by name, with further attributes."""
    found: dict[str, Any] = {}
    structure: dict[str, Any] = {"attrs": {**arviz_data.attributes(result), **attrs}, "groups": {}}
    for group in arviz_data.groups(result):
        dataset = arviz_data.group(result, group)
        parts = {"data_vars": dataset.data_vars, "coords": dataset.coords}
        structure["groups"][group] = {part: {
            str(name): {"dims": list(map(str, one.dims)), "attrs": dict(one.attrs)} for name, one in own.items()}
            for part, own in parts.items()} | {"attrs": dict(dataset.attrs)}
        for part, own in parts.items():
            for name, one in own.items():
                values = np.asarray(one.values)
                found[f"{group}/{part}/{name}"] = values.astype(str) if values.dtype.kind == "O" else values
    found[_STRUCTURE] = json.dumps(structure, default=lambda value: np.asarray(value).tolist())
    return found


def unpacked(found: Mapping[str, Any]) -> Any:
    """Return the ArviZ object that `packed` made arrays of."""
    structure = json.loads(str(found[_STRUCTURE]))
    groups = {}
    for group, own in structure["groups"].items():
        parts = {part: {name: (one["dims"], found[f"{group}/{part}/{name}"], one["attrs"])
                        for name, one in own[part].items()} for part in ("data_vars", "coords")}
        groups[group] = xr.Dataset(parts["data_vars"], parts["coords"], own["attrs"])
    return arviz_data.build(groups, structure["attrs"])
