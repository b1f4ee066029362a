"""Numerical error of a fitted likelihood, measured at a few posterior draws.

1. The log likelihood is evaluated at `_DRAWS` draws with more iterations of posterior linearisation and half the
   integration step, in one program.
2. A change that is the same at all draws does not move the posterior; its standard deviation over the draws does. Where
   that is above `LARGEST_CHANGE`, each refinement is evaluated alone.
3. The message names the refinements that are needed, which are far cheaper than an exact likelihood.

Steps and forces are compared with the posterior medians as well: a step longer than half a lengthscale does not resolve
the force, and the error of a force whose SDE is an approximation is estimated by algebra.

The refined likelihood is not exact either: `lfm_ppl.check_accuracy` compares with an exact one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from lfm_ppl.accuracy import log_likelihoods
from lfm_ppl.filtering.integrators.integrator import Stepping
from lfm_ppl.filtering.iterated import DEFAULT_ITERATIONS
from lfm_ppl.forces.stretched import Stretched
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.model_draws import ModelDraws
from lfm_ppl.inference.trajectories import evenly_spaced
from lfm_ppl.inference.tuning import finite_sd
from lfm_ppl.likelihoods.constrained_likelihood import ConstrainedLikelihood
from lfm_ppl.likelihoods.likelihood_site import LikelihoodSite
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood
from lfm_ppl.model.resolution import resolution_messages
from lfm_ppl.utils import checks

_DRAWS = 20
"""Posterior draws at which the log likelihood is refined."""

LARGEST_CHANGE = 0.5
"""Standard deviation over the posterior of a change of the log likelihood that is not worth a warning."""

_MANY_ITERATIONS = 10
"""Iterations after which the linearisation of most models no longer changes."""


@dataclass(frozen=True)
class Refinement:
    """Settings of a likelihood that is more accurate in one respect.

    Attributes:
        settings: keyword arguments of the likelihood.
        change: what they change, in words.
        remedy: how to fit with them.
    """

    settings: dict[str, Any]
    change: str
    remedy: str


def more_iterations(example: SeriesLikelihood) -> Refinement | None:
    """Return more iterations of posterior linearisation; None where the likelihood takes none."""
    if example.has_factors or example.ssm.plan.is_linear or not example.has_gaussian_state:
        return None
    current = example.settings.iterations
    is_short = current < DEFAULT_ITERATIONS and example.about is None
    count = DEFAULT_ITERATIONS if is_short else max(_MANY_ITERATIONS, 2 * current)
    return Refinement({"iterations": count}, f"{count} iterations of posterior linearisation instead of {current}",
                      f"iterations={count} (--iterations {count})")


def shorter_steps(example: SeriesLikelihood) -> Refinement | None:
    """Return half the integration step; None where nothing is integrated, or where constraints fix the steps."""
    if isinstance(example, ConstrainedLikelihood) or all(ssm.plan.has_exact_moments for ssm in example.ssms):
        return None
    settings = log_likelihoods.finer_steps(example)
    arguments = ", ".join(f"{name}={value:g}" for name, value in settings.items())
    flags = " ".join(f"--{name.replace('_', '-')} {value:g}" for name, value in settings.items())
    return Refinement(settings, "half the integration step", f"{arguments} ({flags})")


def approximation_warnings(bound: BoundModel, draws: Mapping[str, np.ndarray],
                           log_likelihood: np.ndarray | None = None) -> list[str]:
    """Return messages on settings of the likelihood whose refinement would change the posterior.

    Args:
        bound: the model and its data.
        draws: site name -> (S, ...), posterior draws.
        log_likelihood: (S,), the fitted log likelihood at the draws; None: it is computed.
    """
    example = bound.site.example
    # With a tolerance there are no iterations.
    candidates = (more_iterations(example) if example.settings.tolerance is None else None, shorter_steps(example))
    refinements = [refinement for refinement in candidates if refinement is not None]
    if not refinements:
        return []
    count = len(next(iter(draws.values())))
    _, rows = evenly_spaced(1, count, min(_DRAWS, count))
    problem = ModelDraws(bound, draws).select(rows)
    fitted = log_likelihoods.gaussian(problem) if log_likelihood is None else log_likelihood[rows]

    def change(*selected: Refinement) -> float:
        settings = {name: value for refinement in selected for name, value in refinement.settings.items()}
        return finite_sd(log_likelihoods.gaussian(problem, **settings) - fitted)

    total = change(*refinements)
    if total <= LARGEST_CHANGE:
        return []
    changes = [total] if len(refinements) == 1 else [change(refinement) for refinement in refinements]
    remedies = [(refinement, size) for refinement, size in zip(refinements, changes, strict=True)
              if size > LARGEST_CHANGE]
    if not remedies:  # only both together
        remedies = [(refinement, total) for refinement in refinements]
    return [_message(refinement, size, len(rows)) for refinement, size in remedies]


def resolution_warnings(site: LikelihoodSite) -> list[str]:
    """Return messages on steps and forces that are too coarse for the likelihood at the posterior medians."""
    first, y = site.example, np.asarray(site.observed)
    rows = y[0] if site.distribution.batch_shape else y
    return [*_long_steps(first), *resolution_messages(first.model, first.times, rows)]


def _long_steps(likelihood: SeriesLikelihood) -> list[str]:
    """Return a message where an integration step is longer than half the lengthscale of a force."""
    grid = likelihood.time_grid
    length = checks.concrete(grid.intervals.length)
    lengthscales = [float(force.lengthscale) for force in jax.tree_util.tree_leaves(
        likelihood.model.forces, is_leaf=lambda part: isinstance(part, Stretched)) if isinstance(force, Stretched)]
    has_equal_steps = any(integrator.stepping is Stepping.EQUAL for integrator in likelihood.integrators)
    if not has_equal_steps or length is None or not lengthscales:
        return []
    # Fewer steps of the filter alone are taken where their error is known to be small.
    settings = likelihood.settings
    steps = grid.steps * settings.steps / settings.integration_steps
    step, longest = float(length.max()) / steps, 0.5 * min(lengthscales)
    if step <= longest:
        return []
    remedy = f"{0.9 * longest:.2g}"  # rounded, it must not exceed the limit
    return [f"the longest integration step, {step:.3g}, is more than half of the shortest lengthscale of a force, "
            f"{min(lengthscales):.3g} at the posterior median, so that the force is not resolved. Set "
            f"max_step={remedy} (--max-step {remedy}) or less."]


def _message(refinement: Refinement, change: float, draws: int) -> str:
    if not np.isfinite(change):
        return (f"with {refinement.change}, the log likelihood is not finite at some of {draws} posterior draws: the "
                "approximation fails for a part of the posterior. Compare it with an exact one (lfm-ppl check, "
                "lfm.check_accuracy).")
    return (f"with {refinement.change}, the log likelihood changes by {change:.1f} (sd over {draws} posterior draws), "
            f"more than {LARGEST_CHANGE}: the posterior is affected. Fit again with {refinement.remedy}.")
