"""Known inputs that jump between two observations, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy.integrate import solve_ivp

import lfm_ppl as lfm
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.model.state_space import state_space

ROWS = np.arange(13.0)
DECAY = 0.3


def system(rate, elimination=lambda x: DECAY * x, sd=0.2, initial_time=0.0):
    """A state that is known at the start: no observation moves its mean."""
    return lfm.LatentForceModel(
        lambda x, u, t: jnp.reshape(rate(t), (1,)) - elimination(x), {},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([sd**2])), lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))),
        initial_time=initial_time)


def means(model, times, **keywords):
    y = np.zeros((len(times), 1))
    return np.asarray(lfm.filter(model, times, y, **keywords).predicted_mean)[:, 0]


def pulses(seed, count=8):
    """Starts, widths from 1e-6 to 10 sampling intervals, and amounts."""
    rng = np.random.default_rng(seed)
    return np.sort(rng.uniform(-1.0, 12.0, count)), 10.0 ** rng.uniform(-6.0, 1.0, count), rng.uniform(0.5, 3.0, count)


def table(starts, widths, amounts, origin=0.0):
    """The sum of the pulses as one "previous" input."""
    times = np.unique(np.concatenate([[starts.min() - 100.0], starts, starts + widths]))
    middle = np.append(0.5 * (times[1:] + times[:-1]), times[-1] + 1.0)
    is_active = (middle[:, None] > starts) & (middle[:, None] < starts + widths)
    return lfm.Input(origin + times, is_active @ (amounts / widths), "previous", "hold")


def exposed(starts, widths, amounts, t, lag=0.0):
    """The linear state at times (T,), which begins at zero."""
    begin, end = np.maximum(starts + lag, 0.0), np.maximum(starts + widths + lag, 0.0)
    elapsed = np.clip(t[:, None] - end, 0.0, None)
    length = np.clip(np.minimum(t[:, None], end) - begin, 0.0, None)
    return (amounts / widths / DECAY * -np.expm1(-DECAY * length) * np.exp(-DECAY * elapsed)).sum(1)


def test_pulse_trains_of_a_linear_model():
    for seed in range(3):
        train = pulses(seed)
        result = means(system(table(*train)), ROWS)
        np.testing.assert_allclose(result, exposed(*train, ROWS), rtol=1e-8, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("keywords", [{}, {"tolerance": 1e-2, "steps": 40}])
def test_pulse_trains_of_saturable_elimination(keywords):
    def elimination(x):
        return x / (0.8 + x)

    train = pulses(5)
    rate = table(*train)
    edges = np.unique(np.concatenate([[0.0], np.asarray(rate.times), ROWS]))
    edges, x, expected = edges[(edges >= 0) & (edges <= ROWS[-1])], np.zeros(1), {0.0: 0.0}
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        # A pulse of width 1e-6 has a rate of 1e6: its time is counted in widths.
        flow, length = float(rate(0.5 * (begin + end))), end - begin
        x = solve_ivp(lambda s, x, flow=flow, length=length: length * (flow - elimination(x)), (0.0, 1.0), x,
                      method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        expected[end] = x[0]
    result = means(system(rate, elimination), ROWS, **keywords)
    np.testing.assert_allclose(result, [expected[t] for t in ROWS], rtol=1e-4, atol=1e-5)


def test_narrow_pulses_at_unix_times():
    """Widths of a few units of rounding."""
    starts, origin = np.arange(0.25, 12.0, 1.5), 1.7e9
    widths = np.full(len(starts), 2.0**-20)
    train = starts, widths, np.ones(len(starts))
    result = means(system(table(*train, origin=origin), initial_time=origin), origin + ROWS)
    np.testing.assert_allclose(result, exposed(*train, ROWS), rtol=1e-6, atol=1e-9)


def test_an_offset_that_is_a_number_moves_the_jumps():
    """The table counts from 1970, the model from its first row."""
    starts, widths, amounts = pulses(1)
    # As far as the digits of the table go.
    starts, stops = ((edge + 1.7e9) - 1.7e9 for edge in (starts, starts + np.maximum(widths, 1e-5)))
    train = starts, stops - starts, amounts
    rate = table(*train, origin=1.7e9)
    result = means(system(lambda t: rate(t + 1.7e9)), ROWS)
    np.testing.assert_allclose(result, exposed(*train, ROWS), rtol=1e-8, atol=1e-9)


def test_kinks_of_a_linear_input():
    """A triangle between two rows, in a model that is exact but for its input."""
    ramp = lfm.Input([-9.0, 2.3, 2.5, 2.8, 99.0], [0.0, 0.0, 4.0, 0.0, 0.0], "linear", "hold")
    result = means(system(ramp), ROWS)

    def corner(edge, t):
        return np.where(t > edge, (t - edge) / DECAY + np.expm1(-DECAY * np.clip(t - edge, 0, None))
                        / DECAY**2, 0.0)

    slopes = np.array([20.0, -20.0 - 4 / 0.3, 4 / 0.3])
    expected = sum(a * corner(edge, ROWS) for a, edge in zip(slopes, (2.3, 2.5, 2.8), strict=True))
    np.testing.assert_allclose(result, expected, rtol=1e-7, atol=1e-8)


def test_only_true_jumps_and_kinks_divide_an_interval():
    fine = np.arange(0.0, 12.0, 0.1)
    nothing = [lfm.Input(fine, np.full(len(fine), 2.0), outside="hold"),
               lfm.Input(ROWS, np.arange(13.0), outside="hold"),  # at the rows
               lfm.Input([-1.0, *fine[1:-1], 13.0], 3.0 * np.array([-1.0, *fine[1:-1], 13.0]), "linear", "hold")]
    for known_input in nothing:
        assert len(build_time_grid(state_space(system(known_input)), ROWS, 10).intervals.length) == len(ROWS)
    jumps = lfm.Input(fine, np.floor(fine / 0.5 + 1e-9), outside="hold")
    grid = build_time_grid(state_space(system(jumps)), ROWS, 10)
    assert len(np.unique(np.round(grid.intervals.end, 9))) >= 25
    # Steps are as long as before, not ten in each part.
    assert len(grid.intervals.length) * grid.steps < 250


INFUSION = lfm.Input([-100.0, 0.0, 1.0], [0.0, 10.0, 0.0], "previous", "hold")
Y = (exposed(np.zeros(1), np.ones(1), np.array([10.0]), ROWS, 1.4) + 0.2 * np.random.default_rng(0).normal(size=13))


def closed_form(lag, second=None):
    mean = exposed(np.zeros(1), np.ones(1), np.array([10.0]), ROWS, lag)
    if second is not None:
        mean = mean + exposed(np.zeros(1), np.ones(1), np.array([10.0]), ROWS, second)
    return float((-0.5 * ((Y - mean) / 0.2) ** 2 - np.log(0.2 * np.sqrt(2 * np.pi))).sum())


def slope(function, point):
    return (function(point + 1e-6) - function(point - 1e-6)) / 2e-6


def lagged(lag, **keywords):
    return lfm.MarginalLikelihood(system(lambda t: INFUSION(t - lag)), ROWS, **keywords).log_prob(Y[:, None])


LAGS = np.array([0.31, 1.2, 1.37, 1.43, 2.0 - 1e-9, 2.0 + 1e-9, 3.7])


@pytest.mark.thorough
@pytest.mark.parametrize("keywords", [{}, pytest.param({"tolerance": 1e-3}, marks=pytest.mark.slow)])
def test_value_and_derivative_with_respect_to_a_lag(keywords):
    value, gradient = jax.jit(jax.vmap(jax.value_and_grad(lambda lag: lagged(lag, **keywords))))(LAGS)
    np.testing.assert_allclose(value, [closed_form(lag) for lag in LAGS], rtol=1e-7)
    for lag, result in zip(LAGS, gradient, strict=True):
        side = 1e-5 * np.sign(lag - 2.0) if abs(lag - 2.0) < 1e-6 else 0.0
        np.testing.assert_allclose(result, slope(closed_form, lag + side), rtol=2e-3 if side else 1e-4)


@pytest.mark.slow
def test_two_lags():
    def log_prob(lags):
        model = system(lambda t: INFUSION(t - lags[0]) + INFUSION(t - lags[1]))
        return lfm.MarginalLikelihood(model, ROWS).log_prob(Y[:, None])

    lags = np.array([1.2, 4.4])
    value, gradient = jax.jit(jax.value_and_grad(log_prob))(lags)
    np.testing.assert_allclose(value, closed_form(*lags), rtol=1e-8)
    expected = [slope(lambda lag: closed_form(lag, 4.4), 1.2), slope(lambda lag: closed_form(1.2, lag), 4.4)]
    np.testing.assert_allclose(gradient, expected, rtol=1e-4)


def test_a_time_that_bends_with_a_parameter_is_refused():
    with pytest.raises(ValueError, match="lag"):
        jax.grad(lambda lag: lfm.MarginalLikelihood(
            system(lambda t: INFUSION(jnp.mod(t - lag, 7.0))), ROWS).log_prob(Y[:, None]))(1.2)
    with pytest.warns(UserWarning):
        lfm.MarginalLikelihood(system(lambda t: INFUSION(jnp.mod(t, 7.0))), ROWS)


@pytest.mark.slow
def test_simulations_and_particles_do_not_step_over_pulses():
    train = pulses(2)
    model = system(table(*train))
    simulation = lfm.simulate(jax.random.key(0), model, ROWS, steps=10)
    np.testing.assert_allclose(simulation.state[:, 0], exposed(*train, ROWS), rtol=1e-5, atol=1e-6)
    noisy = lfm.LatentForceModel(
        model.dynamics, {}, model.observation, lfm.Gaussian(jnp.zeros(1), 1e-16 * jnp.eye(1)),
        process_noise=lambda x, u, t: 1e-8 * (1.0 + jnp.tanh(x) ** 2)[:, None], initial_time=0.0)
    result = lfm.particle_filter(jax.random.key(0), noisy, ROWS, Y[:, None], particles=4, steps=200)
    np.testing.assert_allclose(result.mean[:, 0], exposed(*train, ROWS), rtol=2e-2, atol=1e-2)


@pytest.mark.slow
def test_a_lag_is_learnt():
    def model(times, y=None):
        lag = numpyro.sample("lag", dist.LogNormal(0.0, 0.5))
        numpyro.sample("y", lfm.MarginalLikelihood(system(lambda t: INFUSION(t - lag)), times), obs=y)

    posterior = lfm.fit(model, ROWS, Y[:, None], sampler="map", trajectory_draws=0, progress=False)["posterior"]["lag"]
    lags = np.linspace(1.2, 1.6, 801)
    weight = np.exp([closed_form(lag) - 0.5 * (np.log(lag) / 0.5) ** 2 - np.log(lag) for lag in lags])
    weight /= weight.sum()
    mean = weight @ lags
    np.testing.assert_allclose(posterior.mean(), mean, atol=5e-3)
    np.testing.assert_allclose(posterior.std(), np.sqrt(weight @ (lags - mean) ** 2), rtol=0.15)


@pytest.mark.slow
def test_a_linear_input_at_a_lag():
    ramp = lfm.Input([-9.0, 0.0, 0.2, 0.5, 99.0], [0.0, 0.0, 4.0, 0.0, 0.0], "linear", "hold")

    def log_prob(lag, steps):
        model = system(lambda t: ramp(t - lag), lambda x: x / (0.8 + x))
        return lfm.MarginalLikelihood(model, ROWS, steps=steps, iterations=0).log_prob(Y[:, None])

    value, gradient = jax.value_and_grad(lambda lag: log_prob(lag, 10))(1.37)
    fine = [log_prob(1.37 + change, 40) for change in (-1e-5, 0.0, 1e-5)]
    np.testing.assert_allclose(value, fine[1], atol=1e-4)
    np.testing.assert_allclose(gradient, (fine[2] - fine[0]) / 2e-5, rtol=1e-4)


@pytest.mark.slow
def test_smoothing_at_requested_times_with_a_traced_lag():
    def forced(lag):
        return lfm.LatentForceModel(
            lambda x, u, t: INFUSION(t - lag) + jnp.tanh(u) - DECAY * x, {"u": lfm.Matern(0.5, 2.0)},
            lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.04])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))

    requested_times = np.linspace(0.0, 14.0, 9)

    def run(lag):
        return tuple(getattr(lfm.smooth(forced(lag), ROWS, Y[:, None], at=requested_times), name)
                     for name in ("mean", "covariance"))

    for result, expected in zip(jax.jit(run)(1.37), run(1.37), strict=True):
        np.testing.assert_allclose(result, expected, atol=2e-3)
