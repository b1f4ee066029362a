"""From a posterior to new observations: forecasts with their noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
import xarray as xr

from lfm_ppl.inference.posterior import evenly_spaced, noise_of_rows, trajectories
from lfm_ppl.io.data_set import InputTable
from lfm_ppl.model.inputs import Input
from lfm_ppl.particles.particle_filter import ParticleSettings
from lfm_ppl.results import arviz_data, rebuilding
from lfm_ppl.results import inputs as known_inputs
from lfm_ppl.results.likelihoods import LikelihoodProblem
from lfm_ppl.results.predictions import GROUP, HELD_OUT, predictions
from lfm_ppl.results.series import series_dimension
from lfm_ppl.results.sites import select_site
from lfm_ppl.utils import calendar_time, checks
from lfm_ppl.utils.progress import Console
from lfm_ppl.utils.random_keys import split_by_name
from lfm_ppl.utils.types import Result, Times
from lfm_ppl.workflows.data_binding import check_requested_times, of_site
from lfm_ppl.workflows.fit_options import keys_of


def forecast(result: Result, numpyro_model: Callable, times: Times, *, inputs: Mapping[str, Any] | None = None,
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
        result: of `lfm_ppl.fit`, or read by `lfm_ppl.load`.
        numpyro_model: the model that was fitted. A result holds draws and data, but no code.
        times: (K,) times of the forecast, non-decreasing, from the initial time on; dates if the data have dates.
            (B, K) where the series of a panel have times of their own. With several likelihood sites for all of them,
            or a dict for some.
        inputs: known inputs (`lfm_ppl.Input`) that reach as far as ``times``, and are the same as before at the data:
            inputs by name, or keyword arguments of the model, that replace the ones of the result. Doses are
            (times, amounts, "dose:STATE"), with all those before. With several likelihood sites a dict by site.
        model_kwargs: keyword arguments of the model, as in the fit.
        draws: number of posterior draws, spread over the chains, each with a path of its own.
        seed: of the paths and the noise.
        progress: show on standard error how far it is.

    Returns:
        A new ArviZ object: the groups of ``result`` and a group ``predictions`` with dimensions chain, draw, time and
        output: new observations under the name of the likelihood's site (``y``), with noise; ``y_mean`` and ``y_sd``,
        their normal distribution at each draw; and ``outputs``, which are noise-free, ``forces``, ``states`` and
        ``deterministics`` along the same paths. `lfm_ppl.score` compares them with data, `lfm_ppl.plot_fit` and
        `lfm_ppl.plot_forces` draw them. Known ``inputs`` are a group ``predictions_constant_data``. With several
        likelihood sites the groups have the names of the sites, see `lfm_ppl.select_site`.

    Raises:
        ValueError: times that go back or lie before the initial time; another model than that of the result, seen by
            its settings, its parameters or its log likelihood at the draws; a known input that ends before ``times``;
            noise whose covariance is given row by row.
        TypeError: ``result`` is no ArviZ object; the model needs a keyword argument.

    Warns:
        UserWarning: a simulated state is not finite.

    Example:
        >>> import jax.numpy as jnp, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        ...     lfmodel = lfm.LatentForceModel(
        ...         lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
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
    sites = list(arviz_data.sites_of(result))
    requested = {name: of_site("times", times, name, sites) for name in sites} if sites else {"": times}
    views = {name: select_site(result, name) if sites else result for name in requested}
    clocks = {name: known_inputs.clock_of(view) for name, view in views.items()}
    requested = {name: _checked(calendar_time.positions("times", values, *clocks[name]))
                 for name, values in requested.items() if values is not None}
    later: Mapping[str, Any] = inputs or {}
    if sites:
        later = {name: of_site("inputs", inputs, name, sites) for name in sites}
    keywords = rebuilding.keywords(result, later, model_kwargs)
    with calendar_time.in_messages(*next(iter(clocks.values()))):
        problem = rebuilding.problem(result, numpyro_model, model_kwargs=keywords)
    groups = {name: arviz_data.group(result, name) for name in arviz_data.groups(result)}
    keys = split_by_name(keys_of(seed)["forecasts"], requested)
    for name in requested:
        suffix = f"_{name.replace('/', '.')}" if sites else ""
        with calendar_time.in_messages(*clocks[name]):
            new = _forecast(keys[name], views[name], problem.sites[name] if sites else problem, requested[name],
                            later[name] if sites else later, draws, progress)
        # Held-out data of an earlier forecast do not belong to this one.
        for group in (HELD_OUT, known_inputs.FORECAST):
            groups.pop(f"{group}{suffix}", None)
        groups |= {f"{group}{suffix}": dataset for group, dataset in new.items()}
    return arviz_data.build(groups, arviz_data.attributes(result))


def _checked(times: Any) -> np.ndarray:
    """Return times (K,), or (B, K), after checking their order."""
    if np.ndim(times) == 2:
        return np.array([checks.time_vector("times", row, order="non-decreasing") for row in times])
    return checks.time_vector("times", times, order="non-decreasing")


def _forecast(key: jax.Array, result: Any, problem: LikelihoodProblem, times: np.ndarray,
              inputs: Mapping[str, Any] | None, draws: int, progress: bool) -> dict[str, xr.Dataset]:
    """Return the groups of a forecast of one site."""
    bound = problem.bound
    check_possible(bound, times)
    posterior = arviz_data.group(result, "posterior")
    chains = posterior.sizes["chain"]
    draw_index, rows = evenly_spaced(chains, posterior.sizes["draw"], draws)
    attrs = arviz_data.attributes(result)
    settings = None
    if str(attrs.get("sampler", "")).startswith("pmmh") and "particles" in attrs:
        settings = ParticleSettings(int(attrs["particles"]))
    paths = trajectories(key, bound, problem.select(rows).draws, times, settings,
                         report=Console() if progress else None)
    split = {name: value.reshape(chains, len(draw_index), *value.shape[1:]) for name, value in paths.items()}
    log_likelihood = split.pop("log_likelihood", None)
    # The log likelihood of an observation family depends on the times of the forecast in its last digits.
    if log_likelihood is not None and not bound.site.example.is_family:
        total = log_likelihood.reshape(chains, len(draw_index), -1).sum(axis=-1)
        rebuilding.check_likelihood(result, total, draw_index)
    observed = arviz_data.group(result, "data")
    series = series_dimension(result)
    names = {str(name): observed[name].values.tolist() for name in ("output", series) if name in observed.coords}
    groups = {GROUP: predictions(bound, split, posterior["draw"].values[draw_index], times, names, series)}
    if continued := {name: InputTable(*value) if isinstance(value, tuple) else InputTable(
            np.asarray(value.times), np.asarray(value.values), value.interpolation)
                     for name, value in (inputs or {}).items() if isinstance(value, Input | tuple)}:
        groups[known_inputs.FORECAST] = known_inputs.to_dataset(continued)
    return groups


def check_possible(bound: Any, times: np.ndarray) -> None:
    """Raise where new observations at these times have no distribution.

    Raises:
        ValueError: see `forecast`.
    """
    example = bound.site.example
    if noise_of_rows(example):
        raise ValueError("the covariance of the observation, (T, D, D), or a parameter of its family, (T, D), is given "
                         "for each row of the data, so that there is none at other times. For a forecast give a "
                         "function (x, u, t) as covariance, or one number for all rows; what differs from row to row, "
                         "such as an exposure, can be a known input of the predictor.")
    check_requested_times(bound, times, "times")
    example.ssm.model.check_span(float(bound.times.min()), float(max(times.max(), bound.times.max())))
