"""Change the approximation that a NumPyro model's likelihood uses, without changing the model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpyro.primitives import Messenger

from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood, Panel

NAMES = ("rule", "steps", "max_step", "iterations", "damping")


class approximate(Messenger):  # noqa: N801 (an effect handler, named as NumPyro names its handlers)
    """Effect handler that replaces settings of the likelihood, such as the linearisation rule.

    Args:
        fn: a NumPyro model with a site ``MarginalLikelihood`` or ``panel``.
        **settings: any of ``rule``, ``steps``, ``max_step``, ``iterations`` and ``damping``; what
            is None or left out stays as the model has it.

    Raises:
        TypeError: for a setting of another name.
        ValueError: when the model runs, if it has no such site; and what ``MarginalLikelihood``
            raises for a setting that it does not take.

    Example:
        >>> import jax, jax.numpy as jnp, numpyro, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     system = lfm.LatentForceModel(
        ...         lambda x, u, t: u - x**3, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
        >>> finer = approximate(model, rule=lfm.GaussHermite(7), steps=20)
        >>> run = numpyro.handlers.seed(finer, jax.random.key(0))
        >>> numpyro.handlers.trace(run).get_trace(jnp.arange(3.0))["y"]["fn"].steps
        20
    """

    def __init__(self, fn: Callable[..., Any] | None = None, **settings: Any) -> None:
        unknown = sorted(set(settings) - set(NAMES))
        if unknown:
            raise TypeError(f"unknown setting {unknown[0]!r}; known: {', '.join(NAMES)}.")
        self.settings = {name: value for name, value in settings.items() if value is not None}
        self.found = False
        super().__init__(fn)

    def __enter__(self) -> approximate:
        """Start a run of the model."""
        self.found = False
        super().__enter__()
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """End the run; a model without the site that was to be changed is an error."""
        super().__exit__(kind, error, trace)
        if kind is None and self.settings and not self.found:
            raise ValueError(
                f"the model has no likelihood whose {', '.join(self.settings)} could be set: "
                "expected a site numpyro.sample(name, lfm.MarginalLikelihood(...), obs=y) or a "
                "panel."
            )

    def process_message(self, msg: dict[str, Any]) -> None:
        """Build the likelihood again with the new settings."""
        fn = msg.get("fn")
        if msg["type"] != "sample" or not isinstance(fn, (MarginalLikelihood, Panel)):
            return
        self.found = True
        if isinstance(fn, Panel):
            settings = {**fn.settings, **self.settings}
            msg["fn"] = Panel(fn.build, fn.parameters, fn.times, settings)
        else:
            settings = {name: getattr(fn, name) for name in NAMES} | self.settings
            msg["fn"] = MarginalLikelihood(fn.model, fn.times, **settings)
