"""Linear models with known inputs and rates that are slow or fast compared with the rows, against dense algebra."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references import complex_step, expm

import lfm_ppl as lfm

TIMES = np.array([0.4, 1.0, 2.1, 2.1, 3.9, 6.2])
Y = np.array([[0.3, -0.2], [0.8, 0.1], [np.nan, 0.5], [0.2, 0.4], [-0.6, np.nan], [0.1, 0.7]])
TABLE_TIMES = np.array([-1.0, 0.15, 0.5, 1.9, 2.1, 3.3, 5.0])
TABLE = np.array([[0.5, -1.0], [2.0, 0.3], [-1.0, 0.4], [0.7, -0.6], [0.1, 0.2], [-0.4, 1.1], [1.2, 0.9]])
# Of x1, x2 and the force u, whose rate is 1/1.3; all but that times the rate of the case.
DYNAMICS = np.array([[-1.0, 0.6, 0.8], [-0.7, -0.5, 0.3]])
ENTRY = np.array([[1.0, 0.2], [-0.3, 0.5]])
OUTPUT = np.array([[1.0, 0.0, 0.2], [0.5, -1.0, 0.0]])
DISPERSION = np.array([[0.3], [0.5]])
NOISE = 0.04
RATES = [1e-3, 0.7, 40.0, 1e4]


def build(theta, way="previous", varying_noise=False):
    """A model with two inputs, one of them perhaps in the dispersion, one force and process noise."""
    rate, amount, sd = theta
    table = lfm.Input(TABLE_TIMES, TABLE, way, "hold")

    def dynamics(x, u, t):
        return rate * (DYNAMICS[:, :2] @ x + DYNAMICS[:, 2] * u[0] + amount * (ENTRY @ table(t)))

    def dispersion(x, u, t):
        return jnp.sqrt(rate) * sd * DISPERSION * table(t)[0]

    return lfm.LatentForceModel(
        dynamics, {"u": lfm.Matern(1.0, 1.3, order=0)},
        lfm.GaussianObservation(lambda x, u, t: OUTPUT[:, :2] @ x + OUTPUT[:, 2] * u[0], NOISE * jnp.ones(2)),
        lfm.Gaussian(jnp.array([1.0, -0.5]), 0.5 * jnp.eye(2)), initial_time=0.0,
        process_noise=dispersion if varying_noise else jnp.sqrt(rate) * sd * DISPERSION)


def discretise(feedback, diffusion, length):
    """Return transition and noise by the exponential of a short step, and doubling."""
    n = len(feedback)
    doublings = max(0, int(np.ceil(np.log2(np.abs(feedback).sum(0).max() * length))) + 1)
    block = np.block([[-feedback, diffusion], [np.zeros((n, n)), feedback.T]]) * length / 2**doublings
    block = expm(block)
    phi, noise = block[n:, n:].T, block[n:, n:].T @ block[:n, n:]
    for _ in range(doublings):
        phi, noise = phi @ phi, noise + phi @ noise @ phi.T
    return phi, noise


class Dense:
    """Joint mean and covariance of the states (x1, x2, u) at all rows, at the start and at all breakpoints."""

    def __init__(self, theta, way="previous", varying_noise=False):
        rate, amount, sd = theta
        feedback = np.concatenate([rate * DYNAMICS, [[0.0, 0.0, -1 / 1.3]]])
        inner = TABLE_TIMES[(TABLE_TIMES > 0) & (TABLE_TIMES < TIMES[-1])]
        nodes = np.unique(np.concatenate([[0.0], TIMES, inner]))
        mean, covariance = np.array([1.0, -0.5, 0.0]) + 0.0 * rate, np.diag([0.5, 0.5, 1.0]) + 0.0 * rate
        means, blocks = [mean], [[covariance]]
        for a, b in zip(nodes[:-1], nodes[1:], strict=True):
            held = TABLE[np.searchsorted(TABLE_TIMES, 0.5 * (a + b)) - 1]
            start, end = [held, held] if way == "previous" else [
                np.array([np.interp(t, TABLE_TIMES, column) for column in TABLE.T]) for t in (a, b)]
            diffusion = np.zeros((3, 3)) + 0.0 * rate
            diffusion[2, 2] = 2 / 1.3
            diffusion[:2, :2] = rate * sd**2 * DISPERSION @ DISPERSION.T * (held[0] ** 2 if varying_noise else 1.0)
            phi, noise = discretise(feedback, diffusion, b - a)
            # The input's value and its slope are two more states.
            entry = amount * rate * ENTRY
            augmented = np.zeros((5, 5)) + 0.0 * rate
            augmented[:3, :3] = feedback
            augmented[:2, 3] = entry @ start
            slope = np.zeros((5, 5)) + 0.0 * rate
            slope[:3, :3], slope[:2, 3], slope[3, 4] = feedback, entry @ (end - start) / (b - a), 1.0
            mean = (phi @ mean + expm(augmented * (b - a))[:3, 3]
                    + expm(slope * (b - a))[:3, 4])
            means.append(mean)
            covariance = phi @ blocks[-1][-1] @ phi.T + noise
            blocks.append([phi @ block for block in blocks[-1]] + [covariance])
        self.rows = np.searchsorted(nodes, TIMES)
        self.mean = np.array(means)[self.rows]
        self.covariance = np.array([[blocks[i][j] if j <= i else blocks[j][i].T for j in self.rows] for i in self.rows])

    def condition(self, count):
        """Return log likelihood, means (T, 3) and covariances (T, 3, 3) of all rows given the first ``count``."""
        rows, columns = np.nonzero(np.isfinite(Y[:count]))
        design = np.zeros((len(rows), len(TIMES), 3))
        design[np.arange(len(rows)), rows] = OUTPUT[columns]
        joint = self.covariance.transpose(0, 2, 1, 3).reshape(3 * len(TIMES), -1)
        design = design.reshape(len(rows), 3 * len(TIMES))
        innovation = Y[rows, columns] - design @ self.mean.ravel()
        s = design @ joint @ design.T + NOISE * np.eye(len(rows))
        gain = np.linalg.solve(s, design @ joint).T
        mean = self.mean + (gain @ innovation).reshape(-1, 3)
        covariance = (joint - gain @ design @ joint).reshape(len(TIMES), 3, len(TIMES), 3)
        diagonal = np.arange(len(TIMES))
        determinant = np.prod(np.linalg.det(2 * np.pi * s)) if len(rows) else 1.0
        log_likelihood = -0.5 * (innovation @ np.linalg.solve(s, innovation) + np.log(determinant))
        return log_likelihood, mean, covariance[diagonal, :, diagonal]


def close(result, expected, tolerance=1e-9):
    """Relative to the largest entry."""
    result, expected = np.asarray(result), np.asarray(expected)
    assert result.shape == expected.shape
    assert np.abs(result - expected).max() <= tolerance * np.abs(expected).max()


@pytest.fixture(scope="module", params=["previous", *(
    pytest.param(kind, marks=pytest.mark.thorough) for kind in ("linear", "noise"))])
def case(request):
    """The compiled results of a kind of model as a function of its parameters, and its dense algebra."""
    settings = {"way": "previous", "varying_noise": True} if request.param == "noise" else {"way": request.param}

    @jax.jit
    def results(theta):
        def log_prob(theta):
            return lfm.MarginalLikelihood(build(theta, **settings), TIMES, steps=2).log_prob(Y)

        likelihood = lfm.MarginalLikelihood(build(theta, **settings), TIMES, steps=2)
        smoothed = likelihood.smooth(Y)
        draws = smoothed.sample_joint(jax.random.key(0), 2000)
        return (log_prob(theta), jax.grad(log_prob)(theta), jax.jacfwd(log_prob)(theta), likelihood.filter(Y), smoothed,
                draws)

    return settings, results


@pytest.mark.thorough
@pytest.mark.parametrize("rate", RATES)
def test_rates_slow_and_fast(case, rate):
    settings, results = case
    theta = np.array([rate, 1.3, 0.8])
    value, reverse, forward, filtered, smoothed, draws = results(theta)
    dense = Dense(theta, **settings)
    log_likelihood, mean, covariance = dense.condition(len(TIMES))
    close(value, log_likelihood)
    close(smoothed.mean, mean)
    close(smoothed.covariance, covariance)
    for row in (0, 2, 5):
        _, mean, covariance = dense.condition(row)
        close(filtered.predicted_mean[row], mean[row])
        close(filtered.predicted_covariance[row], covariance[row])
    derivative = complex_step(lambda p: Dense(p, **settings).condition(len(TIMES))[0], theta)
    # Each in units of a relative change of its parameter.
    close(reverse * theta, derivative * theta)
    close(forward * theta, derivative * theta)
    deviation = np.asarray(draws) - np.asarray(smoothed.mean)
    sd = np.sqrt(np.diagonal(smoothed.covariance, axis1=1, axis2=2))
    assert np.abs(deviation.mean(0) / sd).max() < 5 / np.sqrt(2000)
    assert np.abs(deviation.std(0) / sd - 1).max() < 5 / np.sqrt(4000)


def infusion(rate, way="previous", dynamics=None, **keywords):
    """A compartment that is known to be empty, with a constant infusion until 24 h."""
    table = (lfm.Input([0.0, 24.0], [10.0, 0.0], "previous", "hold") if way == "previous"
             else lfm.Input([0.0, 24.0, 30.0], [10.0, 0.0, 0.0], "linear", "hold"))
    return lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([table(t) - rate * x[0]]) if dynamics is None else dynamics(x, table(t)), {},
        lfm.GaussianObservation(lambda x, u, t: x / 20.0, jnp.array([4e-6])),
        lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), initial_time=0.0, **keywords)


HOURS = np.array([6.0, 12.0, 24.0, 25.0])


def concentration(rate, way="previous"):
    during, elapsed = np.minimum(HOURS, 24.0), np.maximum(HOURS - 24.0, 0.0)
    constant = -np.expm1(-rate * during) / rate
    if way == "previous":
        return 10.0 * constant * np.exp(-rate * elapsed) / 20.0
    return 10.0 * (constant - (during - constant) / rate / 24.0) * np.exp(-rate * elapsed) / 20.0


@pytest.mark.thorough
@pytest.mark.parametrize("options", [{}, {"tolerance": 1e-4}, {"method": "exponential"}, {"steps": 1}], ids=str)
def test_an_infusion_into_a_compartment_that_empties_within_minutes(options):
    for way in ("previous", "linear") if options in ({}, {"steps": 1}) else ("previous",):
        predict = jax.jit(lambda rate, way=way: lfm.MarginalLikelihood(infusion(rate, way), HOURS, **options).filter(
            np.zeros((4, 1))).predicted_mean[:, 0] / 20.0)
        for rate in (0.01, 3.0, 10.0, 300.0):
            close(predict(rate), concentration(rate, way), 1e-10)
    assert lfm.MarginalLikelihood(infusion(10.0), HOURS, **options).description == "exact (the model is linear)"


@pytest.mark.thorough
def test_draws_of_a_state_without_noise_are_the_exact_path():
    smoothed = lfm.smooth(infusion(10.0), HOURS, np.zeros((4, 1)))
    draws = smoothed.sample(jax.random.key(0), 3).state[..., 0]
    np.testing.assert_allclose(draws, np.tile(20.0 * concentration(10.0), (3, 1)), rtol=1e-10)


@pytest.mark.thorough
def test_a_dose_and_a_panel():
    """The dose decays beside the infusion; both series of the panel have their own rate."""
    def build(parameters):
        return infusion(parameters["rate"], events=[lfm.Dose([20.0], 7.0, "x0")])

    rates = np.array([0.2, 50.0])
    y = np.zeros((2, 4, 1))
    panel = lfm.panel(build, {"rate": jnp.asarray(rates)}, HOURS)
    expected = []
    for rate in rates:
        mean = concentration(rate) + 7.0 / 20.0 * np.where(HOURS > 20.0, np.exp(-rate * (HOURS - 20.0)), 0.0)
        expected.append((-0.5 * mean**2 / 4e-6 - 0.5 * np.log(2 * np.pi * 4e-6)).sum())
    np.testing.assert_allclose(panel.log_prob(y), expected, rtol=1e-9)


@pytest.mark.thorough
def test_one_regime_equals_the_linear_model():
    y = concentration(10.0)[:, None]
    switching = lfm.Switching({"a": infusion(10.0), "b": infusion(10.0)}, jnp.array([[0.0, 0.1], [0.2, 0.0]]), HOURS)
    expected = (-0.5 * np.log(2 * np.pi * 4e-6)) * len(HOURS)
    np.testing.assert_allclose(switching.log_prob(y), expected, rtol=1e-9)


@pytest.mark.parametrize(("name", "expected"), [
    ("input", "exact (the model is linear)"), ("products of inputs", "exact (the model is linear)"),
    ("time", "exact (the model is linear)"), ("function of an input", "exact (the model is linear)"),
    ("function of a linear input", None), ("sine", None), ("jump of the user", None), ("input at t squared", None)])
def test_exact_is_said_only_where_it_is(name, expected):
    held = lfm.Input([0.0, 7.0], [1.0, 2.0], "previous", "hold")
    ramp = lfm.Input([0.0, 7.0, 99.0], [1.0, 2.0, 2.0], "linear", "hold")
    terms = {"input": ramp, "products of inputs": lambda t: ramp(t) * ramp(t - 1.0) * held(t),
             "time": lambda t: 1.0 + t - 0.1 * t**2, "function of an input": lambda t: jnp.exp(held(t)),
             "function of a linear input": lambda t: jnp.exp(ramp(t)), "sine": jnp.sin,
             "jump of the user": lambda t: jnp.where(t > 8.0, 1.0, 0.0),
             "input at t squared": lambda t: held(0.0 * t**2 + 1.0) + ramp(t**2)}
    model = infusion(1.0, dynamics=lambda x, value: value - x)
    model = lfm.LatentForceModel(lambda x, u, t: jnp.stack([terms[name](t) - x[0]]), {}, model.observation,
                                 model.initial_state, initial_time=0.0)
    if name == "input at t squared":
        with pytest.warns(UserWarning, match="t minus a constant"):
            likelihood = lfm.MarginalLikelihood(model, HOURS)
    else:
        likelihood = lfm.MarginalLikelihood(model, HOURS)
    integrated = "exact transitions, known inputs integrated in 10 steps between two times"
    assert likelihood.description == (expected or integrated)


def test_other_functions_of_time_converge_and_are_stable():
    """A fast sensor of a sine: order four where the steps resolve the decay, else two with a small factor."""
    def predicted(rate, steps):
        model = lfm.LatentForceModel(
            lambda x, u, t: rate * (jnp.sin(t) - x), {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.ones(1)),
            lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), initial_time=0.0)
        return lfm.filter(model, HOURS, np.zeros((4, 1)), steps=steps, max_step=0.25 * 20 / steps).predicted_mean[:, 0]

    predict = jax.jit(predicted, static_argnums=1)
    for rate in (0.3, 30.0, 3e4):
        size = rate**2 + 1.0
        expected = (rate**2 * np.sin(HOURS) - rate * np.cos(HOURS) + rate * np.exp(-rate * HOURS)) / size
        coarse, fine = (np.abs(predict(rate, steps) - expected).max() for steps in (10, 20))
        assert coarse < (1e-4 if rate < 1.0 else 0.03 / rate)
        assert fine < coarse / (12.0 if rate < 1.0 else 3.5)


@pytest.mark.thorough
def test_fast_decay_of_a_model_that_is_not_linear_in_its_forces():
    """A state that follows exp(u) within minutes has the moments of exp(u); the steps are as long as an hour.

    With the points -1/2 and 1/2 of the rule, exp(u) has the mean cosh(1/2), and sinh(1/2) is the sd of its linear part.
    """
    @jax.jit
    def mean_and_variance(rate):
        model = lfm.LatentForceModel(
            lambda x, u, t: rate * (jnp.exp(u) - x), {"u": lfm.Matern(0.5, 40.0, order=1)},
            lfm.GaussianObservation(lambda x, u, t: x, jnp.ones(1)), lfm.Gaussian(jnp.ones(1), jnp.eye(1)),
            process_noise=jnp.sqrt(2.0 * rate) * 0.1 * jnp.ones((1, 1)), initial_time=0.0)
        result = lfm.filter(model, HOURS, np.array([[np.nan]] * 3 + [[0.0]]))
        return result.predicted_mean[:, 0], result.predicted_covariance[:, 0, 0]

    for rate in (20.0, 1e3):
        mean, variance = mean_and_variance(rate)
        np.testing.assert_allclose(mean, np.cosh(0.5), rtol=1e-3)
        np.testing.assert_allclose(variance, np.sinh(0.5) ** 2 + 0.01, rtol=1e-2)
