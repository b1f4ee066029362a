"""Scores of predictions: errors, CRPS, log scores and coverage.

1. Align predictions and measurements in time; dates are counted as in the result.
2. A prediction is a mixture of normal distributions over the draws, draws alone, or the law of an observation family.
3. Compute the scores of every measurement, and their means by output.

Source: Gneiting and Raftery (2007), Journal of the American Statistical Association 102.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from scipy import stats
from scipy.special import logsumexp

from lfm_ppl.io.data_set import Data, at_origin, in_unit
from lfm_ppl.results.predictions import GROUP, MEAN, SD, flat_draws, observed_variable, quantiles
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.utils import calendar_time, checks
from lfm_ppl.utils.gaussian_residuals import TURN

ALL = "all"
"""The row of a table of scores for all outputs together."""

_FEW = 10.0
"""Least number of draws for a log score; with fewer it depends more on chance than on the forecast."""

_SAME_TIME = 1e-9
"""Relative difference of times that is rounding."""


class Scores(NamedTuple):
    """Scores of single predictions, arrays of the shape of what was predicted; NaN where nothing was measured.

    Attributes:
        error: y minus the predictive mean.
        crps: continuous ranked probability score, in units of y; smaller is better.
        log_score: log predictive density; larger is better. NaN where there is no density.
        covered: 1 where the central interval holds y, 0 where not.
    """

    error: np.ndarray
    crps: np.ndarray
    log_score: np.ndarray
    covered: np.ndarray


def score(result: Any, held_out: Any, level: float = 0.95, *, numpyro_model: Callable | None = None,
          inputs: Mapping[str, Any] | None = None, model_kwargs: Mapping[str, Any] | None = None) -> pd.DataFrame:
    r"""Compare predictions with later measurements.

        rmse     root of the mean of (y - E y*)^2
        crps     mean of  E|y* - y| - E|y* - y*'| / 2  =  mean of  int (F(v) - 1{v >= y})^2 dv
        log      mean of  log p(y),   p = mean over the draws of N(y_mean, y_sd^2)
        coverage share of y in the central interval, between the quantiles (1 - level)/2 and (1 + level)/2 of p

    CRPS takes the draws y*_1..S of each prediction, with the unbiased ("fair") estimator

        1/S sum_s |y*_s - y| - 1/(2 S (S - 1)) sum_s,r |y*_s - y*_r|.

    The other scores take the mixture of normal densities that `forecast` stores. CRPS and the log score are proper: on
    average the true predictive distribution has the best of them.

    Of an observation family p is the mixture over the draws of the family's own law along each path, which takes the
    model; the other scores take the draws.

    Args:
        result: what `lfm_ppl.forecast`, or `lfm_ppl.fit` with ``at``, returned; or its dataset ``predictions``.
        held_out: (K, D) (or (K,) for one output; (B, K, D) for a panel), one row for each time of the predictions; or a
            `lfm_ppl.Data` or a DataArray with coordinates time and output, whose times must be among those predicted;
            dates, and numbers with a unit, are counted as in the result. NaN entries are ignored.
        level: of the interval, between 0 and 1.
        numpyro_model: of an observation family, the model that was fitted; without it there is no log score.
        inputs: as in `lfm_ppl.forecast`, and so is the next.
        model_kwargs: keyword arguments of the model.

    Returns:
        A table with a row for each output and a row "all" for all entries: ``n`` (how many were compared), ``rmse``,
        ``crps`` (both in the outputs' units, so that "all" means little where these differ), ``log_score`` (mean log
        density of an entry) and ``coverage_95`` (after ``level``).

    Raises:
        ValueError: the result has no predictions; a wrong shape; a time or an output that was not predicted; nothing
            to compare with.

    Warns:
        UserWarning: the log score of some entries rests on few draws, because the noise is small beside the differences
            between paths that were simulated; take more draws, or CRPS.

    Example:
        >>> draws = np.random.default_rng(0).normal(size=(1, 4000, 1, 1))
        >>> dims = ("chain", "draw", "time", "output")
        >>> predicted = xr.Dataset({"y": (dims, draws)}, {"time": [1.0], "output": ["x"]})
        >>> score(predicted, [[0.0]]).loc["x", "crps"].round(1)  # (sqrt(2) - 1) / sqrt(pi) = 0.234 in expectation
        np.float64(0.2)

    Source: Gneiting and Raftery (2007), JASA 102; Ferro (2014), QJRMS 140, for the fair estimator.
    """
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, got {level}.")
    view = None if isinstance(result, xr.Dataset) else ResultView.of(result)
    predicted = result if view is None else view.group(GROUP)
    variable = observed_variable(predicted)
    series = [str(dim) for dim in variable.dims if dim not in ("chain", "draw", "time", "output")]
    outputs = [str(name) for name in variable["output"].values]
    clock = (None, "") if view is None else view.clock
    predicted, y = aligned(predicted, variable, _on_clock(held_out, *clock), series)
    variable, names = observed_variable(predicted), [str(name) for name in predicted["output"].values]
    mean, sd = (flat_draws(predicted[name]) if name in predicted else None for name in (MEAN, SD))
    densities = None
    if numpyro_model is not None:
        # A family's law is that of all its outputs, in the model's order; those not held out are missing.
        columns = [outputs.index(name) for name in names]
        full = np.full((*y.shape[:-1], len(outputs)), np.nan)
        full[..., columns] = y
        densities = _family_densities(view, numpyro_model, predicted, full, inputs, model_kwargs)[..., columns]
    angular = np.isin(names, json.loads(variable.attrs.get("angular") or "[]"))
    period = float(variable.attrs.get("period", TURN))
    return table(scores(flat_draws(variable), y, mean, sd, level, angular, densities, period), names, level)


def scores(draws: np.ndarray, y: np.ndarray, mean: np.ndarray | None = None, sd: np.ndarray | None = None,
           level: float = 0.95, angular: Any = False, densities: np.ndarray | None = None,
           period: float = TURN) -> Scores:
    """Return the scores of single predictions.

    Args:
        draws: (S, ...) of each prediction.
        y: (...), NaN where missing.
        mean: (S, ...) of the normal distribution of each draw; None: there is no density.
        sd: (S, ...), its standard deviation.
        level: of the central interval.
        angular: (...), which are angles: differences are taken on the circle.
        densities: (S, ...), log densities of ``y`` at each draw, where these are not normal.
        period: period of the angles.
    """
    if np.any(angular):
        # All angles on the branch centred on the mean direction.
        scale = TURN / period
        centre = np.angle(np.exp(1j * scale * draws).mean(axis=0)) / scale

        def unwrap(value: np.ndarray) -> np.ndarray:
            return np.where(angular, centre + np.angle(np.exp(1j * scale * (value - centre))) / scale, value)

        draws, y, mean = unwrap(draws), unwrap(y), None if mean is None else unwrap(mean)
    present = np.isfinite(y)
    below = 0.5 * (1.0 - level)
    if mean is None or sd is None:
        error = y - draws.mean(axis=0)
        low, high = quantiles(draws, (below, 1.0 - below))
        is_covered = (low <= y) & (y <= high)
    else:
        error = y - mean.mean(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.where(sd > 0, (y - mean) / sd, np.where(y == mean, 0.0, np.sign(y - mean) * np.inf))
            densities = np.where(sd > 0, stats.norm.logpdf(z) - np.log(sd), np.nan)
        distribution = stats.norm.cdf(z).mean(axis=0)
        is_covered = (below <= distribution) & (distribution <= 1.0 - below)
    log_score = np.full(y.shape, np.nan) if densities is None else _mixture_log_density(densities, present)
    return Scores(error, crps(draws, y), log_score, np.where(present, is_covered, np.nan))


def _family_densities(view: ResultView | None, numpyro_model: Callable, predicted: xr.Dataset, y: np.ndarray,
                      inputs: Mapping[str, Any] | None, model_kwargs: Mapping[str, Any] | None) -> np.ndarray:
    """Return the log densities (S, ...) of an observation family."""
    from lfm_ppl.results import rebuilding  # figures and tables of scores need no JAX
    from lfm_ppl.results.family_scores import log_densities

    if view is None:
        raise ValueError("the log score of an observation family takes the parameters of each draw; pass what "
                         "lfm.forecast returned, not its dataset.")
    problem = rebuilding.problem(view, numpyro_model, model_kwargs=rebuilding.keywords(view, inputs, model_kwargs))
    posterior = view.posterior
    draw_index = np.searchsorted(posterior["draw"].values, predicted["draw"].values)
    rows = (np.arange(posterior.sizes["chain"])[:, None] * posterior.sizes["draw"] + draw_index).ravel()
    return log_densities(problem.bound, problem.select(rows).draws, predicted, y)


def crps(draws: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the fair CRPS (...) of draws (S, ...) at y (...), by sorting; NaN where y is, and for a single draw.

    sum_s,r |y_s - y_r| = 2 sum_i (2 i - S - 1) y_(i) over the sorted draws.
    """
    count = len(draws)
    if count < 2:
        return np.full(np.shape(y), np.nan)
    ordered = np.sort(draws, axis=0)
    weight = (2.0 * np.arange(1, count + 1) - count - 1).reshape(-1, *(1,) * np.ndim(y))
    return np.abs(draws - y).mean(axis=0) - (weight * ordered).sum(axis=0) / (count * (count - 1))


def gaussian_scores(mean: np.ndarray, sd: np.ndarray, y: np.ndarray, level: float = 0.95) -> Scores:
    r"""Return the scores (...) of normal distributions with mean (...) and sd (...), in closed form.

    With z = (y - mean) / sd,

        crps = sd (z (2 Phi(z) - 1) + 2 phi(z) - 1 / sqrt(pi)).
    """
    z = (y - mean) / sd
    ranked = sd * (z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - 1 / np.sqrt(np.pi))
    is_inside = np.where(np.isfinite(z), np.abs(z) <= stats.norm.ppf(0.5 + 0.5 * level), np.nan)
    return Scores(y - mean, ranked, stats.norm.logpdf(z) - np.log(sd), is_inside)


def table(scores: Scores, outputs: list[str], level: float = 0.95) -> pd.DataFrame:
    """Return the mean scores by output (the last axis) and of all; see `score`."""
    rows = {}
    entries: list[tuple[Any, str]] = [*enumerate(outputs), (slice(None), ALL)]
    for index, name in entries:
        rows[name] = summary(Scores(*(value[..., index] for value in scores)), level)
    return pd.DataFrame.from_dict(rows, orient="index")


def summary(scores: Scores, level: float = 0.95) -> dict[str, float]:
    """Return the mean scores of the entries that were measured."""
    present = np.isfinite(scores.error)

    def mean(values: np.ndarray) -> float:
        return float(np.mean(values[present])) if present.any() else np.nan

    return {"n": int(present.sum()), "rmse": float(np.sqrt(mean(scores.error**2))), "crps": mean(scores.crps),
            "log_score": mean(scores.log_score), f"coverage_{100 * level:g}": mean(scores.covered)}


def aligned(predicted: xr.Dataset, variable: xr.DataArray, held_out: Any,
            series: list[str]) -> tuple[xr.Dataset, np.ndarray]:
    """Return the predictions of what was held out, and that as an array (..., K, D).

    Raises:
        ValueError: see `score`.
    """
    outputs = [str(name) for name in variable["output"].values]
    if isinstance(held_out, (Data, xr.DataArray)):
        if "time" not in predicted.indexes:
            raise ValueError("held_out must be an array (B, K, D), as the series of the predictions have their own "
                             f"times; got {type(held_out).__name__}.")
        times, y, names = _labelled(held_out)
        for name in names:
            if name not in outputs:
                raise ValueError(f"held_out: {checks.unknown('output', name, outputs)}")
        predicted = predicted.isel(time=_rows(predicted["time"].values, times)).sel(output=names)
    else:
        y = np.asarray(checks.unmask(held_out), float)
        y = y[..., None] if len(outputs) == 1 and y.ndim == 1 + len(series) else y
        expected = (*(variable.sizes[dim] for dim in series), variable.sizes["time"], len(outputs))
        if y.shape != expected:
            raise ValueError(f"held_out must have shape {expected}, one row for each time of the predictions and one "
                             f"column for each of {', '.join(outputs)}; got {y.shape}. Give an lfm.Data for some of "
                             "the times.")
    if np.isinf(y).any():
        raise ValueError("held_out has infinite entries; use NaN for a missing entry.")
    if not np.isfinite(y).any():
        raise ValueError("held_out has no value to compare with: every entry is missing.")
    return predicted, y


def _on_clock(held_out: Any, origin: str | None, unit: str) -> Any:
    """Return held-out data whose dates are counted from the origin of the result, in its unit of time."""
    if isinstance(held_out, Data) and unit and (held_out.origin is None) != (origin is None):
        kinds = ("numbers", "dates") if origin is not None else ("dates", "numbers")
        raise ValueError(f"the times of held_out are {kinds[0]}, and the times of the result are {kinds[1]}; give "
                         f"{kinds[1]}.")
    if isinstance(held_out, Data):
        return at_origin(held_out, origin, unit) if held_out.origin and origin else in_unit(held_out, unit)
    if isinstance(held_out, xr.DataArray) and "time" in held_out.coords:
        if calendar_time.holds_dates(dates := held_out["time"].values):
            times = calendar_time.positions("the times of held_out", dates, origin, unit)
            return held_out.assign_coords(time=("time", times))
    return held_out


def _labelled(held_out: Data | xr.DataArray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    if isinstance(held_out, Data):
        return held_out.times, held_out.y, list(held_out.outputs)
    for name in ("time", "output"):
        if name not in held_out.coords or name not in held_out.dims:
            raise ValueError(f"held_out needs the dimensions and coordinates time and output, got "
                             f"{tuple(held_out.dims)}; or pass an array.")
    held_out = held_out.transpose(..., "time", "output")
    return (np.asarray(held_out["time"].values, float), np.asarray(held_out.values, float),
            [str(name) for name in held_out["output"].values])


def _rows(predicted: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return which predicted time each time is."""
    nearest = np.abs(predicted[:, None] - times).argmin(axis=0)
    far = np.abs(predicted[nearest] - times) > _SAME_TIME * (np.ptp(predicted) + np.abs(times))
    if far.any():
        raise ValueError(f"held_out has the time {times[far][0]:g}, which was not predicted (the predictions are at "
                         f"{len(predicted)} times from {predicted.min():g} to {predicted.max():g}). Forecast at the "
                         "times of the held-out data: lfm.forecast(result, model, held_out.times).")
    return nearest


def _mixture_log_density(terms: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return the log density (...) at y of a mixture of draws (S, ...); warn where a few draws make most of it."""
    terms = np.where(present, terms, 0.0)
    largest = terms.max(axis=0)
    weights = np.exp(terms - np.where(np.isfinite(largest), largest, 0.0))
    squares = (weights**2).sum(axis=0)
    carried = np.where(squares > 0, weights.sum(axis=0) ** 2 / np.where(squares > 0, squares, 1.0), 0.0)
    few = present & (carried < min(_FEW, 0.5 * len(terms)))
    if few.sum() > 0.05 * present.sum():
        checks.warn(f"the log score of {int(few.sum())} of {int(present.sum())} entries rests on fewer than "
                    f"{min(_FEW, 0.5 * len(terms)):g} draws: they lie between the simulated paths, or far from all. "
                    "Take more draws in lfm.forecast (--draws), or compare by CRPS.")
    return np.where(present, logsumexp(terms, axis=0) - np.log(len(terms)), np.nan)
