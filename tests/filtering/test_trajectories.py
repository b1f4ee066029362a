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
from lfm_ppl import loading
from lfm_ppl.filtering.filter import forward, preparation
from lfm_ppl.filtering.iterated import posterior_linearisation
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.smoother import smoothing_grids
from lfm_ppl.filtering.time_grid import build_time_grid
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
    found = np.einsum("dki,dkj->kij", away, away) / DRAWS
    np.testing.assert_allclose(away.mean(axis=0), 0.0, atol=4.5 / np.sqrt(DRAWS))
    variances = np.diagonal(found, axis1=1, axis2=2)[scale > 0]
    np.testing.assert_allclose(np.sqrt(variances), 1.0, atol=0.02)
    np.testing.assert_allclose(found, wanted, atol=4.5 * np.sqrt(2.0 / DRAWS))
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
    grid = build_time_grid(ssm, TIMES, 3, max_step=10.0)
    y = jnp.asarray(observed(5, softplus))
    start = Moments(*ssm.initial())

    @jax.jit
    def run(y):
        passed = forward(ssm, lfm.Cubature(), grid, y, start=start, keep="steps")
        prepared = preparation(ssm, lfm.Cubature(), grid)
        return passed, posterior_linearisation(ssm, lfm.Cubature(), grid, y, start, 1, 1.0, prepared).points.nodes

    passed, nodes = jax.tree_util.tree_map(np.asarray, run(y))
    force = 5
    # The joint prior of the force at all nodes and of all observations' errors, by the steps' affine maps.
    current = np.asarray(start.covariance)
    size = current.shape[0]
    blocks, slopes, noises = [], [], []
    before = []  # the transposed transition from each earlier node to now, times its prior covariance
    for row in range(len(TIMES)):
        for step in range(3):
            phi, noise = passed.steps.phi[row, step], passed.steps.process_cov[row, step]
            current = phi @ current @ phi.T + noise
            before = [phi @ one for one in before] + [current]
        blocks.append(list(before))
        slopes.append(passed.jacobian[row])
        noises.append(passed.obs_cov[row])
    count = 3 * len(TIMES)
    gram = np.zeros((5 * len(TIMES),) * 2)
    cross = np.zeros((count, 5 * len(TIMES)))
    for j in range(len(TIMES)):
        at = slice(5 * j, 5 * j + 5)
        for node in range(count):
            if node <= 3 * j + 2:  # Cov(observation j, node) = H_j Phi(node -> j) P(node)
                cross[node, at] = (slopes[j] @ blocks[j][node])[:, force]
        for i in range(j + 1):
            part = slopes[j] @ blocks[j][3 * i + 2] @ slopes[i].T
            gram[at, 5 * i:5 * i + 5] = part
            gram[5 * i:5 * i + 5, at] = part.T
        gram[at, at] += noises[j]
    # Nodes after an observation: Cov(node, observation i) = (Phi(i -> node) P(i))[force] H_i'.
    transitions = [np.eye(size)]
    for node in range(count):
        transitions.append(passed.steps.phi[node // 3, node % 3])
    marginal = [np.asarray(start.covariance)]
    for node in range(count):
        own = passed.steps.process_cov[node // 3, node % 3]
        marginal.append(transitions[node + 1] @ marginal[-1] @ transitions[node + 1].T + own)
    for i in range(len(TIMES)):
        moved = marginal[3 * i + 3]
        for node in range(3 * i + 3, count):
            moved = transitions[node + 1] @ moved
            cross[node, 5 * i:5 * i + 5] = moved[force] @ slopes[i].T
    variance = np.array([marginal[node + 1][force, force] for node in range(count)])
    expected = variance - np.einsum("ij,ij->i", cross, np.linalg.solve(gram, cross.T).T)
    np.testing.assert_allclose(nodes.covariance[:, 1:, 0, 0].ravel(), expected, rtol=1e-9)


def test_many_requested_times_share_the_steps_of_an_interval():
    """The scan for draws integrates in steps as short as the data's, however many times are asked for."""
    def grids(at, max_step=None):
        return smoothing_grids(state_space(motif(softplus)), TIMES, 12, max_step, at, 0)

    assert grids(np.linspace(0.0, 14.0, 141)).joint.steps == 1  # 0.1 of the gap of 2, whose steps take a sixth
    assert grids(np.linspace(0.0, 14.0, 29)).joint.steps == 3
    assert grids(np.array([1.0])).joint.steps == 12  # other gaps are whole
    # Gaps of 2 are cut into four pieces of 12 steps by max_step, and each of these in halves by the requested times.
    assert grids(np.linspace(0.0, 14.0, 57), max_step=0.05).joint.steps == 6
    assert grids(np.linspace(0.0, 300.0, 31)).joint.steps == 12, "a forecast takes no more than before"
    model, y = motif(softplus, genes=2), observed(2, softplus)
    many = lfm.smooth(model, TIMES, y, steps=12, at=np.linspace(0.0, 14.0, 141))
    assert_draws_have_the_moments_of(many)


def bent(x, u, t):
    return softplus(x)


def jumping(functions=7):
    kernel = lfm.forces.PeriodicSquaredExponential(1.0, 1.5, 3.0)
    return {"u": lfm.QuasiPeriodic(kernel, lfm.forces.SQM(1.5, (3.0, 4.0, 13.0)), functions=functions)}


def genes_with(forces=None, observe=None, initial_time=0.0):
    genes = motif(softplus, noise_sd=0.0682)
    noise = genes.observation if observe is None else lfm.GaussianObservation(observe, 0.0682**2 * jnp.ones(2))
    return lfm.LatentForceModel(genes.dynamics, forces or genes.forces, noise, genes.initial_state,
                                initial_time=initial_time)


@pytest.mark.parametrize("model", [
    genes_with(observe=bent), pytest.param(genes_with(initial_time=-1.0), marks=pytest.mark.slow),
    pytest.param(genes_with(jumping(5), bent), marks=pytest.mark.slow)], ids=["plain", "early start", "jumps"])
def test_the_scan_for_draws_repeats_that_of_the_iterations(model):
    """It is linearised about the same moments: at the ends of the same steps the filter is the same."""
    steps, y = 6, observed(2, softplus)
    ssm, start = state_space(model), model.initial_time
    grid = build_time_grid(ssm, TIMES, steps, max_step=10.0)
    row_start, length = grid.intervals.start[:, None], grid.intervals.length[:, None]
    ends = np.unique(np.append(row_start + length * np.arange(1, steps) / steps, TIMES))
    wanted = lfm.smooth(model, TIMES, y, steps=steps, max_step=10.0, iterations=3)._joint.passed
    at = ends[ends > start]
    rows = smoothing_grids(ssm, TIMES, steps, 10.0, at, 3).joint.observed
    found = lfm.smooth(model, TIMES, y, steps=steps, max_step=10.0, iterations=3, at=at)._joint.passed
    np.testing.assert_allclose(found.filtered.covariance[rows], wanted.filtered.covariance[grid.observed], atol=1e-10)
    np.testing.assert_allclose(found.gain[rows], wanted.gain[grid.observed], atol=1e-9)


@pytest.mark.parametrize("max_step", [None, 0.05])
def test_nodes_of_the_scan_for_draws_are_found_on_that_of_the_marginals(max_step):
    ssm = state_space(genes_with(jumping()))
    base, joint, _, at, _ = smoothing_grids(ssm, TIMES, 6, max_step, np.append(AT, 2.5), 3)
    times = joint.intervals.start[:, None] + joint.intervals.length[:, None] * np.linspace(0, 1, joint.steps + 1)
    length = base.intervals.length[at.interval]
    found = base.intervals.start[at.interval] + length * (at.step + at.share) / base.steps
    np.testing.assert_allclose(found, times, atol=1e-12)
    assert at.step.max() == base.steps - 1 and (at.share >= 0).all() and (at.share <= 1).all()
    np.testing.assert_array_equal(at.end[joint.observed], base.observed)
    # Just before a jump a node lies in the interval that ends with it, just after it in the next.
    ends = np.flatnonzero(joint.intervals.jump >= 0)
    assert len(ends) == 3
    np.testing.assert_array_equal(base.intervals.jump[at.interval[ends, -1]], joint.intervals.jump[ends])
    after = ends + 1 + (joint.intervals.length[ends + 1] == 0)
    assert (at.interval[after, 0] > at.interval[ends, -1]).all()
