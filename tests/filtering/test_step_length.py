"""Gaps in the data are crossed in steps no longer than twice the usual one."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import lfm_ppl as lfm
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.model.state_space import state_space

TIMES = np.array([0.0, 0.25, 0.5, 0.5, 0.75, 1.0, 13.0, 13.25, 13.5])


def system(lengthscale=0.5, curved=True):
    shape = jnp.tanh if curved else (lambda u: u)
    return lfm.LatentForceModel(
        lambda x, u, t: 3.0 * shape(u) - x, {"u": lfm.Matern(1.0, lengthscale)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))


def longest(model, times=TIMES, **keywords):
    grid = build_time_grid(state_space(model), times, 10, **keywords)
    return np.max(grid.intervals.length) / grid.steps


def test_the_longest_step_is_at_most_twice_the_median_step():
    assert longest(system()) <= 0.05 * (1 + 1e-12)
    assert longest(system(), requested_times=np.array([40.0])) <= 0.05 * (1 + 1e-12)
    assert longest(system(), max_step=0.7) > 0.5
    assert longest(system(), tolerance=1e-3) == 1.2
    # The transitions of a linear model are exact.
    assert longest(system(curved=False)) == 1.2
    assert longest(system(), times=np.array([3.0])) == 0.0


def test_pauses_between_bursts_take_a_bounded_number_of_steps():
    bursts = (np.arange(10.0)[:, None] + 1e-6 * np.arange(50)).ravel()
    grid = build_time_grid(state_space(system()), bursts, 10)
    assert len(np.asarray(grid.intervals.length)) < 22 * len(bursts)


@pytest.mark.slow
def test_a_gap_of_many_lengthscales_is_resolved():
    y = np.sin(TIMES)[:, None]
    by_default, fine = jax.jit(lambda: tuple(lfm.MarginalLikelihood(
        system(), TIMES, iterations=0, max_step=step).log_prob(y) for step in (None, 0.0125)))()
    np.testing.assert_allclose(by_default, fine, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("spacing", "expected"), [(1.0, False), (12.0, True)])
def test_a_fit_warns_of_steps_that_do_not_resolve_a_force(spacing, expected):
    def model(times, y=None):
        lengthscale = numpyro.sample("lengthscale", dist.LogNormal(jnp.log(0.5), 0.01))
        numpyro.sample("y", lfm.MarginalLikelihood(system(lengthscale), times), obs=y)

    times = spacing * np.arange(6.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        lfm.fit(model, times, np.sin(times)[:, None], sampler="map", trajectory_draws=0, progress=False)
    messages = [str(entry.message) for entry in caught if "--max-step" in str(entry.message)]
    assert bool(messages) is expected
    if expected:
        assert "1.2" in messages[0] and "lengthscale" in messages[0]
