"""The plan of integration: what is exact, what is integrated and what is linearised, for one model of each kind."""

import jax
import jax.numpy as jnp
import pytest
from systems import whole_state

import lfm_ppl as lfm
from lfm_ppl.model.integration_plan import Dependence, LinearisedInputs
from lfm_ppl.model.state_space import state_space

NOISE = jnp.array([0.1])
RAIN = lfm.Input([0.0, 1.0, 2.0], [0.0, 1.0, 0.5], "linear")


def plan_of(dynamics, forces=None, noise=None, observation=None):
    forces = {"u": lfm.Matern(1.0, 1.0)} if forces is None else forces
    observation = lfm.GaussianObservation(whole_state, NOISE) if observation is None else observation
    model = lfm.LatentForceModel(dynamics, forces, observation, lfm.Gaussian(jnp.ones(1), jnp.eye(1)), noise)
    return state_space(model).plan


def linear(x, u, t):
    return u - x


# Its kernel is not stationary, so that its measurement depends on time.
MODERATED = {"u": lfm.Periodic(lfm.forces.ModeratedPeriodicMatern(1.0, 1.0, 4.0), functions=8)}
COSINE = {"u": lfm.Periodic(lfm.forces.PeriodicMatern(1.0, 1.0, 4.0), functions=9, mean=jnp.cos)}
# dynamics, forces, process noise -> exact transition, noise, offset, moments
EXACT = {
    "constant": ((linear,), (True, True, True, True)),
    "constant noise": ((linear, None, jnp.eye(1)), (True, True, True, True)),
    "table": ((lambda x, u, t: u - x + RAIN(t),), (True, True, False, True)),
    "sine": ((lambda x, u, t: u - x + jnp.sin(t),), (True, True, False, False)),
    "noise in time": ((linear, None, lambda x, u, t: (1.0 + t) * jnp.eye(1)), (True, False, False, True)),
    "mean of a force": ((linear, COSINE), (True, True, False, False)),
    "force in time": ((linear, MODERATED), (False, False, False, False)),
    "force in time, unused": ((lambda x, u, t: -x, MODERATED), (True, True, True, True)),
    "coefficient in time": ((lambda x, u, t: u - (1.0 + t) * x,), (False, False, False, False)),
    "link": ((lambda x, u, t: jnp.exp(u) - x,), (False, False, False, False)),
}


@pytest.mark.parametrize("name", EXACT)
def test_exact_parts_of_the_transition(name):
    arguments, expected = EXACT[name]
    plan = plan_of(*arguments)
    assert (plan.has_exact_transition, plan.has_exact_noise, plan.has_exact_offset, plan.has_exact_moments) == expected


@pytest.mark.parametrize(("dynamics", "noise", "linearised", "coefficients"), [
    (linear, None, LinearisedInputs.NONE, Dependence.NOTHING),
    (lambda x, u, t: jnp.exp(u) - x, None, LinearisedInputs.FORCES, Dependence.STATE),
    (lambda x, u, t: t * u - x, None, LinearisedInputs.FORCES, Dependence.TIME),
    (lambda x, u, t: u - t * x, None, LinearisedInputs.STATES, Dependence.TIME),
    (lambda x, u, t: u * x, None, LinearisedInputs.STATES, Dependence.STATE),
    (linear, lambda x, u, t: x[None], LinearisedInputs.STATES, Dependence.STATE),
    (linear, lambda x, u, t: u[None], LinearisedInputs.FORCES, Dependence.STATE)])
def test_linearised_inputs(dynamics, noise, linearised, coefficients):
    plan = plan_of(dynamics, noise=noise)
    assert (plan.linearised, plan.coefficients) == (linearised, coefficients)
    assert plan.is_linear == (linearised is LinearisedInputs.NONE)
    assert plan.has_normal_states == (coefficients is not Dependence.STATE)


@pytest.mark.parametrize(("observation", "has_exact_update", "has_normal_outputs", "has_fixed_weights"), [
    (lfm.GaussianObservation(whole_state, NOISE), True, True, True),
    (lfm.GaussianObservation(lambda x, u, t: t * x, NOISE), False, True, False),
    (lfm.GaussianObservation(lambda x, u, t: x**2, NOISE), False, False, False),
    (lfm.GaussianObservation(whole_state, NOISE, angular=(0,)), False, False, True),
    (lfm.GaussianObservation(whole_state, lambda x, u, t: 0.1 + x**2), False, False, False),
    (lfm.PoissonObservation(whole_state), True, True, True)])
def test_observation(observation, has_exact_update, has_normal_outputs, has_fixed_weights):
    plan = plan_of(linear, observation=observation)
    assert (plan.has_exact_update, plan.has_normal_outputs, plan.has_fixed_weights) == (
        has_exact_update, has_normal_outputs, has_fixed_weights)
    assert plan.is_linear == has_exact_update


def test_autonomous():
    assert plan_of(lambda x, u, t: jax.nn.softplus(u) - x).is_autonomous
    assert not plan_of(lambda x, u, t: jax.nn.softplus(u) - x + t).is_autonomous
    assert not plan_of(lambda x, u, t: jax.nn.softplus(u) - x, MODERATED).is_autonomous
