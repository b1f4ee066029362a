"""The result of a fit as an ArviZ object, on ArviZ 0.23 and on ArviZ 1.x.

1. ArviZ 0.23 keeps groups in an ``InferenceData``, ArviZ 1.x in an ``xarray.DataTree``. Only this module, which makes
   and changes results, and `lfm_ppl.results.result_view`, which reads them, depend on the difference.
2. `save` and `load` write and read netCDF files, atomically.
3. `summary` tabulates the scalar parameters; `convergence_warnings` checks the chains.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from lfm_ppl.results import convergence, netcdf
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.scalars import scalar_draws, scalar_truth
from lfm_ppl.storage import files

LIBRARY = "lfm_ppl"

FACTORS = "factor_failures"
"""Attribute of a result: counts of `lfm_ppl.inference.factor_failures`, as JSON."""

WEIGHTS = "constraint_weights"
"""Attribute of a result under constraints: `factor_failures.PathESS`, effective sample sizes, as JSON."""

MODE = "mode"
"""Attribute of a result of sampler "map": name -> value at the posterior mode, as JSON."""

DEGENERATE = "degenerate_mode"
"""Attribute of a result of sampler "map": parameter -> entries at whose mode the density has a spike, as JSON."""

_SMALLEST_TAIL = 5
"""Fewest importance ratios that a Pareto distribution can be fitted to."""


def build(groups: Mapping[str, xr.Dataset], attrs: Mapping[str, Any] | None = None) -> Any:
    """Return an ArviZ object of ``groups``: an InferenceData (ArviZ 0.23) or a DataTree (1.x).

    Args:
        groups: group name -> dataset; datasets without variables are left out.
        attrs: attributes of the result as a whole, such as model, rule and seed.

    Returns:
        The ArviZ object. A ``/`` in the name of a variable (NumPyro's scopes) becomes ``.``,
        because neither netCDF nor DataTree can hold it.

    Raises:
        TypeError: a group is not an xarray dataset.

    Example:
        >>> draws = xr.Dataset({"decay": (("chain", "draw"), np.ones((4, 100)))})
        >>> result = build({"posterior": draws}, {"seed": 0})
        >>> list(ResultView.of(result).groups)
        ['posterior']
    """
    checked_groups = {name: _checked(name, dataset) for name, dataset in groups.items()}
    checked_groups = {name: dataset for name, dataset in checked_groups.items() if dataset.data_vars}
    attrs = {"inference_library": LIBRARY, **(attrs or {})}
    if not _uses_datatree():
        return load_arviz().InferenceData(attrs=attrs, **checked_groups)
    tree = xr.DataTree.from_dict({f"/{name}": dataset for name, dataset in checked_groups.items()})
    tree.attrs = attrs
    return tree


def add_group(result: Any, name: str, dataset: xr.Dataset) -> Any:
    """Put ``dataset`` into ``result`` as the group ``name``, replacing one of that name.

    Returns:
        ``result``, which is changed in place.
    """
    dataset, is_tree = _checked(name, dataset), isinstance(result, xr.DataTree)
    if not is_tree:  # InferenceData does not replace a group
        remove_group(result, name)
    result[name] = xr.DataTree(dataset) if is_tree else dataset
    return result


def remove_group(result: Any, name: str) -> Any:
    """Take the group ``name`` out of ``result``, which is changed in place, if it is there; return ``result``."""
    if name in ResultView.of(result).groups:
        del result[name]
    return result


def save(result: Any, path: str | Path, overwrite: bool = False) -> Path:
    """Write a result to a netCDF file, through a temporary name, so that the file is there whole or not at all.

    Args:
        result: what `lfm_ppl.fit` returned: every group, with coordinates, units and attributes, is kept.
        path: the file, for instance ``posterior.nc``; its folder is made.
        overwrite: replace a file that exists.

    Returns:
        ``path`` as a Path.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is False.
        IsADirectoryError: ``path`` is a folder.
        TypeError: ``result`` is no ArviZ object.

    Example:
        >>> import tempfile, lfm_ppl as lfm
        >>> result = build({"posterior": xr.Dataset({"decay": (("chain", "draw"), np.ones((4, 100)))})})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     written = lfm.save(result, Path(folder) / "run" / "posterior.nc")
        ...     again = lfm.load(written.parent)
        >>> list(ResultView.of(again).groups), type(again) is type(result)
        (['posterior'], True)
    """
    view = ResultView.of(result)
    return netcdf.write(view.groups, {"inference_library": LIBRARY, **view.attrs}, path, overwrite)


def load(path: str | Path) -> Any:
    """Read a result that `save` or ``lfm-ppl fit`` wrote, whichever version of ArviZ it was written with.

    Args:
        path: a netCDF file, or a results folder with a ``posterior.nc``.

    Returns:
        The ArviZ object, in memory: an ``InferenceData`` on ArviZ 0.23, an ``xarray.DataTree`` on 1.x.

    Raises:
        FileNotFoundError: there is no such file, or no ``posterior.nc`` in the folder.
        ValueError: it is not netCDF, not written by lfm_ppl, or holds no posterior.

    Example:
        See `save`.
    """
    path = files.locate(path)
    datasets, attrs = netcdf.read(path)
    library = attrs.get("inference_library")
    if library != LIBRARY:
        raise ValueError(f"{path} was not written by lfm_ppl (its inference_library is {library!r}). Read it with "
                         "ArviZ itself, arviz.from_netcdf.")
    if "posterior" not in datasets:
        raise ValueError(f"{path} holds no posterior; its groups are {', '.join(datasets) or 'none'}. Expected the "
                         "file that lfm.save or `lfm-ppl fit` wrote.")
    return build(datasets, attrs)


def summary(result: Any) -> pd.DataFrame:
    """Return one row per scalar parameter, the same on every version of ArviZ.

    Args:
        result: an ArviZ object with a posterior.

    Returns:
        Columns mean, sd, q2.5, q97.5 (quantiles in percent), truth (where a result has it), mcse_mean, ess_bulk,
        ess_tail (the smaller effective size of the 5% and the 95% quantile), r_hat (rank-normalised split R-hat); rows
        labelled ``noise_sd`` or ``decay[CDKN1A]``. Diagnostics are NaN where they do not exist: R-hat of one chain, and
        all diagnostics of fewer than four draws, or of draws that are constant or not finite. Resampled draws are no
        chains: the effective size is that of the importance weights, and there is no R-hat. Draws of a Laplace
        approximation (sampler "map") are independent: the columns are mode, mean, sd, q2.5, q97.5, truth, and
        ``warnings`` where the mode of a parameter is degenerate. A run that was stopped has a further column,
        ``partial``, with the number of draws.

    Raises:
        ValueError: the result has no posterior.

    Example:
        >>> draws = np.random.default_rng(0).normal(size=(4, 100))
        >>> posterior = xr.Dataset({"decay": (("chain", "draw"), draws)})
        >>> list(summary(build({"posterior": posterior})).index)
        ['decay']

    Source: Vehtari et al. (2021), Bayesian Analysis 16(2), eq. 3 and section 4.1.
    """
    view = ResultView.of(result)
    draws = view.draws
    with np.errstate(invalid="ignore"):  # of draws that are not finite
        quantiles = {label: np.quantile(values, (0.025, 0.975)) for label, values in draws.items()}
    moments = {
        "mean": {label: _mean(values) for label, values in draws.items()},
        "sd": {label: _sd(values) for label, values in draws.items()},
        "q2.5": {label: low for label, (low, _) in quantiles.items()},
        "q97.5": {label: high for label, (_, high) in quantiles.items()},
    }
    if view.truth:
        moments["truth"] = view.truth
    if view.is_about_mode:
        table = pd.DataFrame({**_mode(view), **moments}, index=list(draws), dtype=float)
        if degenerate := _degenerate(view):
            table["warnings"] = ["degenerate mode" if label in degenerate else "" for label in table.index]
        return table
    diagnostics = {
        "mcse_mean": _diagnostic(draws, load_arviz().mcse, method="mean"),
        "ess_bulk": _diagnostic(draws, load_arviz().ess, method="bulk"),
        # ArviZ 1.x has another default probability than 0.23.
        "ess_tail": _diagnostic(draws, load_arviz().ess, method="tail", prob=(0.05, 0.95)),
        "r_hat": _diagnostic(draws, load_arviz().rhat, min_chains=2),
    }
    table = pd.DataFrame({**moments, **diagnostics}, index=list(draws), dtype=float)
    if (resampled := view.attrs.get("effective_draws")) is not None:
        table["mcse_mean"] = table["sd"] / np.sqrt(resampled)
        table["ess_bulk"] = float(resampled)
        table[["ess_tail", "r_hat"]] = np.nan
    if (partial := view.attrs.get("partial")) is not None:
        table["partial"] = str(partial).split(",", 1)[0]
    return table


def convergence_warnings(result: Any, table: pd.DataFrame | None = None) -> list[str]:
    """Return what is wrong with the draws of ``result``, one message per finding.

    R-hat above 1.01, bulk or tail effective sample size below 100 per chain, divergences, factors of
    an observation family or of constraints that do not converge, trajectories under constraints that are worth little.
    Draws from a Laplace approximation (sampler "map") are independent, and give none but the last two, and that the
    mode is degenerate.

    Args:
        result: an ArviZ object with a posterior, and sample_stats where there are any.
        table: the rows of its `summary` to judge; None: all.

    Returns:
        Messages that name the parameters, their values, and what to do; empty if all is well.
    """
    view = ResultView.of(result)
    from_mode = view.attrs.get("sampler") == "map"
    of_factors = convergence.of_factors(*(view.decoded(FACTORS) or (0, 0, 0)), constrained="constraints" in view.attrs,
                                    from_mode=from_mode)
    of_factors += convergence.of_weights(*(view.decoded(WEIGHTS) or (0, 0, 0)))
    if view.is_about_mode:
        rows = summary(view) if table is None else table
        degenerate = [label for label in _degenerate(view) if label in rows.index]
        return convergence.of_degenerate_mode(rows.loc[degenerate]) + of_factors
    if from_mode or "effective_draws" in view.attrs:
        return of_factors if from_mode else []
    rows = summary(view) if table is None else table
    sizes = view.posterior.sizes
    return convergence.messages(rows, sizes["chain"], sizes["draw"], int(view.divergences.sum())) + of_factors


def mcse_mean(values: np.ndarray) -> float:
    """Return the Monte Carlo standard error of the mean of (chain, draw) values.

    It is the sd over the root of the effective sample size, which counts as at most the number of values; zero where
    all are equal, NaN where one is not finite. With fewer than four draws a chain, they count as independent.
    """
    if not np.isfinite(values).all() or values.size < 2:
        return np.nan
    if np.ptp(values) == 0.0:
        return 0.0
    size = float(values.size)
    if values.shape[1] >= 4:
        size = min(float(load_arviz().ess(values, method="mean")), size)
    return float(values.std(ddof=1) / np.sqrt(size))


def psis(log_ratio: np.ndarray, relative_efficiency: float = 1.0) -> tuple[np.ndarray, float]:
    """Return Pareto-smoothed, normalised log weights (S,) and the Pareto shape k of log ratios (S,).

    k is -inf where the largest ratios are all equal, and +inf where there are too few to tell.
    Source: Vehtari et al. (2024), Pareto smoothed importance sampling, JMLR 25(72).
    """
    raw = log_ratio - log_ratio.max()
    raw = raw - np.log(np.exp(raw).sum())
    tail = int(min(0.2 * raw.size, 3.0 * np.sqrt(raw.size / relative_efficiency)))
    if tail < _SMALLEST_TAIL:
        return raw, np.inf
    if np.ptp(np.sort(raw)[-tail - 1 :]) == 0.0:
        return raw, -np.inf
    if _uses_datatree():
        from arviz_stats.base import array_stats

        # ArviZ 1.x takes the log of what is divided by.
        smoothed, k = array_stats.psislw(-raw, r_eff=relative_efficiency)
    else:
        smoothed, k = load_arviz().psislw(raw.copy(), relative_efficiency)
    if not np.isfinite(k):  # ties leave too few distinct ratios
        return raw, np.inf
    return np.asarray(smoothed), float(k)


def _mode(view: ResultView) -> dict[str, dict[str, float]]:
    """Return the column of a summary that holds the posterior mode; none where the result does not tell it."""
    posterior = view.posterior
    values = {name.replace("/", "."): np.asarray(value, float) for name, value in view.decoded(MODE).items()}
    named = {name: (posterior[name].dims[2:], value) for name, value in values.items() if name in posterior}
    modes = xr.Dataset(named, {dim: posterior[dim] for dims, _ in named.values() for dim in dims if dim in posterior})
    return {"mode": scalar_truth(posterior, modes)} if named else {}


def _degenerate(view: ResultView) -> list[str]:
    """Return the labels of the parameters whose mode is degenerate."""
    variables = {site.replace("/", "."): indices for site, indices in view.decoded(DEGENERATE).items()}
    labels = {name: list(scalar_draws(view.posterior[[name]])) for name in variables if name in view.posterior}
    return [labels[name][index] for name, indices in variables.items() if name in labels for index in indices]


def _diagnostic(draws: Mapping[str, np.ndarray], measure: Callable, min_chains: int = 1,
                **options: Any) -> dict[str, float]:
    """Return ``measure`` of the draws (chain, draw) of every scalar; NaN where it is not defined."""
    return {label: float(measure(values, **options)) if values.shape[0] >= min_chains and values.shape[1] >= 4
            and np.isfinite(values).all() and np.ptp(values) > 0.0 else np.nan for label, values in draws.items()}


def _mean(values: np.ndarray) -> float:
    return float(values.flat[0] if _equal(values) else values.mean())


def _sd(values: np.ndarray) -> float:
    if values.size < 2 or not np.isfinite(values).all():
        return np.nan
    return 0.0 if _equal(values) else float(values.std(ddof=1))


def _equal(values: np.ndarray) -> bool:
    """Whether all are the same number, whose mean may be rounded."""
    return bool(values.size and (values == values.flat[0]).all())


def _checked(name: str, dataset: Any) -> xr.Dataset:
    if not isinstance(dataset, xr.Dataset):
        raise TypeError(f"group {name!r} must be an xarray.Dataset, got {type(dataset).__name__}.")
    scoped = [variable for variable in dataset.data_vars if "/" in str(variable)]
    return dataset.rename({variable: str(variable).replace("/", ".") for variable in scoped})


def _uses_datatree() -> bool:
    return int(load_arviz().__version__.split(".")[0]) >= 1


@functools.cache
def load_arviz() -> ModuleType:
    """Return ArviZ, imported on first use: it takes two seconds."""
    # ArviZ 0.23 announces ArviZ 1.x at import, which the reader of our output can do nothing about.
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"\s*ArviZ is undergoing a major", FutureWarning)
        try:
            import arviz
        except FileNotFoundError:  # another process wrote the date of that announcement at the same time
            import arviz
    return arviz
