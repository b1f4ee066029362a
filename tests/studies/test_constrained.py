"""Constrained study: records, the source's estimator, bands, and a quick run."""

import jax.numpy as jnp
import numpy as np
import pytest
from reference_map import quadratic_program
from scipy.linalg import expm
from scipy.optimize import minimize_scalar
from scipy.stats import truncnorm

import lfm_ppl as lfm
from lfm_ppl.studies.constrained import estimators, problem


@pytest.mark.parametrize("shape", problem.SHAPES)
def test_records_follow_their_equation(shape):
    record = problem.record(shape, 3, seed=1)
    assert record.y.shape == (1501, 1) and record.force.min() >= 0.0 and 0.3 < record.force.max() < 8.0
    np.testing.assert_array_equal(record.y, problem.record(shape, 3, seed=1).y)
    # x(t) = integral of 0.25 l(s) exp(-0.6 (t - s)) by the trapezoidal rule; the process noise adds 1e-3 at most.
    decayed = np.exp(0.6 * problem.TIMES) * record.force * 0.25
    integral = np.append(0.0, np.cumsum(0.5 * (decayed[1:] + decayed[:-1]) * 0.01)) * np.exp(-0.6 * problem.TIMES)
    residual = record.y[:, 0] - integral
    assert abs(residual.mean()) < 4 * 0.025 / np.sqrt(1501) + 2e-3
    assert residual.std() == pytest.approx(0.025, rel=0.08)


@pytest.mark.thorough
def test_the_shortest_band_of_a_truncated_normal():
    """Of one quantity without a record: N(0.5, 1) and N(2.5, 1) truncated at zero."""
    model = lfm.LatentForceModel(
        lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        lfm.GaussianObservation(lambda x, u, t: u, jnp.array([1.0])), lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))))
    for y in (-1.0, 6.0):
        posterior = lfm.constrained_posterior(model, np.zeros(1), np.array([[y]]), lower={"u": 0.0}, grid=np.zeros(1))
        low, high = (float(a[0]) for a in estimators.shortest_band(posterior, "u"))
        exact = truncnorm(-(y / 2) / np.sqrt(0.5), np.inf, loc=y / 2, scale=np.sqrt(0.5))
        shares = np.linspace(0.0, 0.0499, 500)
        widths = exact.ppf(shares + 0.95) - exact.ppf(shares)
        assert exact.cdf(high) - exact.cdf(low) == pytest.approx(0.95, abs=1e-3)
        assert high - low == pytest.approx(widths.min(), rel=5e-3)
        assert (low == 0.0) == (y < 0)
        # From 60 quantiles; the bound is an end where the density falls from there on.
        part_quantiles = estimators.quantiles(posterior, "u", 60)
        np.testing.assert_allclose(np.sort(part_quantiles[:, 0]), exact.ppf((np.arange(60) + 0.5) / 60), rtol=1e-6)
        bounds = [float(a[0]) for a in estimators.shortest_interval(part_quantiles, 0.0)]
        assert exact.cdf(bounds[1]) - exact.cdf(bounds[0]) == pytest.approx(0.95, abs=2e-3)
        assert (bounds[0] == 0.0) == (y < 0)
        assert bounds[1] - bounds[0] == pytest.approx(widths.min(), rel=0.02)


def matrices(rate, weight, step):
    """Transition and covariance of (x, l, l') over a step, by van Loan's matrix exponential."""
    drift = np.array([[-0.6, 0.25, 0.0], [0.0, 0.0, 1.0], [0.0, -(rate**2), -2.0 * rate]])
    noise = np.diag([1e-6, 0.0, 4.0 * weight**3]) / 2.0
    exponential = expm(step * np.block([[-drift, noise], [np.zeros((3, 3)), drift.T]]))
    return exponential[3:, 3:].T, exponential[3:, 3:].T @ exponential[:3, 3:]


def dense_cost(rate, frozen, weight, times, y):
    """The least cost at a rate by Clarabel on dense algebra, with the covariances of rate ``frozen``, and the force."""
    transition, _ = matrices(rate, weight, times[1])
    _, noise = matrices(frozen, weight, times[1])
    mean, blocks = np.zeros(3 * len(times)), [[50.0 * np.eye(3)]]
    for _ in times[1:]:
        new = [block @ transition.T for block in blocks[-1]]
        blocks.append([*new, transition @ new[-1] + noise])
    # blocks[k][j] = cov(s_j, s_k)
    covariance = np.block([[blocks[max(j, k)][min(j, k)] if j <= k else blocks[j][k].T for k in range(len(times))]
                           for j in range(len(times))])
    observe = np.kron(np.eye(len(times)), [[1.0, 0.0, 0.0]])
    total = observe @ covariance @ observe.T + 0.025**2 * np.eye(len(times))
    gain = np.linalg.solve(total, observe @ covariance).T
    free = 0.5 * y @ np.linalg.solve(total, y)
    force = np.kron(np.eye(len(times)), [[0.0, 1.0, 0.0]])
    path, _, excess = quadratic_program(mean + gain @ y, covariance - gain @ observe @ covariance, force,
                                        np.zeros(len(times)))
    return free + excess + 1e-2 * (rate - np.sqrt(3.0)) ** 2, force @ path


@pytest.mark.thorough
def test_the_rate_as_a_constant_state_against_a_search_on_the_dense_cost():
    """The printed cost with the rate among the states, and forces that cannot be negative."""
    times = np.linspace(0.0, 6.0, 25)
    y = problem.record("half sines", 1).y[:601:25]
    estimate = lfm.full_information(problem.companion(1.0, jnp.zeros(3), learnt=True), times, y, grid=times, steps=16,
                                    lower={"factor": 0.0, "rate": 0.0}, tolerance=1e-11)
    rate = float(estimate.state("rate").mean[0])
    assert estimate.converged and np.ptp(estimate.state("rate").mean) < 1e-9 and np.asarray(estimate.active)[:, 0].any()
    best = minimize_scalar(lambda candidate: dense_cost(candidate, rate, np.sqrt(3.0), times, y[:, 0])[0],
                           bounds=(1e-3, 3.0), method="bounded", options={"xatol": 1e-8})
    cost, force = dense_cost(best.x, rate, np.sqrt(3.0), times, y[:, 0])
    assert rate == pytest.approx(best.x, abs=2e-5) and float(estimate.objective) == pytest.approx(cost, abs=2e-6)
    np.testing.assert_allclose(estimate.state("factor").mean, force, atol=2e-5)


@pytest.mark.slow
def test_the_rate_of_the_first_window_is_where_the_dense_cost_is_least():
    times, y = problem.TIMES[:61], problem.record("half sines", 303).y
    rate = np.sqrt(3.0) / estimators.learn_rate_as_state("window", y[None])[0, 0]

    def cost(rate):
        return dense_cost(rate, rate, np.sqrt(3.0), times, y[:61, 0])[0]

    best = minimize_scalar(cost, bounds=(0.5 * rate, 2.0 * rate), method="bounded", options={"xatol": 1e-6})
    assert rate == pytest.approx(best.x, rel=0.02) and cost(rate) == pytest.approx(best.fun, abs=1e-4)
    costs = estimators._compile_costs("window")(np.log(np.sqrt(3.0) / np.array([rate])), y)
    assert float(costs[0]) == pytest.approx(cost(rate), abs=1e-5)
