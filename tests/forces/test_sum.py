"""Sums and stacks of forces, their means, and jumps."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import block_diag

from lfm_ppl.forces import Constant, Matern, WienerVelocity
from lfm_ppl.forces.sde import Stack


def test_a_sum_is_block_diagonal_and_adds():
    a, b, c = Matern(1.3, 0.7, 1, mean=2.0), Matern(0.4, 5.0, 2, mean=lambda t: 3.0 * t), WienerVelocity(0.5)
    total = a + b
    assert (total.state_dim, total.noise_dim) == (5, 2)
    for name in ("initial_covariance", "feedback", "dispersion"):
        assert_array_equal(getattr(total, name)(), block_diag(getattr(a, name)(), getattr(b, name)()))
    for name in ("transition", "process_noise"):
        assert_allclose(getattr(total, name)(0.3), block_diag(getattr(a, name)(0.3), getattr(b, name)(0.3)), rtol=1e-15)
    assert_array_equal(total.measurement(0.0), [1, 0, 1, 0, 0])
    assert_allclose([total.mean_at(0.5), total.mean(0.5)], 3.5)
    assert_array_equal(sum([a, b]).initial_covariance(), total.initial_covariance())
    lag = np.array([0.0, 0.2, 3.0])
    assert_allclose(total.covariance(lag), a.covariance(lag) + b.covariance(lag), rtol=1e-14)
    density = a.spectral_density(lag) + b.spectral_density(lag)
    assert_allclose(total.spectral_density(lag), density, rtol=1e-14)
    assert_allclose(total.sde_spectral_density(lag), density, rtol=1e-11)
    assert len(((a + b) + (a + c)).forces) == 4
    assert total.stationary and not (a + c).stationary


def test_a_stack_keeps_its_outputs_apart_and_may_be_empty():
    stack = Stack((Matern(1.3, 0.7, 1, mean=2.0), Constant(3.0) + WienerVelocity(1.0)))
    assert stack.state_dim == 5
    assert_array_equal(stack.measurement(0.0), [[1, 0, 0, 0, 0], [0, 0, 1, 1, 0]])
    assert_allclose(stack.mean_at(1.0), [2.0, 0.0])
    assert stack.initial_covariance().shape == stack.feedback().shape == (5, 5)
    assert stack.dispersion().shape == (5, 2)
    stack = Stack(())
    assert (stack.state_dim, stack.jump_times) == (0, ())
    assert (stack.measurement(0.0).shape, stack.mean_at(0.0).shape) == ((0, 0), (0,))
    assert [m.shape for m in stack.discretise(0.1)] == [(0, 0), (0, 0)]


def test_jumps_merge_in_time_and_leave_the_other_forces_alone(oscillator):
    early, late = oscillator(1.0, 1.0, (1.0, 3.0)), oscillator(1.0, 1.0, (2.0, 3.0))
    total = Constant(1.0) + early + late
    assert total.jump_times == (1.0, 2.0, 3.0) and Constant(1.0).jump_times == ()
    nothing = (np.eye(2), np.zeros((2, 2)))
    cases = [(early.jump(0), nothing), (nothing, late.jump(0)), (early.jump(1), late.jump(1))]
    for index, ((ga, qa), (gb, qb)) in enumerate(cases):
        g, q = total.jump(index)
        assert_array_equal(g, block_diag(np.eye(1), ga, gb))
        assert_array_equal(q, block_diag(np.zeros((1, 1)), qa, qb))
    with pytest.raises(IndexError):
        total.jump(3)
    with pytest.raises(NotImplementedError):
        total.sde_covariance(1.0)


def test_means_cross_jit_and_have_gradients():
    class Trend(eqx.Module):
        slope: jax.Array

        def __call__(self, t):
            return self.slope * t

    def value(slope):
        return (Matern(1.0, 1.0, mean=Trend(slope)) + Constant(1.0, mean=slope)).mean_at(4.0)

    assert_allclose(jax.grad(value)(jnp.array(2.0)), 5.0)
    force = Matern(1.0, 1.0, mean=lambda t: t**2)
    assert_allclose(jax.jit(lambda force, t: force.mean_at(t))(force, 3.0), 9.0)
    with pytest.raises(ValueError, match=r"\(2,\)"):
        Matern(1.0, 1.0, mean=lambda t: jnp.ones(2)).mean_at(0.0)
