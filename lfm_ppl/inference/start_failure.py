"""The part of a model's log density that is not finite at the prior median, for the error of a failed search."""

from __future__ import annotations

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer import init_to_median

from lfm_ppl.filtering.breakdown import breakdown, family_breakdown
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.likelihoods.constrained_likelihood import ConstrainedLikelihood
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood
from lfm_ppl.switching.switching_likelihood import Switching


def start_failure(bound: BoundModel) -> str:
    """Return a sentence on the part of the log density, or of its gradient, that is not finite at the prior median."""
    z = bound.draw(jax.random.key(0), init_to_median)
    value, gradient = (np.asarray(part) for part in bound.log_density_gradient(z))
    if np.isfinite(value) and np.isfinite(gradient).all():
        return (f"the log density ({float(value):g}) and its gradient are finite, so that the starting points that "
                "`init` draws are the reason: leave out init.")
    if np.isfinite(value):
        names = ", ".join(repr(name) for name, slope in zip(bound.names, gradient, strict=True)
                          if not np.isfinite(slope))
        return (f"the log density is finite ({float(value):g}), but its derivative with respect to {names} is not: "
                "look for a square root, a norm or a division at zero in the functions of the model.")
    return _site_failure(bound) or _likelihood_failure(bound, z) or (
        f"the log density is {float(value):g}, though the densities of all sites are finite: their sum overflows.")


def _site_failure(bound: BoundModel) -> str | None:
    """Return a sentence on the prior, factor or further observed site whose log density is not finite."""
    likelihoods = {site.name for site in bound.unbound.likelihoods}
    for name, site in bound.trace().items():
        if site["type"] != "sample" or name in likelihoods:
            continue
        if not site["is_observed"] and not np.isfinite(np.asarray(site["value"], float)).all():
            value = np.array2string(np.asarray(site["value"], float), threshold=5, separator=", ").replace("\n", "")
            return f"the value of {name!r} is not finite ({value}): check the parameters of its prior."
        total = float(jnp.sum(site["fn"].log_prob(site["value"])))
        if not np.isfinite(total):
            kind = "site" if site["is_observed"] else "prior of"
            return f"the {kind} {name!r} has the log density {total:g}."
    return None


def _likelihood_failure(bound: BoundModel, z: Any) -> str | None:
    """Return a sentence on the site, the series and the row at which the likelihood fails."""
    for name, site_model in bound.site_models.items():
        distribution, y = site_model.likelihood(z), site_model.y
        members = distribution.members
        for index, member in enumerate(members):
            rows = y.reshape(len(members), *member.event_shape)[index]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the same reasons, as warnings
                if np.isfinite(member.log_prob(rows)):
                    continue
            series = f"series {index}: " if distribution.batch_shape else ""
            return (f"site {name!r}: " if bound.is_by_site else "") + series + _series_failure(member, rows)
    return None


def _series_failure(member: SeriesLikelihood, y: Any) -> str:
    if isinstance(member, ConstrainedLikelihood):
        return "the likelihood under constraints is not finite: they may be impossible together with the data."
    if isinstance(member, Switching):
        return member.breakdown(member.checked(y))
    if member.is_family:
        return family_breakdown(member.ssm, member.settings.rule, member.time_grid, y, member.factor_settings)
    return breakdown(member.ssm, member.settings.rule, member.time_grid, y) or (
        "the likelihood is not finite, though the filter does not break down without posterior linearisation: try "
        "iterations=0.")
