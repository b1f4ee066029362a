"""What holds for every method of integration: convergence, maps, records, and steps that follow a tolerance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import whole_state

import lfm_ppl as lfm
from lfm_ppl.filtering.dynamics import Dynamics
from lfm_ppl.filtering.integrators.adaptive import AdaptiveSteps
from lfm_ppl.filtering.integrators.exact import ExactTransition
from lfm_ppl.filtering.integrators.integrator import Section, Stepping
from lfm_ppl.filtering.integrators.methods import METHODS, choose_integrator
from lfm_ppl.filtering.integrators.runge_kutta import RungeKutta
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.transition import linear_part
from lfm_ppl.model.state_space import Span, state_space

LENGTH = 0.8


def ssm_of(dynamics, noise=None):
    return state_space(lfm.LatentForceModel(
        dynamics, {"u": lfm.Matern(1.0, 1.5, order=1)}, lfm.GaussianObservation(whole_state, jnp.ones(2)),
        lfm.Gaussian(jnp.array([0.5, -0.2]), jnp.array([[0.2, 0.05], [0.05, 0.1]])), process_noise=noise))


CUBIC = ssm_of(lambda x, u, t: jnp.stack([x[1], u[0] - x[0] - 0.5 * x[0]**3 - 0.3 * x[1] + jnp.cos(t)]),
                    0.2 * jnp.eye(2))
LINEAR = ssm_of(lambda x, u, t: jnp.stack([x[1], u[0] - x[0] - 0.3 * x[1]]), 0.2 * jnp.eye(2))


def predict(integrator, ssm, steps, record=Record.SMOOTHER):
    dynamics, length = Dynamics(ssm, lfm.Cubature(), linear_part(ssm, jnp.zeros(()))), jnp.asarray(LENGTH)
    interval = Section(Span.between(0.3, 0.3 + LENGTH, LENGTH), length, Moments(*ssm.initial()))

    @jax.jit
    def run(interval):
        return integrator.predict(dynamics, integrator.tabulate(dynamics, length, steps), interval, steps, record)

    return run(interval)


def error(prediction, reference):
    return max(float(jnp.abs(a - b).max()) for a, b in zip(prediction.moments, reference.moments, strict=True))


@pytest.mark.thorough
@pytest.mark.parametrize("method", METHODS)
def test_moments_converge_with_the_steps(method):
    reference = predict(RungeKutta(), CUBIC, 200)
    coarse, fine = (error(predict(METHODS[method], CUBIC, steps), reference) for steps in (8, 16))
    assert fine < 1e-3
    assert fine < coarse / 3.0, "of order two at least"


@pytest.mark.thorough
@pytest.mark.parametrize("method", METHODS)
def test_a_prediction_is_its_map_and_records_its_steps(method):
    start = Moments(*CUBIC.initial())
    smoother = predict(METHODS[method], CUBIC, 4)
    composed = smoother.phi @ start.covariance @ smoother.phi.T + smoother.process_cov
    np.testing.assert_allclose(smoother.moments.covariance, composed, rtol=1e-10, atol=1e-12)
    assert np.linalg.eigvalsh(smoother.process_cov).min() > -1e-14
    recorded = predict(METHODS[method], CUBIC, 4, Record.LINEARIZATION)
    np.testing.assert_allclose(recorded.moments.mean, smoother.moments.mean, rtol=1e-12)
    assert recorded.nodes.phi.shape == (4, CUBIC.state_dim, CUBIC.state_dim)
    np.testing.assert_allclose(np.linalg.multi_dot(recorded.nodes.phi[::-1]), smoother.phi, rtol=1e-10, atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("method", METHODS)
def test_adaptive_steps_reach_their_tolerance(method):
    reference = predict(RungeKutta(), CUBIC, 200)
    adaptive = choose_integrator(CUBIC, lfm.Cubature(), method, 1e-4)
    assert adaptive == AdaptiveSteps(METHODS[method], 1e-4)
    assert adaptive.stepping is Stepping.ADAPTIVE
    assert not adaptive.is_explicit
    assert error(predict(adaptive, CUBIC, 40), reference) < 1e-4


@pytest.mark.parametrize("method", METHODS)
def test_a_linear_model_takes_its_exact_transition(method):
    assert all(choose_integrator(LINEAR, lfm.Cubature(), method, tolerance) == ExactTransition()
               for tolerance in (None, 1e-3))
    assert error(predict(METHODS[method], LINEAR, 20), predict(ExactTransition(), LINEAR, 20)) < 1e-3
