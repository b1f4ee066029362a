"""Discrete inputs: Rao-Blackwellised particles against plain ones, the filter and independent algebra."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy import stats

import lfm_ppl as lfm
from lfm_ppl.switching.mixture import Mixture
from lfm_ppl.switching.switched_model import is_input_additive

TIMES = np.arange(0.0, 4.01, 0.25)
ALPHA, BETA, OUTSIDE, SCALE, LENGTH, NOISE = 0.3, 5.0, 5.0, 1.0, 1.5, 0.04


def house(heater, rate=ALPHA):
    """One room at 17 degrees."""
    return lfm.LatentForceModel(
        lambda x, u, t: rate * (OUTSIDE - x) + BETA * heater + u, {"rest": lfm.Matern(SCALE, LENGTH, order=0)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([NOISE])),
        lfm.Gaussian(jnp.array([17.0]), 0.25 * jnp.eye(1)))


def leaky(heater):
    """The heater changes a rate, too."""
    return house(heater, ALPHA + 0.3 * heater)


THERMOSTAT = lfm.Thermostat(lfm.Input([0.0, 2.0], [18.0, 16.5]), hysteresis=0.4, sensor_sd=0.1)


def by_hand(generator, count):
    """Paths of the first house by its matrix exponentials: temperatures and heaters (T, count)."""
    feedback = np.array([[-ALPHA, 1.0, 1.0], [0.0, -1.0 / LENGTH, 0.0], [0.0, 0.0, 0.0]])
    diffusion = np.diag([0.0, 2 * SCALE**2 / LENGTH, 0.0])
    h = TIMES[1] - TIMES[0]
    phi = scipy.linalg.expm(feedback * h)
    van_loan = scipy.linalg.expm(np.block([[-feedback, diffusion], [np.zeros((3, 3)), feedback.T]]) * h)
    noise = (phi @ van_loan[:3, 3:])[:2, :2]
    root = np.linalg.cholesky(noise)
    state = np.stack([17.0 + 0.5 * generator.normal(size=count), SCALE * generator.normal(size=count)])
    heater, temperatures, heaters = np.zeros(count), [], []
    for k, t in enumerate(TIMES):
        if k:
            push = ALPHA * OUTSIDE + BETA * heater
            state = (phi @ np.vstack([state, push]))[:2] + root @ generator.normal(size=(2, count))
        temperatures.append(state[0])
        read = state[0] + 0.1 * generator.normal(size=count) - (18.0 if t < 2.0 else 16.5)
        heater = np.where(read < -0.2, 1.0, np.where(read > 0.2, 0.0, heater))
        heaters.append(heater)
    return np.array(temperatures), np.array(heaters)


def agree(result, paths, inputs):
    """Means of temperature and heater within four standard errors of the difference, at every time."""
    mean, sd = result.outputs.moments()
    error = np.hypot(result.outputs.error()[:, 0], paths.std(axis=1) / np.sqrt(paths.shape[1]))
    np.testing.assert_array_less(np.abs(mean[:, 0] - paths.mean(axis=1)), 4.0 * error + 1e-12)
    # A standard deviation of N draws has a relative error of at least 1/sqrt(2 N).
    np.testing.assert_allclose(sd[:, 0], paths.std(axis=1), rtol=4.0 / np.sqrt(2 * result.inputs.shape[1]))
    p = inputs.mean(axis=1)
    error = np.sqrt(p * (1 - p) * (1 / result.inputs.shape[1] + 1 / inputs.shape[1]))
    np.testing.assert_array_less(np.abs(result.input_mean - p), 4.0 * error + 1e-12)


@pytest.fixture(scope="module")
def predicted():
    return lfm.rao_blackwellised(jax.random.key(1), house, THERMOSTAT, TIMES, particles=1000)


@pytest.mark.thorough
def test_the_prediction_is_that_of_a_hundred_times_the_plain_particles(predicted):
    """Whole states drawn with matrix exponentials, without any of this library."""
    agree(predicted, *by_hand(np.random.default_rng(0), 100_000))


@pytest.mark.slow
def test_simulated_paths_have_the_same_distribution(predicted):
    simulation = lfm.simulate_switched(jax.random.key(2), house, THERMOSTAT, TIMES, paths=100_000)
    agree(predicted, np.asarray(simulation.state[:, :, 0]), np.asarray(simulation.inputs))
    residual = np.asarray(simulation.y[:, :, 0] - simulation.state[:, :, 0])
    assert residual.var() == pytest.approx(NOISE, rel=0.02)


@pytest.mark.slow
def test_an_input_that_changes_a_rate_has_covariances_of_its_own():
    assert is_input_additive(house) and not is_input_additive(leaky)
    result = lfm.rao_blackwellised(jax.random.key(3), leaky, THERMOSTAT, TIMES, particles=1000)
    assert result.outputs.variance.shape == (len(TIMES), 1000, 1)
    simulation = lfm.simulate_switched(jax.random.key(4), leaky, THERMOSTAT, TIMES, paths=100_000)
    agree(result, np.asarray(simulation.state[:, :, 0]), np.asarray(simulation.inputs))


@pytest.mark.slow
def test_between_decisions_nothing_is_drawn():
    """With one decision at the start, later moments are exact for two Gaussians, and vary less than plain particles."""
    result = lfm.rao_blackwellised(jax.random.key(5), house, THERMOSTAT, TIMES, particles=400, decisions=TIMES[:1])
    simulation = lfm.simulate_switched(jax.random.key(6), house, THERMOSTAT, TIMES, paths=40_000,
                                       decisions=TIMES[:1])
    agree(result, np.asarray(simulation.state[:, :, 0]), np.asarray(simulation.inputs))
    assert (result.inputs == result.inputs[0]).all()
    heated = lfm.rao_blackwellised(jax.random.key(5), house, lfm.Thermostat(100.0), TIMES, particles=400,
                                   decisions=TIMES[:1])
    plain = heated.outputs.moments()[1][-1, 0] / np.sqrt(400)
    assert heated.outputs.error()[-1, 0] < 0.3 * plain


@pytest.mark.thorough
@pytest.mark.parametrize("build", [
    pytest.param(house, id="adds", marks=pytest.mark.slow), pytest.param(leaky, id="changes a rate")])
def test_an_input_that_never_changes_is_the_filter(build):
    """Always on: moments, likelihood and state of the Gaussian filter of the heated house, whatever is drawn."""
    y = 17.0 + np.sin(3 * TIMES)[:, None]
    y[[2, 3, 9]] = np.nan
    always = lfm.Thermostat(1e12, sensor_sd=1e9)  # so inaccurate a sensor says nothing of the state
    result = lfm.rao_blackwellised(jax.random.key(0), build, always, TIMES, y=y, initial=1, particles=3)
    expected = lfm.filter(build(1.0), TIMES, y)
    np.testing.assert_allclose(result.log_likelihood, expected.log_likelihood, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(result.mean, expected.filtered_mean, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(result.covariance, expected.filtered_covariance, rtol=1e-7, atol=1e-8)
    went_on = lfm.rao_blackwellised(jax.random.key(0), build, always, TIMES[5:], y=y[5:], initial=1, particles=3,
                                    start=lfm.filter(build(1.0), TIMES[:5], y[:5]).state)
    np.testing.assert_allclose(went_on.mean[-1], expected.filtered_mean[-1], rtol=1e-7, atol=1e-7)


@pytest.mark.slow
def test_the_likelihood_is_that_of_weighted_paths():
    times = TIMES[:7]
    y = np.full((7, 1), np.nan)
    y[[2, 4, 6], 0] = [17.5, 18.2, 18.0]
    result = lfm.rao_blackwellised(jax.random.key(7), house, THERMOSTAT, times, y=y, particles=4000)
    simulation = lfm.simulate_switched(jax.random.key(8), house, THERMOSTAT, times, paths=200_000)
    path = np.asarray(simulation.state[:, :, 0])
    weight = np.exp(sum(stats.norm(path[k], np.sqrt(NOISE)).logpdf(y[k, 0]) for k in (2, 4, 6)))
    error = weight.std() / np.sqrt(weight.size)
    # The variance of the logarithm of the filter's own estimate is at most of order 1/ess of its weights.
    standard_error = weight.mean() * np.sqrt(3.0 / float(result.ess.min()))
    assert abs(float(jnp.exp(result.log_likelihood.sum())) - weight.mean()) < 4 * np.hypot(error, standard_error)
    mean = (weight * path[6]).sum() / weight.sum()
    spread = np.sqrt((weight * (path[6] - mean) ** 2).sum() / weight.sum())
    size = weight.sum() ** 2 / (weight**2).sum()
    assert abs(float(result.mean[6, 0]) - mean) < 4 * spread * np.sqrt(1 / size + 3.0 / float(result.ess.min()))


@pytest.mark.slow
def test_forces_that_jump_are_followed():
    """A random jump of the force between two decisions: mean and variance of both kinds of particles."""

    class JumpingForce(lfm.Matern):
        jump_times = (1.1,)

        def jump(self, index):
            return 0.5 * jnp.eye(1), 4.0 * jnp.eye(1)

    def kicked(heater):
        model = house(heater)
        return lfm.LatentForceModel(model.dynamics, {"rest": JumpingForce(SCALE, LENGTH, order=0)}, model.observation,
                                    model.initial_state)

    result = lfm.rao_blackwellised(jax.random.key(9), kicked, THERMOSTAT, TIMES, particles=1000)
    simulation = lfm.simulate_switched(jax.random.key(10), kicked, THERMOSTAT, TIMES, paths=100_000)
    agree(result, np.asarray(simulation.state[:, :, 0]), np.asarray(simulation.inputs))


def test_one_compilation_serves_all_values():
    count = 0

    @jax.jit
    def predict(rate, set_point, start, initial):
        nonlocal count
        count += 1
        state = lfm.FilterState(0.0, start, jnp.eye(2))
        return lfm.rao_blackwellised(
            jax.random.key(0), lambda heater: house(heater, rate), lfm.Thermostat(set_point), TIMES[:3],
            start=state, initial=initial, particles=10).input_mean

    cold = predict(0.3, 18.0, jnp.array([10.0, 0.0]), 0)
    warm = predict(0.1, 14.0, jnp.array([30.0, 0.0]), 1)
    assert count == 1
    np.testing.assert_allclose(cold, 1.0)
    np.testing.assert_allclose(warm, 0.0)


def test_thermostat_with_and_without_hysteresis():
    wide, sharp = lfm.Thermostat(20.0, hysteresis=1.0), lfm.Thermostat(20.0)
    readings = [19.4, 19.6, 20.0, 20.4, 20.6]
    assert [[int(wide.decide(d, jnp.array([r]), 0.0)) for r in readings] for d in (0, 1)] == [
        [1, 0, 0, 0, 0], [1, 1, 1, 1, 0]]
    assert [int(sharp.decide(1, jnp.array([r]), 0.0)) for r in readings] == [1, 1, 0, 0, 0]
    thermostat = lfm.Thermostat(20.0, sensor=lambda x, u, t: 0.5 * (x[0] + x[1]))
    assert thermostat.reading(jnp.array([18.0, 20.0]), jnp.zeros(0), 0.0).tolist() == [19.0]


def test_mixtures_against_scipy():
    mean, sd, weight = np.array([[-1.0, 2.0, 4.0]]), np.array([[0.5, 1.0, 0.1]]), np.array([[0.2, 0.5, 0.3]])
    mixture = Mixture(jnp.asarray(mean[..., None]), jnp.asarray(sd[..., None] ** 2), jnp.log(weight))
    parts = stats.norm(mean[0], sd[0])
    expected = (weight[0] * mean[0]).sum()
    variance = (weight[0] * (sd[0] ** 2 + mean[0] ** 2)).sum() - expected**2
    np.testing.assert_allclose([float(part[0, 0]) for part in mixture.moments()], [expected, np.sqrt(variance)])
    assert float(mixture.log_density([[1.3]])[0, 0]) == pytest.approx(np.log((weight[0] * parts.pdf(1.3)).sum()))
    shares = np.array([0.01, 0.5, 0.975])
    quantiles = np.asarray(mixture.quantiles(shares))[:, 0, 0]
    np.testing.assert_allclose([(weight[0] * parts.cdf(x)).sum() for x in quantiles], shares, rtol=1e-10)
    point_mixture = Mixture(jnp.array([[[3.0], [5.0]]]), jnp.zeros((1, 1, 1)), jnp.log(jnp.full((1, 2), 0.5)))
    np.testing.assert_allclose(np.asarray(point_mixture.quantiles([0.25, 0.75]))[:, 0, 0], [3.0, 5.0], rtol=1e-12)


def test_bad_arguments_are_named():
    mixture = Mixture(jnp.zeros((1, 1, 1)), jnp.ones((1, 1, 1)), jnp.zeros((1, 1)))
    for make, name in (
            (lambda: lfm.Thermostat(None), "set point"), (lambda: lfm.Thermostat(np.nan), "set_point"),
            (lambda: lfm.Thermostat(20.0, hysteresis=-1.0), "hysteresis"),
            (lambda: lfm.Thermostat(20.0, sensor_sd=-1.0), "sensor_sd"), (lambda: run(initial=2), "initial"),
            (lambda: run(initial=np.zeros(3, int)), "10"), (lambda: run(particles=0), "particles"),
            (lambda: run(threshold=2.0), "threshold"), (lambda: run(decisions=[-1.0]), "-1"),
            (lambda: run(build=curved), "'x0'"),
            (lambda: run(controller=lfm.Thermostat(20.0, sensor=lambda x, u, t: x[0] ** 2)), "linear"),
            (lambda: run(build=lambda heater: house(heater) if heater else two_rooms()), "states"),
            (lambda: run(build=later), "initial state"), (lambda: run(y=np.zeros((3, 2))), "y"),
            (lambda: run(start=lfm.FilterState(0.0, jnp.zeros(5), jnp.eye(5))), "start has 5"),
            (lambda: mixture.quantiles(1.0), "1")):
        with pytest.raises(ValueError, match=name):
            make()
    for make, name in (
            (lambda: run(controller=20.0), "Controller"), (lambda: lfm.Thermostat([18.0, 20.0]), "lfm.Input"),
            (lambda: lfm.simulate_switched(0, house, THERMOSTAT, TIMES), "key"),
            (lambda: lfm.rao_blackwellised(0, house, THERMOSTAT, TIMES), "key"),
            (lambda: lfm.Thermostat(20.0, hysteresis=np.array([1.0, 2.0])), "hysteresis")):
        with pytest.raises(TypeError, match=name):
            make()


def run(build=house, controller=THERMOSTAT, particles=10, **keywords):
    return lfm.rao_blackwellised(jax.random.key(0), build, controller, TIMES[:3], particles=particles, **keywords)


def curved(heater):
    return lfm.LatentForceModel(lambda x, u, t: heater - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, [0.1]),
                                lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))


def later(heater):
    return eqx.tree_at(lambda m: m.initial_state.mean, house(heater), jnp.array([17.0 + heater]))


def two_rooms():
    return lfm.LatentForceModel(lambda x, u, t: -x, {}, lfm.GaussianObservation(lambda x, u, t: x[:1], [0.1]),
                                lfm.Gaussian(jnp.zeros(2), jnp.eye(2)))


@pytest.mark.slow
def test_an_observation_comes_before_the_decision_at_its_time():
    """Of the input itself, which is switched on at the first time: the first reading is still of the heater off."""

    def lamp(heater):
        return lfm.LatentForceModel(
            lambda x, u, t: 0.0 * x, {}, lfm.GaussianObservation(lambda x, u, t: x + 100.0 * heater, jnp.array([1e-6])),
            lfm.Gaussian(jnp.array([17.0]), 1e-4 * jnp.eye(1)))

    times, key = np.arange(3.0), jax.random.key(0)
    simulation = lfm.simulate_switched(key, lamp, lfm.Thermostat(1000.0), times, steps=1)
    np.testing.assert_allclose(simulation.y[:, 0, 0], [17.0, 117.0, 117.0], atol=0.1)
    np.testing.assert_array_equal(simulation.inputs[:, 0], [1.0, 1.0, 1.0])
    result = lfm.rao_blackwellised(key, lamp, lfm.Thermostat(1000.0), times, y=simulation.y[:, 0], particles=10,
                                   steps=1)
    np.testing.assert_allclose(result.outputs.moments()[0][:, 0], [17.0, 117.0, 117.0], atol=0.1)
    assert np.isfinite(result.log_likelihood).all() and result.log_likelihood[0] > 0.0


@pytest.mark.thorough
def test_a_model_that_asks_for_the_value_in_python_has_a_covariance_for_each_particle():
    rates = {0.0: ALPHA, 1.0: ALPHA}
    assert not is_input_additive(lambda heater: house(heater, rates[heater]))
    assert not is_input_additive(lambda heater: house(heater, float(np.array([heater])[0])))
