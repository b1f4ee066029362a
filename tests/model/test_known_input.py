"""Known inputs against NumPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import lfm_ppl as lfm

TIMES, VALUES = np.array([0.5, 1.0, 3.0]), np.array([[1.0, -1.0], [2.0, 4.0], [0.0, 1.0]])
GRID = np.array([-1.0, 0.5, 0.7, 1.0, 2.999, 3.0, 9.0])


def test_linear():
    found = jax.vmap(lfm.Input(TIMES, VALUES, "linear"))(GRID)
    assert np.allclose(found, np.stack([np.interp(GRID, TIMES, column) for column in VALUES.T], axis=1), atol=1e-15)


def test_previous():
    found = jax.vmap(lfm.Input(TIMES, VALUES))(GRID)
    assert np.array_equal(found, VALUES[[0, 0, 0, 1, 1, 2, 2]])
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
    state, found = 0.0, [0.0]
    for begin, value in enumerate([0.0, 5.0, 1.0]):
        span = (begin, begin + 1.0)
        solution = solve_ivp(lambda t, x, v=value: function(x, v), span, [state], rtol=1e-12, atol=1e-13)
        state = solution.y[0, -1]
        found.append(state)
    return np.array(found)


def predictions(model, steps):
    return lfm.filter(model, ROWS, np.array([[np.nan], [np.nan], [np.nan], [0.3]]), steps=steps).predicted_mean[:, 0]


def test_jumps_at_rows_are_exact_in_a_linear_model():
    found = predictions(pushed(lambda x, u, t: STEP(t) - x), 10)
    assert np.allclose(found, response(lambda x, v: v - x), atol=1e-6)
    assert found[1] == 0.0, "nothing moves before the jump"


def test_jumps_at_rows_keep_the_order_four():
    model = pushed(lambda x, u, t: STEP(t) - x - x**3)
    exact = response(lambda x, v: v - x - x**3)
    error = [np.abs(predictions(model, steps) - exact).max() for steps in (40, 80)]
    assert error[1] < 1e-6
    assert 3.7 < np.log2(error[0] / error[1]) < 4.5


def test_simulated_states_jump_with_the_input():
    model = pushed(lambda x, u, t: STEP(t) - x)
    drawn = lfm.simulate(jax.random.key(0), model, ROWS, steps=400)
    assert np.allclose(drawn.state[:, 0], response(lambda x, v: v - x), atol=1e-5)
