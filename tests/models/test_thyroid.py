"""Pituitary and thyroid: the published steady state, the fast state that is eliminated, and IPOPT."""

import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_map import Transcribed

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
    made = (gd1 * ft4 / (ft4 + 5e-7) + 4.3e-15 * ft4 / (ft4 + 1e-9) + gt3 * tsh / (tsh + 2.75)
            + gd1 * q / (q + 5e-7) + 4.3e-15 * q / (q + 1e-9))
    stimulus = 473.0214 * trh / ((trh + 4.7e-8) * (1 + 100 * tshz / (tshz + 50)) * (1 + 1.6879e6 * t3r))
    return np.array([
        0.1 * th - 1.1e-6 * t4, 2.6e-2 * made - 8e-6 * t3p, 1.3e5 * 4.3e-15 * ft4 / (ft4 + 1e-9) - 8.3e-4 * t3c,
        0.4 * stimulus - 2.3e-4 * tsh, 2.6e5 * stimulus - 140.0 * tshz])


def test_the_steady_state_is_the_published_one():
    own = module()
    np.testing.assert_allclose(own.axis(jnp.asarray(own.STEADY), 6.9), 0.0, atol=1e-12 * own.STEADY.max())
    published = [122.02, 3.1615, 11.701, 1.8157]
    np.testing.assert_allclose(own.STEADY, published, rtol=5e-5)
    t4, t3, t3c, tsh = own.STEADY
    rates = published_rates(t4 * 1e-9, t3 * 1e-9, t3c * 1e-9, tsh, 1.9389, 6.9e-9)
    lost = np.array([1.1e-6 * t4 * 1e-9, 8e-6 * t3 * 1e-9, 8.3e-4 * t3c * 1e-9, 2.3e-4 * tsh, 140.0 * 1.9389])
    # The published value of the fast state has five digits.
    assert np.all(np.abs(rates / lost) < [1e-12, 1e-12, 1e-12, 5e-5, 5e-5])
    # With the constants of a reimplementation, T3 would be 2.6% lower.
    other = published_rates(t4 * 1e-9, t3 * 1e-9, t3c * 1e-9, tsh, 1.9389, 6.9e-9, 2.3527e-8, 1.8882e-13)[1]
    assert t3 + 1e9 * other / 8e-6 == pytest.approx(3.0804, abs=1e-4)


def test_the_rates_are_those_with_the_fast_state_at_its_own_steady_state():
    own = module()
    for x, trh in ((own.STEADY * [1.1, 0.8, 0.9, 1.5], 12.0), (own.STEADY * [0.7, 1.3, 1.2, 0.3], 0.4)):
        t4, t3, t3c, tsh = x * [1e-9, 1e-9, 1e-9, 1.0]
        low, high = 0.0, 1e3
        for _ in range(200):  # bisection on the fast rate, which falls with the fast state
            z = 0.5 * (low + high)
            low, high = (z, high) if published_rates(t4, t3, t3c, tsh, z, trh * 1e-9)[4] > 0 else (low, z)
        expected = published_rates(t4, t3, t3c, tsh, z, trh * 1e-9)[:4] * 3600.0 * [1e9, 1e9, 1e9, 1.0]
        np.testing.assert_allclose(own.axis(jnp.asarray(x), trh), expected, rtol=1e-10)


def test_below_zero_the_secretion_is_the_line_that_touches():
    own = module()
    rate = functools.partial(own.axis, jnp.asarray(own.STEADY))
    slopes = [jax.grad(lambda trh: rate(trh)[3])(trh) for trh in (-5.0, -1e-7, 1e-7)]
    np.testing.assert_allclose(slopes, slopes[1], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.5, 3.0, pytest.param(6.0, marks=pytest.mark.xfail(
    strict=True, reason="off by 0.2: an eighth of TRH's distribution is negative, where the secretion has a kink"))])
def test_four_steps_between_samples_are_exact(scale):
    own = module()
    data = loading.load("thyroid").simulate()
    system = own.build(7.0, scale, 1.5, 0.03)
    few, many = (lfm.MarginalLikelihood(system, data.times, steps=steps).log_prob(data.y) for steps in (4, 16))
    assert few == pytest.approx(float(many), abs=0.01)


@pytest.mark.slow
def test_full_information_against_ipopt():
    """In shares of the steady state; TRH is bounded where it matters, and the states are non-negative."""
    own = module()
    data = loading.load("thyroid").simulate(seed=3)
    times, y = data.times[:13], data.y[:13]
    level, scale, lengthscale, variation = 7.0, 3.0, 1.5, 0.03
    model = own.build(level, scale, lengthscale, variation)
    names = (*model.state_names, "TRH")
    bounds = dict.fromkeys(names, 0.0) | {"TRH": 7.5}
    result = lfm.full_information(model, times, y, lower=bounds, grid=times, steps=32, tolerance=1e-10)
    assert result.converged

    def drift(x, u):
        trh = (u + level) * 1e-9
        t4, t3, t3c, tsh = (x[k] * own.STEADY[k] for k in range(4))
        ft4 = t4 * 1e-9 / own.BOUND_T4
        t3n = t3c * 1e-9 / own.BOUND_T3N
        th = own.G_T * tsh / (tsh + own.D_T)
        q = th * tsh / (tsh + own.SHUNT)
        made = (own.G_D1 * (ft4 / (ft4 + own.K_M1) + q / (q + own.K_M1)) + own.G_T3 * tsh / (tsh + own.D_T)
                + own.G_D2 * (ft4 / (ft4 + own.K_M2) + q / (q + own.K_M2)))
        c = own.A_S2 * own.G_H / own.B_S2 * trh / (trh + own.D_H) / (1 + own.L_S * t3n / (t3n + own.D_R))
        z = (c - own.D_S + ((own.D_S - c) ** 2 + 4 * (1 + own.S_S) * c * own.D_S) ** 0.5) / (2 * (1 + own.S_S))
        rates = (own.A_T * th * 1e9 - own.B_T * t4, own.A_31 * made * 1e9 - own.B_31 * t3,
                 own.A_32 * own.G_D2 * 1e9 * ft4 / (ft4 + own.K_M2) - own.B_32 * t3c,
                 own.A_S * own.B_S2 / own.A_S2 * z - own.B_S * tsh)
        return [3600.0 * rate / steady for rate, steady in zip(rates, own.STEADY, strict=True)]

    reference = Transcribed(
        drift, lambda x: [x[3] * own.STEADY[3], x[1] * own.FREE[1], x[0] * own.FREE[2]], (scale, lengthscale, 1),
        np.zeros((4, 4)), np.ones(4), np.diag((own.START_SD / own.STEADY) ** 2), (variation * own.FREE) ** 2,
        [(4, 1.0, 7.5 - level), *((k, 1.0, 0.0) for k in range(4))])
    # From the steady state and the prior mean of TRH, and not from our own solution.
    guess = np.tile([1.0, 1.0, 1.0, 1.0, 0.0, 0.0], (len(times), 1))
    nodes, objective = reference.solve(times, np.asarray(y), guess, rounds=8)
    assert float(result.objective) == pytest.approx(objective, abs=1e-4)
    np.testing.assert_allclose(np.asarray(result.force("TRH")) - level, nodes[:, 4], atol=1e-3)
    # Its bounds are met to 1e-8; TRH moves by nmol/l between rows.
    at_bound = nodes[:, :5] - [0.0, 0.0, 0.0, 0.0, 7.5 - level] < 1e-5
    np.testing.assert_array_equal(np.asarray(result.active), at_bound)
    assert at_bound[:, 4].any() and not at_bound.all(axis=0).any() and not at_bound[:, :4].any()
