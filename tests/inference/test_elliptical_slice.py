import math
from functools import partial

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro import handlers
from numpyro.diagnostics import effective_sample_size
from numpyro.infer import MCMC, init_to_value
from numpyro.infer.util import log_density
from scipy.linalg import block_diag
from scipy.stats import kstest

from lfm_ppl.inference.kernels.elliptical_slice import (
    MAX_EVALUATIONS,
    EllipticalSlice,
    SliceState,
    elliptical_slice_step,
)


def assert_expectation(draws, exact):
    """The mean of draws (chain, draw) against an exact expectation, within 4 Monte Carlo standard errors."""
    draws = np.asarray(draws, float)
    assert abs(draws.mean() - exact) < 4 * draws.std() / math.sqrt(effective_sample_size(draws))


# The step, without NumPyro: a prior N(0.4, 1.3^2) and two peaks near -1.5 and 1.5, of which one is higher

GRID = np.linspace(-9.0, 9.0, 200_001)
MEAN, SD = 0.4, 1.3


def peaks(x):
    return -0.5 * ((x * x - 2.25) / 0.8) ** 2


def step(key, state, log_likelihood=peaks):
    key_draw, key_step = jax.random.split(key)
    draw = MEAN + SD * jax.random.normal(key_draw, jnp.shape(state.position))
    return elliptical_slice_step(key_step, state, draw, log_likelihood, MEAN)


@pytest.mark.thorough
def test_a_step_leaves_the_target_as_it_is():
    """Exact draws by inversion of the distribution function, and one step of each."""
    density = np.exp(peaks(GRID) - 0.5 * ((GRID - MEAN) / SD) ** 2)
    cumulative = np.cumsum(density) / density.sum()
    size = 40_000
    positions = np.interp(np.random.default_rng(0).uniform(size=size), cumulative, GRID)
    state = SliceState(jnp.asarray(positions), peaks(positions), np.zeros(size, int))
    new_state = jax.vmap(step)(jax.random.split(jax.random.key(1), size), state)
    x = np.asarray(new_state.position)
    assert np.mean(x != positions) == 1.0
    assert kstest(positions, lambda q: np.interp(q, GRID, cumulative)).pvalue > 1e-3
    assert kstest(x, lambda q: np.interp(q, GRID, cumulative)).pvalue > 1e-3
    np.testing.assert_allclose(new_state.log_likelihood, peaks(x), rtol=1e-9, atol=1e-12)
    # The step is reversible: (old, new) and (new, old) positions have the same distribution.
    for f, g in ((np.sign, np.abs), (np.sin, np.exp), (lambda q: q, lambda q: q**3)):
        difference = f(positions) * g(x) - g(positions) * f(x)
        assert abs(difference.mean()) < 4 * difference.std() / math.sqrt(size)


def test_positions_are_pytrees_and_keep_their_precision():
    state = SliceState({"a": jnp.zeros(3, "float32"), "b": jnp.ones(())}, 0.0)
    draw = {"a": jnp.ones(3), "b": jnp.array(2.0)}
    moved = elliptical_slice_step(jax.random.key(0), state, draw, lambda x: 0.0 * x["b"])
    assert moved.evaluations == 1
    assert moved.position["a"].dtype == jnp.float32
    # x cos a + v sin a with x = 0 and v = 1 is sin a; with x = 1 and v = 2 it is cos a + 2 sin a.
    sine = float(moved.position["a"][0])
    assert abs(abs(float(moved.position["b"]) - 2 * sine) - math.sqrt(1 - sine**2)) < 1e-6


def test_the_likelihood_is_traced_once_and_called_once_for_each_angle():
    traced, called = 0, 0

    def count(x):
        nonlocal called
        called += 1
        return np.asarray(-0.5 * (x - 3.0) ** 2 / 1e-4)

    def log_likelihood(x):
        nonlocal traced
        traced += 1
        return jax.pure_callback(count, jax.ShapeDtypeStruct((), float), x)

    narrow = jax.jit(partial(step, log_likelihood=log_likelihood))
    state, total = SliceState(jnp.array(0.0), -0.5 * 9e4, 0), 0
    for key in jax.random.split(jax.random.key(4), 20):
        state = jax.block_until_ready(narrow(key, state))
        total += int(state.evaluations)
    assert called == total > 60
    assert traced <= 2  # the second for the second step, whose state has other weak types


def test_where_the_likelihood_is_no_number_no_chain_goes():
    """N(0, 1) on (0, 1) and (1.5, 3)."""

    def log_likelihood(x):
        x = jnp.where(x < 0, jnp.nan, jnp.where(x > 3, jnp.inf, x))
        return jnp.where((x > 1.0) & (x < 1.5), -jnp.inf, 0.0 * x)

    def standard(state, key):
        key_draw, key_step = jax.random.split(key)
        state = elliptical_slice_step(key_step, state, jax.random.normal(key_draw), log_likelihood)
        return state, state

    start = SliceState(jnp.full(4, 0.5), jnp.zeros(4), jnp.zeros(4, int))
    keys = jax.random.split(jax.random.key(5), (4, 5000))
    states = jax.jit(jax.vmap(partial(jax.lax.scan, standard)))(start, keys)[1]
    x = np.asarray(states.position)
    assert np.all((x >= 0) & (x <= 3) & ((x <= 1.0) | (x >= 1.5)))
    assert np.all(np.asarray(states.log_likelihood) == 0.0)
    is_possible = (GRID >= 0) & (GRID <= 3) & ((GRID <= 1.0) | (GRID >= 1.5))
    density = np.where(is_possible, np.exp(-0.5 * GRID**2), 0.0)
    for function in (lambda q: q, np.square):
        assert_expectation(function(x), (function(GRID) * density).sum() / density.sum())


def test_a_state_without_likelihood_is_left_and_one_without_neighbours_is_kept():
    lost = SliceState(jnp.array(0.3), -jnp.inf)
    moved = step(jax.random.key(0), lost)
    np.testing.assert_allclose(moved.log_likelihood, peaks(moved.position), rtol=1e-12)
    stuck = step(jax.random.key(0), lost, lambda x: x * math.nan)
    assert (stuck.position, stuck.log_likelihood) == (0.3, -math.inf)
    assert stuck.evaluations == MAX_EVALUATIONS


# Against dense algebra: every prior that is accepted, with its mean (3,) and covariance (3, 3)

LOC = np.array([1.0, -2.0, 0.5])
COVARIANCE = np.array([[2.0, 1.1, 0.3], [1.1, 1.0, 0.2], [0.3, 0.2, 0.5]])
FACTOR = np.array([[1.0, 0.2], [-0.5, 0.6], [0.8, -1.0]])
DIAGONAL = np.array([0.3, 0.5, 0.2])
NOISE, Y = 0.7, np.array([1.3, -0.4])


def plated():
    with numpyro.plate("rows", 3):
        return numpyro.sample("plated", dist.Normal(0.7, 1.2))


def two_sites():
    first = numpyro.sample("first", dist.Normal(1.0, 2.0))
    second = numpyro.sample("second", dist.MultivariateNormal(LOC[1:], COVARIANCE[1:, 1:]).expand([1]))
    return jnp.concatenate([first[None], second[0]])


def nested_plates():
    """Plates of sizes 3 and 1 around batches with a size of one."""
    with numpyro.plate("column", 1, dim=-1), numpyro.plate("row", 3, dim=-2):
        x = numpyro.sample("nested", dist.MultivariateNormal(LOC[:2], COVARIANCE[:2, :2]).expand([1, 1]))
    return x[:, 0, 1]


def scaled():
    """A prior to the power of one half has twice the covariance."""
    with handlers.scale(scale=0.5):
        return numpyro.sample("scaled", dist.MultivariateNormal(LOC, COVARIANCE))


def sampled(name, distribution, shape=()):
    return lambda: numpyro.sample(name, distribution, sample_shape=shape)


PRIORS = [
    (sampled("normal", dist.Normal(LOC, np.array([1.0, 0.5, 2.0])).to_event(1)), LOC, np.diag([1.0, 0.25, 4.0])),
    (sampled("expanded", dist.Normal(0.7, 1.2).expand([3]).to_event(1)), np.full(3, 0.7), 1.44 * np.eye(3)),
    (sampled("sample_shape", dist.Normal(0.7, 1.2), (3,)), np.full(3, 0.7), 1.44 * np.eye(3)),
    (plated, np.full(3, 0.7), 1.44 * np.eye(3)),
    (sampled("covariance", dist.MultivariateNormal(LOC, COVARIANCE)), LOC, COVARIANCE),
    (sampled("factor", dist.MultivariateNormal(LOC, scale_tril=np.linalg.cholesky(COVARIANCE))), LOC, COVARIANCE),
    (sampled("precision", dist.MultivariateNormal(LOC, precision_matrix=np.linalg.inv(COVARIANCE))), LOC, COVARIANCE),
    (sampled("low rank", dist.LowRankMultivariateNormal(LOC, FACTOR, DIAGONAL)), LOC,
     FACTOR @ FACTOR.T + np.diag(DIAGONAL)),
    (two_sites, LOC, np.block([[4.0 * np.eye(1), np.zeros((1, 2))], [np.zeros((2, 1)), COVARIANCE[1:, 1:]]])),
    (nested_plates, np.full(3, -2.0), np.eye(3)),
    (scaled, LOC, 2 * COVARIANCE),
]
WEIGHTS = np.random.default_rng(0).normal(size=(2, 3 * len(PRIORS)))


def linear(y):
    x = numpyro.deterministic("all", jnp.concatenate([prior() for prior, _, _ in PRIORS]))
    numpyro.sample("y", dist.Normal(WEIGHTS @ x, NOISE).to_event(1), obs=y)


@pytest.mark.thorough
def test_the_posterior_of_a_linear_model_with_every_prior():
    mcmc = MCMC(EllipticalSlice(linear), num_warmup=300, num_samples=2000, num_chains=4, chain_method="vectorized",
                progress_bar=False)
    mcmc.run(jax.random.key(1), Y, extra_fields=("potential_energy", "log_likelihood"))
    samples, fields = mcmc.get_samples(group_by_chain=True), mcmc.get_extra_fields(group_by_chain=True)
    mean, covariance = np.concatenate([m for _, m, _ in PRIORS]), block_diag(*(c for _, _, c in PRIORS))
    gain = covariance @ WEIGHTS.T @ np.linalg.inv(WEIGHTS @ covariance @ WEIGHTS.T + NOISE**2 * np.eye(2))
    posterior = covariance - gain @ WEIGHTS @ covariance
    centred = np.asarray(samples["all"]) - mean - gain @ (Y - WEIGHTS @ mean)
    pairs = [(i, j) for i in range(len(mean)) for j in (i, i - i % 3)]
    products = np.stack([centred[:, :, i] * centred[:, :, j] for i, j in pairs], axis=-1)
    exact = [posterior[pair] for pair in pairs]
    for draws, value in ((centred, 0.0), (products, exact)):
        error = draws.std(axis=(0, 1)) / np.sqrt(effective_sample_size(draws))
        assert np.all(np.abs(draws.mean(axis=(0, 1)) - value) < 4.5 * error)

    latent = {name: value[1, 5] for name, value in samples.items() if name != "all"}
    np.testing.assert_allclose(fields["potential_energy"][1, 5], -log_density(linear, (Y,), {}, latent)[0], rtol=1e-9)
    residual = (Y - WEIGHTS @ samples["all"][1, 5]) / NOISE
    expected = -0.5 * residual @ residual - math.log(2 * math.pi * NOISE**2)
    np.testing.assert_allclose(fields["log_likelihood"][1, 5], expected, rtol=1e-9)


# Against blackjax

COUNTS = np.array([0, 3, 1, 7, 2])
TIMES = np.arange(5.0)
KERNEL = 0.8 * np.exp(-0.5 * (TIMES[:, None] - TIMES) ** 2 / 1.5**2) + 1e-6 * np.eye(5)


def counts(y):
    """A log Gaussian Cox process."""
    f = numpyro.sample("f", dist.MultivariateNormal(0.5, KERNEL))
    numpyro.sample("y", dist.Poisson(jnp.exp(f)).to_event(1), obs=y)


@pytest.mark.slow
def test_agreement_with_blackjax():
    chains, warmup, draws = 4, 500, 10_000
    mcmc = MCMC(EllipticalSlice(counts), num_warmup=warmup, num_samples=draws, num_chains=chains,
                chain_method="vectorized", progress_bar=False)
    mcmc.run(jax.random.key(2), COUNTS)
    ours = np.asarray(mcmc.get_samples(group_by_chain=True)["f"])

    def log_likelihood(f):
        return jnp.sum(COUNTS * f - jnp.exp(f))

    peer = blackjax.elliptical_slice(log_likelihood, mean=jnp.full(5, 0.5), cov=jnp.asarray(KERNEL))

    def chain(key):
        def chain_step(state, key):
            state, _ = peer.step(key, state)
            return state, state.position

        return jax.lax.scan(chain_step, peer.init(jnp.full(5, 0.5)), jax.random.split(key, warmup + draws))[1][warmup:]

    theirs = np.asarray(jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(3), chains)))

    def mean_and_error(x):
        return x.mean(), x.std() / math.sqrt(effective_sample_size(x))

    centre = theirs.mean(axis=(0, 1))
    for k in range(5):
        for function in (lambda f: f, lambda f: (f - centre[k]) ** 2):  # noqa: B023
            (mean, error), (peer_mean, peer_error) = (mean_and_error(function(x[:, :, k])) for x in (ours, theirs))
            assert abs(mean - peer_mean) < 4 * math.hypot(error, peer_error)
        sds, errors = zip(*((x[:, :, k].std(), _error_of_sd(x[:, :, k])) for x in (ours, theirs)), strict=True)
        assert abs(sds[0] - sds[1]) < 4 * math.hypot(*errors)


def _error_of_sd(x):
    """The delta method: var(sd) = var(mean of squares) / (4 sd^2)."""
    squares = (x - x.mean()) ** 2
    return squares.std() / math.sqrt(effective_sample_size(squares)) / (2 * x.std())


# The likelihood


def test_masks_scales_and_factors_belong_to_the_likelihood():
    y = jnp.array([0.5, -1.0, 2.0])

    def model():
        x = numpyro.sample("x", dist.Normal(1.0, 2.0))
        with handlers.scale(scale=0.3):
            numpyro.sample("scaled", dist.Normal(x, 1.0).expand([3]), obs=y)
        with handlers.mask(mask=jnp.array([True, False, True])):
            numpyro.sample("masked", dist.Normal(2 * x, 1.0).expand([3]), obs=y)
        numpyro.factor("factor", -3.0 * x**4)
        numpyro.deterministic("square", x**2)

    x = jnp.array(0.7)
    state = EllipticalSlice(model).init(jax.random.key(0), 0, {"x": x})
    normal = dist.Normal(0.0, 1.0).log_prob
    expected = 0.3 * normal(y - x).sum() + normal(y - 2 * x)[jnp.array([0, 2])].sum() - 3 * x**4
    np.testing.assert_allclose(state.log_likelihood, expected, rtol=1e-12)
    joint = expected + dist.Normal(1.0, 2.0).log_prob(x)
    np.testing.assert_allclose(state.potential_energy, -joint, rtol=1e-12)


# Errors


def positive():
    numpyro.sample("noise", dist.HalfNormal(1.0))
    numpyro.sample("gap", dist.Beta(1.0, 2.0).expand([2]).to_event(1))
    numpyro.sample("x", dist.Normal())


def improper():
    numpyro.sample("x", dist.ImproperUniform(dist.constraints.real, (), ()))


def centred(**of_x):
    location = numpyro.sample("location", dist.Normal(0.0, 1.0))
    numpyro.sample("x", dist.Normal(location, 1.0), **of_x)


def scale_depends():
    a = numpyro.sample("a", dist.Normal(0.0, 1.0))
    numpyro.sample("b", dist.MultivariateNormal(jnp.zeros(2), jnp.exp(a) * jnp.eye(2)))


def family_depends():
    a = numpyro.sample("a", dist.Normal(0.0, 1.0))
    numpyro.sample("b", dist.Normal(0.0, 1.0) if a > 0 else dist.MultivariateNormal(jnp.zeros(1), jnp.eye(1)))


def subsampled():
    x = numpyro.sample("x", dist.Normal())
    with numpyro.plate("rows", 10, subsample_size=4):
        numpyro.sample("y", dist.Normal(x, 1.0), obs=0.0)


def masked():
    with handlers.mask(mask=jnp.array([True, False])):
        numpyro.sample("x", dist.Normal().expand([2]))


def badly_scaled():
    with handlers.scale(scale=jnp.array([1.0, 2.0])):
        numpyro.sample("x", dist.Normal().expand([2]))


def impossible():
    x = numpyro.sample("x", dist.Normal().expand([2]).to_event(1))
    numpyro.factor("never", jnp.where(x[0] < 1e6, -jnp.inf, 0.0))


@pytest.mark.parametrize(("model", "init_params", "name"), [
    (positive, None, r"'noise' \(HalfNormal\), 'gap' \(Beta\)"), (improper, None, "'x'"), (centred, None, "'x'"),
    (scale_depends, None, "'b'"), (family_depends, None, "'b'"), (subsampled, None, "'rows'"), (masked, None, "'x'"),
    (badly_scaled, None, "'x'"), (impossible, None, "init_params"), (impossible, {"x": np.zeros(2)}, "-inf"),
    (impossible, {}, "'x'"), (impossible, {"x": np.zeros(3)}, "'x'"), (impossible, np.zeros(2), "ndarray"),
])
def test_bad_models_and_starts_are_named(model, init_params, name):
    with pytest.raises(ValueError, match=name):
        EllipticalSlice(model).init(jax.random.key(0), 10, init_params)


def test_a_site_may_depend_on_others_where_it_is_observed():
    state = EllipticalSlice(centred).init(jax.random.key(0), 0, None, (), {"obs": 1.0})
    assert set(state.z) == {"location"}


@pytest.mark.thorough
def test_vectorised_chains_start_from_given_points_or_draws_of_the_prior():
    keys = jax.random.split(jax.random.key(0), 2)
    with pytest.raises(ValueError, match="-inf"):
        EllipticalSlice(impossible).init(keys, 10, {"x": np.array([[1e7, 0.0], [0.0, 0.0]])})
    kernel = EllipticalSlice(impossible, init_strategy=init_to_value(values={"x": jnp.array([1e7, 2.0])}))
    np.testing.assert_array_equal(kernel.init(jax.random.key(0), 10).z["x"], [1e7, 2.0])
    draws = EllipticalSlice(two_sites).init(jax.random.split(jax.random.key(0), 4000), 0).z["first"]
    assert kstest((np.asarray(draws) - 1.0) / 2.0, "norm").pvalue > 1e-3
