"""From a NumPyro model and data to a posterior in one call.

1. Bind the model to its data, and check every argument.
2. Find the sampler and the starting points (`lfm_ppl.workflows.fit_starts`).
3. Run the chains (`lfm_ppl.inference.sampling`), or find the posterior mode and draw from its Laplace approximation
   (both in `lfm_ppl.workflows.posterior_draws`).
4. Compute scores, diagnostics and trajectories from the draws (`lfm_ppl.workflows.fit_results`).
5. Build the result, store it, and raise its warnings.

With a folder, a `Checkpoint` stores the chains after each second and the batches of step 4, so that a stopped run can
be resumed.
"""

from __future__ import annotations

import contextlib
import functools
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.forces.sde import ApproximationWarning
from lfm_ppl.inference import sampling
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.kernels.options import check_options
from lfm_ppl.inference.model_digest import model_digest
from lfm_ppl.inference.samplers import SAMPLERS
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.results.labels import Labels
from lfm_ppl.results.series import SERIES
from lfm_ppl.results.true_values import checked_truth
from lfm_ppl.storage import checkpoint as checkpoints
from lfm_ppl.utils import calendar_time, checks
from lfm_ppl.utils.compilation import prepare_chains
from lfm_ppl.utils.types import Result, Times
from lfm_ppl.workflows.data_binding import (
    SiteData,
    bind_data,
    check_requested_times,
    completed_model,
    coords_of_site,
    of_site,
    warn_of_missing_predictions,
    warn_of_named_settings,
)
from lfm_ppl.workflows.fit_options import (
    FitOptions,
    check_sizes,
    describe_assumptions,
    describe_priors,
    likelihood_settings,
    model_docstring,
)
from lfm_ppl.workflows.fit_results import (
    ConvergenceWarning,
    FitProblem,
    SiteProblem,
    best_effort,
    build_result,
    finished_result,
    note_warnings,
    post_process,
    write_result,
)
from lfm_ppl.workflows.posterior_draws import draw_about_mode, explain_start_failure, find_chain_start, sample_chains


def fit(
    numpyro_model: Callable,
    times: Times,
    y: ArrayLike | None = None,
    *,
    sampler: str = "nuts",
    chains: int = 4,
    warmup: int | None = None,
    samples: int | None = None,
    thin: int | None = None,
    seed: int = 0,
    at: Times | None = None,
    trajectory_draws: int = 400,
    model_kwargs: Mapping[str, Any] | None = None,
    fixed: Mapping[str, ArrayLike] | None = None,
    rule: Rule | None = None,
    steps: int | None = None,
    iterations: int | None = None,
    method: str | None = None,
    init: Any = None,
    sampler_options: Mapping[str, Any] | None = None,
    chain_method: str | None = None,
    progress: bool = True,
    truth: Mapping[str, ArrayLike] | None = None,
    name: str | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    attributes: Mapping[str, Any] | None = None,
    dims: Mapping[str, Sequence[str]] | None = None,
    coords: Mapping[str, Sequence[Any]] | None = None,
) -> Result:
    """Fit a latent force model: sample its parameters, then its forces given them.

    Args:
        numpyro_model: ``model(times, y=None, **model_kwargs)`` with one site
            ``numpyro.sample(name, lfm.MarginalLikelihood(...), obs=y)``, or a `lfm.panel` in a plate; or with several
            sites, which read their own times and data, ``lfm.MarginalLikelihood(system, times["a"])``, ``obs=y["a"]``.
        times: (T,), non-decreasing. Or, without ``y``, times and observations together: `lfm.Data`, a DataFrame of
            pandas or polars or an xarray Dataset (see `lfm.read_table`); the model then gets the known inputs as its
            argument ``inputs``. Dates (``datetime64``, a DatetimeIndex, ...) become numbers that count from the
            midnight before the first date, in the unit that the model names (``units={"time": "h"}``), else in the unit
            of the time between rows. Numbers in `lfm.Data` with ``units={"time": "d"}`` are converted to that unit,
            too, with the times of its known inputs; it is the unit of the result. For several likelihood sites a dict
            of these by name, ``{"a": data, "b": (times, y)}``: the model gets dicts of times, of y and of known inputs,
            and all dates count from one midnight.
        y: (T, D), NaN or masked where missing; (B, T, D) for a panel.
        sampler: "nuts", "ram" (robust adaptive Metropolis), "pmmh" (particle-marginal RAM: a particle filter estimates
            the likelihood, and the posterior is exact up to its integration steps), or "map" (posterior mode; the draws
            come from its Laplace approximation).
        chains: number of chains.
        warmup: warm-up draws of each chain; by default 1000, and 300 for NUTS from the Laplace approximation.
        samples: draws of each chain, by default 1000; for "map", draws in all, by default 400.
        thin: steps of one draw, also in the warm-up. By default 1 for NUTS, 5 for each parameter for RAM, whose steps
            are cheap and short, and 2 for each parameter for particle-marginal RAM.
        seed: seed of all random numbers.
        at: times of the trajectories, and of new observations; by default a grid over the data. Times after the last
            observation are forecasts, see `forecast`. (B, K) for series that have their own times. Dates where the
            times of the data are dates; numbers are in the unit of the `lfm.Data`, or else of the model. A dict by site
            where the sites need different times.
        trajectory_draws: number of posterior draws, spread over the chains, that get a trajectory; 0: none.
        model_kwargs: keyword arguments of the model. A second fit of the model to other data, times, known inputs and
            real arrays of the same shapes compiles nothing, with the exceptions of `lfm.bind`.
        fixed: fixed parameters: name -> value, ``{"decay": 0.8}`` or ``{"decay[CDKN1A]": 0.8}``.
        rule: linearisation rule of the likelihoods, where the model leaves it open; as in `MarginalLikelihood`.
        steps: the same for the integration steps between two consecutive times. Where steps and iterations are tuned
            (see ``iterations``), filter and smoother take the fewest of 3, 5, 10 and 20 steps, by the same criterion.
        iterations: the same for the iterations of posterior linearisation. With a usable mode (see ``init``) and the
            samplers "nuts" and "ram" they start from the smoothed moments there. By default they are as few as keep the
            error of the log likelihood below 0.1 over the posterior, a standard deviation over 20 draws of the Laplace
            approximation; a line says how many. 0 is a single pass of the filter.
        method: the same for the method of integration. By default, with "nuts" or "ram", it is "exponential" where an
            explicit step is too long for a fast decay at the mode and the model leaves the steps open, too.
        init: starting points. By default, or with "map", draws about the posterior mode. For NUTS they come from the
            Laplace approximation N(mode, C) widened to twice its standard deviations. C, the inverse Hessian, is the
            (dense) inverse mass matrix at the start of the warm-up, and its estimates are regularised towards C. The
            chains move in coordinates in which the posterior is nearly symmetric; ``step_size`` and ``energy`` of the
            result belong to these, draws and densities to the parameters. Where the Laplace approximation is not usable
            (a Hessian with a negative eigenvalue, several modes of similar height, more than 100 parameters), NUTS
            starts as with "median", at the prior median with a unit mass matrix, and prints one line with the reason.
            Along flat directions C has variance one. Or a NumPyro strategy.
        sampler_options: further arguments of NUTS, `RAM` or `ParticleMarginalRAM`, for example
            ``{"target_accept_prob": 0.95}`` or ``{"particles": 500, "delayed": True}``.
        chain_method: "parallel", "vectorized" or "sequential"; by default parallel where there are as many devices as
            chains, sequential otherwise. A fit that is the first computation of JAX makes a device for each chain;
            later than that, only ``numpyro.set_host_device_count(chains)`` at the beginning of the program does.
        progress: show the progress on standard error: a bar, or a line every 30 s where there is no terminal.
        truth: true values of simulated data (``lfm.Data.truth``), stored in the result for plots; a dict by site.
        name: name of the model in the result.
        checkpoint: folder that stores the run: the state of the chains and their draws, written every few seconds, and
            ``posterior.nc`` with the draws so far and at the end with the complete result. A killed process loses the
            last block of draws.
        resume: continue the run in ``checkpoint``; with the draws of an uninterrupted run. Model, data, settings
            and versions must be the same. A finished run is read and returned; in an empty or missing folder a new run
            starts.
        overwrite: replace a result or an unfinished run in ``checkpoint``.
        attributes: further attributes of the result.
        dims: parameter -> names of its dimensions, ``{"decay": ["gene"]}``. By default the plates around it,
            ``event_dims`` of NumPyro's ``infer``. A parameter with an entry for each output has the dimension "output",
            ``numpyro.sample("decay", prior, infer={"event_dims": ["output"]})``, and the outputs as its labels.
        coords: dimension -> labels, ``{"gene": ["CDKN1A", "SESN1"]}``, also of the dimension "output" (columns of y)
            and of the plate of a panel, whose name is the dimension of the series. By default the column names of a
            data frame are the labels of "output", and series have the labels of an xarray DataArray, or numbers. With
            several likelihood sites the dimensions of one are "a_output" and so on.

    Ctrl-C ends the sampling after the present block of steps, about two seconds. With a ``checkpoint`` the finished
    draws are returned, with an attribute ``partial`` and a warning; without one they are the attribute ``result`` of
    the KeyboardInterrupt. A second Ctrl-C does not wait for the end of the block. Both wait for compiled code that is
    running, and for a compilation.

    Returns:
        An ArviZ object (``InferenceData`` on ArviZ 0.23, ``xarray.DataTree`` on 1.x) with the groups

        - ``posterior``: parameters, with coordinates; sites of ``numpyro.deterministic`` have the attribute
          ``derived``;
        - ``sample_stats``;
        - ``log_likelihood``: the Gaussian filter's leave-one-out conditionals, log p of each observed entry given all
          other entries and theta, which make ``az.loo`` right for dependent data;
        - ``log_prior``: the log prior density of each parameter, for ``az.psense_summary``;
        - ``one_step_ahead``: log p(y_k | y_1:k-1, theta) and standardised residuals;
        - ``trajectories``: forces, states, deterministics and ``outputs``, the expected values of the observations, at
          ``at``, given the data; from the Gaussian smoother, and for "pmmh" from the particle smoother. Where densities
          are known, mean and 95% interval of each (``forces_summary`` and so on) and of new data
          (``new_data_summary``);
        - ``posterior_predictive``: replicated data along a path of states and forces given the data, one for each draw.
          (``numpyro.infer.Predictive`` with the same draws simulates NEW forces instead.)
        - ``predictions``: with ``at``, new observations at these times, with noise; see `forecast`;
        - ``observed_data``; ``data``, with dimensions time and output, NaN where missing; and ``truth`` and
          ``constant_data`` (known inputs) if there are any.

        ``observed_data``, ``log_likelihood`` and ``posterior_predictive`` have one dimension ``observation`` for all
        observed entries, with the coordinates time, output and series, so that ``az.loo``, ``az.loo_pit`` and
        ``az.plot_ppc_pit`` take the result as it is.

        With several likelihood sites ``log_likelihood``, ``observed_data`` and ``posterior_predictive`` have a variable
        for each, with a dimension of its own (``a_observation``), and the groups ``data``, ``one_step_ahead``,
        ``trajectories``, ``predictions``, ``truth`` and ``constant_data`` have its name: ``trajectories_a``.
        `lfm.select_series` returns the part of one site as a result of one site, for figures, scores and tables.

    Raises:
        ValueError, TypeError: unknown sampler, wrong shapes, unknown parameters in ``fixed``, and so on; other model,
            data or settings than in the resumed run; no starting point of finite density (the message names the
            part of the log density that is not finite at the prior median).
        FileExistsError, FileNotFoundError: the folder holds a result or a run; there is no run to resume.
        KeyboardInterrupt: Ctrl-C before the first draw, without a checkpoint, or for the second time.

    Warns:
        UserWarning: the result is partial; the model names another rule or number of steps than ``fit``; new
            observations ``at`` these times cannot be predicted, because their noise is given row by row.
        ConvergenceWarning: R-hat above 1.01, fewer than 100 effective draws a chain, divergences, a degenerate
            posterior mode; each with a remedy.
        ApproximationWarning: more iterations, shorter steps or a smaller ``max_step`` would change the posterior;
            before the sampling, an explicit step is too long for a fast decay at the mode or the start.

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
        >>> result = lfm.fit(model, times, np.sin(times)[:, None], sampler="map", samples=50, progress=False)
        >>> result["posterior"]["rate"].shape
        (1, 50)
    """
    start_time = time.perf_counter()
    if samples is None:
        samples = 400 if sampler == "map" else 1000
    check_sizes(sampler, chains, warmup, samples, thin, trajectory_draws)
    check_options(sampler, sampler_options)
    prepare_chains(chains)
    if checkpoint is None and resume:
        raise ValueError("resume continues a run that is stored in a folder; name the folder, checkpoint=...")
    if checkpoint is not None:
        checkpoints.check_folder(checkpoint, resume, overwrite)
    settings = {name: value for name, value in (("rule", rule), ("steps", steps), ("iterations", iterations),
                                                ("method", method)) if value is not None}
    bound, series, clock, model_kwargs = bind_data(completed_model(numpyro_model, settings), times, y, model_kwargs)
    warn_of_named_settings(bound, settings)
    names = list(series) if bound.is_by_site else []
    if names and sampler == "pmmh":
        raise ValueError("sampler 'pmmh' takes a model with one likelihood site, and there are data of "
                         f"{', '.join(names)}; take 'nuts' or 'ram'.")
    sites = {name: _site_problem(bound.site_models[name], data, clock, of_site("at", at, name, names),
                                 of_site("truth", truth, name, names), dims, coords_of_site(coords, name, names))
             for name, data in series.items()}
    digest = None if checkpoint is None else model_digest(bound)
    bound = bound.fix(fixed)
    sites = {name: replace(sites[name], bound=site_model, description={
        **likelihood_settings(site_model.site.example),
        "assumptions": best_effort("the model in words", functools.partial(describe_assumptions, site_model), None),
    }) for name, site_model in bound.site_models.items()}
    times_by_site = {name: site.requested_times for name, site in sites.items()}
    requested_times = None if at is None else times_by_site if bound.is_by_site else times_by_site[bound.site.name]
    if sampler == "map":
        chains, warmup, thin, method_of_chains = 1, 0, None, None
    else:
        thin = thin or SAMPLERS[sampler].steps_per_draw * bound.size or 1
        method_of_chains = sampling.available_method(chain_method, chains)
    options = FitOptions(sampler, chains, warmup, samples, thin, seed, dict(fixed or {}), requested_times,
                         trajectory_draws, init, dict(sampler_options or {}), method_of_chains, settings)
    title = str(name or getattr(numpyro_model, "__name__", "model"))
    description = {
        "model": title, "description": model_docstring(numpyro_model),
        "call": options.call(title, "times, y" if y is not None else "data", model_kwargs),
        **options.description(bound),
        "priors": best_effort("priors in words", lambda: describe_priors(bound), None),
        "assumptions": None if bound.is_by_site else sites[bound.site.name].description["assumptions"]}
    problem = FitProblem(bound, sites, options, description, dict(attributes or {}), start_time)
    store = None
    if checkpoint is not None:
        record = options.record(bound, digest)
        if resume and (finished := finished_result(checkpoint, record)) is not None:
            return finished
        store = checkpoints.begin_or_resume(checkpoint, record, resume)
    if progress:
        if sampler == "map":  # chains may start at the mode, where their likelihood is chosen
            print(f"likelihood: {description['likelihood']}", file=sys.stderr, flush=True)
        if method_of_chains == "sequential" and chain_method is None and jax.default_backend() == "cpu":
            print(f"The {chains} chains run one after another: JAX has {jax.local_device_count()} of the devices for "
                  f"{chains} chains side by side. Call numpyro.set_host_device_count({chains}) before it computes.",
                  file=sys.stderr, flush=True)
    with contextlib.closing(store) if store else contextlib.nullcontext(), calendar_time.in_messages(*clock):
        with explain_start_failure(bound):
            if sampler == "map":
                draws = draw_about_mode(problem, store, progress)
            else:
                start = find_chain_start(problem, store, progress)
                if start.sampler.bound is not problem.bound:
                    problem = problem.with_bound(start.sampler.bound)
                draws = sample_chains(problem, start, store, progress)
        processed = post_process(problem, draws, store, progress)
        partial = draws.partial or processed.partial
        result = build_result(problem, draws, processed, store, partial)
        convergence_warnings = note_warnings(result, processed.warnings)
        if store is not None:
            write_result(store, result)
            if partial is None:
                store.finish()
    if partial is not None:
        if store is None:
            # In a loop of fits Ctrl-C must end the loop, and a partial result must not pass for a complete one.
            raise _StoppedError(result, f"stopped with {partial}; they are in the attribute `result` of this exception "
                                        "(sys.last_value.result). With a folder, checkpoint=..., fit returns them")
        warnings.warn(f"the run was stopped, and its result is partial: {partial}.", stacklevel=2)
    for message in processed.warnings:
        checks.warn(message, ApproximationWarning)
    for message in convergence_warnings:
        checks.warn(message, ConvergenceWarning)
    return result


def _site_problem(bound: BoundModel, site_data: SiteData, clock: tuple[str | None, str], requested_times: Any,
                  truth: Mapping[str, Any] | None, dims: Mapping[str, Sequence[str]] | None,
                  coords: Mapping[str, Sequence[Any]] | None) -> SiteProblem:
    """Check the arguments of `fit` on one likelihood site."""
    data, unit = site_data.on_clock, site_data.unit
    if clock[0] is None and data is not None:  # each site may have a unit of its own
        clock = None, data.units.get("time", "")
    if calendar_time.holds_dates(requested_times):
        requested_times = calendar_time.positions("at", requested_times, *clock)
    elif requested_times is not None and unit is not None and unit != clock[1]:  # in the user's unit
        checks.refuse_durations("at", requested_times)
        requested_times = np.asarray(requested_times, float) * (calendar_time.SECONDS[unit]
                                                                / calendar_time.SECONDS[clock[1]])
    with calendar_time.in_messages(*clock):
        check_requested_times(bound, requested_times)
        warn_of_missing_predictions(bound, requested_times)
    if data is not None:
        coords = {"output": data.outputs, **({SERIES: data.series} if data.series else {}), **(coords or {})}
    labels = Labels.of(bound, dims, coords, site_data.labelled_y)
    truth = data.truth if truth is None and data is not None else truth
    return SiteProblem(bound, labels, requested_times, data, clock, checked_truth(bound, truth, labels))


class _StoppedError(KeyboardInterrupt):
    """Ctrl-C with a partial result.

    Attributes:
        result: the partial result.
    """

    def __init__(self, result: Any, message: str) -> None:
        super().__init__(message)
        self.result = result


