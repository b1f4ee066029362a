"""Draws of trajectories have the moments that the smoother reports, which are the moments by dense algebra."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.handlers import condition, seed, trace
from systems import identity, motif, softplus

import lfm_ppl as lfm
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.io import loading
from lfm_ppl.model.state_space import state_space

TIMES = np.array([0.0, 0.0, 2.0, 4.0, 4.0, 6.0, 12.0, 14.0])  # replicates and a gap
AT = np.array([0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 9.0, 14.0, 15.0, 20.0])  # ends with a forecast
DRAWS = 20_000


def standardised(covariance):
    """Return covariances (K, n, n) as correlations, zero where a variance is."""
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    scale = np.where(sd > 1e-12, 1.0 / np.where(sd > 1e-12, sd, 1.0), 0.0)
    return covariance * scale[:, :, None] * scale[:, None, :], scale


def assert_draws_have_the_moments_of(result):
    """Errors of a correlation and of a share of a variance are 0.7% and 1% from 20,000 draws: 4.5 of these."""
    sample = result.sample(jax.random.key(3), DRAWS)
    forces = [np.asarray(sample.forces[name])[..., None] for name in result.force_names]
    w = np.concatenate([np.asarray(sample.state), *forces], axis=2)
    mean, covariance = np.asarray(result.input_mean), np.asarray(result.input_covariance)
    expected, scale = standardised(covariance)
    residual = (w - mean) * scale
    computed = np.einsum("dki,dkj->kij", residual, residual) / DRAWS
    np.testing.assert_allclose(residual.mean(axis=0), 0.0, atol=4.5 / np.sqrt(DRAWS))
    variances = np.diagonal(computed, axis1=1, axis2=2)[scale > 0]
    np.testing.assert_allclose(np.sqrt(variances), 1.0, atol=0.02)
    np.testing.assert_allclose(computed, expected, atol=4.5 * np.sqrt(2.0 / DRAWS))
    is_constant = np.broadcast_to(scale == 0, residual.shape)
    assert np.abs((w - mean)[is_constant]).max(initial=0.0) < 1e-9, "what is known does not vary"


@functools.cache
def observed(genes, link):
    y = np.asarray(lfm.simulate(jax.random.key(genes), motif(link, genes=genes), TIMES).y).copy()
    y[3, 0] = np.nan
    return y


def check(link, genes, variance, steps, iterations, requested_times=AT, noise_sd=0.0682):
    model = motif(link, genes=genes, variance=variance, noise_sd=noise_sd)
    assert_draws_have_the_moments_of(
        lfm.smooth(model, TIMES, observed(genes, link), steps=steps, iterations=iterations, at=requested_times))


@pytest.mark.thorough
@pytest.mark.parametrize(("link", "genes", "variance", "steps", "iterations"), [
    (identity, 5, 0.0, 10, 0), pytest.param(softplus, 2, 1e-10, 3, 3, marks=pytest.mark.slow)])
def test_draws_have_the_reported_moments(link, genes, variance, steps, iterations):
    check(link, genes, variance, steps, iterations)


@pytest.mark.slow
@pytest.mark.parametrize(("genes", "variance", "steps", "iterations"), [
    (1, 1e8, 10, 3), (3, 0.0, 1, 3), (5, 1.0, 50, 0)])
def test_draws_of_many_settings_have_the_reported_moments(genes, variance, steps, iterations):
    """Among them many steps of five genes: what moves these over an interval is of rank two but for rounding."""
    for requested_times in (AT, None):
        check(softplus, genes, variance, steps, iterations, requested_times)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pharmacokinetics", "heat", "home-heating"])
def test_draws_of_a_model_file_have_the_reported_moments(name):
    """Of one with doses, one with many states and one with a known input."""
    file = loading.load(name)
    data = file.simulate()
    if file.prepare is not None:
        data = file.prepare(data)
    values = {key: jnp.asarray(value) for key, value in data.truth["parameters"].items()}
    seeded = seed(condition(file.model, values), jax.random.key(0))
    sites = trace(seeded).get_trace(data.times, data.y, **file.keywords(data, {}))
    (site,) = [candidate for candidate in sites.values() if isinstance(candidate.get("fn"), lfm.MarginalLikelihood)]
    end = data.times[-1] + 0.1 * (data.times[-1] - data.times[0])
    assert_draws_have_the_moments_of(site["fn"].smooth(data.y, at=np.linspace(data.times[0], end, 12)))


def test_requested_times_share_the_steps_of_an_interval():
    ssm = state_space(motif(softplus))

    def steps_at(requested_times, max_step=None):
        grid = build_time_grid(ssm, TIMES, 12, max_step, requested_times)
        return len(grid.intervals.length) * grid.steps, np.max(grid.intervals.length) / grid.steps

    plain_count, longest = steps_at(None)
    for requested_times in (np.linspace(0.0, 14.0, 141), np.linspace(0.0, 14.0, 29), np.array([1.0])):
        count, step = steps_at(requested_times)
        assert step <= longest * (1 + 1e-12) and count <= 2 * plain_count + 13 * len(requested_times)
    assert steps_at(np.linspace(0.0, 14.0, 57), max_step=0.05)[1] <= 0.05 * (1 + 1e-12)
    assert steps_at(np.array([300.0]))[1] <= longest, "a forecast takes steps of the usual length"


@pytest.mark.slow
def test_requested_times_move_the_moments_by_the_integration_error():
    """The error of an interval that is divided is that of its steps, of fourth order."""
    model, y = motif(softplus, genes=2, noise_sd=0.0682), observed(2, softplus)
    requested_times = np.array([0.5, 3.1, 9.3])

    def difference(steps):
        plain = lfm.smooth(model, TIMES, y, steps=steps)
        divided = lfm.smooth(model, TIMES, y, steps=steps, at=np.append(requested_times, TIMES))
        sd = np.sqrt(np.diagonal(plain.covariance, axis1=1, axis2=2))
        change = np.abs(divided.mean[len(requested_times):] - plain.mean)
        assert change[sd < 1e-9].max(initial=0.0) < 1e-9
        return (change[sd > 1e-9] / sd[sd > 1e-9]).max()

    default, fine = difference(10), difference(20)
    assert default < 2e-3 and fine < default / 6
