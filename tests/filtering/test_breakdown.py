"""A log likelihood of -inf says where and how the filter broke down; compiled code says nothing and costs nothing."""

from __future__ import annotations

import itertools
import warnings
from decimal import Decimal, localcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import DoubleWell, Linear, Outputs, double_well, identity, motif, whole_state

import lfm_ppl as lfm
from lfm_ppl.filtering.breakdown import breakdown
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.model.state_space import state_space

TIMES = np.array([0.5, 1.0, 9.0, 9.5])
Y = np.array([0.4, 0.6, 0.5, 0.1])[:, None]
LONG_STEPS = {"max_step": 1.0}  # ten steps in each interval: the default divides the long gap
RATES = np.array([0.76, -0.46])


def test_the_row_and_the_step_are_named():
    """The step is far too long for a cubic force: the mean leaves the well within the third row."""
    steep = double_well(b=5.0)
    with pytest.warns(lfm.FilterWarning, match=r"row 2 .*time 9.*step \d of 10.*steps=.*max_step="):
        result = lfm.filter(steep, TIMES, Y, **LONG_STEPS)
    assert not np.isfinite(result.log_likelihood[2])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        compiled = jax.jit(lambda b: lfm.filter(double_well(b=b), TIMES, Y, **LONG_STEPS).log_likelihood)
        assert not np.isfinite(compiled(5.0)).all(), "compiled code says nothing"
    assert np.isfinite(compiled(1.0)).all()


@pytest.mark.slow
def test_the_likelihood_says_it_outside_of_compiled_code():
    likelihood = lfm.MarginalLikelihood(double_well(b=5.0), TIMES, iterations=0, **LONG_STEPS)
    with pytest.warns(lfm.FilterWarning, match="row 2") as caught:
        assert np.isneginf(likelihood.log_prob(Y))
    assert caught[0].filename == __file__, "the user's line"
    with pytest.warns(lfm.FilterWarning, match="row 2"):
        assert np.isneginf(likelihood.log_prob_per_observation(Y)[2])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isneginf(jax.jit(likelihood.log_prob)(Y))
        assert np.isneginf(likelihood.log_prob(Y[None])).all()


@pytest.mark.slow
def test_two_outputs_that_contradict_each_other():
    """Both are the state, without noise: their innovation covariance is singular."""
    model = lfm.LatentForceModel(
        DoubleWell(), {}, lfm.GaussianObservation(lambda x, u, t: jnp.concatenate([x, x]), jnp.zeros(2)),
        lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1))
    with pytest.warns(lfm.FilterWarning, match="row 0"):
        lfm.filter(model, TIMES, np.concatenate([Y, Y + 1.0], axis=1))


def test_nothing_is_said_where_nothing_breaks_down():
    ssm = state_space(double_well())
    assert breakdown(ssm, lfm.Cubature(), build_time_grid(ssm, TIMES, 10), Y) is None


def unstable(noise):
    """One state that grows and one that decays, whose sum is observed."""
    return lfm.LatentForceModel(
        Linear(jnp.diag(RATES), jnp.zeros((2, 0))), {},
        lfm.GaussianObservation(Outputs(jnp.ones((1, 2))), jnp.array([noise])),
        lfm.Gaussian(jnp.zeros(2), jnp.eye(2)), process_noise=0.5 * jnp.eye(2), initial_time=0.0)


def exact_log_likelihood(times, y, noise):
    """The Kalman filter of `unstable` in four hundred digits."""
    decimal = np.vectorize(lambda value: Decimal(float(value)), otypes=[object])
    with localcontext() as context:
        context.prec = 400
        rates, row, log_2pi = decimal(RATES), decimal(np.ones(2)), Decimal(2 * np.pi).ln()
        mean, covariance, previous_time, total = decimal(np.zeros(2)), decimal(np.eye(2)), Decimal(0), Decimal(0)
        for time, value in zip(decimal(times), decimal(y), strict=True):
            phi = np.array([(rate * (time - previous_time)).exp() for rate in rates])
            added = Decimal("0.25") * (phi**2 - 1) / (2 * rates)
            mean, covariance, previous_time = phi * mean, phi[:, None] * covariance * phi + np.diag(added), time
            variance, innovation = row @ covariance @ row + Decimal(noise), value - row @ mean
            total -= (innovation**2 / variance + variance.ln() + log_2pi) / 2
            gain = covariance @ row / variance
            mean, covariance = mean + gain * innovation, covariance - np.outer(gain, gain) * variance
        return float(total)


@pytest.mark.thorough
def test_what_grows_beyond_all_digits_is_impossible_or_right():
    """After a gap of 169 a variance is 1e111, and what is left of it after an observation is rounding errors."""
    y = np.array([0.3, -0.4, 0.2, 0.1, 0.5])
    impossible = []
    for gap in (1.0, 10.0, 20.0, 30.0, 40.0, 60.0, 100.0, 169.0):
        times = np.array([0.5, gap, gap, gap + 0.01, gap + 1.0])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", lfm.FilterWarning)
            result = float(lfm.filter(unstable(1e-4), times, y).log_likelihood.sum())
        impossible.append(result == -np.inf)
        if not impossible[-1]:
            assert result == pytest.approx(exact_log_likelihood(times, y, 1e-4), rel=1e-5), gap
    assert impossible == [False] * 4 + [True] * 4


def test_precision_lost_is_named():
    with pytest.warns(lfm.FilterWarning, match=r"row 1 .*e\+55"):
        lfm.filter(unstable(1e-4), np.array([0.5, 169.0, 169.0, 170.0, 171.0]), np.full((5, 1), 0.1))


@pytest.mark.thorough
def test_an_uncertain_start_and_little_noise_are_no_failure():
    """Also where the first observation is exactly zero."""
    for noise, y in itertools.product((0.0, 1e-20, 1e-12), (0.0, 0.4)):
        model = lfm.LatentForceModel(
            Linear(-jnp.eye(1), jnp.ones((1, 1))), {"u": lfm.Matern(1.0, 1.0)},
            lfm.GaussianObservation(whole_state, jnp.array([noise])), lfm.Gaussian(jnp.zeros(1), 1e7 * jnp.eye(1)))
        assert np.isfinite(lfm.filter(model, TIMES, np.full((4, 1), y)).log_likelihood).all()


@pytest.mark.parametrize("noise", [0.0, 1e-18])
def test_observations_that_cross_zero_without_noise_are_no_failure(noise):
    """The scale of an output is that of all its observations: sin(pi) is 1e-16."""
    model = motif(identity, genes=1, variance=1.0, noise_sd=np.sqrt(noise), order=1)
    times = np.linspace(0.0, 2 * np.pi, 9)
    assert np.isfinite(lfm.filter(model, times, np.sin(times)).log_likelihood).all()


@pytest.mark.parametrize(("noise", "variance", "y"), [
    (0.0, 1.0, 1e-6), (0.0, 1.0, 1e-9), (0.0, 1e4, 1e-6), (1e-16, 1e6, 1e-3), (1e-12, 1e8, 1e-3)])
def test_small_observations_next_to_a_wide_prior_are_no_failure(noise, variance, y):
    dynamics = Linear(jnp.array([[-0.5, 1.0, 0.0], [-1.0, -0.5, 0.3], [0.2, 0.0, -1.0]]), jnp.ones((3, 1)))
    model = lfm.LatentForceModel(
        dynamics, {"u": lfm.Matern(1.0, 1.0, order=2)},
        lfm.GaussianObservation(Outputs(jnp.array([[1.0, 0.7, 0.0, 0.0]])), noise * jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(3), variance * jnp.eye(3)))
    result = lfm.filter(model, np.linspace(0.0, 3.0, 5), np.full((5, 1), y))
    assert np.isfinite(result.log_likelihood).all()
