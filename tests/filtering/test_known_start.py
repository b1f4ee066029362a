"""Smoothing soon after a known start, where all states are moved by one force and their covariance is singular."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm

TIMES = np.linspace(0.0, 15.0, 13)
AT = np.linspace(0.0, 15.0, 91)
# Two of the decays nearly equal, so that two of the states are nearly proportional to each other for all times.
DECAY, SENSITIVITY = jnp.array([0.801797, 1.170477, 0.801614]), jnp.array([0.96, 0.2, 0.84])


def genes(link, variance=0.0, integrated=False):
    """Three decays pushed by one force; ``integrated``: with a term in t that is never there, so that it is stepped."""
    def dynamics(x, u, t):
        rate = SENSITIVITY * link(u[0]) - DECAY * x
        return rate + jnp.where(t > 1e6, 1.0, 0.0) if integrated else rate

    return lfm.LatentForceModel(
        dynamics, {"u": lfm.Matern(1.0, 2.0, order=1)},
        lfm.GaussianObservation(lambda x, u, t: x, 0.01 * jnp.ones(3)),
        lfm.Gaussian(jnp.array([0.1, 0.04, 0.07]), variance * jnp.eye(3)), initial_time=0.0)


@pytest.mark.thorough
@pytest.mark.parametrize("variance", [0.0, pytest.param(1e8, marks=pytest.mark.slow)])
def test_between_nodes_it_is_the_exact_smoother(variance):
    """A linear model by its exact transition and in Runge-Kutta steps, from a known start to an unknown one."""
    y = np.asarray(lfm.simulate(jax.random.key(0), genes(lambda u: u), TIMES).y)
    exact = lfm.smooth(genes(lambda u: u, variance), TIMES, y, at=AT)
    result = lfm.smooth(genes(lambda u: u, variance, integrated=True), TIMES, y, at=AT)
    scale = np.sqrt(np.diagonal(np.asarray(exact.covariance), axis1=1, axis2=2).max(axis=0))
    assert np.all(np.abs(result.mean - exact.mean) < 2e-4 * scale)
    assert np.all(np.abs(result.covariance - exact.covariance) < 2e-4 * scale * scale[:, None])
