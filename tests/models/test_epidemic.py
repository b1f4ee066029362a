"""The epidemic: its equations against SciPy's, and its settings."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from lfm_ppl.io import loading


@pytest.fixture(scope="module")
def file():
    return loading.load("epidemic")


@pytest.fixture(scope="module")
def functions(file):
    return file.definitions


def test_dynamics_are_those_of_the_sir_model(functions):
    """The logarithms against shares, integrated by DOP853, with a transmission that does not change."""
    system = functions["build"](2.5, 0.3, 10.0, 10.0, 0.2, 0.5)
    ours = solve_ivp(lambda t, x: np.asarray(system.dynamics(jnp.asarray(x), jnp.zeros(1), t)), (0.0, 60.0),
                     np.asarray(system.initial_state.mean), rtol=1e-10, atol=1e-10)
    shares = np.exp(ours.y[:, 0])
    sir = solve_ivp(lambda t, x: [-0.5 * x[0] * x[1], 0.5 * x[0] * x[1] - 0.2 * x[1]], (0.0, 60.0), shares,
                    method="DOP853", rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(np.exp(ours.y[:, -1]), sir.y[:, -1], rtol=1e-6)
    # What is reported of the new infections beta s i N of a day.
    expected = np.log(0.5 * 100_000 * 0.5 * sir.y[0, -1] * sir.y[1, -1])
    result = system.observation.function(jnp.asarray(ours.y[:, -1]), jnp.zeros(1), 60.0)
    assert float(result[0]) == pytest.approx(expected, abs=1e-6)


@pytest.mark.thorough
def test_known_rates_are_fixed_unless_freed(file):
    data = file.simulate()
    assert data.y.shape == (60, 1) and np.all(data.y == np.round(data.y))
    assert file.anchors(data) == {"recovery": 0.2, "reporting": 0.5}
