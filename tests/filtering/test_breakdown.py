"""A log likelihood of -inf says where and how the filter broke down; compiled code says nothing and costs nothing."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import DoubleWell, double_well

import lfm_ppl as lfm
from lfm_ppl.filtering.breakdown import breakdown
from lfm_ppl.filtering.schedule import schedule

TIMES = np.array([0.5, 1.0, 9.0, 9.5])
Y = np.array([0.4, 0.6, 0.5, 0.1])[:, None]


def test_the_row_and_the_step_are_named():
    """The step is far too long for a cubic force: the mean leaves the well within the third row."""
    steep = double_well(b=5.0)
    with pytest.warns(lfm.FilterWarning, match=r"row 2 \(time 9\), step \d of 10 from time 1 to 9: the predicted "
                                               r"(mean|covariance) is not finite.*-inf.*steps=.*max_step="):
        found = lfm.filter(steep, TIMES, Y)
    assert not np.isfinite(found.log_likelihood[2])
    with pytest.warns(lfm.FilterWarning, match=r"row 2 \(time 9\)"):
        lfm.smooth(steep, TIMES, Y)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isfinite(lfm.filter(steep, TIMES, Y, max_step=0.01).log_likelihood).all()


def test_a_start_is_where_the_last_window_ended():
    """Rows count from the window's first observation."""
    steep = double_well(b=5.0)
    state = lfm.filter(steep, TIMES[:2], Y[:2]).state
    with pytest.warns(lfm.FilterWarning, match=r"row 0 \(time 9\)"):
        lfm.filter(steep, TIMES[2:], Y[2:], start=state)


def test_two_outputs_that_contradict_each_other():
    """Both are the state, without noise: their innovation covariance is singular."""
    model = lfm.LatentForceModel(
        DoubleWell(), {}, lfm.GaussianObservation(lambda x, u, t: jnp.concatenate([x, x]), jnp.zeros(2)),
        lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1))
    with pytest.warns(lfm.FilterWarning, match="row 0.*innovation covariance is not positive definite"):
        lfm.filter(model, TIMES, np.concatenate([Y, Y + 1.0], axis=1))


def test_compiled_code_says_nothing():
    y = jnp.asarray(Y)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = jax.jit(lambda b: lfm.filter(double_well(b=b), TIMES, y).log_likelihood)(5.0)
    assert not np.isfinite(found).all()


def test_nothing_is_said_where_nothing_breaks_down():
    ssm = lfm.state_space(double_well())
    assert breakdown(ssm, lfm.Cubature(), schedule(ssm, TIMES, 10), Y) is None
