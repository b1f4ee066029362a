r"""The plan of integration of a model: what is exact, what is integrated in steps, what is linearised.

Over an interval without an observation the joint state moves by

    s -> phi s + offset + N(0, process_cov).

1. What of this map is exact is tabulated by the length of the interval: phi where the coefficients of the dynamics are
   constant, process_cov where the dispersion is constant as well, the offset where the additive terms are.
2. The rest is integrated in steps. Where the dynamics is linearised in forces only, their moments at all nodes are
   known, so that the steps are a quadrature (`lfm_ppl.filtering.integrators.quadrature`).
3. Where dynamics and observation are linear, no pass depends on the moments about which it is linearised.

`state_space` makes the plan once, from the structure of the model's functions. `choose_integrator` in
`lfm_ppl.filtering.integrators.methods` reads it, and so does everything else that depends on linearity or on time.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

from lfm_ppl.linearisation.input_selection import InputStructure
from lfm_ppl.model.latent_force_model import LatentForceModel


class Dependence(enum.IntEnum):
    """What a term of the model depends on; a term that depends on the state may depend on time as well."""

    NOTHING = 0
    TIME = 1
    STATE = 2


class LinearisedInputs(enum.Enum):
    """Inputs in which the dynamics is linearised: it is not linear in them, or their coefficient varies."""

    NONE = "none"
    FORCES = "forces"
    STATES = "states, perhaps forces"


@dataclass(frozen=True)
class IntegrationPlan:
    """How the moments of a model are computed; the fields are facts, the properties decisions.

    Attributes:
        linearised: inputs in which the dynamics is linearised.
        coefficients: what the Jacobian of the dynamics in the joint state depends on.
        additive: what the additive terms of the dynamics depend on, known inputs and means of forces.
        dispersion: what the process noise depends on; TIME stands for any function.
        is_autonomous: whether the dynamics is one function of the joint state at all times.
        has_exact_moments: whether coefficients are constant, and additive terms and dispersion at most quadratic in
            time between the breakpoints of known inputs, so that the steps over them are exact.
        observation: what the Jacobian of the observation depends on.
        observation_noise: what the covariance of Gaussian noise depends on.
        is_angular: whether an output is an angle, whose residual is reduced.
    """

    linearised: LinearisedInputs
    coefficients: Dependence
    additive: Dependence
    dispersion: Dependence
    is_autonomous: bool
    has_exact_moments: bool
    observation: Dependence
    observation_noise: Dependence
    is_angular: bool

    @property
    def has_exact_transition(self) -> bool:
        """Whether phi is exact; only additive terms and the dispersion may depend on time."""
        return self.coefficients is Dependence.NOTHING

    @property
    def has_exact_noise(self) -> bool:
        """Whether phi and process_cov are exact; only additive terms may depend on time."""
        return self.has_exact_transition and self.dispersion is Dependence.NOTHING

    @property
    def has_exact_offset(self) -> bool:
        """Whether phi, process_cov and the offset are exact, so that nothing is integrated in steps."""
        return self.has_exact_noise and self.additive is Dependence.NOTHING

    @property
    def has_exact_update(self) -> bool:
        """Whether an update by Gaussian noise is exact: linear, without angles, with noise of no state."""
        return self.observation is self.observation_noise is Dependence.NOTHING and not self.is_angular

    @property
    def is_linear(self) -> bool:
        """Whether no pass depends on the moments about which the model is linearised."""
        return self.linearised is LinearisedInputs.NONE and self.has_exact_update

    @property
    def has_normal_states(self) -> bool:
        """Whether a normal state stays normal; the coefficients of the dynamics may depend on time."""
        return self.coefficients <= Dependence.TIME

    @property
    def has_normal_outputs(self) -> bool:
        """Whether outputs with Gaussian noise are normal where the state is; their Jacobian may depend on time."""
        is_constant = self.observation_noise is Dependence.NOTHING
        return self.observation <= Dependence.TIME and is_constant and not self.is_angular

    @property
    def has_fixed_weights(self) -> bool:
        """Whether the log density of a trajectory is quadratic, with weights that are the same for all trajectories."""
        return (self.linearised is LinearisedInputs.NONE and self.dispersion is Dependence.NOTHING
                and self.observation is self.observation_noise is Dependence.NOTHING)


def integration_plan(model: LatentForceModel, drift: InputStructure, observation: InputStructure,
                     constant_measurement: bool, constant_mean: bool) -> IntegrationPlan:
    """Return the plan of a model; arguments besides the model as in `lfm_ppl.model.state_space.StateSpaceModel`."""
    size = len(model.state_names)
    inputs = (*drift.nonlinear, *drift.averaged)
    linearised = (LinearisedInputs.NONE if not inputs else
                  LinearisedInputs.FORCES if min(inputs) >= size else LinearisedInputs.STATES)
    uses_forces = any(any(row[size:]) for row in drift.jacobian)
    if linearised is not LinearisedInputs.NONE:
        coefficients = Dependence.STATE if drift.nonlinear else Dependence.TIME
    else:
        coefficients = Dependence.NOTHING if constant_measurement or not uses_forces else Dependence.TIME
    additive = Dependence.TIME if drift.offset_varies or not constant_mean else Dependence.NOTHING
    dispersion = Dependence.TIME if callable(model.process_noise) else Dependence.NOTHING
    is_invariant = additive is dispersion is Dependence.NOTHING
    return IntegrationPlan(
        linearised, coefficients, additive, dispersion, constant_measurement and is_invariant,
        coefficients is Dependence.NOTHING and (is_invariant or model.has_quadratic_inputs),
        Dependence.STATE if observation.nonlinear else
        Dependence.TIME if observation.averaged else Dependence.NOTHING,
        Dependence.STATE if model.observation.varies_with_state else Dependence.NOTHING,
        bool(model.observation.angular))
