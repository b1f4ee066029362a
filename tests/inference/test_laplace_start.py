"""Where NUTS starts: usable Laplace approximations, overdispersed points, regularised mass matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpy.testing import assert_allclose
from numpyro.infer.hmc import HMCState
from numpyro.infer.hmc_util import HMCAdaptState, welford_covariance

from lfm_ppl.inference import nuts
from lfm_ppl.inference.laplace_start import (
    MAX_PARAMETERS,
    Laplace,
    UnusableModeError,
    laplace_approximation,
    starting_points,
)
from lfm_ppl.inference.map import mode_of
from lfm_ppl.inference.symmetrising import SymmetrisingTransform
from tests.inference.densities import COVARIANCE, bound, gaussian


def test_the_approximation_of_a_gaussian_is_the_gaussian():
    laplace = laplace_approximation(jax.random.key(0), bound(gaussian))
    assert_allclose(laplace.mode, [1.0, -2.0], atol=1e-6)
    assert_allclose(laplace.covariance, COVARIANCE, rtol=1e-5)


def two_modes():
    x = numpyro.sample("x", dist.Normal(0.0, 3.0))
    numpyro.factor("bumps", jnp.logaddexp(-0.5 * ((x - 4.0) / 0.3) ** 2, 1.0 - 0.5 * ((x + 4.0) / 0.3) ** 2))


def many():
    numpyro.sample("x", dist.Normal().expand([MAX_PARAMETERS + 1]).to_event(1))


@pytest.mark.parametrize("model, name", [(two_modes, "mode"), (many, str(MAX_PARAMETERS + 1))])
def test_a_mode_that_does_not_describe_the_posterior_is_refused(model, name):
    with pytest.raises(UnusableModeError, match=name):
        laplace_approximation(jax.random.key(0), bound(model))


@pytest.mark.parametrize("precision, jump", [(400.0, 1e-6), (1.0, 1e-7)])
def test_small_jumps_of_the_density_do_not_make_the_mode_unusable(precision, jump):
    def stairs():
        """Have small jumps that the gradient does not show, as with adaptive integration steps."""
        x = numpyro.sample("x", dist.ImproperUniform(dist.constraints.real, (), ()))
        numpyro.factor("likelihood", precision * (x - jnp.exp(x)) - jump * jnp.floor(1e5 * x))

    with pytest.warns(UserWarning, match="did not converge"):
        mode_of(jax.random.key(0), bound(stairs))
    laplace = laplace_approximation(jax.random.key(0), bound(stairs))
    assert_allclose(laplace.mode, 0.0, atol=0.03)
    assert_allclose(laplace.covariance, 1.0 / precision, rtol=0.05)


DIRECTIONS = {
    "one of three": np.array([[2.0, 1.0, 0.0], [0.0, 3.0, 0.0]]),
    "two of three": np.array([[0.0, 5.0, 0.0]]),
    "rotated": np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 100.0]]),
    "all": np.zeros((1, 3)),
}
"""Rows that the data inform about; the density is flat along all orthogonal directions."""


@pytest.mark.parametrize("rows", DIRECTIONS.values(), ids=DIRECTIONS)
def test_flat_directions_have_variance_one_and_the_others_the_inverse_hessian(rows):
    def model():
        z = numpyro.sample("z", dist.ImproperUniform(dist.constraints.real_vector, (), (3,)))
        numpyro.factor("informed", -0.5 * ((rows @ (z - 1.0)) ** 2).sum())

    laplace = laplace_approximation(jax.random.key(0), bound(model))
    flat = np.linalg.svd(rows)[2][np.linalg.matrix_rank(rows):]
    # The covariance of what is informed about is that of independent unit errors, whatever is flat.
    if rows.any():
        assert_allclose(rows @ laplace.covariance @ rows.T, np.eye(len(rows)), atol=1e-4)
    assert (np.linalg.eigvalsh(laplace.covariance) > 0.0).all()
    for direction in flat:
        precision = direction @ np.linalg.solve(laplace.covariance, direction)
        assert 0.3 < 1.0 / precision < 3.0
    points = starting_points(jax.random.key(0), bound(model), laplace, 200)
    assert np.isfinite(points).all()
    assert_allclose((points @ flat.T).std(axis=0), 2.0, rtol=0.6)


def test_starting_points_have_twice_the_standard_deviation():
    points = starting_points(jax.random.key(0), bound(gaussian), Laplace(np.array([1.0, -2.0]), COVARIANCE), 400)
    assert_allclose(points.mean(axis=0), [1.0, -2.0], atol=0.3)
    assert_allclose(np.cov(points.T), 4.0 * COVARIANCE, rtol=0.2)


def cliff():
    x = numpyro.sample("x", dist.Normal())
    numpyro.factor("edge", jnp.where(x < 0.0, -1e6 * x**2, 0.0) + jnp.where(x > 3.0, -jnp.inf, 0.0))


def test_points_beyond_a_cliff_are_pulled_towards_the_mode():
    model = bound(cliff)
    points = starting_points(jax.random.key(1), model, Laplace(np.array([0.1]), np.eye(1)), 100)
    log_density = np.array([float(model.log_density(point)) for point in points])
    assert np.isfinite(log_density).all()
    assert log_density.min() > float(model.log_density(np.array([0.1]))) - 20.0
    assert len(np.unique(points)) > 90


def test_mass_matrices_are_means_of_draws_and_approximation():
    transform = SymmetrisingTransform(Laplace(jnp.array([0.5, 0.5]), jnp.array(COVARIANCE)), jnp.zeros(2))
    correlation = COVARIANCE / np.sqrt(np.outer(np.diag(COVARIANCE), np.diag(COVARIANCE)))
    draws = np.random.default_rng(0).normal(size=(30, 2))
    init, update, _ = welford_covariance(diagonal=False)

    def state(estimate):
        adaptation = HMCAdaptState(1.0, None, None, None, None, {("x",): estimate}, 0, None)
        return HMCState(**dict.fromkeys(HMCState._fields) | {"adapt_state": adaptation})

    (estimate,) = nuts._with_pseudo_draws(state(init(2)), transform).adapt_state.mm_state.values()
    for draw in draws:
        estimate = update(jnp.asarray(draw), estimate)
    mean, sum_of_squares, count = estimate
    weight = nuts._PSEUDO_DRAWS
    assert count == 30 + weight
    shift = draws.mean(axis=0)  # the approximation has the mean zero in the coordinates of the chain
    assert_allclose(mean, 30 * shift / count)
    expected = 29 * np.cov(draws.T) + weight * correlation + 30 * weight / count * np.outer(shift, shift)
    assert_allclose(sum_of_squares, expected, rtol=1e-12)
    # An estimate that has draws is left alone.
    (mass_state,) = nuts._with_pseudo_draws(state(estimate), transform).adapt_state.mm_state.values()
    assert_allclose(mass_state[1], sum_of_squares)
