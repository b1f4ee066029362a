"""Laplace's approximation: exact where the posterior is Gaussian, a true mode elsewhere, and honest where it fails."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import lfm_ppl as lfm
from lfm_ppl.latent_grid.laplace import METHODS, laplace
from lfm_ppl.latent_grid.latent_grid import LatentGrid

TIMES = np.linspace(0.0, 6.0, 7)
DECAY = np.array([0.5, 1.2])


def genes(link, variance=0.0, noise=0.1):
    """Two genes with known rates."""
    return lfm.LatentForceModel(
        lambda x, u, t: 0.1 + jnp.array([1.0, 0.6]) * link(u[0]) - DECAY * x, {"u": lfm.Matern(1.0, 2.0, order=1)},
        lfm.GaussianObservation(lambda x, u, t: x, noise**2 * jnp.ones(2)),
        lfm.Gaussian(jnp.array([0.2, 0.1]), variance * jnp.eye(2)))


def observed(model, seed=0):
    y = np.array(lfm.simulate(jax.random.key(seed), model, TIMES).y)
    y[2, 1] = np.nan
    return y


@pytest.mark.parametrize("method, variance", [
    (METHODS[0], 0.3), *(pytest.param(method, 0.0, marks=pytest.mark.slow) for method in METHODS)])
def test_it_is_exact_for_a_linear_model(method, variance):
    """Dense algebra on the same grid: mean, covariance and marginal likelihood, in one step."""
    model = genes(lambda u: u, variance)
    y = observed(model)
    latent = LatentGrid(model, TIMES, 61)
    result = laplace(latent, y, method)
    by_force, by_start = (np.asarray(part).reshape(y.size, -1) for part in jax.jit(jax.jacobian(
        latent.state, argnums=(0, 1)))(latent.mean, jnp.zeros(2)))
    present = np.isfinite(y).ravel()
    a, b = by_force[present], by_start[present]
    prior = np.asarray(latent.root)[0] @ np.asarray(latent.root)[0].T
    residual = y.ravel()[present] - np.asarray(latent.state(latent.mean)).ravel()[present]
    covariance = a @ prior @ a.T + variance * b @ b.T + 0.01 * np.eye(len(a))
    gain = prior @ a.T @ np.linalg.inv(covariance)
    assert np.allclose(result.mode[0], gain @ residual, atol=1e-8)
    assert np.allclose(result.start, np.array([0.2, 0.1]) + variance * b.T @ np.linalg.solve(covariance, residual),
                       atol=1e-8)
    assert np.allclose(result.root @ result.root.T, prior - gain @ a @ prior, atol=1e-8)
    log_marginal = -0.5 * (residual @ np.linalg.solve(covariance, residual) + np.linalg.slogdet(covariance)[1]
                           + len(a) * np.log(2 * np.pi))
    assert np.isclose(result.log_marginal, log_marginal, atol=1e-8)
    assert bool(result.converged) and int(result.iterations) <= 3
    draws = np.asarray(result.sample(jax.random.key(0), 20_000))[:, 0]
    assert np.all(np.abs(draws.mean(axis=0) - result.mode[0]) < 5 * result.sd[0] / np.sqrt(20_000))
    assert np.allclose(draws.std(axis=0), result.sd[0], rtol=5 / np.sqrt(2 * 20_000))


@pytest.mark.thorough
@pytest.mark.parametrize("link", [
    pytest.param(jax.nn.softplus, id="softplus"),
    pytest.param(lambda u: 1 / (0.5 + jnp.exp(u)), id="repression", marks=pytest.mark.slow)])
def test_the_mode_is_that_of_a_general_optimiser(link):
    """BFGS on the same density finds nothing higher; the covariance is the inverse of its numerical Hessian."""
    model = genes(link)
    y = observed(model, 1)
    latent = LatentGrid(model, TIMES, 25)
    result = laplace(latent, y)

    @jax.jit
    def energy(white):
        return 0.5 * (white**2).sum() - latent.log_likelihood(latent.force(white[None]), jnp.asarray(y))

    slope = jax.jit(jax.grad(energy))
    best = minimize(energy, np.zeros(25), jac=slope, method="BFGS", options={"gtol": 1e-9, "maxiter": 5000})
    assert bool(result.converged) and -float(result.log_joint) <= best.fun + 1e-7
    assert np.allclose(result.mode, latent.force(jnp.asarray(best.x)[None]), atol=1e-4)
    numeric = np.stack([(np.asarray(slope(best.x + step)) - np.asarray(slope(best.x - step))) / 2e-5
                        for step in 1e-5 * np.eye(25)])
    root = np.asarray(latent.root[0])
    assert np.allclose(result.root @ result.root.T, root @ np.linalg.inv(numeric) @ root.T, atol=1e-4)
    assert np.isclose(result.log_marginal, -best.fun - 0.5 * np.linalg.slogdet(numeric)[1], atol=1e-3)


@pytest.mark.slow
def test_newton_may_end_at_no_mode_and_says_so():
    """Far from the mode the exponential's curvature is not that of a maximum; the trust region does not mind."""
    failed = 0
    model = genes(jnp.exp, noise=0.03)
    latent = LatentGrid(model, TIMES, 41, "riemann")
    for seed in range(3):
        y = observed(model, seed)
        newton, trust = laplace(latent, y, "newton"), laplace(latent, y)
        assert bool(trust.converged) and float(trust.gradient) < 1e-3
        assert float(newton.log_joint) <= float(trust.log_joint) + 1e-5
        assert np.isfinite(newton.sd).all()
        if not newton.converged:
            failed += 1
            assert float(newton.log_joint) < float(trust.log_joint) - 1.0
    assert failed > 0


def test_errors():
    for change, error, name in (
            ({"method": "newtom"}, ValueError, "'newtom'"), ({"iterations": 0}, ValueError, "iterations"),
            ({"tolerance": 0.0}, ValueError, "tolerance"), ({"y": np.zeros((3, 2))}, ValueError, r"\(3, 2\)"),
            ({"latent": genes(jnp.exp)}, TypeError, "latent")):
        arguments = {"latent": LatentGrid(genes(jnp.exp), TIMES, 11), "y": np.zeros((7, 2))} | change
        with pytest.raises(error, match=name):
            laplace(arguments.pop("latent"), arguments.pop("y"), **arguments)
