"""From a posterior to new observations: forecasts with their noise."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
import xarray as xr

from lfm_ppl.inference.model_draws import ModelDraws
from lfm_ppl.inference.trajectories import evenly_spaced, has_noise_of_rows, trajectories
from lfm_ppl.io.data_set import Data, on_clock_of_fit
from lfm_ppl.io.input_table import OF_SERIES
from lfm_ppl.model.events import Event
from lfm_ppl.particles.particle_filter import ParticleSettings, check_settings
from lfm_ppl.results import arviz_data, rebuilding
from lfm_ppl.results import inputs as known_inputs
from lfm_ppl.results.predictions import GROUP, HELD_OUT, predictions
from lfm_ppl.results.result_view import SELECTED_SERIES, ResultView
from lfm_ppl.results.series import of_all_series, panel_of, series_view
from lfm_ppl.results.sites import all_sites_of, site_view
from lfm_ppl.utils import calendar_time, checks
from lfm_ppl.utils.progress import Console
from lfm_ppl.utils.random_keys import split_by_name
from lfm_ppl.utils.types import Result, Times
from lfm_ppl.workflows.data_binding import check_requested_times, of_site
from lfm_ppl.workflows.fit_options import keys_of


def forecast(result: Result, numpyro_model: Callable, times: Times, *, inputs: Mapping[str, Any] | Data | None = None,
             events: Sequence[Event] | Mapping[str, Sequence[Event]] = (),
             model_kwargs: Mapping[str, Any] | None = None, draws: int = 400, seed: int = 0,
             progress: bool = True) -> Result:
    """Predict new observations, with their noise, between the data and after them.

        p(y* | y) = int p(y* | s*, theta) p(s* | s_T, theta) p(s_T | y, theta) p(theta | y) ds* ds_T dtheta

    is sampled in that order: parameters theta from the posterior, for each of them ONE path of state and forces given
    the data, and noise along it.

    Up to the last observation, at T, the path is a draw of the Gaussian smoother (of the particle smoother where the
    result was sampled by "pmmh"). After it there is nothing to condition on, so that no approximation is needed but
    that of the state at T: where the dynamics are not linear, the path is SIMULATED on from its own state at T, by the
    steps of `lfm_ppl.simulate`, none longer than a step of the fit, and exponential where they would be longer than the
    fastest time constant. The Gaussian moments that a filter would carry on keep mean and variance roughly right
    and the shape wrong: a state in a double well would be put between the wells, and a force with a softplus would push
    below zero. Errors of the shape grow with the horizon, where a filter is never corrected by data. For linear
    dynamics the moments are exact, and the path is drawn from them. With a linear observation, y* given theta is normal
    there, and up to the last observation of any model, with moments that are stored, so that scores and bands need no
    draws of the noise.

    Args:
        result: of `lfm_ppl.fit`, or read by `lfm_ppl.load`; also one series or one likelihood site of it, from
            `lfm_ppl.select_series`, which is predicted alone.
        numpyro_model: the model that was fitted, of all series and sites. A result holds draws and data, but no code.
        times: (K,) times of the forecast, non-decreasing, from the initial time on; dates if the data have dates.
            (B, K) where the series of a panel have times of their own. With several likelihood sites for all of them,
            or a dict for some.
        inputs: what goes on after the fit, by name, see below; or a `lfm_ppl.Data` with later known inputs, whose times
            are converted to the clock of the fit. With several likelihood sites a dict by site.
        events: `lfm_ppl.Dose`, `lfm_ppl.Infusion` and `lfm_ppl.Reset` after the last observation, which follow the
            fit's in the argument ``events`` of the model. With several likelihood sites a dict by site.
        model_kwargs: keyword arguments of the model, as in the fit.
        draws: number of posterior draws, spread over the chains, each with a path of its own.
        seed: seed of the paths and the noise.
        progress: show the progress on standard error.

    Known inputs and doses of the data CONTINUE the fit's: the rows of the fit before the first time of the new
    table stay, and the new rows follow. A table that begins with, or before, that of the fit replaces it. Until the
    last observation both must be the same, since the posterior belongs to them. A table is (times, values), (times,
    values, interpolation) or an `lfm_ppl.Input`, and of doses (times, amounts, "dose:STATE"). In a panel each series
    has its own, under the name ``"dose of series Ann"``.

    Keyword arguments of the model that the data do not hold are REPLACED. But arrays with a row for each row of the
    data in ``model_kwargs``, such as the noise of each measurement, continue with the rows given in ``inputs``, one for
    each of ``times``, which then come after the data.

    Returns:
        A new ArviZ object: the groups of ``result`` and a group ``predictions`` with dimensions chain, draw, time and
        output: new observations under the name of the likelihood's site (``y``), with noise; ``y_mean`` and ``y_sd``,
        their normal distribution at each draw; and ``outputs``, which are noise-free, ``forces``, ``states`` and
        ``deterministics`` along the same paths. `lfm_ppl.score` compares them with data, `lfm_ppl.plot_fit` and
        `lfm_ppl.plot_forces` draw them. Known ``inputs`` are a group ``predictions_constant_data``. With several
        likelihood sites the groups have the names of the sites, see `lfm_ppl.select_series`.

    Raises:
        ValueError: times that go back or lie before the initial time; another model than that of the result, seen by
            its settings, its parameters or its log likelihood at the draws; a known input that ends before ``times``,
            that is unknown, or that differs from the fit before the last observation; noise that is given row by row,
            differs between rows, and is not continued; an event before the last observation.
        TypeError: ``result`` is no ArviZ object; the model needs a keyword argument.

    Warns:
        UserWarning: a simulated state is not finite.

    Example:
        >>> import jax.numpy as jnp, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        ...     lfmodel = lfm.LatentForceModel(
        ...         lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), output_names=["x"])
        ...     numpyro.sample("y", lfm.MarginalLikelihood(lfmodel, times), obs=y)
        >>> times = np.arange(5.0)
        >>> result = lfm.fit(model, times, np.sin(times)[:, None], sampler="map", samples=50, progress=False)
        >>> ahead = lfm.forecast(result, model, [5.0, 6.0])
        >>> ahead["predictions"]["y"].dims, ahead["predictions"]["y"].shape
        (('chain', 'draw', 'time', 'output'), (1, 50, 2, 1))
        >>> lfm.score(ahead, [[-0.9], [-0.3]]).columns.tolist()
        ['n', 'rmse', 'crps', 'log_score', 'coverage_95']

    Source: Gelman et al. (2013), Bayesian Data Analysis, section 1.3, for the composition of draws; Särkkä and Solin
    (2019), Applied Stochastic Differential Equations, chapter 9, for Gaussian moments and what they miss.
    """
    checks.positive_integer("draws", draws)
    view = ResultView.of(result)
    if view.is_part:
        options: dict[str, Any] = {"events": events, "model_kwargs": model_kwargs, "draws": draws, "seed": seed,
                                   "progress": progress}
        return _forecast_selected(view, numpyro_model, times, inputs, options)
    sites = list(view.likelihood_sites)
    requested = {name: of_site("times", times, name, sites) for name in sites} if sites else {"": times}
    views = {name: site_view(view, name) if sites else view for name in requested}
    clocks = {name: member.clock for name, member in views.items()}
    requested = {name: _checked(calendar_time.positions("times", values, *clocks[name]))
                 for name, values in requested.items() if values is not None}
    later = {name: _inputs_by_name(member, of_site("inputs", inputs, name, sites), numpyro_model)
             for name, member in views.items()}
    if sites:
        later = {name: later.get(name, {}) for name in sites}
    data = dict(zip(("times", "y"), rebuilding.observations(view), strict=True))
    has_rows, overrides = {}, dict(model_kwargs or {})
    for name, when in requested.items():
        later[name], continued = _continued_rows(later[name], model_kwargs or {}, views[name], when)
        has_rows[name] = bool(continued)
        overrides |= continued
        if continued:
            extended = _with_later_rows(views[name], when)
            data = {key: {**data[key], name: value} if sites else value for key, value in extended.items()}
    keywords = rebuilding.keywords(view, later if sites else later[""], overrides)
    for name, member in views.items():
        if site_events := of_site("events", events, name, sites):
            with calendar_time.in_messages(*clocks[name]):
                _check_events(member, site_events, numpyro_model)
            earlier = keywords.get("events", {} if sites else ())
            keywords["events"] = ({**earlier, name: [*earlier.get(name, ()), *site_events]} if sites
                                  else [*earlier, *site_events])
    with calendar_time.in_messages(*next(iter(clocks.values()))):
        problem = rebuilding.problem(view, numpyro_model, model_kwargs=keywords, **data)
    groups = dict(view.groups)
    keys = split_by_name(keys_of(seed)["forecasts"], requested)
    for name in requested:
        suffix = f"_{name.replace('/', '.')}" if sites else ""
        with calendar_time.in_messages(*clocks[name]):
            new = _forecast(keys[name], views[name], problem.sites[name] if sites else problem, requested[name],
                            draws, progress, has_rows[name])
        if continued := rebuilding.continued_tables(views[name], later[name]):
            new[known_inputs.FORECAST] = known_inputs.to_dataset(continued)
        # Held-out data of an earlier forecast do not belong to this one.
        for group in (HELD_OUT, known_inputs.FORECAST):
            groups.pop(f"{group}{suffix}", None)
        groups |= {f"{group}{suffix}": dataset for group, dataset in new.items()}
    return arviz_data.build(groups, view.attrs)


def _inputs_by_name(view: ResultView, inputs: Mapping[str, Any] | Data | None,
                    numpyro_model: Callable) -> dict[str, Any]:
    """Return later known inputs and keyword arguments by name, with tables of data on the clock of the fit.

    Raises:
        ValueError: neither the result nor the model has an input of this name.
    """
    if isinstance(inputs, Data):
        inputs = on_clock_of_fit(inputs, *view.clock, "inputs").inputs
    stored = view.inputs
    arguments = _arguments(numpyro_model)
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in arguments.values())
    for name in inputs or {}:
        is_argument = name in arguments or takes_any
        if name in stored or is_argument and not any(label.startswith(f"{name}{OF_SERIES}") for label in stored):
            continue
        of_series = " Each series of a panel has its own." if any(OF_SERIES in label for label in stored) else ""
        raise ValueError(f"inputs: {checks.unknown('known input', name, [*stored, *arguments])}{of_series}")
    return dict(inputs or {})


def _check_events(view: ResultView, events: Sequence[Event], numpyro_model: Callable) -> None:
    """Raise ValueError unless events come after the last observation of one series, and the model takes them."""
    if view.series_dimension is not None:
        raise ValueError("events: each series of a panel has doses of its own; give inputs={'NAME of series LABEL': "
                         "(times, amounts, 'dose:STATE')}, which continue the data's.")
    if "events" not in _arguments(numpyro_model):
        raise ValueError("events: the model has no argument `events` to take them by.")
    _, last = rebuilding.observed_span(view)
    for event in events:
        if not isinstance(event, Event):
            raise TypeError(f"events must be lfm.Dose, lfm.Infusion or lfm.Reset, got {type(event).__name__}.")
        if np.min(event.event_times, initial=np.inf) < last:
            time, end = calendar_time.named(float(np.min(event.event_times))), calendar_time.named(last)
            raise ValueError(f"events: {event.label} at time {time} lies before the last observation, at time {end}; "
                             "events of the forecast follow the fit's.")


def _arguments(numpyro_model: Callable) -> dict[str, inspect.Parameter]:
    """Return the parameters of a model after times and y, by name."""
    while hasattr(numpyro_model, "fn"):  # an effect handler
        numpyro_model = numpyro_model.fn
    return rebuilding.further_parameters(numpyro_model)


def _continued_rows(later: Mapping[str, Any], model_kwargs: Mapping[str, Any], view: ResultView,
                    times: np.ndarray) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return later arguments without rows, and the arguments whose later rows follow the fit's.

    An argument has rows if its array in ``model_kwargs`` has one for each row of the data, (T, ...), or of a panel
    (B, T, ...). The later array then has one for each of ``times`` (K,) or (B, K).
    """
    _, y = rebuilding.observations(view)
    stored, rows = view.inputs, y.shape[:-1]
    arguments, continued = dict(later), {}
    for name, value in later.items():
        earlier: Any = model_kwargs.get(name)
        if name in stored or not all(isinstance(array, np.ndarray | jax.Array) for array in (value, earlier)):
            continue
        lead = len(rows) if earlier.shape[:len(rows)] == rows else 1
        if earlier.ndim == 0 or earlier.shape[:lead] != rows[-lead:]:
            continue
        expected = (*earlier.shape[:lead - 1], times.shape[-1], *earlier.shape[lead:])
        if value.shape != expected:
            raise ValueError(f"inputs: {name!r} has shape {value.shape}, expected {expected}, a row for each time of "
                             "the forecast, which follows the rows in model_kwargs.")
        continued[name] = np.concatenate([earlier, arguments.pop(name)], axis=lead - 1)
    return arguments, continued


def _with_later_rows(view: ResultView, later_times: np.ndarray) -> dict[str, np.ndarray]:
    """Return times and observations of a result of one site, followed by rows without observations.

    Raises:
        ValueError: a later time is not after the data.
    """
    times, y = rebuilding.observations(view)
    later = np.broadcast_to(later_times, (*times.shape[:-1], later_times.shape[-1]))
    if (later[..., :1] < times[..., -1:]).any():
        raise ValueError(f"times: later rows of arguments are for times after the data, which "
                         f"end at {times[..., -1].max():g}, got {later.min():g}.")
    missing = np.full((*y.shape[:-2], later.shape[-1], y.shape[-1]), np.nan)
    return {"times": np.concatenate([times, later], axis=-1), "y": np.concatenate([y, missing], axis=-2)}


def _forecast_selected(view: ResultView, numpyro_model: Callable, times: Times,
                       inputs: Mapping[str, Any] | Data | None, options: Mapping[str, Any]) -> Result:
    """Return a selected series or site with its forecast by the model of the panel or of all sites."""
    if SELECTED_SERIES in view.attrs:
        panel, label = panel_of(view)
        later = of_all_series(view, _inputs_by_name(view, inputs, numpyro_model))
        panel_forecast = forecast(panel, numpyro_model, times, inputs=later, **options)
        predicted = series_view(ResultView.of(panel_forecast), label)
    else:
        all_sites, name = all_sites_of(view)
        options = {**options, "events": {name: options["events"]}}
        forecast_of_all = forecast(all_sites, numpyro_model, {name: times}, inputs={name: inputs}, **options)
        predicted = site_view(ResultView.of(forecast_of_all), name)
    new = (GROUP, known_inputs.FORECAST)
    groups = {name: dataset for name, dataset in view.groups.items() if name not in (*new, HELD_OUT)}
    groups |= {name: predicted.groups[name] for name in new if name in predicted.groups}
    return arviz_data.build(groups, view.attrs)


def _checked(times: Any) -> np.ndarray:
    """Return times (K,), or (B, K), after checking their order."""
    if np.ndim(times) == 2:
        return np.array([checks.time_vector("times", row, order="non-decreasing") for row in times])
    return checks.time_vector("times", times, order="non-decreasing")


def _forecast(key: jax.Array, view: ResultView, problem: ModelDraws, times: np.ndarray,
              draws: int, progress: bool, has_rows: bool) -> dict[str, xr.Dataset]:
    """Return the groups of a forecast of one site; ``has_rows`` if the last rows of the data have these times."""
    bound = problem.bound
    check_possible(bound, times, has_rows)
    posterior = view.posterior
    chains = posterior.sizes["chain"]
    draw_index, rows = evenly_spaced(chains, posterior.sizes["draw"], draws)
    attrs = view.attrs
    settings = None
    if str(attrs.get("sampler", "")).startswith("pmmh") and "particles" in attrs:
        settings = check_settings(bound.site.example.ssm, ParticleSettings(int(attrs["particles"])))
    paths = trajectories(key, bound, problem.select(rows).draws, None if has_rows else times, settings,
                         report=Console() if progress else None)
    if has_rows:
        paths = {name: value if name == "log_likelihood" else value[..., -times.shape[-1]:, :]
                 for name, value in paths.items()}
    split = {name: value.reshape(chains, len(draw_index), *value.shape[1:]) for name, value in paths.items()}
    log_likelihood = split.pop("log_likelihood", None)
    # The log likelihood of an observation family depends on the times of the forecast in its last digits, and one that
    # starts from an anchor on those within the data, at which the moments are interpolated.
    is_within_data = np.min(times) < np.max(rebuilding.observations(view)[0])
    is_same = not bound.site.example.is_family and (bound.anchor_point is None or not is_within_data)
    if log_likelihood is not None and is_same:
        total = log_likelihood.reshape(chains, len(draw_index), -1).sum(axis=-1)
        rebuilding.check_likelihood(view, total, draw_index)
    observed, series = view.group("data"), view.series_dimension
    names = {str(name): observed[name].values.tolist() for name in ("output", series) if name in observed.coords}
    return {GROUP: predictions(bound, split, posterior["draw"].values[draw_index], times, names, series)}


def check_possible(bound: Any, times: np.ndarray, has_rows: bool = False) -> None:
    """Raise where new observations at these times have no distribution; ``has_rows`` if these are rows of the data.

    Raises:
        ValueError: see `forecast`.
    """
    if not has_rows and has_noise_of_rows(bound):
        raise ValueError("the covariance of the observation, (T, D, D), or a parameter of its family, (T, D), is given "
                         "for each row of the data and differs between rows, so that there is none at other times. "
                         "Give later rows of a keyword argument R of the model, one for each time: model_kwargs={'R': "
                         "rows of the fit}, inputs={'R': later rows}; or a function (x, u, t) or one number as "
                         "covariance, or an exposure as a known input of the predictor.")
    check_requested_times(bound, times, "times")
    model = bound.site.example.ssm.model
    model.check_span(float(bound.times.min()), float(max(times.max(), bound.times.max())))
