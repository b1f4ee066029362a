"""Noise of a Gaussian observation, as a standard deviation or as a covariance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm

TIMES = np.array([0.0, 0.7, 1.1])
Y = np.array([[0.3, np.nan], [0.1, -0.4], [0.7, 0.2]])
ROWS = np.array([[0.1, 0.2], [0.3, 0.1], [0.2, 0.5]])


def log_density(**noise):
    model = lfm.LatentForceModel(
        lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        lfm.GaussianObservation(lambda x, u, t: jnp.concatenate([x, 2.0 * u]), **noise),
        lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
    return lfm.MarginalLikelihood(model, TIMES).log_prob(Y)


@pytest.mark.thorough
@pytest.mark.parametrize(("sd", "covariance"), [
    (0.3, 0.09 * jnp.eye(2)), (0.3, 0.09), (jnp.array([0.1, 0.2]), jnp.array([0.01, 0.04])),
    (ROWS, jnp.stack([jnp.diag(row**2) for row in ROWS])),
    (lambda x, u, t: 0.1 + 0.2 * t, lambda x, u, t: (0.1 + 0.2 * t) ** 2 * jnp.eye(2)),
    (lambda x, u, t: 0.1 + jnp.concatenate([x, u]) ** 2, lambda x, u, t: (0.1 + jnp.concatenate([x, u]) ** 2) ** 2),
], ids=["number", "numbers", "vector", "rows", "function of time", "function of the state"])
def test_an_sd_is_the_root_of_a_variance(sd, covariance):
    assert float(log_density(sd=sd)) == pytest.approx(float(log_density(covariance=covariance)), rel=1e-12)


def test_the_gradient_in_an_sd():
    gradient = jax.grad(lambda sd: log_density(sd=sd))(0.3)
    of_variance = jax.grad(lambda variance: log_density(covariance=variance * jnp.ones(2)))(0.09)
    assert float(gradient) == pytest.approx(0.6 * float(of_variance), rel=1e-9)


def test_a_number_holds_for_all_sensors():
    basis, sensors, y = lfm.LaplaceBasis((0.0, 1.0), 4), np.array([0.2, 0.6]), np.ones((3, 2))
    start = lfm.Gaussian(jnp.zeros(4), jnp.eye(4))
    values = [lfm.MarginalLikelihood(
        lfm.heat(basis, 0.1, 0.1, sensors=sensors, initial=start, **noise), TIMES).log_prob(y)
              for noise in ({"sd": 0.2}, {"covariance": 0.04}, {"covariance": np.array([0.04, 0.04])})]
    np.testing.assert_allclose(values, values[2], rtol=1e-12)


@pytest.mark.parametrize(("error", "noise", "word"), [
    (TypeError, {}, "sd= and covariance="), (TypeError, {"sd": 1.0, "covariance": 1.0}, "both"),
    (ValueError, {"sd": -0.1}, "sd"), (ValueError, {"sd": np.array([0.1, np.nan])}, "sd"),
    (ValueError, {"sd": np.ones((3, 2, 2))}, "sd"), (ValueError, {"sd": lambda x, u, t: jnp.eye(2)}, "sd"),
    (ValueError, {"sd": np.ones(3)}, "2 components"), (ValueError, {"sd": np.ones((4, 2))}, " 4 .* 3 "),
])
def test_errors(error, noise, word):
    with pytest.raises(error, match=word):
        log_density(**noise)
