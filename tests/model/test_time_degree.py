"""Degrees in time of functions of (x, u, t), and step functions, which have none."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.model.time_degree import degree_in_time
from lfm_ppl.model.user_functions import trace_function

HELD = lfm.Input([0.0, 1.0, 2.0], [0.0, 1.0, 3.0], "previous", "hold")
LINEAR = lfm.Input([0.0, 1.0, 2.0], [0.0, 1.0, 3.0], "linear", "hold")


def degree(function):
    arguments = jnp.ones(2), jnp.ones(1), jnp.asarray(0.5)
    return degree_in_time(trace_function("dynamics", "f(x, u, t)", function, *arguments))


@pytest.mark.parametrize(("function", "expected"), [
    (lambda x, u, t: -x * 2.0, 0), (lambda x, u, t: x * t + u, 1), (lambda x, u, t: (t - 1.0) ** 2 / 3.0 + t, 2),
    (lambda x, u, t: t**3 * x, 3), (lambda x, u, t: jnp.stack([LINEAR(t), HELD(t - 0.5)]), 1),
    (lambda x, u, t: jax.jit(lambda t: t.astype(jnp.float32) * t)(t), 2),
    (lambda x, u, t: jnp.where(x > 0.0, t, 2.0), 1), (lambda x, u, t: jnp.floor(x[0]) * t, 1)])
def test_polynomials_have_their_degree(function, expected):
    assert degree(function) == expected


@pytest.mark.parametrize("step", [
    lambda t: t.astype(int), lambda t: jnp.asarray(t, int).astype(float), lambda t: t.astype(bool), jnp.floor,
    jnp.ceil, jnp.round, jnp.sign, lambda t: t % 1.0, lambda t: t // 1.0, lambda t: jnp.where(t > 0.5, 1.0, 0.0),
    lambda t: (t > 0.5) * 1.0, lambda t: jnp.maximum(t, 0.5), lambda t: jnp.arange(3.0)[t.astype(int)],
    lambda t: jax.lax.reduce_precision(t, 8, 2), lambda t: t**-1, jnp.abs])
@pytest.mark.parametrize("wrap", [lambda step: step, jax.jit])
def test_steps_and_kinks_in_time_are_no_polynomials(step, wrap):
    assert degree(lambda x, u, t: x * wrap(step)(t)) == np.inf
