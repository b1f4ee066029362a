"""Pituitary and thyroid: the published steady state, the fast state that is eliminated, and IPOPT."""

import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.io import loading


def module():
    """Return the module of the model file."""
    return sys.modules[loading.load("thyroid").model.__module__]


def published_rates(t4, t3p, t3c, tsh, tshz, trh, gd1=22e-9, gt3=394e-15):
    """The five rates of the source, in mol, mU, l and s, with the fast TSH of the pituitary among the states."""
    ft4 = t4 / (1 + 2e10 * 3e-7 + 2e8 * 4.5e-6)
    t3n = t3c / (1 + 2e9 * 8e-6)
    t3r = t3n / (t3n + 1e-10)
    th = 3.375e-12 * tsh / (tsh + 2.75)
    q = th * tsh / (tsh + 1.0)
    production = (gd1 * ft4 / (ft4 + 5e-7) + 4.3e-15 * ft4 / (ft4 + 1e-9) + gt3 * tsh / (tsh + 2.75)
                  + gd1 * q / (q + 5e-7) + 4.3e-15 * q / (q + 1e-9))
    stimulus = 473.0214 * trh / ((trh + 4.7e-8) * (1 + 100 * tshz / (tshz + 50)) * (1 + 1.6879e6 * t3r))
    return np.array([
        0.1 * th - 1.1e-6 * t4, 2.6e-2 * production - 8e-6 * t3p, 1.3e5 * 4.3e-15 * ft4 / (ft4 + 1e-9) - 8.3e-4 * t3c,
        0.4 * stimulus - 2.3e-4 * tsh, 2.6e5 * stimulus - 140.0 * tshz])


def test_the_steady_state_is_the_published_one():
    thyroid = module()
    np.testing.assert_allclose(thyroid.axis(jnp.asarray(thyroid.STEADY), 6.9), 0.0, atol=1e-12 * thyroid.STEADY.max())
    published = [122.02, 3.1615, 11.701, 1.8157]
    np.testing.assert_allclose(thyroid.STEADY, published, rtol=5e-5)
    t4, t3, t3c, tsh = thyroid.STEADY
    rates = published_rates(t4 * 1e-9, t3 * 1e-9, t3c * 1e-9, tsh, 1.9389, 6.9e-9)
    lost = np.array([1.1e-6 * t4 * 1e-9, 8e-6 * t3 * 1e-9, 8.3e-4 * t3c * 1e-9, 2.3e-4 * tsh, 140.0 * 1.9389])
    # The published value of the fast state has five digits.
    assert np.all(np.abs(rates / lost) < [1e-12, 1e-12, 1e-12, 5e-5, 5e-5])
    # With the constants of a reimplementation, T3 would be 2.6% lower.
    reimplementation = published_rates(t4 * 1e-9, t3 * 1e-9, t3c * 1e-9, tsh, 1.9389, 6.9e-9, 2.3527e-8, 1.8882e-13)[1]
    assert t3 + 1e9 * reimplementation / 8e-6 == pytest.approx(3.0804, abs=1e-4)


def test_the_rates_are_those_with_the_fast_state_at_its_own_steady_state():
    thyroid = module()
    for x, trh in ((thyroid.STEADY * [1.1, 0.8, 0.9, 1.5], 12.0), (thyroid.STEADY * [0.7, 1.3, 1.2, 0.3], 0.4)):
        t4, t3, t3c, tsh = x * [1e-9, 1e-9, 1e-9, 1.0]
        low, high = 0.0, 1e3
        for _ in range(200):  # bisection on the fast rate, which falls with the fast state
            z = 0.5 * (low + high)
            low, high = (z, high) if published_rates(t4, t3, t3c, tsh, z, trh * 1e-9)[4] > 0 else (low, z)
        expected = published_rates(t4, t3, t3c, tsh, z, trh * 1e-9)[:4] * 3600.0 * [1e9, 1e9, 1e9, 1.0]
        np.testing.assert_allclose(thyroid.axis(jnp.asarray(x), trh), expected, rtol=1e-10)


def test_below_zero_the_secretion_is_the_line_that_touches():
    thyroid = module()
    rate = functools.partial(thyroid.axis, jnp.asarray(thyroid.STEADY))
    slopes = [jax.grad(lambda trh: rate(trh)[3])(trh) for trh in (-5.0, -1e-7, 1e-7)]
    np.testing.assert_allclose(slopes, slopes[1], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.5, 3.0, 6.0])
def test_four_steps_between_samples_are_enough(scale):
    thyroid = module()
    data = loading.load("thyroid").simulate()
    system = thyroid.build(7.0, scale, 1.5, 0.03)
    few, many = (lfm.MarginalLikelihood(system, data.times, steps=steps).log_prob(data.y) for steps in (4, 16))
    assert few == pytest.approx(float(many), abs=0.03)
