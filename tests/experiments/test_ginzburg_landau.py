"""The double well as an experiment: small runs of every part, tables and figures, and what they must satisfy."""

import numpy as np
import pytest

from lfm_ppl.engine.store import write
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.ginzburg_landau import experiment, figures, parameters, problem, states
from lfm_ppl.experiments.study import TASKS
from lfm_ppl.experiments.tasks import slug

SMALL = experiment.GinzburgLandauSettings(
    realisations=1, conditional=2, particles=200, smoother_particles=50, smoother_draws=20, conditional_particles=50,
    cells=96, draw_cells=48, nodes=5, paths=4, marginal_particles=20, marginal_steps=4, ram=(4, 6, 2), nuts=(4, 6, 1),
    pmmh=(4, 6, 1), tree_depth=2)


def task(kind, label):
    return next(one for one in experiment.all_tasks(SMALL) if one.name.startswith(f"{kind}/{slug(label)}/"))


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
    for what in ("filter", "smoother"):
        low, mean, high = (result[f"{what}_{end}"] for end in ("low", "mean", "high"))
        assert low.shape == (501,) and np.isfinite(mean).all()
        assert (low <= high).all()
        assert 0.0 <= result[f"{what}_coverage"] <= 1.0
    assert result["smoother_rmse"] < result["filter_rmse"] < 3.0
    assert result["seconds"] > 0.0


@pytest.mark.parametrize("method", [
    pytest.param(method, marks=() if method == "CKF" else pytest.mark.slow) for method in problem.METHODS])
def test_every_method_has_conditional_posteriors(method):
    computed = task("conditional", method)
    result = parameters.conditional(computed)
    values = result["log_likelihood"]
    assert values.shape == (2, 3, 5) and np.isfinite(values).mean() > 0.8
    gathered = experiment.STUDY.kinds["conditional"].collect([computed], {computed.name: result})
    found = parameters.outcomes(gathered).sel({"method": method})
    assert found["outside"].shape == (2, 3)
    np.testing.assert_array_equal(found["outside"], np.abs(found["below"] - 0.5) > 0.495)


def test_the_grid_gives_the_same_likelihood_in_one_step_and_in_twenty():
    """exp(2 A) = exp(0.1 A)^20: the fine times change nothing."""
    once = states.compute(task("state", "grid"))["log_likelihood"]
    found = parameters.conditional(task("conditional", "grid"))["log_likelihood"]
    place = problem.NAMES.index("sigma")
    np.testing.assert_allclose(parameters.nodes("sigma", SMALL.nodes)[1], problem.TRUTH[place], rtol=1e-14)
    np.testing.assert_allclose(found[0, place, 1], once, rtol=1e-9)


@pytest.mark.parametrize("label", [
    pytest.param(label, marks=pytest.mark.slow) for label in parameters.SAMPLERS])
def test_every_sampler_draws_parameters_and_states(label):
    result = parameters.by_chains(task("mcmc", label))
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
    chosen = scores.thin_draws(draws, 2)
    np.testing.assert_array_equal(chosen, [[0.0, 8.0, 16.0], [7.0, 15.0, 23.0]])


def test_names_of_tasks_and_files_differ():
    found = experiment.all_tasks(experiment.GinzburgLandauSettings())
    assert len({one.file for one in found}) == len(found) == 5 * 20 + 5 * 10 + 1 + 4 * 20


def test_more_realisations_keep_the_tasks_of_fewer():
    few = {one.name: one.record() for one in experiment.all_tasks(experiment.GinzburgLandauSettings(20, 100))}
    many = {one.name: one.record() for one in experiment.all_tasks(experiment.GinzburgLandauSettings(30, 150))}
    assert all(many[name] == record for name, record in few.items())


def test_settings_are_checked():
    with pytest.raises(ValueError, match="realisations must be at least 1"):
        experiment.GinzburgLandauSettings(realisations=0)
    with pytest.raises(ValueError, match="nodes must be at least 4"):
        experiment.GinzburgLandauSettings(nodes=3)
    with pytest.raises(ValueError, match="use several seeds"):
        experiment.GinzburgLandauSettings(conditional=20_000)


def made_up(settings):
    """Results of every task, with the right names and shapes."""
    generator = np.random.default_rng(0)
    results = {}
    for one in experiment.all_tasks(settings):
        kind, given = one.settings["what"], one.settings
        if kind == "conditional":
            count = given["last"] - given["first"] + 1
            away = 1.2 if given["method"] == "EKF" else 0.0
            rows = np.stack([
                -8.0 * (nodes - truth - away) ** 2 if name == "alpha" else -8.0 * (np.log(nodes / truth) - away) ** 2
                for name, truth in zip(problem.NAMES, problem.TRUTH, strict=True)
                for nodes in [parameters.nodes(name, given["nodes"])]])
            results[one.name] = {"log_likelihood": np.tile(rows, (count, 1, 1)), "seconds": 1.0}
            continue
        mean = generator.normal(size=501)
        result = {f"{what}_{end}": mean + shift for what in ("filter", "smoother")
                  for end, shift in (("low", -2.0), ("mean", 0.0), ("high", 2.0))}
        result |= {f"{what}_{score}": 0.9 for what in ("filter", "smoother") for score in ("rmse", "coverage")}
        result["seconds"] = 2.0
        if kind == "mcmc":
            result |= {"draws": generator.normal(size=(3, 4, 10)), "mean": np.ones(3), "sd": np.ones(3),
                       "low": np.full(3, -3.0), "high": np.full(3, 1.0), "ess": np.full(3, 100.0),
                       "r_hat": np.ones(3), "divergences": 0}
        elif given["method"] == problem.GRID:
            x = np.linspace(-6.0, 6.0, 49)
            density = np.tile(np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi), (3, 1))
            result |= {"x": x, "marks": np.array([11.8, 31.0, 17.9]), "filter_density": density,
                       "smoother_density": density}
        results[one.name] = result
    return results


MADE = experiment.GinzburgLandauSettings(realisations=3, conditional=12, nodes=41)


def data_of(settings):
    return experiment.STUDY.collect(settings, made_up(settings))


def test_the_tables_count_what_was_found():
    tables = {name: table.frame for name, table in experiment.tables(MADE, data_of(MADE)).items()}
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
    drawn = figures.draw(MADE, data_of(MADE))
    assert list(drawn) == ["states", "marginals", "conditional", "integrated", "rates"]
    for figure in drawn.values():
        assert figure.get_figwidth() == 7.0
        assert figure.legends
        grid = [axes.get_subplotspec() for axes in figure.axes]
        assert any(axes.get_ylabel() for axes in figure.axes)
        for axes, place in zip(figure.axes, grid, strict=True):
            assert axes.get_xlabel() or not place.is_last_row()


@pytest.mark.slow
def test_what_is_stored_is_tabulated_and_drawn_without_computing(tmp_path):
    results = made_up(MADE)
    for one in experiment.all_tasks(MADE):
        write(one, results[one.name], tmp_path / TASKS)
    lines = []
    found = experiment.STUDY.run(MADE, tmp_path, report=lines.append)
    count = len(experiment.all_tasks(MADE))
    assert lines == [f"{count} of {count} tasks are stored already"]
    written = experiment.STUDY.save(found, tmp_path)
    assert {path.name for path in written} == {
        "comparison.csv", "comparison.md", "rates.csv", "rates.md", "parameters.csv", "parameters.md", "states.png",
        "marginals.png", "conditional.png", "integrated.png", "rates.png"}
    assert all(path.stat().st_size > 0 for path in written)
    first = (tmp_path / "rates.csv").read_text()
    experiment.STUDY.save(experiment.STUDY.run(MADE, tmp_path), tmp_path)
    assert (tmp_path / "rates.csv").read_text() == first


def test_a_folder_of_other_settings_is_refused(tmp_path):
    results = made_up(MADE)
    for one in experiment.all_tasks(MADE):
        write(one, results[one.name], tmp_path / TASKS)
    other = experiment.GinzburgLandauSettings(realisations=3, conditional=12, nodes=41, seed=1)
    with pytest.raises(ValueError, match="seed is 0 there and 1 now"):
        experiment.STUDY.run(other, tmp_path)


@pytest.mark.slow
def test_the_quick_version_runs_from_end_to_end(tmp_path):
    found = experiment.STUDY.run(experiment.GinzburgLandauSettings.quick(realisations=1, conditional=2), tmp_path)
    assert found.tables["comparison"].loc["grid, true parameters", "RMSE smoother"] < 1.5
    assert len(experiment.STUDY.save(found, tmp_path)) == 11
