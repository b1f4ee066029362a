"""Periodic kernels study: a small run, its tables and figures, and properties of the approximations."""

import numpy as np
import pytest

from lfm_ppl.parallel.task import Task
from lfm_ppl.studies.periodic_kernels import methods, problem, study

SMALL = study.PeriodicKernelSettings(runs=20, functions=(5, 22), draws=20, points=(20, 200))


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return study.STUDY.run(SMALL, tmp_path_factory.mktemp("kernels"))


@pytest.mark.slow
def test_the_published_comparison(results):
    """Below 1e-4 with 22 eigenfunctions, above 0.1 with random frequencies, and not with 20 points."""
    error = results.tables["published"]["error"]
    assert error["22 eigenfunctions, 200 points"] < 1e-4 and error["20 eigenfunctions, 20 points"] > 5e-3
    assert error[methods.SPARSE] > error[methods.SPARSE_4] > 0.1


@pytest.mark.slow
def test_the_order_of_the_published_table_holds(results):
    rmse, density = results.tables["regression"]["RMSE"], results.tables["regression"]["log likelihood"]
    assert rmse[methods.SPARSE] > rmse[methods.SPARSE_4] > rmse[methods.KPCA]
    assert density[methods.SPARSE] < density[methods.SPARSE_4] < density[methods.KPCA]
    assert rmse[methods.KPCA] == pytest.approx(rmse[methods.EXACT], rel=1e-2)
    coverage = results.tables["regression"].loc[methods.EXACT]
    assert abs(coverage["coverage"] - 0.95) < 4 * coverage["coverage se"]


@pytest.mark.slow
def test_errors_fall_with_the_number_of_functions(results):
    table = results.tables["covariance"]
    for row in table.index[table.index.str.endswith("eigenfunctions")]:
        assert table.loc[row, "22"] < table.loc[row, "5"]
        name = row.removesuffix(", eigenfunctions")
        resonators = f"{name}, resonators"
        if resonators in table.index:
            assert table.loc[resonators, "22"] == pytest.approx(table.loc[row, "22"], abs=1e-12)
            # A stationary kernel misses the same variance at all times.
            assert table.loc[row, "22"] == pytest.approx(table.loc[f"{name}, left out", "22"], abs=1e-12)


def test_prediction_is_conditioning():
    """Against the conditional of one joint normal, by its precision matrix."""
    task = Task("x", 0, {})
    prior = methods.prior_covariances(task, methods.EXACT, 0)
    data = np.cos(np.arange(len(problem.MEASURED)))
    mean, variance = methods.condition(prior, data)
    times = np.append(problem.MEASURED, problem.PREDICTED[40])
    joint = np.exp(-0.5 * ((times[:, None] - times) / 10.0) ** 2) + 1e-8 * np.eye(len(times))
    precision = np.linalg.inv(joint)
    assert variance[40] == pytest.approx(1.0 / precision[-1, -1], rel=1e-5)
    assert mean[40] == pytest.approx(-precision[-1, :-1] @ data / precision[-1, -1], rel=1e-5)
