"""Forces of which the model is an even function: a Gaussian filter does not see them, and says so."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.model.even_forces import even_forces

TIMES = np.linspace(0.3, 3.0, 7)


def model_of(drift, force=None, observed=lambda x, u, t: x):
    force = lfm.Matern(1.0, 1.0) if force is None else force
    return lfm.LatentForceModel(drift, {"u": force, "v": lfm.Matern(0.5, 2.0)},
                                lfm.GaussianObservation(observed, jnp.array([0.01])),
                                lfm.Gaussian(jnp.zeros(1), 0.1 * jnp.eye(1)))


EVEN = {
    "square": model_of(lambda x, u, t: u[:1] ** 2 + u[1:] - x),
    "cosine": model_of(lambda x, u, t: jnp.cos(u[:1]) + u[1:] - x),
    "distance": model_of(lambda x, u, t: jnp.abs(u[:1] - 1.0) + u[1:] - x, lfm.Matern(0.3, 1.0, mean=1.0)),
    "squared exponential": model_of(lambda x, u, t: u[:1] ** 2 + u[1:] - x, lfm.SquaredExponential(1.0, 1.0)),
    "observation": model_of(lambda x, u, t: u[1:] - x, observed=lambda x, u, t: x + u[:1] ** 2),
}
SEEN = {
    "linear": model_of(lambda x, u, t: u[:1] + u[1:] - x),
    "weak": model_of(lambda x, u, t: jnp.sin(1e-6 * u[:1]) + u[1:] - x),
    "softplus": model_of(lambda x, u, t: jax.nn.softplus(u[:1]) + u[1:] - x),
    "square about a mean": model_of(lambda x, u, t: u[:1] ** 2 + u[1:] - x, lfm.Matern(1.0, 1.0, mean=0.5)),
    "bilinear": model_of(lambda x, u, t: u[:1] * x + u[1:] - x),
    "drag in a wind, from rest": model_of(lambda x, u, t: 1.0 - jnp.abs(x - u[:1]) * (x - u[:1]) + u[1:]),
    "square of a difference": model_of(lambda x, u, t: 9.8 - (x - u[:1]) ** 2 + u[1:]),
    "visible later": model_of(lambda x, u, t: jnp.maximum(t - 1.0, 0.0) * u[:1] + u[:1] ** 2 + u[1:] - x),
    "square, but observed": model_of(lambda x, u, t: u[:1] ** 2 + u[1:] - x, observed=lambda x, u, t: x + u[:1]),
}


@pytest.mark.parametrize("name", EVEN)
def test_even_functions_of_a_force_are_named(name):
    assert even_forces(EVEN[name], TIMES) == ["u"]


@pytest.mark.parametrize("name", SEEN)
def test_other_functions_are_not(name):
    assert even_forces(SEEN[name], TIMES) == []


def test_the_filter_learns_nothing_of_the_force_and_warns():
    y = np.sin(TIMES)[:, None] ** 2
    with pytest.warns(lfm.forces.ApproximationWarning, match="even function of the force 'u'"):
        result = lfm.smooth(EVEN["square"], TIMES, y)
    mean, sd = result.force("u")
    np.testing.assert_allclose(mean, 0.0, atol=1e-9)
    np.testing.assert_allclose(sd, 1.0, rtol=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error", lfm.forces.ApproximationWarning)
        result = lfm.smooth(SEEN["softplus"], TIMES, y)
    assert np.abs(result.force("u")[0]).max() > 0.1


def test_compiled_code_is_not_checked():
    def log_prob(y):
        return lfm.MarginalLikelihood(EVEN["square"], TIMES, iterations=0).log_prob(y)

    with warnings.catch_warnings():
        warnings.simplefilter("error", lfm.forces.ApproximationWarning)
        assert np.isfinite(jax.jit(log_prob)(np.sin(TIMES)[:, None]))
