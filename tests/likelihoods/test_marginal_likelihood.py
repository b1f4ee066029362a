import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro import handlers
from numpyro.infer import SVI, Predictive, Trace_ELBO
from numpyro.infer.autoguide import AutoNormal
from numpyro.infer.util import log_density

import lfm_ppl as lfm
from tests.inference import linear_motif as motif

TIMES = motif.TIMES
THETA = {name: jnp.asarray(value) for name, value in motif.THETA.items()}


def log_likelihood(theta, y, times=TIMES):
    return lfm.MarginalLikelihood(motif.build(**theta), times).log_prob(y)


@pytest.fixture(scope="module")
def y():
    return motif.data()


@pytest.fixture(scope="module")
def batch(y):
    """Three parameters, and the values and gradients there from one vectorised call."""
    many = jax.tree.map(lambda leaf: jnp.stack([leaf, 1.3 * leaf, 0.8 * leaf]), THETA)
    evaluate = jax.vmap(jax.value_and_grad(log_likelihood), in_axes=(0, None))
    return jax.tree.map(np.asarray, (many, *jax.jit(evaluate)(many, y)))


def test_log_prob_is_the_sum_of_the_filter_and_the_exact_density(y):
    model = motif.build(**THETA)
    likelihood = lfm.MarginalLikelihood(model, TIMES)
    assert (likelihood.batch_shape, likelihood.event_shape) == ((), (len(TIMES), 2))
    filtered = lfm.filter(model, TIMES, y).log_likelihood
    rows = jax.jit(likelihood.log_prob_per_observation)(y)
    np.testing.assert_allclose(rows, filtered, rtol=0, atol=1e-11)
    np.testing.assert_allclose(filtered.sum(), motif.log_density(y, **motif.THETA), rtol=1e-9)


def test_leading_dimensions_of_the_value_are_a_batch(y):
    many = jnp.stack([y, 2.0 * y, y - 0.3]).reshape(3, 1, *y.shape)
    batch = jax.jit(log_likelihood)(THETA, many)
    assert batch.shape == (3, 1)
    for index in range(3):
        exact = motif.log_density(np.asarray(many[index, 0]), **motif.THETA)
        np.testing.assert_allclose(batch[index, 0], exact, rtol=1e-9)


@pytest.mark.thorough
def test_vmap_over_parameters(y, batch):
    many, values, _ = batch
    for index in range(3):
        exact = motif.log_density(y, **{name: leaf[index] for name, leaf in many.items()})
        np.testing.assert_allclose(values[index], exact, rtol=1e-9)


def test_gradient_agrees_in_both_modes_and_with_the_exact_density(y, batch):
    many, _, gradients = batch
    forward = jax.jit(jax.jacfwd(log_likelihood))(THETA, y)
    for name in THETA:
        np.testing.assert_allclose(forward[name], gradients[name][0], rtol=1e-9, atol=1e-10)
    for which in range(3):
        theta = {name: leaf[which] for name, leaf in many.items()}
        for name, value in theta.items():
            for index in np.ndindex(np.shape(value)):
                step = np.zeros(np.shape(value))
                step[index] = 1e-4

                def exact(factor, theta=theta, name=name, step=step):
                    return motif.log_density(y, **{**theta, name: theta[name] + factor * step})

                difference = (8 * (exact(1) - exact(-1)) - (exact(2) - exact(-2))) / 12e-4
                np.testing.assert_allclose(gradients[name][which][index], difference, rtol=1e-7, atol=1e-9)


@pytest.mark.thorough
def test_traced_times_give_the_exact_value_and_a_finite_derivative_at_replicates(y):
    traced = jax.jit(jax.value_and_grad(lambda times: log_likelihood(THETA, y, times)))
    for times, start in ((TIMES, 0.0), (TIMES * 1.7 + 3.0, 3.0)):
        value, gradient = traced(times)
        np.testing.assert_allclose(value, motif.log_density(y, **motif.THETA, times=times - start), rtol=1e-9)
        assert np.all(np.isfinite(gradient))


def test_survives_being_rebuilt_as_a_pytree(y):
    likelihood = lfm.MarginalLikelihood(motif.build(**THETA), TIMES, rule=lfm.Taylor(), steps=7)
    likelihood.log_prob_per_observation  # noqa: B018 (what is cached must not survive)
    leaves, tree = jax.tree.flatten(likelihood)
    stretched = [2.0 * np.asarray(leaf) if np.shape(leaf) == TIMES.shape else leaf for leaf in leaves]
    result = tree.unflatten(stretched)
    assert (result.settings, result.event_shape) == (likelihood.settings, likelihood.event_shape)
    exact = motif.log_density(y, **motif.THETA, times=2.0 * TIMES)
    np.testing.assert_allclose(jax.jit(result.log_prob)(y), exact, rtol=1e-9)


# Inside NumPyro


def joint(model, y, values=motif.THETA, **keywords):
    return jax.jit(lambda values: log_density(model, (TIMES,), {"y": y, **keywords}, values)[0])(values)


@pytest.fixture(scope="module")
def prior():
    return sum(float(dist.LogNormal(np.log(value), 0.4).log_prob(value).sum()) for value in motif.THETA.values())


def test_handlers(y, prior):
    exact = motif.log_density(y, **motif.THETA)
    np.testing.assert_allclose(joint(motif.model, y), prior + exact, rtol=1e-9)
    conditioned = handlers.condition(motif.model, {"y": jnp.asarray(y)})
    np.testing.assert_allclose(joint(conditioned, None), prior + exact, rtol=1e-9)

    def model(times, y, mask, scale):
        with handlers.mask(mask=mask), handlers.scale(scale=scale):
            numpyro.sample("y", lfm.MarginalLikelihood(motif.build(**THETA), times), obs=y)

    changed = jax.jit(lambda mask, scale: log_density(model, (TIMES, y, mask, scale), {}, {})[0])
    values = [changed(True, 1.0), changed(False, 1.0), changed(True, 0.5)]
    np.testing.assert_allclose(values, [exact, 0.0, 0.5 * exact], rtol=1e-9)
    assert log_density(model, (TIMES, y, False, 1.0), {}, {})[0] == 0.0


@pytest.mark.thorough
def test_expanded_and_masked_batches(y):
    exact = motif.log_density(y, **motif.THETA)
    batch = jnp.stack([y, 2.0 * y])
    mask = jnp.array([True, False])

    @jax.jit
    def evaluate(value):
        expanded = lfm.MarginalLikelihood(motif.build(**THETA), TIMES).expand([2])
        return expanded.log_prob(value), expanded.mask(mask).log_prob(value), expanded.to_event(1).log_prob(value)

    plain, masked, event = evaluate(batch)
    np.testing.assert_allclose(plain, [exact, motif.log_density(2.0 * y, **motif.THETA)], rtol=1e-9)
    np.testing.assert_allclose(masked, [exact, 0.0], rtol=1e-9)
    np.testing.assert_allclose(event, plain.sum(), rtol=1e-12)


@pytest.mark.thorough
def test_prior_predictive_has_the_exact_moments():
    draws = 4000
    conditioned = handlers.condition(motif.model, THETA)
    y = np.asarray(Predictive(conditioned, num_samples=draws, parallel=True)(jax.random.key(3), TIMES)["y"])
    assert y.shape == (draws, len(TIMES), 2)
    chol = np.linalg.cholesky(motif.observation_covariance(TIMES, **motif.THETA))
    white = np.linalg.solve(chol, y.reshape(draws, -1).T)
    # Whitened draws are independent standard normals: means N(0, 1/n), second moments 1 +- sqrt(2/n) and 0 +- 1/sqrt(n)
    assert np.abs(white.mean(1)).max() < 4.5 / np.sqrt(draws)
    error = np.abs(white @ white.T / draws - np.eye(len(chol)))
    assert np.diag(error).max() < 4.5 * np.sqrt(2.0 / draws)
    assert error.max() < 5.0 * np.sqrt(2.0 / draws)


@pytest.mark.slow
def test_variational_inference_raises_the_evidence_bound(y):
    svi = SVI(motif.model, AutoNormal(motif.model, init_scale=0.02), numpyro.optim.Adam(0.03), Trace_ELBO())
    state = jax.jit(svi.init)(jax.random.key(0), TIMES, y)
    # times and y are traced here
    run = jax.jit(lambda state, times, y: jax.lax.scan(lambda s, _: svi.update(s, times, y), state, length=300))
    state, losses = run(state, TIMES, y)
    first, last = np.asarray(losses[:50]), np.asarray(losses[-50:])
    assert np.all(np.isfinite(losses))
    assert first.mean() - last.mean() > 4 * np.sqrt((first.var() + last.var()) / 50)
    # The bound lies below the evidence, log E[p(y | theta)] under the prior
    normal = np.random.default_rng(1).normal(size=(2000, 4))
    spread = {"decay": normal[:, :2], "lengthscale": normal[:, 2], "noise_sd": normal[:, 3]}
    parameters = {name: motif.THETA[name] * np.exp(0.4 * z) for name, z in spread.items()}
    values = jax.jit(jax.vmap(log_likelihood, in_axes=(0, None)))(parameters, y)
    weights = np.exp(np.asarray(values) - np.max(values))
    evidence = np.log(weights.mean()) + np.max(values)
    error = weights.std() / weights.mean() / np.sqrt(len(weights)) + last.std() / np.sqrt(50)
    assert -last.mean() < evidence + 4 * error


# Failure is a number


def double_well(theta, y, times):
    alpha, beta, variance = theta
    system = lfm.LatentForceModel(
        lambda x, u, t: -(alpha * x + beta * x**3), {}, lfm.GaussianObservation(lambda x, u, t: x, variance[None]),
        lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1))
    return lfm.MarginalLikelihood(system, times, steps=2, iterations=0).log_prob(y)


IMPOSSIBLE = [
    (-1.0, -30.0, 0.1),  # explodes
    (-1.0, 1e8, 0.1),  # too stiff for an explicit method
    (np.inf, 0.1, 0.1),
    (-1.0, 0.1, np.nan),
    (-1.0, 0.1, np.inf),
    (-1.0, 0.1, -100.0),  # no covariance
]
POSSIBLE = [(-1.0, 0.1, 0.1), (-0.5, 0.2, 0.3)]


@pytest.fixture(scope="module")
def failures():
    """Values and gradients, in reverse and in forward mode, at possible and impossible parameters side by side."""
    times, y = np.arange(6.0), np.ones((6, 1))

    def evaluate(theta):
        value, reverse = jax.value_and_grad(double_well)(theta, y, times)
        return value, reverse, jax.jacfwd(double_well)(theta, y, times)

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(evaluate))(jnp.array(POSSIBLE + IMPOSSIBLE)))


@pytest.mark.thorough
def test_impossible_parameters_have_minus_infinity_and_zero_gradients(failures):
    value, reverse, forward = (part[len(POSSIBLE):] for part in failures)
    assert np.all(value == -np.inf)
    np.testing.assert_array_equal(reverse, np.zeros((len(IMPOSSIBLE), 3)))
    np.testing.assert_array_equal(forward, np.zeros((len(IMPOSSIBLE), 3)))


@pytest.mark.thorough
def test_impossible_parameters_in_a_batch_leave_the_others_alone(failures):
    times, y = np.arange(6.0), np.ones((6, 1))
    single = jax.jit(double_well)
    for theta, value, reverse, forward in zip(POSSIBLE, *failures, strict=False):
        np.testing.assert_allclose(value, single(jnp.array(theta), y, times), rtol=1e-12)
        np.testing.assert_allclose(forward, reverse, rtol=1e-8)
        for entry in range(3):
            step = 1e-4 * np.eye(3)[entry]
            high, low = (single(jnp.array(theta + sign * step), y, times) for sign in (1, -1))
            np.testing.assert_allclose(reverse[entry], (high - low) / 2e-4, rtol=1e-5)


# Errors


def test_wrong_arguments_are_named(y):
    model = motif.build(**THETA)
    likelihood = lfm.MarginalLikelihood(model, TIMES)
    infinite = np.where(np.arange(16).reshape(8, 2) == 2, np.inf, 0.0)
    for compute, error, name in (
            (lambda: lfm.MarginalLikelihood({}, TIMES), TypeError, "model"),
            (lambda: lfm.MarginalLikelihood(model, TIMES, rule=lfm.Cubature), TypeError, "rule"),
            (lambda: lfm.MarginalLikelihood(model, TIMES, steps=0), ValueError, "steps"),
            (lambda: lfm.MarginalLikelihood(model, TIMES, iterations=-1), ValueError, "iterations"),
            (lambda: lfm.MarginalLikelihood(model, TIMES, iterations=2, damping=0.0), ValueError, "damping"),
            (lambda: lfm.MarginalLikelihood(model, TIMES[::-1]), ValueError, "times"),
            (lambda: likelihood.log_prob(np.zeros((8, 3))), ValueError, r"\(8, 2\)"),
            (lambda: likelihood.log_prob(infinite), ValueError, r"y\[1, 0\]"),
            (lambda: likelihood.log_prob(np.full((8, 2), np.nan)), ValueError, "missing")):
        with pytest.raises(error, match=name):
            compute()
