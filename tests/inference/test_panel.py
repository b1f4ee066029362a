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
from lfm_ppl.utils.batching import mapped

TIMES = np.array([0.0, 0.5, 1.5, 2.0, 3.5])
RATES = np.array([0.4, 0.9, 1.6])
LENGTHSCALE = 1.3


def build(rate, lengthscale, softness=1.0):
    """A non-linear model of one output."""
    return lfm.LatentForceModel(
        dynamics=lambda x, u, t: jax.nn.softplus(softness * u) - rate * x,
        forces={"u": lfm.Matern(1.0, lengthscale, order=1)},
        observation=lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.05])),
        initial_state=lfm.Gaussian(jnp.zeros(1), 0.2 * jnp.eye(1)),
    )


def one(rate, lengthscale, times, y):
    return lfm.MarginalLikelihood(build(rate, lengthscale), times, steps=4).log_prob_per_observation(y)


def panel(rates, lengthscale, times=TIMES):
    """The lengthscale is shared: the builder closes over it."""
    return lfm.panel(lambda p: build(p["rate"], lengthscale), {"rate": rates}, times, steps=4)


@pytest.fixture(scope="module")
def y():
    y = np.abs(np.random.default_rng(0).normal(1.0, 0.5, (3, len(TIMES), 1)))
    y[1, 2] = np.nan
    return y


@pytest.fixture(scope="module")
def looped(y):
    """Per-observation log densities (3, T), and gradients of each series' sum, one series after another."""
    both = jax.jit(lambda r, s, t, y: (one(r, s, t, y),
                                       jax.grad(lambda r, s: one(r, s, t, y).sum(), argnums=(0, 1))(r, s)))
    return [both(r, LENGTHSCALE, TIMES, y) for r, y in zip(RATES, y, strict=True)], both


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


def test_panel_equals_a_loop(y, looped):
    each, _ = looped

    @jax.jit
    def evaluate(rates, lengthscale, y):
        distribution = panel(rates, lengthscale)
        gradient = jax.grad(lambda r, s: panel(r, s).log_prob(y).sum(), argnums=(0, 1))(rates, lengthscale)
        return distribution.log_prob(y), distribution.log_prob_per_observation(y), gradient

    values, observations, (by_rate, by_lengthscale) = evaluate(RATES, LENGTHSCALE, y)
    assert values.shape == (3,)
    np.testing.assert_allclose(observations, np.stack([e[0] for e in each]), rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(values, [e[0].sum() for e in each], rtol=1e-10)
    np.testing.assert_allclose(by_rate, [e[1][0] for e in each], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(by_lengthscale, sum(e[1][1] for e in each), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("own_times", [False, True], ids=["shared times", "own times"])
def test_many_series_go_one_after_another_on_a_cpu(y, monkeypatch, own_times):
    """To the same values and gradients as side by side."""
    count = 9
    index = np.arange(count) % 3
    rates, several = RATES[index] + 0.01 * np.arange(count), y[index]
    times = TIMES * (1.0 + 0.1 * np.arange(count)[:, None]) if own_times else TIMES

    def evaluate():
        total = lambda rates, lengthscale: panel(rates, lengthscale, times).log_prob(several).sum()  # noqa: E731
        return jax.jit(jax.value_and_grad(total, argnums=(0, 1)))

    monkeypatch.setattr("lfm_ppl.utils.batching.on_cpu", lambda: True)
    loops = lambda: str(jax.make_jaxpr(evaluate())(rates, LENGTHSCALE)).count(f"length={count}")  # noqa: E731
    assert loops()
    one_by_one = evaluate()(rates, LENGTHSCALE)
    monkeypatch.setattr("lfm_ppl.utils.batching.on_cpu", lambda: False)
    assert not loops()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12), one_by_one,
                 evaluate()(rates, LENGTHSCALE))


def test_batches_of_results_without_entries(monkeypatch):
    monkeypatch.setattr("lfm_ppl.utils.batching.on_cpu", lambda: True)
    x = jnp.arange(24.0).reshape(12, 2)
    total, empty = mapped(lambda row: (row.sum(), row[:0]), x, batch_size=4)
    np.testing.assert_array_equal(total, x.sum(1))
    assert empty.shape == (12, 0)


def test_series_with_times_of_their_own(y, looped, together):
    _, loop = looped
    times = np.stack([TIMES, 1.7 * TIMES, TIMES**1.2 + 1.0])
    values, (by_rate, _) = together(RATES, LENGTHSCALE, times, y)
    for index in range(3):
        density, (slope, _) = loop(RATES[index], LENGTHSCALE, times[index], y[index])
        np.testing.assert_allclose(values[index], density.sum(), rtol=1e-10)
        np.testing.assert_allclose(by_rate[index], slope, rtol=1e-10, atol=1e-10)


def test_ragged_series_are_padded(y, together):
    short = 3
    times = np.stack([TIMES, TIMES, np.concatenate([TIMES[:short], np.repeat(TIMES[short - 1], 2)])])
    ragged = y.copy()
    ragged[2, short:] = np.nan
    values, gradients = together(RATES, LENGTHSCALE, times, ragged)
    alone = jax.jit(one)(RATES[2], LENGTHSCALE, TIMES[:short], y[2, :short])
    np.testing.assert_allclose(values[2], alone.sum(), rtol=1e-10)
    assert all(np.all(np.isfinite(gradient)) for gradient in gradients)


def test_an_all_missing_series_contributes_zero(y, together):
    missing = y.copy()
    missing[1] = np.nan
    times = np.broadcast_to(TIMES, (3, len(TIMES)))
    values, (by_rate, _) = together(RATES, LENGTHSCALE, times, missing)
    assert values[1] == 0.0
    assert by_rate[1] == 0.0
    assert np.all(values[[0, 2]] != 0.0)


def test_one_impossible_series_leaves_the_others_alone(y, together):
    times = np.broadcast_to(TIMES, (3, len(TIMES)))
    good, (slopes, _) = together(RATES, LENGTHSCALE, times, y)
    values, (by_rate, by_lengthscale) = together(np.array([0.4, np.inf, 1.6]), LENGTHSCALE, times, y)
    assert np.isneginf(values).tolist() == [False, True, False]
    np.testing.assert_allclose(values[[0, 2]], good[[0, 2]], rtol=1e-12)
    np.testing.assert_allclose(by_rate[[0, 2]], slopes[[0, 2]], rtol=1e-8)
    assert by_rate[1] == 0.0
    assert np.isfinite(by_lengthscale)


def test_in_a_plate(y, looped):
    each, _ = looped

    def model(times, y=None, mask=None):
        lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.0, 0.3))
        with numpyro.plate("series", 3):
            rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
            with handlers.mask(mask=mask):
                numpyro.sample("y", panel(rate, lengthscale, times), obs=y)

    values = {"rate": jnp.asarray(RATES), "lengthscale": jnp.asarray(LENGTHSCALE)}
    score = jax.jit(lambda mask: log_density(model, (TIMES, y, mask), {}, values)[0])
    prior = dist.LogNormal(0.0, 0.5).log_prob(RATES).sum() + dist.LogNormal(0.0, 0.3).log_prob(LENGTHSCALE)
    series = np.array([e[0].sum() for e in each])
    for mask in ([True, True, True], [True, False, True]):
        np.testing.assert_allclose(score(jnp.array(mask)), prior + series[mask].sum(), rtol=1e-10)
    draws = Predictive(model, num_samples=2)(jax.random.key(0), TIMES, mask=True)
    assert draws["y"].shape == (2, 3, len(TIMES), 1)
    assert np.all(np.isfinite(draws["y"]))


def test_one_series_in_a_plate_is_an_error(y):
    def model(times, y=None):
        with numpyro.plate("series", 3):
            numpyro.sample("y", lfm.MarginalLikelihood(build(0.5, LENGTHSCALE), times), obs=y)

    with pytest.raises(ValueError, match=r"one series.*batch shape \(3,\) of a numpyro.plate.*take lfm.panel"):
        handlers.trace(handlers.seed(model, 0)).get_trace(TIMES, y)
    single = lfm.MarginalLikelihood(build(0.5, LENGTHSCALE), TIMES)
    assert single.expand(()) is single

    def vectors(times):
        with numpyro.plate("series", 3):
            lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.0, 0.5))
            numpyro.sample("y", lfm.MarginalLikelihood(build(0.5, lengthscale), times))

    with pytest.raises(ValueError, match=r"lengthscale must be one number.*numpyro.plate, take lfm.panel"):
        handlers.trace(handlers.seed(vectors, 0)).get_trace(TIMES)


def test_samples(y):
    distribution = panel(RATES, LENGTHSCALE)
    assert (distribution.batch_shape, distribution.event_shape) == ((3,), (len(TIMES), 1))
    draws = jax.jit(distribution.sample, static_argnums=1)(jax.random.key(0), (400,))
    assert draws.shape == (400, 3, len(TIMES), 1)
    # Series are independent: the correlation of their means is zero within its error
    means = np.asarray(draws).mean((2, 3))
    correlation = np.corrcoef(means.T)[np.triu_indices(3, 1)]
    assert np.abs(correlation).max() < 4.5 / np.sqrt(400)
    # A faster decay means a lower level
    assert np.all(np.diff(means.mean(0)) < 0)
    batch = jax.jit(distribution.log_prob)(draws[:2])
    assert batch.shape == (2, 3)


def test_rebuilt_as_a_pytree(y, looped):
    each, _ = looped
    leaves, tree = jax.tree.flatten(panel(jnp.asarray(RATES), LENGTHSCALE, jnp.asarray(TIMES)))
    again = jax.jit(lambda leaves, y: tree.unflatten(leaves).log_prob(y))(leaves, y)
    np.testing.assert_allclose(again, [e[0].sum() for e in each], rtol=1e-10)


def test_errors(y):
    with pytest.raises(ValueError, match="parameters must hold at least one array"):
        lfm.panel(lambda p: build(1.0, 1.0), {}, TIMES)
    with pytest.raises(ValueError, match=r"same leading axis.*\(3,\), \(2,\).*close over it in build"):
        lfm.panel(lambda p: build(p[0], p[1]), (RATES, RATES[:2]), TIMES)
    with pytest.raises(ValueError, match=r"same leading axis.*\(\)"):
        lfm.panel(lambda p: build(p["rate"], p["l"]), {"rate": RATES, "l": 1.0}, TIMES)
    with pytest.raises(ValueError, match="times has 2 rows for 3 series"):
        panel(RATES, LENGTHSCALE, np.stack([TIMES, TIMES]))
    with pytest.raises(ValueError, match=r"\(3, 5, 1\) \(series, times, outputs\), got \(3, 4, 1\); pad .* with NaN"):
        panel(RATES, LENGTHSCALE).log_prob(y[:, :4])
    with pytest.raises(ValueError, match="y has infinite entries"):
        panel(RATES, LENGTHSCALE).log_prob(np.where(np.isnan(y), np.inf, y))
    with pytest.raises(ValueError, match="times"):
        panel(RATES, LENGTHSCALE, TIMES[::-1])
    with pytest.raises(ValueError, match="max_step is not supported in a panel whose series have different times"):
        lfm.panel(lambda p: build(p, 1.0), RATES, np.stack([TIMES, TIMES, TIMES]), max_step=0.1)
    with pytest.raises(TypeError, match="rule must be"):
        lfm.panel(lambda p: build(p, 1.0), RATES, TIMES, rule="cubature")
    with pytest.raises(ValueError, match="series 1: times must not go back: row 1"):
        panel(RATES, LENGTHSCALE, np.stack([TIMES, TIMES[::-1], TIMES]))
