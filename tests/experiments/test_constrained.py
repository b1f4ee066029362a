"""Forces that cannot be negative: the records, the source's estimator, bands, and a little of every part."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import truncnorm

import lfm_ppl as lfm
from lfm_ppl.engine.store import write
from lfm_ppl.experiments import catalogue
from lfm_ppl.experiments.constrained import estimators, experiment, figures, problem, report, tables


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


def test_the_window_has_the_printed_cost():
    """Covariances of which `lfm.full_information` makes half of the cost in equations 10g and 10h of the source."""
    model = problem.companion(0.8, jnp.array([0.1, 0.5, -0.2]))
    np.testing.assert_allclose(model.initial_state.covariance, np.linalg.inv(2 * 1e-2 * np.eye(3)))
    noise = np.asarray(model.process_noise) @ np.asarray(model.process_noise).T
    np.testing.assert_allclose(2.0 * noise[:2, :2], np.diag([1e-6, 0.0]))
    # Without the factor 2 the force is a Matern process of scale 1: Lyapunov's equation for its stationary covariance.
    columns = [model.dynamics(jnp.array(unit), jnp.zeros(0), 0.0)[1:] for unit in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0])]
    feedback, stationary = np.stack(columns, axis=1), np.diag([1.0, 3.0 / 0.8**2])
    np.testing.assert_allclose(feedback @ stationary + stationary @ feedback.T, -2.0 * noise[1:, 1:], atol=1e-12)


def test_the_shortest_band_of_a_truncated_normal():
    """Of one quantity without a record: N(0.5, 1) and N(2.5, 1) truncated at zero."""
    model = lfm.LatentForceModel(
        lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        lfm.GaussianObservation(lambda x, u, t: u, jnp.array([1.0])), lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))))
    for y in (-1.0, 6.0):
        found = lfm.constrained_posterior(model, np.zeros(1), np.array([[y]]), lower={"u": 0.0}, grid=np.zeros(1))
        low, high = (float(a[0]) for a in estimators.shortest(found, "u"))
        exact = truncnorm(-(y / 2) / np.sqrt(0.5), np.inf, loc=y / 2, scale=np.sqrt(0.5))
        shares = np.linspace(0.0, 0.0499, 500)
        widths = exact.ppf(shares + 0.95) - exact.ppf(shares)
        assert exact.cdf(high) - exact.cdf(low) == pytest.approx(0.95, abs=1e-3)
        assert high - low == pytest.approx(widths.min(), rel=5e-3)
        assert (low == 0.0) == (y < 0)
        # From 60 quantiles, the 57 nearest of which are 56 parts.
        parts = estimators.quantiles(found, "u", 60)
        np.testing.assert_allclose(np.sort(parts[:, 0]), exact.ppf((np.arange(60) + 0.5) / 60), rtol=1e-6)
        ends = [float(a[0]) for a in estimators.shortest_of(parts)]
        assert exact.cdf(ends[1]) - exact.cdf(ends[0]) == pytest.approx(56 / 60, abs=1e-6)


def test_the_shortest_interval_of_a_mixture():
    """Of two uniform distributions side by side, nine tenths in the narrow one: 95% reach into the wide one."""
    values = jnp.concatenate([jnp.tile((jnp.arange(40) + 0.5) / 40, 9), 1.0 + 10.0 * (jnp.arange(40) + 0.5) / 40])
    low, high = estimators.shortest_of(jnp.stack([values, -values], axis=1))
    np.testing.assert_allclose([low[0], high[0]], [0.0, 6.0], atol=0.3)
    np.testing.assert_allclose([low[1], high[1]], [-high[0], -low[0]], rtol=1e-12)


def test_times_of_peaks():
    times = np.linspace(0.0, 24.0, 241)
    path = 1.0 + 0.5 * np.cos(2 * np.pi * (times - 23.5) / 24.0)
    assert experiment.acrophase(times, path[None])[0] == pytest.approx(23.5)
    assert experiment.peak(times, path[None])[0] == pytest.approx(23.5)
    assert experiment._apart(np.array([23.5]), np.array([0.5]))[0] == pytest.approx(1.0)


def stored(folder, settings):
    """Store invented results of every task."""
    random = np.random.default_rng(0)
    for task in experiment.all_tasks(settings):
        count, what = task.settings["count"], task.settings["what"]
        if what == "transcription":
            path = np.abs(random.normal(size=(3, len(problem.TIMES))))
            found = {"truth": path[0]}
            for method in estimators.METHODS:
                found |= {f"{method}/mse": random.uniform(1e-3, 1e-2, count), f"{method}/minimum": np.zeros(count),
                          f"{method}/coverage": np.full(count, 0.95), f"{method}/failed": np.zeros(count, bool),
                          f"{method}/first": np.sort(path, axis=0)[[1, 0, 2], ::estimators.ROWS[method]]}
        elif what == "ballistic":
            paths = random.normal(size=(3, len(problem.TARGET_TIMES)))
            found = {"rmse": random.uniform(size=(count, 3)), "converged": np.ones(count, bool), "estimate": paths,
                     "truth": paths}
        else:
            times, hours = np.linspace(0.0, 24.0, 51), np.arange(25.0)
            paths = np.abs(random.normal(size=(count, 51)))
            found = {"times": times, "truth": paths, "mode": paths, "low": 0.5 * paths, "high": 2 * paths,
                     "coverage": np.ones(count), "peak": random.uniform(0.0, 2.0, (count, 2)), "rmse": np.ones(count),
                     "converged": np.ones(count, bool), "bands_converged": np.ones(count, bool),
                     "y": random.normal(size=(25, 3)), "measured": hours}
        write(task, found, Path(folder) / experiment.TASKS, overwrite=False)


def test_tables_and_figures_from_stored_results(tmp_path):
    settings = experiment.Settings(runs=3, patients=4, targets=3, block=2)
    stored(tmp_path, settings)
    found = experiment.run(settings, tmp_path)
    assert found.transcription.loc["delayed MHE, 60 samples", "published"] == 0.0103
    mse = tables.gathered(found.results, "transcription", "EP/mse")
    assert mse.shape == (12,) and found.transcription.loc["EP", "median MSE"] == np.median(mse)
    assert set(figures.draw(settings, found.results)) == {"forces", "errors", "target", "patient", "peaks"}
    written = experiment.save(found, tmp_path)
    assert all(path.stat().st_size > 0 for path in written) and len(written) == 2 * 3 + 5


def test_settings_say_what_is_wrong():
    with pytest.raises(ValueError, match="shapes"):
        experiment.Settings(shapes=("sine",))
    with pytest.raises(ValueError, match="Did you mean 'EP'"):
        experiment.Settings(methods=("EPP",))
    with pytest.raises(ValueError, match="10000 records"):
        experiment.Settings(runs=10_001)
    assert catalogue.experiment("constrained").run is report.run


@pytest.mark.slow
def test_a_window_starts_from_the_earlier_estimate():
    """Rows of the source's estimator are those of windows solved one by one, from the printed arrival means."""
    y = problem.record("half sines", 0).y
    path = np.asarray(estimators.horizon(jnp.array([1.0]), y))
    inside = problem.TIMES[:61]
    for begin in (0, 1, 31, 700, 1440):
        mean = path[begin] if begin else np.zeros(3)
        alone = lfm.full_information(problem.companion(1.0, mean), inside, y[begin: begin + 61],
                                     lower={"factor": 0.0}, grid=inside).state_mean
        np.testing.assert_allclose(path[begin + 30], alone[30], atol=1e-4)
    assert path[:, 1].min() >= 0.0


@pytest.mark.slow
def test_a_little_of_everything(tmp_path):
    """The bounds of the experiment, on few records; the estimates are feasible to the last bit."""
    wanted = catalogue.Wanted(tmp_path, quick=True)
    assert len(report.run(wanted).written) == 11
    found = experiment.run(experiment.quick(), tmp_path)
    assert found.transcription.loc[["full information", "EP"], "least"].min() >= 0.0
    assert found.transcription.loc["full information", "largest MSE"] < 0.0103
    assert found.transcription["failed"].sum() == 0
