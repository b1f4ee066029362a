"""The draws of a plain NumPyro run as a result of `lfm_ppl.fit`.

1. Bind the model to its data, and take draws and statistics from the MCMC object or a dictionary.
2. Compute missing deterministic sites, scores and trajectories.
3. Lay out the ArviZ groups as `lfm_ppl.fit` does.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.inference.bind import bind
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.trajectories import scores
from lfm_ppl.results import arviz_data
from lfm_ppl.results.labels import Labels
from lfm_ppl.results.layout import TrajectoryDraws
from lfm_ppl.results.true_values import checked_truth
from lfm_ppl.utils import checks
from lfm_ppl.utils.random_keys import split_by_name
from lfm_ppl.utils.types import Result
from lfm_ppl.workflows.data_binding import check_requested_times, coords_of_site, of_site
from lfm_ppl.workflows.fit_options import keys_of, likelihood_settings, model_docstring, versions
from lfm_ppl.workflows.fit_results import (
    ConvergenceWarning,
    PostProcessing,
    SiteProblem,
    best_effort,
    draw_paths,
    lay_out_sites,
    note_warnings,
)

_STATISTICS = {"diverging": "diverging", "accept_prob": "acceptance_rate", "num_steps": "n_steps", "energy": "energy",
               "adapt_state.step_size": "step_size", "potential_energy": "lp"}
"""Field of a kernel's state -> its name in ArviZ."""


def to_arviz(mcmc: Any, numpyro_model: Callable, times: ArrayLike, y: ArrayLike, *, at: ArrayLike | None = None,
             trajectory_draws: int = 400, seed: int = 0, model_kwargs: Mapping[str, Any] | None = None,
             dims: Mapping[str, Sequence[str]] | None = None, coords: Mapping[str, Sequence[Any]] | None = None,
             truth: Mapping[str, ArrayLike] | None = None, name: str | None = None) -> Result:
    """Turn the draws of a plain NumPyro run into a result, with everything that `lfm_ppl.fit` stores.

    ArviZ's own converter sees a likelihood with a single observation, the whole sequence, so that ``az.loo`` of it says
    nothing. Here each row of the data has its leave-one-out conditional log p(y_k | y_-k, theta), and forces, states
    and replicated data are drawn along the smoothed trajectories.

    Args:
        mcmc: a ``numpyro.infer.MCMC`` that has run, with any kernel; or site name -> draws (chains, draws, ...).
        numpyro_model: its model, ``model(times, y=None, **model_kwargs)``; with the handlers that it was run with, such
            as `lfm_ppl.fix`.
        times: (T,), as it was run with; of several likelihood sites a dict by name of the site.
        y: (T, D), as it was run with, or a dict.
        at: times of the trajectories and of new observations, as in `lfm_ppl.fit`.
        trajectory_draws: number of draws for which trajectories are drawn; 0: none.
        seed: of the trajectories.
        model_kwargs: keyword arguments of the model.
        dims: parameter -> names of its dimensions, as in `lfm_ppl.fit`.
        coords: dimension -> labels, as in `lfm_ppl.fit`.
        truth: of simulated data.
        name: of the model, for the record.

    Returns:
        An ArviZ object with the groups of `lfm_ppl.fit`; `lfm_ppl.save`, `lfm_ppl.forecast`, `lfm_ppl.check_accuracy`
        and the figures take it.

    Raises:
        TypeError: ``mcmc`` is neither.
        ValueError: it has not run, or its draws do not belong to the model's parameters.

    Warns:
        ConvergenceWarning: as `lfm_ppl.fit`.

    Example:
        >>> import jax, jax.numpy as jnp, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        ...     lfmodel = lfm.LatentForceModel(
        ...         lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(lfmodel, times), obs=y)
        >>> times, y = jnp.arange(5.0), jnp.sin(jnp.arange(5.0))[:, None]
        >>> kernel = numpyro.infer.NUTS(model)
        >>> mcmc = numpyro.infer.MCMC(kernel, num_warmup=50, num_samples=50, num_chains=2, chain_method="vectorized",
        ...                           progress_bar=False)
        >>> mcmc.run(jax.random.key(0), times, y)
        >>> import warnings
        >>> with warnings.catch_warnings():  # so few draws have not converged
        ...     warnings.simplefilter("ignore")
        ...     result = lfm.to_arviz(mcmc, model, times, y)
        >>> result["log_likelihood"]["y"].dims, result["log_likelihood"]["y"].shape
        (('chain', 'draw', 'observation'), (2, 50, 5))
    """
    if trajectory_draws != 0:
        checks.positive_integer("trajectory_draws", trajectory_draws)
    draws, stats = _collected(mcmc)
    values = np.asarray(y.to_numpy(), float) if hasattr(y, "to_numpy") else y  # a data frame
    bound = bind(numpyro_model, times, values, model_kwargs=model_kwargs)
    draws = _checked(bound, draws)
    chains, samples = next(iter(draws.values())).shape[:2]
    flat = {site: draws[site].reshape(-1, *draws[site].shape[2:]) for site in bound.sites}
    sites, processed = {}, PostProcessing()
    keys = keys_of(seed)
    score_keys, path_keys = (split_by_name(keys[name], bound.site_models) for name in ("scores", "trajectories"))
    for site, model in bound.site_models.items():
        names = list(bound.site_models) if bound.is_by_site else []
        site_at, site_truth = of_site("at", at, site, names), of_site("truth", truth, site, names)
        check_requested_times(model, site_at)
        labels = Labels.of(model, dims, coords_of_site(coords, site, names), None if names else y)
        sites[site] = SiteProblem(model, labels, site_at, truth=checked_truth(model, site_truth, labels),
                                  description=likelihood_settings(model.site.example))
        processed.scores[site] = best_effort("scores of the observations", partial(
            scores, score_keys[site], model, flat), None)
        processed.trajectories[site] = best_effort("trajectories", partial(
            draw_paths, path_keys[site], model, draws, site_at, trajectory_draws), TrajectoryDraws())
    groups, site_attributes = lay_out_sites(bound, sites, draws, stats, processed)
    kernel = getattr(mcmc, "sampler", None)
    attrs = {
        "model": name or getattr(numpyro_model, "__name__", "model"), "description": model_docstring(numpyro_model),
        **({} if bound.is_by_site else likelihood_settings(bound.site.example)), "likelihood": None, **site_attributes,
        "sampler": "draws" if kernel is None else type(kernel).__name__.lower(),
        "chains": chains, "samples": samples, "fixed": "{}", "versions": json.dumps(versions()),
        "created_at": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    if kernel is not None:
        attrs |= {"warmup": int(mcmc.num_warmup), "thin": int(mcmc.thinning)}
    result = arviz_data.build(groups, {label: value for label, value in attrs.items() if value is not None})
    for message in note_warnings(result):
        checks.warn(message, ConvergenceWarning)
    return result


def _collected(mcmc: Any) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return site -> draws (C, N, ...) and statistic -> (C, N)."""
    if isinstance(mcmc, Mapping):
        return {str(name): np.asarray(value) for name, value in mcmc.items()}, {}
    if not (hasattr(mcmc, "get_samples") and hasattr(mcmc, "get_extra_fields")):
        raise TypeError("mcmc must be a numpyro.infer.MCMC that has run, or a dict of draws (chains, draws, ...), got "
                        f"{type(mcmc).__name__}.")
    try:
        samples = mcmc.get_samples(group_by_chain=True)
        fields = mcmc.get_extra_fields(group_by_chain=True)
    except (AssertionError, AttributeError, TypeError, KeyError):  # what an MCMC raises that was never run
        samples = None
    if not samples:
        raise ValueError("this MCMC has no draws; call mcmc.run(key, times, y) first.")
    draws = {name: np.asarray(value) for name, value in samples.items()}
    shape = next(iter(draws.values())).shape[:2]
    stats = {_STATISTICS.get(name, name.replace(".", "_")): np.asarray(value) for name, value in fields.items()
             if np.shape(value) == shape}
    if "lp" in stats:
        stats["lp"] = -stats["lp"]
    return draws, stats


def _checked(bound: BoundModel, draws: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the draws of the model's sites, those that it computes included; what is missing of these is computed.

    Raises:
        ValueError: a parameter has no draws, or draws of another shape.
    """
    shapes = {name: np.shape(value) for name, value in bound.constrain(np.zeros(bound.size)).items()}
    lead = {value.shape[:2] for value in draws.values()}
    if len(lead) != 1 or any(len(shape) != 2 for shape in lead):
        raise ValueError("every parameter needs as many draws, (chains, draws, ...), as the others; got "
                         f"{', '.join(f'{name} {value.shape}' for name, value in draws.items()) or 'none'}.")
    for name in bound.sites:
        if name not in draws:
            raise ValueError(f"the model samples {name!r}, of which there are no draws (there are: "
                             f"{', '.join(draws)}); give the model that was run, with its handlers.")
        if draws[name].shape[2:] != shapes[name]:
            raise ValueError(f"{name!r} has shape {shapes[name]} in the model, and draws of shape "
                             f"{draws[name].shape[2:]}; give the model that was run, with its arguments.")
    site_values = {name: draws[name] for name in shapes if name in draws}
    if len(site_values) < len(shapes):
        points = {name: draws[name].reshape(-1, *draws[name].shape[2:]) for name in bound.sites}
        (count,) = lead
        z = jax.vmap(bound.unconstrain)(points)
        computed = bound.constrain_draws(np.asarray(z).reshape(*count, -1))
        site_values = {name: site_values.get(name, computed[name]) for name in shapes}
    return site_values
