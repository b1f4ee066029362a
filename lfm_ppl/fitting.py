"""From a NumPyro model and data to a posterior: one call."""

from __future__ import annotations

import contextlib
import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from typing import Any

import jax
import numpy as np
from numpyro.infer import init_to_median, init_to_value

from lfm_ppl import checks
from lfm_ppl.filtering.breakdown import FilterWarning, breakdown
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.inference import sampling
from lfm_ppl.inference.bound_model import BoundModel, bind
from lfm_ppl.inference.kernels.options import check_options
from lfm_ppl.inference.kernels.particle_marginal import ParticleMarginalRAM
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.map import MAPResult, mode_of
from lfm_ppl.inference.marginal_likelihood import Panel
from lfm_ppl.inference.posterior import scores, trajectories
from lfm_ppl.inference.sampling import Transition
from lfm_ppl.results import arviz_data
from lfm_ppl.results.layout import Labels, lay_out

SAMPLERS = ("nuts", "ram", "pmmh", "map")

_STEPS_A_DRAW = {"ram": 5, "pmmh": 1}
"""Steps for each parameter that make one draw: a random walk in d dimensions forgets in some multiple of d. A step of
particle-marginal RAM takes some hundred times as long as one of RAM, so that it makes fewer."""

_GRID = 200
"""Number of grid points of trajectories where no times are asked for."""

class ConvergenceWarning(UserWarning):
    """A diagnostic says that the draws do not represent the posterior yet."""


def fit(
    numpyro_model: Callable,
    times: Any,
    y: Any,
    *,
    sampler: str = "nuts",
    chains: int = 4,
    warmup: int = 1000,
    samples: int = 1000,
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
    dims: Mapping[str, Sequence[str]] | None = None,
    coords: Mapping[str, Sequence[Any]] | None = None,
) -> Any:
    """Fit a latent force model: sample its parameters, then its forces given them.

    Args:
        numpyro_model: ``model(times, y=None, **model_kwargs)`` with one site
            ``numpyro.sample(name, lfm.MarginalLikelihood(...), obs=y)``, or a `lfm.panel` in a plate.
        times: (T,), non-decreasing.
        y: (T, D), NaN where missing; (B, T, D) for a panel.
        sampler: "nuts", "ram" (robust adaptive Metropolis), "pmmh" (particle-marginal RAM: a particle filter estimates
            the likelihood, and the posterior is exact up to its integration steps), or "map" (posterior mode; the draws
            come from its Laplace approximation).
        chains: number of chains.
        warmup: number of warm-up steps in each.
        samples: number of draws in each; for "map", in all.
        thin: steps of the chain that make one draw, in the warm-up too. By default 1 for NUTS, 5 for each parameter
            for RAM, whose steps are cheap and short, and 1 for each parameter for particle-marginal RAM.
        seed: of everything random.
        at: times of the trajectories, and of new observations; by default a grid over the data. Times after the last
            observation are forecasts, see `forecast`.
        trajectory_draws: number of posterior draws, spread over the chains, for which trajectories are drawn; 0: none.
        model_kwargs: keyword arguments of the model.
        fixed: parameters that are not learnt: name -> value, ``{"decay": 0.8}`` or ``{"decay[CDKN1A]": 0.8}``.
        init: starting points: "map" for the posterior mode, "median" for the prior median, or a NumPyro strategy; by
            default the prior median for NUTS, and draws from the Laplace approximation at the mode for the others.
        sampler_options: further arguments of NUTS, `RAM` or `ParticleMarginalRAM`, for example
            ``{"target_accept_prob": 0.95}`` or ``{"particles": 500, "delayed": True}``.
        chain_method: "parallel", "vectorized" or "sequential"; by default parallel where there are as many devices as
            chains (``numpyro.set_host_device_count(chains)`` before JAX starts), sequential otherwise.
        progress: show a progress bar.
        truth: of simulated data (``lfm.Data.truth``), stored beside the results for plots.
        name: of the model, for the record.
        dims: parameter -> names of its dimensions, ``{"decay": ["gene"]}``. By default the plates that it stands in,
            ``event_dims`` of NumPyro's ``infer``, "output" for a vector with an entry for each output.
        coords: dimension -> labels, ``{"gene": ["CDKN1A", "SESN1"]}``; of "output", the names of the columns of y, and
            of "series", those of a panel, too. By default columns of a data frame keep their names.

    Returns:
        An ArviZ object (``InferenceData`` on ArviZ 0.23, ``xarray.DataTree`` on 1.x) with the groups

        - ``posterior``: parameters, with coordinates; what ``numpyro.deterministic`` computes of them has the attribute
          ``derived``;
        - ``sample_stats``;
        - ``log_likelihood``: the Gaussian filter's leave-one-out conditionals log p(y_k | y_-k, theta), which make
          ``az.loo`` right for dependent data;
        - ``one_step_ahead``: log p(y_k | y_1:k-1, theta) and standardised residuals;
        - ``trajectories``: forces, states and noise-free outputs at ``at``, given the data; from the Gaussian smoother,
          and for "pmmh" from the particle smoother;
        - ``posterior_predictive``: replicated data along these trajectories. (``numpyro.infer.Predictive`` with the
          same draws simulates NEW forces instead.)
        - ``predictions``: with ``at``, new observations at these times, with their noise; see `forecast`;
        - ``observed_data``, and ``truth`` where known.

    Raises:
        ValueError, TypeError: unknown sampler, wrong shapes, parameters to fix that do not exist, and so on.

    Warns:
        ConvergenceWarning: R-hat above 1.01, fewer than 100 effective draws a chain, divergences; each with a remedy.
        FilterWarning: no point to start from was found (which is an error): where the filter breaks down at the prior
            median, and how.

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
    checks.one_of("sampler", sampler, SAMPLERS)
    check_options(sampler, sampler_options)
    for label, value in (("chains", chains), ("samples", samples)):
        checks.positive_integer(label, value)
    if warmup != 0:
        checks.positive_integer("warmup", warmup)
    if thin is not None:
        checks.positive_integer("thin", thin)
    if trajectory_draws != 0:
        checks.positive_integer("trajectory_draws", trajectory_draws)
    keys = jax.random.split(jax.random.key(seed), 5)
    values = y.to_numpy(float) if hasattr(y, "to_numpy") else y  # a data frame
    bound = bind(numpyro_model, times, values, **dict(model_kwargs or {}))
    check_requested(bound, at)
    labels = Labels.of(bound, dims, coords, y)
    bound = bound.fix(fixed)
    remarks: dict[str, Any]
    if sampler == "map":
        with _start_explained(bound):
            draws, stats, remarks = _mode(bound, keys[1], samples, seed, init)
        chains, warmup = 1, 0
    else:
        with _start_explained(bound):
            thin = thin or _STEPS_A_DRAW.get(sampler, 0) * bound.size or 1
            transition, starts, remarks = _transition(sampler, bound, sampler_options, init, keys[2], seed, chains,
                                                      warmup * thin)
            collected = sampling.sample(keys[1], bound, transition, starts, warmup=warmup * thin, samples=samples,
                                        thin=thin, chain_method=chain_method, progress=progress)
        draws, stats = bound.constrain_draws(collected.z), _statistics(collected.statistics)
        remarks["thin"] = thin
    flat = {site: draws[site].reshape(-1, *draws[site].shape[2:]) for site in bound.sites}
    rated = kept("scores of the observations", lambda: scores(bound, flat), None)
    particles = {name: remarks.pop(name, None) for name in ("particle_settings", "particle_steps")}
    chosen, paths, grid = kept(
        "trajectories", lambda: draw_paths(keys[3], bound, flat, at, trajectory_draws, chains, samples, **particles),
        (None, None, None))
    groups = lay_out(bound, draws, stats, rated, paths, chosen, grid, truth, labels)
    example = bound.site.example
    attrs = {
        "model": name or getattr(numpyro_model, "__name__", "model"), "rule": example.rule.name,
        "steps": example.steps, "max_step": example.max_step, "iterations": example.iterations,
        "tolerance": example.tolerance,
        "sampler": sampler, "seed": seed, "chains": chains, "warmup": warmup,
        "samples": samples, "fixed": json.dumps({k: np.asarray(v).tolist() for k, v in (fixed or {}).items()}),
        "wall_time_s": round(time.perf_counter() - started, 3), "versions": json.dumps(versions()),
        "created_at": datetime.now(UTC).isoformat(timespec="seconds"), **remarks,
    }
    result = arviz_data.build(groups, {k: v for k, v in attrs.items() if v is not None})
    warn_of_convergence(result)
    return result


def warn_of_convergence(result: Any) -> None:
    """Store in a result what is wrong with its draws, in its attribute ``warnings``, and warn of it."""
    found = arviz_data.convergence_warnings(result)
    result.attrs["warnings"] = json.dumps(found)
    for message in found:
        checks.warn(message, ConvergenceWarning)


@contextlib.contextmanager
def _start_explained(bound: BoundModel) -> Iterator[None]:
    """Where no point to start from is found, say how the filter breaks down at the prior median."""
    try:
        yield
    except ValueError as error:
        if "finite density" in str(error):
            kept("reason why there is nowhere to start", lambda: _explain_start(bound), None)
        raise


def _explain_start(bound: BoundModel) -> None:
    distribution = bound.likelihood(bound.draw(jax.random.key(0), init_to_median))
    several = isinstance(distribution, Panel)
    for index in range(distribution.batch_shape[0] if several else 1):
        one = distribution.series(index) if several else distribution
        said = breakdown(one.ssm, one.rule, one.time_grid,
                         (bound.y[index] if several else bound.y).reshape(one.event_shape))
        if said is not None:
            series = f" of series {index}" if several else ""
            warnings.warn(f"at the prior median{series}, {said}", FilterWarning, stacklevel=6)
            return


def kept(what: str, compute: Callable[[], Any], otherwise: Any) -> Any:
    """Compute something from the draws; a failure must not lose the draws, which took the time."""
    try:
        return compute()
    except Exception as error:
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


def _strategy(init: Any, bound: BoundModel, seed: int) -> Any:
    if init is None:
        return init_to_median(num_samples=15)
    if isinstance(init, str):
        checks.one_of("init", init, ("map", "median"))
        if init == "median":
            return init_to_median(num_samples=15)
        return init_to_value(values=mode_of(bound, seed=seed).parameters)
    if not callable(init):
        raise TypeError('init must be None, "map", "median" or a NumPyro strategy such as '
                        f"numpyro.infer.init_to_uniform, got {init!r}.")
    return init


def _transition(sampler: str, bound: BoundModel, options: Mapping[str, Any] | None, init: Any, key: jax.Array,
                seed: int, chains: int, warmup: int) -> tuple[Transition, np.ndarray, dict[str, Any]]:
    """Return how the chains move, where each of them starts (C, d), and what to remember of it."""
    options = dict(options or {})
    strategy = _strategy(init, bound, seed)
    if sampler == "nuts":
        transition = sampling.nuts(bound, warmup, options)
        return transition, _starts(key, bound, strategy, chains, transition.evaluate), {}
    walk = RAM if sampler == "ram" else ParticleMarginalRAM
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
    kernel = walk(bound.model, **options)
    starts = (_starts(key, bound, strategy, chains, bound.log_density) if mode is None or init is not None
              else _about(key, bound, mode, chains))
    if not isinstance(kernel, ParticleMarginalRAM):
        return sampling.random_walk(bound, kernel, warmup), starts, {}
    kernel.prepare(bound, starts[0])
    assert kernel.tuned is not None
    remarks = {"particles": kernel.tuned.particles, "log_likelihood_sd": kernel.tuned.sd,
               "delayed": int(kernel.delayed), "particle_settings": kernel.settings,
               "particle_steps": kernel.particle_steps}
    return sampling.particle_marginal(bound, kernel, warmup), starts, remarks


def _starts(key: jax.Array, bound: BoundModel, strategy: Any, chains: int, evaluate: Any) -> np.ndarray:
    """Return a point (C, d) for each chain, by a NumPyro strategy, where what ``evaluate`` gives is finite."""
    return np.stack([bound.start(each, strategy, evaluate=evaluate) for each in jax.random.split(key, chains)])


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


def _mode(bound: BoundModel, key: jax.Array, samples: int, seed: int, init: Any) -> tuple[dict, dict, dict]:
    if isinstance(init, str):
        checks.one_of("init", init, ("map", "median"))
        init = None
    # Second derivatives take longer to compile than everything else here takes to run.
    mode = mode_of(bound, seed=seed, init=init)
    draws = {label: np.asarray(value)[None] for label, value in mode.sample(key, samples).items()}
    remarks = {"map_converged": int(mode.converged), "map_message": mode.message,
               "map_log_density": float(mode.log_density), "log_evidence": float(mode.log_evidence)}
    return draws, {}, remarks


def draw_paths(key: jax.Array, bound: BoundModel, draws: dict, at: Any, count: int, chains: int, samples: int,
           particle_settings: Any, particle_steps: int | None) -> tuple[np.ndarray, dict | None, np.ndarray | None]:
    """Draw trajectories for draws that are spread evenly over each chain."""
    per_chain = min(samples, -(-count // chains))
    if per_chain == 0:
        return np.array([], int), None, None
    chosen = np.unique(np.linspace(0, samples - 1, per_chain).round().astype(int))
    rows = (np.arange(chains)[:, None] * samples + chosen).ravel()
    times = bound.times
    grid = None
    if times.ndim == 1:
        origin = float(bound.site.example.time_grid.initial_time)
        grid = (np.union1d(np.linspace(min(origin, times[0]), times[-1], _GRID), times) if at is None
                else np.atleast_1d(np.asarray(at, float)))
    subset = {site: value[rows] for site, value in draws.items()}
    paths = trajectories(key, bound, subset, grid, particle_settings, particle_steps)
    if at is None:
        paths.pop("prediction", None)  # stored where they were asked for
    return chosen, {k: v.reshape(chains, len(chosen), *v.shape[1:]) for k, v in paths.items()}, grid


def versions() -> dict[str, str]:
    """Return the versions of what a result was made with."""
    names = ("lfm_ppl", "jax", "jaxlib", "numpyro", "arviz", "numpy", "equinox")
    found = {"python": sys.version.split()[0]}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
