"""Switching between regimes against enumeration of all paths, other filters of the library and particles."""

import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import scipy.linalg
from scipy import stats

import lfm_ppl as lfm
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.predict import predict
from lfm_ppl.switching.chain import MarkovChain, transition_matrices
from lfm_ppl.switching.regimes import filter_path, filter_regimes, sample_regimes

MERGINGS = ("gpb2", "gpb3", "imm")
RATES = np.array([[0.0, 0.3], [0.5, 0.0]])


def build(scale=1.0, noise=0.1, decay=1.0, lengthscale=1.0, level=0.0):
    """Return a state that relaxes to a level, driven by a force; both are observed."""
    return lfm.LatentForceModel(
        lambda x, u, t: decay * (level - x) + scale * u, {"u": lfm.Matern(1.0, lengthscale, order=0)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([noise])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))


def observed_force(scale):
    """Return a force that is observed alone, with a memory that is short compared with the data."""
    return lfm.LatentForceModel(
        lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(scale, 0.01)},
        lfm.GaussianObservation(lambda x, u, t: u, jnp.array([0.1])),
        lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))


def known_state(offset):
    """Return a model of a known state that decays, observed with an offset: a hidden Markov model."""
    return lfm.LatentForceModel(
        lambda x, u, t: -0.3 * x, {}, lfm.GaussianObservation(lambda x, u, t: x + offset, jnp.array([0.5])),
        lfm.Gaussian(jnp.ones(1), jnp.zeros((1, 1))))


def heater(power):
    """Return the temperature of a room that a heater warms, without process noise."""
    return lfm.LatentForceModel(
        lambda x, u, t: power - 0.2 * (x - 5.0), {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.09])),
        lfm.Gaussian(jnp.array([8.0]), jnp.eye(1)))


def heater_and_wall(power):
    """Return the temperatures of a room, which is measured, and of its wall, without process noise."""
    return lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([power - 0.2 * (x[0] - 5.0) + 0.5 * (x[1] - x[0]), 0.1 * (x[0] - x[1])]), {},
        lfm.GaussianObservation(lambda x, u, t: x[:1], jnp.array([0.09])),
        lfm.Gaussian(jnp.array([8.0, 8.0]), jnp.eye(2)))


def enumerate_paths(switching, y):
    """Return the log density, probabilities of the regimes and means from all K^T paths.

    Given a path all observations are jointly Gaussian, with a dense covariance of the state-space form, in NumPy.
    """
    regimes = switching.regimes()
    times, ssms = np.asarray(switching.times), switching.ssms
    count, length = len(ssms), len(times)
    size = ssms[0].state_dim
    maps = []
    for problem in regimes.problems:
        rows = []
        for k in range(length):
            interval = jax.tree.map(lambda a, k=k: jnp.asarray(a)[k], problem.grid.intervals)
            p = predict(problem, interval, Moments(jnp.zeros(size), jnp.zeros((size, size))), record=Record.SMOOTHER)
            rows.append(tuple(np.asarray(a) for a in (p.phi, p.moments.mean, p.process_cov)))
        maps.append(rows)
    zero = jnp.zeros(size)
    outputs = [(np.asarray(jax.jacfwd(lambda s, m=ssm: m.observe(m.inputs(s, 0.0), 0.0))(zero)),
                np.asarray(ssm.observe(ssm.inputs(zero, 0.0), 0.0)), np.asarray(ssm.obs_cov(zero, 0.0, 0)))
               for ssm in ssms]
    lengths = np.diff(times)
    chain = [scipy.linalg.expm(np.asarray(switching.rates) * dt) for dt in lengths]
    log_weights, means = [], []
    for path in itertools.product(range(count), repeat=length):
        log_weight = np.log(switching.initial[path[0]]) + sum(
            np.log(chain[k][path[k], path[k + 1]]) for k in range(length - 1))
        mean, covariance = (np.asarray(a) for a in ssms[path[0]].initial())
        state_means, cross = [], np.zeros((length * size,) * 2)
        for k, regime in enumerate(path):
            phi, offset, noise = maps[regime][k]
            mean, covariance = phi @ mean + offset, phi @ covariance @ phi.T + noise
            block = slice(k * size, (k + 1) * size)
            if k:
                previous = cross[(k - 1) * size:k * size, :k * size]
                cross[block, :k * size] = phi @ previous
                cross[:k * size, block] = cross[block, :k * size].T
            cross[block, block] = covariance
            state_means.append(mean)
        h = scipy.linalg.block_diag(*(outputs[r][0] for r in path))
        mu = h @ np.concatenate(state_means) + np.concatenate([outputs[r][1] for r in path])
        s = h @ cross @ h.T + scipy.linalg.block_diag(*(outputs[r][2] for r in path))
        data = np.ravel(y)
        present = np.isfinite(data)
        data, mu, h, s = data[present], mu[present], h[present], s[np.ix_(present, present)]
        log_weights.append(log_weight + stats.multivariate_normal.logpdf(data, mu, s))
        means.append(np.concatenate(state_means) + cross @ h.T @ np.linalg.solve(s, data - mu))
    total = np.logaddexp.reduce(log_weights)
    weights = np.exp(np.array(log_weights) - total)
    paths = np.array(list(itertools.product(range(count), repeat=length)))
    probability = np.stack([weights @ (paths == regime) for regime in range(count)], axis=1)
    return SimpleNamespace(total=total, probability=probability,
                           mean=(weights @ np.array(means)).reshape(length, size))


def exact_cases():
    rates = np.array([[0.0, 0.4, 0.1], [0.2, 0.0, 0.3], [0.6, 0.1, 0.0]])
    return {"known state": ({name: known_state(offset) for name, offset in zip("abc", (-1.0, 0.0, 1.0), strict=True)},
                            rates, np.array([0.0, 0.5, 1.5, 1.7, 3.0])),
            "short memory": ({"low": observed_force(0.5), "high": observed_force(2.0)}, RATES, np.arange(8.0))}


@pytest.mark.thorough
@pytest.mark.parametrize("merging", MERGINGS)
@pytest.mark.parametrize("case", exact_cases())
def test_the_density_equals_enumeration_where_merging_is_exact(case, merging):
    models, rates, times = exact_cases()[case]
    switching = lfm.Switching(models, rates, times, merging=merging, initial=np.full(len(models), 1 / len(models)))
    y = np.random.default_rng(0).normal(size=(len(times), 1))
    exact = enumerate_paths(switching, y)
    np.testing.assert_allclose(switching.log_prob(y), exact.total, rtol=1e-10)
    smoothed = switching.smooth(y)
    # Averages over 256 draws.
    np.testing.assert_allclose(smoothed.probability, exact.probability, atol=0.07)


@pytest.mark.thorough
@pytest.mark.parametrize(("merging", "rows"), [("gpb2", 2), *(
    pytest.param(*case, marks=pytest.mark.thorough) for case in (("gpb3", 3), ("gpb4", 4)))])
def test_short_records_equal_enumeration(merging, rows):
    """No two histories are merged before the last row."""
    models = {"calm": build(0.3), "rough": build(2.0, 0.3), "far": build(level=2.0)}
    rates = np.array([[0.0, 0.3, 0.1], [0.5, 0.0, 0.2], [0.4, 0.1, 0.0]])
    switching = lfm.Switching(models, rates, np.cumsum(np.arange(rows) / 2), merging=merging)
    y = np.array([[0.3], [1.5], [-0.8], [2.0]])[:rows]
    np.testing.assert_allclose(switching.log_prob(y), enumerate_paths(switching, y).total, rtol=1e-10)


@pytest.mark.thorough
def test_draws_have_the_smoothing_distribution():
    switching = lfm.Switching({"calm": build(0.3), "rough": build(2.0, 0.3)}, RATES, np.arange(8.0))
    y = np.asarray(switching.sample(jax.random.key(1)))
    exact, regimes = enumerate_paths(switching, y), switching.regimes()
    data = jnp.asarray(y)
    trace = filter_regimes(regimes, data)
    paths, probability = jax.jit(lambda key: sample_regimes(key, regimes, trace, data, 4000))(jax.random.key(0))
    # Three standard errors of a probability are .024; merging adds less.
    np.testing.assert_allclose((paths == 1).mean(1), exact.probability[:, 1], atol=0.03)
    np.testing.assert_allclose(probability, exact.probability, atol=0.02)
    smoothed = switching.smooth(y)
    np.testing.assert_allclose(smoothed.mean, exact.mean, atol=0.05)
    w, _ = jax.jit(jax.vmap(lambda key: switching.sample_path(key, y)))(jax.random.split(jax.random.key(1), 4000))
    states = np.asarray(w[:, :, [0, 3]])
    np.testing.assert_allclose(states.mean(0), exact.mean, atol=0.05)
    np.testing.assert_allclose(states.var(0), np.diagonal(smoothed.covariance, axis1=1, axis2=2), rtol=0.15)


HEATING = np.array([[0.0, 0.15], [0.25, 0.0]])
NOISELESS = {"room": ({"off": heater(0.0), "on": heater(4.0)}, HEATING, 9),
             "room and wall": ({"off": heater_and_wall(0.0), "on": heater_and_wall(4.0)}, HEATING, 9),
             "three powers": ({"off": heater(0.0), "half": heater(2.0), "on": heater(4.0)},
                              np.array([[0.0, 0.3, 0.1], [0.2, 0.0, 0.2], [0.1, 0.3, 0.0]]), 6)}


@pytest.mark.thorough
@pytest.mark.parametrize("case", ["room and wall", "three powers"])
def test_regimes_without_process_noise_have_the_smoothing_distribution(case):
    """A later state pins all earlier ones; rows are missing between."""
    models, rates, rows = NOISELESS[case]
    switching = lfm.Switching(models, rates, 0.5 * np.arange(rows), merging="gpb4")
    y = np.array(jax.jit(switching.sample)(jax.random.key(3)))
    y[[2, 3]] = np.nan
    exact = enumerate_paths(switching, y)
    smoothed = switching.smooth(y)
    np.testing.assert_allclose(smoothed.probability, exact.probability, atol=0.04)
    np.testing.assert_allclose(smoothed.mean, exact.mean, atol=0.06)


@pytest.mark.thorough
@pytest.mark.parametrize(("merging", "rows", "present"), [
    ("gpb2", 160, 1), pytest.param("gpb4", 160, 4, marks=pytest.mark.slow)])
def test_long_records_without_process_noise_have_the_regimes_of_the_truth(merging, rows, present):
    models, rates, _ = NOISELESS["room"]
    switching = lfm.Switching(models, rates, 0.5 * np.arange(rows), merging=merging)
    w, y = jax.jit(switching.simulate)(jax.random.key(1))
    y = jnp.where((np.arange(rows) % present == 0)[:, None], y, jnp.nan)
    draws, _ = jax.jit(jax.vmap(lambda key: switching.sample_path(key, y)))(jax.random.split(jax.random.key(0), 20))
    is_right = np.asarray(draws[:, :, 2] == w[:, 2])
    assert is_right.mean() > (0.99 if present == 1 else 0.9)
    # A change moves the temperature by 1.8 degrees a row at most, and may be drawn three rows too early or too late.
    assert np.abs(draws[:, :, 0] - w[:, 0]).max() < (1.0 if present == 1 else 3 * 1.8)
    assert np.sqrt(np.mean((draws[:, :, 0] - w[:, 0]) ** 2)) < (0.2 if present == 1 else 0.6)


@pytest.mark.thorough
def test_nonlinear_regimes_without_process_noise_equal_the_filters_of_all_paths():
    def model(sign):
        return lfm.LatentForceModel(
            lambda x, u, t: sign * x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])),
            lfm.Gaussian(jnp.ones(1), 0.1 * jnp.eye(1)))

    switching = lfm.Switching({"well": model(1.0), "flat": model(-0.5)}, RATES, 0.5 * np.arange(6), merging="gpb4")
    y, regimes = jax.jit(switching.sample)(jax.random.key(0)), switching.regimes()
    paths = jnp.array(list(itertools.product(range(2), repeat=6)))
    prior = jnp.log(regimes.transitions)[np.arange(1, 6), paths[:, :-1], paths[:, 1:]].sum(1)
    filters = jax.jit(jax.vmap(lambda path: filter_path(regimes, y, path).log_likelihood.sum()))
    weight = jax.nn.softmax(prior + filters(paths))
    np.testing.assert_allclose(switching.smooth(y).probability[:, 1], weight @ paths, atol=0.05)


@pytest.mark.thorough
@pytest.mark.parametrize("merging", MERGINGS)
def test_equal_regimes_are_one_model(merging):
    times = np.array([0.0, 0.5, 0.5, 2.0, 3.0])
    y = np.array([[0.1], [np.nan], [0.4], [-1.0], [0.3]])
    single = lfm.MarginalLikelihood(build(), times)
    switching = lfm.Switching({"a": build(), "b": build()}, RATES, times, merging=merging)
    np.testing.assert_allclose(switching.log_prob(y), single.log_prob(y), rtol=1e-10)
    np.testing.assert_allclose(switching.log_prob_per_observation(y), single.log_prob_per_observation(y), atol=1e-10)
    requested_times = np.array([0.2, 1.0, 3.0, 4.5])
    smoothed, expected = switching.smooth(y, requested_times), single.smooth(y, requested_times)
    np.testing.assert_allclose(smoothed.mean, expected.mean, atol=1e-9)
    np.testing.assert_allclose(smoothed.covariance, expected.covariance, atol=1e-9)
    np.testing.assert_allclose(smoothed.state("x0"), expected.state("x0"), atol=1e-9)
    scores = switching.scores(jax.random.key(0), y)
    np.testing.assert_allclose(scores["leave_one_out"][:, 0], expected.leave_one_out, atol=1e-9)
    np.testing.assert_allclose(scores["residual"], expected.whitened_innovation, atol=1e-8)


@pytest.mark.thorough
def test_requested_times_change_no_probability():
    switching = lfm.Switching({"calm": build(0.3), "rough": build(2.0, 0.3)}, RATES, np.arange(6.0))
    y = np.asarray(switching.sample(jax.random.key(3)))
    requested_times = np.arange(0.0, 5.01, 0.25)
    smoothed = switching.smooth(y, requested_times)
    np.testing.assert_allclose(smoothed.log_likelihood.sum(), switching.log_prob(y), rtol=1e-9)
    # The regime is that of the next observation.
    np.testing.assert_allclose(smoothed.probability[1:3], np.broadcast_to(smoothed.probability[3], (2, 2)), atol=1e-9)
    np.testing.assert_allclose(smoothed.probability[3], smoothed.probability[4], atol=0.06)


def rao_blackwellised(switching, y, particles, key=0):
    """Return the log likelihood of the particle filter whose particles draw the path of regimes."""
    times, models = np.asarray(switching.times), switching.models
    lengths = np.append(np.diff(times), 0.0)
    chain = MarkovChain(times, transition_matrices(switching.rates, jnp.asarray(lengths)))
    initial_key, key = jax.random.split(jax.random.key(key))
    initial = jax.random.categorical(initial_key, jnp.log(switching.initial), shape=(particles,))
    result = lfm.rao_blackwellised(key, lambda value: models[int(value)], chain, times, y=y, initial=initial,
                                   particles=particles)
    return float(result.log_likelihood.sum())


PARTICLE_CASES = {"force": lambda: {"calm": build(0.5), "rough": build(2.0)},
                  "noise": lambda: {"sharp": build(noise=0.05), "vague": build(noise=1.0)},
                  "level": lambda: {"low": build(0.5), "high": build(0.5, level=4.0)},
                  "decay": lambda: {"slow": build(0.5, decay=0.2, level=4.0), "fast": build(0.5, decay=2.0)}}


@pytest.mark.thorough
@pytest.mark.parametrize("case", PARTICLE_CASES)
def test_the_density_is_that_of_particles(case):
    switching = lfm.Switching(PARTICLE_CASES[case](), 0.3 * RATES, np.arange(40.0), merging="gpb4")
    y = np.asarray(switching.sample(jax.random.key(2)))
    assert abs(rao_blackwellised(switching, y, 10_000) - float(switching.log_prob(y))) < 0.1


@pytest.mark.slow
def test_a_long_series_is_within_a_tenth_of_many_particles():
    switching = lfm.Switching(PARTICLE_CASES["force"](), 0.3 * RATES, np.arange(200.0))
    y = np.asarray(switching.sample(jax.random.key(2)))
    assert abs(rao_blackwellised(switching, y, 100_000) - float(switching.log_prob(y))) < 0.1


@pytest.mark.thorough
@pytest.mark.parametrize("merging", [
    MERGINGS[0], *(pytest.param(name, marks=pytest.mark.thorough) for name in MERGINGS[1:])])
def test_gradients_equal_finite_differences(merging):
    times = np.array([0.0, 0.4, 1.0, 1.0, 2.5, 3.0])
    y = np.array([[0.1], [0.8], [np.nan], [1.4], [-1.0], [0.3]])

    def log_density(z):
        rates = jnp.array([[0.0, 1.0], [0.0, 0.0]]) * z[0] + jnp.array([[0.0, 0.0], [1.0, 0.0]]) * z[1]
        models = {"calm": build(z[2], z[3]), "rough": build(2.0, z[3], z[4])}
        return lfm.Switching(models, rates, times, merging=merging, initial=jnp.stack([z[5], 1 - z[5]])).log_prob(y)

    z, step = jnp.array([0.3, 0.5, 0.4, 0.2, 0.9, 0.7]), 1e-5
    function = jax.jit(log_density)
    differences = [(function(z.at[i].add(step)) - function(z.at[i].add(-step))) / (2 * step) for i in range(len(z))]
    np.testing.assert_allclose(jax.grad(function)(z), differences, rtol=1e-6, atol=1e-8)


@pytest.mark.thorough
def test_a_regime_that_cannot_be_reached_has_no_influence():
    times, y = np.arange(4.0), np.array([[0.1], [0.4], [-0.2], [0.3]])
    switching = lfm.Switching({"a": build(), "b": build(5.0)}, np.zeros((2, 2)), times, initial=[1.0, 0.0])
    np.testing.assert_allclose(switching.log_prob(y), lfm.MarginalLikelihood(build(), times).log_prob(y), rtol=1e-10)

    def log_density(rate):
        rates = jnp.array([[0.0, 1.0], [0.0, 0.0]]) * rate
        return lfm.Switching({"a": build(), "b": build(5.0)}, rates, times, initial=[1.0, 0.0]).log_prob(y)

    assert np.isfinite(jax.grad(log_density)(0.0))


ZERO_RATES = {
    "a rate": lambda rate: (rate * np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0]]), np.full(3, 1 / 3)),
    "all rates, one start": lambda rate: (rate * np.array([[0, 1, 0.5], [0.3, 0, 0.2], [0.7, 0.1, 0]]),
                                          np.array([1.0, 0.0, 0.0])),
    "the only ways to a regime": lambda rate: (rate * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
                                              + np.array([[0, 0.4, 0], [0.3, 0, 0], [0.2, 0.5, 0]]),
                                              np.array([0.6, 0.4, 0.0])),
    "a probability": lambda p: (np.array([[0, 0.2, 0.1], [0.3, 0, 0], [0.7, 0.1, 0]]), jnp.stack([1 - p, 0.0 * p, p]))}


@pytest.mark.thorough
@pytest.mark.parametrize(("case", "merging"), [
    ("a rate", "gpb2"), ("the only ways to a regime", "gpb2"), ("a probability", "imm"),
    pytest.param("all rates, one start", "gpb2", marks=pytest.mark.slow)])
def test_the_gradient_at_a_rate_of_zero_is_the_one_sided_derivative(case, merging):
    times, y = np.array([0.0, 0.4, 1.3, 1.5]), np.array([[0.1], [-0.4], [1.9], [2.2]])
    models = {"low": build(0.5), "middle": build(0.5, level=1.0), "high": build(0.5, level=3.0)}

    @jax.jit
    def log_density(rate):
        rates, initial = ZERO_RATES[case](rate)
        return lfm.Switching(models, jnp.asarray(rates), times, merging=merging, initial=initial).log_prob(y)

    gradient = jax.grad(log_density)(0.0)
    step = 1e-4 / np.abs(gradient)  # these data make some regimes a million times as probable, which curves the density
    quotient = (4 * log_density(step) - log_density(2 * step) - 3 * log_density(0.0)) / (2 * step)
    np.testing.assert_allclose(gradient, quotient, rtol=1e-5)
    np.testing.assert_allclose(jax.jvp(log_density, (0.0,), (1.0,))[1], quotient, rtol=1e-5)


def matern(scale, lengthscale):
    """Return a state that follows a Matern force of order one."""
    return lfm.LatentForceModel(
        lambda x, u, t: u - x, {"u": lfm.Matern(scale, lengthscale, order=1)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.05])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))


def matern_as_states(scale, lengthscale):
    """Return `matern` with u and u' as states of the dynamics."""
    rate = np.sqrt(3.0) / lengthscale
    return lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([x[1] - x[0], x[2], -(rate**2) * x[1] - 2 * rate * x[2]]), {},
        lfm.GaussianObservation(lambda x, u, t: x[:1], jnp.array([0.05])),
        lfm.Gaussian(jnp.zeros(3), jnp.diag(jnp.array([1.0, scale**2, (scale * rate) ** 2]))),
        process_noise=np.array([[0.0], [0.0], [2 * scale * rate**1.5]]))


@pytest.mark.thorough
def test_a_change_of_the_lengthscale_keeps_the_derivative_of_a_force():
    parameters = {"long": (1.0, 2.0), "short": (0.7, 0.4)}
    times, y = np.array([0.0, 0.5, 1.0, 1.0, 2.5]), np.array([[0.1], [0.8], [np.nan], [1.4], [-1.0]])
    forces, states = (lfm.Switching({name: make(*values) for name, values in parameters.items()}, RATES, times)
                      for make in (matern, matern_as_states))
    np.testing.assert_allclose(forces.log_prob(y), states.log_prob(y), rtol=1e-10)
    smoothed, expected = forces.smooth(y), states.smooth(y)
    np.testing.assert_allclose(smoothed.probability, expected.probability, atol=1e-8)
    # The state of the forces is (x, u, u' / rate) with the rate of the first regime.
    scale = np.array([1.0, 1.0, 2.0 / np.sqrt(3.0)])
    np.testing.assert_allclose(smoothed.mean, expected.mean * scale, atol=1e-8)
    np.testing.assert_allclose(smoothed.force("u"), expected.state("x1"), atol=1e-8)


@pytest.mark.thorough
def test_the_force_of_a_regime_has_its_mean_and_scale():
    """The system stays in the second regime, whose force has another mean."""
    def model(mean, scale):
        return lfm.LatentForceModel(
            lambda x, u, t: u[:1] + u[1:] - x, {"u": lfm.Matern(scale, 1.0, mean=mean), "v": lfm.Constant(scale)},
            lfm.GaussianObservation(lambda x, u, t: x, sd=0.2), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))

    times, y = np.array([0.0, 1.0, 1.0, 2.5]), np.array([[0.1], [np.nan], [0.4], [1.0]])
    requested_times = np.array([0.5, 1.0, 3.0])
    models = {"low": model(0.0, 1.0), "high": model(3.0, 0.5)}
    result = lfm.Switching(models, np.zeros((2, 2)), times, initial=[0.0, 1.0]).smooth(y, requested_times)
    expected = lfm.MarginalLikelihood(models["high"], times).smooth(y, requested_times)
    for name in ("u", "v"):
        np.testing.assert_allclose(result.force(name), expected.force(name), atol=1e-9)
    np.testing.assert_allclose(result.state("x0"), expected.state("x0"), atol=1e-9)
    with pytest.raises(ValueError, match="'w'"):
        result.force("w")


@pytest.mark.thorough
def test_stiff_regimes_take_exponential_steps():
    def model(rate):
        return lfm.LatentForceModel(
            lambda x, u, t: -rate * (x - jnp.tanh(u)), {"u": lfm.Matern(1.0, 1.0, order=0)},
            lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))

    times, y = np.arange(4.0), np.array([[0.1], [0.4], [-0.3], [0.2]])
    models = {"fast": model(300.0), "slow": model(1.0)}
    explicit = lfm.Switching(models, np.zeros((2, 2)), times, initial=[1.0, 0.0])
    exponential = explicit.with_settings(method="exponential")
    single = lfm.MarginalLikelihood(models["fast"], times, iterations=0, method="exponential")
    np.testing.assert_allclose(exponential.log_prob(y), single.log_prob(y), rtol=1e-9)
    assert exponential.recorded_settings["method"] == "exponential"
    assert np.isfinite(exponential.smooth(y, [0.5, 3.5]).mean).all()


@pytest.mark.thorough
def test_impossible_data_have_a_density_of_minus_infinity():
    def model(offset):
        return lfm.LatentForceModel(lambda x, u, t: -x, {}, lfm.GaussianObservation(
            lambda x, u, t: x + offset, jnp.zeros(1)), lfm.Gaussian(jnp.ones(1), jnp.zeros((1, 1))))

    switching = lfm.Switching({"a": model(0.0), "b": model(1.0)}, RATES, np.arange(3.0))
    value, gradient = jax.value_and_grad(switching.log_prob)(jnp.full((3, 1), 7.0))
    assert value == -np.inf and np.all(gradient == 0.0)
    with pytest.warns(lfm.FilterWarning, match="row 0"):
        switching.log_prob(np.full((3, 1), 7.0))


@pytest.mark.thorough
def test_simulations_have_the_moments_of_the_chain():
    times = np.array([0.0, 0.5, 1.0, 3.0])
    models = {"low": build(0.5, level=-2.0), "high": build(0.5, level=3.0)}
    switching = lfm.Switching(models, RATES, times, initial=[0.8, 0.2])
    w, y = jax.jit(jax.vmap(switching.simulate))(jax.random.split(jax.random.key(0), 4000))
    expected = np.array([0.8, 0.2]) @ np.asarray(
        [scipy.linalg.expm(np.asarray(switching.rates) * t) for t in times])
    np.testing.assert_allclose(np.asarray(w[:, :, 1:3].mean(0)), expected, atol=0.03)
    assert np.all(w[:, :, 1] + w[:, :, 2] == 1.0)
    np.testing.assert_allclose(np.var(np.asarray(y - w[:, :, :1])), 0.1, rtol=0.05)


@pytest.mark.thorough
def test_nonlinear_regimes_are_linearised():
    def model(sign):
        return lfm.LatentForceModel(
            lambda x, u, t: sign * x - x**3 + u, {"u": lfm.Matern(0.3, 1.0)},
            lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])), lfm.Gaussian(jnp.ones(1), 0.1 * jnp.eye(1)))

    times = np.arange(0.0, 6.0, 0.5)
    switching = lfm.Switching({"well": model(1.0), "flat": model(0.0)}, np.zeros((2, 2)), times, initial=[1.0, 0.0])
    y = np.asarray(switching.sample(jax.random.key(0)))
    single = lfm.MarginalLikelihood(model(1.0), times, iterations=0)
    np.testing.assert_allclose(switching.log_prob(y), single.log_prob(y), rtol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("requested", [[5.0, 12.0], np.arange(3.5, 12.1, 0.5)])
def test_forecasts_stay_in_the_range_of_the_regimes(requested):
    """From a regime without noise about its level, the state moves between the levels, and ends at both."""
    models = {name: build(1e-3, decay=2.0, level=level) for name, level in (("low", 0.0), ("high", 4.0))}
    switching = lfm.Switching(models, 2 * RATES, np.arange(4.0), initial=[1.0, 0.0])
    y = np.zeros((4, 1))
    w, _ = jax.jit(jax.vmap(lambda key: switching.sample_path(key, y, requested)))(
        jax.random.split(jax.random.key(0), 2000))
    last = np.asarray(w[:, -1, 0])
    assert -0.5 < last.min() and last.max() < 4.2
    chain = scipy.linalg.expm(np.asarray(switching.rates) * 9.0)
    np.testing.assert_allclose(w[:, -1, 2].mean(), chain[0, 1], atol=0.06)


@pytest.mark.thorough
def test_known_inputs_of_any_regime_divide_the_intervals():
    """The process noise of the second regime, which holds, has a step between two rows."""
    step = lfm.Input([0.0, 2.5, 10.0], [0.3, 3.0, 3.0], "previous")

    def model(noise):
        return lfm.LatentForceModel(
            lambda x, u, t: -x, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
            lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=noise)

    times, y = np.arange(6.0), np.array([[0.1], [0.3], [-0.2], [2.0], [-1.0], [0.5]])
    stepped = model(lambda x, u, t: jnp.reshape(step(t), (1, 1)))
    switching = lfm.Switching({"a": model(jnp.ones((1, 1))), "b": stepped}, np.zeros((2, 2)), times, initial=[0.0, 1.0])
    np.testing.assert_allclose(switching.log_prob(y), lfm.MarginalLikelihood(stepped, times).log_prob(y), rtol=1e-8)


def regimes_model(times, y=None):
    leave = numpyro.sample("leave", dist.LogNormal(-1.5, 0.5))
    rates = jnp.array([[-1.0, 1.0], [1.0, -1.0]]) * leave
    numpyro.sample("y", lfm.Switching({"calm": build(0.3), "rough": build(2.0)}, rates, times), obs=y)


@pytest.mark.thorough
def test_a_fit_has_paths_of_regimes_and_forecasts():
    times = np.arange(0.0, 20.0, 0.5)
    switching = lfm.Switching({"calm": build(0.3), "rough": build(2.0)}, 0.2 * RATES, times)
    w, y = switching.simulate(jax.random.key(4))
    result = lfm.fit(regimes_model, times, y, sampler="map", samples=100, progress=False)
    states = result["trajectories"]["states"]
    assert list(states["state"].values) == ["x0", "calm", "rough"]
    probability = states.sel(state="rough", time=times).mean(("chain", "draw"))
    assert np.isin(states.sel(state=["calm", "rough"]), [0.0, 1.0]).all()
    assert np.mean((probability > 0.5) == np.asarray(w[:, 2], bool)) > 0.75
    forecast = lfm.forecast(result, regimes_model, np.linspace(20.0, 40.0, 5), progress=False)
    # The chain forgets: both regimes are equally probable in the end.
    assert abs(forecast["predictions"]["states"].sel(state="rough")[..., -1].mean() - 0.5) < 0.2
    with pytest.raises(ValueError, match="switches between regimes"):
        lfm.check_accuracy(result, regimes_model, progress=False)


@pytest.mark.slow
def test_rates_are_calibrated():
    """The rank of the true rates among quantiles of their posterior, on a grid, is uniform over 100 simulations."""
    times, prior_mean, prior_sd = np.arange(0.0, 100.0, 0.5), np.log(0.15), 0.6
    models = {"calm": build(0.3), "rough": build(2.0)}
    grid = np.linspace(-3.0, 3.0, 25)
    points = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)

    def switching(z):
        q = jnp.exp(prior_mean + prior_sd * z)
        return lfm.Switching(models, jnp.array([[-1.0, 1.0], [0.0, 0.0]]) * q[0]
                             + jnp.array([[0.0, 0.0], [1.0, -1.0]]) * q[1], times)

    def ranks(key):
        prior_key, data_key = jax.random.split(key)
        z = jax.random.normal(prior_key, (2,))
        y = switching(z).sample(data_key)
        log_density = jax.vmap(lambda z: switching(z).log_prob(y) - 0.5 * (z**2).sum())(points)
        weight = jax.nn.softmax(log_density).reshape(25, 25)
        marginals = jnp.stack([weight.sum(1), weight.sum(0)])
        cumulative = jnp.cumsum(marginals, axis=1) - 0.5 * marginals
        return jax.vmap(lambda value, c: jnp.interp(value, grid, c))(z, cumulative)

    values = np.asarray(jax.lax.map(jax.jit(ranks), jax.random.split(jax.random.key(0), 100)))
    for column in values.T:
        assert stats.kstest(column, "uniform").pvalue > 0.01
        assert 0.89 <= np.mean((column > 0.025) & (column < 0.975)) <= 1.0


@pytest.mark.parametrize(("change", "match"), [
    ({"rates": np.zeros((3, 3))}, r"rates must be a matrix \(2, 2\)"),
    ({"rates": [[0.0, -0.1], [0.2, 0.0]]}, "must not be negative"),
    ({"rates": [[0.9, 0.1], [0.2, 0.8]]}, "transition probabilities"),
    ({"rates": [[0.0, np.inf], [0.2, 0.0]]}, "finite"),
    ({"initial": [0.5, 0.6]}, "sum to 1"),
    ({"initial": [1.0]}, "2 probabilities"),
    ({"merging": "gpb1"}, "merging"),
    ({"models": {"a": build()}}, "at least two regimes"),
    ({"models": {"a": build(), "b": known_state(0.0)}}, "has forces"),
    ({"models": {"a": build(), "u": build()}}, "'u'"),
    ({"method": "implicit"}, "method"),
])
def test_malformed_arguments_have_one_line(change, match):
    arguments = {"models": {"a": build(), "b": build()}, "rates": RATES, "times": np.arange(3.0)} | change
    with pytest.raises(ValueError, match=match) as error:
        lfm.Switching(**arguments)
    assert "\n" not in str(error.value)


@pytest.mark.thorough
def test_traced_probabilities_and_initial_times_are_checked():
    times, y = np.arange(3.0), np.zeros((3, 1))
    models = {"a": build(), "b": build()}
    assert jax.jit(lambda p: lfm.Switching(models, RATES, times, initial=p).log_prob(y))(jnp.ones(2)) == -np.inf
    early = lfm.LatentForceModel(lambda x, u, t: -x + u, {"u": lfm.Matern(1.0, 1.0, order=0)}, lfm.GaussianObservation(
        lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), initial_time=-1.0)
    with pytest.raises(ValueError, match="initial_time"):
        lfm.Switching({"a": build(), "b": early}, RATES, times)


def test_models_of_another_type_are_refused():
    with pytest.raises(TypeError, match="map the names of the regimes"):
        lfm.Switching([build(), build()], RATES, np.arange(3.0))
    counts = lfm.LatentForceModel(
        lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(1.0, 1.0)}, lfm.PoissonObservation(lambda x, u, t: u),
        lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))
    with pytest.raises(ValueError, match="GaussianObservation"):
        lfm.Switching({"a": counts, "b": counts}, RATES, np.arange(3.0))


@pytest.mark.thorough
def test_transitions_of_rates_that_are_fast_compared_with_the_rows():
    """The stationary distribution in every row, however long the time, with the derivative in a rate."""
    def transitions(rate, lengths):
        rates = jnp.array([[-rate, rate, 0.0], [1.0, -3.0, 2.0], [0.0, 4.0, -4.0]])
        return transition_matrices(rates, jnp.asarray(lengths))

    short = np.array([0.0, 0.3, 5.0])
    expected = [scipy.linalg.expm(np.array([[-0.5, 0.5, 0.0], [1.0, -3.0, 2.0], [0.0, 4.0, -4.0]]) * h) for h in short]
    np.testing.assert_allclose(jax.jit(transitions)(0.5, short), expected, atol=1e-14)
    long = np.array([1e3, 1e9, 1e16, 1e30])
    stationary = np.array([1.0, 0.5, 0.25]) / 1.75
    derivative = np.array([-1.5, 1.0, 0.5]) / 1.75**2
    value, slope = jax.jit(lambda rate: (transitions(rate, long), jax.jacfwd(transitions)(rate, long)))(0.5)
    np.testing.assert_allclose(value, np.broadcast_to(stationary, (4, 3, 3)), rtol=1e-12)
    np.testing.assert_allclose(slope, np.broadcast_to(derivative, (4, 3, 3)), rtol=1e-9)
