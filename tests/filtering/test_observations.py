"""Observations of every kind, jumps of forces, and posterior linearisation."""

from __future__ import annotations

import warnings
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references import LinearLFM, Regression, gauss_hermite, matern
from systems import Kicked, Linear, Outputs, double_well, first_state, identity, motif, softplus

import lfm_ppl as lfm

TIMES = np.array([0.3, 1.0, 1.0, 2.5])
Y = np.array([0.4, 0.6, 0.5, 0.1])[:, None]
PRIOR = lfm.Gaussian(jnp.array([0.2]), jnp.array([0.3]))
ONE = (Linear(-0.7 * jnp.eye(1), jnp.ones((1, 1))), {"u": lfm.Matern(1.0, 1.3, 1)})


def dense(noise):
    process = LinearLFM(-0.7 * np.eye(1), np.ones((1, 1)), [matern(1.0, 1.3, 1)], 0.0, np.array([0.2]),
                        np.array([[0.3]]))
    return Regression(process, np.eye(1, 2), noise)


def test_covariance_for_each_time():
    noise = np.array([0.1, 0.2, 0.01, 0.4])[:, None]
    model = lfm.LatentForceModel(*ONE, lfm.GaussianObservation(first_state, jnp.asarray(noise)[:, :, None]), PRIOR,
                                 initial_time=0.0)
    result = lfm.smooth(model, TIMES, Y, at=[1.5])  # a requested time shifts the rows, not the covariances
    assert np.isclose(result.log_likelihood.sum(), dense(noise).log_likelihood(TIMES, Y), rtol=1e-10)


def test_full_covariance_and_missing_entries():
    """Correlated errors of two outputs; where one is missing the other has its marginal."""
    covariance = np.array([[0.2, 0.1], [0.1, 0.3]])
    model = lfm.LatentForceModel(*ONE, lfm.GaussianObservation(Outputs(jnp.eye(2)), jnp.asarray(covariance)), PRIOR,
                                 initial_time=0.0)
    y = np.c_[Y, [[0.1], [np.nan], [0.3], [0.0]]]
    y[3, 0] = np.nan
    mean, cov = dense(np.ones(1)).process.moments(TIMES)
    k = cov.transpose(0, 2, 1, 3).reshape(8, 8) + np.kron(np.eye(4), covariance)
    present = np.isfinite(y).ravel()
    residual, k = (y - mean).ravel()[present], k[np.ix_(present, present)]
    expected = -0.5 * (residual @ np.linalg.solve(k, residual) + np.linalg.slogdet(k)[1]
                       + len(residual) * np.log(2 * np.pi))
    assert np.isclose(lfm.filter(model, TIMES, y).log_likelihood.sum(), expected, rtol=1e-10)


@pytest.mark.parametrize("rule, points", [(lfm.GaussHermite(5), gauss_hermite(1, 5)), (lfm.Taylor(), None)])
def test_covariance_that_depends_on_the_state(rule, points):
    """One update by hand: R is averaged over the points, or taken at the mean."""
    model = lfm.LatentForceModel(
        *ONE, lfm.GaussianObservation(first_state, lambda x, u, t: 0.1 + 0.5 * x**2 + t), PRIOR)
    result = lfm.filter(model, [0.0], [[0.7]], rule=rule)
    nodes = np.array([0.2]) if points is None else 0.2 + np.sqrt(0.3) * points.nodes[:, 0]
    noise = (np.ones(1) if points is None else points.weights) @ (0.1 + 0.5 * nodes**2)
    s = 0.3 + noise
    assert np.isclose(result.log_likelihood[0], -0.5 * (0.25 / s + np.log(2 * np.pi * s)), rtol=1e-10)
    assert np.isclose(result.filtered_mean[0, 0], 0.2 + 0.3 / s * 0.5, rtol=1e-10)


@pytest.mark.filterwarnings("ignore:the angles 'y0' reach")
def test_angles_are_compared_on_the_circle():
    """Whole turns of the data change nothing, in the residual and beyond."""
    plain, angular = (lfm.LatentForceModel(
        *ONE, lfm.GaussianObservation(first_state, jnp.array([0.1]), angular=outputs), PRIOR, initial_time=0.0)
        for outputs in ((), (0,)))
    expected = lfm.filter(plain, TIMES, Y)
    for turns in (-2, 0, 3):
        turned = lfm.filter(angular, TIMES, Y + 2 * np.pi * turns)
        assert np.allclose(expected.log_likelihood, turned.log_likelihood, rtol=1e-10)
        assert np.allclose(expected.filtered_mean, turned.filtered_mean, atol=1e-12)


@pytest.mark.parametrize("period", [360.0, 24.0])
def test_angles_in_degrees_and_hours_are_compared_on_the_circle(period):
    """A model of angles in another unit is the model in radians, up to the Jacobian of the unit."""
    scale = period / (2 * np.pi)
    prior = lfm.Gaussian(scale * PRIOR.mean, scale**2 * PRIOR.covariance)
    radians, turned = (lfm.LatentForceModel(
        ONE[0], {"u": lfm.Matern(unit * 1.0, 1.3, 1)}, lfm.GaussianObservation(first_state, unit**2 * jnp.array([0.1]),
                                                                         angular=(0,), **options), start,
        initial_time=0.0) for unit, options, start in ((1.0, {}, PRIOR), (scale, {"period": period}, prior)))
    expected = lfm.filter(radians, TIMES, Y)
    result = lfm.filter(turned, TIMES, scale * Y + period * np.arange(len(Y))[:, None])
    assert np.allclose(result.log_likelihood, expected.log_likelihood - np.log(scale), rtol=1e-10)
    assert np.allclose(result.filtered_mean, scale * expected.filtered_mean, atol=1e-9)


def test_degrees_that_are_read_as_radians_are_named():
    y = np.array([[10.0, 350.0], [np.nan, 355.0], [2.0, 5.0]])

    def observed(angular, **options):
        return lfm.GaussianObservation(lambda x, u, t: x[:2], jnp.ones(2), angular, **options)

    with pytest.warns(UserWarning, match="'wind' reach 355.*period=360.*period=24"):
        observed((1,)).check_data(y, names=("speed", "wind"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        observed(()).check_data(y)
        observed((1,), period=360).check_data(y)
        observed((0, 1)).check_data(np.radians(y / 10))
    with pytest.raises(ValueError, match="period"):
        observed((1,), period=0.0)


def bearing(x, u, t):
    return jnp.arctan2(x[1:], x[:1])


@pytest.mark.parametrize("rule", [
    lfm.Taylor(), *(pytest.param(rule, marks=pytest.mark.slow) for rule in (lfm.Cubature(), lfm.GaussHermite(5)))],
    ids=lambda rule: rule.name)
def test_angles_are_averaged_on_the_circle(rule):
    """A bearing next to the branch cut at pi, and the same picture turned by half a circle."""

    def filter_angle(sign, angle):
        model = lfm.LatentForceModel(
            lambda x, u, t: -x, {}, lfm.GaussianObservation(bearing, jnp.array([0.01]), angular=(0,)),
            lfm.Gaussian(sign * jnp.array([-1.0, 0.01]), 0.01 * jnp.eye(2)))
        return lfm.filter(model, [0.0], [[angle]], rule=rule)

    cut, opposite = filter_angle(1.0, np.pi - 0.05), filter_angle(-1.0, -0.05)
    assert np.allclose(cut.log_likelihood, opposite.log_likelihood, rtol=1e-9)
    assert np.allclose(cut.filtered_mean, -opposite.filtered_mean, rtol=1e-9)
    assert np.allclose(cut.filtered_covariance, opposite.filtered_covariance, rtol=1e-9)


def square_observed(x, u, t):
    return x**2 + 0.5 * u


def test_non_linear_observation_by_points():
    """Moments of y = x^2 + u / 2 under the prior, in closed form."""
    model = lfm.LatentForceModel(*ONE, lfm.GaussianObservation(square_observed, jnp.array([0.1])), PRIOR)
    result = lfm.filter(model, [0.0], [[0.7]], rule=lfm.GaussHermite(3))
    m, v = 0.2, 0.3
    mean, variance = m**2 + v, 4 * m**2 * v + 2 * v**2 + 0.25 + 0.1
    assert np.isclose(result.log_likelihood[0], -0.5 * ((0.7 - mean) ** 2 / variance + np.log(2 * np.pi * variance)),
                      rtol=1e-10)
    assert np.isclose(result.filtered_mean[0, 0], m + 2 * m * v / variance * (0.7 - mean), rtol=1e-10)


@pytest.mark.parametrize("link", [identity, pytest.param(softplus, marks=pytest.mark.slow)])
def test_jumps(link):
    """Across a jump the covariance function shrinks by the share; a jump comes before an observation at its time."""
    kicks, share = (0.6, 1.0, 2.0, 9.0), 0.3
    force = Kicked(share, kicks, 1.0, 1.3, 1)

    def kernel(t, s):
        crossed = sum(((np.minimum(t, s) < kick) & (kick <= np.maximum(t, s))) * 1.0 for kick in kicks)
        return matern(1.0, 1.3, 1)(t, s) * share**crossed

    model = lfm.LatentForceModel(ONE[0], {"u": force}, lfm.GaussianObservation(first_state, jnp.array([0.1])), PRIOR,
                                 initial_time=0.0)
    if link is identity:
        requested_times = np.array([0.5, 0.6, 1.7, 2.0, 3.0])
        reference = dense(np.array([0.1]))
        reference.process.kernels, reference.process.breaks = [kernel], kicks[:3]
        result = lfm.smooth(model, TIMES, Y, at=requested_times)
        mean, cov = reference.posterior(TIMES, Y, requested_times)
        assert np.isclose(result.log_likelihood.sum(), reference.log_likelihood(TIMES, Y), rtol=1e-9)
        assert np.allclose(result.input_mean, mean, atol=1e-9)
        assert np.allclose(result.input_covariance, cov[np.arange(5), np.arange(5)], atol=1e-9)
        assert np.allclose(result.leave_one_out, reference.leave_one_out(TIMES, Y), rtol=1e-8)
    else:
        nonlinear = eqx.tree_at(lambda m: m.forces["u"], motif(softplus, genes=1), force)
        # Without memory a jump makes everything that the force knew irrelevant.
        result = lfm.filter(nonlinear, TIMES, Y)
        without_jumps = lfm.filter(motif(softplus, genes=1), TIMES, Y)
        assert np.isclose(result.log_likelihood[0], without_jumps.log_likelihood[0], rtol=1e-10)  # before any jump
        assert abs(result.log_likelihood[3] - without_jumps.log_likelihood[3]) > 1e-3
        stationary = np.asarray(force.initial_covariance())
        alone = lfm.filter(nonlinear, [5.0], [[0.4]])
        assert np.abs(alone.predicted_covariance[0, 1:, 1:] - stationary).max() < 1e-10


@pytest.mark.slow
def test_iterations_change_nothing_on_a_linear_model():
    model = motif(identity, genes=1)
    plain, iterated = (lfm.smooth(model, TIMES, Y, iterations=n) for n in (0, 2))
    for name in ("mean", "covariance", "log_likelihood", "leave_one_out"):
        assert np.allclose(getattr(plain, name), getattr(iterated, name), atol=1e-9), name
    assert iterated.change < 1e-9 and np.isnan(plain.change)


def exponential_of_force(x, u, t):
    return jnp.exp(u)


def test_iterations_find_the_posterior_linearisation_of_dense_algebra():
    """y = exp(u) + e: each y linearised about its posterior marginal, and the Gaussian process conditioned on all."""
    empty = jnp.zeros((0, 0))
    model = lfm.LatentForceModel(
        Linear(empty, jnp.zeros((0, 1)), jnp.zeros(0)), {"u": lfm.Matern(0.8, 1.0, 1)},
        lfm.GaussianObservation(exponential_of_force, jnp.array([0.05])), lfm.Gaussian(jnp.zeros(0), empty),
        initial_time=0.0)
    y = np.array([1.5, 0.8, 0.7, 2.0])
    k = matern(0.8, 1.0, 1)(TIMES[:, None], TIMES)
    mean, variance = np.zeros(4), np.diag(k)
    for _ in range(300):
        value = np.exp(mean + variance / 2)  # E exp(u); A = E exp(u), Cov = (exp(v) - 1) value^2
        residual = value**2 * (np.exp(variance) - 1 - variance)
        a = np.diag(value)
        s = a @ k @ a + np.diag(residual + 0.05)
        innovation = y - value + value * mean
        gain = np.linalg.solve(s, a @ k).T
        mean = 0.5 * mean + 0.5 * gain @ innovation
        variance = 0.5 * variance + 0.5 * np.diag(k - gain @ a @ k)
    log_likelihood = -0.5 * (innovation @ np.linalg.solve(s, innovation) + np.linalg.slogdet(s)[1]
                             + 4 * np.log(2 * np.pi))
    result = lfm.smooth(model, TIMES, y[:, None], rule=lfm.GaussHermite(15), steps=1, iterations=200, damping=0.5)
    assert result.change < 1e-8
    assert np.allclose(result.force("u").mean, mean, atol=1e-7)
    assert np.allclose(result.force("u").sd ** 2, variance, atol=1e-7)
    assert np.isclose(result.log_likelihood.sum(), log_likelihood, rtol=1e-7)


@pytest.mark.slow
def test_iterations_that_go_back_and_forth_meet():
    """With a fixed share of 0.7 or 1 those of some records change for ever, by 1.5 and 3.4 standard deviations."""
    model, times = double_well(mean=0.0, variance=1.0, dispersion=1.0), np.arange(2.0, 18.0, 2.0)
    keys = jax.random.split(jax.random.key(0), 16)
    records = jnp.stack([lfm.simulate(key, model, times).y for key in keys])

    @partial(jax.jit, static_argnums=1)
    def changes(records, share):
        smooth = partial(lfm.smooth, model, times, steps=20, iterations=24, damping=share)
        return jax.lax.map(lambda y: smooth(y).change, records)

    damped, full = np.asarray(changes(records, 0.7)), np.asarray(changes(records, 1.0))
    assert damped.max() < 0.01 and np.median(damped) < 1e-3
    assert full.max() < 0.5 and np.median(full) < 0.01


@pytest.fixture(scope="module")
def draws():
    model = lfm.LatentForceModel(*ONE, lfm.GaussianObservation(first_state, jnp.array([0.1])), PRIOR, initial_time=0.0)
    requested_times = np.array([0.0, 0.7, 1.0, 1.8, 4.0])
    result = lfm.smooth(model, TIMES, Y, at=requested_times)
    sample = result.sample(jax.random.key(0), 4000)
    return requested_times, np.concatenate([sample.state, sample.forces["u"][:, :, None]], axis=2)


def test_trajectories_have_the_joint_posterior(draws):
    """Mean, and covariance between all times, of x and u, within the Monte Carlo error."""
    requested_times, sample = draws
    mean, cov = dense(np.array([0.1])).posterior(TIMES, Y, requested_times)
    flat = sample.reshape(len(sample), -1)
    expected = cov.transpose(0, 2, 1, 3).reshape(flat.shape[1], -1)
    sd = np.sqrt(np.diag(expected))
    count = len(flat)
    z = (flat.mean(0) - mean.ravel()) / (sd / np.sqrt(count))
    assert np.abs(z).max() < 4.5  # of 10 standard normals, p < 1e-4
    variance_of_entry = (expected**2 + np.outer(sd, sd) ** 2) / count
    z = (np.cov(flat.T) - expected) / np.sqrt(variance_of_entry)
    assert np.abs(z).max() < 4.5
