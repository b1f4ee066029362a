"""The error of a posterior that was sampled with the Gaussian filter's likelihood.

1. At draws of the posterior compute the log likelihood of the filter, also with half the step and more iterations.
2. Compute the log likelihood of a reference: exact for linear models, a Fokker-Planck grid for one state, else
   replicates of a particle filter.
3. Smooth the importance weights (Pareto), and correct the moments of the parameters.
4. `judge` turns the numbers into a verdict: trust, corrected, re-run or inconclusive.

Source: Vehtari et al. (2024), JMLR 25(72); Andrieu and Roberts (2009), Annals of Statistics 37(2).
"""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.accuracy import importance_weights, log_likelihoods
from lfm_ppl.accuracy.approximation import more_iterations
from lfm_ppl.accuracy.log_likelihoods import Reference, ReferenceSettings
from lfm_ppl.accuracy.report import EXACT, GROUP, AccuracyReport
from lfm_ppl.accuracy.verdict import NOISE_SD, NOISE_SHARE, Findings, judge
from lfm_ppl.inference.model_digest import model_digest
from lfm_ppl.inference.model_draws import ModelDraws
from lfm_ppl.inference.samplers import GAUSSIAN_FILTER_SAMPLERS, SAMPLERS
from lfm_ppl.inference.trajectories import evenly_spaced
from lfm_ppl.inference.tuning import finite_sd
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.results import arviz_data, rebuilding
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.scalars import choose
from lfm_ppl.results.sites import site_view
from lfm_ppl.storage import checkpoint as checkpoints
from lfm_ppl.storage import run_record
from lfm_ppl.utils import checks

REFERENCES = ("auto", "grid", "particles")

_LARGEST_VARIANCE = 100.0
"""Of the noise of a log ratio, where all replicates but one find the data impossible."""

_MOST_WORK = 2e10
"""Limit on particle steps times states of a check: some ten minutes on two cores."""


def check_accuracy(result: Any, numpyro_model: Callable, times: Any = None, y: Any = None, *, reference: str = "auto",
                   draws: int = 200, particles: int | None = None, replicates: int = 4, steps: int | None = None,
                   model_kwargs: Mapping[str, Any] | None = None, seed: int = 0, progress: bool = True,
                   checkpoint: str | Path | None = None, resume: bool = False) -> AccuracyReport:
    """Ask a posterior of the Gaussian filter how wrong it is, and what the exact one looks like.

    At draws theta_i of the posterior, the likelihood of the Gaussian filter is compared with an exact one. Their ratios
    w_i = p(y | theta_i) / p_filter(y | theta_i) are importance weights that turn the filter's posterior into the exact
    one. Pareto smoothing makes them usable and tells, by its k, whether they are.

    A particle filter estimates the likelihood without bias, so that its ratios are right on average; its noise is
    measured by independent replicates, kept below 0.3 in each log ratio, and part of every standard error.

    Args:
        result: of `lfm_ppl.fit`; the report is stored in it, as the group ``accuracy``.
        numpyro_model: the model that was fitted, with the same settings.
        times: as in the fit; by default what the result holds.
        y: as in the fit; by default what the result holds.
        reference: "grid" (Fokker-Planck equation; one state), "particles", or "auto": the grid for one state with
            noise, else particles, and none where the filter is exact, for linear models with Gaussian noise.
        draws: number of posterior draws to compare at, spread evenly over the chains.
        particles: in each run of the particle filter; by default as many as keep the noise low. Where that takes
            minutes, as for panels, fewer at first, and more only if their noise leaves the verdict open.
        replicates: runs of the particle filter for each draw, at least 2.
        steps: integration steps of the reference between two observations; by default as in the fit.
        model_kwargs: keyword arguments of the model, as in the fit.
        seed: of the particle filter.
        progress: show the progress on standard error.
        checkpoint: a folder to keep log likelihoods in while others are computed, every few seconds. They stay there,
            in a folder ``checkpoint``, for whoever takes them up after the report is stored.
        resume: continue the check in the folder ``checkpoint``, which must be of the same result and settings. In an
            empty folder a new check starts.

    Returns:
        The report; ``print`` it.

    Raises:
        ValueError, TypeError: an unknown reference; a grid for several states or without noise; a result without its
            data; a model that is not the one of the result; draws of a sampler that is exact already.

    Example:
        >>> import jax.numpy as jnp, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        ...     system = lfm.LatentForceModel(
        ...         lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
        >>> result = lfm.fit(model, np.arange(5.0), np.ones((5, 1)), sampler="map", samples=50, progress=False)
        >>> check_accuracy(result, model, progress=False).verdict.word
        'trust'

    Source: Vehtari et al. (2024), JMLR 25(72), for the smoothing; Andrieu and Roberts (2009), Annals of Statistics
    37(2), for exactness with unbiased estimates of the likelihood.
    """
    checks.one_of("reference", reference, REFERENCES)
    checks.positive_integer("draws", draws)
    for name, value in (("particles", particles), ("steps", steps)):
        if value is not None:
            checks.positive_integer(name, value)
    checks.positive_integer("replicates", replicates)
    if replicates < 2:
        raise ValueError("replicates must be at least 2: their spread estimates the noise of the particle filter.")
    view = ResultView.of(result)
    _check_sampler(str(view.attrs.get("sampler", "")))
    full_problem = rebuilding.problem(view, numpyro_model, times, y, model_kwargs)
    examples = {name: site.example for name, site in full_problem.sites.items()}
    for example in examples.values():
        if example.constraints_in_words:
            raise ValueError("a check of the Gaussian filter's accuracy does not support constraints, and the "
                             f"likelihood has some: {example.constraints_in_words}. Leave them out.")
        if not example.has_gaussian_state:
            raise ValueError("a check of the Gaussian filter's accuracy does not support a model that switches between "
                             "regimes; compare its likelihood with lfm.rao_blackwellised.")
    kinds = {name: _kind(reference, example.ssm) for name, example in examples.items()}
    posterior = view.posterior
    draw_index, rows = evenly_spaced(posterior.sizes["chain"], posterior.sizes["draw"], draws)
    run = None
    if checkpoint is not None:
        run = checkpoints.begin_or_resume(checkpoint, {
            "reference": reference, "draws": draws, "particles": particles, "replicates": replicates, "steps": steps,
            "seed": seed, "model": run_record.digest(model_digest(full_problem.bound)),
            "data": run_record.digest(*(site.y for site in full_problem.sites.values())),
            "versions": run_record.versions(),
            "draws of the result": run_record.digest(*full_problem.draws.values()),
        }, resume)  # fmt: skip
    with contextlib.closing(run) if run else contextlib.nullcontext():
        problem = replace(full_problem.select(rows), stores=None if run is None else run.batches)
        settings = {name: ReferenceSettings(kind, particles, replicates, steps, seed, progress)
                    for name, kind in kinds.items()}
        report = _report(view, problem, draw_index, settings)
    arviz_data.add_group(result, GROUP, report.to_dataset())
    return report


def _report(view: ResultView, problem: ModelDraws, draw_index: np.ndarray,
            settings: Mapping[str, ReferenceSettings]) -> AccuracyReport:
    shape = (view.posterior.sizes["chain"], len(draw_index))
    sites = problem.sites
    filtered = {name: log_likelihoods.gaussian(site).reshape(shape) for name, site in sites.items()}
    for name, site in sites.items():
        result = site_view(view, name) if view.likelihood_sites else view
        recorded = log_likelihoods.recorded(site, filtered[name].ravel()).reshape(shape)
        rebuilding.check_likelihood(result, recorded, draw_index)
    doubled = [log_likelihoods.gaussian(site, "log likelihoods with finer steps",
                                        **log_likelihoods.finer_steps(site.example)) for site in sites.values()]
    iterated, refinements = dict(filtered), {name: more_iterations(site.example) for name, site in sites.items()}
    for name, refinement in refinements.items():
        if refinement is not None:
            iterated[name] = log_likelihoods.gaussian(sites[name], "log likelihoods with more iterations",
                                                  **refinement.settings).reshape(shape)
    references = {name: _reference(site, filtered[name], settings[name], len(sites)) for name, site in sites.items()}
    return _assess(view, draw_index, np.sum([*filtered.values()], axis=0), np.sum(doubled, axis=0).reshape(shape),
                   _of_all_sites(references), problem,
                   np.sum([*iterated.values()], axis=0) if any(refinements.values()) else None)


def _of_all_sites(references: Mapping[str, Reference]) -> Reference:
    """Return the log likelihoods of the series of all sites."""
    values = list(references.values())
    descriptions = {name: reference.description for name, reference in references.items()}
    shared = set(descriptions.values())
    replicates = max(reference.estimates.shape[-1] for reference in values)
    return Reference(
        np.concatenate([np.broadcast_to(reference.estimates, (*reference.estimates.shape[:2], replicates))
                        for reference in values], axis=1),
        shared.pop() if len(shared) == 1 else "; ".join(map(": ".join, descriptions.items())),
        max(reference.particles for reference in values), any(reference.limited for reference in values))


def _assess(view: ResultView, draw_index: np.ndarray, filtered: np.ndarray, doubled: np.ndarray, reference: Reference,
            problem: ModelDraws, iterated: np.ndarray | None) -> AccuracyReport:
    """Return the report from log likelihoods (C, S) at draws ``draw_index`` (S,) of each chain.

    ``filtered`` is of the Gaussian filter, ``doubled`` of twice as many steps, ``iterated`` of more iterations.
    """
    posterior = view.posterior
    averaged = _summed(reference.estimates.reshape(*filtered.shape, *reference.estimates.shape[1:]))
    ratio = averaged.log_mean - filtered
    efficiency = _relative_efficiency(filtered)
    weights = importance_weights.smooth(ratio, efficiency)
    varying = {label: view.draws[label] for label in choose(view.draws, None)}
    table = importance_weights.corrected_moments(varying, draw_index, weights.log_weight)
    noisy = reference.estimates.shape[-1] > 1
    noise_sd = noise(averaged) if noisy else 0.0
    change = doubled - filtered
    example, attrs = problem.example, view.attrs
    findings = Findings(
        table=table, k=weights.k, threshold=weights.threshold, exact=reference.description.startswith(EXACT),
        step_change_sd=float(change.std()), noise_sd=noise_sd, noise_share=_share(noise_sd, ratio),
        particles=reference.particles, checked=ratio.size,
        available=posterior.sizes["chain"] * posterior.sizes["draw"], impossible=int(np.isneginf(ratio).sum()),
        sampler=str(attrs.get("sampler", "")), refit=_refit(attrs), steps=example.settings.integration_steps,
        max_step=example.settings.max_step, tolerance=example.settings.tolerance)
    if iterated is not None and (refinement := more_iterations(example)) is not None:
        findings = replace(findings, iterations=refinement.settings["iterations"], ratio_sd=finite_sd(ratio),
                           iterated_ratio_sd=finite_sd(averaged.log_mean - iterated))
    verdict = judge(findings)
    sample = ("chain", "draw")
    variables = {
        "log_likelihood": (sample, filtered), "log_likelihood_reference": (sample, averaged.log_mean),
        "log_likelihood_doubled_steps": (sample, doubled), "log_weight": (sample, weights.log_weight),
        "noise_sd": (sample, np.sqrt(averaged.variance) if noisy else np.zeros_like(ratio)),
        **{name: ("parameter", table[name].to_numpy()) for name in table.columns},
    }
    coords = {"chain": posterior["chain"].values, "draw": posterior["draw"].values[draw_index],
              "parameter": list(table.index)}
    return AccuracyReport(xr.Dataset(variables, coords, {
        "reference": reference.description, "pareto_k": weights.k, "threshold": weights.threshold,
        "ess": efficiency * weights.ess,
        "particles": reference.particles, "particles_limited": int(reference.limited), "noise_sd": noise_sd,
        "noise_share": findings.noise_share, "step_change_mean": float(change.mean()),
        "step_change_sd": findings.step_change_sd, "steps": example.settings.integration_steps,
        "available_draws": findings.available,
        "verdict": verdict.word, "reason": verdict.reason, "command": verdict.command,
        "remedies": json.dumps(verdict.remedies)}))


def noise(averaged: importance_weights.Averaged) -> float:
    """Return the root mean square, over draws, of the noise sd of averaged log likelihoods."""
    variances = averaged.variance[~np.isnan(averaged.variance)]
    return float(np.sqrt(np.minimum(variances, _LARGEST_VARIANCE).mean())) if variances.size else np.inf


def _share(noise_sd: float, ratio: np.ndarray) -> float:
    variance = float(np.var(ratio[np.isfinite(ratio)]))
    return min(noise_sd**2 / variance, 1.0) if variance > 0.0 else 0.0


def _refit(attrs: Mapping[str, Any]) -> str:
    """Return the command that made a result, in the words that it remembers; empty for results of `lfm_ppl.fit`."""
    if not attrs.get("model_file"):
        return ""
    words = ["lfm-ppl", "fit", str(attrs["model_file"])]
    if attrs.get("data", "simulated") != "simulated":
        words += ["--data", str(attrs["data"])]
    if attrs.get("series_column"):
        words += ["--series", str(attrs["series_column"])]
    if attrs.get("sampler", "nuts") != "nuts":
        words += ["--sampler", str(attrs["sampler"])]
    rule = json.loads(attrs.get("settings") or "{}").get("rule")
    words += ["--rule", rule] if rule else []
    for flag, stored in (("--option", "options"), ("--set", "fixed")):
        for name, value in json.loads(attrs.get(stored) or "{}").items():
            text = ",".join(f"{number:.12g}" for number in value) if isinstance(value, list) else str(value)
            words += [flag, f"{name}={text}"]
    return shlex.join(words)


def _relative_efficiency(log_likelihood: np.ndarray) -> float:
    """Return how many independent draws each draw is worth, at most 1."""
    error = arviz_data.mcse_mean(log_likelihood)
    if not error > 0.0:
        return 1.0
    return float(np.clip(log_likelihood.var(ddof=1) / error**2 / log_likelihood.size, 0.01, 1.0))


def _check_sampler(sampler: str) -> None:
    if sampler not in ("", *GAUSSIAN_FILTER_SAMPLERS):
        exact = sampler in SAMPLERS or "+" in sampler  # after a "+": how the draws were corrected
        which = ", which samples the exact posterior already" if exact else ""
        raise ValueError(f"the draws of this result come from {sampler}{which}; the check is for posteriors of the "
                         f"Gaussian filter (samplers {', '.join(GAUSSIAN_FILTER_SAMPLERS)}).")


def _kind(reference: str, ssm: StateSpaceModel) -> str:
    """Return "grid", "particles" or "none"."""
    family = isinstance(ssm.model.observation, ObservationFamily)
    if reference == "grid" and family:
        raise ValueError("reference='grid' takes Gaussian observations, and this model has an observation family. Use "
                         "reference='particles'.")
    one_state = ssm.state_dim == 1 and not family and not ssm.model.events
    if reference == "grid" and ssm.model.events:
        raise ValueError("reference='grid' takes models without events, and this one has some. Use "
                         "reference='particles'.")
    if reference == "grid" and not one_state:
        names = (*ssm.model.state_names, *ssm.model.force_names)
        raise ValueError(f"reference='grid' takes models of one state; this one has {ssm.state_dim}, of "
                         f"{', '.join(names)} (a force counts with its derivatives). Use reference='particles'.")
    if reference != "auto":
        return reference
    if ssm.has_exact_likelihood:
        return "none"
    return "grid" if one_state and _noisy(ssm) else "particles"


def _noisy(ssm: StateSpaceModel) -> bool:
    """Whether noise enters the one state, so that it has a density."""
    noise = ssm.model.process_noise if ssm.physical_dim else ssm.stack.dispersion()
    return callable(noise) or (noise is not None and bool(np.any(np.asarray(noise))))


def _reference(problem: ModelDraws, filtered: np.ndarray, settings: ReferenceSettings,
               count: int) -> Reference:
    """Return the reference of one site of ``count``, whose noises add up."""
    if settings.kind == "none":
        return Reference(filtered.reshape(-1, 1, 1), f"{EXACT}: for this linear model the Gaussian filter is exact")
    if settings.kind == "grid":
        return log_likelihoods.on_grid(problem, settings)

    def is_settled(estimates: np.ndarray) -> bool:
        averaged = _summed(estimates)
        ratio = averaged.log_mean.reshape(filtered.shape) - filtered
        if not np.isfinite(ratio).any():
            return False
        is_noisy = _share(noise(averaged), ratio) > NOISE_SHARE
        return importance_weights.smooth(ratio, _relative_efficiency(filtered)).reliable or not is_noisy

    return log_likelihoods.by_particles(
        problem, settings, lambda estimates: noise(_summed(estimates)), NOISE_SD / np.sqrt(count), _MOST_WORK,
        is_settled)


def _summed(estimates: np.ndarray) -> importance_weights.Averaged:
    """Return the averages over replicates of log likelihoods (..., B, R), summed over the series."""
    averaged = importance_weights.average(estimates)
    return importance_weights.Averaged(averaged.log_mean.sum(axis=-1), averaged.variance.sum(axis=-1))
