"""Forecasts from rolling origins, as they would have been made at each origin.

1. Fit the model to the data up to an origin, and forecast the next rows; a second fit compiles nothing.
2. Forecast the same rows by a reference: persistence, or the seasonal-naive forecast.
3. Score both, move the origin on, and repeat.

Source: Hyndman and Athanasopoulos (2021), Forecasting: Principles and Practice, section 5.10.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.unbound_model import SharedModel
from lfm_ppl.io.data import as_data
from lfm_ppl.results.family_scores import log_densities
from lfm_ppl.results.predictions import GROUP, MEAN, SD, flat_draws, observed_variable
from lfm_ppl.results.rebuilding import parameter_draws
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.scoring import ALL, Scores, gaussian_scores, scores, summary, table
from lfm_ppl.utils import checks
from lfm_ppl.utils.gaussian_residuals import TURN
from lfm_ppl.utils.types import Times
from lfm_ppl.workflows.data_binding import bind_data
from lfm_ppl.workflows.fit import fit
from lfm_ppl.workflows.fit_results import ConvergenceWarning
from lfm_ppl.workflows.forecast import check_possible

MODEL = "model"
"""The forecaster that is not the reference."""

_LEAST_ROWS = 3
"""Fewest rows that a model is learnt from."""

_SCORES = ("rmse", "crps", "log_score")


@dataclass(frozen=True)
class Backtest:
    """What `backtest` found.

    Attributes:
        scores: dataset with dimensions forecaster ("model" and the reference), origin (the time of the last row that
            was known), horizon (1, 2, ... rows after it) and output: ``mean``, ``error``, ``crps``, ``log_score``,
            ``covered``; and ``time`` (origin, horizon), the times that were predicted. NaN where y is.
        table: mean scores by forecaster and output, and of "all" outputs; columns as in `lfm_ppl.score`.
    """

    scores: xr.Dataset
    table: pd.DataFrame

    def wins(self) -> pd.DataFrame:
        """Return at how many origins the forecast has the better RMSE, CRPS and log score than the reference.

        Returns:
            Rows: outputs and "all"; columns ``origins``, ``rmse``, ``crps``, ``log_score``, NaN where there is no such
            score.
        """
        model_scores, reference = (self.scores.isel(forecaster=index) for index in (0, 1))
        rows = {}
        for name in [*(str(output) for output in self.scores["output"].values), ALL]:
            ours, theirs = (_by_origin(forecaster if name == ALL else forecaster.sel(output=name))
                            for forecaster in (model_scores, reference))
            is_comparable = np.isfinite(ours["rmse"]) & np.isfinite(theirs["rmse"])
            better = {label: (ours[label] > theirs[label]) if label == "log_score" else ours[label] < theirs[label]
                      for label in _SCORES}
            has_score = {label: bool((np.isfinite(ours[label]) & np.isfinite(theirs[label])).any())
                         for label in _SCORES}
            rows[name] = {"origins": int(is_comparable.sum()), **{
                label: int(hit[is_comparable].sum()) if has_score[label] else np.nan for label, hit in better.items()}}
        return pd.DataFrame.from_dict(rows, orient="index")


def backtest(numpyro_model: Callable, times: Times, y: ArrayLike | None = None, *, horizon: int, every: int = 1,
             first: int | None = None, season: int | None = None, sampler: str = "map", draws: int = 400,
             level: float = 0.95, seed: int = 0, progress: bool = True, **options: Any) -> Backtest:
    """Fit to the data up to an origin, predict what follows, move the origin on, and score it all.

    Each fit has the shape of the whole data, with NaN in the place of what is not known yet, so that everything is
    compiled once. New observations are predicted as `lfm_ppl.forecast` does: dynamics that are not linear are simulated
    on from the last row that is known.

    Beside the model stands a reference that knows no mechanism: at h rows after the origin k it predicts the value of
    as many whole seasons before (of the row k itself for persistence), with the spread of such differences so far,

        y*_k+h ~ N(y_k+h-l, s_l^2),   l = season ceil(h / season),   s_l^2 = mean of (y_i - y_i-l)^2 over i <= k.

    Where the value is missing, one more season before is taken.

    Args:
        numpyro_model: as in `lfm_ppl.fit`.
        times: (T,), increasing; in rows of one each, since horizon and season count rows. Or data, as in `lfm_ppl.fit`:
            `lfm_ppl.Data`, whose known inputs the model is given over the whole span, or a DataFrame.
        y: (T, D), NaN where missing; None where the first argument is the data.
        horizon: how many rows after each origin are predicted.
        every: rows from one origin to the next.
        first: rows that the first fit knows; by default half of them.
        season: rows of a season, for the seasonal-naive reference; None: persistence.
        sampler: as in `lfm_ppl.fit`. The default takes the Laplace approximation at the posterior mode, in a fraction
            of the time; "nuts" is the better choice where the posterior is wide or skew.
        draws: number of posterior draws that are propagated.
        level: of the intervals whose coverage is counted.
        seed: seed of all random numbers.
        progress: print a line for each origin.
        **options: further arguments of `lfm_ppl.fit`, such as ``warmup``, ``samples``, ``model_kwargs``, ``fixed``.

    Returns:
        Scores by origin, horizon and output, and their means; see `Backtest`.

    Raises:
        ValueError: no origin with a whole horizon after it; replicates (equal times); a panel; whatever `fit` says,
            with the origin.

    Warns:
        ConvergenceWarning: chains of some origins have not converged.

    Example:
        >>> import jax.numpy as jnp, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        ...     lfmodel = lfm.LatentForceModel(
        ...         lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), output_names=["x"])
        ...     numpyro.sample("y", lfm.MarginalLikelihood(lfmodel, times), obs=y)
        >>> times = np.arange(12.0)
        >>> found = lfm.backtest(model, times, np.sin(times)[:, None], horizon=2, every=2, draws=50)
        >>> dict(found.scores["crps"].sizes)
        {'forecaster': 2, 'origin': 3, 'horizon': 2, 'output': 1}
        >>> found.table.index.tolist()[:2]
        [('model', 'x'), ('model', 'all')]

    Source: Hyndman and Athanasopoulos (2021), Forecasting: Principles and Practice, sections 5.2, 5.8 and 5.10.
    """
    for label, count in (("horizon", horizon), ("every", every), ("draws", draws)):
        checks.positive_integer(label, count)
    if season is not None:
        checks.positive_integer("season", season)
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, got {level}.")
    names, passed = None, (times, y)
    if y is None:
        data = as_data(times)
        passed, times, y, names = (data, None), data.times, data.y, data.outputs
    checks.refuse_dates("times", times)
    times, y = (np.asarray(checks.unmask(value), float) for value in (times, y))
    y = y[:, None] if y.ndim == times.ndim == 1 else y
    if times.ndim != 1 or y.ndim != 2:
        raise ValueError(f"backtest takes one series, times (T,) and y (T, D), got shapes {times.shape} and {y.shape}; "
                         "of a panel, one series after another.")
    duplicates = np.flatnonzero(np.diff(times) == 0)
    if duplicates.size:
        row = duplicates[0]
        raise ValueError(f"rows {row} and {row + 1} have the same time {times[row]:g}, but horizon and season count "
                         "rows; put replicates into columns, or take their means.")
    origins = _origins(len(times), horizon, every, first)
    options = {"samples": draws if sampler == "map" else 1000, **options}
    bound, _, _, options["model_kwargs"] = bind_data(numpyro_model, *passed, options.get("model_kwargs"))
    times = bound.times
    bound = bound.fix(options.get("fixed"))
    check_possible(bound, times)
    model = bound.site.example.ssm.model
    angular = np.isin(np.arange(y.shape[1]), model.observation.angular)
    period = model.observation.period
    reference = "persistence" if season is None else "seasonal-naive"
    forecasts, naive, messages, shared_model = [], [], [], SharedModel(numpyro_model)
    for origin in origins:
        past = np.where(np.arange(len(times))[:, None] <= origin, y, np.nan)
        future = slice(origin + 1, origin + 1 + horizon)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                result = fit(shared_model, times, past, sampler=sampler, seed=seed, at=times, trajectory_draws=draws,
                             progress=False, **options)
                predicted = ResultView.of(result).group(GROUP).isel(time=future)
            except Exception as error:
                error.add_note(f"at the origin {times[origin]:g} (row {origin})")
                raise
            draws_of_y = flat_draws(observed_variable(predicted))
            # An observation family has no normal distribution at each draw.
            mean, sd = (flat_draws(predicted[name]) if name in predicted else None for name in (MEAN, SD))
            densities = None if mean is not None else _of_family(bound, result, predicted, y[future])
            origin_scores = scores(draws_of_y, y[future], mean, sd, level, angular, densities, period)
        messages += [f"origin {times[origin]:g}: {warning.message}" for warning in caught]
        forecasts.append(((draws_of_y if mean is None else mean).mean(axis=0), origin_scores))
        mean, sd = _naive(past[:origin + 1], horizon, season or 1, angular, period)
        target = np.where(angular, mean + _wrapped(y[future] - mean, period), y[future])
        naive.append((mean, gaussian_scores(mean, sd, target, level)))
        if progress:
            print(f"origin {times[origin]:g}: RMSE {summary(origin_scores, level)['rmse']:.4g}, {reference} "
                  f"{summary(naive[-1][1], level)['rmse']:.4g}", file=sys.stderr, flush=True)
    if messages:
        checks.warn(f"{len(messages)} warnings at the origins, the first of them at {messages[0]}", ConvergenceWarning)
    dataset = _dataset((forecasts, naive), reference, times, origins, horizon, names or model.output_names)
    dataset.attrs.update(sampler=sampler, season=season or 1, level=level, seed=seed, warnings="\n".join(messages))
    return Backtest(dataset, _table(dataset, level))


def _of_family(bound: BoundModel, result: Any, predicted: xr.Dataset, y: np.ndarray) -> np.ndarray:
    """Return the log densities (S, H, D) of an observation family along the predicted paths."""
    posterior = ResultView.of(result).posterior.isel(draw=predicted["draw"].values)
    return log_densities(bound, parameter_draws(bound, posterior), predicted, y)


def _origins(rows: int, horizon: int, stride: int, first: int | None) -> list[int]:
    """Return the last known row of each fit."""
    if first is None:
        first = max(rows // 2, _LEAST_ROWS)
    checks.positive_integer("first", first)
    origins = list(range(first - 1, rows - horizon, stride))
    if first < _LEAST_ROWS or not origins:
        raise ValueError(f"there is no origin: of {rows} rows the first fit is to know {first} (at least "
                         f"{_LEAST_ROWS}) and {horizon} more are to be predicted. Take a smaller first or horizon.")
    return origins


def _naive(y: np.ndarray, horizon: int, season: int, angular: np.ndarray,
           period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and sd (H, D) of the reference given the rows (k + 1, D) so far; see `backtest`."""
    rows, outputs = y.shape
    mean, sd = np.full((2, horizon, outputs), np.nan)
    for lead in range(1, horizon + 1):
        for output in range(outputs):
            lag = season * -(-lead // season)
            while lag - lead < rows and not np.isfinite(y[rows - 1 + lead - lag, output]):
                lag += season
            if lag - lead >= rows:
                continue
            mean[lead - 1, output] = y[rows - 1 + lead - lag, output]
            change = y[lag:, output] - y[:-lag, output]
            change = _wrapped(change, period) if angular[output] else change
            change = change[np.isfinite(change)]
            if change.size > 1 and np.any(change):
                sd[lead - 1, output] = np.sqrt(np.mean(change**2))
    return mean, sd


def _wrapped(angle: np.ndarray, period: float) -> np.ndarray:
    """Return differences of angles on the circle; in NumPy, since each shape would be compiled otherwise."""
    scale = TURN / period
    return np.angle(np.exp(1j * scale * angle)) / scale


def _dataset(forecasters: tuple, reference: str, times: np.ndarray, origins: list[int], horizon: int,
             outputs: Sequence[str]) -> xr.Dataset:
    dims = ("forecaster", "origin", "horizon", "output")
    steps_ahead = np.array(origins)[:, None] + np.arange(1, horizon + 1)
    variables: dict[str, Any] = {"mean": (dims, np.array([[mean for mean, _ in pairs] for pairs in forecasters]))}
    for name in Scores._fields:
        values = [[getattr(origin_scores, name) for _, origin_scores in pairs] for pairs in forecasters]
        variables[name] = (dims, np.array(values))
    coords = {"forecaster": [MODEL, reference], "origin": times[origins], "horizon": np.arange(1, horizon + 1),
              "output": list(outputs), "time": (("origin", "horizon"), times[steps_ahead])}
    return xr.Dataset(variables, coords)


def _scores_of(dataset: xr.Dataset) -> Scores:
    return Scores(*(dataset[name].values for name in Scores._fields))


def _by_origin(dataset: xr.Dataset) -> pd.DataFrame:
    return pd.DataFrame([summary(_scores_of(dataset.isel(origin=index))) for index in range(dataset.sizes["origin"])])


def _table(dataset: xr.Dataset, level: float) -> pd.DataFrame:
    outputs = [str(name) for name in dataset["output"].values]
    tables = {str(forecaster): table(_scores_of(dataset.sel(forecaster=forecaster)), outputs, level)
              for forecaster in dataset["forecaster"].values}
    return pd.concat(tables, names=["forecaster", "output"])
