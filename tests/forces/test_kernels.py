"""Covariance and spectral density of each force against independent formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad
from scipy.special import gamma, kv

from lfm_ppl.forces import Constant, Matern, SquaredExponential, WienerVelocity

ORDERS = range(6)


@pytest.mark.parametrize("order", ORDERS)
def test_matern_is_the_published_process(order):
    """Its covariance by Bessel functions, its spectral density, and its noise where the formula changes."""
    lag = np.array([0.01, 0.3, 1.0, 2.5, 10.0])
    nu, scale, ell = order + 0.5, 1.7, 0.8
    force = Matern(scale, ell, order)
    x = np.sqrt(2 * nu) * lag / ell
    assert_allclose(force.covariance(lag), scale**2 * 2 ** (1 - nu) / gamma(nu) * x**nu * kv(nu, x), rtol=1e-12)
    assert_allclose(force.covariance(0.0), scale**2, rtol=1e-14)
    lam = np.sqrt(2 * order + 1) / ell
    q = scale**2 * 2 * np.sqrt(np.pi) * lam ** (2 * order + 1) * gamma(order + 1) / gamma(order + 0.5)
    omega = np.array([0.0, 0.3, 2.0, -2.0, 40.0])
    expected = q / (lam**2 + omega**2) ** (order + 1)
    assert_allclose(force.spectral_density(omega), expected, rtol=1e-12)
    assert_allclose(force.sde_spectral_density(omega), expected, rtol=1e-11)
    edge = min(order + 1.0, 5.0) / lam
    below, above = jax.jit(jax.vmap(force.process_noise))(edge * (1 + np.array([-1e-12, 1e-12])))
    assert_allclose(below, above, rtol=1e-10, atol=1e-12)


def test_spectral_density_of_the_squared_exponential_integrates_to_the_variance():
    force = SquaredExponential(1.7, 0.8)
    density = jax.jit(lambda omega: force.spectral_density(omega))
    total = quad(lambda omega: float(density(omega)), 0, np.inf, epsabs=1e-9)[0] / np.pi
    assert_allclose(total, 1.7**2, rtol=1e-6)


@pytest.mark.parametrize(("make", "order"), [(Matern, 2), (Matern, 5), (SquaredExponential, 6)])
def test_nothing_depends_on_the_unit_of_time_and_a_long_gap_forgets_everything(make, order):
    @jax.jit
    @jax.vmap
    def parts(ell, x):
        force = make(2.0, ell, order)
        return *force.discretise(x * ell), force.initial_covariance()

    x = np.array([1e-6, 0.7, 1e3, 1e6, 1e200])
    expected = parts(np.ones(5), x)
    for ell in (1e-8, 1e8):
        for result, reference in zip(parts(np.full(5, ell), x), expected, strict=True):
            assert_allclose(result, reference, rtol=1e-10, atol=1e-25)
    transition, noise, covariance = expected
    assert_allclose(transition[2:], 0.0, atol=1e-25)
    assert_allclose(noise[2:], covariance[2:], rtol=1e-13, atol=1e-12)


def test_wiener_velocity_covariance_by_double_integration():
    force = WienerVelocity(1.5, 0.3, 0.8)
    t, s = 2.0, 0.7
    driven = quad(lambda r: (t - r) * (s - r), 0.0, s)[0]
    assert_allclose(force.covariance(t, s), 0.3**2 + 0.8**2 * t * s + 1.5**2 * driven, rtol=1e-12)
    assert_allclose(WienerVelocity(1.5).covariance(2.0, 2.0), 1.5**2 * 8 / 3, rtol=1e-12)


def test_densities_that_do_not_exist_are_errors(oscillator):
    for force, method in ((WienerVelocity(1.0), "spectral_density"), (WienerVelocity(1.0), "sde_spectral_density"),
                          (Constant(1.0), "spectral_density"), (Constant(1.0), "sde_spectral_density"),
                          (oscillator(1.0, 1.0), "covariance"), (oscillator(1.0, 1.0), "spectral_density")):
        with pytest.raises(NotImplementedError):
            getattr(force, method)(1.0)


def test_default_covariance_and_density_from_the_state_space_form(oscillator):
    # A critically damped oscillator is the Matern process of order 1 with lam = 1/lengthscale.
    force, matern = oscillator(2.0, 1.0), Matern(2.0, np.sqrt(3.0), 1)
    lag = np.array([0.0, 0.4, -2.0])
    assert_allclose(force.sde_covariance(lag), matern.covariance(lag), rtol=1e-12)
    omega = np.array([0.0, 1.0, 7.0])
    assert_allclose(force.sde_spectral_density(omega), matern.spectral_density(omega), rtol=1e-12)


def test_second_derivatives_exist():
    slope = jax.jit(jax.grad(lambda ell: SquaredExponential(1.0, ell, 4).process_noise(0.8)[0, 0]))
    h = 1e-4
    assert_allclose(jax.jacfwd(slope)(jnp.array(0.9)), (slope(0.9 + h) - slope(0.9 - h)) / (2 * h), rtol=1e-6)
