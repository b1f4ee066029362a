"""Double well study: small runs of every part, tables and figures."""

import numpy as np
import pytest

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.ginzburg_landau import experiment, figures, parameters, problem, states
from lfm_ppl.experiments.study import TASKS
from lfm_ppl.experiments.tasks import slug
from lfm_ppl.utils.run_store import RunStore

SMALL = experiment.GinzburgLandauSettings(
    realisations=1, conditional=2, particles=200, smoother_particles=50, smoother_draws=20, conditional_particles=50,
    cells=96, draw_cells=48, nodes=5, paths=4, marginal_particles=20, marginal_steps=4, ram=(4, 6, 2), nuts=(4, 6, 1),
    pmmh=(4, 6, 1), tree_depth=2)


def task(kind, label):
    prefix = f"{kind}/{slug(label)}/"
    return next(study_task for study_task in experiment.all_tasks(SMALL) if study_task.name.startswith(prefix))


def test_the_realisations_are_those_of_the_model_file():
    data = problem.realisation(problem.DEFAULT)
    default = problem.model_file().simulate()
    np.testing.assert_array_equal(data.y, default.y)
    np.testing.assert_array_equal(data.path, np.asarray(default.truth["state"])[:, 0])
    assert problem.TRUTH == tuple(default.truth["parameters"][name] for name in problem.NAMES)
    present = np.isfinite(data.sparse[:, 0])
    np.testing.assert_array_equal(data.fine[present], data.times)
    np.testing.assert_array_equal(data.sparse[present], data.y)


@pytest.mark.parametrize("method", [
    method if method == "CKF" else pytest.param(method, marks=pytest.mark.slow) for method in problem.METHODS])
def test_every_method_filters_and_smooths(method):
    result = states.compute(task("state", method))
    for prefix in ("filter", "smoother"):
        low, mean, high = (result[f"{prefix}_{end}"] for end in ("low", "mean", "high"))
        assert low.shape == (501,) and np.isfinite(mean).all()
        assert (low <= high).all()
        assert 0.0 <= result[f"{prefix}_coverage"] <= 1.0
    assert result["smoother_rmse"] < result["filter_rmse"] < 3.0
    assert result["seconds"] > 0.0


@pytest.mark.parametrize("method", [
    pytest.param(method, marks=() if method == "CKF" else pytest.mark.slow) for method in problem.METHODS])
def test_every_method_has_conditional_posteriors(method):
    conditional_task = task("conditional", method)
    result = parameters.conditional_likelihoods(conditional_task)
    values = result["log_likelihood"]
    assert values.shape == (2, 3, 5) and np.isfinite(values).mean() > 0.8
    dataset = experiment.STUDY.kinds["conditional"].collect([conditional_task], {conditional_task.name: result})
    outcomes = parameters.outcomes(dataset).sel({"method": method})
    assert outcomes["outside"].shape == (2, 3)
    np.testing.assert_array_equal(outcomes["outside"], np.abs(outcomes["below"] - 0.5) > 0.495)


def test_the_grid_gives_the_same_likelihood_in_one_step_and_in_twenty():
    """exp(2 A) = exp(0.1 A)^20: the fine times change nothing."""
    single_step = states.compute(task("state", "grid"))["log_likelihood"]
    log_likelihood = parameters.conditional_likelihoods(task("conditional", "grid"))["log_likelihood"]
    index = problem.NAMES.index("sigma")
    np.testing.assert_allclose(parameters.nodes("sigma", SMALL.nodes)[1], problem.TRUTH[index], rtol=1e-14)
    np.testing.assert_allclose(log_likelihood[0, index, 1], single_step, rtol=1e-9)


@pytest.mark.parametrize("label", [
    pytest.param(label, marks=pytest.mark.slow) for label in parameters.SAMPLERS])
def test_every_sampler_draws_parameters_and_states(label):
    result = parameters.sample_posterior(task("mcmc", label))
    assert result["draws"].shape == (3, parameters.CHAINS, 6)
    alpha, beta, sigma = result["draws"]
    assert (beta > 0).all() and (sigma > 0).all() and np.isfinite(alpha).all()
    assert result["smoother_mean"].shape == (501,)
    assert (result["smoother_low"] < result["smoother_high"]).all()


def test_the_law_of_total_variance():
    generator = np.random.default_rng(0)
    mean, variance = generator.normal(size=(3, 2)), generator.uniform(1.0, 2.0, (3, 2))
    total, sd = scores.total_moments(mean, variance)
    second = (variance + mean**2).mean(axis=0)
    np.testing.assert_allclose(total, mean.mean(axis=0))
    np.testing.assert_allclose(sd**2, second - total**2, rtol=1e-12)


def test_draws_are_spread_over_all_chains():
    draws = np.arange(24.0).reshape(3, 2, 4)
    thinned = scores.thin_draws(draws, 2)
    np.testing.assert_array_equal(thinned, [[0.0, 8.0, 16.0], [7.0, 15.0, 23.0]])


def test_names_of_tasks_and_files_differ():
    tasks = experiment.all_tasks(experiment.GinzburgLandauSettings())
    assert len({task.stem for task in tasks}) == len(tasks) == 5 * 20 + 5 * 10 + 1 + 4 * 20


def test_more_realisations_keep_the_tasks_of_fewer():
    few, many = ({task.name: task.record() for task in experiment.all_tasks(experiment.GinzburgLandauSettings(*counts))}
                 for counts in ((20, 100), (30, 150)))
    assert all(many[name] == record for name, record in few.items())


def synthetic_results(settings):
    """Results of every task, with the right names and shapes."""
    generator = np.random.default_rng(0)
    results = {}
    for study_task in experiment.all_tasks(settings):
        kind, task_settings = study_task.settings["what"], study_task.settings
        if kind == "conditional":
            count = task_settings["last"] - task_settings["first"] + 1
            offset = 1.2 if task_settings["method"] == "EKF" else 0.0
            rows = np.stack([
                -8.0 * ((nodes - truth if name == "alpha" else np.log(nodes / truth)) - offset) ** 2
                for name, truth in zip(problem.NAMES, problem.TRUTH, strict=True)
                for nodes in [parameters.nodes(name, task_settings["nodes"])]])
            results[study_task.name] = {"log_likelihood": np.tile(rows, (count, 1, 1)), "seconds": 1.0}
            continue
        mean = generator.normal(size=501)
        result = {f"{prefix}_{end}": mean + shift for prefix in ("filter", "smoother")
                  for end, shift in (("low", -2.0), ("mean", 0.0), ("high", 2.0))}
        result |= {f"{prefix}_{score}": 0.9 for prefix in ("filter", "smoother") for score in ("rmse", "coverage")}
        result["seconds"] = 2.0
        if kind == "mcmc":
            result |= {"draws": generator.normal(size=(3, 4, 10)), "mean": np.ones(3), "sd": np.ones(3),
                       "low": np.full(3, -3.0), "high": np.full(3, 1.0), "ess": np.full(3, 100.0),
                       "r_hat": np.ones(3), "divergences": 0}
        elif task_settings["method"] == problem.GRID:
            x = np.linspace(-6.0, 6.0, 49)
            density = np.tile(np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi), (3, 1))
            result |= {"x": x, "marks": np.array([11.8, 31.0, 17.9]), "filter_density": density,
                       "smoother_density": density}
        results[study_task.name] = result
    return results


SYNTHETIC = experiment.GinzburgLandauSettings(realisations=3, conditional=12, nodes=41)


def synthetic_data(settings):
    return experiment.STUDY.collect(settings, synthetic_results(settings))


def test_tables_count_outcomes():
    tables = {name: table.frame for name, table in experiment.tables(SYNTHETIC, synthetic_data(SYNTHETIC)).items()}
    rates = tables["rates"]
    assert list(rates.index) == list(problem.METHODS)
    assert rates.loc["EKF", "pooled"] == 1.0 and rates.loc["grid", "pooled"] == 0.0
    assert rates.loc["EKF", "differs"] == 1.0 and rates.loc["grid", "differs"] == 0.0
    assert rates.loc["grid", "alpha se"] == pytest.approx(np.sqrt(1 / 14 * 13 / 14 / 12))
    table = tables["comparison"]
    assert table.loc["RAM, CKF", "ESS/CPU s"] == 50.0
    # alpha = -1 and beta = 0.1 lie in (-3, 1), sigma = 2 does not.
    assert table.loc["RAM, CKF", "coverage parameters"] == pytest.approx(2 / 3)
    assert table.loc["RAM, EKF", "RMSE published"] == 0.895
    assert tables["parameters"].loc["RAM, CKF", "coverage sigma"] == 0.0
    assert scores.readable(table).loc["RAM, CKF", "ESS/CPU s"] == "50"


def test_the_figures_are_drawn_and_labelled():
    all_figures = figures.draw(SYNTHETIC, synthetic_data(SYNTHETIC))
    assert list(all_figures) == ["states", "marginals", "conditional", "integrated", "rates"]
    for figure in all_figures.values():
        assert figure.get_figwidth() == 7.0
        assert figure.legends
        grid = [axes.get_subplotspec() for axes in figure.axes]
        assert any(axes.get_ylabel() for axes in figure.axes)
        for axes, cell in zip(figure.axes, grid, strict=True):
            assert axes.get_xlabel() or not cell.is_last_row()


@pytest.mark.slow
def test_stored_results_are_tabulated_without_computing(tmp_path):
    results = synthetic_results(SYNTHETIC)
    for study_task in experiment.all_tasks(SYNTHETIC):
        RunStore(tmp_path / TASKS).put(study_task.stem, results[study_task.name], study_task.record())
    lines = []
    result = experiment.STUDY.run(SYNTHETIC, tmp_path, report=lines.append)
    count = len(experiment.all_tasks(SYNTHETIC))
    assert lines == [f"{count} of {count} tasks are stored already"]
    written = experiment.STUDY.save(result, tmp_path)
    assert {path.name for path in written} == {
        "comparison.csv", "comparison.md", "rates.csv", "rates.md", "parameters.csv", "parameters.md", "states.png",
        "marginals.png", "conditional.png", "integrated.png", "rates.png"}
    assert all(path.stat().st_size > 0 for path in written)
    first = (tmp_path / "rates.csv").read_text()
    experiment.STUDY.save(experiment.STUDY.run(SYNTHETIC, tmp_path), tmp_path)
    assert (tmp_path / "rates.csv").read_text() == first


@pytest.mark.slow
def test_the_quick_version_runs_from_end_to_end(tmp_path):
    results = experiment.STUDY.run(experiment.GinzburgLandauSettings.quick(realisations=1, conditional=2), tmp_path)
    assert results.tables["comparison"].loc["grid, true parameters", "RMSE smoother"] < 1.5
    assert len(experiment.STUDY.save(results, tmp_path)) == 11
