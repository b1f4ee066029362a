import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro import handlers
from numpyro.infer import Predictive
from numpyro.infer.util import log_density

import lfm_ppl as lfm

TIMES = np.array([0.0, 0.5, 1.5, 2.0, 3.5])
RATES = np.array([0.4, 0.9, 1.6])
LENGTHSCALE = 1.3


def build(rate, lengthscale):
    """A linear model of one output, of which little is compiled."""
    return lfm.LatentForceModel(
        dynamics=lambda x, u, t: u - rate * x,
        forces={"u": lfm.Matern(1.0, lengthscale, order=1)},
        observation=lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.05])),
        initial_state=lfm.Gaussian(jnp.zeros(1), 0.2 * jnp.eye(1)),
    )


def row_density(rate, lengthscale, times, y):
    return lfm.MarginalLikelihood(build(rate, lengthscale), times, steps=1, iterations=0).log_prob_per_observation(y)


def panel(rates, lengthscale, times=TIMES):
    """The lengthscale is shared: the builder closes over it."""
    return lfm.panel(lambda p: build(p["rate"], lengthscale), {"rate": rates}, times, steps=1, iterations=0)


@pytest.fixture(scope="module")
def y():
    y = np.abs(np.random.default_rng(0).normal(1.0, 0.5, (3, len(TIMES), 1)))
    y[1, 2] = np.nan
    return y


@pytest.fixture(scope="module")
def looped(y):
    """Per-observation log densities (3, T), and gradients of each series' sum, one series after another."""
    evaluate = jax.jit(lambda r, s, t, y: (row_density(r, s, t, y),
                                           jax.grad(lambda r, s: row_density(r, s, t, y).sum(), argnums=(0, 1))(r, s)))
    return [evaluate(r, LENGTHSCALE, TIMES, y) for r, y in zip(RATES, y, strict=True)], evaluate


@pytest.fixture(scope="module")
def together():
    """One compiled panel whose series have times of their own: (log_prob, gradients of its sum)."""

    def evaluate(rates, lengthscale, times, y):
        def total(rates, lengthscale):
            values = panel(rates, lengthscale, times).log_prob(y)
            return values.sum(), values

        gradients, values = jax.grad(total, argnums=(0, 1), has_aux=True)(rates, lengthscale)
        return values, gradients

    compiled = jax.jit(evaluate)
    return lambda *arguments: jax.tree.map(np.asarray, compiled(*arguments))


@pytest.mark.thorough
def test_requested_times_that_are_traced_are_nodes(y):
    """With a known input, whose jump divides intervals and their steps."""
    heat = lfm.Input([0.0, 0.8, 2.2], [0.0, 1.0, 0.3], interpolation="previous", outside="hold")
    model = lfm.LatentForceModel(
        lambda x, u, t: u + heat(t) - x**3, {"u": lfm.Matern(1.0, LENGTHSCALE)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.05])), lfm.Gaussian(jnp.zeros(1), 0.2 * jnp.eye(1)))
    requested = np.array([1.0, 0.5, 3.0, 4.0])

    @jax.jit
    def smooth(times, requested):
        result = lfm.MarginalLikelihood(model, times, iterations=0).smooth(y[0], requested)
        return result.mean, result.covariance, result.log_likelihood

    expected = lfm.smooth(model, TIMES, y[0], at=requested, steps=40, iterations=0)
    for computed, exact in zip(smooth(TIMES, requested), (
            expected.mean, expected.covariance, expected.log_likelihood), strict=True):
        np.testing.assert_allclose(computed, exact, atol=2e-5)


def test_panel_equals_a_loop(y, looped):
    results, _ = looped

    @jax.jit
    def evaluate(rates, lengthscale, y):
        distribution = panel(rates, lengthscale)
        gradient = jax.grad(lambda r, s: panel(r, s).log_prob(y).sum(), argnums=(0, 1))(rates, lengthscale)
        return distribution.log_prob(y), distribution.log_prob_per_observation(y), gradient

    values, observations, (by_rate, by_lengthscale) = evaluate(RATES, LENGTHSCALE, y)
    assert values.shape == (3,)
    np.testing.assert_allclose(observations, np.stack([e[0] for e in results]), rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(values, [e[0].sum() for e in results], rtol=1e-10)
    np.testing.assert_allclose(by_rate, [e[1][0] for e in results], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(by_lengthscale, sum(e[1][1] for e in results), rtol=1e-10, atol=1e-10)


@pytest.mark.thorough
def test_many_series_go_one_after_another_on_a_cpu(y, monkeypatch):
    """To the same values and gradients as side by side, with times of their own."""
    count = 9
    index = np.arange(count) % 3
    rates, several = RATES[index] + 0.01 * np.arange(count), y[index]
    times = TIMES * (1.0 + 0.1 * np.arange(count)[:, None])

    def evaluate():
        return jax.jit(jax.value_and_grad(lambda rates, lengthscale: panel(rates, lengthscale, times).log_prob(
            several).sum(), argnums=(0, 1)))

    def count_loops():
        return str(jax.make_jaxpr(evaluate())(rates, LENGTHSCALE)).count(f"length={count}")

    monkeypatch.setattr("lfm_ppl.utils.batching.on_cpu", lambda: True)
    assert count_loops()
    in_sequence = evaluate()(rates, LENGTHSCALE)
    monkeypatch.setattr("lfm_ppl.utils.batching.on_cpu", lambda: False)
    assert not count_loops()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12), in_sequence,
                 evaluate()(rates, LENGTHSCALE))


@pytest.mark.thorough
def test_series_with_times_of_their_own_padded_or_all_missing(y, looped, together):
    _, loop = looped
    short = 3
    padded = np.concatenate([TIMES[:short], np.repeat(TIMES[short - 1], 2)])
    times, ragged = np.stack([TIMES, 1.7 * TIMES, padded]), y.copy()
    ragged[2, short:] = np.nan
    values, (by_rate, _) = together(RATES, LENGTHSCALE, times, ragged)
    for index in range(3):
        density, (slope, _) = loop(RATES[index], LENGTHSCALE, times[index], ragged[index])
        np.testing.assert_allclose(values[index], density.sum(), rtol=1e-10)
        np.testing.assert_allclose(by_rate[index], slope, rtol=1e-10, atol=1e-10)
    alone = lfm.filter(build(RATES[2], LENGTHSCALE), TIMES[:short], y[2, :short], steps=1)
    np.testing.assert_allclose(values[2], alone.log_likelihood.sum(), rtol=1e-10)
    ragged[1] = np.nan
    values, (by_rate, _) = together(RATES, LENGTHSCALE, times, ragged)
    assert values[1] == by_rate[1] == 0.0 and np.all(values[[0, 2]] != 0.0)


def test_one_impossible_series_leaves_the_others_alone(y, together):
    times = np.broadcast_to(TIMES, (3, len(TIMES)))
    good, (slopes, _) = together(RATES, LENGTHSCALE, times, y)
    values, (by_rate, by_lengthscale) = together(np.array([0.4, np.inf, 1.6]), LENGTHSCALE, times, y)
    assert np.isneginf(values).tolist() == [False, True, False]
    np.testing.assert_allclose(values[[0, 2]], good[[0, 2]], rtol=1e-12)
    np.testing.assert_allclose(by_rate[[0, 2]], slopes[[0, 2]], rtol=1e-8)
    assert by_rate[1] == 0.0
    assert np.isfinite(by_lengthscale)


@pytest.mark.thorough
def test_in_a_plate(y, looped):
    results, _ = looped

    def model(times, y=None, mask=None):
        lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.0, 0.3))
        with numpyro.plate("series", 3):
            rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
            with handlers.mask(mask=mask):
                numpyro.sample("y", panel(rate, lengthscale, times), obs=y)

    values = {"rate": jnp.asarray(RATES), "lengthscale": jnp.asarray(LENGTHSCALE)}
    score = jax.jit(lambda mask: log_density(model, (TIMES, y, mask), {}, values)[0])
    prior = dist.LogNormal(0.0, 0.5).log_prob(RATES).sum() + dist.LogNormal(0.0, 0.3).log_prob(LENGTHSCALE)
    series = np.array([e[0].sum() for e in results])
    for mask in ([True, True, True], [True, False, True]):
        np.testing.assert_allclose(score(jnp.array(mask)), prior + series[mask].sum(), rtol=1e-10)
    draws = Predictive(model, num_samples=2)(jax.random.key(0), TIMES, mask=True)
    assert draws["y"].shape == (2, 3, len(TIMES), 1)
    assert np.all(np.isfinite(draws["y"]))


def test_one_series_in_a_plate_is_an_error(y):
    def model(times, y=None, lengthscale=LENGTHSCALE):
        with numpyro.plate("series", 3):
            numpyro.sample("y", lfm.MarginalLikelihood(build(0.5, lengthscale), times), obs=y)

    for lengthscale in (LENGTHSCALE, LENGTHSCALE * jnp.ones(3)):
        with pytest.raises(ValueError, match="lfm.panel"):
            handlers.trace(handlers.seed(model, 0)).get_trace(TIMES, y, lengthscale)
    single = lfm.MarginalLikelihood(build(0.5, LENGTHSCALE), TIMES)
    assert single.expand(()) is single


@pytest.mark.thorough
def test_samples(y):
    distribution = panel(RATES, LENGTHSCALE)
    assert (distribution.batch_shape, distribution.event_shape) == ((3,), (len(TIMES), 1))
    draws = jax.jit(distribution.sample, static_argnums=1)(jax.random.key(0), (400,))
    assert draws.shape == (400, 3, len(TIMES), 1)
    # Series are independent: the correlation of their means is zero within its error
    draws = np.asarray(draws)
    means = draws.mean((2, 3))
    correlation = np.corrcoef(means.T)[np.triu_indices(3, 1)]
    assert np.abs(correlation).max() < 4.5 / np.sqrt(400)
    assert np.all(np.diff(draws.std((0, 2, 3))) < 0)  # a faster decay means less variance
    batch = jax.jit(distribution.log_prob)(draws[:2])
    assert batch.shape == (2, 3)


def test_rebuilt_as_a_pytree(y, looped):
    results, _ = looped
    leaves, tree = jax.tree.flatten(panel(jnp.asarray(RATES), LENGTHSCALE, jnp.asarray(TIMES)))
    rebuilt = jax.jit(lambda leaves, y: tree.unflatten(leaves).log_prob(y))(leaves, y)
    np.testing.assert_allclose(rebuilt, [e[0].sum() for e in results], rtol=1e-10)


def test_wrong_arguments_are_named(y):
    three = np.stack([TIMES] * 3)
    for compute, error, name in (
            (lambda: lfm.panel(lambda p: build(1.0, 1.0), {}, TIMES), ValueError, "parameters"),
            (lambda: lfm.panel(lambda p: build(p[0], p[1]), (RATES, RATES[:2]), TIMES), ValueError, r"\(3,\), \(2,\)"),
            (lambda: panel(RATES, LENGTHSCALE, three[:2]), ValueError, "times has 2 rows"),
            (lambda: panel(RATES, LENGTHSCALE).log_prob(y[:, :4]), ValueError, r"\(3, 5, 1\)"),
            (lambda: panel(RATES, LENGTHSCALE).log_prob(np.full(y.shape, np.inf)), ValueError, "y has infinite"),
            (lambda: panel(RATES, LENGTHSCALE, TIMES[::-1]), ValueError, "times"),
            (lambda: lfm.panel(lambda p: build(p, 1.0), RATES, three, max_step=0.1), ValueError, "max_step"),
            (lambda: lfm.panel(lambda p: build(p, 1.0), RATES, TIMES, rule="cubature"), TypeError, "rule"),
            (lambda: panel(RATES, LENGTHSCALE, np.stack([TIMES, TIMES[::-1], TIMES])), ValueError, "series 1")):
        with pytest.raises(error, match=name):
            compute()
