"""Known inputs against NumPy."""

from __future__ import annotations

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lfm_ppl as lfm

TIMES, VALUES = np.array([0.5, 1.0, 3.0]), np.array([[1.0, -1.0], [2.0, 4.0], [0.0, 1.0]])
GRID = np.array([-1.0, 0.5, 0.7, 1.0, 2.999, 3.0, 9.0])


def test_linear():
    result = jax.vmap(lfm.Input(TIMES, VALUES, "linear"))(GRID)
    assert np.allclose(result, np.stack([np.interp(GRID, TIMES, column) for column in VALUES.T], axis=1), atol=1e-15)


def test_previous():
    result = jax.vmap(lfm.Input(TIMES, VALUES))(GRID)
    assert np.array_equal(result, VALUES[[0, 0, 0, 1, 1, 2, 2]])
    assert float(lfm.Input([1.0], [3.0], "linear")(5.0)) == 3.0


def test_values_may_be_traced():
    gradient = jax.grad(lambda v: lfm.Input(TIMES, v * jnp.asarray(VALUES[:, 0]), "linear")(2.0))(1.5)
    assert np.isclose(gradient, 1.0)


ROWS = np.array([0.0, 1.0, 2.0, 3.0])
STEP = lfm.Input([0.0, 1.0, 2.0], [0.0, 5.0, 1.0])


def pushed(dynamics):
    return lfm.LatentForceModel(dynamics, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
                                lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))))


def response(function):
    """The solution at the rows, integrated from jump to jump."""
    state, result = 0.0, [0.0]
    for begin, value in enumerate([0.0, 5.0, 1.0]):
        span = (begin, begin + 1.0)
        solution = solve_ivp(lambda t, x, v=value: function(x, v), span, [state], rtol=1e-12, atol=1e-13)
        state = solution.y[0, -1]
        result.append(state)
    return np.array(result)


def predictions(model, steps):
    return lfm.filter(model, ROWS, np.array([[np.nan], [np.nan], [np.nan], [0.3]]), steps=steps).predicted_mean[:, 0]


def test_jumps_at_rows_are_exact_in_a_linear_model():
    result = predictions(pushed(lambda x, u, t: STEP(t) - x), 10)
    assert np.allclose(result, response(lambda x, v: v - x), atol=1e-6)
    assert result[1] == 0.0, "nothing moves before the jump"


@pytest.mark.thorough
def test_jumps_at_rows_keep_the_order_four():
    model = pushed(lambda x, u, t: STEP(t) - x - x**3)
    exact = response(lambda x, v: v - x - x**3)
    error = [np.abs(predictions(model, steps) - exact).max() for steps in (40, 80)]
    assert error[1] < 1e-6
    assert 3.7 < np.log2(error[0] / error[1]) < 4.5


@pytest.mark.thorough
def test_simulated_states_jump_with_the_input():
    model = pushed(lambda x, u, t: STEP(t) - x)
    simulation = lfm.simulate(jax.random.key(0), model, ROWS, steps=400)
    assert np.allclose(simulation.state[:, 0], response(lambda x, v: v - x), atol=1e-5)


LINE = lfm.Input([0.0, 1.0, 2.0], [0.0, 5.0, 1.0], "linear")


class DelayedInput(eqx.Module):
    """input(t - delay) - x, with the input among the module's fields."""

    power: lfm.Input
    delay: float = 0.0

    def __call__(self, x, u, t):
        return self.power(t - self.delay) - x


def smoother_warnings(model, times=ROWS, **options):
    """The messages of warnings of a smoother."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        lfm.smooth(model, times, np.zeros((len(times), 1)), steps=2, **options)
    return [str(warning.message) for warning in caught]


ENDED = "known input in dynamics, whose table goes from 0 to 2, is read at time 3, where its last value holds. Give it"


@pytest.mark.parametrize("dynamics", [
    DelayedInput(LINE), lambda x, u, t: LINE(t) - x, jax.jit(lambda x, u, t: LINE(t) - x),
    lambda x, u, t: jax.vmap(LINE)(t + jnp.arange(-1.0, 1.0)).sum() * x,
], ids=["module", "closure", "compiled", "mapped"])
def test_reading_beyond_the_table_is_told(dynamics):
    model = pushed(dynamics)
    (message,) = {text for text in smoother_warnings(model) if "last value" in text}
    assert ENDED in message and 'outside="hold"' in message


@pytest.mark.thorough
def test_reading_is_told_everywhere():
    model, y = pushed(DelayedInput(LINE)), np.zeros((4, 1))
    for call in (lambda: lfm.filter(model, ROWS, y), lambda: lfm.MarginalLikelihood(model, ROWS).ssm,
                 lambda: lfm.MarginalLikelihood(model, ROWS).time_grid,
                 lambda: lfm.simulate(jax.random.key(0), model, ROWS, steps=2),
                 lambda: lfm.MarginalLikelihood(pushed(DelayedInput(LINE)), ROWS[:3]).smooth(y[:3], at=[2.5, 3.0])):
        with pytest.warns(UserWarning, match="is read at time 3"):
            call()
    observation = lfm.GaussianObservation(lambda x, u, t: x + LINE(t), jnp.array([0.1]))
    measured = lfm.LatentForceModel(lambda x, u, t: -x, {}, observation, PRIOR)
    assert "known input in the observation function" in smoother_warnings(measured)[0]
    noisy = lfm.LatentForceModel(lambda x, u, t: -x, {}, OBSERVATION, PRIOR, lambda x, u, t: LINE(t)[None, None])
    assert "known input in process_noise" in smoother_warnings(noisy)[0]
    pulled = lfm.LatentForceModel(lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0, mean=LINE)}, OBSERVATION, PRIOR)
    assert "known input in the mean of the force 'u'" in smoother_warnings(pulled)[0]


PRIOR = lfm.Gaussian(jnp.zeros(1), jnp.eye(1))
OBSERVATION = lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1]))


@pytest.mark.parametrize("dynamics, options, message", [
    (DelayedInput(LINE), {"times": ROWS[:3]}, None),
    (DelayedInput(LINE), {"times": ROWS[:3], "at": np.array([2.5])}, "is read at time 2.5, where its last value holds"),
    (DelayedInput(LINE, delay=1.0), {"times": ROWS + 1.0}, "is read at time 3, where its last"),
    (DelayedInput(LINE, delay=1.0), {}, "is read at time -1, where its first value holds"),
    (DelayedInput(LINE, delay=1.0), {"times": 1.0 + ROWS[:3]}, None),
    (DelayedInput(STEP), {}, None),
    (DelayedInput(STEP), {"at": np.array([3.5])}, "is read at time 3.5, where its last value holds"),
    (DelayedInput(lfm.Input([0.0], [2.0])), {}, None),
    (DelayedInput(lfm.Input([0.0, 1.0], [2.0, 1.0], "linear", outside="hold")), {}, None),
    (lambda x, u, t: LINE(jnp.clip(t, 0.0, 2.0)) - x, {}, None),
])
def test_what_is_beyond(dynamics, options, message):
    """A value that holds until the next time may do so after the last for as long as before; delays count."""
    result = smoother_warnings(pushed(dynamics), **options)
    assert (message is None and not result) or message in result[0]


def test_reading_beyond_may_be_an_error():
    model = pushed(DelayedInput(lfm.Input([0.0, 1.0], [2.0, 1.0], "linear", outside="error")))
    with pytest.raises(ValueError, match="whose table goes from 0 to 1, is read at time 3"):
        lfm.filter(model, ROWS, np.zeros((4, 1)))


def test_compiled_code_says_what_is_known():
    """Nothing of a table that is traced; the warning of one that is not comes while the program is traced."""
    def traced(table):
        return lfm.MarginalLikelihood(pushed(DelayedInput(table)), ROWS).event_shape[0] * table.values[0]

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(traced)(LINE)
    with pytest.warns(UserWarning, match="is read at time 3"):
        jax.jit(lambda p: lfm.MarginalLikelihood(pushed(lambda x, u, t: LINE(t) - p * x), ROWS).event_shape[0] * p)(1.0)


def test_a_warning_names_the_input():
    heater = lfm.Input([0.0, 1.0, 2.0], [0.0, 5.0, 1.0], "linear", name="the_heater")
    model = pushed(lambda x, u, t: heater(t) - x)
    with pytest.warns(UserWarning, match="the known input 'the_heater' in dynamics, whose table goes from 0 to 2, is"):
        lfm.filter(model, ROWS, np.full((4, 1), 0.3), steps=1)


@pytest.mark.thorough
def test_a_forecast_needs_an_input_as_far_as_it_is_asked_for():
    """And not as far as the last of its intervals, which are as long as the intervals of the data."""
    model = pushed(lambda x, u, t: jnp.tanh(x) * lfm.Input([0.0, 3.6], [1.0, 2.0], "linear", outside="error")(t))
    y = np.full((4, 1), 0.3)
    assert np.isfinite(lfm.smooth(model, ROWS, y, steps=1, at=[3.6]).mean).all()
    with pytest.raises(ValueError, match="is read at time 3.7, where its last value holds"):
        lfm.smooth(model, ROWS, y, steps=1, at=[3.7])
