"""The likelihood site of a NumPyro model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
from numpyro import handlers

from lfm_ppl.filtering.grid_layout import GridLayout
from lfm_ppl.filtering.iterated import Anchor
from lfm_ppl.likelihoods.handlers.likelihood_handler import LikelihoodHandler
from lfm_ppl.likelihoods.likelihood import Likelihood
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood
from lfm_ppl.utils import checks


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


class SiteTimes(NamedTuple):
    """Times of a likelihood site that do not depend on the parameters.

    Attributes:
        times: (T,), or (B, T) for a panel.
        layout: layout of the time grid; None where the likelihood lays it out itself.
    """

    times: Any
    layout: GridLayout | None = None


class replace_times(LikelihoodHandler):  # noqa: N801 (an effect handler, named as NumPyro names its handlers)
    """Effect handler that gives each likelihood its times, where the model's arithmetic or compiled code traces them.

    Args:
        fn: a NumPyro model.
        times: name of a site -> its times.
    """

    def __init__(self, fn: Callable[..., Any], times: Mapping[str, SiteTimes]) -> None:
        self.times = times
        super().__init__(fn)

    def replacement(self, likelihood: Likelihood, site: dict[str, Any]) -> Any:
        """Return the likelihood at these times."""
        new: SiteTimes | None = self.times.get(site["name"])
        if new is None:
            return likelihood
        if new.layout is not None and isinstance(likelihood, SeriesLikelihood):
            return likelihood.with_times(new.times, new.layout)
        return likelihood.with_times(new.times) if checks.traced(likelihood.times) else likelihood


class replace_anchors(LikelihoodHandler):  # noqa: N801 (an effect handler, see above)
    """Effect handler that gives likelihoods the smoothed moments from which their iterations start.

    Args:
        fn: a NumPyro model.
        anchors: name of a site -> its moments; other sites stay as they are.
    """

    def __init__(self, fn: Callable[..., Any], anchors: Mapping[str, Anchor]) -> None:
        self.anchors = anchors
        super().__init__(fn)

    def replacement(self, likelihood: Likelihood, site: dict[str, Any]) -> Any:
        """Return the likelihood with these moments."""
        anchor = self.anchors.get(site["name"])
        return likelihood if anchor is None else likelihood.with_about(anchor)


class remove_likelihood(LikelihoodHandler):  # noqa: N801 (an effect handler, see above)
    """Effect handler that removes the likelihood, so that the density is that of the prior."""

    def missing(self) -> str:
        """Return the error of a likelihood inside a wrapper."""
        return "the likelihood is inside a mask or an expansion, so that it cannot be separated from the prior."


class record_likelihoods(LikelihoodHandler):  # noqa: N801 (an effect handler, see above)
    """Effect handler that removes each likelihood and stores it in ``likelihoods`` by the name of its site."""

    def begin(self) -> None:
        """Forget the likelihoods of the run before."""
        super().begin()
        self.likelihoods: dict[str, Likelihood] = {}

    def replacement(self, likelihood: Likelihood, site: dict[str, Any]) -> Any:
        """Store the likelihood and return an improper distribution."""
        self.likelihoods[site["name"]] = likelihood
        return super().replacement(likelihood, site)
