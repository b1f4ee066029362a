"""Change the approximation that a NumPyro model's likelihood uses, without changing the model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lfm_ppl.likelihoods.constrained_likelihood import likelihood_with
from lfm_ppl.likelihoods.handlers.likelihood_handler import LikelihoodHandler
from lfm_ppl.likelihoods.likelihood import Likelihood
from lfm_ppl.likelihoods.marginal_likelihood import MarginalLikelihood

NAMES = ("rule", "steps", "max_step", "iterations", "damping", "tolerance", "method", "filter_steps", "factors",
         "lower", "upper", "constraints", "grid", "draws")


class approximate(LikelihoodHandler):  # noqa: N801 (an effect handler, named as NumPyro names its handlers)
    """Effect handler that replaces settings of the likelihood, such as the linearisation rule.

    Args:
        numpyro_model: a NumPyro model with a site ``MarginalLikelihood`` or ``panel``.
        **settings: any of ``rule``, ``steps``, ``max_step``, ``iterations``, ``damping``, ``tolerance``, ``method``,
            ``filter_steps``, ``factors``, ``lower``, ``upper``, ``constraints``, ``grid`` and ``draws``; what is None
            or left out stays as the model has it. But ``steps`` hold for the filter, too, unless ``filter_steps`` are
            named; ``steps`` or ``iterations`` without a tolerance remove the tolerance of the model, and a tolerance or
            constraints remove its iterations.

    Raises:
        TypeError: for a setting of another name.
        ValueError: when the model runs, if it has no such site; and what ``MarginalLikelihood``
            raises for a setting that it does not take.

    Example:
        >>> import jax, jax.numpy as jnp, numpyro, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     system = lfm.LatentForceModel(
        ...         lambda x, u, t: u - x**3, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
        >>> finer = lfm.approximate(model, rule=lfm.GaussHermite(7), steps=20)
        >>> run = numpyro.handlers.seed(finer, jax.random.key(0))
        >>> numpyro.handlers.trace(run).get_trace(jnp.arange(3.0))["y"]["fn"].settings.steps
        20
    """

    def __init__(self, numpyro_model: Callable[..., Any] | None = None, **settings: Any) -> None:
        unknown = sorted(set(settings) - set(NAMES))
        if unknown:
            raise TypeError(f"unknown setting {unknown[0]!r}; known: {', '.join(NAMES)}.")
        self.settings = {name: value for name, value in settings.items() if value is not None}
        super().__init__(numpyro_model)

    def missing(self) -> str:
        """Return the error of a model without a likelihood whose settings could be changed."""
        if not self.settings:
            return ""
        return (
            f"the model has no likelihood whose {', '.join(self.settings)} could be set: "
            "expected a site numpyro.sample(name, lfm.MarginalLikelihood(...), obs=y) or a "
            "panel."
        )

    def replacement(self, likelihood: Likelihood, site: dict[str, Any]) -> Any:
        """Return the likelihood with the new settings."""
        has_equal_steps = "steps" in self.settings or self.settings.get("iterations", 0) > 0
        is_single_pass = any(self.settings.get(name) for name in ("tolerance", "lower", "upper", "constraints"))
        ended = (["tolerance"] * has_equal_steps + ["iterations"] * is_single_pass
                 + ["filter_steps"] * ("steps" in self.settings or is_single_pass))
        settings = {name: None for name in ended if name in likelihood.arguments} | self.settings
        if isinstance(likelihood, MarginalLikelihood):  # bounds make it another class
            new = likelihood_with(likelihood.model, likelihood.times, likelihood.arguments | settings)
            return new.with_about(likelihood.about)
        return likelihood.with_settings(**settings)


class complete(approximate):  # noqa: N801 (an effect handler, named as NumPyro names its handlers)
    """Effect handler that sets those settings of the likelihood that the model leaves open; arguments as `approximate`.

    What the model names stays.
    """

    def replacement(self, likelihood: Likelihood, site: dict[str, Any]) -> Any:
        """Return the likelihood with the settings that were open."""
        is_open = {name: value for name, value in self.settings.items() if name not in likelihood.arguments}
        return likelihood.with_settings(**is_open) if is_open else likelihood
