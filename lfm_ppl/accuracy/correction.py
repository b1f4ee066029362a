"""The corrected posterior as a result of its own: draws resampled by their importance weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any

import jax
import numpy as np
import xarray as xr

from lfm_ppl.accuracy import importance_weights
from lfm_ppl.accuracy.report import AccuracyReport
from lfm_ppl.inference.trajectories import evenly_spaced, trajectories
from lfm_ppl.results import arviz_data, rebuilding
from lfm_ppl.results.layout import with_summaries
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.series import TIMES, times_of
from lfm_ppl.utils import checks

_KEPT = ("data", "observed_data", "truth")
_OF_DRAWS = ("posterior", "log_likelihood", "log_prior", "posterior_predictive")
"""Groups that depend on the draws alone, and are picked with them."""

_KINDS = {"states": "state", "forces": "force", "outputs": "output"}


def correct_posterior(result: Any, numpyro_model: Callable, times: Any = None, y: Any = None, *,
                      model_kwargs: Mapping[str, Any] | None = None, trajectory_draws: int = 400,
                      seed: int = 0) -> Any:
    """Return the corrected posterior: equally weighted draws, resampled by the weights of the accuracy report.

    Draws that the weights favour appear more than once, so that diagnostics of chains say nothing here; the report
    gives the effective number of draws. Trajectories are drawn again by the Gaussian smoother at the corrected
    parameters; log likelihood and replicated data belong to the draws.

    Args:
        result: of `lfm_ppl.fit`, with the report that `check_accuracy` stored; check at many draws (1,000) first.
        numpyro_model: the model that was fitted.
        times: as in the fit; by default what the result holds.
        y: as in the fit; by default what the result holds.
        model_kwargs: keyword arguments of the model, as in the fit.
        trajectory_draws: number of draws for which trajectories are drawn, where the result has some; 0: none.
        seed: of the resampling and the trajectories.

    Returns:
        An ArviZ object with the groups posterior, data, observed_data, log_likelihood, log_prior, posterior_predictive,
        truth and trajectories, where the result has them, and its attributes.

    Raises:
        ValueError: there is no report, or its weights cannot be relied on.
    """
    if trajectory_draws != 0:
        checks.positive_integer("trajectory_draws", trajectory_draws)
    view = ResultView.of(result)
    view.refuse_several_sites()
    report = AccuracyReport.of(view)
    if not report.reliable:
        raise ValueError(f"the importance weights cannot be relied on: Pareto k = {report.k:.2f}, not below "
                         f"{report.threshold:.2f}. Check at more draws, or sample the exact posterior with "
                         'lfm.fit(..., sampler="pmmh").')
    posterior = view.posterior.transpose("chain", "draw", ...)
    chains, size = report.log_weight.shape
    draw_index = np.searchsorted(posterior["draw"].values, report.dataset["draw"].values)
    of_all = (np.arange(chains)[:, None] * posterior.sizes["draw"] + draw_index).ravel()
    picked = of_all[importance_weights.resample(report.log_weight, chains * size, seed)].reshape(chains, size)
    groups = {name: _select_draws(view.groups[name], picked) for name in _OF_DRAWS if name in view.groups}
    groups |= {name: view.groups[name] for name in _KEPT if name in view.groups}
    if trajectory_draws and "trajectories" in view.groups:
        groups["trajectories"] = _draw_trajectories(view, numpyro_model, times, y, model_kwargs, picked,
                                                    trajectory_draws, seed)
    attrs = {"sampler": f"{view.attrs.get('sampler', 'unknown')} + importance resampling", "chains": chains,
             "samples": size, "reference": report.reference, "pareto_k": report.k, "effective_draws": report.ess,
             "warnings": "[]", "created_at": datetime.now(UTC).isoformat(timespec="seconds")}
    return arviz_data.build(groups, {**view.attrs, **attrs})


def _select_draws(dataset: xr.Dataset, picked: np.ndarray) -> xr.Dataset:
    """Return the draws ``picked`` (C, S), indices into all chains joined, as chains."""
    chain, draw = (xr.DataArray(index, dims=("chain", "draw")) for index in np.divmod(picked, dataset.sizes["draw"]))
    selected = dataset.drop_vars(["chain", "draw"], errors="ignore").isel(chain=chain, draw=draw)
    return selected.transpose("chain", "draw", ...).assign_coords(
        chain=np.arange(picked.shape[0]), draw=np.arange(picked.shape[1]))


def _draw_trajectories(view: ResultView, numpyro_model: Callable, times: Any, y: Any,
                       model_kwargs: Mapping[str, Any] | None, picked: np.ndarray, count: int,
                       seed: int) -> xr.Dataset:
    """Draw trajectories at some of the picked draws, in the layout of the result."""
    template = view.group("trajectories")
    path_times = times_of(template).values if {"time", TIMES} & set(template.coords) else None
    draw_index, rows = evenly_spaced(picked.shape[0], picked.shape[1], count)
    problem = rebuilding.problem(view, numpyro_model, times, y, model_kwargs).select(picked.ravel()[rows])
    paths = {label: values.reshape(picked.shape[0], len(draw_index), *values.shape[1:]) for label, values in
             trajectories(jax.random.key(seed), problem.bound, problem.draws, path_times).items()}
    variables = {}
    for label, variable in template.data_vars.items():
        if "draw" not in variable.dims or label == "deterministics":  # computed again below
            continue
        variables[label] = (variable.transpose("chain", "draw", ...).dims, paths[_KINDS[str(label)]], variable.attrs)
    coords = {key: value for key, value in template.coords.items() if key not in ("chain", "draw", "statistic")}
    new = xr.Dataset(variables, coords | {"chain": np.arange(picked.shape[0]), "draw": draw_index})
    # The model may have other deterministics than when it was fitted.
    names = list(problem.bound.site.example.ssm.model.deterministic_names)
    new = new.drop_vars("deterministic", errors="ignore")
    if names:
        dims = [*new["outputs"].dims[:-1], "deterministic"]
        attrs = template["deterministics"].attrs if "deterministics" in template else {}
        new = new.assign(deterministics=(dims, paths["deterministic"], attrs)).assign_coords(deterministic=names)
    return with_summaries(new, paths)
