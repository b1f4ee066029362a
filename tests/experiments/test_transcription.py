"""Transcription study: data, methods on small examples, tables and figures."""

import dataclasses

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy.integrate import solve_ivp

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.published import PublishedComparison
from lfm_ppl.experiments.study import TASKS
from lfm_ppl.experiments.transcription import experiment, figures, problem, slices
from lfm_ppl.latent_grid.laplace import laplace
from lfm_ppl.parallel.task import Task
from lfm_ppl.utils.run_store import RunStore

SATURATION, EXPONENTIAL = problem.CONFIGURATIONS[1], problem.CONFIGURATIONS[6]
FEW = experiment.TranscriptionSettings(datasets=12, draws=400, burn_in=40)


def test_the_configurations_are_those_of_the_source_and_softplus():
    assert [configuration.label for configuration in problem.CONFIGURATIONS] == [*problem.PUBLISHED, "softplus"]


def test_the_data_solve_the_equation():
    """Expression against an ODE solver on the same force; observations within their noise of it."""
    data = problem.data_set(SATURATION, 3)
    fine_u = np.interp(data.fine, problem.GRID, data.u)
    assert np.abs(fine_u[::6] - data.u).max() == 0.0

    def slope(t, x):
        active = 1 / (1 + 0.5 * np.exp(-np.interp(t, problem.GRID, data.u)))
        return data.rates.basal + data.rates.sensitivity * active - data.rates.decay * x

    solution = solve_ivp(slope, (0.0, problem.END), data.rates.start, t_eval=problem.TIMES, rtol=1e-8, max_step=0.05)
    indices = np.searchsorted(data.fine, problem.TIMES - 1e-9)
    assert np.allclose(data.fine[indices], problem.TIMES)
    # The force between the points of the grid is rougher than the line through them.
    assert np.allclose(solution.y.T, data.state[indices], atol=5e-3)
    noise = np.concatenate([(problem.data_set(SATURATION, index).y - problem.data_set(SATURATION, index).state[indices])
                            for index in range(20)]) / problem.NOISE
    assert abs(noise.mean()) < 4 / np.sqrt(noise.size) and abs(noise.std() - 1) < 4 / np.sqrt(2 * noise.size)


@pytest.mark.slow
def test_force_and_rates_are_shared_by_the_configurations_and_have_their_distribution():
    first, second = problem.data_set(SATURATION, 0), problem.data_set(EXPONENTIAL, 0)
    assert np.array_equal(first.u, second.u) and np.array_equal(first.rates.decay, second.rates.decay)
    u = np.stack([problem.data_set(SATURATION, index).u for index in range(150)])
    lag = 48
    expected = (1 + np.sqrt(3) * problem.GRID[lag] / 2) * np.exp(-np.sqrt(3) * problem.GRID[lag] / 2)
    # Averages over the grid of each draw are independent between draws.
    for values, mean in (((u**2).mean(axis=1), 1.0), ((u[:, lag:] * u[:, :-lag]).mean(axis=1), expected)):
        assert abs(values.mean() - mean) < 4 * values.std() / np.sqrt(len(values))


@pytest.mark.parametrize("method", [
    pytest.param(method, marks=() if method == "LA, trust region" else pytest.mark.slow)
    for method in experiment.METHODS])
def test_every_method_finds_the_force(method):
    settings = {"experiment": "transcription", "method": method, "link": "saturation", "gamma": 0.5, "first": 0,
                "last": 1}
    if method == "ESLS":
        settings |= {"draws": 4000, "burn_in": 400}
    result = experiment.compute(Task(f"saturation/{problem.slug(method)}", 0, settings))
    assert result["mean"].shape == result["sd"].shape == (2, problem.POINTS)
    assert (result["sd"] > 0).all() and (result["seconds"] > 0).all()
    if method == "LA":  # Newton's method is known to fail, and then to say so
        assert (result["diverged"] | result["stopped"]).all() and np.isfinite(result["rmse"]).all()
        return
    assert not result["diverged"].any() and (result["rmse"] < 0.9).all()
    if method == "ESLS":
        assert (result["draws"] >= 4000).all() and (result["low"] < result["mean"]).all()


def linear():
    """A data set whose activity is u itself, and its model on the grid."""
    data = problem.data_set(problem.Configuration("linear"), 1)
    return data, problem.on_grid("linear", None, data.rates)


@pytest.mark.slow
def test_the_gaussian_of_the_ellipses_is_the_posterior_of_a_linear_link():
    """Found from any draws; a draw of it is one of the posterior, and the ratio of likelihoods is flat."""
    data, latent = linear()
    exact = laplace(latent, data.y)
    draws = jax.vmap(latent.force)(jax.random.normal(jax.random.key(0), (50, 1, problem.POINTS)))[:, 0]
    gaussian = slices.linearize_posterior(latent, data.y, draws)
    assert np.allclose(gaussian.mean, exact.mode[0], atol=1e-7)
    ellipses = slices.ellipses(latent, data.y, gaussian)
    points = jax.vmap(ellipses.draw)(jax.random.split(jax.random.key(1), 4000))
    assert np.all(np.abs(np.asarray(points.force).std(axis=0) / exact.sd[0] - 1) < 5 / np.sqrt(2 * 4000))
    assert np.abs(points.force.mean(axis=0) - exact.mode[0]).max() < 4.5 * float(jnp.max(exact.sd)) / np.sqrt(4000)
    assert np.ptp(jax.vmap(ellipses.log_ratio)(points)) < 1e-6
    assert np.allclose(ellipses.point(points.force[0]).linear, points.linear[0])
    assert np.allclose(ellipses.mean.force, gaussian.mean)


@pytest.mark.slow
def test_unmixed_chains_continue_until_they_mix():
    """A data set on which ellipses of the prior hardly move."""
    data = [problem.data_set(EXPONENTIAL, 2)]
    settings = {"link": "exponential", "gamma": None, "draws": 30_000, "burn_in": 2_500}
    result = slices.compute(settings, data, jax.random.split(jax.random.key(0), 1))
    assert result["draws"][0] >= 60_000 and result["r_hat_first"][0] > 1.05
    assert result["r_hat"][0] <= 1.01 and result["ess"][0] > 400  # 100 for each chain, as ArviZ asks
    assert (result["seconds"] > 0).all() and (result["seconds_more"] > 0).all()


@pytest.mark.slow
def test_both_kinds_of_ellipses_have_the_same_posterior(monkeypatch):
    """On a non-linear link on which chains on ellipses of the prior mix."""
    data = [problem.data_set(SATURATION, 2)]
    settings = {"link": "saturation", "gamma": 0.5, "draws": 100_000, "burn_in": 5_000}
    first = slices.compute(settings, data, jax.random.split(jax.random.key(0), 1))
    monkeypatch.setattr(slices, "R_HAT", 0.0)
    monkeypatch.setattr(slices, "_STAGES", 2)
    second = slices.compute(settings, data, jax.random.split(jax.random.key(1), 1))
    assert first["r_hat"][0] <= 1.01 and first["draws"][0] == 100_000 and second["draws"][0] == 200_000
    error = 4.5 * first["sd"][0] * np.sqrt(1 / first["ess"][0] + 1 / second["ess"][0])
    assert np.all(np.abs(first["mean"][0] - second["mean"][0]) < error)
    assert np.all(np.abs(first["sd"][0] - second["sd"][0]) < error)


@pytest.mark.slow
def test_slices_of_a_linear_link_have_the_exact_posterior():
    """The experiment's own sampler on u itself as activity, against dense algebra on the grid."""
    data, latent = linear()
    result = slices.compute({"link": "linear", "gamma": None, "draws": 40_000, "burn_in": 2_000}, [data],
                            jax.random.split(jax.random.key(1), 1))
    exact = laplace(latent, data.y)
    error = 4.5 * np.asarray(exact.sd[0]) / np.sqrt(result["ess"][0])
    assert result["ess"][0] > 200
    assert np.all(np.abs(result["mean"][0] - exact.mode[0]) < error)
    assert np.all(np.abs(result["sd"][0] - exact.sd[0]) < error)


@pytest.mark.slow
@pytest.mark.parametrize("configuration, index", [(problem.CONFIGURATIONS[number], index) for number, index in
                                                  ((0, 3), (1, 0), (4, 1), (5, 4), (7, 2))])
def test_the_slices_agree_with_blackjax(configuration, index):
    """Five data sets, three links: means and standard deviations at some points, in standard errors of both."""
    blackjax = pytest.importorskip("blackjax")
    data = problem.data_set(configuration, index)
    result = slices.compute({"link": configuration.link, "gamma": configuration.gamma, "draws": 100_000,
                             "burn_in": 5_000}, [data], jax.random.split(jax.random.key(0), 1))
    latent = problem.on_grid(configuration.link, configuration.gamma or 1.0, data.rates)
    algorithm = blackjax.elliptical_slice(lambda u: latent.log_likelihood(u[None], jnp.asarray(data.y)),
                                          mean=jnp.zeros(problem.POINTS), cov=latent.root[0] @ latent.root[0].T)
    indices = slices.MONITORED

    def chain(key):
        def step(state, key):
            state, _ = algorithm.step(key, state)
            return state, state.position[indices]

        def record(state, key):
            state, _ = jax.lax.scan(step, state, jax.random.split(key, 40))
            return state, state.position[indices]

        start_key, step_key = jax.random.split(key)
        state = algorithm.init(latent.root[0] @ jax.random.normal(start_key, (problem.POINTS,)))
        return jax.lax.scan(record, state, jax.random.split(step_key, 2500))[1][250:]

    draws = np.asarray(jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(1), 4)))
    ess = {name: np.array([float(az.ess(draws[..., point], method=name)) for point in range(len(indices))])
           for name in ("mean", "sd")}
    assert result["r_hat"][0] <= 1.01 and min(ess["mean"].min(), ess["sd"].min()) > 150
    flat = draws.reshape(-1, len(indices))
    for name, values in (("mean", flat.mean(axis=0)), ("sd", flat.std(axis=0))):
        error = flat.std(axis=0) * np.sqrt(1 / ess[name] + 1 / result["ess"][0])
        difference = values - result[name][0][indices]
        assert np.all(np.abs(difference) < 4 * error), (name, difference, error)


def synthetic_results(settings):
    """Results of every task: errors of 0.3, and of 0.6 for GFS; the second data set of LA has diverged."""
    results = {}
    for task in experiment.all_tasks(settings):
        count = task.settings["last"] - task.settings["first"] + 1
        truth = np.stack([problem.data_set(SATURATION, index).u for index in range(count)])
        shift = 0.6 if task.settings["method"] == "GFS" else 0.3
        result = {"mean": truth + shift, "sd": np.full(truth.shape, 0.25), "seconds": np.full(count, 2.0)}
        if task.settings["method"] == "LA":
            result["stopped"] = np.arange(count) != 1
        if "LA" in task.settings["method"]:
            result["converged"] = np.arange(count) != 1
        if "iterated" in task.settings["method"]:
            result["change"] = np.full(count, 1e-3)
        if task.settings["method"] == "ESLS":
            result |= {"r_hat": np.full(count, 1.005), "r_hat_first": np.full(count, 1.02), "ess": np.full(count, 50.0),
                       "seconds": np.full(count, 400.0), "seconds_more": np.full(count, 50.0)}
        results[task.name] = result | experiment.score_force(result, truth)
    return results


def synthetic_data(settings):
    return experiment.STUDY.collect(settings, synthetic_results(settings))


def test_tables_count_outcomes():
    tables = {name: table.frame for name, table in experiment.tables(FEW, synthetic_data(FEW)).items()}
    table = tables["comparison"]
    assert table.loc["exponential: LA", "divergences"] == 2  # one in each of two blocks
    assert table.loc["exponential: LA", "RMSE"] == pytest.approx(0.3)
    assert table.loc["softplus: ESLS", "mixed"] == 1.0 and table.loc["softplus: ESLS", "mixed at first"] == 0.0
    assert table.loc["softplus: ESLS", "all CPU s"] == 450.0
    assert table.loc["softplus: GFS", "coverage"] == 0.0 and table.loc["softplus: GHS(7)", "coverage"] == 1.0
    nlpd = 0.5 * (0.3 / 0.25) ** 2 + np.log(0.25) + 0.5 * np.log(2 * np.pi)
    assert table.loc["softplus: GHS(7)", "NLPD"] == pytest.approx(nlpd)
    assert table.loc["softplus: iterated GHS(7)", "last change"] == 1e-3
    assert table.loc["exponential: LA", "at a mode"] == pytest.approx(10 / 12)
    published = tables["published"]
    assert published.loc["exponential", "no mode"] == 2
    assert published.loc["exponential", "LA div. published"] == 55 and len(published) == 7
    paired = tables["paired"]
    assert paired.loc["softplus: GFS", "RMSE ratio"] == pytest.approx(2.0)
    assert paired.loc["softplus: GFS", "times as fast"] == 200.0
    assert not any(name.endswith("ESLS") for name in paired.index)


@pytest.mark.parametrize("z, text, consistent", [
    (-4.2, "consistent", True), (0.0, "consistent", True), (4.2, "consistent", True),
    (-4.3, "lower than published (z = -4.3)", True), (-31.0, "lower than published (z = -31.0)", True),
    (4.3, "higher than published (z = 4.3)", False), (np.nan, "-", False)])
def test_a_verdict_is_two_sided_and_lower_is_consistent(z, text, consistent):
    comparison = PublishedComparison(z)
    assert str(comparison) == text and comparison.is_consistent is consistent
    assert comparison.is_lower == text.startswith("lower") and comparison.is_higher == text.startswith("higher")


def test_each_published_cell_has_its_verdict():
    """Errors of a known mean and standard error: one cell of each verdict, one without a standard error."""
    published = problem.PUBLISHED["exponential"]

    def errors(z, count=100):
        spread = np.where(np.arange(count) % 2, 1.0, -1.0)  # of standard error 0.01, once it is scaled
        return 0.01 * (spread * np.sqrt(count - 1) + z)

    def dataset(rmse):
        return xr.Dataset({"rmse": (("method", "dataset"), np.array(list(rmse.values()))),
                           "diverged": (("method", "dataset"), np.zeros((3, len(rmse["LA"])), bool)),
                           "converged": (("method", "dataset"), np.ones((3, len(rmse["LA"]))))}, {"method": list(rmse)})

    data = {"repression 1": dataset({"LA": [np.nan], "ESLS": [0.4], "GFS": [np.nan]}),
            "exponential": dataset({method: published[method][0] + errors(z)
                                    for method, z in (("LA", 5.0), ("ESLS", -6.0), ("GFS", -2.0))})}
    table = pd.DataFrame.from_dict(experiment.published_rows(data), orient="index")
    assert table.loc["exponential", [f"{method} z" for method in published]].tolist() == pytest.approx([5, -6, -2])
    assert table.loc["exponential", [f"{method} verdict" for method in published]].tolist() == [
        "higher than published (z = 5.0)", "lower than published (z = -6.0)", "consistent"]
    assert table.loc["repression 1", "ESLS verdict"] == "-"
    assert scores.readable(table).loc["exponential", "ESLS verdict"] == "lower than published (z = -6.0)"
    assert experiment.notes(FEW, data)[0] == (
        "2 of 3 cells count as consistent with the published table, 1 of them lower than published; 1 higher.")


@pytest.mark.slow
def test_a_killed_run_ends_with_the_same_table(tmp_path, monkeypatch):
    """The experiment itself, stopped after three tasks and started again: the same tables but for the times."""
    monkeypatch.setattr(experiment, "METHODS", ("LA", "ESLS", "GFS"))
    settings = experiment.TranscriptionSettings(datasets=2, draws=400, burn_in=40,
                                                configurations=(SATURATION.label, EXPONENTIAL.label))
    uninterrupted = experiment.STUDY.run(settings, tmp_path / "whole")
    compute, done = experiment.compute, []

    def killed(task):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(task.name)
        return compute(task)

    with pytest.raises(KeyboardInterrupt):
        kinds = {label: kind._replace(compute=killed) for label, kind in experiment.STUDY.kinds.items()}
        dataclasses.replace(experiment.STUDY, kinds=kinds).run(settings, tmp_path / "half")
    resumed = experiment.STUDY.run(settings, tmp_path / "half")
    for name in ("comparison", "published"):
        first, second = uninterrupted.tables[name], resumed.tables[name]
        timeless = [name for name in first if "CPU" not in name]
        pd.testing.assert_frame_equal(first[timeless], second[timeless], check_exact=True)


def test_infinite_errors_count_as_divergence():
    mean = np.zeros((3, problem.POINTS))
    mean[0, 5], mean[1] = np.nan, 4.0
    result = experiment.score_force({"mean": mean, "sd": np.ones(mean.shape)}, np.zeros(mean.shape))
    assert result["diverged"].tolist() == [True, True, False] and result["rmse"][0] == np.inf


@pytest.mark.slow
def test_stored_results_are_tabulated_without_computing(tmp_path):
    results = synthetic_results(FEW)
    for task in experiment.all_tasks(FEW):
        RunStore(tmp_path / TASKS).put(task.stem, results[task.name], task.record())
    study_result = experiment.STUDY.run(FEW, tmp_path)
    written = experiment.STUDY.save(study_result, tmp_path)
    assert {path.name for path in written} == {
        "comparison.csv", "comparison.md", "published.csv", "published.md", "paired.csv", "paired.md", "errors.png",
        "force-repression-0.1.png", "force-exponential.png"}
    first = (tmp_path / "comparison.csv").read_text()
    experiment.STUDY.save(experiment.STUDY.run(FEW, tmp_path), tmp_path)
    assert (tmp_path / "comparison.csv").read_text() == first
    with pytest.raises(ValueError, match="draws is 400 there and 800 now"):
        experiment.STUDY.run(dataclasses.replace(FEW, draws=800), tmp_path)


def test_notes_count_consistent_cells(tmp_path):
    settings = experiment.TranscriptionSettings(datasets=2, configurations=(EXPONENTIAL.label,))
    results = synthetic_results(settings)
    for task in experiment.all_tasks(settings):
        results[task.name]["rmse"] = results[task.name]["rmse"] + [0.0, 1e-3]
        RunStore(tmp_path / TASKS).put(task.stem, results[task.name], task.record())
    study_result = experiment.STUDY.run(settings, tmp_path)
    experiment.STUDY.save(study_result, tmp_path)
    assert study_result.notes == (  # LA has one sound data set alone, ESLS 0.3005 (0.0005) for 0.290, GFS 0.6 for 0.358
        "0 of 2 cells count as consistent with the published table, 0 of them lower than published; 2 higher.",
        experiment.TRUST)
    assert "higher than published" in (tmp_path / "published.md").read_text()


def test_the_figures_are_labelled():
    for figure in figures.draw(FEW, synthetic_data(FEW)).values():
        assert figure.get_figwidth() == 7.0 and figure.legends
        for axes in figure.axes:
            assert not axes.axison or (axes.get_xlabel() and axes.get_ylabel())


def test_blocks_of_more_data_sets_hold_those_of_fewer():
    few = {task.name: task.record() for task in experiment.all_tasks(experiment.TranscriptionSettings(datasets=20))}
    many = {task.name: task.record() for task in experiment.all_tasks(experiment.TranscriptionSettings(datasets=40))}
    assert few.items() <= many.items() and len(few) == 2 * 8 * len(experiment.METHODS)


def test_invalid_settings():
    with pytest.raises(ValueError, match="burn_in must lie in"):
        experiment.TranscriptionSettings(draws=100, burn_in=200)
    with pytest.raises(ValueError, match="gamma, the saturation constant, must be positive"):
        problem.data_set(problem.Configuration("saturation", -0.1), 0)
    with pytest.raises(ValueError, match="link must be one of .*, got 'cubic'"):
        problem.data_set(problem.Configuration("cubic", 1.0), 0)
