"""Full information estimation against the smoother, Clarabel and IPOPT."""

from __future__ import annotations

import casadi
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_map import Transcribed, quadratic_program
from references import LinearLFM, Regression, matern
from systems import Linear, whole_state

import lfm_ppl as lfm

TIMES = np.linspace(0.0, 6.0, 25)


def transcription(scale=1.0, lengthscale=1.0, noise_sd=0.025, mean=0.0, variance=0.1):
    """x' = 0.25 u - 0.6 x + w, the example of Wolff et al."""
    return lfm.LatentForceModel(
        Linear(jnp.array([[-0.6]]), jnp.array([[0.25]])), {"factor": lfm.Matern(scale, lengthscale)},
        lfm.GaussianObservation(whole_state, jnp.array([noise_sd**2])),
        lfm.Gaussian(jnp.array([mean]), jnp.array([[variance]])), process_noise=1e-3 * jnp.eye(1), initial_time=0.0)


MODEL = transcription()


def data(seed, force=np.sin, times=TIMES):
    rng = np.random.default_rng(seed)
    fine = np.linspace(0.0, times[-1], 2001)
    x = np.zeros(2001)
    for k in range(2000):
        x[k + 1] = x[k] + (fine[1] - fine[0]) * (0.25 * force(fine[k]) - 0.6 * x[k])
    return (np.interp(times, fine, x) + 0.025 * rng.normal(size=len(times)))[:, None]


def posterior(y):
    """Mean and covariance of (x, u) at all rows, by dense Gaussian process algebra."""
    process = LinearLFM(np.array([[-0.6]]), np.array([[0.25]]), [matern(1.0, 1.0, 1)], 0.0, np.zeros(1),
                        np.array([[0.1]]), dispersion=np.array([[1e-3]]))
    mean, covariance = Regression(process, np.array([[1.0, 0.0]]), np.array([0.025**2])).posterior(TIMES, y, TIMES)
    size = mean.size
    return mean.ravel(), covariance.transpose(0, 2, 1, 3).reshape(size, size)


def pushed(t):
    return np.maximum(np.sin(2.0 * t), 0.0)


@pytest.fixture(scope="module")
def bounded():
    y = data(1, pushed)
    return y, lfm.full_information(MODEL, TIMES, y, lower={"factor": 0.0}, upper={"x0": 0.12, "factor": 0.8},
                                   grid=TIMES)


@pytest.mark.thorough
def test_without_active_constraints_it_is_the_smoother():
    y = data(0)
    y[3:6] = np.nan
    smoothed = lfm.smooth(MODEL, TIMES, y)
    free = lfm.full_information(MODEL, TIMES, y, grid=TIMES)
    loose = lfm.full_information(MODEL, TIMES, y, lower={"factor": -10.0}, upper={"x0": 5.0, "factor": 9.0}, grid=TIMES)
    for estimate in (free, loose):
        assert estimate.converged and estimate.passes == 1 and estimate.gap == 0.0 and not estimate.multiplier.any()
        np.testing.assert_allclose(estimate.force("factor").mean, smoothed.force("factor").mean, atol=1e-10)
        np.testing.assert_allclose(estimate.state("x0").mean, smoothed.state("x0").mean, atol=1e-10)
    assert type(loose.force("factor")) is type(smoothed.force("factor")) and np.isnan(loose.state("x0").sd).all()
    np.testing.assert_allclose(loose.slack[:, 0], smoothed.force("factor").mean + 10.0, atol=1e-10)


def test_with_active_constraints_it_is_the_dense_quadratic_program(bounded):
    y, estimate = bounded
    mean, covariance = posterior(y)
    rows = np.arange(len(TIMES))
    pick = np.eye(mean.size)
    u, x = pick[2 * rows + 1], pick[2 * rows]
    matrix = np.concatenate([u, -x, -u])
    offset = np.repeat([0.0, 0.12, 0.8], len(TIMES))
    w, multipliers, excess = quadratic_program(mean, covariance, matrix, offset)
    assert estimate.converged and estimate.gap <= 1e-10
    active = np.asarray(estimate.active)
    assert (active.sum(axis=0) >= [3, 3, 0]).all()
    np.testing.assert_allclose(estimate.state("x0").mean, w[0::2], atol=1e-6)
    np.testing.assert_allclose(estimate.force("factor").mean, w[1::2], atol=1e-6)
    np.testing.assert_allclose(np.asarray(estimate.multiplier).T.ravel(), multipliers, atol=1e-5 * multipliers.max())
    free = lfm.full_information(MODEL, TIMES, y, grid=TIMES)
    assert np.isclose(estimate.objective - free.objective, excess, rtol=1e-7)


def test_what_is_returned_is_feasible_to_the_last_bit(bounded):
    _, estimate = bounded
    assert estimate.force_mean.min() >= 0.0 and estimate.force_mean.max() <= 0.8 and estimate.state_mean.max() <= 0.12
    assert (estimate.slack >= 0.0).all() and (estimate.multiplier >= 0.0).all()
    assert estimate.violation.max() < 1e-9


@pytest.mark.slow
def test_outputs_and_functions_are_bounded_like_names(bounded):
    """The output here is the state, and functions say the same as bounds; also in units of their own."""
    y, estimate = bounded
    model = eqx.tree_at(lambda m: m.initial_state.mean, MODEL, jnp.zeros(1))
    with_functions = lfm.full_information(model, TIMES, y, upper={"y0": 0.12}, grid=TIMES,
                                          constraints=lambda x, u, t: 1e3 * jnp.array([u[0], 0.8 - u[0]]))
    np.testing.assert_allclose(with_functions.force_mean, estimate.force_mean, atol=1e-7)
    np.testing.assert_allclose(with_functions.state_mean, estimate.state_mean, atol=1e-7)


@pytest.mark.slow
def test_bounds_may_change_with_time():
    estimate = lfm.full_information(MODEL, TIMES, data(1), grid=TIMES,
                                    constraints=[lambda x, u, t: u[0] + 0.2 * t, lambda x, u, t: 1.0 - u])
    assert estimate.converged and (estimate.force("factor").mean >= -0.2 * TIMES - 1e-9).all()


@pytest.mark.slow
def test_by_default_the_constraints_hold_between_the_observations():
    times = TIMES[::6]
    estimate = lfm.full_information(MODEL, times, data(1, pushed, times), lower={"factor": 0.0})
    assert estimate.times.shape == (201,) and np.isin(times, estimate.times).all()
    assert estimate.converged and estimate.force_mean.min() >= 0.0


@pytest.mark.slow
def test_replicates_and_missing_rows():
    """Two observations at a time are one of their mean; a row that is missing is not there."""
    y = data(1, pushed)
    once = lfm.full_information(MODEL, TIMES, y, lower={"factor": 0.0}, grid=TIMES)
    twice = lfm.full_information(
        lfm.LatentForceModel(MODEL.dynamics, MODEL.forces, lfm.GaussianObservation(
            whole_state, jnp.full((50, 1, 1), 2 * 0.025**2)), MODEL.initial_state, 1e-3 * jnp.eye(1), 0.0),
        np.repeat(TIMES, 2), np.repeat(y, 2, axis=0) + np.tile([[0.01], [-0.01]], (25, 1)), lower={"factor": 0.0},
        grid=TIMES)
    np.testing.assert_allclose(twice.force_mean, once.force_mean, atol=1e-8)
    np.testing.assert_allclose(twice.multiplier, once.multiplier, atol=1e-6)


@pytest.mark.slow
def test_a_known_start_on_its_bound():
    model = transcription(variance=0.0)
    estimate = lfm.full_information(model, TIMES, data(2), lower={"x0": 0.0, "factor": 0.0}, grid=TIMES)
    assert estimate.converged and estimate.state("x0").mean[0] == 0.0 and estimate.state_mean.min() >= 0.0


@pytest.mark.thorough
def test_another_data_set_and_other_bounds_compile_nothing(bounded, caplog):
    y = data(3, pushed)
    lfm.full_information(MODEL, TIMES, y, lower={"factor": 0.0}, upper={"x0": 0.12, "factor": 0.8}, grid=TIMES)
    with jax.log_compiles(), caplog.at_level("DEBUG"):
        estimate = lfm.full_information(MODEL, TIMES, 0.9 * y, lower={"factor": 0.05},
                                        upper={"x0": 0.11, "factor": 0.7}, grid=TIMES)
    assert not [record for record in caplog.records if "ompil" in record.message and "solve_problem" in record.message]
    assert estimate.converged and estimate.force_mean.min() >= 0.05


class Ballistic(eqx.Module):
    """Altitude and speed of a target in the atmosphere, in km and km/s."""

    def __call__(self, x, u, t):
        return jnp.stack([-x[1], -449.0e-3 * jnp.exp(-0.149 * x[0]) * x[1] ** 2 + 9.8e-3 + u[0]])


def distance(x, u, t):
    return jnp.sqrt(30.0**2 + (0.03 - x[:1]) ** 2)


def ballistic():
    return lfm.LatentForceModel(
        Ballistic(), {"u": lfm.Matern(0.05, 5.0, order=2)}, lfm.GaussianObservation(distance, jnp.array([9e-4])),
        lfm.Gaussian(jnp.array([64.0, 2.9]), jnp.diag(jnp.array([1.0, 0.04]))),
        process_noise=jnp.diag(jnp.sqrt(jnp.array([50e-6, 10e-6]))), initial_time=0.0)


@pytest.mark.slow
def test_ballistic_target_against_ipopt():
    model, times = ballistic(), np.linspace(0.0, 25.0, 26)
    y = lfm.simulate(jax.random.key(3), model, times).y
    for lower in ({"u": -0.005, "x1": 0.9}, {}):
        estimate = lfm.full_information(model, times, y, lower=lower, grid=times, steps=8)
        assert estimate.converged and (not lower or np.asarray(estimate.active).any(axis=0).all())
        bounds = [(2, 1.0, -0.005), (1, 1.0, 0.9)] if lower else []
        reference = Transcribed(
            lambda x, u: [-x[1], -449.0e-3 * casadi.exp(-0.149 * x[0]) * x[1] ** 2 + 9.8e-3 + u],
            lambda x: [(30.0**2 + (0.03 - x[0]) ** 2) ** 0.5], (0.05, 5.0, 2), np.diag([50e-6, 10e-6]),
            np.array([64.0, 2.9]), np.diag([1.0, 0.04]), [9e-4], bounds)
        guess = np.concatenate([estimate.state_mean, estimate.force_mean, np.zeros((26, 2))], axis=1)
        nodes, objective = reference.solve(times, np.asarray(y), guess + 0.01)
        assert np.isclose(estimate.objective, objective, rtol=0, atol=1e-4)
        np.testing.assert_allclose(estimate.force("u").mean, nodes[:, 2], atol=1e-5)
        np.testing.assert_allclose(estimate.state_mean, nodes[:, :2], atol=1e-4)


def refused(error, name, **arguments):
    with pytest.raises(error, match=name):
        lfm.full_information(transcription(variance=0.0), TIMES, data(0), **{"grid": TIMES, **arguments})


def test_bad_constraints_are_named():
    refused(ValueError, "'facto'.*'factor'", lower={"facto": 0.0})
    refused(ValueError, "0.*-1", upper={"factor": -1.0}, lower={"factor": 0.0})
    refused(ValueError, r"lower\['factor'\]", lower={"factor": np.nan})
    refused(ValueError, "'factor'", lower={"factor": np.zeros(3)})
    refused(ValueError, "'x0'.*0.1", lower={"x0": 0.1})
    refused(ValueError, r"u\[2\]", constraints=lambda x, u, t: u[2])
    refused(ValueError, "variance", constraints=lambda x, u, t: 1.0 + 0.0 * t)
    refused(ValueError, "grid", lower={"factor": 0.0}, grid=[0.0, 2.0, 1.0])
    refused(ValueError, "-?1.*0", lower={"factor": 0.0}, grid=[-1.0, 2.0])
    refused(TypeError, "20.0", lower={"factor": 0.0}, grid=20.0)
    refused(TypeError, "lower", lower=[0.0])
    refused(TypeError, "number", constraints=[0.0])


@pytest.mark.slow
def test_what_is_infeasible_or_has_not_converged_is_said():
    refused(ValueError, r"constraints\[0\].*13", constraints=lambda x, u, t: jnp.where(t > 3.0, -1.0, u[0]))
    refused(ValueError, r"constraints\[[01]\]", constraints=[lambda x, u, t: u[0] - 1.0, lambda x, u, t: -u[0] - 0.5])
    with pytest.warns(UserWarning, match="12"):
        lfm.full_information(MODEL, TIMES, data(1, pushed), lower={"factor": 0.0}, grid=TIMES, max_passes=12)
