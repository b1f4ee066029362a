"""Filter and smoother with forces that repeat and jump, against dense Gaussian process algebra."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references import LinearLFM, Regression
from systems import Linear, first_state, softplus

import lfm_ppl as lfm
from lfm_ppl import forces
from lfm_ppl.studies.periodic_kernels.resonators import resonators

# Few functions make small tests.
pytestmark = pytest.mark.filterwarnings("ignore:a periodic force keeps")

PERIOD, POINTS = 3.0, (3.0, 6.0)
TIMES = np.array([0.3, 1.0, 1.0, 2.5, 3.0, 4.4, 6.0, 7.7])
Y = np.array([0.4, 0.6, 0.5, 0.1, np.nan, -0.3, 0.2, 0.9])[:, None]
AT = np.array([0.0, 1.7, 3.0, 3.5, 6.0, 8.5])
EVOLUTIONS = {"constant": lfm.Constant(1.0), "CQM": forces.CQM(5.0), "SQM": forces.SQM(1.5, POINTS),
              "WQM": forces.WQM(0.5, POINTS), "Matern-5/2": lfm.Matern(1.0, 4.0, order=2)}


def kernel(lengthscale=1.5, period=PERIOD):
    return forces.PeriodicSquaredExponential(1.0, lengthscale, period)


def exact(evolution):
    """The product of the published kernels, in NumPy."""

    def product(t, s):
        cycle = [(np.asarray(x)[..., None] >= np.asarray(POINTS)).sum(-1) for x in (t, s)]
        lag = np.abs(t - s)
        weight = {"constant": 1.0, "CQM": np.exp(-lag / 5.0), "SQM": np.exp(-np.abs(cycle[0] - cycle[1]) / 1.5),
                  "WQM": 1.0 + 0.5 * np.minimum(*cycle),
                  "Matern-5/2": (lambda x: (1 + x + x * x / 3) * np.exp(-x))(np.sqrt(5) * lag / 4.0)}[evolution]
        return np.exp(-((np.sin(np.pi * (t - s) / PERIOD) / 1.5) ** 2)) * weight

    return product


def model(force, dynamics=None):
    return lfm.LatentForceModel(
        dynamics or Linear(-0.7 * jnp.eye(1), jnp.ones((1, 1))), {"u": force},
        lfm.GaussianObservation(first_state, jnp.array([0.1])), lfm.Gaussian(jnp.array([0.2]), jnp.array([0.3])),
        initial_time=0.0)


def dense(evolution):
    process = LinearLFM(-0.7 * np.eye(1), np.ones((1, 1)), [exact(evolution)], 0.0, np.array([0.2]),
                        np.array([[0.3]]), longest=0.5, breaks=POINTS)
    return Regression(process, np.eye(1, 2), np.array([0.1]))


@pytest.mark.thorough
@pytest.mark.parametrize("evolution", ["SQM", pytest.param("WQM", marks=pytest.mark.slow)])
def test_a_driven_state_is_that_of_dense_algebra(evolution):
    """All eigenfunctions above 1e-12; times asked for, one of them a change point; replicates; a missing entry."""
    force = lfm.QuasiPeriodic(kernel(), EVOLUTIONS[evolution], gamma=1e-12)
    result = lfm.smooth(model(force), TIMES, Y, at=AT)
    reference = dense(evolution)
    assert abs(float(result.log_likelihood.sum()) - reference.log_likelihood(TIMES, Y)) < 1e-6
    mean, covariance = reference.posterior(TIMES, Y, AT)
    np.testing.assert_allclose(result.input_mean, mean, atol=1e-6)
    np.testing.assert_allclose(result.input_covariance, covariance[np.arange(6), np.arange(6)], atol=1e-6)


@pytest.mark.slow
def test_a_kernel_that_is_not_stationary_drives_a_state():
    """Its functions of time are integrated by Runge-Kutta steps; the reference has the same covariance."""
    moderated = forces.ModeratedPeriodicMatern(1.0, 1.0, PERIOD, 0.2, 2)
    force = lfm.QuasiPeriodic(moderated, forces.SQM(1.5, POINTS), functions=5)
    reference = dense("SQM")
    covariance = eqx.filter_jit(force.sde_covariance)
    reference.process.kernels = [lambda t, s: np.asarray(covariance(t, s))]
    reference.process.breaks = (1.5, 3.0, 4.5, 6.0, 7.5)
    result = lfm.filter(model(force), TIMES, Y, steps=40)
    assert abs(float(result.log_likelihood.sum()) - reference.log_likelihood(TIMES, Y)) < 1e-5


def link(x, u, t):
    return softplus(u) - 0.7 * x


@pytest.mark.slow
def test_iterations_across_jumps_converge_with_the_steps():
    """The state just before a jump is a node of its own, so that finer steps change little."""
    system = model(lfm.QuasiPeriodic(kernel(), forces.SQM(0.5, POINTS), functions=1), link)
    coarse, fine = (lfm.smooth(system, TIMES, Y, steps=steps, iterations=2) for steps in (4, 8))
    assert abs(float(coarse.log_likelihood.sum() - fine.log_likelihood.sum())) < 1e-3
    np.testing.assert_allclose(coarse.mean, fine.mean, atol=1e-2)


@pytest.mark.slow
def test_a_panel_is_a_loop():
    def build(p):
        return model(lfm.QuasiPeriodic(kernel(p["lengthscale"], p["period"]), forces.SQM(2.0, POINTS), functions=3))

    parameters = {"lengthscale": jnp.array([1.0, 2.0]), "period": jnp.array([3.0, 2.5])}
    y = jnp.stack([jnp.asarray(Y), 2.0 * jnp.asarray(Y)])
    result = jax.jit(lambda p, y: lfm.panel(build, p, TIMES).log_prob(y))(parameters, y)
    expected = [lfm.MarginalLikelihood(build({"lengthscale": a, "period": b}), TIMES).log_prob(series)
                for a, b, series in zip((1.0, 2.0), (3.0, 2.5), y, strict=True)]
    np.testing.assert_allclose(result, expected, rtol=1e-10)


@pytest.mark.slow
def test_gradients_of_the_likelihood_are_finite_differences():
    """By scale, lengthscale, period and the weights' lengthscale."""

    def value(p):
        force = lfm.QuasiPeriodic(forces.PeriodicMatern(p[0], p[1], p[2], 1), forces.SQM(p[3], POINTS), functions=5)
        return lfm.MarginalLikelihood(model(force), TIMES).log_prob(Y)

    point, h = jnp.array([1.2, 0.9, 2.8, 1.5]), 1e-5
    run = jax.jit(value)
    difference = [(run(point + step) - run(point - step)) / (2 * h) for step in h * np.eye(4)]
    np.testing.assert_allclose(jax.jit(jax.grad(value))(point), difference, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_a_resonator_with_a_bias_is_that_of_dense_algebra():
    """Noise, damping and a mean; and the same for the sum that carries a kernel."""
    for force in (lfm.Resonator(3.0, 0.8, 0.3, 0.1, mean=1.5),
                  resonators(kernel(), functions=5, noise=0.2, damping=0.1, mean=1.5)):
        reference = dense("constant")
        covariance = eqx.filter_jit(force.covariance)
        reference.process.kernels = [lambda t, s, covariance=covariance: np.asarray(covariance(t, s))]
        reference.process.means = [lambda t: 1.5 + np.zeros_like(t)]
        result = lfm.filter(model(force), TIMES, Y)
        assert abs(float(result.log_likelihood.sum()) - reference.log_likelihood(TIMES, Y)) < 1e-8


@pytest.mark.slow
def test_forces_on_a_grid_may_jump():
    """Their prior there is the product of the kernels."""
    latent = lfm.LatentGrid(model(lfm.QuasiPeriodic(kernel(), forces.SQM(1.5, POINTS), functions=5)), TIMES, 40)
    prior = np.asarray(latent.root[0] @ latent.root[0].T)
    np.testing.assert_allclose(prior, exact("SQM")(latent.grid[:, None], latent.grid), atol=1e-5)


@pytest.mark.thorough
def test_a_period_longer_than_the_data_is_an_error():
    late = model(lfm.Periodic(kernel(period=24.0), functions=3) + lfm.Constant(1.0))
    with pytest.raises(ValueError, match="'u'.* 24"):
        lfm.MarginalLikelihood(late, TIMES)


@pytest.mark.slow
def test_a_sampled_period_may_be_longer_than_the_data():
    """A draw from its prior must not end a fit."""
    late = model(lfm.Periodic(kernel(period=jnp.asarray(24.0)), functions=3))
    assert np.isfinite(float(lfm.MarginalLikelihood(late, TIMES).log_prob(Y)))
