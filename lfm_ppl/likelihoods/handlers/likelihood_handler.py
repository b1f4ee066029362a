"""Effect handlers: those that judge a run of the model when it ends, and those that replace its likelihood."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpyro.distributions as dist
from numpyro.primitives import Messenger

from lfm_ppl.likelihoods.likelihood import Likelihood


class Handler(Messenger):
    """Effect handler that gathers something of every run of a model and may find fault with it at its end."""

    def begin(self) -> None:
        """Forget the run before."""

    def complaint(self) -> str:
        """Return the error of the run that has ended; nothing where all is well."""
        return ""

    def __enter__(self) -> Any:
        """Start a run of the model."""
        self.begin()
        super().__enter__()
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """End the run."""
        super().__exit__(kind, error, trace)
        if kind is None and (message := self.complaint()):
            raise ValueError(message)


class LikelihoodHandler(Handler):
    """Replaces the distribution of every site ``MarginalLikelihood`` or ``panel``.

    Args:
        fn: a NumPyro model; None where the handler is used as a context.

    Attributes:
        only_site: name of the site whose likelihood is replaced; None: of all sites.
    """

    supports_all_likelihoods = True
    only_site: str | None = None

    def __init__(self, fn: Callable[..., Any] | None = None) -> None:
        self.has_site = False
        super().__init__(fn)

    def replacement(self, likelihood: Likelihood, site: dict[str, Any]) -> Any:
        """Return the distribution that takes the place of the likelihood of a site; by default a likelihood of one."""
        shape = likelihood.batch_shape + likelihood.event_shape
        return dist.ImproperUniform(dist.constraints.real, (), shape).mask(False)

    def missing(self) -> str:
        """Return the error of a model without such a site; nothing where that is no mistake."""
        return ""

    def begin(self) -> None:
        """Forget the sites of the run before."""
        self.has_site = False

    def complaint(self) -> str:
        """Return what is wrong where no site was found."""
        return "" if self.has_site else self.missing()

    def process_message(self, msg: dict[str, Any]) -> None:
        """Replace the distribution of the site."""
        fn = msg.get("fn")
        is_selected = self.only_site is None or self.only_site == msg.get("name")
        if msg["type"] == "sample" and is_selected and isinstance(fn, Likelihood):
            if not (self.supports_all_likelihoods or fn.first.has_gaussian_state):
                return
            self.has_site = True
            msg["fn"] = self.replacement(fn, msg)
