"""From a NumPyro model and data to a posterior: one call."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from numpyro.infer import init_to_median, init_to_value

from lfm_ppl import calendar_time, checks
from lfm_ppl.data import Data, as_data, at_origin, model_keywords
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.forces.sde import ApproximationWarning
from lfm_ppl.inference import sampling
from lfm_ppl.inference.bound_model import BoundModel, bind
from lfm_ppl.inference.bound_samplers import BoundSampler, nuts_sampler, particle_marginal_sampler, ram_sampler
from lfm_ppl.inference.degenerate_mode import degenerate_entries
from lfm_ppl.inference.interruption import was_interrupt
from lfm_ppl.inference.kernels.options import KERNELS, check_options
from lfm_ppl.inference.kernels.particle_marginal import ParticleMarginalRAM, Tuned
from lfm_ppl.inference.laplace_start import (
    Laplace,
    UnusableModeError,
    laplace_approximation,
    starting_points,
)
from lfm_ppl.inference.map import MAPResult, check_sites, mode_of
from lfm_ppl.inference.model_digest import model_digest
from lfm_ppl.inference.posterior import evenly_spaced, scores, trajectories
from lfm_ppl.inference.priors import assumptions, prior
from lfm_ppl.inference.progress import Counter
from lfm_ppl.inference.random_keys import split_keys
from lfm_ppl.inference.samplers import FILTERED, SAMPLERS
from lfm_ppl.inference.schedule import Schedule
from lfm_ppl.inference.site_failures import failures_at, paths_worth, site_failures
from lfm_ppl.inference.start_failure import start_failure
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.progress import waiting
from lfm_ppl.results import arviz_data
from lfm_ppl.results import checkpoint as checkpoints
from lfm_ppl.results.approximation import approximation_warnings, resolution_warnings
from lfm_ppl.results.checkpoint import Checkpoint
from lfm_ppl.results.files import POSTERIOR
from lfm_ppl.results.inputs import remember
from lfm_ppl.results.layout import Labels, checked_truth, lay_out

_WARMUP, _SHORT_WARMUP = 1000, 300
"""Draws of the warm-up of each chain by default; the short one is that of NUTS from the Laplace approximation."""

_GRID = 200
"""Number of grid points of trajectories where no times are asked for."""

class ConvergenceWarning(UserWarning):
    """A diagnostic says that the draws do not represent the posterior yet."""


def fit(
    numpyro_model: Callable,
    times: Any,
    y: Any = None,
    *,
    sampler: str = "nuts",
    chains: int = 4,
    warmup: int | None = None,
    samples: int | None = None,
    thin: int | None = None,
    seed: int = 0,
    at: Any = None,
    trajectory_draws: int = 400,
    model_kwargs: Mapping[str, Any] | None = None,
    fixed: Mapping[str, Any] | None = None,
    init: Any = None,
    sampler_options: Mapping[str, Any] | None = None,
    chain_method: str | None = None,
    progress: bool = True,
    truth: Mapping[str, Any] | None = None,
    name: str | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    attributes: Mapping[str, Any] | None = None,
    dims: Mapping[str, Sequence[str]] | None = None,
    coords: Mapping[str, Sequence[Any]] | None = None,
) -> Any:
    """Fit a latent force model: sample its parameters, then its forces given them.

    Args:
        numpyro_model: ``model(times, y=None, **model_kwargs)`` with one site
            ``numpyro.sample(name, lfm.MarginalLikelihood(...), obs=y)``, or a `lfm.panel` in a plate.
        times: (T,), non-decreasing. Or, without ``y``, the whole data: `lfm.Data`, a DataFrame of pandas or polars or
            an xarray Dataset (see `lfm.read_table`); the model then gets the known inputs as its argument ``inputs``.
            Dates (``datetime64``, a DatetimeIndex, ...) become numbers since the midnight before the first of them, in
            the unit that the model names (``units={"time": "h"}``), else in that of the time between rows.
        y: (T, D), NaN or masked where missing; (B, T, D) for a panel.
        sampler: "nuts", "ram" (robust adaptive Metropolis), "pmmh" (particle-marginal RAM: a particle filter estimates
            the likelihood, and the posterior is exact up to its integration steps), or "map" (posterior mode; the draws
            come from its Laplace approximation).
        chains: number of chains.
        warmup: number of warm-up steps in each; by default 1000, and 300 for NUTS from the Laplace approximation.
        samples: number of draws in each, by default 1000; for "map", in all, by default 400.
        thin: steps of the chain that make one draw, in the warm-up too. By default 1 for NUTS, 5 for each parameter
            for RAM, whose steps are cheap and short, and 2 for each parameter for particle-marginal RAM.
        seed: of everything random.
        at: times of the trajectories, and of new observations; by default a grid over the data. Times after the last
            observation are forecasts, see `forecast`. Dates where the times of the data are dates; numbers count in
            the unit of the `lfm.Data`, or else of the model.
        trajectory_draws: number of posterior draws, spread over the chains, for which trajectories are drawn; 0: none.
        model_kwargs: keyword arguments of the model.
        fixed: parameters that are not learnt: name -> value, ``{"decay": 0.8}`` or ``{"decay[CDKN1A]": 0.8}``.
        init: starting points. By default, or with "map", draws about the posterior mode. For NUTS they come from the
            Laplace approximation N(mode, C) widened to twice its standard deviations, and C, the inverse Hessian, is
            the (dense) inverse mass matrix with which the warm-up begins and towards which its estimates are
            regularised. Where the Laplace approximation is not usable (a flat direction, a Hessian that is not positive
            definite, several modes of similar height, more than 100 parameters) NUTS starts as with "median", the prior
            median and a unit mass matrix, and one line says why. Or a NumPyro strategy.
        sampler_options: further arguments of NUTS, `RAM` or `ParticleMarginalRAM`, for example
            ``{"target_accept_prob": 0.95}`` or ``{"particles": 500, "delayed": True}``.
        chain_method: "parallel", "vectorized" or "sequential"; by default parallel where there are as many devices as
            chains (``numpyro.set_host_device_count(chains)`` before JAX starts), sequential otherwise.
        progress: show on standard error how far it is: a bar, or a line every 30 s where there is no terminal.
        truth: of simulated data (``lfm.Data.truth``), stored beside the results for plots.
        name: of the model, for the record.
        checkpoint: a folder to keep the run in while it goes on: the state of the chains and their draws, written at
            least every few seconds, and a ``posterior.nc`` with the draws so far, in the end with the whole result.
            A process that is killed loses the last block of draws.
        resume: go on with the run in ``checkpoint``, to the same draws as if it had not been stopped. Everything must
            be as it was: model, data, settings and versions. A run that is finished is read and returned; in a folder
            that is empty or does not exist a new one begins.
        overwrite: replace a result or an unfinished run in ``checkpoint``.
        attributes: further attributes of the result.
        dims: parameter -> names of its dimensions, ``{"decay": ["gene"]}``. By default the plates that it stands in,
            ``event_dims`` of NumPyro's ``infer``, "output" for a vector with an entry for each output.
        coords: dimension -> labels, ``{"gene": ["CDKN1A", "SESN1"]}``; of "output", the names of the columns of y, and
            of "series", those of a panel, too. By default columns of a data frame keep their names.

    Ctrl-C ends the sampling after the present block of steps, some two seconds. With a ``checkpoint`` the draws so far
    are returned, with an attribute ``partial`` and a warning; without one they are the attribute ``result`` of the
    KeyboardInterrupt that is raised. A second Ctrl-C ends it at once.

    Returns:
        An ArviZ object (``InferenceData`` on ArviZ 0.23, ``xarray.DataTree`` on 1.x) with the groups

        - ``posterior``: parameters, with coordinates; what ``numpyro.deterministic`` computes of them has the attribute
          ``derived``;
        - ``sample_stats``;
        - ``log_likelihood``: the Gaussian filter's leave-one-out conditionals log p(y_k | y_-k, theta), which make
          ``az.loo`` right for dependent data;
        - ``one_step_ahead``: log p(y_k | y_1:k-1, theta) and standardised residuals;
        - ``trajectories``: forces, states, deterministics of these and noise-free outputs at ``at``, given the data;
          from the Gaussian smoother, and for "pmmh" from the particle smoother. Where densities are known, mean and 95%
          interval of each, ``forces_summary`` and so on, and of new data, ``new_data_summary``;
        - ``posterior_predictive``: replicated data along these trajectories. (``numpyro.infer.Predictive`` with the
          same draws simulates NEW forces instead.)
        - ``predictions``: with ``at``, new observations at these times, with their noise; see `forecast`;
        - ``observed_data``, and ``truth`` and ``constant_data`` (known inputs) where there are any.

    Raises:
        ValueError, TypeError: unknown sampler, wrong shapes, parameters to fix that do not exist, and so on; a run to
            go on with that was of something else; no point to start from, with the part of the log density that is
            not finite at the prior median.
        FileExistsError, FileNotFoundError: the folder holds a result or a run; no run to go on with.
        KeyboardInterrupt: Ctrl-C before there was a draw, without a checkpoint, or for the second time.

    Warns:
        UserWarning: the result is partial.
        ConvergenceWarning: R-hat above 1.01, fewer than 100 effective draws a chain, divergences, a degenerate
            posterior mode; each with a remedy.
        ApproximationWarning: more iterations, shorter steps or a shorter longest step would move the posterior.

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
        >>> result = lfm.fit(model, times, np.sin(times)[:, None], sampler="map", samples=50, progress=False)
        >>> result["posterior"]["rate"].shape
        (1, 50)
    """
    started = time.perf_counter()
    if samples is None:
        samples = 400 if sampler == "map" else 1000
    _check_sizes(sampler, chains, warmup, samples, thin, trajectory_draws)
    check_options(sampler, sampler_options)
    if checkpoint is None and resume:
        raise ValueError("resume goes on with a run that a folder keeps; name the folder, checkpoint=...")
    if checkpoint is not None:
        checkpoints.check_folder(checkpoint, resume, overwrite)
    data, unit = None, times.units.get("time") if isinstance(times, Data) else None
    if y is None:
        data = as_data(times)
        times, y = data.times, data.y
        coords = {"output": data.outputs, **(coords or {})}
    bound, data, clock = bind_dates(numpyro_model, times, y, data, model_kwargs)
    if data is not None:
        truth = data.truth if truth is None else truth
        model_kwargs = model_keywords(data.inputs, model_kwargs)
    if calendar_time.holds_dates(at):
        at = calendar_time.positions("at", at, *clock)
    elif at is not None and unit is not None and unit != clock[1]:  # numbers in the unit of the data as they were
        checks.refuse_durations("at", at)
        at = np.asarray(at, float) * (calendar_time.SECONDS[unit] / calendar_time.SECONDS[clock[1]])
    with calendar_time.in_messages(*clock):
        check_requested(bound, at)
    labels = Labels.of(bound, dims, coords, y)
    truth = checked_truth(bound, truth, labels)
    digest = None if checkpoint is None else model_digest(bound)
    bound = bound.fix(fixed)
    if sampler == "map":
        chains, warmup, thin, method = 1, 0, None, None
    else:
        thin = thin or SAMPLERS[sampler].steps_a_draw * bound.size or 1
        method = sampling.available_method(chain_method, chains)
    asked = _Asked(sampler, chains, warmup, samples, thin, seed, dict(fixed or {}), at, trajectory_draws, init,
                   dict(sampler_options or {}), method)
    title = str(name or getattr(numpyro_model, "__name__", "model"))
    call = _call(title, "times, y" if data is None else "data", asked, model_kwargs)
    run = _Run(bound, asked, labels, data, clock, truth, progress, started, {
        "model": title, "description": described_by(numpyro_model), "call": call, **asked.described(bound),
        "priors": kept("priors in words", lambda: _priors(bound), None),
        "assumptions": kept("the model in words", lambda: _assumptions(bound), None)}, dict(attributes or {}))
    if checkpoint is not None:
        record = asked.record(bound, digest)
        if resume and (finished := checkpoints.finished(checkpoint, record)) is not None:
            return finished
        run.keeper = checkpoints.begin_or_resume(checkpoint, record, resume)
    if progress:
        print(f"likelihood: {run.described['likelihood']}", file=sys.stderr, flush=True)
    with checkpoints.closing(run.keeper), calendar_time.in_messages(*clock):
        with _start_explained(bound):
            run.sample()
        run.follow()
        result = run.result()
        found = note_warnings(result, run.cautions)
        run.store(result)
        if run.keeper is not None and run.partial is None:
            run.keeper.finish()
    if run.partial is not None:
        if run.keeper is None:
            # Who runs one fit after another wants them all to end, and takes none for whole that is not.
            raise _Stopped(result, f"stopped with {run.partial}; they are in the attribute `result` of this exception "
                                   "(sys.last_value.result). With a folder, checkpoint=..., fit returns them")
        warnings.warn(f"the run was stopped, and its result is partial: {run.partial}.", stacklevel=2)
    for message in run.cautions:
        checks.warn(message, ApproximationWarning)
    warn_of_convergence(found)
    return result


def _check_sizes(sampler: str, chains: int, warmup: int | None, samples: int, thin: int | None, paths: int) -> None:
    checks.one_of("sampler", sampler, SAMPLERS, likeness=checks.ABBREVIATIONS)
    for label, value, none in (("chains", chains, ()), ("samples", samples, ()), ("warmup", warmup, (None, 0)),
                               ("thin", thin, (None,)), ("trajectory_draws", paths, (0,))):
        if value not in none:
            checks.positive_integer(label, value)


class _Asked(NamedTuple):
    """How to sample, as `fit` was asked; its arguments are described there.

    Attributes:
        thin: steps of a draw; None for "map".
        method: how the chains run side by side.
    """

    sampler: str
    chains: int
    warmup: int | None
    samples: int
    thin: int | None
    seed: int
    fixed: dict[str, Any]
    at: Any
    trajectory_draws: int
    init: Any
    options: dict[str, Any]
    method: str | None

    @property
    def keys(self) -> jax.Array:
        """Random keys: of the chains, their starts, and the trajectories, among others."""
        return jax.random.split(jax.random.key(self.seed), 5)

    def described(self, bound: BoundModel) -> dict[str, Any]:
        """Return what the attributes of the result say of the approximation and the sampler."""
        example = bound.site.example
        return {
            "rule": example.rule.name, "steps": example.steps, "max_step": example.max_step,
            "iterations": example.iterations, "tolerance": example.tolerance, "sampler": self.sampler,
            "likelihood": ("estimated without bias (particle filter)" if self.sampler == "pmmh"
                           else example.description),
            "seed": self.seed, "chains": self.chains, "warmup": self.warmup, "samples": self.samples,
            "fixed": json.dumps({k: np.asarray(v).tolist() for k, v in self.fixed.items()}),
            **({"sites": example.sites_in_words} if example.sites_in_words else {}),
            **({"constraints": example.constraints_in_words} if example.constrained else {}),
        }  # fmt: skip

    def record(self, bound: BoundModel, digest: Any) -> dict[str, Any]:
        """Return all that a run must share with one that it goes on with."""
        return {
            **self.described(bound), "thin": self.thin, "chain_method": self.method, "init": self.init,
            "sampler_options": self.options, "trajectory_draws": self.trajectory_draws, "parameters": bound.names,
            "model": checkpoints.digest(digest), "times": checkpoints.digest(bound.times),
            "data": checkpoints.digest(bound.y),
            "times of the trajectories": None if self.at is None else checkpoints.digest(np.asarray(self.at, float)),
            "versions": checkpoints.versions(),
        }  # fmt: skip


@dataclass
class _Run:
    """A run of `fit`: what it is of, how far it is, and where it is kept.

    Attributes:
        bound: the model with its data, without the parameters that are fixed.
        asked: how to sample.
        labels: names of dimensions and entries.
        data: as they were given, with known inputs; None where times and y were.
        clock: calendar time of t = 0, None where times are plain numbers, and unit of time.
        truth: of simulated data.
        progress: whether to show how far it is.
        started: when it began.
        described: attributes of the result, but for those that come of sampling.
        attributes: those that the user wants besides.
        keeper: what keeps it in a folder; None: nothing does.
        z: (C, N, d), unconstrained draws of the chains; None for "map".
        draws: site -> (C, N, ...), so far.
        stats: statistics of the sampler, (C, N) each.
        remarks: attributes that come of sampling.
        particles: what trajectories of "pmmh" need to know of its particles.
        rated: scores of the observations; None where there are none yet.
        drawn: chosen draws, their trajectories, and the times of these.
        cautions: messages on the likelihood for the attribute ``warnings``.
        partial: what a result that was stopped lacks; None: nothing.
    """

    bound: BoundModel
    asked: _Asked
    labels: Labels
    data: Data | None
    clock: tuple[str | None, str]
    truth: Mapping[str, Any] | None
    progress: bool
    started: float
    described: dict[str, Any]
    attributes: dict[str, Any]
    keeper: Checkpoint | None = None
    z: np.ndarray | None = None
    draws: dict[str, np.ndarray] = field(default_factory=dict)
    stats: dict[str, np.ndarray] = field(default_factory=dict)
    remarks: dict[str, Any] = field(default_factory=dict)
    particles: dict[str, Any] = field(default_factory=dict)
    rated: Any = None
    drawn: tuple = (None, None, None)
    cautions: list[str] = field(default_factory=list)
    partial: str | None = None

    def sample(self) -> None:
        """Draw parameters, or find the mode; after Ctrl-C, as far as it came.

        Raises:
            KeyboardInterrupt: there are no draws.
        """
        asked, keeper = self.asked, self.keeper
        key = asked.keys[1]
        if asked.sampler == "map":
            if isinstance(asked.init, Mapping):
                check_sites(self.bound, asked.init)
            else:
                _check_init(asked.init)
            known = keeper is not None and keeper.holds(_MODE)
            with waiting(_SEARCH, self.progress and not known):
                self.draws, self.stats, self.remarks = _mode(self.bound, key, asked.samples, asked.seed, asked.init,
                                                             keeper)
            return
        assert asked.thin is not None
        setup = keeper.setup if keeper is not None and keeper.started else None
        is_at_mode = asked.init in (None, "map")
        with waiting(_SEARCH if is_at_mode else _START, self.progress and setup is None):
            if asked.sampler == "nuts":
                sampler, starts, remarks = _nuts_sampler(self.bound, asked, setup)
            else:
                sampler, starts, remarks = _random_walk_sampler(asked, self.bound, setup)
        if self.progress and setup is None and _FALLBACK in remarks:
            print(f"note     {remarks[_FALLBACK]}", file=sys.stderr, flush=True)
        warmup = remarks["warmup"] * asked.thin
        if keeper is not None:
            if setup is None:
                keeper.setup = {name: remarks[name] for name in _SETUP if name in remarks}
            keeper.look = self._look
        self.particles = {label: remarks.pop(label, None) for label in _OF_PARTICLES}
        self.remarks = {**remarks, "thin": asked.thin}
        schedule = Schedule(warmup, asked.samples, asked.thin, asked.method)
        collected = sampling.run_chains(key, sampler, starts, schedule, keeper, self.progress)
        count = collected.z.shape[1]
        if count == 0:
            raise KeyboardInterrupt(f"stopped in the warm-up, after {collected.done:,} of {collected.total:,} steps; "
                                    "there are no draws yet")
        if collected.done < collected.total:
            self.partial = _some(count, asked.samples)
        self.z = collected.z
        self.draws, self.stats = _draws(self.bound, {"z": collected.z, **collected.statistics}, asked.samples)

    def follow(self) -> None:
        """Compute what follows from the draws, scores of the observations and trajectories; after Ctrl-C, less."""
        if self.partial is not None:
            return
        asked, keeper = self.asked, self.keeper
        if keeper is not None:  # the draws are safe, whatever comes
            self.store(self.result(_BARE))
        flat = {site: self.draws[site].reshape(-1, *self.draws[site].shape[2:]) for site in self.bound.sites}
        counter = Counter(is_shown=self.progress)

        def watched(what: str) -> dict[str, Any]:
            return {"show": counter.restart(what), "parts": None if keeper is None else keeper.parts(what)}

        try:
            self.rated = kept("scores of the observations",
                              lambda: scores(self.bound, flat, **watched("scores")), None)
            self.remarks |= self._found_of_sites(flat)
            self.cautions += kept("resolution of the forces", lambda: resolution_warnings(self.bound, flat), [])
            if asked.sampler in FILTERED:
                self.cautions += kept("error of the likelihood", lambda: approximation_warnings(
                    self.bound, flat, self._log_likelihood()), [])
            self.drawn = kept("trajectories", lambda: draw_paths(
                asked.keys[3], self.bound, flat, asked.at, asked.trajectory_draws, asked.chains, asked.samples,
                **{label: self.particles.get(label) for label in _OF_PARTICLES}, **watched("trajectories")), self.drawn)
        except KeyboardInterrupt:
            self.partial = _BARE if self.rated is None else "all draws and their scores, without trajectories"
        finally:
            counter.close()

    def _log_likelihood(self) -> np.ndarray | None:
        """Return the log likelihood (S,) of each draw; None where the scores do not add up to it."""
        if self.rated is None or isinstance(self.bound.site.example.model.observation, ObservationFamily):
            return None
        terms = self.rated["one_step_ahead"]
        return terms.reshape(len(terms), -1).sum(axis=1)

    def _found_of_sites(self, flat: Mapping[str, Any]) -> dict[str, str]:
        """Return attributes that say where sites do not converge, and what the weights of trajectories are worth."""
        asked, found, z = self.asked, {}, self.z
        if asked.sampler in FILTERED and z is not None:
            found[arviz_data.SITES] = kept("convergence of the sites",
                                           lambda: site_failures(self.bound, z, asked.seed), None)
        elif asked.sampler == "map" and self.bound.site.example.constrained:
            found[arviz_data.SITES] = kept("convergence of the sites", lambda: failures_at(self.bound, flat), None)
        found[arviz_data.WEIGHTS] = kept("weights under the constraints", lambda: paths_worth(self.bound, flat), None)
        return {name: json.dumps(value) for name, value in found.items() if value is not None}

    def result(self, partial: str | None = None) -> Any:
        """Return an ArviZ object of what there is.

        Args:
            partial: what it lacks; None: what the run says.
        """
        seconds = time.perf_counter() - self.started if self.keeper is None else self.keeper.seconds
        attrs = {
            **self.described, "wall_time_s": round(seconds, 3), "versions": json.dumps(versions()),
            "created_at": datetime.now(UTC).isoformat(timespec="seconds"), **self.remarks,
            "partial": partial or self.partial, "run": None if self.keeper is None else self.keeper.record,
            **self.attributes,
        }  # fmt: skip
        chosen, paths, grid = self.drawn
        groups = lay_out(self.bound, self.draws, self.stats, self.rated, paths, chosen, grid, self.truth, self.labels)
        attrs |= remember(groups, self.data, *self.clock)
        return arviz_data.build(groups, {k: v for k, v in attrs.items() if v is not None})

    def store(self, result: Any) -> None:
        """Write a result into the folder, where there is one."""
        if self.keeper is not None:
            arviz_data.save(result, self.keeper.folder / POSTERIOR, overwrite=True)

    def _look(self, rows: Mapping[str, np.ndarray]) -> None:
        """Write a partial result of rows that the chains have left so far."""
        def write() -> None:
            draws, stats = _draws(self.bound, rows, self.asked.samples)
            so_far = dataclasses.replace(self, draws=draws, stats=stats)
            self.store(so_far.result(_some(rows["z"].shape[1], self.asked.samples)))

        kept("partial result", write, None)


class _Stopped(KeyboardInterrupt):
    """Ctrl-C, with what there is: ``result``."""

    def __init__(self, result: Any, message: str) -> None:
        super().__init__(message)
        self.result = result


_FALLBACK = "init_fallback"
"""Attribute of a result: why NUTS did not start from the Laplace approximation."""

_SETUP = ("particles", "log_likelihood_sd", "warmup", "init", _FALLBACK)
"""Remarks of the start that a run needs to go on."""

_OF_PARTICLES = ("particle_settings", "particle_steps")
"""What the trajectories of pmmh need to know of its particles."""

_MODE = "mode"
"""Name under which a run keeps the mode and the draws about it."""

_SEARCH, _START = "posterior mode: compiling and searching", "start: compiling, and looking for where chains begin"

_BARE = "all draws, without scores and trajectories"


def _some(draws: int, samples: int) -> str:
    return f"{draws} of {samples} draws a chain, without scores and trajectories"


def _draws(bound: BoundModel, rows: Mapping[str, np.ndarray], samples: int) -> tuple[dict, dict]:
    """Return site name -> draws, and the statistics, of rows that the chains left."""
    z = rows["z"]
    count = z.shape[1]
    # As many rows as there will be: compiled once, whatever their number.
    whole = np.concatenate([z, np.repeat(z[:, -1:], samples - count, axis=1)], axis=1)
    draws = {site: values[:, :count] for site, values in bound.constrain_draws(whole).items()}
    return draws, _statistics({name: values for name, values in rows.items() if name != "z"})


def note_warnings(result: Any, cautions: Sequence[str] = ()) -> list[str]:
    """Store warnings of the draws and the likelihood in the attribute ``warnings``; return those of the draws.

    Args:
        result: an ArviZ object.
        cautions: messages on the likelihood.
    """
    found = arviz_data.convergence_warnings(result)
    result.attrs["warnings"] = json.dumps([*found, *cautions])
    return found


def warn_of_convergence(found: Sequence[str]) -> None:
    """Warn of what `note_warnings` found."""
    for message in found:
        checks.warn(message, ConvergenceWarning)


@contextlib.contextmanager
def _start_explained(bound: BoundModel) -> Iterator[None]:
    """Where no point to start from is found, add to the error which part of the density fails at the prior median."""
    try:
        yield
    except ValueError as error:
        if "finite density" not in str(error):
            raise
        reason = kept("reason why there is nowhere to start", lambda: start_failure(bound), None)
        if reason is None:
            raise
        raise ValueError(f"{error} At the prior median, {reason}") from error


def kept(what: str, compute: Callable[[], Any], otherwise: Any) -> Any:
    """Compute something from the draws; a failure must not lose the draws, which took the time."""
    try:
        return compute()
    except Exception as error:
        if was_interrupt(error):
            raise KeyboardInterrupt from error
        reason = f"{type(error).__name__}: {error}"
        warnings.warn(f"the {what} could not be computed and are left out of the result: {reason}", stacklevel=3)
        return otherwise


def check_requested(bound: BoundModel, at: Any) -> None:
    """Raise before sampling what would stop the trajectories after it."""
    if at is None:
        return
    if bound.times.ndim != 1:
        raise ValueError("`at` needs one vector of times for all series; this panel has times of its own for each.")
    example = bound.site.example
    build_time_grid(example.ssm, bound.times, example.steps, example.max_step, at, tolerance=example.tolerance)


def _check_init(init: Any) -> None:
    if isinstance(init, str):
        checks.one_of("init", init, ("map", "median"))
    elif init is not None and not callable(init):
        raise TypeError('init must be None, "map", "median" or a NumPyro strategy such as '
                        f"numpyro.infer.init_to_uniform, got {init!r}.")


def _strategy(init: Any, bound: BoundModel, seed: int) -> Any:
    if init is None or isinstance(init, str) and init == "median":
        return init_to_median
    return init_to_value(values=mode_of(bound, seed=seed).parameters) if isinstance(init, str) else init


def _nuts_sampler(bound: BoundModel, asked: _Asked, setup: Mapping[str, Any] | None
                  ) -> tuple[BoundSampler, np.ndarray | None, dict]:
    """Return NUTS, the starting points (C, d), and attributes of the result; see `_random_walk_sampler`."""
    init, options = asked.init, asked.options
    _check_init(init)
    # A mass matrix of the user's is not regularised by another one.
    is_free = "inverse_mass_matrix" not in options and options.get("dense_mass", True) is True

    def sampler(laplace: Laplace | None, warmup: int) -> BoundSampler:
        return nuts_sampler(bound, warmup * (asked.thin or 1), options, laplace if is_free else None)

    def steps(is_laplace: bool) -> int:
        return asked.warmup if asked.warmup is not None else _SHORT_WARMUP if is_laplace and is_free else _WARMUP

    if setup is not None:
        is_laplace = setup["init"] == "laplace"
        placeholder = Laplace(np.zeros(bound.size), np.eye(bound.size)) if is_laplace else None
        return sampler(placeholder, setup["warmup"]), None, dict(setup)
    reason = None
    if init in (None, "map"):
        try:
            laplace = laplace_approximation(bound, asked.seed)
        except UnusableModeError as error:
            reason = f"the chains start at the prior median, with a unit mass matrix: {error}"
        else:
            chosen = dataclasses.replace(sampler(laplace, steps(True)), slow_warmup_hint="")
            points = starting_points(asked.keys[2], bound, laplace, asked.chains)
            return chosen, points, {"warmup": steps(True), "init": "laplace"}
        init = None
    chosen = sampler(None, steps(False))
    points = _starts(asked.keys[2], bound, _strategy(init, bound, asked.seed), asked.chains, chosen.evaluate)
    remarks = {"warmup": steps(False), "init": "strategy" if callable(init) else "median"}
    if reason is None:
        return chosen, points, remarks
    return dataclasses.replace(chosen, slow_warmup_hint=""), points, remarks | {_FALLBACK: reason}


def _random_walk_sampler(asked: _Asked, bound: BoundModel, setup: Mapping[str, Any] | None
                         ) -> tuple[BoundSampler, np.ndarray | None, dict[str, Any]]:
    """Return how the chains of a random walk move, where each of them starts (C, d), and what to remember of it.

    Chains that go on start nowhere: all that their transition needs to know is in ``setup``.
    """
    init, sampler, seed, key, chains = asked.init, asked.sampler, asked.seed, asked.keys[2], asked.chains
    _check_init(init)
    options = dict(asked.options)
    draws = _WARMUP if asked.warmup is None else asked.warmup
    warmup = draws * (asked.thin or 1)
    if setup is not None:
        kernel = KERNELS[sampler](bound.model, **options)
        if not isinstance(kernel, ParticleMarginalRAM):
            return ram_sampler(bound, warmup, kernel), None, {"warmup": draws}
        kernel.prepare(bound, None, Tuned(int(setup["particles"]), float(setup["log_likelihood_sd"])))
        return particle_marginal_sampler(bound, warmup, kernel), None, _remarks(kernel) | {"warmup": draws}
    strategy = _strategy(init, bound, seed)
    mode = None
    if "initial_covariance" not in options:
        # A random walk that starts with the shape of the posterior needs no gradient afterwards, but learning that
        # shape by rejection takes thousands of steps. The mode gives it; chains start at draws from its Laplace
        # approximation.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mode = mode_of(bound, seed=seed, restarts=2)
        if mode.unidentified or not np.all(np.isfinite(mode.covariance)):
            mode = None
    if mode is not None:
        options["initial_covariance"] = mode.covariance
        if sampler == "pmmh":
            # At the mode, because a chain's own start may be a poor place to judge the estimate by.
            options.setdefault("tune_at", bound.unravel(mode.mode))
    kernel = KERNELS[sampler](bound.model, **options)
    starts = (_starts(key, bound, strategy, chains, bound.log_density) if mode is None or init is not None
              else _about(key, bound, mode, chains))
    if not isinstance(kernel, ParticleMarginalRAM):
        return ram_sampler(bound, warmup, kernel), starts, {"warmup": draws}
    kernel.prepare(bound, starts[0])
    return particle_marginal_sampler(bound, warmup, kernel), starts, _remarks(kernel) | {"warmup": draws}


def _remarks(kernel: ParticleMarginalRAM) -> dict[str, Any]:
    assert kernel.tuned is not None
    return {"particles": kernel.tuned.particles, "log_likelihood_sd": kernel.tuned.sd, "delayed": int(kernel.delayed),
            "particle_settings": kernel.settings, "particle_steps": kernel.particle_steps}


def _starts(key: jax.Array, bound: BoundModel, strategy: Any, chains: int, evaluate: Any) -> np.ndarray:
    """Return a point (C, d) for each chain, by a NumPyro strategy, where what ``evaluate`` gives is finite."""
    keys = split_keys(key, chains)
    return np.stack([bound.start(keys(chain), strategy, evaluate=evaluate) for chain in range(chains)])


def _about(key: jax.Array, bound: BoundModel, mode: MAPResult, chains: int) -> np.ndarray:
    """Return draws (C, d) of the Laplace approximation, the mode itself where the density of a draw is zero."""
    root = np.linalg.cholesky(mode.covariance)
    points = mode.mode + np.asarray(jax.random.normal(key, (chains, bound.size))) @ root.T
    possible = [bool(np.isfinite(bound.log_density_gradient(point)[0])) for point in points]
    return np.where(np.array(possible)[:, None], points, mode.mode)


def _statistics(collected: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    stats = {**collected, "lp": -collected["lp"]}
    if "n_steps" in stats:
        stats["tree_depth"] = np.ceil(np.log2(stats["n_steps"] + 1)).astype(int)
    return stats


def _mode(bound: BoundModel, key: jax.Array, samples: int, seed: int, init: Any,
          run: Checkpoint | None) -> tuple[dict, dict, dict]:
    if isinstance(init, str):
        init = None

    def compute() -> dict[str, Any]:
        # Second derivatives take longer to compile than everything else here takes to run.
        mode = mode_of(bound, seed=seed, init=init)
        remarks = {"map_converged": int(mode.converged), "map_message": mode.message,
                   "map_log_density": float(mode.log_density), "log_evidence": float(mode.log_evidence),
                   arviz_data.MODE: json.dumps({name: value.tolist() for name, value in
                                                {**mode.parameters, **mode.deterministic}.items()})}
        draws = mode.sample(key, samples)
        degenerate = kept("check of the mode", lambda: degenerate_entries(bound, mode, draws), {})
        remarks |= {arviz_data.DEGENERATE: json.dumps(degenerate)} if degenerate else {}
        return {"": np.asarray(json.dumps(remarks)), **draws}

    found = compute() if run is None else run.once(_MODE, compute)
    remarks = json.loads(str(found.pop("")))
    return {label: np.asarray(value)[None] for label, value in found.items()}, {}, remarks


def draw_paths(key: jax.Array, bound: BoundModel, draws: dict, at: Any, count: int, chains: int, samples: int,
               particle_settings: Any, particle_steps: int | None,
               **more: Any) -> tuple[np.ndarray, dict | None, np.ndarray | None]:
    """Draw trajectories for draws that are spread evenly over each chain."""
    chosen, rows, grid = _paths(bound, at, count, chains, samples)
    if not len(rows):
        return chosen, None, None
    subset = {site: value[rows] for site, value in draws.items()}
    paths = trajectories(key, bound, subset, grid, particle_settings, particle_steps, **more)
    if at is None:
        paths.pop("prediction", None)  # stored where they were asked for
    return chosen, {k: v.reshape(chains, len(chosen), *v.shape[1:]) for k, v in paths.items()}, grid


def _paths(bound: BoundModel, at: Any, count: int, chains: int,
           samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return which draws of each chain have a trajectory, their rows among all draws, and its times."""
    chosen, rows = evenly_spaced(chains, samples, count)
    times = bound.times
    if times.ndim > 1:
        return chosen, rows, None
    if at is not None:
        return chosen, rows, np.atleast_1d(np.asarray(at, float))
    origin = float(bound.site.example.time_grid.initial_time)
    return chosen, rows, np.union1d(np.linspace(min(origin, times[0]), times[-1], _GRID), times)


def bind_dates(numpyro_model: Callable, times: Any, y: Any, data: Data | None,
               model_kwargs: Mapping[str, Any] | None) -> tuple[BoundModel, Data | None, tuple[str | None, str]]:
    """Bind a model to times that may be dates, counted in the unit of time that the model names.

    Args:
        numpyro_model: the model.
        times: (T,) or (B, T), numbers or dates.
        y: the observations, or a data frame of them.
        data: what times and y were taken from, where they were.
        model_kwargs: keyword arguments of the model, without the known inputs of ``data``.

    Returns:
        The bound model; the data, with times in the same unit; the calendar time of t = 0, None where times are plain
        numbers, and their unit, empty where it is not known.
    """
    checks.refuse_durations("times", times)
    origin, unit = (None, "") if data is None else (data.origin, data.units.get("time", ""))
    if calendar_time.holds_dates(times):
        times, origin, unit = calendar_time.numbers_of("times", times)
    values = y.to_numpy(float) if hasattr(y, "to_numpy") else y  # a data frame

    def bind_in(origin: str | None, unit: str) -> BoundModel:
        keywords = dict(model_kwargs or {}) if data is None else model_keywords(data.inputs, model_kwargs)
        with calendar_time.in_messages(origin, unit):
            return _bound(numpyro_model, times, values, keywords)

    bound = bind_in(origin, unit)
    # The model names its unit only once it has been built, for which it takes times.
    model_unit = bound.site.example.ssm.model.units.get("time", "")
    old, new = (calendar_time.SECONDS.get(name) for name in (unit, model_unit))
    if origin is None or old is None or new is None or old == new:
        return bound, data, (origin, unit)
    times = np.asarray(times) * (old / new)
    data = None if data is None else at_origin(data, origin, model_unit)
    return bind_in(origin, model_unit), data, (origin, model_unit)


def _bound(numpyro_model: Callable, times: Any, y: Any, model_kwargs: dict[str, Any]) -> BoundModel:
    try:
        return bind(numpyro_model, times, y, **model_kwargs)
    except TypeError as error:
        if "'NoneType'" not in str(error) or "inputs" in model_kwargs or (
                "inputs" not in inspect.signature(numpyro_model).parameters):
            raise
        raise TypeError("the model has an argument `inputs`, and there are none. Name their columns, "
                        "lfm.read_table(frame, inputs=[...]), or give lfm.Data(..., inputs={...}).") from error


def _priors(bound: BoundModel) -> str:
    """Return name -> prior in words, as JSON."""
    trace = bound.trace()
    return json.dumps({name: prior(trace[name]["fn"]) for name in bound.sites})


def _assumptions(bound: BoundModel) -> str:
    """Return what the model says of observations, forces and initial state, with numbers typical of the prior."""
    return json.dumps(assumptions(bound.site.example.ssm.model))


def described_by(numpyro_model: Any) -> str | None:
    """Return the docstring of a model, under handlers and partial applications; None where there is none."""
    while (inner := getattr(numpyro_model, "fn", getattr(numpyro_model, "func", None))) is not None:
        numpyro_model = inner
    return inspect.getdoc(numpyro_model) if inspect.isroutine(numpyro_model) else None


def _call(model: str, data: str, asked: _Asked, model_kwargs: Mapping[str, Any] | None) -> str:
    """Return the call of `fit` as text, in which objects that text cannot hold are named where they were given."""
    arguments = {
        "sampler": asked.sampler, "chains": asked.chains, "warmup": asked.warmup, "samples": asked.samples,
        "thin": asked.thin, "seed": asked.seed, "trajectory_draws": asked.trajectory_draws,
        "chain_method": asked.method, "init": asked.init, "sampler_options": asked.options,
        "fixed": {name: np.asarray(value).tolist() for name, value in asked.fixed.items()},
    }  # fmt: skip
    given = [f"{label}={value!r}" if isinstance(value, (str, int, float, dict)) else f"{label}={label}"
             for label, value in arguments.items() if value is not None and value != {}]
    named = [f"{label}={label}" for label, value in (("at", asked.at), ("model_kwargs", model_kwargs))
             if value is not None]
    return f"lfm.fit({', '.join([model, data, *given, *named])})"


def versions() -> dict[str, str]:
    """Return the versions of what a result was made with."""
    return checkpoints.versions() | {"arviz": metadata.version("arviz")}
