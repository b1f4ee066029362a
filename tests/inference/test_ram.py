import math

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.diagnostics import effective_sample_size
from numpyro.infer import MCMC

from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.kernels.robust_metropolis import adapt, rank_one_update

STATISTICS = ("accept_prob", "accepted", "potential_energy", "mean_accept_prob", "step_size")
CHAINS, WARMUP = 8, 40_000
SCALES = np.diag([1.0, 0.5, 2.0, 1.0, 1.5])
COVARIANCE = SCALES @ (0.5 * np.ones((5, 5)) + 0.5 * np.eye(5)) @ SCALES
PRECISION = np.linalg.inv(COVARIANCE)


def gaussian(z):
    return 0.5 * z @ PRECISION @ z


def positive(log_y):
    """Log scale is normal a priori and observed with noise, so that its posterior is normal."""
    scale = numpyro.sample("scale", dist.LogNormal(0.0, 1.0))
    numpyro.sample("y", dist.Normal(jnp.log(scale), 0.5), obs=log_y)


def run(kernel, key, *args, warmup=1000, samples=1000, chains=1, **kwargs):
    mcmc = MCMC(kernel, num_warmup=warmup, num_samples=samples, num_chains=chains, chain_method="vectorized",
                progress_bar=False)
    mcmc.run(jax.random.key(key), *args, **kwargs)
    return mcmc


@pytest.fixture(scope="module")
def correlated():
    """Eight chains on a five-dimensional Gaussian."""
    return run(RAM(potential_fn=gaussian), 0, warmup=WARMUP, samples=10_000, chains=CHAINS,
               init_params=jnp.zeros((CHAINS, 5)), extra_fields=(*STATISTICS, "chol_proposal"))


def assert_within_monte_carlo_error(draws, mean, sd):
    """Draws (chain, draw) against an exact mean and sd; 4 standard errors from the ESS.

    The squares of a normal variable have variance 2 sd^4, and an ESS of their own.
    """
    ess = effective_sample_size(draws)
    assert abs(draws.mean() - mean) < 4 * sd / math.sqrt(ess)
    squares = (draws - mean) ** 2
    ess_squares = effective_sample_size(squares)
    assert abs(squares.mean() - sd**2) < 4 * math.sqrt(2 / ess_squares) * sd**2


# The rank-one update


@pytest.mark.parametrize("dimension", [1, 2, 20])
def test_rank_one_update_equals_the_dense_formula(dimension):
    rng = np.random.default_rng(dimension)
    weights = np.array([-0.999, -0.44, -1e-6, 0.0, 1e-6, 0.766, 50.0])
    factor = np.tril(0.3 * rng.normal(size=(dimension, dimension)))
    np.fill_diagonal(factor, rng.uniform(0.5, 2.0, dimension))
    direction = rng.normal(size=dimension)
    direction /= np.linalg.norm(direction)
    updates = jax.vmap(rank_one_update, (None, None, 0))(factor, direction, weights)
    for weight, updated in zip(weights, np.asarray(updates), strict=True):
        middle = np.eye(dimension) + weight * np.outer(direction, direction)
        dense = factor @ middle @ factor.T
        error = np.abs(updated @ updated.T - dense).max()
        assert error < 1e-12 * np.abs(dense).max()
        np.testing.assert_allclose(updated, np.linalg.cholesky(dense), atol=1e-12)
        assert np.all(np.triu(updated, 1) == 0.0)


def test_rank_one_update_is_equivariant_under_scaling():
    # rows of very different scale: the relative error of each row is what counts
    rng = np.random.default_rng(1)
    factor = np.tril(rng.normal(size=(4, 4))) + 3 * np.eye(4)
    scale = np.array([1e-8, 1.0, 1e8, 1e-3])
    u = rng.normal(size=4)
    u /= np.linalg.norm(u)
    plain = rank_one_update(jnp.asarray(factor), jnp.asarray(u), -0.9)
    scaled = rank_one_update(jnp.asarray(scale[:, None] * factor), jnp.asarray(u), -0.9)
    np.testing.assert_allclose(scaled, scale[:, None] * plain, rtol=1e-13)


def test_rank_one_update_stays_definite_where_the_formula_is_not():
    updated = np.asarray(rank_one_update(jnp.eye(3), jnp.array([0.6, 0.8, 0.0]), -2.0))
    assert np.all(np.isfinite(updated))
    assert np.all(np.diag(updated) > 0.0)


def test_many_updates_keep_the_determinant():
    # det(S_n)^2 is the product of 1 + w_n: independent of the route through 5000 factors
    weights = jnp.tile(jnp.array([-0.234, 0.3, -0.2, 0.1]), 1250)
    noise = jax.random.normal(jax.random.key(0), (5000, 6))
    final, _ = jax.lax.scan(lambda s, uw: (adapt(s, *uw), None), jnp.eye(6), (noise, weights))
    log_det = 2 * jnp.sum(jnp.log(jnp.diagonal(final)))
    np.testing.assert_allclose(log_det, jnp.sum(jnp.log1p(weights)), rtol=1e-10)


def test_no_adaptation_without_weight_and_none_that_overflows():
    factor = jnp.array([[0.3, 0.0], [1.7, 0.9]])
    noise = jnp.array([0.2, -1.1])
    assert np.array_equal(adapt(factor, noise, jnp.array(0.0)), factor)
    huge, tiny = 1e308 * jnp.eye(2), 1e-307 * jnp.eye(2)
    assert np.array_equal(adapt(huge, noise, jnp.array(10.0)), huge)
    assert np.array_equal(adapt(tiny, noise, jnp.array(-0.99999)), tiny)
    assert np.array_equal(adapt(factor, jnp.zeros(2), jnp.array(0.5)), factor)


# Adaptation in a chain


@pytest.mark.thorough
def test_acceptance_rate_converges_to_the_target(correlated):
    accepted = np.asarray(correlated.get_extra_fields(group_by_chain=True)["accepted"], float)
    per_chain = accepted.mean(axis=1)  # independent chains give the error of their own mean
    assert abs(per_chain.mean() - 0.234) < 4 * per_chain.std(ddof=1) / math.sqrt(CHAINS)
    assert abs(per_chain.mean() - 0.234) < 0.01


def test_proposal_covariance_becomes_proportional_to_the_posterior_covariance(correlated):
    white = np.linalg.solve(np.linalg.cholesky(COVARIANCE), correlated.last_state.chol_proposal)
    shape = white @ np.swapaxes(white, 1, 2)
    shape /= np.trace(shape, axis1=1, axis2=2)[:, None, None] / 5
    error = shape.std(axis=0, ddof=1) / math.sqrt(CHAINS)
    assert np.all(np.abs(shape.mean(axis=0) - np.eye(5)) < 5 * error)
    assert np.all(error < 0.1)
    assert np.linalg.cond(shape.mean(axis=0)) < 1.5  # 39 at first


def test_posterior_of_a_correlated_gaussian(correlated):
    draws = np.asarray(correlated.get_samples(group_by_chain=True))
    for k in range(5):
        assert_within_monte_carlo_error(draws[:, :, k], 0.0, math.sqrt(COVARIANCE[k, k]))
    product = draws[:, :, 0] * draws[:, :, 2]
    sd = math.sqrt(COVARIANCE[0, 0] * COVARIANCE[2, 2] + COVARIANCE[0, 2] ** 2)
    ess = effective_sample_size(product)
    assert abs(product.mean() - COVARIANCE[0, 2]) < 4 * sd / math.sqrt(ess)


def test_adaptation_goes_on_after_the_warmup_if_it_is_asked_to():
    mcmc = run(RAM(potential_fn=gaussian, adapt="throughout"), 0, warmup=1000, samples=1000, chains=CHAINS,
               init_params=jnp.zeros((CHAINS, 5)), extra_fields=STATISTICS)
    fields = mcmc.get_extra_fields(group_by_chain=True)
    # log det S grows by log(1 + eta_n (alpha_n - alpha*)) / 2, with eta_n = d n^(-2/3)
    n = 1000 + np.arange(2, 1001)
    excess = np.asarray(fields["accept_prob"])[:, 1:] - 0.234
    growth = np.diff(5 * np.log(np.asarray(fields["step_size"])), axis=1)
    np.testing.assert_allclose(growth, 0.5 * np.log1p(5 * n ** (-2 / 3) * excess), atol=1e-10)


def test_statistics_are_consistent_and_the_proposal_is_that_of_the_warmup(correlated):
    fields = {k: np.asarray(v) for k, v in correlated.get_extra_fields(group_by_chain=True).items()}
    assert np.all(fields["chol_proposal"] == fields["chol_proposal"][:, :1])
    draws = np.asarray(correlated.get_samples(group_by_chain=True))
    energy = 0.5 * np.einsum("cni,ij,cnj->cn", draws, PRECISION, draws)
    np.testing.assert_allclose(fields["potential_energy"], energy, atol=1e-10)
    moved = np.any(np.diff(draws, axis=1) != 0.0, axis=2)
    assert np.array_equal(moved, fields["accepted"][:, 1:])
    # the mean starts again after the warm-up
    means = np.cumsum(fields["accept_prob"], axis=1) / np.arange(1, 10_001)
    np.testing.assert_allclose(fields["mean_accept_prob"], means, atol=1e-10)


def test_one_parameter_is_steered_towards_044():
    mcmc = run(
        RAM(positive), 1, 0.8, warmup=3000, samples=8000, chains=CHAINS, extra_fields=STATISTICS
    )
    accepted = np.asarray(mcmc.get_extra_fields(group_by_chain=True)["accepted"], float).mean(1)
    assert abs(accepted.mean() - 0.44) < 4 * accepted.std(ddof=1) / math.sqrt(CHAINS)
    assert abs(accepted.mean() - 0.44) < 0.02
    log_scale = np.log(mcmc.get_samples(group_by_chain=True)["scale"])
    assert_within_monte_carlo_error(log_scale, 0.8 * 4 / 5, math.sqrt(1 / 5))


def test_one_density_evaluation_for_each_step_and_no_recompilation():
    traced = 0

    def potential(z):
        nonlocal traced
        traced += 1
        return 0.5 * jnp.sum(z**2)

    kernel = RAM(potential_fn=potential)
    state = kernel.init(jax.random.key(0), 10, jnp.zeros(3))
    assert traced == 1
    jax.make_jaxpr(lambda s: kernel.sample(s, (), {}))(state)
    assert traced == 2

    mcmc = run(kernel, 0, warmup=20, samples=20, init_params=jnp.zeros(3))
    first = traced
    mcmc.run(jax.random.key(1), init_params=jnp.ones(3))
    assert traced == first + 1  # the starting point alone; the compiled step is used again


def test_impossible_regions_are_rejected():
    """An exponential density on (0, 3); outside, and on a gap, the potential is no number."""

    def potential(x):
        (x,) = x
        gap = (x > 1.0) & (x < 1.5)
        return jnp.where(x < 0, jnp.nan, jnp.where(x > 3, jnp.inf, jnp.where(gap, -jnp.inf, x)))

    mcmc = run(
        RAM(potential_fn=potential, target_accept_prob=0.3), 7, samples=10_000, chains=4,
        init_params=jnp.full((4, 1), 0.5), extra_fields=STATISTICS,
    )  # fmt: skip
    draws = np.asarray(mcmc.get_samples(group_by_chain=True))[..., 0]
    assert draws.min() > 0
    assert draws.max() < 3
    assert not np.any((draws > 1.0) & (draws < 1.5))
    for values in mcmc.get_extra_fields().values():
        assert np.all(np.isfinite(values))
    intervals = [(0.0, 1.0), (1.5, 3.0)]
    mass = sum(math.exp(-a) - math.exp(-b) for a, b in intervals)
    mean = sum((a + 1) * math.exp(-a) - (b + 1) * math.exp(-b) for a, b in intervals) / mass
    ess = effective_sample_size(draws)
    assert abs(draws.mean() - mean) < 4 * draws.std() / math.sqrt(ess)


def test_initial_scale_and_covariance():
    key = jax.random.key(0)

    def initial_factor(**options):
        return RAM(potential_fn=gaussian, **options).init(key, 1, jnp.zeros(5)).chol_proposal

    np.testing.assert_array_equal(initial_factor(), np.eye(5))
    np.testing.assert_array_equal(initial_factor(initial_scale=0.2), 0.2 * np.eye(5))
    optimal = initial_factor(initial_covariance=COVARIANCE)
    np.testing.assert_allclose(optimal @ optimal.T, 2.38**2 / 5 * COVARIANCE, rtol=1e-12)
    variances = initial_factor(initial_covariance=np.arange(1.0, 6.0), initial_scale=2.0)
    np.testing.assert_allclose(variances, np.diag(2 * np.sqrt(np.arange(1.0, 6.0))))


# Errors


@pytest.mark.parametrize(("options", "name"), [
    ({}, "potential_fn"), ({"model": positive, "potential_fn": gaussian}, "potential_fn"),
    ({"model": positive, "target_accept_prob": 1.0}, "target_accept_prob"),
    ({"model": positive, "adapt": "warm-up"}, "'warm-up'"), ({"model": positive, "exponent": 0.5}, "exponent"),
    ({"model": positive, "initial_scale": -1.0}, "initial_scale"),
    ({"model": positive, "initial_covariance": np.ones((2, 2))}, "initial_covariance"),
    ({"model": positive, "initial_covariance": np.ones((2, 3))}, "initial_covariance"),
])
def test_bad_options_are_named(options, name):
    with pytest.raises(ValueError, match=name):
        RAM(**options)


@pytest.mark.parametrize(("options", "start", "name"), [
    ({}, None, "init_params"), ({}, np.full(5, np.nan), "init_params"), ({}, {}, "at least one parameter"),
    ({"initial_covariance": np.eye(4)}, np.zeros(5), r"size 5.*\(4, 4\)"),
])
def test_bad_starts_are_named(options, start, name):
    potential = (lambda z: 0.0) if isinstance(start, dict) else gaussian
    with pytest.raises(ValueError, match=name):
        RAM(potential_fn=potential, **options).init(jax.random.key(0), 10, start)
