"""The warning that data can distinguish the functions of a periodic force from the full kernel, by dense algebra."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_triangular
from scipy.special import ive

import lfm_ppl as lfm
from lfm_ppl import forces
from lfm_ppl.model.linear_response import TOLERANCE
from lfm_ppl.model.truncation import truncations

WEEKLY = np.arange(0.0, 20.0, 7 / 365.25)
YEARLY = forces.PeriodicSquaredExponential(3.0, 1.0, 1.0)


def model(season, sd, trend=None):
    """A season and a trend that are observed themselves."""
    return lfm.LatentForceModel(
        lambda x, u, t: -x, {"season": season, **({} if trend is None else {"trend": trend})},
        lfm.GaussianObservation(lambda x, u, t: jnp.sum(u)[None], jnp.reshape(jnp.asarray(sd) ** 2, (1,))),
        lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))))


def matern32(lag, scale, lengthscale):
    ratio = np.sqrt(3.0) * np.abs(lag) / lengthscale
    return scale**2 * (1.0 + ratio) * np.exp(-ratio)


def covariances(times, functions, evolution, sd, trend=0.0):
    """Return the covariances of the data under the whole kernel and under its first functions.

    exp(-sin(x/2)^2 / l^2) = exp(-a) exp(a cos x) with a = 1 / (2 l^2), whose Fourier coefficients are Bessel functions.
    """
    lag = times[:, None] - times
    order = np.arange(functions // 2 + 1)
    coefficients = 9.0 * ive(order, 0.5) * np.where(order, 2.0, 1.0)
    truncated = sum(c * np.cos(2 * np.pi * j * lag) for j, c in zip(order, coefficients, strict=True))
    remainder = trend + sd**2 * np.eye(times.size)
    return 9.0 * np.exp(-np.sin(np.pi * lag) ** 2) * evolution(lag) + remainder, truncated * evolution(lag) + remainder


def error(exact, truncated):
    """|mean| + 2 standard deviations of the error of the log likelihood."""
    root = np.linalg.cholesky(truncated)
    half = solve_triangular(root, np.linalg.cholesky(exact), lower=True)
    values = np.linalg.eigvalsh(half @ half.T)
    return 0.5 * np.sum(values - 1 - np.log(values)) + 2.0 * np.sqrt(0.5 * np.sum((values - 1) ** 2))


EVOLUTIONS = {
    "constant": (lfm.Constant(1.0), lambda lag: np.ones_like(lag)),
    "slow": (lfm.Matern(1.0, 40.0, 1), lambda lag: matern32(lag, 1.0, 40.0)),
    "fast": (lfm.Matern(1.0, 1.5, 1), lambda lag: matern32(lag, 1.0, 1.5)),
    "rough": (forces.CQM(10.0), lambda lag: np.exp(-np.abs(lag) / 10.0)),
}
IRREGULAR = np.sort(np.random.default_rng(0).uniform(0.0, 100.0, 700))


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["rough", pytest.param("slow", marks=pytest.mark.slow)])
def test_the_estimate_is_the_error_of_dense_algebra(name):
    evolution, kernel = EVOLUTIONS[name]
    for times in (WEEKLY[:300], WEEKLY, IRREGULAR) if name != "rough" else (WEEKLY[:300], IRREGULAR[:300]):
        for functions, sd in ((5, 1.0), (7, 0.2), (9, 0.2)):
            (result,) = truncations(model(lfm.QuasiPeriodic(YEARLY, evolution, functions), sd), times)
            dense = error(*covariances(times, functions, kernel, sd))
            if times.size <= 300 and max(dense, result.error) > TOLERANCE:
                np.testing.assert_allclose(result.error, dense, rtol=1e-5)  # every row is looked at
            assert dense < 1.7 * TOLERANCE or dense / 1.7 < result.error < 1.7 * dense
            assert dense > TOLERANCE / 1.7 or result.error < TOLERANCE
            if result.error > TOLERANCE:  # as many as are recommended do, and fewer would not
                assert error(*covariances(times, result.functions, kernel, sd)) < 1.7 * TOLERANCE
                assert error(*covariances(times, result.functions - 2, kernel, sd)) > TOLERANCE / 1.7


@pytest.mark.thorough
def test_the_loss_of_a_trend_and_a_season():
    """Weekly CO2: 99.97% of the variance is kept, and nats of the log likelihood of data of the kernel are lost."""
    evolution, trend = lfm.Matern(1.0, 40.0, 1), lfm.Matern(20.0, 30.0, 1)
    season = lfm.QuasiPeriodic(YEARLY, evolution, 7)
    assert float(season.eigenvalues().sum()) > 0.9997 * 9.0
    lag = WEEKLY[:, None] - WEEKLY
    roots = [np.linalg.cholesky(covariance) for covariance in covariances(
        WEEKLY, 7, lambda lag: matern32(lag, 1.0, 40.0), 0.3, matern32(lag, 20.0, 30.0))]
    y = roots[0] @ np.random.default_rng(0).standard_normal((WEEKLY.size, 100))
    exact, truncated = (-0.5 * (solve_triangular(root, y, lower=True) ** 2).sum(0) - np.log(root.diagonal()).sum()
                        - 0.5 * WEEKLY.size * np.log(2 * np.pi) for root in roots)
    (result,) = truncations(model(season, 0.3, trend), WEEKLY)
    lost = exact - truncated
    assert lost.mean() > 1.0
    assert (np.abs(lost) < result.error).mean() >= 0.93 and np.abs(lost).max() > 0.5 * result.error
    with pytest.warns(lfm.ApproximationWarning, match=r"the 7 functions .*'season'.*Use functions=(11|13), or expl"):
        of_filter = lfm.MarginalLikelihood(model(season, 0.3, trend), WEEKLY).log_prob(y[:, 0, None])
    np.testing.assert_allclose(of_filter, truncated[0], atol=1e-3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        enough = lfm.QuasiPeriodic(YEARLY, evolution, result.functions)
        of_filter = lfm.MarginalLikelihood(model(enough, 0.3, trend), WEEKLY).log_prob(y[:, 0, None])
    np.testing.assert_allclose(of_filter, exact[0], atol=TOLERANCE)


@pytest.mark.thorough
def test_the_error_is_estimated_through_the_dynamics():
    """dx/dt = 6 (u - x), by the trapezoidal rule."""
    cycles, rows, functions, sd, accuracy = 8, 24, 7, 0.01, 0.1
    step = 1 / 48
    fine = step * np.arange(48 * cycles)
    stride = 48 // rows
    times = fine[::stride]
    weights = np.where(fine <= times[:, None], 6.0 * step * np.exp(-6.0 * np.maximum(times[:, None] - fine, 0.0)), 0.0)
    weights[np.arange(times.size), stride * np.arange(times.size)] *= 0.5
    weights[:, 0] *= 0.5
    weights[0] = 0.0
    exact, truncated = (weights @ kernel @ weights.T + sd**2 * np.eye(times.size) for kernel in covariances(
        fine, functions, lambda lag: matern32(lag, 1.0, 10.0), 0.0))
    filtered = lfm.LatentForceModel(
        lambda x, u, t: 6.0 * (u - x), {"season": lfm.QuasiPeriodic(YEARLY, lfm.Matern(1.0, 10.0, 1), functions)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([sd**2])),
        lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))))
    (result,) = truncations(filtered, times)
    np.testing.assert_allclose(result.error, error(exact, truncated), rtol=accuracy)


@pytest.mark.thorough
def test_kernels_without_a_spectrum_and_weights_that_jump():
    times = np.arange(0.0, 12.0, 1 / 30)
    kernel = forces.ModeratedPeriodicMatern(1.0, 1.0, 1.0, 0.5, 2)
    for evolution in (lfm.Constant(1.0), forces.SQM(3.0, tuple(range(1, 12)))):
        season = lfm.QuasiPeriodic(kernel, evolution, 9)
        lag = (times[:, None], times[None, :])
        weights = np.asarray(evolution.covariance(*lag)) * np.ones((times.size, times.size))
        noise = 0.1**2 * np.eye(times.size)
        dense = error(np.asarray(kernel(*lag)) * weights + noise,
                      np.asarray(season.basis.covariance(*lag)) * weights + noise)
        (result,) = truncations(model(season, 0.1), times)
        np.testing.assert_allclose(result.error, dense, rtol=1e-4)
        assert 9 < result.functions < 40


@pytest.mark.thorough
def test_silent_where_nothing_is_wrong_or_nothing_can_be_told():
    few = lfm.Periodic(YEARLY, 7)
    with pytest.warns(lfm.ApproximationWarning, match="7 functions"):
        lfm.filter(model(few, 0.01), WEEKLY[:80], np.zeros((80, 1)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(lambda sd: lfm.filter(model(few, sd), WEEKLY[:80], np.zeros((80, 1))).log_likelihood)(0.01)
        lfm.filter(model(few, 3.0), WEEKLY[:80], np.zeros((80, 1)))
        meant = lfm.Periodic(YEARLY, 7, explained_variance=0.0)
        lfm.filter(model(meant, 0.01), WEEKLY[:80], np.zeros((80, 1)))
    assert truncations(model(meant, 0.01), WEEKLY) == truncations(model(lfm.Matern(1.0, 1.0), 0.01), WEEKLY) == []
    # In sums, too; and only what is observed counts.
    y = np.full((WEEKLY.size, 1), np.nan)
    y[:40] = 0.0
    (part,) = truncations(model(few + lfm.Matern(20.0, 10.0), 0.1), WEEKLY, y)
    (without_data,) = truncations(model(few + lfm.Matern(20.0, 10.0), 0.1), WEEKLY)
    assert part.error < 0.5 * without_data.error
