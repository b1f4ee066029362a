"""Known inputs against NumPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

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
