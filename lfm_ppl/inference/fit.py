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
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import xarray as xr
from numpyro.infer import MCMC, NUTS, init_to_median

from lfm_ppl import checks
from lfm_ppl.analysis import arviz_data
from lfm_ppl.analysis.scalars import units_attribute
from lfm_ppl.filtering.breakdown import FilterWarning, breakdown
from lfm_ppl.filtering.filter import check_observations
from lfm_ppl.filtering.schedule import schedule
from lfm_ppl.inference.fixing import fix
from lfm_ppl.inference.map import map_estimate
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood, Panel
from lfm_ppl.inference.particle_marginal import ParticleMarginalRAM
from lfm_ppl.inference.posterior import LikelihoodSite, likelihood_site, scores, trajectories
from lfm_ppl.inference.ram import RAM
from lfm_ppl.inference.unconstrained import UnconstrainedModel

SAMPLERS = ("nuts", "ram", "pmmh", "map")

_FORWARD_MODE_LIMIT = 10
"""Most unconstrained parameters for which forward-mode gradients are the faster ones."""

_STEPS_A_DRAW = {"ram": 5, "pmmh": 1}
"""Steps for each parameter that make one draw: a random walk in d dimensions forgets in some multiple of d. A step of
particle-marginal RAM takes some hundred times as long as one of RAM, so that it makes fewer."""

_GRID = 200
"""Number of grid points of trajectories where no times are asked for."""

_EXTRA_FIELDS = {
    "nuts": {"diverging": "diverging", "accept_prob": "acceptance_rate", "num_steps": "n_steps", "energy": "energy",
             "adapt_state.step_size": "step_size", "potential_energy": "lp"},
    "ram": {"accept_prob": "acceptance_rate", "accepted": "accepted", "potential_energy": "lp"},
    "pmmh": {"accept_prob": "acceptance_rate", "accepted": "accepted", "potential_energy": "lp",
             "estimated": "estimated"},
}


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
        at: times of the trajectories; by default a grid over the data. Times after the last are forecasts.
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

    Returns:
        An ArviZ object (``InferenceData`` on ArviZ 0.23, ``xarray.DataTree`` on 1.x) with the groups

        - ``posterior``: parameters, with coordinates;
        - ``sample_stats``;
        - ``log_likelihood``: the Gaussian filter's leave-one-out conditionals log p(y_k | y_-k, theta), which make
          ``az.loo`` right for dependent data;
        - ``one_step_ahead``: log p(y_k | y_1:k-1, theta) and standardised residuals;
        - ``trajectories``: forces, states and noise-free outputs at ``at``, given the data; from the Gaussian smoother,
          and for "pmmh" from the particle smoother;
        - ``posterior_predictive``: replicated data along these trajectories. (``numpyro.infer.Predictive`` with the
          same draws simulates NEW forces instead.)
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
    for label, value in (("chains", chains), ("samples", samples)):
        checks.positive_integer(label, value)
    if warmup != 0:
        checks.positive_integer("warmup", warmup)
    if thin is not None:
        checks.positive_integer("thin", thin)
    if trajectory_draws != 0:
        checks.positive_integer("trajectory_draws", trajectory_draws)
    keywords = dict(model_kwargs or {})
    key = jax.random.key(seed)
    keys = jax.random.split(key, 5)
    site = likelihood_site(numpyro_model, (times, y), keywords, keys[0])
    y = _checked(site, y)
    _check_requested(site.example, times, at)
    outputs = site.example.ssm.model.output_names
    model = fix(numpyro_model, fixed, labels=outputs) if fixed else numpyro_model
    arguments = (times, y)
    space = UnconstrainedModel(model, arguments, keywords, keys[2])
    size = space.draw(keys[2], init_to_median).size
    if size == 0:
        raise ValueError("the model has no parameters to sample; use lfm.smooth for the forces of a known model.")
    particles = particle_steps = None
    if sampler == "map":
        with _start_explained(model, arguments, keywords, keys[2], space):
            draws, stats, remarks = _mode(model, arguments, keywords, keys[1], samples, seed, init, size)
        chains, warmup = 1, 0
    else:
        with _start_explained(model, arguments, keywords, keys[2], space):
            strategy = _strategy(init, model, arguments, keywords, seed)
            kernel, first = _kernel(sampler, model, arguments, keywords, strategy, sampler_options, keys[2], seed,
                                    chains, init is not None, space, size)
            thin = thin or _STEPS_A_DRAW.get(sampler, 0) * size or 1
            draws, stats = _sample(kernel, sampler, arguments, keywords, keys[1], chains, warmup, samples, thin,
                                   chain_method, progress, first)
        remarks = {"thin": thin}
        if isinstance(kernel, ParticleMarginalRAM) and kernel.tuned is not None:
            particles, particle_steps = kernel.settings, kernel.particle_steps
            remarks |= {"particles": kernel.tuned.particles, "log_likelihood_sd": kernel.tuned.sd,
                        "delayed": int(kernel.delayed)}
    flat = {label: value.reshape(-1, *value.shape[2:]) for label, value in draws.items()}
    latent = _latent(model, arguments, keywords, keys[0], flat)
    rated = _kept("scores of the observations", lambda: scores(
        model, arguments, keywords, latent, y, site), None)
    chosen, paths, grid = _kept("trajectories", lambda: _paths(
        model, arguments, keywords, latent, site, y, at, trajectory_draws, chains, samples, keys[3], particles,
        particle_steps),
        (None, None, None))
    groups = _groups(site, draws, stats, rated, paths, chosen, grid, times, y, truth, chains, samples)
    attrs = {
        "model": name or getattr(numpyro_model, "__name__", "model"), "rule": site.example.rule.name,
        "steps": site.example.steps, "max_step": site.example.max_step, "iterations": site.example.iterations,
        "tolerance": site.example.tolerance,
        "sampler": sampler, "seed": seed, "chains": chains, "warmup": warmup,
        "samples": samples, "fixed": json.dumps({k: np.asarray(v).tolist() for k, v in (fixed or {}).items()}),
        "wall_time_s": round(time.perf_counter() - started, 3), "versions": json.dumps(_versions()),
        "created_at": datetime.now(UTC).isoformat(timespec="seconds"), **remarks,
    }
    result = arviz_data.build(groups, {k: v for k, v in attrs.items() if v is not None})
    if sampler != "map":
        for message in arviz_data.convergence_warnings(result):
            warnings.warn(message, ConvergenceWarning, stacklevel=2)
    return result


@contextlib.contextmanager
def _start_explained(model: Callable, arguments: tuple, keywords: dict, key: jax.Array,
                     space: UnconstrainedModel) -> Iterator[None]:
    """Where no point to start from is found, say how the filter breaks down at the prior median."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        if "valid initial parameters" in str(error) or "finite density" in str(error):
            _kept("reason why there is nowhere to start", lambda: _explain_start(
                model, arguments, keywords, key, space), None)
        raise


def _explain_start(model: Callable, arguments: tuple, keywords: dict, key: jax.Array,
                   space: UnconstrainedModel) -> None:
    median = space.constrain(space.draw(key, init_to_median))
    distribution = likelihood_site(model, arguments, keywords, key, median).distribution
    y = jnp.asarray(arguments[1], float)
    several = isinstance(distribution, Panel)
    for index in range(distribution.batch_shape[0] if several else 1):
        one = distribution.series(index) if several else distribution
        said = breakdown(one.ssm, one.rule, one.plan, (y[index] if several else y).reshape(one.event_shape))
        if said is not None:
            series = f" of series {index}" if several else ""
            warnings.warn(f"at the prior median{series}, {said}", FilterWarning, stacklevel=6)
            return


def _kept(what: str, compute: Callable[[], Any], otherwise: Any) -> Any:
    """Compute something from the draws; a failure must not lose the draws, which took the time."""
    try:
        return compute()
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        warnings.warn(f"the {what} could not be computed and are left out of the result: {reason}", stacklevel=3)
        return otherwise


def _checked(site: LikelihoodSite, y: Any) -> jax.Array:
    if isinstance(site.distribution, Panel):
        return site.distribution.checked(y)
    return check_observations(y, *site.distribution.event_shape)


def _check_requested(example: MarginalLikelihood, times: Any, at: Any) -> None:
    """Raise before sampling what would stop the trajectories after it."""
    if at is None:
        return
    if np.ndim(times) != 1:
        raise ValueError("`at` needs one vector of times for all series; this panel has times of its own for each.")
    schedule(example.ssm, times, example.steps, example.max_step, at, tolerance=example.tolerance)


def _strategy(init: Any, model: Callable, arguments: tuple, keywords: dict, seed: int) -> Any:
    if init is None:
        return init_to_median(num_samples=15)
    if isinstance(init, str):
        checks.one_of("init", init, ("map", "median"))
        if init == "median":
            return init_to_median(num_samples=15)
        from numpyro.infer import init_to_value

        mode = map_estimate(model, *arguments, seed=seed, model_kwargs=keywords)
        return init_to_value(values=mode.parameters)
    if not callable(init):
        raise TypeError('init must be None, "map", "median" or a NumPyro strategy such as '
                        f"numpyro.infer.init_to_uniform, got {init!r}.")
    return init


def _kernel(sampler: str, model: Callable, arguments: tuple, keywords: dict, strategy: Any,
            options: Mapping[str, Any] | None, key: jax.Array, seed: int, chains: int,
            chosen_start: bool, space: UnconstrainedModel, size: int) -> tuple[Any, Any]:
    """Return the kernel and, for a random walk unless the user chose where to start, starting points."""
    options = dict(options or {})
    few = size <= _FORWARD_MODE_LIMIT
    if sampler == "nuts":
        options.setdefault("forward_mode_differentiation", few)
        options.setdefault("dense_mass", few)  # a full mass matrix is cheap to learn for a handful of parameters
        return NUTS(model, init_strategy=strategy, **options), None
    walk = RAM if sampler == "ram" else ParticleMarginalRAM
    if "initial_covariance" in options:
        return walk(model, init_strategy=strategy, **options), None
    # A random walk that starts with the shape of the posterior needs no gradient afterwards, but learning that shape
    # by rejection takes thousands of steps. The mode gives it; chains start at draws from its Laplace approximation.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mode = map_estimate(model, *arguments, seed=seed, model_kwargs=keywords, restarts=2,
                            hessian="finite-differences", forward_mode=few)
    if mode.unidentified or not np.all(np.isfinite(mode.covariance)):
        return walk(model, init_strategy=strategy, **options), None
    if sampler == "pmmh":
        # At the mode, because a chain's own start may be a poor place to judge the estimate by.
        options.setdefault("tune_at", space.unravel(jnp.asarray(mode.mode)))
    kernel = walk(model, init_strategy=strategy, initial_covariance=mode.covariance, **options)
    if chosen_start:
        return kernel, None
    root = np.linalg.cholesky(mode.covariance)
    points = mode.mode + np.asarray(jax.random.normal(key, (chains, size))) @ root.T
    possible = np.isfinite(np.asarray(jax.jit(jax.vmap(space.potential))(jnp.asarray(points))))
    points = jnp.asarray(np.where(possible[:, None], points, mode.mode))
    return kernel, jax.vmap(space.unravel)(points) if chains > 1 else space.unravel(points[0])


def _sample(kernel: Any, sampler: str, arguments: tuple, keywords: dict, key: jax.Array, chains: int, warmup: int,
            samples: int, thin: int, chain_method: str | None, progress: bool, first: Any) -> tuple[dict, dict]:
    if chain_method is None:
        chain_method = "parallel" if jax.local_device_count() >= chains else "sequential"
    checks.one_of("chain_method", chain_method, ("parallel", "vectorized", "sequential"))
    mcmc = MCMC(kernel, num_warmup=warmup * thin, num_samples=samples * thin, thinning=thin, num_chains=chains,
                chain_method=chain_method, progress_bar=progress)
    mcmc.run(key, *arguments, extra_fields=tuple(_EXTRA_FIELDS[sampler]), init_params=first, **keywords)
    extra = mcmc.get_extra_fields(group_by_chain=True)
    stats = {new: np.asarray(extra[old]) for old, new in _EXTRA_FIELDS[sampler].items()}
    stats["lp"] = -stats["lp"]
    if "n_steps" in stats:
        stats["tree_depth"] = np.ceil(np.log2(stats["n_steps"] + 1)).astype(int)
    draws = {label: np.asarray(value) for label, value in mcmc.get_samples(group_by_chain=True).items()}
    return draws, stats


def _mode(model: Callable, arguments: tuple, keywords: dict, key: jax.Array, samples: int, seed: int,
          init: Any, size: int) -> tuple[dict, dict, dict]:
    if isinstance(init, str):
        checks.one_of("init", init, ("map", "median"))
        init = None
    # Second derivatives take longer to compile than everything else here takes to run.
    mode = map_estimate(model, *arguments, seed=seed, model_kwargs=keywords, init=init, hessian="finite-differences",
                        forward_mode=size <= _FORWARD_MODE_LIMIT)
    draws = {label: np.asarray(value)[None] for label, value in mode.sample(key, samples).items()}
    remarks = {"map_converged": int(mode.converged), "map_message": mode.message,
               "map_log_density": float(mode.log_density), "log_evidence": float(mode.log_evidence)}
    return draws, {}, remarks


def _latent(model: Callable, arguments: tuple, keywords: dict, key: jax.Array, flat: dict) -> dict:
    """The draws without deterministic sites, which the model computes itself."""
    from numpyro import handlers

    trace = handlers.trace(handlers.seed(model, key)).get_trace(*arguments, **keywords)
    return {label: value for label, value in flat.items() if trace.get(label, {}).get("type") == "sample"}


def _paths(model: Callable, arguments: tuple, keywords: dict, latent: dict, site: LikelihoodSite, y: Any, at: Any,
           count: int, chains: int, samples: int, key: jax.Array,
           particles: Any, particle_steps: int | None) -> tuple[np.ndarray, dict | None, np.ndarray | None]:
    """Draw trajectories for draws that are spread evenly over each chain."""
    per_chain = min(samples, -(-count // chains))
    if per_chain == 0:
        return np.array([], int), None, None
    chosen = np.unique(np.linspace(0, samples - 1, per_chain).round().astype(int))
    rows = (np.arange(chains)[:, None] * samples + chosen).ravel()
    times = np.asarray(arguments[0], float)
    grid = None
    if times.ndim == 1:
        origin = float(site.example.plan.initial_time)
        grid = (np.union1d(np.linspace(min(origin, times[0]), times[-1], _GRID), times) if at is None
                else np.atleast_1d(np.asarray(at, float)))
    subset = {label: value[rows] for label, value in latent.items()}
    paths = trajectories(model, arguments, keywords, subset, y, grid, key, site, particles, particle_steps)
    return chosen, {k: v.reshape(chains, len(chosen), *v.shape[1:]) for k, v in paths.items()}, grid


def _groups(site: LikelihoodSite, draws: dict, stats: dict, rated: dict | None, paths: dict | None, chosen: Any,
            grid: np.ndarray | None, times: Any, y: Any, truth: Mapping[str, Any] | None, chains: int,
            samples: int) -> dict[str, xr.Dataset]:
    model = site.example.ssm.model
    units = model.units
    panel = ("series",) if isinstance(site.distribution, Panel) else ()
    times = np.asarray(times, float)
    per_series = times.ndim == 2
    along = ("series", "time") if panel else ("time",)
    coords: dict[str, Any] = {"chain": np.arange(chains), "draw": np.arange(samples)}
    clock: dict[str, Any] = {} if per_series else {"time": ("time", times, units_attribute(["time"], units))}
    named = {"output": list(model.output_names), "state": list(model.state_names), "force": list(model.force_names)}

    def variable(dims: Sequence[str], values: Any, names: Sequence[str] = ()) -> tuple:
        return tuple(dims), np.asarray(values), units_attribute(names, units)

    # A time at which nothing was observed has no predictive density to compare.
    seen = np.flatnonzero(np.isfinite(np.asarray(y)).any(axis=-1).reshape(-1, np.shape(y)[-2]).any(axis=0))
    sample = ("chain", "draw", *along)
    observed_coords = {**clock, "output": named["output"]}
    groups = {
        "posterior": _posterior(draws, coords, named["output"]),
        "sample_stats": xr.Dataset({k: (("chain", "draw"), v) for k, v in stats.items()}, coords),
        "observed_data": xr.Dataset({site.name: variable((*along, "output"), y, named["output"])}, observed_coords),
    }
    if per_series:
        groups["observed_data"] = groups["observed_data"].assign(times=(along, times))
    if rated is not None:
        split = {label: value.reshape(chains, samples, *value.shape[1:]) for label, value in rated.items()}
        left_out = xr.Dataset({site.name: variable(sample, split["leave_one_out"])}, {**coords, **clock})
        groups["log_likelihood"] = left_out.isel(time=seen)
        groups["one_step_ahead"] = xr.Dataset(
            {"log_density": variable(sample, split["one_step_ahead"]),
             "residual": variable((*sample, "output"), split["residual"])}, {**coords, **observed_coords})
    if paths is not None:
        thinned = {"chain": np.arange(chains), "draw": chosen}
        groups["posterior_predictive"] = xr.Dataset(
            {site.name: variable((*sample, "output"), paths["y"], named["output"])}, {**thinned, **observed_coords})
        place = ("chain", "draw", *panel, "at")
        at = {} if grid is None else {"at": ("at", grid, units_attribute(["time"], units))}
        groups["trajectories"] = xr.Dataset(
            {f"{kind}s": variable((*place, kind), paths[kind], named[kind]) for kind in named if paths[kind].shape[-1]},
            {**thinned, **at, **{kind: named[kind] for kind in named if named[kind]}})
    if truth:
        groups["truth"] = _truth(truth, named, units, draws)
    return groups


def _posterior(draws: dict, coords: dict, outputs: list[str]) -> xr.Dataset:
    variables: dict[str, Any] = {}
    extra: dict[str, Any] = {}
    for label, value in draws.items():
        dims = []
        for axis, size in enumerate(value.shape[2:]):
            if size == len(outputs) and axis == 0 and value.ndim == 3 and size > 1:
                dims.append("output")
                extra["output"] = outputs
            else:
                dims.append(f"{label}_dim_{axis}")
                extra[dims[-1]] = np.arange(size)
        variables[label] = (("chain", "draw", *dims), value)
    return xr.Dataset(variables, {**coords, **extra})


def _truth(truth: Mapping[str, Any], named: dict, units: Mapping[str, str], draws: dict) -> xr.Dataset:
    variables: dict[str, Any] = {}
    coords: dict[str, Any] = {}
    if truth.get("times") is not None:
        coords["at_truth"] = ("at_truth", np.asarray(truth["times"], float), units_attribute(["time"], units))
    forces = truth.get("forces") or {}
    known = [label for label in named["force"] if label in forces]
    if known:
        coords["force"] = known
        variables["forces"] = (("at_truth", "force"), np.stack([np.asarray(forces[n]) for n in known], axis=1),
                              units_attribute(known, units))
    if truth.get("state") is not None and np.ndim(truth["state"]) == 2:
        coords["state"] = named["state"]
        variables["states"] = (("at_truth", "state"), np.asarray(truth["state"]),
                               units_attribute(named["state"], units))
    for label, value in (truth.get("parameters") or {}).items():
        value = np.asarray(value, float)
        dims = ["output"] if value.shape == (len(named["output"]),) and value.size > 1 else \
            [f"{label}_dim_{axis}" for axis in range(value.ndim)]
        if dims == ["output"]:
            coords["output"] = named["output"]
        if label in draws:
            variables[label] = (tuple(dims), value)
    return xr.Dataset(variables, coords)


def _versions() -> dict[str, str]:
    names = ("lfm_ppl", "jax", "jaxlib", "numpyro", "arviz", "numpy", "equinox")
    found = {"python": sys.version.split()[0]}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
