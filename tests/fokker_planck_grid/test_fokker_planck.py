"""The Fokker-Planck grid against closed forms, quadrature, and the Kalman filter where that is exact."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import double_well, first_state, whole_state

import lfm_ppl as lfm
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.fokker_planck_grid.fokker_planck import Grid, choose_grid, fokker_planck, log_likelihood
from lfm_ppl.forces import Force
from lfm_ppl.model.state_space import state_space

TIMES = np.array([0.1, 0.45, 0.45, 0.8, 1.5, 1.7, 2.9, 3.0, 4.2])
AT = np.array([3.5, 0.0, 0.45, 1.1, 5.0])


def linear(x, u, t):
    return 0.3 - x


def forced(x, u, t):
    return jnp.sin(2.0 * t) - x


def zero_drift(x, u, t):
    return jnp.zeros_like(x)


def force_alone(x, u, t):
    return u


def ornstein_uhlenbeck(drift=linear, noise=0.3, variance=0.7):
    return lfm.LatentForceModel(
        drift, {}, lfm.GaussianObservation(whole_state, jnp.array([noise])), lfm.Gaussian([0.5], [variance]),
        process_noise=jnp.array([[1.2]]), initial_time=0.0)


class Jumping(Force):
    """dz = -z dt + dbeta, that jumps to 0.5 z + N(0, 0.3) at 1.6."""

    mean: float = 0.2
    state_dim = 1
    noise_dim = 1
    jump_times = (1.6,)

    def initial_covariance(self):
        return jnp.array([[0.5]])

    def feedback(self):
        return jnp.array([[-1.0]])

    def dispersion(self):
        return jnp.array([[1.0]])

    def jump(self, index):
        return jnp.array([[0.5]]), jnp.array([[0.3]])


def only(force):
    return lfm.LatentForceModel(zero_drift, {"u": force}, lfm.GaussianObservation(force_alone, jnp.array([0.3])),
                                lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))), initial_time=0.0)


def data(model, seed=1, missing=(4,)):
    y = np.array(lfm.simulate(jax.random.key(seed), model, TIMES).y)
    y[list(missing)] = np.nan
    return y


LINEAR = {
    "known start": (ornstein_uhlenbeck(variance=0.0), {}),
    "drift of time": (ornstein_uhlenbeck(forced), {"steps": 60}),
    "force that jumps": (only(Jumping()), {}),
}


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=() if name == "known start" else pytest.mark.slow) for name in LINEAR])
def test_it_equals_the_kalman_filter_and_smoother(name):
    model, options = LINEAR[name]
    y = data(model)
    result = fokker_planck(model, TIMES, y, at=AT, cells=1000, bounds=(-6.0, 6.0), **options)
    exact = lfm.filter(model, TIMES, y, steps=100)
    smooth = lfm.smooth(model, TIMES, y, at=AT, steps=100)
    assert abs(float(result.log_likelihood.sum() - exact.log_likelihood.sum())) < 1e-4
    np.testing.assert_allclose(result.log_likelihood, exact.log_likelihood, atol=1e-4)
    assert result.error < 1e-4
    np.testing.assert_allclose(result.mean, exact.filtered_mean[:, 0], atol=1e-4)
    np.testing.assert_allclose(result.sd, np.sqrt(exact.filtered_covariance[:, 0, 0]), atol=1e-4)
    np.testing.assert_array_equal(result.smoothed_times, AT)
    # A known start is one cell wide on a grid.
    is_point = (AT == 0) & (name == "known start")
    np.testing.assert_allclose(result.smoothed_mean, smooth.mean[:, 0], atol=1e-4)
    np.testing.assert_allclose(result.smoothed_sd[~is_point], np.sqrt(smooth.covariance[:, 0, 0])[~is_point], atol=1e-4)
    for densities in (result.predicted, result.filtered, result.smoothed):
        np.testing.assert_allclose(densities.sum(1) * result.width, 1.0, atol=1e-9)
        assert densities.min() >= 0.0


@pytest.mark.slow
def test_equal_intervals_use_the_matrix_and_agree():
    model, times = ornstein_uhlenbeck(), np.arange(12) * 0.4
    y = np.array(lfm.simulate(jax.random.key(2), model, times).y)
    result = fokker_planck(model, times, y, cells=800, bounds=(-6.0, 6.0))
    exact, smooth = lfm.filter(model, times, y), lfm.smooth(model, times, y)
    assert abs(float(result.log_likelihood.sum() - exact.log_likelihood.sum())) < 1e-4
    np.testing.assert_allclose(result.smoothed_mean, smooth.mean[:, 0], atol=1e-4)
    np.testing.assert_allclose(result.smoothed_sd, np.sqrt(smooth.covariance[:, 0, 0]), atol=1e-4)


WELL = double_well(mean=0.9, variance=0.05, dispersion=0.8, noise=0.04, b=1.5)
WELL_TIMES = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5])
WELL_Y = np.array([0.7, 1.1, np.nan, -0.2, -0.9, -0.6])[:, None]


@pytest.mark.slow
def test_second_order_in_the_width_of_a_cell():
    ssm = state_space(WELL)
    time_grid = build_time_grid(ssm, WELL_TIMES, 1)
    value = {n: float(log_likelihood(ssm, time_grid, WELL_Y, Grid(-2.5, 2.5, n))) for n in (50, 100, 200, 800)}
    errors = [abs(value[n] - value[800]) for n in (50, 100, 200)]
    # The error of the fine grid itself adds at most a fifteenth to the last one.
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all((orders > 1.8) & (orders < 2.2)), orders


@pytest.mark.thorough
def test_stationary_density_of_the_double_well():
    result = fokker_planck(WELL, [0.0, 200.0], [[np.nan], [0.5]], cells=400, bounds=(-2.6, 2.6))
    # The drift is -(a x + b x^3) with a = -1, so that 2 Phi / sigma^2 is:
    density = np.exp(-2.0 * (-result.x**2 / 2 + 1.5 * result.x**4 / 4) / 0.8**2)
    density = density / (density.sum() * result.width)
    np.testing.assert_allclose(result.predicted[1], density, atol=1e-4)


def growing(x, u, t):
    return 0.4 * x


def proportional(x, u, t):
    return 0.5 * jnp.reshape(x, (1, 1))


@pytest.mark.slow
def test_state_dependent_dispersion_against_geometric_brownian_motion():
    model = lfm.LatentForceModel(growing, {}, lfm.GaussianObservation(whole_state, jnp.array([0.1])),
                                 lfm.Gaussian([1.0], [0.0]), process_noise=proportional, initial_time=0.0)
    largest = []
    for cells in (400, 800):
        result = fokker_planck(model, [0.5], [[1.2]], cells=cells, bounds=(0.0, 6.0), tolerance=1.0)
        # Ito: log x(t) is normal with mean (0.4 - 0.5^2 / 2) t and variance 0.5^2 t.
        variance = 0.5**2 * 0.5
        z = (np.log(result.x) - (0.4 - 0.5**2 / 2) * 0.5) / np.sqrt(variance)
        exact = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi * variance) / result.x
        largest.append(np.abs(result.predicted[0] - exact).max())
    assert largest[1] < 2e-4
    assert 3.5 < largest[0] / largest[1] < 4.5


def rising(x, u, t):
    return jnp.reshape(0.5 + t, (1, 1)) + 0.0 * x


@pytest.mark.slow
def test_dispersion_that_depends_on_time():
    model = lfm.LatentForceModel(zero_drift, {}, lfm.GaussianObservation(whole_state, jnp.array([0.1])),
                                 lfm.Gaussian([0.2], [0.1]), process_noise=rising, initial_time=0.0)
    result = fokker_planck(model, [1.0], [[0.0]], at=[1.0], cells=600, bounds=(-9.0, 9.0), steps=20)
    masses = result.predicted[0] * result.width
    # int_0^1 (0.5 + t)^2 dt = 13 / 12; the midpoint rule with 20 steps lacks 1 / (12 20^2).
    expected = 0.1 + 13 / 12
    assert abs(float(masses @ result.x) - 0.2) < 1e-6
    assert abs(float(masses @ (result.x - 0.2) ** 2) - expected) < 1.0 / (12 * 20**2) + result.width**2 / 4


def state_and_angle(x, u, t):
    return jnp.concatenate([x, 2.0 * x + x**2])


def widening(x, u, t):
    return jnp.diag(jnp.array([0.2, 0.3])) + 0.1 * jnp.ones((2, 2)) * (1.0 + x[0] ** 2)


@pytest.mark.slow
@pytest.mark.parametrize(("angular", "y"), [((), [1.2, np.nan]), ((1,), [1.2, 3.0])])
def test_likelihood_of_several_outputs_against_quadrature(y, angular):
    y = np.array(y)
    model = lfm.LatentForceModel(zero_drift, {}, lfm.GaussianObservation(state_and_angle, widening, angular),
                                 lfm.Gaussian([0.8], [0.3]), process_noise=jnp.eye(1))
    result = fokker_planck(model, [0.0, 1.0], [y, [np.nan, np.nan]], cells=600, bounds=(-5.0, 6.5), tolerance=0.1)
    x = np.linspace(-4.0, 5.6, 4001)
    residual = y - np.stack([x, 2.0 * x + x**2], axis=-1)
    if angular:
        residual[:, 1] = np.angle(np.exp(1j * residual[:, 1]))
    present = np.flatnonzero(np.isfinite(y))
    noise = np.diag([0.2, 0.3]) + 0.1 * (1.0 + x[:, None, None] ** 2)
    noise, residual = noise[:, present][:, :, present], residual[:, present]
    square = np.einsum("ki,ki->k", residual, np.linalg.solve(noise, residual[..., None])[..., 0])
    likelihood = np.exp(-0.5 * square) / np.sqrt(np.linalg.det(2 * np.pi * noise))
    prior = np.exp(-0.5 * (x - 0.8) ** 2 / 0.3) / np.sqrt(2 * np.pi * 0.3)
    # The wrapped residual jumps by 2 pi, where the likelihood has a kink.
    assert abs(float(result.log_likelihood[0]) - np.log((prior * likelihood).sum() * (x[1] - x[0]))) < 1e-4


@pytest.mark.slow
def test_a_likelihood_as_narrow_as_a_cell_is_integrated():
    grid = Grid(-5.0, 5.0, 100)
    for sd in (0.05, 0.025):
        model = ornstein_uhlenbeck(noise=sd**2, variance=1.0)
        ssm = state_space(model)
        for y in (0.0, 0.05, 0.13):
            value = log_likelihood(ssm, build_time_grid(ssm, [0.0], 1), [[y]], grid)
            exact = -0.5 * (y - 0.5) ** 2 / (1.0 + sd**2) - 0.5 * np.log(2 * np.pi * (1.0 + sd**2))
            # Within half a cell the density changes by at most |y - 0.5| 0.05; quadrature adds a percent.
            assert abs(float(value) - exact) < 0.035


@pytest.mark.slow
def test_an_outlier_keeps_its_likelihood():
    model = ornstein_uhlenbeck()
    times, y = [0.0, 0.5, 1.0], np.array([[0.2], [12.0], [0.3]])
    coarse, fine = (fokker_planck(model, times, y, tolerance=10.0, cells=n, bounds=(-6.0, 14.0)) for n in (400, 800))
    exact = lfm.filter(model, times, y)
    assert np.isfinite(fine.smoothed).all()
    # Where the density falls by a factor within a cell the error is visible, but still of second order.
    for fine_value, at_half, expected in ((fine.log_likelihood, coarse.log_likelihood, exact.log_likelihood),
                                          (fine.mean, coarse.mean, exact.filtered_mean[:, 0])):
        np.testing.assert_allclose((4.0 * fine_value - at_half) / 3.0, expected, rtol=1e-3)


def parameters(theta):
    return double_well(mean=0.9, variance=0.05, dispersion=theta[1], noise=theta[2], b=theta[0])


@pytest.mark.slow
def test_batches_and_vmap_equal_loops():
    times = WELL_TIMES**1.1
    ssm, grid = state_space(WELL), Grid(-3.0, 3.0, 60)
    time_grid = build_time_grid(ssm, times, 1)
    sets = np.stack([WELL_Y, WELL_Y[::-1], 0.5 * WELL_Y])
    run = jax.jit(lambda y: log_likelihood(ssm, time_grid, y, grid))
    np.testing.assert_allclose(run(sets), [run(y) for y in sets], rtol=1e-12)
    log_density = jax.jit(lambda theta: log_likelihood(state_space(parameters(theta)), time_grid,
                                                       jnp.asarray(WELL_Y), grid))
    thetas = jnp.array([[1.5, 0.8, 0.04], [0.7, 1.1, 0.04], [2.0, 0.3, 0.04]])
    loop = [log_density(theta) for theta in thetas]
    np.testing.assert_allclose(jax.jit(jax.vmap(log_density))(thetas), loop, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(lambda t: jax.lax.map(log_density, t))(thetas), loop, rtol=1e-12)


@pytest.mark.thorough
def test_derivatives_in_forward_mode_and_failure():
    """Failure in compiled code is minus infinity."""
    ssm, grid = state_space(WELL), Grid(-3.0, 3.0, 60)
    time_grid = build_time_grid(ssm, WELL_TIMES, 1)
    log_density = jax.jit(lambda theta: log_likelihood(state_space(parameters(theta)), time_grid,
                                                       jnp.asarray(WELL_Y), grid))
    theta = jnp.array([1.5, 0.8, 0.04])
    slope = jax.jit(jax.jacfwd(log_density))(theta)
    for index, step in enumerate(1e-5 * np.eye(3)):
        difference = log_density(theta + step) - log_density(theta - step)
        np.testing.assert_allclose(slope[index], difference / 2e-5, rtol=1e-5)
    for bad in ((np.nan, 0.8, 0.1), (1.0, 0.8, 0.0), (np.inf, 0.8, 0.1), (1.0, 0.8, np.nan)):
        assert log_density(np.array(bad)) == -np.inf


@pytest.mark.slow
def test_the_chosen_grid_is_as_accurate_as_asked():
    tolerance = 2e-3
    grid = choose_grid(WELL, WELL_TIMES, WELL_Y, tolerance=tolerance)
    ssm = state_space(WELL)
    time_grid = build_time_grid(ssm, WELL_TIMES, 1)
    wide = Grid(grid.low - 0.5, grid.high + 0.5, int(3 * grid.cells * (1 + 1 / (grid.high - grid.low))))
    value, better = (float(log_likelihood(ssm, time_grid, WELL_Y, g)) for g in (grid, wide))
    assert abs(value - better) < tolerance
    result = fokker_planck(WELL, WELL_TIMES, WELL_Y, tolerance=tolerance)
    assert result.grid == grid and result.error < tolerance
    assert abs(value - better) < 2.0 * result.error
    filtered = np.asarray(result.filtered * result.width)
    assert filtered[:, :3].max() < 1e-10 and filtered[:, -3:].max() < 1e-10


@pytest.mark.slow
def test_one_grid_for_several_models_and_data_sets():
    models = [parameters(theta) for theta in ((1.5, 0.8, 0.04), (0.5, 1.0, 0.04))]
    sets = np.stack([WELL_Y, -WELL_Y])
    shared = choose_grid(models, WELL_TIMES, sets, tolerance=5e-3)
    alone = [choose_grid(model, WELL_TIMES, y, tolerance=5e-3) for model in models for y in sets]
    assert shared.low <= min(g.low for g in alone) + 0.2 and shared.high >= max(g.high for g in alone) - 0.2
    assert shared.cells >= min(g.cells for g in alone)


@pytest.mark.slow
def test_what_a_wide_prior_loses_outside_the_grid_is_not_lost_in_the_likelihood():
    model = double_well(mean=0.0, variance=10.0, noise=0.01)
    y = [[1.3], [1.0]]
    grid = choose_grid(model, [0.0, 1.0], y, cells=300)
    assert grid.high - grid.low < 8.0
    result = fokker_planck(lfm.LatentForceModel(
        model.dynamics, {}, model.observation, model.initial_state, model.process_noise), [0.0, 1.0], y)
    exact = -0.5 * 1.3**2 / 10.01 - 0.5 * np.log(2 * np.pi * 10.01)
    assert abs(float(result.log_likelihood[0]) - exact) < 1e-4


@pytest.mark.slow
def test_a_warning_where_the_grid_is_too_coarse():
    with pytest.warns(UserWarning, match="1e-06.* 60 cells"):
        fokker_planck(WELL, WELL_TIMES, WELL_Y, cells=60, bounds=(-3.0, 3.0), tolerance=1e-6)


def simple(drift=linear, start=1.0, variance=0.1, process_noise=None, noise=0.1, forces=None):
    return lfm.LatentForceModel(drift, forces or {}, lfm.GaussianObservation(first_state, noise),
                                lfm.Gaussian([start], [variance]), process_noise=process_noise)


def test_bad_arguments_are_named():
    for options, name in (
            ({"cells": 0}, "cells"), ({"cells": 4}, "cells"), ({"bounds": (1.0, -1.0)}, "bounds"),
            ({"bounds": (0.0,)}, "bounds"), ({"bounds": (0.0, np.inf)}, "bounds"), ({"bounds": (5.0, 9.0)}, "bounds"),
            ({"tolerance": 0.0}, "tolerance"), ({"steps": 0}, "steps"), ({"at": [-1.0]}, r"at\[0\]"),
            ({"times": WELL_TIMES[::-1]}, "times"), ({"y": np.ones((3, 1))}, r"\(3, 1\)"),
            ({"y": np.full((6, 1), np.nan)}, "y")):
        with pytest.raises(ValueError, match=name):
            fokker_planck(WELL, **{"times": WELL_TIMES, "y": WELL_Y, **options})
    with pytest.raises(TypeError, match="model"):
        fokker_planck("model", WELL_TIMES, WELL_Y)
    with pytest.raises(TypeError, match="cells"):
        fokker_planck(WELL, WELL_TIMES, WELL_Y, cells=10.5)
    with pytest.raises(ValueError, match="model"):
        choose_grid([], WELL_TIMES, WELL_Y)
    with pytest.raises(ValueError, match="parameters"):
        jax.jit(lambda b: choose_grid(double_well(b=b), WELL_TIMES, WELL_Y).low)(1.0)


def test_models_without_a_density_are_named():
    for model, name in (
            (lfm.LatentForceModel(linear, {}, lfm.GaussianObservation(first_state, jnp.array([0.1])), lfm.Gaussian(
                jnp.zeros(2), jnp.eye(2)), process_noise=jnp.eye(2)), "x0, x1"),
            (simple(forces={"u": lfm.Matern(1.0, 1.0)}, noise=jnp.array([0.1])), "3"),
            (simple(noise=jnp.array([0.1])), "process_noise"),
            (simple(process_noise=jnp.zeros((1, 1)), noise=jnp.array([0.1])), "process_noise"),
            (simple(process_noise=lambda x, u, t: jnp.zeros((1, 1)), noise=jnp.array([0.1])), "noise"),
            (only(lfm.Constant(1.0)), "'u'"),
            (simple(process_noise=jnp.eye(1), noise=jnp.array([0.0])), "'y0'"),
            (simple(process_noise=jnp.eye(1), noise=lambda x, u, t: jnp.zeros(1)), "'y0'"),
            (simple(process_noise=lambda x, u, t: jnp.sqrt(x)[None], noise=jnp.array([0.1])), "bounds")):
        with pytest.raises(ValueError, match=name):
            fokker_planck(model, [0.0, 1.0], np.ones((2, 1)))


@pytest.mark.slow
def test_a_state_that_runs_away_has_no_bounds():
    model = simple(lambda x, u, t: x**3, start=0.0, variance=1.0, process_noise=jnp.eye(1), noise=jnp.array([1e4]))
    with pytest.raises(ValueError):
        fokker_planck(model, [0.0, 5.0], np.ones((2, 1)))
