"""Ballistic study: small runs of every part, tables and figures."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.ballistic import experiment, parameters, states
from lfm_ppl.experiments.ballistic.problem import (
    RECORDS_PER_SEED,
    posterior,
    simulate_target,
    simulate_target_from_prior,
    true_likelihood,
    true_z,
)
from lfm_ppl.experiments.study import TASKS
from lfm_ppl.io import loading
from lfm_ppl.utils.run_store import RunStore

SMALL = experiment.BallisticSettings(
    runs=2, particle_runs=1, particles=(2_000,), chain_runs=1, drawn_runs=1, draws=200, paths=5, nuts=(2, 10, 10, 1),
    ram=(2, 10, 10, 2))


def tasks_of(kind, settings):
    return [task for task in experiment.all_tasks(settings) if task.settings["what"] == kind]


@pytest.mark.slow
def test_the_targets_are_those_of_the_model_file():
    data = loading.load("ballistic").simulate(seed=RECORDS_PER_SEED + 3)
    target = simulate_target(3, seed=1)
    np.testing.assert_array_equal(target.y, data.y)
    is_measured = np.isin(data.truth["times"], target.times)
    np.testing.assert_array_equal(target.paths[0], np.asarray(data.truth["state"])[is_measured, 0])
    np.testing.assert_array_equal(target.paths[2], np.asarray(data.truth["forces"]["u"])[is_measured])
    assert np.exp(true_z()) == pytest.approx([4.49e-4, 50.0, 5.0])
    assert true_z()[0] == pytest.approx(-7.7, abs=0.01)  # as published
    first, second = simulate_target_from_prior(1), simulate_target_from_prior(1, seed=1)
    assert first.y.shape == target.y.shape and first.paths.shape == target.paths.shape
    assert (first.z != target.z).all() and (first.z != second.z).all()


@pytest.mark.slow
def test_the_densities_are_those_of_the_model():
    """The prior against scipy's, and the likelihood against that of the system built by hand."""
    z = true_z() + np.array([0.3, -0.2, 0.1])
    target = simulate_target(0)
    log_likelihood, log_prior = posterior().log_densities(z, target.y)
    expected = stats.norm([np.log(5e-4), np.log(30.0), np.log(5.0)], [1.0, 1.0, 0.7]).logpdf(z).sum()
    # The levels of the noise are fixed at the medians of their priors, whose densities there belong to it.
    expected += sum(stats.lognorm(0.7, scale=level).logpdf(level) for level in (50.0, 10.0, 30.0))
    assert log_prior == pytest.approx(expected, rel=1e-12)
    assert log_likelihood == pytest.approx(float(posterior().likelihood(z).log_prob(target.y)), rel=1e-10)


@pytest.mark.slow
def test_a_gaussian_smoother_tracks():
    """The errors belong to the stored mean, and the band covers them."""
    (task,) = [entry for entry in tasks_of("tracking", SMALL) if entry.settings["method"] == "Taylor"]
    result = states.run_gaussian(task)
    target = simulate_target(0)
    assert result["smoother_rmse"].shape == result["smoother_coverage"].shape == (2, 3)
    rmse = np.sqrt(np.mean((result["mean"] - target.paths) ** 2, axis=1))
    np.testing.assert_allclose(result["smoother_rmse"][0], rmse)
    assert (result["smoother_rmse"] < result["filter_rmse"]).all()
    assert (result["smoother_coverage"] > 0.8).all()
    assert (result["smoother_seconds"] > 0).all() and result["log_likelihood"].shape == (2,)


@pytest.mark.slow
def test_particles_agree_with_the_gaussian_smoother_where_it_is_nearly_exact():
    (task,) = tasks_of("particles", SMALL)
    result = states.run_particles(task)
    likelihood = true_likelihood()
    target = simulate_target(0)
    mean, sd = map(np.asarray, states.smoothed_paths(likelihood.smooth(target.y)))
    # 2,000 particles leave an error of the log likelihood of about 1, and many different paths at the end alone.
    assert abs(result["log_likelihood"] - float(likelihood.log_prob(target.y))) < 4.0
    assert result["distinct"][0] < result["distinct"][-1] <= 2_000
    is_reliable = result["distinct"] > 200
    assert is_reliable.sum() >= 5
    difference = ((result["mean"] - mean) / sd)[:, is_reliable]
    assert np.sqrt(np.mean(difference**2)) < 4.0 / np.sqrt(200)
    np.testing.assert_allclose(result["sd"][:, is_reliable], sd[:, is_reliable], rtol=0.3)


@pytest.mark.slow
def test_the_posterior_is_that_of_a_grid():
    """Mean and standard deviation of each parameter against a sum over a grid of all three."""
    target = simulate_target(0)
    result = parameters.estimate(target, 1_000, 5, 0)
    assert result["k"] < 0.7 and result["exists"]
    axes = [np.linspace(m - 5 * s, m + 5 * s, 25)
            for m, s in zip(result["posterior_mean"], result["posterior_sd"], strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    log_density = np.sum(posterior().log_densities_of(nodes, target.y, batch=25), axis=0)
    weight = np.exp(log_density - log_density.max())
    weight /= weight.sum()
    mean = weight @ nodes
    sd = np.sqrt(weight @ (nodes - mean) ** 2)
    error = sd / np.sqrt(result["ess"])
    np.testing.assert_array_less(np.abs(result["posterior_mean"] - mean), 4 * error)
    np.testing.assert_allclose(result["posterior_sd"], sd, rtol=4 / np.sqrt(result["ess"]))
    np.testing.assert_allclose(result["below"], weight @ (nodes < true_z()), atol=0.1)
    # No point of the grid is more likely than the most likely one.
    points = np.stack([result["likely"], *nodes[np.argsort(log_density)[-5:]]])
    best, *lower = posterior().log_densities_of(points, target.y)[0]
    assert best >= max(lower) - 1e-6


def synthetic_results(settings):
    """Results of every task: particles with RMSE and time that follow from their number, parameters as expected."""
    generator, results = np.random.default_rng(0), {}
    for task in experiment.all_tasks(settings):
        inputs = task.settings
        if inputs["what"] == "chains":
            draws = true_z()[:, None, None] + 0.1 * generator.normal(size=(3, 2, 300))
            is_shifted = inputs["sampler"] == "RAM"
            results[task.name] = {"draws": draws, "seconds": 10.0, "divergences": 1, "r_hat": np.full(3, 1.002),
                                  "mean": true_z() + 0.05 * is_shifted, "sd": np.full(3, 0.11 if is_shifted else 0.1),
                                  "ess": np.full(3, 200.0)}
            continue
        if inputs["what"] == "particles":
            factor = 1.0 + 100.0 / inputs["particles"]
            results[task.name] = {
                "filter_rmse": 2 * factor * np.ones(3), "smoother_rmse": factor * np.array([50.0, 30.0, 20.0]),
                "smoother_coverage": np.full(3, 0.9), "log_likelihood": -600.0 + inputs["index"], "filter_seconds": 0.1,
                "smoother_seconds": inputs["particles"] * 1e-3, "distinct": np.full(120, 7.0),
                "mean": np.zeros((3, 120)), "sd": np.ones((3, 120))}
            continue
        count = inputs["last"] - inputs["first"] + 1
        if inputs["what"] == "tracking":
            result = {"filter_rmse": np.full((count, 3), 2.0), "smoother_rmse": np.tile([50.0, 30.0, 20.0], (count, 1)),
                      "smoother_coverage": np.full((count, 3), 0.95), "log_likelihood": np.full(count, -601.0),
                      "filter_seconds": np.full(count, 1e-3), "smoother_seconds": np.full(count, 2e-3),
                      "mean": simulate_target(0).paths, "sd": np.ones((3, 120))}
        else:
            total = settings.drawn_runs if inputs["what"] == "drawn" else settings.runs
            below = (np.arange(inputs["first"], inputs["last"] + 1)[:, None] + 0.5) / total * np.ones(3)
            if inputs["what"] == "known":
                results[task.name] = {"below": below[:, 0]}
                continue
            result = {"likely": true_z() + np.zeros((count, 3)), "exists": np.arange(count) > 0,
                      "posterior_mean": true_z() + np.zeros((count, 3)),
                      "posterior_sd": np.full((count, 3), 0.1), "below": below, "k": np.full(count, 0.2),
                      "ess": np.full(count, 300.0), "seconds": np.full(count, 0.5),
                      "draws": true_z()[:, None] + 0.1 * generator.normal(size=(3, 200)),
                      **{f"{kind}_{name}": np.full((count, 3), 0.9) for kind in ("likely", "posterior")
                         for name in ("rmse", "coverage")}}
        results[task.name] = result
    return results


SYNTHETIC = experiment.BallisticSettings(runs=100, particle_runs=3, particles=(500, 1_000), chain_runs=2, drawn_runs=20)


def synthetic_data(settings):
    return experiment.STUDY.collect(settings, synthetic_results(settings))


def test_tables_summarize_results():
    tables = {name: table.frame for name, table in experiment.tables(SYNTHETIC, synthetic_data(SYNTHETIC)).items()}
    tracked = tables["tracking"]
    assert list(tracked.index) == [
        *states.RULES, *(f"cubature, {label}{end}" for end in ("", "; parameters drawn from the prior")
                         for label in experiment.UNKNOWN)]
    assert tracked.loc["Taylor", "RMSE speed (m/s)"] == 30.0 and tracked.loc["cubature", "coverage u"] == 0.95
    particle_table = tables["particles"]
    row = particle_table.loc["smoother, 1,000 particles"]
    assert row["ratio u"] == pytest.approx(1 / 1.1) and row["ratio u se"] == pytest.approx(0.0, abs=1e-12)
    assert row["times as long"] == pytest.approx(500.0) and row["distinct"] == 7.0
    assert row["log likelihood - Gaussian"] == pytest.approx(2.0) and row["its sd"] == pytest.approx(1.0)
    assert particle_table.loc["smoother, Gaussian", "CPU s"] == 2e-3
    parameter_table = tables["parameters"]
    row = parameter_table.loc["log alpha"]
    assert row["maximum"] == 0.9 and row["truth"] == pytest.approx(-7.708, abs=1e-3)
    assert [row[f"coverage {level}%"] for level in (50, 80, 95)] == pytest.approx([0.5, 0.8, 0.96], abs=0.011)
    assert parameter_table.loc["log scale, drawn from the prior", "coverage 80%"] == pytest.approx(0.8, abs=0.051)
    drag = parameter_table.loc["log alpha, the force's parameters known"]
    assert drag["coverage 80%"] == pytest.approx(0.8, abs=0.011) and np.isnan(drag["posterior sd"])
    assert row["coverage 50% se"] == pytest.approx(0.05, abs=1e-3) and row["rank p"] > 0.99
    agreement = tables["agreement"]
    assert agreement.loc["RAM", "shift"] == pytest.approx(0.5)
    assert agreement.loc["RAM", "sd ratio"] == pytest.approx(1.1)
    assert agreement.loc["RAM", "shift se"] == pytest.approx(0.1)
    assert agreement.loc["weighted draws", "k"] == 0.2 and agreement.loc["NUTS", "R-hat"] == 1.002


def test_constant_chain_is_reported():
    results = synthetic_results(SYNTHETIC)
    constant_chain = next(task.name for task in tasks_of("chains", SYNTHETIC) if task.settings["sampler"] == "RAM")
    for name, value in (("ess", np.nan), ("r_hat", np.nan), ("sd", 0.0)):
        results[constant_chain][name][1] = value
    row = experiment.agreement(experiment.STUDY.collect(SYNTHETIC, results))["RAM"]
    assert row["least ESS"] == 0 and row["R-hat"] == np.inf and row["sd ratio"] == 0


def test_stored_results_are_tabulated_without_computing(tmp_path):
    results = synthetic_results(SYNTHETIC)
    for task in experiment.all_tasks(SYNTHETIC):
        RunStore(tmp_path / TASKS).put(task.stem, results[task.name], task.record())
    lines = []
    study_result = experiment.STUDY.run(SYNTHETIC, tmp_path, report=lines.append)
    count = len(results)
    assert lines == [f"{count} of {count} tasks are stored already"]
    written = experiment.STUDY.save(study_result, tmp_path)
    stems = ("tracking", "particles", "parameters", "agreement")
    assert {path.name for path in written} == {f"{stem}.{end}" for stem in stems for end in ("csv", "md")} | {
        "paths.png", "particles.png", "drag.png", "coverage.png"}
    assert scores.readable(study_result.tables["tracking"]).loc["cubature", "coverage u"].startswith("0.95")
    with pytest.raises(ValueError, match="seed is 0 there and 1 now"):
        experiment.STUDY.run(dataclasses.replace(SYNTHETIC, seed=1), tmp_path)


def test_tasks_have_separate_files():
    tasks = experiment.all_tasks(experiment.BallisticSettings())
    assert len({task.stem for task in tasks}) == len(tasks) == 4 * 10 + 50 + 50 + 4 * 20 + 2 * 3 + 10


def test_invalid_settings():
    with pytest.raises(ValueError, match="rules must hold 'cubature'"):
        experiment.BallisticSettings(rules=("Taylor",))


@pytest.mark.slow
def test_the_quick_version_runs_from_end_to_end(tmp_path):
    study_result = experiment.STUDY.run(experiment.BallisticSettings.quick(runs=2), tmp_path)
    written = experiment.STUDY.save(study_result, tmp_path)
    assert len(written) == 12 and all(path.stat().st_size > 0 for path in written)
    assert len(study_result.printed) == 4


@pytest.mark.slow
def test_the_drag_alone_is_integrated_right():
    """With the force's parameters known, on another grid and equally spaced in the drag."""
    target = simulate_target(0)
    z = np.log(np.linspace(*np.exp(target.z[0] + np.array([-1.0, 1.0])), 400))  # equally spaced in alpha
    points = np.stack([z, np.full(400, target.z[1]), np.full(400, target.z[2])], axis=1)
    log_likelihood, _ = posterior().log_densities_of(points, target.y, batch=20)
    density = np.exp(log_likelihood - log_likelihood.max())
    cells = 0.5 * (density[1:] + density[:-1]) * np.diff(z)
    expected = cells[z[1:] <= target.z[0]].sum() / cells.sum()
    assert parameters.rank_drag(target) == pytest.approx(expected, abs=0.02)
