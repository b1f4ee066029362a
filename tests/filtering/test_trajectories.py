"""Draws of trajectories have the moments that the smoother reports, and these are those of dense algebra."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.handlers import condition, seed, trace
from systems import identity, motif, softplus

import lfm_ppl as lfm
from lfm_ppl.filtering.forward import forward
from lfm_ppl.filtering.iterated import posterior_linearisation
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.problem import filter_problem
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.filtering.update import GaussianUpdate
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
    drawn = result.sample(jax.random.key(3), DRAWS)
    forces = [np.asarray(drawn.forces[name])[..., None] for name in result.force_names]
    w = np.concatenate([np.asarray(drawn.state), *forces], axis=2)
    mean, covariance = np.asarray(result.input_mean), np.asarray(result.input_covariance)
    wanted, scale = standardised(covariance)
    away = (w - mean) * scale
    computed = np.einsum("dki,dkj->kij", away, away) / DRAWS
    np.testing.assert_allclose(away.mean(axis=0), 0.0, atol=4.5 / np.sqrt(DRAWS))
    variances = np.diagonal(computed, axis1=1, axis2=2)[scale > 0]
    np.testing.assert_allclose(np.sqrt(variances), 1.0, atol=0.02)
    np.testing.assert_allclose(computed, wanted, atol=4.5 * np.sqrt(2.0 / DRAWS))
    still = np.broadcast_to(scale == 0, away.shape)
    assert np.abs((w - mean)[still]).max(initial=0.0) < 1e-9, "what is known does not vary"


@functools.cache
def observed(genes, link):
    y = np.asarray(lfm.simulate(jax.random.key(genes), motif(link, genes=genes), TIMES).y).copy()
    y[3, 0] = np.nan
    return y


def check(link, genes, variance, steps, iterations, at=AT, noise_sd=0.0682):
    model = motif(link, genes=genes, variance=variance, noise_sd=noise_sd)
    assert_draws_have_the_moments_of(
        lfm.smooth(model, TIMES, observed(genes, link), steps=steps, iterations=iterations, at=at))


@pytest.mark.parametrize(("link", "genes", "variance", "steps", "iterations"), [
    (identity, 5, 0.0, 10, 0), pytest.param(softplus, 2, 1e-10, 3, 3, marks=pytest.mark.slow),
    pytest.param(identity, 1, 1e8, 10, 0, marks=pytest.mark.slow),
    pytest.param(softplus, 5, 0.0, 1, 0, marks=pytest.mark.slow)])
def test_draws_have_the_reported_moments(link, genes, variance, steps, iterations):
    check(link, genes, variance, steps, iterations)


def test_draws_of_many_steps_at_the_data_have_the_reported_moments():
    """What moves five genes over an interval is of rank two but for rounding, and no ``at`` corrects the draws."""
    check(softplus, 5, 1.0, 50, 0, at=None)


@pytest.mark.slow
@pytest.mark.parametrize("iterations", [0, 3])
@pytest.mark.parametrize("steps", [1, 10, 50])
@pytest.mark.parametrize("variance", [0.0, 1e-10, 1.0, 1e6])
@pytest.mark.parametrize("genes", [1, 3, 5])
def test_draws_of_many_settings_have_the_reported_moments(genes, variance, steps, iterations):
    for at in (AT, None):
        check(softplus, genes, variance, steps, iterations, at)
        if iterations == 0:
            check(identity, genes, variance, steps, iterations, at)


@pytest.mark.slow
@pytest.mark.parametrize("noise_sd", [1e-10, 1e-4])
@pytest.mark.parametrize("link", [identity, softplus])
def test_draws_with_hardly_any_noise_have_the_reported_moments(link, noise_sd):
    check(link, 2, 0.0, 10, 0, noise_sd=noise_sd)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(loading.available()) - {"gps"}))
def test_draws_of_every_model_file_have_the_reported_moments(name):
    file = loading.load(name)
    data = file.simulate()
    if file.prepare is not None:
        data = file.prepare(data)
    values = {key: jnp.asarray(value) for key, value in data.truth["parameters"].items()}
    seeded = seed(condition(file.model, values), jax.random.key(0))
    sites = trace(seeded).get_trace(data.times, data.y, **file.keywords(data, {}))
    (site,) = [one for one in sites.values() if isinstance(one.get("fn"), lfm.MarginalLikelihood)]
    end = data.times[-1] + 0.1 * (data.times[-1] - data.times[0])
    assert_draws_have_the_moments_of(site["fn"].smooth(data.y, at=np.linspace(data.times[0], end, 12)))


def test_nodes_after_a_known_start_are_those_of_dense_algebra():
    """Five genes that one force moves from a known start: the covariance of their state is nearly singular."""
    model = motif(softplus, genes=5, noise_sd=0.0682)
    ssm = lfm.state_space(model)
    distinct = np.unique(TIMES)
    ends = (distinct[:-1, None] + np.diff(distinct)[:, None] * np.array([1.0, 2.0, 3.0]) / 3).ravel()
    grid = build_time_grid(ssm, TIMES, 3, max_step=10.0, requested_times=ends)
    assert grid.steps == 1
    y = jnp.asarray(observed(5, softplus))
    start = Moments(*ssm.initial())

    @jax.jit
    def run(y):
        problem, updater = filter_problem(ssm, lfm.Cubature(), grid), GaussianUpdate(y)
        trace = forward(problem, updater, record=Record.SMOOTHER)
        return trace, posterior_linearisation(problem, updater, 1, 1.0).points.nodes

    trace, nodes = jax.tree.map(np.asarray, run(y))
    size, count, force = start.mean.shape[0], len(trace.phi), 5
    # prior[k]: covariance at the end of interval k; the joint prior follows from the affine maps of the intervals.
    prior, covariance = [], np.asarray(start.covariance)
    for phi, noise in zip(trace.phi, trace.process_cov, strict=True):
        covariance = phi @ covariance @ phi.T + noise
        prior.append(covariance)
    transition = np.zeros((count, count, size, size))
    for first in range(count):
        transition[first, first] = np.eye(size)
        for later in range(first + 1, count):
            transition[later, first] = trace.phi[later] @ transition[later - 1, first]
    joint = np.zeros((count, count, size, size))
    for first in range(count):
        for later in range(first, count):
            joint[later, first] = transition[later, first] @ prior[first]
            joint[first, later] = joint[later, first].T
    rows = np.asarray(grid.observed)
    slope = trace.update.jacobian[rows]
    cross = np.einsum("kiab,icb->kaic", joint[:, rows], slope)[:, force].reshape(count, -1)
    gram = np.einsum("iax,ijxy,jby->iajb", slope, joint[np.ix_(rows, rows)], slope).reshape((5 * len(rows),) * 2)
    for index, row in enumerate(rows):
        gram[5 * index:5 * index + 5, 5 * index:5 * index + 5] += trace.update.obs_cov[row]
    reduction = np.einsum("ij,ij->i", cross, np.linalg.solve(gram, cross.T).T)
    expected = np.array([covariance[force, force] for covariance in prior]) - reduction
    np.testing.assert_allclose(nodes.covariance[:, -1, 0, 0], expected, rtol=1e-9)


def test_requested_times_share_the_steps_of_an_interval():
    ssm = state_space(motif(softplus))

    def steps_at(at, max_step=None):
        grid = build_time_grid(ssm, TIMES, 12, max_step, at)
        return len(grid.intervals.length) * grid.steps, np.max(grid.intervals.length) / grid.steps

    whole, longest = steps_at(None)
    for at in (np.linspace(0.0, 14.0, 141), np.linspace(0.0, 14.0, 29), np.array([1.0])):
        count, step = steps_at(at)
        assert step <= longest * (1 + 1e-12) and count <= 2 * whole + 13 * len(at)
    assert steps_at(np.linspace(0.0, 14.0, 57), max_step=0.05)[1] <= 0.05 * (1 + 1e-12)
    assert steps_at(np.array([300.0]))[1] <= longest, "a forecast takes steps of the usual length"


@pytest.mark.parametrize(("genes", "variance", "steps"), [
    (5, 0.0, 24), (1, 1e-10, 1), *(pytest.param(genes, variance, steps, marks=pytest.mark.slow)
                                   for genes in (1, 5) for variance in (0.0, 1e-10, 1e6)
                                   for steps in (1, 2, 5, 10, 22, 24, 26, 40, 60))])
def test_draws_between_and_after_the_data_have_the_marginal_sd(genes, variance, steps):
    model = motif(softplus, genes=genes, variance=variance, noise_sd=0.0682)
    result = lfm.smooth(model, TIMES, observed(genes, softplus), steps=steps, at=np.arange(0.0, 18.0))
    drawn = result.sample(jax.random.key(1), DRAWS)
    sd = np.sqrt(np.diagonal(np.asarray(result.input_covariance), axis1=1, axis2=2))
    drawn_sd = np.concatenate([np.asarray(drawn.state), np.asarray(drawn.forces["u"])[..., None]], axis=2).std(axis=0)
    np.testing.assert_allclose(drawn_sd, sd, rtol=0.02, atol=1e-9)


@pytest.mark.parametrize("iterations", [0, 3])
def test_requested_times_move_the_moments_by_the_integration_error(iterations):
    """The error of an interval that is divided is that of its steps, of fourth order."""
    model, y, at = motif(softplus, genes=2, noise_sd=0.0682), observed(2, softplus), np.array([0.5, 3.1, 9.3])

    def difference(steps):
        plain = lfm.smooth(model, TIMES, y, steps=steps, iterations=iterations)
        divided = lfm.smooth(model, TIMES, y, steps=steps, iterations=iterations, at=np.append(at, TIMES))
        sd = np.sqrt(np.diagonal(plain.covariance, axis1=1, axis2=2))
        change = np.abs(divided.mean[len(at):] - plain.mean)
        assert change[sd < 1e-9].max(initial=0.0) < 1e-9
        return (change[sd > 1e-9] / sd[sd > 1e-9]).max()

    default, fine = difference(10), difference(20)
    assert default < 2e-3 and fine < default / 6
