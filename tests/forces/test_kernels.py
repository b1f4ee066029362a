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
SDE_ORDERS = SquaredExponential.orders


@pytest.mark.parametrize("order", ORDERS)
def test_matern_covariance_is_the_bessel_formula(order):
    lag = np.array([0.01, 0.3, 1.0, 2.5, 10.0])
    nu, scale, ell = order + 0.5, 1.7, 0.8
    x = np.sqrt(2 * nu) * lag / ell
    expected = scale**2 * 2 ** (1 - nu) / gamma(nu) * x**nu * kv(nu, x)
    force = Matern(scale, ell, order)
    assert_allclose(force.covariance(lag), expected, rtol=1e-12)
    assert_allclose(force.covariance(0.0), scale**2, rtol=1e-14)


@pytest.mark.parametrize("order", ORDERS)
def test_matern_spectral_density_is_the_published_one(order):
    scale, ell = 1.7, 0.8
    lam = np.sqrt(2 * order + 1) / ell
    q = scale**2 * 2 * np.sqrt(np.pi) * lam ** (2 * order + 1) * gamma(order + 1)
    q /= gamma(order + 0.5)
    omega = np.array([0.0, 0.3, 2.0, -2.0, 40.0])
    force = Matern(scale, ell, order)
    expected = q / (lam**2 + omega**2) ** (order + 1)
    assert_allclose(force.spectral_density(omega), expected, rtol=1e-12)
    assert_allclose(force.sde_spectral_density(omega), expected, rtol=1e-11)


@pytest.mark.parametrize(
    "force", [Matern(1.7, 0.8, p) for p in (0, 2)] + [SquaredExponential(1.7, 0.8)]
)
def test_spectral_density_integrates_to_the_variance(force):
    total = 2 * quad(lambda w: float(force.spectral_density(w)), 0, np.inf, epsabs=1e-9)[0]
    assert_allclose(total / (2 * np.pi), 1.7**2, rtol=1e-6)


@pytest.mark.parametrize("make", [Matern, SquaredExponential])
def test_nothing_depends_on_the_unit_of_time(make):
    orders = ORDERS if make is Matern else SDE_ORDERS
    for order in orders:
        reference = make(2.0, 1.0, order)
        for ell in (1e-8, 1e8):
            force = make(2.0, ell, order)
            assert_allclose(force.initial_covariance(), reference.initial_covariance(), rtol=1e-14)
            for x in (1e-6, 0.7, 1e3):
                for got, expected in zip(
                    force.discretise(x * ell), reference.discretise(x), strict=True
                ):
                    assert_allclose(got, expected, rtol=1e-10, atol=1e-25)


@pytest.mark.parametrize("make", [Matern, SquaredExponential])
def test_a_long_gap_forgets_everything(make):
    for order in ORDERS if make is Matern else SDE_ORDERS:
        force = make(2.0, 0.5, order)
        for gap in (500.0, 5e5, 1e200):
            transition, noise = force.discretise(gap)
            assert_allclose(transition, 0.0, atol=1e-25)
            assert_allclose(noise, force.initial_covariance(), rtol=1e-13, atol=1e-12)


def test_wiener_velocity_covariance_by_double_integration():
    force = WienerVelocity(1.5, 0.3, 0.8)
    t, s = 2.0, 0.7
    driven = quad(lambda r: (t - r) * (s - r), 0.0, s)[0]
    expected = 0.3**2 + 0.8**2 * t * s + 1.5**2 * driven
    assert_allclose(force.covariance(t, s), expected, rtol=1e-12)
    assert_allclose(WienerVelocity(1.5).covariance(2.0, 2.0), 1.5**2 * 8 / 3, rtol=1e-12)


def test_spectral_densities_that_do_not_exist_say_so(oscillator):
    with pytest.raises(NotImplementedError, match="not stationary.*covariance"):
        WienerVelocity(1.0).spectral_density(1.0)
    with pytest.raises(NotImplementedError, match="not stationary.*sde_covariance"):
        WienerVelocity(1.0).sde_spectral_density(1.0)
    for method in (Constant(1.0).spectral_density, Constant(1.0).sde_spectral_density):
        with pytest.raises(NotImplementedError, match="frequency zero"):
            method(1.0)
    with pytest.raises(NotImplementedError, match="sde_covariance"):
        oscillator(1.0, 1.0).covariance(1.0)
    with pytest.raises(NotImplementedError, match="sde_spectral_density"):
        oscillator(1.0, 1.0).spectral_density(1.0)


def test_default_covariance_and_density_from_the_state_space_form(oscillator):
    # A critically damped oscillator is the Matern process of order 1 with lam = 1/lengthscale.
    force, matern = oscillator(2.0, 1.0), Matern(2.0, np.sqrt(3.0), 1)
    lag = np.array([0.0, 0.4, -2.0])
    assert_allclose(force.sde_covariance(lag), matern.covariance(lag), rtol=1e-12)
    omega = np.array([0.0, 1.0, 7.0])
    assert_allclose(force.sde_spectral_density(omega), matern.spectral_density(omega), rtol=1e-12)


@pytest.mark.parametrize("order", ORDERS)
def test_matern_noise_is_continuous_where_its_formula_changes(order):
    force = Matern(1.0, np.sqrt(2 * order + 1), order)
    edge = min(order + 1.0, 5.0)
    below, above = (force.process_noise(edge * (1 + e)) for e in (-1e-12, 1e-12))
    assert_allclose(below, above, rtol=1e-10, atol=1e-13)


def test_second_derivatives_exist():
    def noise(ell):
        return SquaredExponential(1.0, ell, 4).process_noise(0.8)[0, 0]

    h = 1e-4
    difference = (jax.grad(noise)(0.9 + h) - jax.grad(noise)(0.9 - h)) / (2 * h)
    assert_allclose(jax.hessian(noise)(jnp.array(0.9)), difference, rtol=1e-6)
