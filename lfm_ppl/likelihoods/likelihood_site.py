"""The likelihood site of a NumPyro model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
from numpyro import handlers

from lfm_ppl.likelihoods.likelihood import Likelihood
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood


class LikelihoodSite(NamedTuple):
    """The likelihood site of a NumPyro model.

    Attributes:
        name: name of the site.
        distribution: the `MarginalLikelihood` or the panel.
        observed: its observations, (T, D) or (B, T, D); None where they are left open.
    """

    name: str
    distribution: Likelihood
    observed: Any = None

    @property
    def example(self) -> SeriesLikelihood:
        """The distribution of one series."""
        return self.distribution.first

    @property
    def members(self) -> list[SeriesLikelihood]:
        """The distributions of all series."""
        return self.distribution.members


def likelihood_site(model: Callable, arguments: tuple, keywords: Mapping[str, Any], key: jax.Array,
                    parameters: Mapping[str, Any] | None = None, name: str | None = None) -> LikelihoodSite:
    """Run a NumPyro model and return its likelihood site, of several the one with this name.

    Raises:
        ValueError: the model has no such site, or several and no name is given.
    """
    seeded = handlers.seed(handlers.substitute(model, data=dict(parameters or {})), key)
    return single_site(likelihood_sites(handlers.trace(seeded).get_trace(*arguments, **keywords)), name)


def likelihood_sites(trace: Mapping[str, Any]) -> list[LikelihoodSite]:
    """Return the likelihood sites of a NumPyro trace."""
    sites = []
    for name, site in trace.items():
        distribution = site.get("fn")
        # Masks and expansions wrap the distribution.
        while hasattr(distribution, "base_dist") and not isinstance(distribution, Likelihood):
            distribution = distribution.base_dist
        if isinstance(distribution, Likelihood):
            sites.append(LikelihoodSite(name, distribution, site["value"]))
    return sites


def single_site(sites: Sequence[LikelihoodSite], name: str | None = None) -> LikelihoodSite:
    """Return the only likelihood site, or the one with this name.

    Raises:
        ValueError: there is no such site, or there are several and no name is given.
    """
    selected = [site for site in sites if name in (None, site.name)]
    if len(selected) == 1:
        return selected[0]
    names = ", ".join(site.name for site in sites) or "none"
    if not selected:
        raise ValueError("the model must have a site numpyro.sample(name, lfm.MarginalLikelihood(...), obs=y) (or "
                         f"lfm.panel){'' if name is None else f' with the name {name!r}'}; found {names}.")
    raise ValueError(f"one likelihood site is expected here, and the model has {names}: pass times and data by site, "
                     f"lfm.fit(model, {{{', '.join(f'{site.name!r}: (times, y)' for site in sites)}}}), which calls "
                     f"model(times, y) with dicts; of a bound model take bound.site_models[{sites[0].name!r}].")


