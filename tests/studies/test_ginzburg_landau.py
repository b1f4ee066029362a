"""Double well study: small runs of every part, tables and figures."""

import numpy as np
import pytest

from lfm_ppl.studies.ginzburg_landau import parameters, problem, states, study
from lfm_ppl.studies.tasks import slug

SMALL = study.GinzburgLandauSettings(
    realisations=1, conditional=2, particles=200, smoother_particles=50, smoother_draws=20, conditional_particles=50,
    cells=96, draw_cells=48, nodes=5, paths=4, marginal_particles=20, marginal_steps=4, ram=(4, 6, 2), nuts=(4, 6, 1),
    pmmh=(4, 6, 1), tree_depth=2)


def task(kind, label):
    prefix = f"{kind}/{slug(label)}/"
    return next(study_task for study_task in study.all_tasks(SMALL) if study_task.name.startswith(prefix))


def test_a_method_filters_and_smooths():
    result = states.compute(task("state", "CKF"))
    for prefix in ("filter", "smoother"):
        low, mean, high = (result[f"{prefix}_{end}"] for end in ("low", "mean", "high"))
        assert low.shape == (501,) and np.isfinite(mean).all()
        assert (low <= high).all()
        assert 0.0 <= result[f"{prefix}_coverage"] <= 1.0
    assert result["smoother_rmse"] < result["filter_rmse"] < 3.0
    assert result["seconds"] > 0.0


@pytest.mark.thorough
def test_a_method_has_conditional_posteriors():
    conditional_task = task("conditional", "CKF")
    result = parameters.conditional_likelihoods(conditional_task)
    values = result["log_likelihood"]
    assert values.shape == (2, 3, 5) and np.isfinite(values).mean() > 0.8
    dataset = study.STUDY.kinds["conditional"].collect([conditional_task], {conditional_task.name: result})
    outcomes = parameters.outcomes(dataset).sel({"method": "CKF"})
    assert outcomes["outside"].shape == (2, 3)
    np.testing.assert_array_equal(outcomes["outside"], np.abs(outcomes["below"] - 0.5) > 0.495)


@pytest.mark.thorough
def test_the_grid_gives_the_same_likelihood_in_one_step_and_in_twenty():
    """exp(2 A) = exp(0.1 A)^20: the fine times change nothing."""
    single_step = states.compute(task("state", "grid"))["log_likelihood"]
    log_likelihood = parameters.conditional_likelihoods(task("conditional", "grid"))["log_likelihood"]
    index = problem.NAMES.index("sigma")
    np.testing.assert_allclose(parameters.nodes("sigma", SMALL.nodes)[1], problem.TRUTH[index], rtol=1e-14)
    np.testing.assert_allclose(log_likelihood[0, index, 1], single_step, rtol=1e-9)
