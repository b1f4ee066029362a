"""Settings of the Gaussian filter of a likelihood, with their defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from lfm_ppl.filtering.arguments import as_rule, check_iterations
from lfm_ppl.filtering.ep.settings import FactorSettings, as_settings
from lfm_ppl.filtering.integrators.methods import DEFAULT_METHOD, METHODS
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import Cubature
from lfm_ppl.utils import checks


@dataclass(frozen=True)
class FilterSettings:
    """Settings of the filter of one likelihood; see the arguments of `lfm_ppl.MarginalLikelihood`.

    Attributes:
        rule: linearisation rule.
        steps: integration steps between two consecutive times.
        filter_steps: the number for filter and smoother, where it is another one; None: ``steps``.
        max_step: longest step; None: twice the median step.
        iterations: of posterior linearisation; `MarginalLikelihood` puts its default here, which depends on the model.
        damping: largest share of each new iterate that is taken.
        tolerance: largest error of an integration step, in standard deviations; None: equal steps.
        method: of integration.
        factors: of an observation family; None: expectation propagation.
    """

    rule: Rule = Cubature()
    steps: int = 10
    filter_steps: int | None = None
    max_step: float | None = None
    iterations: int = 0
    damping: float = 0.7
    tolerance: float | None = None
    method: str = DEFAULT_METHOD
    factors: FactorSettings | None = None

    @property
    def integration_steps(self) -> int:
        """Integration steps of the filter and the smoother."""
        return self.steps if self.filter_steps is None else self.filter_steps

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the names of all settings."""
        return tuple(field.name for field in fields(cls))

    @classmethod
    def of(cls, arguments: Mapping[str, Any]) -> tuple[FilterSettings, frozenset[str]]:
        """Return settings from arguments of which None are open, and the names of those that are not.

        Raises:
            ValueError, TypeError: an argument out of its range, or iterations beside a tolerance.
        """
        named_settings = {name: value for name, value in arguments.items() if value is not None}
        if "rule" in named_settings:
            named_settings["rule"] = as_rule(named_settings["rule"])
        check_iterations(named_settings.get("iterations"), named_settings.get("damping", cls.damping),
                         named_settings.get("tolerance"))
        if "filter_steps" in named_settings:
            checks.positive_integer("filter_steps", named_settings["filter_steps"],
                                    "It is a number of integration steps.")
            if "tolerance" in named_settings:
                raise ValueError("a tolerance chooses its own steps; leave filter_steps or tolerance out.")
        if "tolerance" in named_settings:
            checks.positive("tolerance", named_settings["tolerance"],
                            "It is in standard deviations, 0.001 for example.")
            named_settings["tolerance"] = float(named_settings["tolerance"])
        checks.one_of("method", named_settings.get("method", cls.method), METHODS)
        if "factors" in named_settings:
            named_settings["factors"] = as_settings(named_settings["factors"])
        return cls(**named_settings), frozenset(named_settings)
