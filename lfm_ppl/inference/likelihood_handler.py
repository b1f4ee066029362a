"""Effect handlers that put something else in the place of a model's likelihood."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpyro.primitives import Messenger

from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood, Panel


class LikelihoodHandler(Messenger):
    """Replaces the distribution of every site ``MarginalLikelihood`` or ``panel``.

    Args:
        fn: a NumPyro model; None where the handler is used as a context.
    """

    def __init__(self, fn: Callable[..., Any] | None = None) -> None:
        self.found = False
        super().__init__(fn)

    def replacement(self, likelihood: MarginalLikelihood | Panel, site: dict[str, Any]) -> Any:
        """Return the distribution that takes the place of the likelihood of a site."""
        raise NotImplementedError

    def complaint(self) -> str:
        """Return the error of a model without such a site; nothing where that is no mistake."""
        raise NotImplementedError

    def __enter__(self) -> Any:
        """Start a run of the model."""
        self.found = False
        super().__enter__()
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """End the run."""
        super().__exit__(kind, error, trace)
        if kind is None and not self.found and (message := self.complaint()):
            raise ValueError(message)

    def process_message(self, msg: dict[str, Any]) -> None:
        """Replace the distribution of the site."""
        fn = msg.get("fn")
        if msg["type"] == "sample" and isinstance(fn, (MarginalLikelihood, Panel)):
            self.found = True
            msg["fn"] = self.replacement(fn, msg)
