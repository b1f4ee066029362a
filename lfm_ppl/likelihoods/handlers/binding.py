"""Effect handlers that binding applies: likelihoods with other times or moments, removed, or recorded."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from lfm_ppl.filtering.grid_layout import GridLayout
from lfm_ppl.filtering.iterated import Anchor
from lfm_ppl.likelihoods.handlers.likelihood_handler import LikelihoodHandler
from lfm_ppl.likelihoods.likelihood import Likelihood
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood
from lfm_ppl.utils import checks


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


class replace_anchors(LikelihoodHandler):  # noqa: N801 (an effect handler, see `replace_times`)
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


class remove_likelihood(LikelihoodHandler):  # noqa: N801 (an effect handler, see `replace_times`)
    """Effect handler that removes the likelihood, so that the density is that of the prior."""

    def missing(self) -> str:
        """Return the error of a likelihood inside a wrapper."""
        return "the likelihood is inside a mask or an expansion, so that it cannot be separated from the prior."


class record_likelihoods(LikelihoodHandler):  # noqa: N801 (an effect handler, see `replace_times`)
    """Effect handler that removes each likelihood and stores it in ``likelihoods`` by the name of its site."""

    def begin(self) -> None:
        """Forget the likelihoods of the run before."""
        super().begin()
        self.likelihoods: dict[str, Likelihood] = {}

    def replacement(self, likelihood: Likelihood, site: dict[str, Any]) -> Any:
        """Store the likelihood and return an improper distribution."""
        self.likelihoods[site["name"]] = likelihood
        return super().replacement(likelihood, site)
