"""The methods of integration by name, and the integrator of a model.

A linear model with constant coefficients takes its exact transition, whatever the method. A quadrature replaces
explicit steps where the dynamics is linearised in forces only. With a tolerance the length of the steps follows the
moments.
"""

from __future__ import annotations

from lfm_ppl.filtering.integrators.adaptive import AdaptiveSteps
from lfm_ppl.filtering.integrators.exact import ExactTransition
from lfm_ppl.filtering.integrators.exponential import Exponential
from lfm_ppl.filtering.integrators.integrator import EqualSteps, Integrator
from lfm_ppl.filtering.integrators.quadrature import Quadrature
from lfm_ppl.filtering.integrators.runge_kutta import RungeKutta
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import SigmaPointRule
from lfm_ppl.model.integration_plan import LinearisedInputs
from lfm_ppl.model.state_space import StateSpaceModel

DEFAULT_METHOD = "runge-kutta"

METHODS: dict[str, EqualSteps] = {DEFAULT_METHOD: RungeKutta(), "exponential": Exponential()}
"""Value of ``method`` -> integrator of the steps of models that need some."""


def choose_integrator(ssm: StateSpaceModel, rule: Rule, method: str, tolerance: float | None) -> Integrator:
    """Return the integrator of a model.

    Args:
        ssm: the model.
        rule: the linearisation rule; with points in the full state it reads more than the forces.
        method: of integration, one of `METHODS`.
        tolerance: of the error of a step, in standard deviations; None: equal steps.
    """
    if ssm.plan.has_exact_transition:
        return ExactTransition()
    integrator = METHODS[method]
    uses_full_state = isinstance(rule, SigmaPointRule) and rule.full_state
    if integrator.is_explicit and not uses_full_state and ssm.plan.linearised is not LinearisedInputs.STATES:
        # The Jacobian K of the rest then reads only the forces, which only their own transition moves: K E K = 0.
        integrator = Quadrature()
    return integrator if tolerance is None else AdaptiveSteps(integrator, tolerance)
