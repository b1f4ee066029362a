"""The experiment of the transcription factors: its data, its methods on a few of them, its tables and figures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

from lfm_ppl.experiments.tasks import Task, write
from lfm_ppl.experiments.transcription import experiment, figures, problem, slices, tables

SATURATION, EXPONENTIAL = problem.CONFIGURATIONS[1], problem.CONFIGURATIONS[6]
FEW = experiment.Settings(datasets=12, draws=400, burn_in=40)


def test_the_configurations_are_those_of_the_source_and_softplus():
    assert [one.label for one in problem.CONFIGURATIONS] == [*problem.PUBLISHED, "softplus"]


def test_the_data_solve_the_equation():
    """Expression against an ODE solver on the same force; observations within their noise of it."""
    data = problem.data_set(SATURATION, 3)
    fine_u = np.interp(data.fine, problem.GRID, data.u)
    assert np.abs(fine_u[::6] - data.u).max() == 0.0

    def slope(t, x):
        active = 1 / (1 + 0.5 * np.exp(-np.interp(t, problem.GRID, data.u)))
        return data.rates.basal + data.rates.sensitivity * active - data.rates.decay * x

    found = solve_ivp(slope, (0.0, problem.END), data.rates.start, t_eval=problem.TIMES, rtol=1e-8, max_step=0.05)
    at = np.searchsorted(data.fine, problem.TIMES - 1e-9)
    assert np.allclose(data.fine[at], problem.TIMES)
    # The force between the points of the grid is rougher than the line through them.
    assert np.allclose(found.y.T, data.state[at], atol=5e-3)
    noise = np.concatenate([(problem.data_set(SATURATION, index).y - problem.data_set(SATURATION, index).state[at])
                            for index in range(20)]) / problem.NOISE
    assert abs(noise.mean()) < 4 / np.sqrt(noise.size) and abs(noise.std() - 1) < 4 / np.sqrt(2 * noise.size)


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
    found = experiment.compute(Task(f"saturation/{experiment.slug(method)}", 0, settings))
    assert found["mean"].shape == found["sd"].shape == (2, problem.POINTS)
    assert (found["sd"] > 0).all() and (found["seconds"] > 0).all()
    if method == "LA":  # Newton's method is known to fail, and then to say so
        assert (found["diverged"] | found["stopped"]).all() and np.isfinite(found["rmse"]).all()
        return
    assert not found["diverged"].any() and (found["rmse"] < 0.9).all()
    if method == "ESLS":
        assert (found["length"] >= 3600).all() and (found["low"] < found["mean"]).all()


@pytest.mark.slow
def test_chains_that_have_not_mixed_go_on():
    """Up to eight times as long as what was asked for."""
    data = [problem.data_set(EXPONENTIAL, index) for index in range(2)]
    given = {"link": "exponential", "gamma": None, "draws": 200, "burn_in": 40}
    found = slices.compute(given, data, jax.random.split(jax.random.key(0), 2))
    assert (found["length"] == 8 * 160).all() and (found["r_hat"] > 1.01).all()


@pytest.mark.slow
def test_slices_of_a_linear_link_have_the_exact_posterior(monkeypatch):
    """The experiment's own sampler on u itself as activity, against dense algebra on the grid."""
    from lfm_ppl.comparators.laplace import laplace
    from lfm_ppl.comparators.latent_grid import LatentGrid

    monkeypatch.setattr(problem, "activity", lambda u, link, gamma: u)
    data = problem.data_set.__wrapped__(problem.Configuration("softplus"), 1)
    slices._program.cache_clear()
    found = slices.compute({"link": "softplus", "gamma": None, "draws": 40_000, "burn_in": 2_000}, [data],
                           jax.random.split(jax.random.key(1), 1))
    latent = LatentGrid(problem.system("softplus", 1.0, data.rates), problem.TIMES, problem.GRID, slices.RULE)
    exact = laplace(latent, data.y)
    slices._program.cache_clear()
    error = 4.5 * np.asarray(exact.sd[0]) / np.sqrt(found["ess"][0])
    assert found["ess"][0] > 200
    assert np.all(np.abs(found["mean"][0] - exact.mode[0]) < error)
    assert np.all(np.abs(found["sd"][0] - exact.sd[0]) < error)


def made_up(settings):
    """Results of every task: errors of 0.3, and of 0.6 for GFS; the second data set of LA has diverged."""
    results = {}
    for task in experiment.all_tasks(settings):
        count = task.settings["last"] - task.settings["first"] + 1
        truth = np.stack([problem.data_set(SATURATION, index).u for index in range(count)])
        shift = 0.6 if task.settings["method"] == "GFS" else 0.3
        found = {"mean": truth + shift, "sd": np.full(truth.shape, 0.25), "seconds": np.full(count, 2.0)}
        if task.settings["method"] == "LA":
            found["stopped"] = np.arange(count) != 1
        if task.settings["method"] == "ESLS":
            found |= {"r_hat": np.full(count, 1.02), "ess": np.full(count, 50.0), "seconds": np.full(count, 400.0)}
        results[task.name] = found | experiment.judged(found, truth)
    return results


def test_the_tables_count_what_was_found():
    cells = experiment.by_cell(FEW, made_up(FEW))
    table = tables.comparison(cells)
    assert table.loc["exponential: LA", "divergences"] == 2  # one in each of two blocks
    assert table.loc["exponential: LA", "RMSE"] == pytest.approx(0.3)
    assert table.loc["softplus: ESLS", "R-hat"] == 0.0
    assert table.loc["softplus: GFS", "coverage"] == 0.0 and table.loc["softplus: GHS(7)", "coverage"] == 1.0
    nlpd = 0.5 * (0.3 / 0.25) ** 2 + np.log(0.25) + 0.5 * np.log(2 * np.pi)
    assert table.loc["softplus: GHS(7)", "NLPD"] == pytest.approx(nlpd)
    published = tables.beside_published(cells)
    assert published.loc["exponential", "LA div. published"] == 55 and len(published) == 7
    paired = tables.against_slices(cells)
    assert paired.loc["softplus: GFS", "RMSE ratio"] == pytest.approx(2.0)
    assert paired.loc["softplus: GFS", "times as fast"] == 200.0
    assert not any(name.endswith("ESLS") for name in paired.index)


@pytest.mark.slow
def test_a_killed_run_ends_with_the_same_table(tmp_path, monkeypatch):
    """The experiment itself, stopped after three tasks and started again: the same tables but for the times."""
    monkeypatch.setattr(experiment, "METHODS", ("ESLS", "GFS"))
    monkeypatch.setattr(problem, "CONFIGURATIONS", (SATURATION, EXPONENTIAL))
    settings = experiment.Settings(datasets=2, draws=400, burn_in=40)
    whole = experiment.run(settings, tmp_path / "whole")
    compute, done = experiment.compute, []

    def killed(task):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(task.name)
        return compute(task)

    monkeypatch.setattr(experiment, "compute", killed)
    with pytest.raises(KeyboardInterrupt):
        experiment.run(settings, tmp_path / "half")
    monkeypatch.setattr(experiment, "compute", compute)
    again = experiment.run(settings, tmp_path / "half")
    for first, second in ((whole.table, again.table), (whole.published, again.published)):
        timeless = [name for name in first if "CPU" not in name]
        pd.testing.assert_frame_equal(first[timeless], second[timeless], check_exact=True)


def test_what_is_not_finite_has_diverged():
    mean = np.zeros((3, problem.POINTS))
    mean[0, 5], mean[1] = np.nan, 4.0
    found = experiment.judged({"mean": mean, "sd": np.ones(mean.shape)}, np.zeros(mean.shape))
    assert found["diverged"].tolist() == [True, True, False] and found["rmse"][0] == np.inf


def test_what_is_stored_is_tabulated_and_drawn_without_computing(tmp_path):
    results = made_up(FEW)
    for one in experiment.all_tasks(FEW):
        write(one, results[one.name], tmp_path / experiment.TASKS)
    found = experiment.run(FEW, tmp_path)
    written = experiment.save(found, tmp_path)
    assert {path.name for path in written} == {
        "comparison.csv", "comparison.md", "published.csv", "published.md", "paired.csv", "paired.md", "errors.png",
        "force-repression-0.1.png", "force-exponential.png"}
    first = (tmp_path / "comparison.csv").read_text()
    experiment.save(experiment.run(FEW, tmp_path), tmp_path)
    assert (tmp_path / "comparison.csv").read_text() == first
    with pytest.raises(ValueError, match="draws is 400 there and 800 now"):
        experiment.run(dataclasses.replace(FEW, draws=800), tmp_path)


def test_the_figures_are_labelled():
    for figure in figures.draw(FEW, experiment.by_cell(FEW, made_up(FEW))).values():
        assert figure.get_figwidth() == 7.0 and figure.legends
        for axes in figure.axes:
            assert not axes.axison or (axes.get_xlabel() and axes.get_ylabel())


def test_blocks_of_more_data_sets_hold_those_of_fewer():
    few = {one.name: one.record() for one in experiment.all_tasks(experiment.Settings(datasets=20))}
    many = {one.name: one.record() for one in experiment.all_tasks(experiment.Settings(datasets=40))}
    assert few.items() <= many.items() and len(few) == 2 * 8 * len(experiment.METHODS)


def test_mistakes():
    with pytest.raises(ValueError, match="datasets must be at least 1"):
        experiment.Settings(datasets=0)
    with pytest.raises(ValueError, match="gamma must be"):
        problem.activity(jnp.zeros(3), "saturation", -0.1)
    with pytest.raises(ValueError, match="unknown link 'cubic'"):
        problem.activity(jnp.zeros(3), "cubic", 1.0)
