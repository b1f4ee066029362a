"""Binding of a model to times that may be dates, counted in the unit of time that the model names."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.inference.bind import bind
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.posterior import noise_of_rows
from lfm_ppl.io.data_set import Data, at_origin, model_keywords
from lfm_ppl.utils import calendar_time, checks


def bind_dates(numpyro_model: Callable, times: Any, y: Any, data: Data | None,
               model_kwargs: Mapping[str, Any] | None) -> tuple[BoundModel, Data | None, tuple[str | None, str]]:
    """Bind a model to its data.

    Args:
        numpyro_model: the model.
        times: (T,) or (B, T), numbers or dates.
        y: the observations, or a data frame of them.
        data: the object that holds times and y; None where they were passed themselves.
        model_kwargs: keyword arguments of the model, without the known inputs of ``data``.

    Returns:
        The bound model; the data, with times in the unit of the model; the calendar time of t = 0 (None where times
        are plain numbers) with the unit of time (empty where it is unknown).
    """
    checks.refuse_durations("times", times)
    origin, unit = (None, "") if data is None else (data.origin, data.units.get("time", ""))
    if calendar_time.holds_dates(times):
        times, origin, unit = calendar_time.numbers_of("times", times)
    values = y.to_numpy(float) if hasattr(y, "to_numpy") else y  # a data frame

    def bind_in(origin: str | None, unit: str) -> BoundModel:
        keywords = dict(model_kwargs or {}) if data is None else model_keywords(data.inputs, model_kwargs)
        with calendar_time.in_messages(origin, unit):
            return _bind(numpyro_model, times, values, keywords)

    bound = bind_in(origin, unit)
    # The model names its unit only once it has been built, which needs times.
    model_unit = bound.site.example.ssm.model.units.get("time", "")
    data_seconds, model_seconds = (calendar_time.SECONDS.get(name) for name in (unit, model_unit))
    if origin is None or data_seconds is None or model_seconds is None or data_seconds == model_seconds:
        return bound, data, (origin, unit)
    times = np.asarray(times) * (data_seconds / model_seconds)
    data = None if data is None else at_origin(data, origin, model_unit)
    return bind_in(origin, model_unit), data, (origin, model_unit)


def _bind(numpyro_model: Callable, times: Any, y: Any, model_kwargs: dict[str, Any]) -> BoundModel:
    try:
        return bind(numpyro_model, times, y, **model_kwargs)
    except TypeError as error:
        if "'NoneType'" not in str(error) or "inputs" in model_kwargs or (
                "inputs" not in inspect.signature(numpyro_model).parameters):
            raise
        raise TypeError("the model has an argument `inputs`, and there are none. Name their columns, "
                        "lfm.read_table(frame, inputs=[...]), or give lfm.Data(..., inputs={...}).") from error


def check_requested_times(bound: BoundModel, times: Any, name: str = "at") -> None:
    """Check the times of trajectories, (K,), or (B, K) for each series; None: a grid over the data.

    Raises:
        ValueError: a wrong shape; a time before the initial time.
    """
    if times is None:
        return
    example = bound.site.example
    has_series_times = bound.times.ndim == 2
    if np.ndim(times) > 1 and not (has_series_times and np.shape(times)[:-1] == (len(bound.times),)):
        expected = f"(K,), or ({len(bound.times)}, K) for each series" if has_series_times else "(K,)"
        raise ValueError(f"{name} must have shape {expected}, got {np.shape(times)}.")
    data_times = bound.times if has_series_times else [bound.times]
    rows = times if np.ndim(times) == 2 else [times] * len(data_times)
    for series, pair in enumerate(zip(data_times, rows, strict=True)):
        try:
            build_time_grid(example.ssm, pair[0], example.steps, example.max_step, pair[1], tolerance=example.tolerance)
        except ValueError as error:
            raise ValueError(f"series {series}: {error}" if has_series_times else str(error)) from None


def warn_of_missing_predictions(bound: BoundModel, times: Any) -> None:
    """Warn where new observations at the times of the trajectories have no distribution."""
    if times is None or np.array_equal(np.asarray(times, float), bound.times) or not noise_of_rows(bound.site.example):
        return
    checks.warn("at: the noise is given for each row of the data, so that new observations at these times cannot be "
                "predicted; the result has trajectories there, and no group `predictions`. For predictions give a "
                "function (x, u, t) or one number for all rows as covariance.")
