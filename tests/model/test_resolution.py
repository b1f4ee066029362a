"""The warning that data can distinguish the SDE of a squared exponential force from the exact process."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.model.resolution import TOLERANCE, resolutions


def relaxing(x, u, t):
    return u - x


def first_force(x, u, t):
    return u[:1]


def model(force, sd, output=first_force, dynamics=relaxing):
    return lfm.LatentForceModel(
        dynamics, {"drive": force},
        lfm.GaussianObservation(output, jnp.reshape(jnp.asarray(sd) ** 2, (1,))),
        lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))))


def true_error(force, times, sd):
    """|mean| + 2 standard deviations of the error of the log likelihood, by dense algebra, for data of u itself."""
    exact, of_sde = force.covariances(times[:, None] - times)
    noise = sd**2 * np.eye(times.size)
    ratio = np.linalg.solve(np.linalg.cholesky(of_sde + noise), np.linalg.cholesky(exact + noise))
    values = np.linalg.eigvalsh(ratio.T @ ratio)
    return 0.5 * np.sum(values - 1 - np.log(values)) + 2.0 * np.sqrt(0.5 * np.sum((values - 1) ** 2))


@pytest.mark.thorough
@pytest.mark.parametrize("order", [6, pytest.param(2, marks=pytest.mark.slow)])
def test_estimate_is_the_true_error(order):
    rng = np.random.default_rng(0)
    for count in (30, 100, 300):
        for ell in (0.03, 0.1, 1.0, 3.0):
            for times in (np.linspace(0, 1, count), np.sort(rng.uniform(0, 1, count))):
                for sd in (0.001, 0.03, 1.0):
                    force = lfm.SquaredExponential(1.0, ell, order)
                    true = true_error(force, times, sd)
                    (result,) = resolutions(model(force, sd), times)
                    if true > 1.6 * TOLERANCE:
                        assert result.error > TOLERANCE
                    # Records shorter than a lengthscale, almost free of noise, may give a warning too early.
                    if true < TOLERANCE / 1.6 and (ell <= 1.0 or sd > 0.001):
                        assert result.error < TOLERANCE


@pytest.mark.thorough
def test_the_error_is_estimated_through_the_dynamics():
    # What a slow state shows of the force has less of its high frequencies, so that a low order does.
    times = np.linspace(0.0, 1.0, 100)
    force = lfm.SquaredExponential(1.0, 0.1, 4)
    (seen,), (driven,) = (resolutions(model(force, 0.1, output), times) for output in (first_force, lambda x, u, t: x))
    assert driven.error < 0.5 * seen.error
    assert driven.signal_to_noise < seen.signal_to_noise
    # The same data in another unit of the output, and in another unit of time.
    (scaled,) = resolutions(model(force, 0.2, lambda x, u, t: 2.0 * x), times)
    (slow,) = resolutions(model(lfm.SquaredExponential(1.0, 1.0, 4), 1.0, lambda x, u, t: x,
                                lambda x, u, t: u - 0.1 * x), 10.0 * times)
    np.testing.assert_allclose([scaled.error, slow.error], driven.error, rtol=1e-6)


@pytest.mark.thorough
def test_functions_warn_and_name_the_force():
    coarse, fine = (model(lfm.SquaredExponential(1.0, 0.2, order), 0.01) for order in (4, 8))
    times, y = np.linspace(0.0, 1.0, 50), np.zeros((50, 1))
    for run in (lambda m: lfm.filter(m, times, y), lambda m: lfm.smooth(m, times, y),
                lambda m: lfm.MarginalLikelihood(m, times).log_prob(np.zeros((len(times), 1)))):
        with pytest.warns(lfm.ApproximationWarning, match=r"'drive'.*lengthscale 0\.2.*order=8.*Matern"):
            run(coarse)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            run(fine)


@pytest.mark.thorough
def test_silent_inside_compiled_code_and_for_other_forces():
    times, y = np.linspace(0.0, 1.0, 50), np.zeros((50, 1))

    def log_likelihood(sd):
        return lfm.MarginalLikelihood(model(lfm.SquaredExponential(1.0, 0.2, 2), sd), times).log_prob(y)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(log_likelihood)(0.01)
        jax.jit(lambda: log_likelihood(0.01))()
        jax.grad(log_likelihood)(0.01)
    assert resolutions(model(lfm.Matern(1.0, 0.2), 0.01), times) == []


def test_terms_of_sums_and_odd_cases():
    times = np.linspace(0.0, 1.0, 50)
    kernel_sum = lfm.SquaredExponential(1.0, 0.2, 2) + lfm.Matern(1.0, 0.1, 0) + lfm.Constant(1.0)
    (result,) = resolutions(model(kernel_sum, 0.01), times)
    (alone,) = resolutions(model(lfm.SquaredExponential(1.0, 0.2, 2), 0.01), times)
    assert TOLERANCE < result.error < alone.error  # a rough force hides the difference
    assert resolutions(model(lfm.SquaredExponential(1.0, 0.2), 0.1), times[:1]) == []
    for scaled_times in (np.zeros(3), 1e6 * times, 1e-9 * times):
        (result,) = resolutions(model(lfm.SquaredExponential(1.0, 0.2), 0.1), scaled_times)
        assert result.error < TOLERANCE
    # Without noise nothing can be trusted, and a model that overflows is passed over.
    assert resolutions(model(lfm.SquaredExponential(1.0, 0.1), 1e-12), np.linspace(0, 1, 200))[0].error > TOLERANCE
    unstable = model(lfm.SquaredExponential(1.0, 1.0), 0.1, lambda x, u, t: x, lambda x, u, t: u + 1e5 * x)
    assert resolutions(unstable, times) == [] or resolutions(unstable, times)[0].error >= 0.0


def test_only_what_is_observed_counts():
    """A grid padded with missing values, for predictions, has the error of its observations."""
    times = np.linspace(0.0, 10.0, 401)
    y = np.full((401, 1), np.nan)
    y[::40] = 0.5
    system = model(lfm.SquaredExponential(1.0, 1.0, 4), 0.03)
    (padded,) = resolutions(system, times, y)
    (observed,) = resolutions(system, times[::40])
    assert padded.error == observed.error < resolutions(system, times)[0].error


@pytest.mark.thorough
def test_the_noise_of_most_rows_counts():
    """A covariance for each time, the first of which is tiny."""
    times = np.linspace(0.0, 10.0, 21)
    system = model(lfm.SquaredExponential(1.0, 1.0, 4), 0.1)
    varying = eqx.tree_at(lambda m: m.observation.covariance, system,
                          jnp.full((21, 1, 1), 0.01).at[0].set(1e-12))
    np.testing.assert_allclose(resolutions(varying, times)[0].error, resolutions(system, times)[0].error, rtol=1e-9)


def test_a_model_with_process_noise_is_passed_over():
    """Its own noise hides the difference, and is not in the estimate."""
    times = np.linspace(0.0, 1.0, 50)
    base = model(lfm.SquaredExponential(1.0, 0.2, 2), 0.01, lambda x, u, t: x)
    noisy = lfm.LatentForceModel(base.dynamics, base.forces, base.observation, base.initial_state,
                                 process_noise=0.3 * jnp.eye(1))
    assert resolutions(base, times) and resolutions(noisy, times) == []
