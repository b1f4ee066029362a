"""Call centre study: searches for modes, and posteriors of the parameters."""

import sys

import numpy as np
import pytest
from scipy import special, stats

import lfm_ppl as lfm
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.call_centre import experiment, learning, problem, tracking
from lfm_ppl.inference.optimise import End, Objective
from lfm_ppl.results import importance_at_modes


def window():
    return problem.build_window(None, "Thursday", 0)


NUTS_SETTINGS = experiment.CallCentreSettings(days=4, methods=("SQM",), functions=5, draws=2_000, mixed=5, nuts_days=4,
                                              nuts=(2, 300, 700))
"""Weighted draws and NUTS, on simulated days."""

NUTS_TASKS = [task for task in experiment.all_tasks(NUTS_SETTINGS) if task.settings["what"] == "nuts"]


NOISE = 4
"""Index of a parameter."""


def patch_posterior(monkeypatch, value_and_gradient):
    """Replace the posterior by a density with ``value_and_gradient(z, prior)``."""

    class Posterior:
        def objective(self, y, prior=1.0):
            return Objective(lambda z: value_and_gradient(np.asarray(z), prior))

    monkeypatch.setattr(problem, "posterior", lambda method: Posterior())


def with_two_modes(count):
    """Return method, training, weighted draws and modes of the first window; the second mode is one of small noises."""
    task = NUTS_TASKS[0]
    method, (call_window,) = tracking.build_arrival_model(task), tracking.build_windows(task)
    draws, weights, mass = learning.sample_posterior(method, call_window.training, count, NUTS_SETTINGS.seed)
    assert len(mass) == 2 and weights.reliable and method.names[NOISE] == "noise_sd"
    modes = learning.find_modes(method, call_window.training)
    return method, call_window.training, draws, np.exp(weights.log_weight[0]), modes


@pytest.mark.slow
def test_the_densities_are_those_of_the_model():
    """The prior against scipy's, the likelihood against that of the model built by hand."""
    method, call_window = problem.ArrivalModel("matern"), window()
    assert method.names == ("mean", "scale", "lengthscale", "noise_sd")
    z = np.log([6.5, 2.0, 100.0, 0.6])
    log_likelihood, log_prior = problem.posterior(method).log_densities(z, call_window.training)
    medians, spread = np.log([6.0, 2.0, 168.0, 0.5]), np.array([0.5, 0.7, 0.7, 0.7])
    assert log_prior == pytest.approx(stats.norm(medians, spread).logpdf(z).sum(), rel=1e-9)
    m = sys.modules[problem.model_file().model.__module__]
    system = m.build(6.5, 2.0, 0.6, 100.0, force="matern", service=problem.SERVICE_RATE)
    likelihood = lfm.MarginalLikelihood(system, problem.TRAINING_TIMES, steps=m.STEPS)
    assert log_likelihood == pytest.approx(float(likelihood.log_prob(call_window.training)), rel=1e-9)


@pytest.mark.slow
def test_the_gradient_is_that_of_finite_differences():
    method, call_window = problem.ArrivalModel("matern"), window()
    objective = problem.posterior(method).objective(call_window.training)
    z = np.log([6.5, 2.0, 150.0, 0.8])
    _, gradient = objective.value_and_gradient(z)
    steps = 1e-5 * np.eye(4)
    expected = [(objective.value(z + step) - objective.value(z - step)) / 2e-5 for step in steps]
    np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-5)
    (best, *_), _ = learning.run_searches(method, call_window.training)
    assert best.value < problem.posterior(method).objective(call_window.training, 0.0).value(z)


@pytest.mark.slow
def test_searches_from_several_starts_find_several_modes(monkeypatch):
    """Three wells, one of them far higher than the others."""
    method = problem.ArrivalModel("sqm")
    starts = np.log([[start[name] for name in method.names] for start in learning.STARTS])
    wells, depth, evaluated = starts + 0.05, np.array([3.0, -2.0, 30.0]), []

    def value_and_gradient(z, prior):
        k = np.argmin(((z - wells) ** 2).sum(axis=1))
        evaluated.append(k)
        return 20 * ((z - wells[k]) ** 2).sum() + depth[k] + prior, 40 * (z - wells[k])

    patch_posterior(monkeypatch, value_and_gradient)
    modes = learning.find_modes(method, np.zeros((63, 1)))
    np.testing.assert_allclose([mode.point for mode in modes], wells[[1, 0]], atol=1e-4)
    assert [-mode.value for mode in modes] == pytest.approx([1.0, -4.0])
    evaluated.clear()
    (best, *_), evaluations = learning.run_searches(method, np.zeros((63, 1)))
    np.testing.assert_array_equal(best.point, modes[0].point)
    assert -best.value == pytest.approx(2.0)
    assert set(evaluated) == {0, 1, 2} and evaluations == len(evaluated)
    depth[:], wells[:] = 0.0, wells[0]
    assert len(learning.find_modes(method, np.zeros((63, 1)))) == 1
    patch_posterior(monkeypatch, lambda z, prior: (np.inf, np.zeros(len(method.names))))
    with pytest.raises(ValueError, match="not finite at any start of the searches for sqm"):
        learning.run_searches(method, np.zeros((63, 1)))


def test_lower_modes_without_curvature_are_dropped(monkeypatch):
    """The second of three modes is a saddle, and the third has no finite gradient: neither remains."""
    method = problem.ArrivalModel("matern")
    points = [np.full(4, value) for value in (0.0, 3.0, 6.0)]

    def value_and_gradient(z, prior):
        k = int(np.argmin([np.abs(z - point).max() for point in points]))
        signs = np.array([1.0, 1.0, 1.0, -1.0 if k == 1 else 1.0]) * (np.nan if k == 2 else 1.0)
        return 0.5 * signs @ (z - points[k]) ** 2, signs * (z - points[k])

    patch_posterior(monkeypatch, value_and_gradient)
    for order, expected in (([0, 1, 2], [0]), ([1, 0, 2], [1, 0])):
        monkeypatch.setattr(learning, "run_searches", lambda *_, order=order, **__: (
            [End(points[k], 0.0) for k in order], 3))
        modes = learning.find_modes(method, np.zeros((63, 1)))
        np.testing.assert_array_equal([mode.point for mode in modes], [points[k] for k in expected])
    np.testing.assert_allclose(modes[1].curvature.factor @ modes[1].curvature.factor.T, np.eye(4), atol=1e-6)


@pytest.mark.slow
def test_weighted_draws_are_those_of_a_long_chain():
    """The posterior of one window against random-walk Metropolis with the same density."""
    method, call_window = problem.ArrivalModel("sqm", functions=5), window()
    draws, weights, _ = learning.sample_posterior(method, call_window.training, 1_000, 0)
    weight = np.exp(weights.log_weight[0])
    mean = weight @ draws
    sd = np.sqrt(weight @ (draws - mean) ** 2)

    def density(z):
        return np.sum(problem.posterior(method).log_densities_of(z, call_window.training), axis=0)

    factor = np.linalg.cholesky((draws - mean).T @ ((draws - mean) * weight[:, None]))
    generator = np.random.default_rng(0)
    positions = mean + generator.normal(size=(20, 5)) @ factor.T
    value, samples = density(positions), []
    for _ in range(600):
        proposed = positions + 2.4 / np.sqrt(5) * generator.normal(size=positions.shape) @ factor.T
        new = density(proposed)
        accept = np.log(generator.uniform(size=20)) < new - value
        positions, value = np.where(accept[:, None], proposed, positions), np.where(accept, new, value)
        samples.append(positions)
    chain = np.array(samples[100:])
    error = chain.mean(axis=0).std(axis=0) / np.sqrt(20) + sd / np.sqrt(float(np.ravel(weights.ess)[0]))
    np.testing.assert_array_less(np.abs(chain.mean(axis=(0, 1)) - mean), 4 * error)


@pytest.mark.slow
def test_nuts_and_weighted_draws_have_the_same_posterior():
    """Two samplers that share the density and the modes about which they start, on the fourth window, which has one."""
    task = NUTS_TASKS[3]
    method, (call_window,) = tracking.build_arrival_model(task), tracking.build_windows(task)
    draws, weights, mass = learning.sample_posterior(method, call_window.training, NUTS_SETTINGS.draws, 0)
    assert len(mass) == 1 and weights.reliable
    mean, covariance = importance_at_modes.moments(draws, np.exp(weights.log_weight[0]))
    result = tracking.track_by_nuts(task)
    assert result["divergences"] == 0 and result["r_hat"].max() < 1.02
    error = np.sqrt(1 / result["ess"] + 1 / weights.ess)
    assert error.max() < 0.1
    assert (np.abs(result["mean"] - mean) < 4 * error * result["sd"]).all()
    np.testing.assert_allclose(result["sd"], np.sqrt(np.diag(covariance)), rtol=4 * error.max())


@pytest.mark.slow
def test_weighted_draws_see_a_second_mode():
    """Its share of the posterior, against draws of one wide proposal over both modes."""
    method, y, draws, weight, (first, second) = with_two_modes(4_000)
    edge = 0.5 * (first.point + second.point)[NOISE]
    below = draws[:, NOISE] < edge
    share = weight[below].sum()
    error = np.sqrt((weight**2 * (below - share) ** 2).sum())

    scale = np.abs(first.point - second.point) / 2 + np.linalg.norm(first.curvature.factor, axis=1)
    wide = stats.multivariate_t(0.5 * (first.point + second.point), np.diag(scale**2), df=5)
    proposals = wide.rvs(60_000, random_state=1)
    log_ratio = np.sum(problem.posterior(method).log_densities_of(proposals, y), axis=0) - wide.logpdf(proposals)
    log_ratio = np.where(np.isfinite(log_ratio), log_ratio, -np.inf)
    plain, is_below = np.exp(log_ratio - special.logsumexp(log_ratio)), proposals[:, NOISE] < edge
    expected = plain[is_below].sum()
    apart = np.hypot(error, np.sqrt((plain**2 * (is_below - expected) ** 2).sum()))
    assert abs(share - expected) < 4 * apart and apart < share / 2


@pytest.mark.slow
def test_nuts_and_weighted_draws_agree_about_the_first_mode():
    """NUTS comes to the second one by chance, and then stays for a hundred draws: it cannot tell how much is there."""
    method, _, draws, weight, (first, second) = with_two_modes(4_000)
    edge = 0.5 * (first.point + second.point)[NOISE]
    above = draws[:, NOISE] > edge
    assert weight[above].sum() > 0.98
    shares = weight[above] / weight[above].sum()
    mean, covariance = importance_at_modes.moments(draws[above], shares)
    sd = np.sqrt(np.diag(covariance))
    result = tracking.track_by_nuts(NUTS_TASKS[0])
    elsewhere = result["draws"][NOISE] < edge
    assert elsewhere.mean() < 0.5
    chain = result["draws"][:, ~elsewhere]
    ess = scores.diagnose(method.names, chain[:, None])["ess"]
    error = np.sqrt(1 / ess + (shares**2).sum())
    assert error.max() < 0.1
    assert (np.abs(chain.mean(axis=1) - mean) < 4 * error * sd).all()
    np.testing.assert_allclose(chain.std(axis=1), sd, rtol=4 * error.max())
