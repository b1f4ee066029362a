"""Transcription study: data, methods on small examples, tables and figures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from lfm_ppl.latent_grid.laplace import laplace
from lfm_ppl.parallel.task import Task
from lfm_ppl.studies.transcription import problem, slices, study

SATURATION, EXPONENTIAL = problem.CONFIGURATIONS[1], problem.CONFIGURATIONS[6]


def test_the_data_solve_the_equation():
    """Expression against an ODE solver on the same force; observations within their noise of it."""
    data = problem.data_set(SATURATION, 3)
    fine_u = np.interp(data.fine, problem.GRID, data.u)
    assert np.abs(fine_u[::6] - data.u).max() == 0.0

    def slope(t, x):
        active = 1 / (1 + 0.5 * np.exp(-np.interp(t, problem.GRID, data.u)))
        return data.rates.basal + data.rates.sensitivity * active - data.rates.decay * x

    solution = solve_ivp(slope, (0.0, problem.END), data.rates.start, t_eval=problem.TIMES, rtol=1e-8, max_step=0.05)
    indices = np.searchsorted(data.fine, problem.TIMES - 1e-9)
    assert np.allclose(data.fine[indices], problem.TIMES)
    # The force between the points of the grid is rougher than the line through them.
    assert np.allclose(solution.y.T, data.state[indices], atol=5e-3)
    noise = np.concatenate([(problem.data_set(SATURATION, index).y - problem.data_set(SATURATION, index).state[indices])
                            for index in range(20)]) / problem.NOISE
    assert abs(noise.mean()) < 4 / np.sqrt(noise.size) and abs(noise.std() - 1) < 4 / np.sqrt(2 * noise.size)


@pytest.mark.thorough
@pytest.mark.parametrize("method", [
    "LA, trust region", *(pytest.param(method, marks=pytest.mark.slow) for method in ("LA", "ESLS"))])
def test_a_method_finds_the_force(method):
    settings = {"study": "transcription", "method": method, "link": "saturation", "gamma": 0.5, "first": 0,
                "last": 1}
    if method == "ESLS":
        settings |= {"draws": 4000, "burn_in": 400}
    result = study.compute(Task(f"saturation/{problem.slug(method)}", 0, settings))
    assert result["mean"].shape == result["sd"].shape == (2, problem.POINTS)
    assert (result["sd"] > 0).all() and (result["seconds"] > 0).all()
    if method == "LA":  # Newton's method is known to fail, and then to say so
        assert (result["diverged"] | result["stopped"]).all() and np.isfinite(result["rmse"]).all()
        return
    assert not result["diverged"].any() and (result["rmse"] < 0.9).all()
    if method == "ESLS":
        assert (result["draws"] >= 4000).all() and (result["low"] < result["mean"]).all()


def linear():
    """A data set whose activity is u itself, and its model on the grid."""
    data = problem.data_set(problem.Configuration("linear"), 1)
    return data, problem.on_grid("linear", None, data.rates)


@pytest.mark.slow
def test_the_gaussian_of_the_ellipses_is_the_posterior_of_a_linear_link():
    """Found from any draws; a draw of it is one of the posterior, and the ratio of likelihoods is flat."""
    data, latent = linear()
    exact = laplace(latent, data.y)
    draws = jax.vmap(latent.force)(jax.random.normal(jax.random.key(0), (50, 1, problem.POINTS)))[:, 0]
    gaussian = slices.linearise_posterior(latent, data.y, draws)
    assert np.allclose(gaussian.mean, exact.mode[0], atol=1e-7)
    ellipses = slices.ellipses(latent, data.y, gaussian)
    points = jax.vmap(ellipses.draw)(jax.random.split(jax.random.key(1), 4000))
    assert np.all(np.abs(np.asarray(points.force).std(axis=0) / exact.sd[0] - 1) < 5 / np.sqrt(2 * 4000))
    assert np.abs(points.force.mean(axis=0) - exact.mode[0]).max() < 4.5 * float(jnp.max(exact.sd)) / np.sqrt(4000)
    assert np.ptp(jax.vmap(ellipses.log_ratio)(points)) < 1e-6
    assert np.allclose(ellipses.point(points.force[0]).linear, points.linear[0])
    assert np.allclose(ellipses.mean.force, gaussian.mean)
