import math
import pickle
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
from processes import on_two_devices
from scipy.stats import kstest

from lfm_ppl.inference.kernels.elliptical_slice import (
    MAX_EVALUATIONS,
    EllipticalSlice,
    SliceState,
    elliptical_slice_step,
)

FIELDS = ("evaluations", "log_likelihood", "potential_energy", "i")


def run(kernel, key, *args, warmup=300, samples=3000, chains=4, method="vectorized", extra=(), init_params=None,
        thinning=1, **kwargs):
    mcmc = MCMC(kernel, num_warmup=warmup, num_samples=samples, num_chains=chains, chain_method=method,
                progress_bar=False, thinning=thinning)
    mcmc.run(jax.random.key(key), *args, extra_fields=extra, init_params=init_params, **kwargs)
    return mcmc


def assert_expectation(draws, exact):
    """The mean of draws (chain, draw) against an exact expectation, within 4 Monte Carlo standard errors."""
    draws = np.asarray(draws, float)
    assert abs(draws.mean() - exact) < 4 * draws.std() / math.sqrt(effective_sample_size(draws))


# The step, without NumPyro: a prior N(0.4, 1.3^2) and two peaks near -1.5 and 1.5, of which one is higher

GRID = np.linspace(-9.0, 9.0, 200_001)
MEAN, SD = 0.4, 1.3


def peaks(x):
    return -0.5 * ((x * x - 2.25) / 0.8) ** 2


def expectation(function):
    """Quadrature: sums over a grid are exact to rounding for a smooth density that vanishes at both ends."""
    density = np.exp(peaks(GRID) - 0.5 * ((GRID - MEAN) / SD) ** 2)
    return float((function(GRID) * density).sum() / density.sum())


def step(key, state, log_likelihood=peaks):
    key_draw, key_step = jax.random.split(key)
    draw = MEAN + SD * jax.random.normal(key_draw, jnp.shape(state.position))
    return elliptical_slice_step(key_step, state, draw, log_likelihood, MEAN)


def test_a_step_leaves_the_target_as_it_is():
    """Exact draws by inversion of the distribution function, and one step of each."""
    density = np.exp(peaks(GRID) - 0.5 * ((GRID - MEAN) / SD) ** 2)
    cumulative = np.cumsum(density) / density.sum()
    size = 40_000
    before = np.interp(np.random.default_rng(0).uniform(size=size), cumulative, GRID)
    state = SliceState(jnp.asarray(before), peaks(before), np.zeros(size, int))
    after = jax.vmap(step)(jax.random.split(jax.random.key(1), size), state)
    x = np.asarray(after.position)
    assert np.mean(x != before) == 1.0
    assert kstest(before, lambda q: np.interp(q, GRID, cumulative)).pvalue > 1e-3
    assert kstest(x, lambda q: np.interp(q, GRID, cumulative)).pvalue > 1e-3
    np.testing.assert_allclose(after.log_likelihood, peaks(x), rtol=1e-9, atol=1e-12)
    # The step is reversible: (before, after) and (after, before) have the same distribution.
    for f, g in ((np.sign, np.abs), (np.sin, np.exp), (lambda q: q, lambda q: q**3)):
        difference = f(before) * g(x) - g(before) * f(x)
        assert abs(difference.mean()) < 4 * difference.std() / math.sqrt(size)


def test_chains_have_the_distribution_of_quadrature():
    chains, draws = 8, 10_000

    def chain(key):
        start = SliceState(jnp.array(1.5), peaks(1.5), 0)
        return jax.lax.scan(lambda s, k: (step(k, s),) * 2, start, jax.random.split(key, draws))[1]

    x = np.asarray(jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(2), chains)).position)
    for function in (lambda q: q, np.square, np.sign, lambda q: (q > 1.5) * 1.0, lambda q: np.exp(-q)):
        assert_expectation(function(x[:, 100:]), expectation(function))


def test_vmap_over_chains_and_data_is_the_loop():
    data = jnp.array([0.0, 1.0, 2.5])
    states = SliceState(jnp.linspace(-1.0, 1.0, 6).reshape(3, 2), jnp.zeros((3, 2)), jnp.zeros((3, 2), int))
    states = states._replace(log_likelihood=-0.5 * (states.position - data[:, None]) ** 2 / 0.01)
    keys = jax.random.split(jax.random.key(0), (3, 2))

    def one(y, key, state):
        return step(key, state, lambda x: -0.5 * (x - y) ** 2 / 0.01)

    together = jax.vmap(jax.vmap(one, (None, 0, 0)))(data, keys, states)
    assert len(set(np.asarray(together.evaluations).ravel())) > 2
    for i in range(3):
        for j in range(2):
            single = one(data[i], keys[i, j], jax.tree.map(lambda leaf: leaf[i, j], states))  # noqa: B023
            assert single.evaluations == together.evaluations[i, j]
            np.testing.assert_allclose(single.position, together.position[i, j], rtol=1e-12)
            np.testing.assert_allclose(single.log_likelihood, together.log_likelihood[i, j], rtol=1e-9)


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


@pytest.mark.parametrize("impossible", [math.nan, -math.inf, math.inf])
def test_where_the_likelihood_is_no_number_no_chain_goes(impossible):
    """N(0, 1) without (-inf, 0) and (1, 1.5)."""

    def log_likelihood(x):
        return jnp.where((x < 0) | ((x > 1.0) & (x < 1.5)), impossible, 0.0 * x)

    def standard(state, key):
        key_draw, key_step = jax.random.split(key)
        state = elliptical_slice_step(key_step, state, jax.random.normal(key_draw), log_likelihood)
        return state, state

    start = SliceState(jnp.full(4, 0.5), jnp.zeros(4), jnp.zeros(4, int))
    keys = jax.random.split(jax.random.key(5), (4, 5000))
    states = jax.jit(jax.vmap(partial(jax.lax.scan, standard)))(start, keys)[1]
    x = np.asarray(states.position)
    assert np.all((x >= 0) & ((x <= 1.0) | (x >= 1.5)))
    assert np.all(np.asarray(states.log_likelihood) == 0.0)
    density = np.where((GRID < 0) | ((GRID > 1.0) & (GRID < 1.5)), 0.0, np.exp(-0.5 * GRID**2))
    for function in (lambda q: q, np.square):
        assert_expectation(function(x), (function(GRID) * density).sum() / density.sum())


def test_a_state_without_likelihood_is_left_and_one_without_neighbours_is_kept():
    lost = SliceState(jnp.array(0.3), -jnp.inf)
    moved = step(jax.random.key(0), lost)
    np.testing.assert_allclose(moved.log_likelihood, peaks(moved.position), rtol=1e-12)
    stuck = step(jax.random.key(0), lost, lambda x: x * math.nan)
    assert (stuck.position, stuck.log_likelihood) == (0.3, -math.inf)
    assert stuck.evaluations == MAX_EVALUATIONS


# Against dense algebra: every prior that is accepted, with its mean (d,) and covariance (d, d)

LOC = np.array([1.0, -2.0, 0.5])
COVARIANCE = np.array([[2.0, 1.1, 0.3], [1.1, 1.0, 0.2], [0.3, 0.2, 0.5]])
FACTOR = np.array([[1.0, 0.2], [-0.5, 0.6], [0.8, -1.0]])
DIAGONAL = np.array([0.3, 0.5, 0.2])
WEIGHTS = np.array([[1.0, 0.5, -0.5], [0.0, 1.0, 2.0]])
NOISE, Y = 0.7, np.array([1.3, -0.4])


def plated():
    with numpyro.plate("three", 3):
        return numpyro.sample("x", dist.Normal(0.7, 1.2))


def two_sites():
    first = numpyro.sample("a", dist.Normal(1.0, 2.0))
    second = numpyro.sample("b", dist.MultivariateNormal(LOC[1:], COVARIANCE[1:, 1:]).expand([1]))
    return jnp.concatenate([first[None], second[0]])


def nested_plates():
    """Plates of sizes 3 and 1 around batches with a size of one."""
    with numpyro.plate("one", 1, dim=-1), numpyro.plate("three", 3, dim=-2):
        x = numpyro.sample("x", dist.MultivariateNormal(LOC[:2], COVARIANCE[:2, :2]).expand([1, 1]))
    return x[:, 0, 1]


def scaled():
    """A prior to the power of one half has twice the covariance."""
    with handlers.scale(scale=0.5):
        return numpyro.sample("x", dist.MultivariateNormal(LOC, COVARIANCE))


def sampled(distribution, shape=()):
    return lambda: numpyro.sample("x", distribution, sample_shape=shape)


PRIORS = {
    "Normal": (sampled(dist.Normal(LOC, np.array([1.0, 0.5, 2.0])).to_event(1)), LOC, np.diag([1.0, 0.25, 4.0])),
    "expand": (sampled(dist.Normal(0.7, 1.2).expand([3]).to_event(1)), np.full(3, 0.7), 1.44 * np.eye(3)),
    "sample_shape": (sampled(dist.Normal(0.7, 1.2), (3,)), np.full(3, 0.7), 1.44 * np.eye(3)),
    "plate": (plated, np.full(3, 0.7), 1.44 * np.eye(3)),
    "covariance": (sampled(dist.MultivariateNormal(LOC, COVARIANCE)), LOC, COVARIANCE),
    "scale_tril": (sampled(dist.MultivariateNormal(LOC, scale_tril=np.linalg.cholesky(COVARIANCE))), LOC, COVARIANCE),
    "precision": (
        sampled(dist.MultivariateNormal(LOC, precision_matrix=np.linalg.inv(COVARIANCE))), LOC, COVARIANCE,
    ),
    "low rank": (
        sampled(dist.LowRankMultivariateNormal(LOC, FACTOR, DIAGONAL)), LOC, FACTOR @ FACTOR.T + np.diag(DIAGONAL),
    ),
    "two sites": (two_sites, np.array([1.0, -2.0, 0.5]), np.block([
        [np.array([[4.0]]), np.zeros((1, 2))], [np.zeros((2, 1)), COVARIANCE[1:, 1:]],
    ])),
    "nested plates": (nested_plates, np.full(3, -2.0), np.eye(3)),
    "scaled": (scaled, LOC, 2 * COVARIANCE),
}  # fmt: skip
COSTLY = ("Normal", "sample_shape", "scale_tril", "precision", "low rank", "nested plates")
"""Priors that other ones resemble; these are run with -m slow."""


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=pytest.mark.slow if name in COSTLY else ()) for name in PRIORS])
def test_linear_gaussian_posterior(name):
    prior, mean, covariance = PRIORS[name]

    def model(y):
        x = numpyro.deterministic("all", prior())
        numpyro.sample("y", dist.Normal(WEIGHTS @ x, NOISE).to_event(1), obs=y)

    mcmc = run(EllipticalSlice(model), 1, Y, extra=FIELDS)
    samples, fields = mcmc.get_samples(group_by_chain=True), mcmc.get_extra_fields(group_by_chain=True)
    gain = covariance @ WEIGHTS.T @ np.linalg.inv(WEIGHTS @ covariance @ WEIGHTS.T + NOISE**2 * np.eye(2))
    posterior_mean = mean + gain @ (Y - WEIGHTS @ mean)
    posterior = covariance - gain @ WEIGHTS @ covariance
    centred = np.asarray(samples["all"]) - posterior_mean
    for i in range(3):
        assert_expectation(centred[:, :, i], 0.0)
        for j in range(i + 1):
            assert_expectation(centred[:, :, i] * centred[:, :, j], posterior[i, j])

    latent = {k: v[1, 5] for k, v in samples.items() if k != "all"}
    energy = -log_density(model, (Y,), {}, latent)[0]
    np.testing.assert_allclose(fields["potential_energy"][1, 5], energy, rtol=1e-9)
    residual = (Y - WEIGHTS @ samples["all"][1, 5]) / NOISE
    expected = -0.5 * residual @ residual - math.log(2 * math.pi * NOISE**2)
    np.testing.assert_allclose(fields["log_likelihood"][1, 5], expected, rtol=1e-9)
    assert np.array_equal(fields["i"][-1], np.arange(301, 3301))


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
    ours = np.asarray(run(EllipticalSlice(counts), 2, COUNTS, samples=draws).get_samples(group_by_chain=True)["f"])

    def log_likelihood(f):
        return jnp.sum(COUNTS * f - jnp.exp(f))

    peer = blackjax.elliptical_slice(log_likelihood, mean=jnp.full(5, 0.5), cov=jnp.asarray(KERNEL))

    def chain(key):
        def one(state, key):
            state, _ = peer.step(key, state)
            return state, state.position

        return jax.lax.scan(one, peer.init(jnp.full(5, 0.5)), jax.random.split(key, warmup + draws))[1][warmup:]

    theirs = np.asarray(jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(3), chains)))

    def mean_and_error(x):
        return x.mean(), x.std() / math.sqrt(effective_sample_size(x))

    centre = theirs.mean(axis=(0, 1))
    for k in range(5):
        for function in (lambda f: f, lambda f: (f - centre[k]) ** 2):  # noqa: B023
            (one, error), (other, other_error) = (mean_and_error(function(x[:, :, k])) for x in (ours, theirs))
            assert abs(one - other) < 4 * math.hypot(error, other_error)
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


def test_without_observations_the_draws_come_from_the_prior():
    def model():
        numpyro.sample("x", dist.Normal(3.0, 0.5))

    mcmc = run(EllipticalSlice(model), 0, extra=FIELDS)
    x = mcmc.get_samples(group_by_chain=True)["x"]
    assert np.all(mcmc.get_extra_fields()["evaluations"] == 1)
    assert_expectation(x, 3.0)
    assert_expectation((x - 3.0) ** 2, 0.25)


@pytest.mark.slow
def test_priors_written_with_standard_normals():
    """LocScaleReparam and TransformReparam, which the messages advise."""
    from numpyro.infer.reparam import LocScaleReparam, TransformReparam

    def model(y):
        location = numpyro.sample("location", dist.Normal(0.0, 1.0))
        x = numpyro.sample("x", dist.Normal(location, 0.5))
        scale = numpyro.sample("scale", dist.LogNormal(0.0, 0.2))
        numpyro.factor("of_scale", -jnp.log(scale) * 0.04)
        numpyro.sample("y", dist.Normal(x, 1.0), obs=y)

    config = {"x": LocScaleReparam(0.0), "scale": TransformReparam()}
    samples = run(EllipticalSlice(handlers.reparam(model, config=config)), 3, 2.0).get_samples(group_by_chain=True)
    assert {"location", "x", "scale", "x_decentered", "scale_base"} <= set(samples)
    assert_expectation(samples["x"], 2.0 * 1.25 / 2.25)
    assert_expectation(samples["location"], 2.0 / 2.25)
    # log scale = l has density N(l; 0, 0.2^2) exp(-0.04 l), whose mean is -0.04 * 0.2^2.
    assert_expectation(np.log(samples["scale"]), -0.04 * 0.2**2)


# As a NumPyro kernel


def regression(x, y=None, noise=1.0):
    with numpyro.plate("inputs", 2):
        weights = numpyro.sample("weights", dist.Normal(0.0, 1.0))
    f = numpyro.deterministic("f", x @ weights)
    with numpyro.plate("data", len(x)):
        numpyro.sample("y", dist.StudentT(4.0, f, noise), obs=y)


X = np.array([[1.0, 0.2], [0.5, -1.0], [-0.3, 0.8]])
OBSERVED = np.array([0.7, 0.1, 0.4])


CHAIN_METHODS = """
import jax, numpy as np, numpyro, numpyro.distributions as dist
from numpyro.infer import MCMC
from lfm_ppl import EllipticalSlice

numpyro.enable_x64()
assert jax.local_device_count() == 2

def model(y):
    a = numpyro.sample("a", dist.MultivariateNormal(np.zeros(2), np.array([[1.0, 0.5], [0.5, 2.0]])))
    b = numpyro.sample("b", dist.Normal(1.0, 2.0).expand([2]).to_event(1))
    numpyro.deterministic("c", a + b)
    numpyro.sample("y", dist.StudentT(3.0, a[0] * b, 0.3).to_event(1), obs=y)

draws = {}
for method in ("sequential", "vectorized", "parallel"):
    mcmc = MCMC(EllipticalSlice(model), num_warmup=50, num_samples=100, num_chains=2,
                chain_method=method, progress_bar=False)
    mcmc.run(jax.random.key(3), np.array([0.3, 0.4]), extra_fields=("evaluations", "potential_energy"))
    draws[method] = mcmc.get_samples(group_by_chain=True) | mcmc.get_extra_fields(True)
assert np.std(draws["sequential"]["a"], axis=1).min() > 0
assert draws["sequential"]["c"].shape == (2, 100, 2)
for method in ("vectorized", "parallel"):
    for name, value in draws["sequential"].items():
        np.testing.assert_allclose(draws[method][name], value, rtol=1e-8, err_msg=f"{method} {name}")
print("same")
"""


@pytest.mark.slow
def test_chain_methods_give_the_same_draws():
    result = on_two_devices(CHAIN_METHODS)
    assert result.stdout.strip() == "same", result.stderr


def test_one_chain_with_thinning_is_every_third_draw():
    full, thinned = (
        run(EllipticalSlice(regression), 7, X, y=OBSERVED, warmup=20, samples=60, chains=1, thinning=thinning,
            extra=FIELDS)
        for thinning in (1, 3)
    )
    for name, draws in full.get_samples().items():
        np.testing.assert_array_equal(thinned.get_samples()[name], draws[2::3])
    assert np.array_equal(thinned.get_extra_fields()["i"], np.arange(23, 81, 3))


def test_deterministic_sites_and_reproducibility():
    mcmc, again, other = (
        run(EllipticalSlice(regression), key, X, y=OBSERVED, warmup=20, samples=50, chains=2) for key in (7, 7, 8)
    )
    samples = mcmc.get_samples()
    np.testing.assert_allclose(samples["f"], samples["weights"] @ X.T, rtol=1e-12)
    np.testing.assert_array_equal(again.get_samples()["weights"], samples["weights"])
    assert not np.any(other.get_samples()["weights"] == samples["weights"])


def test_postprocess_of_the_user():
    mcmc = MCMC(EllipticalSlice(regression), num_warmup=5, num_samples=10, progress_bar=False,
                postprocess_fn=lambda z: {"sum": z["weights"].sum()})
    mcmc.run(jax.random.key(0), X, y=OBSERVED)
    assert mcmc.get_samples()["sum"].shape == (10,)


def test_progress_bar_and_its_text(capsys):
    kernel = EllipticalSlice(regression)
    mcmc = MCMC(kernel, num_warmup=20, num_samples=20)
    mcmc.progress_bar = True
    mcmc.run(jax.random.key(0), X, y=OBSERVED)
    state = mcmc.last_state
    text = kernel.get_diagnostics_str(state)
    assert text == f"log likelihood {state.log_likelihood:.2f}. evaluations={state.evaluations}"
    assert text in capsys.readouterr().err
    silent = run(kernel, 0, X, y=OBSERVED, warmup=20, samples=20, chains=1)
    np.testing.assert_allclose(mcmc.get_samples()["weights"], silent.get_samples()["weights"], rtol=1e-9)


def test_new_arguments_reach_a_compiled_kernel():
    traced = 0

    def model(x, y, noise):
        nonlocal traced
        traced += 1
        weights = numpyro.sample("weights", dist.Normal(0.0, 1.0).expand([2]).to_event(1))
        numpyro.sample("y", dist.StudentT(4.0, x @ weights, noise), obs=y)

    mcmc = MCMC(EllipticalSlice(model), num_warmup=100, num_samples=500, progress_bar=False, jit_model_args=True)
    start = {"weights": jnp.zeros(2)}
    means, counts = [], []
    for y in (OBSERVED, OBSERVED + 3.0, OBSERVED - 3.0):
        mcmc.run(jax.random.key(0), X, y, init_params=start, noise=0.1)
        means.append(mcmc.get_samples()["weights"][:, 0].mean())
        counts.append(traced)
    assert means[2] + 1 < means[0] < means[1] - 1
    traced = 0
    EllipticalSlice(model).init(jax.random.key(0), 100, start, (X, OBSERVED), {"noise": 0.1})
    assert np.diff(counts).tolist() == [traced, traced]


@pytest.mark.slow
def test_data_sets_can_be_mapped_over():
    def draws(y):
        return run(EllipticalSlice(regression), 0, X, y=y, warmup=10, samples=20, chains=2).get_samples()["weights"]

    together = jax.jit(jax.vmap(draws))(jnp.stack([OBSERVED, OBSERVED + 1.0]))
    np.testing.assert_allclose(together[1], draws(OBSERVED + 1.0), rtol=1e-8)


def test_sampling_goes_on_from_a_warm_state():
    mcmc = MCMC(EllipticalSlice(regression), num_warmup=30, num_samples=10, num_chains=2, chain_method="vectorized",
                progress_bar=False)
    mcmc.warmup(jax.random.key(0), X, y=OBSERVED)
    mcmc.run(jax.random.key(1), X, y=OBSERVED, extra_fields=("i",))
    assert np.array_equal(mcmc.get_extra_fields(True)["i"], [np.arange(31, 41)] * 2)
    assert mcmc.get_samples()["weights"].shape == (20, 2)


def test_kernel_can_be_pickled():
    mcmc = run(EllipticalSlice(regression), 0, X, y=OBSERVED, warmup=5, samples=10, chains=1)
    copy = pickle.loads(pickle.dumps(mcmc))
    np.testing.assert_array_equal(copy.get_samples()["weights"], mcmc.get_samples()["weights"])
    copy.run(jax.random.key(0), X, y=OBSERVED)
    np.testing.assert_array_equal(copy.get_samples()["weights"], mcmc.get_samples()["weights"])


# Errors


def no_latent():
    numpyro.sample("y", dist.Normal(), obs=0.0)


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


@pytest.mark.parametrize(
    ("model", "init_params", "message"),
    [
        (no_latent, None, "no latent site.*Give at least one parameter a Gaussian prior"),
        (positive, None, r"'noise' \(HalfNormal\), 'gap' \(Beta\)\. Fix them with.*or use NUTS or lfm.RAM"),
        (improper, None, r"'x' \(ImproperUniform\)"),
        (centred, None, "prior of site 'x' depends on other latent sites.*standard normal.*LocScaleReparam.*pass obs"),
        (scale_depends, None, "prior of site 'b' depends on other latent sites"),
        (family_depends, None, "prior of site 'b' depends on other latent sites"),
        (subsampled, None, "plate 'rows' takes 4 of 10 at random.*Leave out subsample_size"),
        (masked, None, "prior of site 'x' is masked.*observed sites alone"),
        (badly_scaled, None, r"scale of latent site 'x' must be one number, got shape \(2,\)"),
        (impossible, None, "no starting point.*NaN or infinite at 100 points.*init_params"),
        (impossible, {"x": np.zeros(2)}, "starting point has log likelihood -inf, which must be finite"),
        (impossible, {}, r"dict of the latent sites with shapes {'x': \(2,\)}, got {}"),
        (impossible, {"x": np.zeros(3)}, r"got {'x': \(3,\)}"),
        (impossible, np.zeros(2), "got ndarray"),
    ],
)
def test_bad_models_and_starts_are_named(model, init_params, message):
    with pytest.raises(ValueError, match=message):
        EllipticalSlice(model).init(jax.random.key(0), 10, init_params)


def test_observed_where_it_would_be_dependent():
    state = EllipticalSlice(centred).init(jax.random.key(0), 0, None, (), {"obs": 1.0})
    assert set(state.z) == {"location"}


def test_errors_of_vectorised_chains():
    keys = jax.random.split(jax.random.key(0), 2)
    with pytest.raises(ValueError, match=r"starting point has log likelihood \[  0. -inf\]"):
        EllipticalSlice(impossible).init(keys, 10, {"x": np.array([[1e7, 0.0], [0.0, 0.0]])})
    with pytest.raises(ValueError, match=r"shapes {'x': \(2, 2\)}, got {'x': \(2,\)}"):
        EllipticalSlice(impossible).init(keys, 10, {"x": np.zeros(2)})


def test_init_strategy_sets_the_start():
    kernel = EllipticalSlice(impossible, init_strategy=init_to_value(values={"x": jnp.array([1e7, 2.0])}))
    state = kernel.init(jax.random.key(0), 10)
    np.testing.assert_array_equal(state.z["x"], [1e7, 2.0])
    # By default chains start from draws of the prior.
    keys = jax.random.split(jax.random.key(0), 4000)
    draws = EllipticalSlice(two_sites).init(keys, 0).z["a"]
    assert kstest((np.asarray(draws) - 1.0) / 2.0, "norm").pvalue > 1e-3
